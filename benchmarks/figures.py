"""The figures of docs/figures.md: what each should be, the command that measures it, and how its output is read.

    python benchmarks/figures.py --table                 # docs/figures.md from docs/figures.json
    python benchmarks/figures.py --measure WORD ...      # run the commands of the figures whose names have these words
    python benchmarks/figures.py --list WORD ...         # print the names and the commands

A command runs in a shell at the root of the repository, once for all of its figures.  `KALMARK_DATA` and
`KALMARK_ORACLE` name the real logs and the recordings.
"""

from __future__ import annotations

import argparse
import datetime
import itertools
import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parent.parent
SAVED, PAGE = ROOT / "docs" / "figures.json", ROOT / "docs" / "figures.md"
Read = Callable[[str], str]  # from the output of a command to the measured value


class Figure(NamedTuple):
    """One row of the table."""

    section: str
    name: str
    wanted: str
    command: str
    read: Read


def passes(output: str) -> str:
    """Return that a test, which asserts what is wanted, has passed; a failure ends the command."""
    return "within"


def row(start: str, text: str) -> Read:
    """Return a reader of the last line that begins with these words; `text` is filled with the words after them."""

    def read(output: str) -> str:
        begin = start.split()
        for line in reversed(output.splitlines()):
            words = line.replace("|", " ").split()
            if words[: len(begin)] == begin:
                return text.format(*(word.rstrip(",;") for word in words[len(begin) :]))
        raise SystemExit(f"no line begins with {start!r} in the output:\n{output}")

    return read


def spread(starts: list[str], columns: list[int]) -> Read:
    """Return a reader of several lines: the least and the greatest of each of these columns."""

    def read(output: str) -> str:
        shown = [[float(row(start, f"{{{c}}}")(output)) for start in starts] for c in columns]
        return " / ".join(f"{min(values):g} to {max(values):g}" for values in shown)

    return read


def several(starts: list[str]) -> Read:
    """Return a reader of several lines: of each the word after these."""
    return lambda output: " / ".join(row(start, "{0}")(output) for start in starts)


def saved(path: str, text: str) -> Read:
    """Return a reader of a JSON file that the command writes; `text` is filled with its values, `robot` with the first."""

    def read(output: str) -> str:
        values = json.loads((ROOT / path).read_text())
        return text.format_map(values | {"robot": next(iter(values.get("robots", {"": {}}).values()))})

    return read


def exactness() -> Iterator[Figure]:
    """Yield the figures that a test asserts."""
    for name, wanted, words in (
        ("`Ekf` on the recorded course run, every x and P", "1e-9", "recorded_course"),
        ("functions of the course in the plane, values and Jacobians", "1e-12", "courses_own_functions"),
        ("heading sigma of a standing robot after 500 scans, `Invariant` and `Fej`", "1e-6°", "learns_nothing_of_its_heading"),
        ("orientation sigmas of a robot that stands in space, 100 scans", "1e-6°", "learns_nothing_of_its_orientation"),
        ("relative map with an uncertain start against an exact one", "1e-9 m", "uncertain_start_leaves"),
        ("augmentation against a prior C: difference", "falls as 1/C", "huge_prior"),
        ("fast `Ekf` against the textbook filter", "1e-10", "textbook_to"),
        ("alignment and ATE against evo", "1e-9", "evo"),
        ("runs in a rotated world, every sensor with every landmark", "1e-6 m; charts 1e-2", "test_invariance"),
        ("functions of space against the toolbox's recordings, 74 of 84", "1e-9", "test_oracle_functions"),
        ("lines of three recorded runs: initialisation, innovation, visibility", "1e-9", "test_oracle_lines"),
        ("Jacobians of every sensor of space with every landmark, 200 draws", "1e-6", "test_seam_in_space"),
        ("fitted lens correction, round trip over the image", ".01 px", "test_lenses"),
        ("compressed map against dense, 3,000 steps, 120 landmarks", "1e-8", "compressed_map_equals_the_dense"),
        ("inactive blocks of every space against the dense filter", "1e-9", "test_compressed_space"),
        ("bearings of near things from steps of 1 m: worlds of ten in which the path is within .5 m", "9", "near_things"),
    ):  # fmt: skip
        yield Figure("Exactness", name, wanted, f"python -m pytest tests -k {words}", passes)
    for mount in ("known", "5 cm and 1.5 deg", "20 cm and 9 deg"):
        yield Figure("Exactness", f"compressed map against dense, mount {mount}: worst landmark / mount off, least to greatest of 20 runs / a sigma smaller",
                     "", "python benchmarks/compressed_mount.py", row(f"mount {mount}:", "{7} to {9} / {11} to {13} sigmas / {18} %"))  # fmt: skip


def campaigns() -> Iterator[Figure]:
    """Yield the consistency of the filters in simulation."""
    shown = "{{estimators[{0}][pose_anees]:.2f}} / {{estimators[{0}][pose_inside]:.1%}} / {{estimators[{0}][joint_anees]:.3f}} / {{estimators[{0}][position_rmse_m]:.3f}} m / {{estimators[{0}][diverged]}}"
    both = "--estimator invariant --estimator ekf"
    cases = [
        *((world, f"kalmark campaign {world} --runs 50 {both}", f"campaign-{world}") for world in ("cloister", "loop_b", "loop_b2", "loop_c")),
        *((name, f"kalmark campaign {name} --runs {runs} {both}", f"campaign-{name}")
          for name, runs in (("lost_in_the_woods", 10), ("mrclam", 20), ("victoria_park_known", 2))),
    ]  # fmt: skip
    for (name, command, out), estimator in itertools.product(cases, ("invariant", "ekf")):
        text = shown.format(estimator)
        wanted = "joint .95 to 1.05" if (name, estimator) == ("cloister", "invariant") else ""
        yield Figure("Consistency", f"`{name}`, `{estimator}`", wanted, command, saved(f"out/{out}/summary.json", text))
    for world, kind in itertools.product(("loop_b2", "loop_c"), ("postponed", "dense")):
        out = f"out/{world}_{kind}"
        command = f"kalmark campaign {world} --runs 100 --estimator invariant --set filter.map.type={kind} --out {out}"
        wanted = "as dense" if kind == "postponed" else ""
        yield Figure("Consistency", f"`{world}`, `invariant`, `map.type={kind}`", wanted, command,
                     saved(f"{out}/summary.json", shown.format("invariant")))  # fmt: skip


def space() -> Iterator[Figure]:
    """Yield the consistency in space."""
    for name, options, wanted, estimator in (
        ("thick_cloister", "", "90 % in the band", "invariant"),
        ("thick_cloister", "", "", "ekf"),
        ("thick_cloister_stereo", "", "90 % in the band", "invariant"),
        ("thick_cloister_stereo", "", "", "ekf"),
        ("thick_cloister_pinhole", "", "at most 7.0", "invariant"),
        ("thick_cloister_pinhole", "", "", "ekf"),
        ("thick_cloister_pinhole", " --set filter.landmarks.type=anchored_homogeneous", "at most 7.0", "invariant"),
        ("thick_cloister_pinhole", " --set filter.landmarks.type=anchored_homogeneous", "", "ekf"),
    ):
        kind = ", anchored homogeneous points" if options else ""
        out = f"out/campaign-{name}{'-anchored' if options else ''}"
        command = (
            f"kalmark campaign {name} --runs 50 --skip 30 --estimator invariant --estimator ekf{options} --out {out}"
        )
        text = f"{{estimators[{estimator}][pose_anees]:.2f}} / {{estimators[{estimator}][pose_inside]:.1%}}"
        yield Figure("Space", f"`{name}`{kind}, `{estimator}`: pose ANEES (6) / in band", wanted, command,
                     saved(f"{out}/summary.json", text))  # fmt: skip
    for name, skip in (("quick_turns", ""), ("thick_cloister_constant_velocity", " --skip 30")):
        out = f"out/campaign-{name}"
        yield Figure("Space", f"`{name}`, `invariant`: pose ANEES (6) / in band", "90 % in the band",
                     f"kalmark campaign {name} --runs 50{skip} --estimator invariant --out {out}",
                     saved(f"{out}/summary.json",
                           "{estimators[invariant][pose_anees]:.2f} / {estimators[invariant][pose_inside]:.1%}"))  # fmt: skip
    house = "kalmark campaign house --runs 20 --skip 30 --estimator invariant --estimator ekf --out out/campaign-house"
    for estimator in ("invariant", "ekf"):
        text = f"{{estimators[{estimator}][pose_anees]:.2f}} / {{estimators[{estimator}][joint_anees]:.2f}}"
        yield Figure("Space", f"`house`, lines, `{estimator}`: pose ANEES (6) / joint (1)", "", house,
                     saved("out/campaign-house/summary.json", text))  # fmt: skip
    for sensor in ("stereo", "pinhole", "pinhole ahead", "laser in space", "laser", "range"):
        along = sensor.replace(" ahead", " on a robot that starts along its route")
        yield Figure("Space", f"mount of a {along}, 5 cm and 1.5° wrong: pose ANEES / in band / NEES of the mount / inside 99.7 %",
                     "- / 85 % / - / 48 of 50", f"python benchmarks/mounts.py '{sensor}'",
                     row(sensor, "{1} / {6} / {8} / {10} of 50"))  # fmt: skip
    out = "out/campaign-pinhole-mount"
    command = (
        "kalmark campaign thick_cloister_pinhole --runs 20 --skip 30 --estimator invariant --estimator ekf --set filter.landmarks.type=inverse_depth"
        " --set robots.robot.sensors.camera.mount.sigma_position_m=0.02 --set robots.robot.sensors.camera.mount.sigma_rotation_deg=1.0"
        f" --out {out}"
    )
    for estimator, wanted in (("invariant", "85 % / better than `ekf`"), ("ekf", "")):
        yield Figure("Space", f"toolbox's cloister and camera, mount in the map, `{estimator}`: pose ANEES (6) / in band / NEES of the mount (6) / position RMSE",
                     wanted, command, saved(f"{out}/summary.json",
                     f"{{estimators[{estimator}][pose_anees]:.2f}} / {{estimators[{estimator}][pose_inside]:.1%}} / {{estimators[{estimator}][mount_anees]:.2f}} / {{estimators[{estimator}][position_rmse_m]:.3f}} m"))  # fmt: skip
    yield Figure("Space", "`self_calibration`: mount 5 cm and 1.5° wrong an axis; error / below 3 sigma",
                 ".1°, 5 mm / 96 %", "kalmark campaign self_calibration --runs 50 --skip 30 --estimator invariant",
                 saved("out/campaign-self_calibration/summary.json",
                       "{estimators[invariant][mount_deg]:.3f}°, {estimators[invariant][mount_m]:.4f} m / {estimators[invariant][mount_sure]:.1%}"))  # fmt: skip
    for name, theirs in TOOLBOX.items():
        yield Figure("Space", f"toolbox recording `{name}`: position RMSE, m / pose NEES", f"{theirs} (toolbox)",
                     f"kalmark run slamtb --log {name}.json.gz --out out/{name}",
                     saved(f"out/{name}/summary.json", "{robot[ate_raw_m]:.4f} / {robot[pose_nees]:.1f}"))  # fmt: skip
    for test in (1, 2, 8, 13, 21, 22):
        yield Figure("Space", f"TagSLAM test {test}, RMS of the corners, px: filter / bundle adjustment", "below 1",
                     "python benchmarks/tags.py", row(str(test), "{3} / {5}"))  # fmt: skip
    yield Figure("Space", "`starry_night`: position raw / landmark sigma ratio / pose NEES", "1.5 times the batch / .9 to 1.1 / 3",
                 "python benchmarks/filter_vs_batch.py starry_night", row("starry_night invariant", "{0} m / {2} / {1}"))  # fmt: skip


def motions() -> Iterator[Figure]:
    """Yield the consistency of the motions of the plane, each in its own world."""
    for world in ("differential_drive", "tricycle", "omnidirectional", "mecanum"):
        yield Figure("Motions", f"`{world}`: pose ANEES (3) / in band / NEES of its constants (1) / runs inside 99.7 %",
                     "90 % in the band / 97 of 100", f"python benchmarks/motions.py {world}",
                     row(world, "{1} / {5} / {7} / {9} of {11}"))  # fmt: skip
    for world, dof, estimator in (
        ("compass_and_gyro", 3, "invariant"),
        ("compass_and_gyro", 3, "ekf"),
        ("diver", 6, "invariant"),
        ("radio", 3, "invariant"),
        ("microphones", 3, "invariant"),
        ("lever_arm", 3, "invariant"),
        ("wheels_and_gyro", 3, "invariant"),
    ):
        text = (
            "{1} / {5} / {9} / {11} of {13}" if world == "diver" else "{1} / {5} / {7} / {9} of {11}"
        )  # it has a state
        name = (
            f"`{world}`, `{estimator}`: pose ANEES ({dof}) / in band / NEES of its constants (1) / runs inside 99.7 %"
        )
        yield Figure("Sensors of the state", name, "" if estimator == "ekf" else "90 % in the band / 97 of 100",
                     f"python benchmarks/motions.py {world} --estimator {estimator}", row(world, text))  # fmt: skip
    for world, dof in (("radar", 3), ("radar_in_space", 6)):
        yield Figure("Sensors of the state", f"`{world}`: pose ANEES ({dof}) / in band / ANEES of the whole state (1)",
                     "90 % in the band", f"python benchmarks/motions.py {world}", row(world, "{1} / {5} / {7}"))  # fmt: skip
    for motion in ("slipping_unicycle", "constant_velocity"):
        for of in ("without", "with"):
            more = "" if of == "without" else " / ANEES more than without"
            yield Figure("Sensors of the state", f"`stop_and_go`, `{motion}`, {of} zero-velocity updates: pose ANEES (3) / sigma / error at "
                         f"the end of stops / windows of stops noticed / false{more}", more and "smaller sigmas, ANEES not worse by two sigmas",
                         "python benchmarks/standing.py",
                         row(f"{motion}, {of}:", "{1} / {7} m / {12} m / {20} / {22}" + (more and " / {26} ± {28}")))  # fmt: skip
    yield Figure("Sensors of the state", "`scan_matching`, loops: pose ANEES (3) / in band", "90 % in the band",
                 "python benchmarks/motions.py scan_matching", row("scan_matching", "{1} / {5}"))  # fmt: skip
    for graph in ("w100", "w1000", "w3500", "sphere2500"):
        yield Figure("Sensors of the state", f"pose graph `{graph}`: last pose from the batch optimum / its sigma / left out / time / memory", "below its sigma",
                     f"python benchmarks/pose_graphs.py {graph}", row(graph, "{5} m / {8} m / {10} / {13} s / {15} GB"))  # fmt: skip
    on_logs = "python benchmarks/real_state_sensors.py"
    for name, wanted, start, text in (
        ("Lost in the Woods, a gyroscope of .1 deg/s bias: bias found / sigma / off / left out", "within 3 sigmas",
         "woods, wide gate:", "{1} deg/s / {4} deg/s / {9} sigmas / {13} of {15}"),
        ("the same, with the usual gate", "", "woods, usual gate:", "{1} deg/s / {4} deg/s / {9} sigmas / {13} of {15}"),
        ("hall, a wheel of +1 %: odometry named first without / with a compass", "all of them", "hall, wheel +1 %:",
         "{3} of {5} / {7} of {9}"),
        ("hall, true wheels: odometry named first without / with a compass", "none", "hall, wheel true:",
         "{3} of {5} / {7} of {9}"),
        ("Victoria Park, GPS: lever arm / sigma / d2 from the given one (2)", "d2 below 11.8", "park: arm",
         "({0}, {1}) m / {4} m / {11}"),
        ("Victoria Park, GPS: left out / NIS (1) / correlation of successive innovations", "below two sigmas, .10", "park: arm",
         "{16} of {18} / {20} / {22}"),
        ("Victoria Park, centroid of the map by the fixes of either half: apart / sigma / d2 (2)", "d2 below 11.8",
         "park: centroids", "{3} m / {7} m / {10}"),
    ):  # fmt: skip
        part = start.split()[0].strip(",:")
        yield Figure("Sensors of the state", name, wanted, f"{on_logs} {part}", row(start, text))
    for world, runs, of in (
        ("constant_velocity", 400, 100),
        ("wheels_and_gyro", 300, 100),
        ("compass_and_gyro", 300, 100),
        ("quick_turns", 200, 50),
    ):
        name = f"`{world}`, {runs} runs: pose ANEES ({6 if world == 'quick_turns' else 3}) / in the band of each {of} / campaigns of {of} drawn of them with 90 %"
        yield Figure("Chance", name, "within two standard errors", f"python benchmarks/motions.py {world} --runs {runs}{f' --of {of}' if of != 100 else ''}",
                     row(f"{world}, {runs} runs:", "{1} ± {3} / {12} / {16}"))  # fmt: skip
    quiet = "a tenth of all noise, the same draws"
    yield Figure("Chance", f"`wheels_and_gyro`, {quiet}, 300 runs: pose ANEES (3) / in the band of each 100 / campaigns of 100 drawn of them with 90 %",
                 "", "python benchmarks/motions.py wheels_and_gyro --noise 0.1 --runs 300",
                 row("wheels_and_gyro, 300 runs:", "{1} ± {3} / {12} / {16}"))  # fmt: skip
    yield Figure("Chance", f"`compass_and_gyro`, {quiet}: pose ANEES (3) / in band", "",
                 "python benchmarks/motions.py compass_and_gyro --noise 0.1", row("compass_and_gyro", "{1} / {5}"))  # fmt: skip
    for world in ("slipping_unicycle", "constant_velocity", "constant_turn_rate"):
        yield Figure("Motions", f"`{world}`: pose ANEES (3) / in band / ANEES of the whole state (1)", "90 % in the band",
                     f"python benchmarks/motions.py {world}", row(world, "{1} / {5} / {7}"))  # fmt: skip


def inertial() -> Iterator[Figure]:
    """Yield the consistency of an inertial unit along EuRoC's trajectory, and what it learns of nothing."""
    for sensor, estimator in (("stereo", "invariant"), ("spherical", "invariant"), ("stereo", "ekf")):
        wanted = ".3 % / 85 % in the band" if estimator == "invariant" else ""
        name = f"V1_01, {sensor} points, `{estimator}`: position / attitude ANEES (3) / in band / state ANEES (15)"
        yield Figure("Inertial", name, wanted, f"python benchmarks/inertial.py path --sensor {sensor} --estimator {estimator}",
                     row(f"path {sensor} {estimator}:", "{3} % / {14} / {18} / {30}"))  # fmt: skip
    for scale in (1, 10):
        name = f"V1_01, readings of the unit, densities times {scale}, stereo points: position / attitude ANEES (3) / state ANEES (15)"
        yield Figure("Inertial", name, ".3 %", f"python benchmarks/inertial.py recorded --runs 2 --scale {scale}",
                     row("recorded stereo invariant:", "{3} % / {14} / {30}"))  # fmt: skip
    for at, seconds in enumerate((1, 5, 20)):
        name = f"V1_01, the truth: its turns in {seconds} s against those of the unit, RMS an axis / of the unit's noise / fitted"
        text = " / ".join(f"{{{at * 10 + k}}} mrad" for k in (6, 10, 12))
        yield Figure("Inertial", name, "", "python benchmarks/inertial.py truth", row("truth: turns off,", text))
    name = ("V1_01, the truth's positions of 10 s by forces read: left with its turns and biases / a constant bias / the unit's turns and "
            "a constant bias / windows in which that is less / change of its biases in 20 s / of their walk")  # fmt: skip
    yield Figure("Inertial", name, "", "python benchmarks/inertial.py truth",
                 row("truth: positions of", "{9} mm / {18} mm / {28} mm / {31} of {33} / {44} mm/s² / {49}"))  # fmt: skip
    for estimator in ("invariant", "ekf"):
        wanted = "0 of 100" if estimator == "invariant" else ""
        yield Figure("Inertial", f"information about position and yaw, `{estimator}`: most, start 1 / runs that gain any", wanted,
                     f"python benchmarks/inertial.py gauge --runs 100 --estimator {estimator}",
                     row(f"gauge {estimator}:", "{2} / {12} of {14}"))  # fmt: skip
        wanted = "1 within 1e-6" if estimator == "invariant" else ""
        yield Figure("Inertial", f"5 min at rest, `{estimator}`: least and most information about position and yaw", wanted,
                     f"python benchmarks/inertial.py still --estimator {estimator}",
                     row(f"still {estimator}:", "{2} / {4}"))  # fmt: skip
    for of, heading, estimator, more in (
        ("a receiver", 30, "invariant", ""),
        ("a receiver", 0.01, "invariant", ""),
        ("a receiver", 30, "ekf", ""),
        ("a receiver of 0.05 m", 30, "invariant", " --receiver 0.05"),
        ("a tower that sees it", 30, "invariant", " --seen"),
    ):
        label = f"a drive with {of} and wheels, heading at the start {heading} deg, `{estimator}`"
        yield Figure("Inertial", f"{label}: state NEES (15) after 30 s / 60 s / 180 s, mean of 40 runs",
                     "below 16.8, its 97.5 %" if estimator == "invariant" else "",
                     f"python benchmarks/drive.py --heading {heading} --estimator {estimator}{more}",
                     several([f"{estimator} {t_s} s: state" for t_s in (30, 60, 180)]))  # fmt: skip


TOOLBOX = {
    "a_idpPnt_odo": ".0365 / 6.5", "a_idpPnt_odo_small": ".0405 / 7.8", "a3_hmgPnt_odo": ".0217 / 25.7",
    "b2_idpPnt_constVel_small": ".095 / 5.3", "c_idpLin_small": ".0113 / 7.6", "c_plkLin_small": ".0117 / 7.6",
    "c_hmgLin_small": ".0117 / 7.9", "e_omni_ahmPnt": ".0371 / 7.6", "g_outliers_small": ".0411 / 6.7",
}  # fmt: skip


def real_logs() -> Iterator[Figure]:
    """Yield the figures of real logs with known association."""
    command = "python benchmarks/real_logs.py"
    for label, start, wanted, text in (
        ("Lost in the Woods: position raw / landmarks raw", "lost_in_the_woods", ".078 / .042 m", "{0} / {2} m"),
        ("Lost in the Woods, ranges to 1 m: position raw / landmarks aligned", "lost_in_the_woods 1 m", "1.42 / .165 m", "{0} / {3} m"),
        ("MRCLAM 6, mean of five robots alone: position raw / landmarks aligned / pose NEES", "mrclam, mean of five", ".41 m / .10 m / 4", "{0} m / {3} m / {4}"),
        ("MRCLAM 6, all in one map: position raw", "mrclam all in one", ".14 m", "{0} m"),
        ("Victoria Park, known trees: aligned median / share within 10 m", "victoria_park_known", "1.4 m / .96", "{6} m / {7}"),
    ):  # fmt: skip
        for estimator in ("invariant", "ekf"):
            yield Figure("Real logs, known association", f"{label}, `{estimator}`", wanted, command,
                         row(f"{start} {estimator}", text))  # fmt: skip
    command = "python benchmarks/filter_vs_batch.py"
    for label, start in (
        ("Lost in the Woods", "lost_in_the_woods"), ("Lost in the Woods, ranges to 3 m", "lost_in_the_woods_3m"),
        ("Lost in the Woods, ranges to 1 m", "lost_in_the_woods_1m"), ("MRCLAM 6, all in one", "mrclam_all"),
        ("Victoria Park, known trees", "victoria_park_known"), ("DLR", "dlr"), ("Freiburg course", "freiburg_course"),
    ):  # fmt: skip
        for estimator in ("invariant", "ekf"):
            wanted = ".95 to 1.05 / .35" if estimator == "invariant" else ""
            yield Figure("Filter against batch",
                         f"{label}, `{estimator}`", wanted, command,
                         row(f"{start} {estimator}", "{2} / {4} / {3}"))  # fmt: skip
    for estimator in ("invariant", "ekf"):
        wanted = ".95 to 1.05 / .35" if estimator == "invariant" else ""
        yield Figure("Filter against batch", f"MRCLAM 6, each of five robots, `{estimator}`", wanted, command,
                     spread([f"mrclam_{k} {estimator}" for k in range(1, 6)], [2, 4, 3]))  # fmt: skip


def unknown_ids() -> Iterator[Figure]:
    """Yield the figures without ids."""
    park, section = "python benchmarks/victoria_park.py", "Victoria Park from its raw laser"
    for label, start in (("raw laser, unknown ids", "laser"), ("RFS detections, unknown ids", "rfs")):
        for steering in ("ascii", "mat"):
            yield Figure(section, f"{label}, steering `{steering}`: median / RMS within 10 m / share within 10 m / duplicates by scan, by map, %",
                         "2.0 m / 3 m / 95 % / 10", park, row(f"{start} {steering}", "{0} m / {1} m / {2} / {6}, {7}"))  # fmt: skip
            yield Figure(section, f"{label}, steering `{steering}`: landmarks / of 299 trees / times real time",
                         "- / - / 10", park, row(f"{start} {steering}", "{4} / {5} / {8}"))  # fmt: skip
    section = "Association"
    for sigmas, prototype in ((".2 m, 3°", "0 / 0"), (".4 m, 5°", ".6 / 2"), ("1 m, 15°", "2.7 / 7")):
        for k, name in enumerate(("nearest", "global", "jcbb", "clique", "sample", "auto")):
            start = {".2 m, 3°": "0.2 m, 3 deg", ".4 m, 5°": "0.4 m, 5 deg", "1 m, 15°": "1.0 m, 15 deg"}[sigmas]
            yield Figure(section, f"pose sigma {sigmas}, `{name}`: wrong pairs / scans with one, %",
                         prototype if name == "auto" else "", "python benchmarks/association.py", cell(start, k))  # fmt: skip
    for name in ("auto", "clique", "jcbb", "nearest"):
        yield Figure(section, f"loop of 6 m and 15°, 200 runs, `{name}`: closed / open / wrong, %",
                     "98 / - / 0" if name == "auto" else "", "python benchmarks/loop_closing.py", row(name, "{0} / {2} / {4}"))  # fmt: skip
    yield Figure(section, "ring roads of 500 m, 20 seeds: maps right / loop open / wrong", "20 / 0 / 0",
                 "python benchmarks/ring_road.py", row("right", "{0} / {2} / {4}"))  # fmt: skip
    section, dlr = "Logs with hidden ids", "python benchmarks/unknown_ids.py dlr dlr_unknown"
    yield Figure(section, "DLR: wrong pairs", "1 %", dlr, row("wrong:", "{0} of {2} {3}"))
    yield Figure(
        section, "DLR: observations of clutter that are not fused", "90 %", dlr, row("without an id in the log:", "{5}")
    )
    yield Figure(section, "DLR: map against that with ids, RMS, raw / aligned", ".3 m", dlr,
                 row("difference of the maps, RMS:", "{0} m / {2} m"))  # fmt: skip
    yield Figure(section, "DLR: landmarks with ids / without", "", dlr, row("landmarks:", "{0} / {3}"))
    ghosts, name = "python benchmarks/ghosts.py", "landmarks not seen again, 8 worlds of 3 seeds"
    yield Figure(section, f"{name}: trees marked, nobody walks", "1 %", ghosts, row("all:", "{0} of {2}"))
    yield Figure(section, f"{name}: of a walker marked / of these expected again", "- / 90 %", ghosts,
                 row("all:", "{10} of {12} / {15} of {17}"))  # fmt: skip
    for robot in range(1, 6):
        each = f'python benchmarks/unknown_ids.py mrclam mrclam --set log.ids=hidden --set association.type=auto --set "log.robots=[{robot}]"'
        yield Figure(section, f"MRCLAM 6, robot {robot}: wrong pairs", "2 in 1,000", each, row("wrong:", "{0} of {2}"))
        yield Figure(section, f"MRCLAM 6, robot {robot}: of these, of landmarks over .5 m apart", "", each,
                     row("of these, of landmarks more than 0.5 m apart:", "{0}"))  # fmt: skip
        yield Figure(section, f"MRCLAM 6, robot {robot}: aligned path RMSE / with ids", "1.3 times", each,
                     row(f"robot{robot}: aligned path RMSE", "{0} m / {4} m"))  # fmt: skip
        ideal = f'python benchmarks/unknown_ids.py mrclam --set "log.robots=[{robot}]"'
        yield Figure(section, f"MRCLAM 6, robot {robot}, all earlier ids known: another landmark is the nearest / takes the best assignment",
                     "", ideal, row("another is the nearest:", "{0} / {9}"))  # fmt: skip


def cell(start: str, index: int) -> Read:
    """Return a reader of the column of a method in the table of associations."""

    def read(output: str) -> str:
        for line in output.splitlines():
            cells = [c.strip() for c in line.strip("| ").split("|")]
            if cells[0] == start:
                return cells[1 + index]
        raise SystemExit(f"no row {start!r} in the output:\n{output}")

    return read


def storms() -> Iterator[Figure]:
    """Yield what becomes of a map in a storm of bad events."""
    yield Figure("Bad events", "1,000,000 events, 5 % bad, all estimators, maps and worlds: refused / not as they should be / storms that end as without them / growth of memory",
                 "all / 0 / all / flat", "python benchmarks/storm.py --events 1000000", row("total", "{1} / {2} / {3} of {4} / {5} MB"))  # fmt: skip
    yield Figure("Bad events", "66,000 events, before 91 % of them a bad one: refused / not as they should be / storms that end as without them",
                 "about 60,000 / 0 / all", "python benchmarks/storm.py --events 66000 --share 0.91", row("total", "{1} / {2} / {3} of {4}"))  # fmt: skip
    yield Figure("Bad events", "Odd files, configurations, maps and streams of events, 100 of each target: inputs / taken / broken",
                 "all / some / 0", "python benchmarks/fuzz.py --inputs 100", row("total", "{0} / {1} / {2}"))  # fmt: skip
    yield Figure("Bad events", "Odd files and configurations, whole runs with pictures and page (308 once had 14 tracebacks): inputs / taken / broken", "308 or more / some / 0",
                 "python benchmarks/fuzz.py --odd", row("total", "{0} / {1} / {2}"))  # fmt: skip
    yield Figure("Bad events", "Damages to the cache of compiled code (199 once had 73 tracebacks and a crash): damages / same map / tracebacks, crashes, other maps", "199 or more / all / 0",
                 "python benchmarks/fuzz.py --caches 200", row("total", "{0} / {1} / {2}"))  # fmt: skip
    for name in ("native", "mrclam", "config", "map", "process", "parquet", "mcap", "ros1", "sqlite", "matlab", "g2o", "carmen",
                 "tum", "kitti", "freiburg", "dlr", "plaza"):  # fmt: skip
        limit = "" if name in ("mcap", "ros1", "sqlite", "native", "process") else " --timeout 400"  # s an input
        yield Figure("Bad events", f"Fuzzing `{name}` guided by coverage, 10 minutes: inputs / crashes, hangs, tracebacks", "all / 0",
                     f"python benchmarks/fuzz.py --seconds 600{limit} {name}", row("total", "{0} / {2}"))  # fmt: skip
    for kind in ("dense", "postponed"):
        yield Figure("Bad events", f"A scan of 3,000 landmarks, `{kind}` map: all new / known by their ids / memory", "seconds / seconds / -",
                     f"python benchmarks/large_scan.py --map {kind}", row("3000 landmarks:", "{0} s / {3} s / {6} MB"))  # fmt: skip
    yield Figure("Bad events", "A log of 1,000,000 rows of CSV: time / memory / bytes a row", "- / that of its events / -",
                 "python benchmarks/tables.py --rows 1000000", row("1000000 rows,", "{6} s / {8} MB / {10}"))  # fmt: skip
    yield Figure("Bad events", "Of 10,000,000 rows, event by event (`stream_log`): time / growth of the memory", "- / bounded",
                 "python benchmarks/tables.py --rows 10000000 --stream", row("10000000 rows,", "{6} s / {8} MB"))  # fmt: skip


def gaps() -> Iterator[Figure]:
    """Yield what becomes of a map when controls and scans stop for a while."""
    section, command = "Gaps", "python benchmarks/hall.py"
    yield Figure(section, "hall of 24 pillars without ids, gaps of 0 to 16 s, both wheels, increments and velocities: maps that are right",
                 "95 %", command, row("total", "{0} of {1}"))  # fmt: skip
    yield Figure(
        section, "wrong maps without an alarm / right maps with one", "0 / 0", command, row("total", "{2} / {3}")
    )
    command = "python benchmarks/hall.py --rows --gaps 4 8 --runs 10 --verdict"
    yield Figure(section, "pillars in rows, gaps of 4 and 8 s in the first round: maps that are right", "95 %", command,
                 row("total", "{0} of {1}"))  # fmt: skip
    yield Figure(section, "pillars in rows: wrong maps that the verdict calls ok / right ones that it does not", "0 / 0",
                 command, row("total", "{2} / {3}"))  # fmt: skip
    section, command = "A robot that is elsewhere", "python benchmarks/carried.py"
    worlds = "random_field", "sparse", "dense", "no limits stated"
    for world, ids in itertools.product(worlds, ("ids", "no ids")):
        yield Figure(section, f"carried away, `{world}`, {ids}: found / after, at most / false alarms / maps with a landmark off or twice",
                     "95 % / 30 s / 0 / 0", command, row(f"{world} {ids}", "{1} of {3} / {9} s / {13} / {19}"))  # fmt: skip
    command = "python benchmarks/anywhere.py"
    for way, said in (
        ("start", "a start anywhere in a known map"),
        ("known", "carried away in a known map"),
        ("own", "carried away in its own map"),
    ):
        for case, within in (("points", 30), ("points_no_ids", 30), ("rays", 30), ("four_ranges", 30), ("points_of_space", 2),
                             ("rays_of_space", 2), ("ranges_of_space", 2), ("corners_of_tags", 2), ("poses_of_tags", 2)):  # fmt: skip
            if way != "own" or case not in ("points_no_ids", "four_ranges", "ranges_of_space"):
                yield Figure(section, f"{said}, {case.replace('_', ' ')}: placed / after, median, most / sure of another place",
                             f"95 % / {within} s / 0", command, row(f"{way} {case}", "{0} of {2} / {4} s, {8} s / {12}"))  # fmt: skip
    section, command = "Walls", "python benchmarks/walls.py"
    for name, wanted in (("invariant", ("3 / 90 %", "0 / 0")), ("ekf", ("", ""))):
        yield Figure(section, f"hall of walls and corners, raw laser, no ids, 50 runs, `{name}`: pose ANEES / steps in its band",
                     wanted[0], command, row(name, "{0} / {1} %"))  # fmt: skip
        yield Figure(section, f"the same, `{name}`: walls / on no true wall / there twice",
                     wanted[1], command, row(name, "{4} / {5} / {6}"))  # fmt: skip
    section, command = "Repeats", "python benchmarks/repeats.py"
    yield Figure(section, "halls whose gaps of 2, 4 and 16 s are ignored: maps that are right, repeats off / merged",
                 "95 %", command, row("gaps ignored", "{0} / {1} of {2}"))  # fmt: skip
    yield Figure(section, "halls mapped once, repeats merged: found at the end / maps that are right", "0 / 95 %", command,
                 row("mapped once", "{0} / {1} of {2}"))  # fmt: skip
    yield Figure(section, "maps at random, orchards, avenues, clusters, pallets: repeats found", ".001", command,
                 row("without repeats", "{0} of {1}"))  # fmt: skip


def race_track() -> Iterator[Figure]:
    """Yield the maps of a race track."""
    section, command = "A race track", "python benchmarks/race_track.py"
    for fault in ("clean", "60 ms late", "slipping", "spun", "no classes"):
        name = f"{fault}: laps with each cone once / path RMSE, m (worst) / at the end / a scan, ms (worst)"
        wanted = "95 % / .3 / .3 / 4 (20)"
        yield Figure(section, name, wanted, command, row(fault, "{0} of {2} / {5} {6} / {9} {10} / {11} {12}"))
        name = f"{fault}: path RMSE of the batch solution of what the filter used, with its lag, m (worst)"
        yield Figure(section, name, ".3", f"{command} --runs 6", row(fault, "{7} {8}"))


def diagnosis() -> Iterator[Figure]:
    """Yield what the diagnosis names."""
    section, command = "Diagnosis", "python benchmarks/diagnosis.py"
    read = row("planted:", "{0} first, {5} among the first three, of {2}")
    yield Figure(section, "simulated logs with one planted fault: it is named first (85 %), among the first three (97 %)",
                 "85 %, 97 %", command, read)  # fmt: skip
    yield Figure(section, "clean simulated logs that are accused of anything (200)", "1 % at most", command,
                 row("clean:", "{0} of {2}"))  # fmt: skip
    names = "right and ok / right, doubtful or unchecked / right and wrong / wrong and named / wrong and ok"
    rows = ["right and ok", "right and doubtful or unchecked", "right and wrong", "wrong and named", "wrong and ok"]
    yield Figure(section, f"200 logs of ten worlds from outside, 23 faults, without truth: {names}", "at most 2 wrong and ok",
                 "python benchmarks/verdict_truth.py LOGS", several(rows))  # fmt: skip
    for world in ("lever_arm", "wheels_and_gyro", "compass_and_gyro", "stop_and_go"):
        yield Figure(section, f"faults of sensors of the state, `{world}`: alarmed / named, of planted; good runs accused", "",
                     f"python benchmarks/diagnosis_readings.py {world} --seeds 2 --clean 10",
                     row(f"sum of {world}:", "{0} / {2} of {5}; {7} of {9}"))  # fmt: skip
    further = "python benchmarks/diagnosis_worlds.py"
    yield Figure(section, "planted faults, further worlds: first / among three", "85 %, 97 %", further, read)
    yield Figure(section, "planted faults, further worlds: clean logs that are accused of anything", "1 % at most", further,
                 row("clean:", "{0} of {2}"))  # fmt: skip
    yield Figure(section, "planted faults, further worlds: maps that are off by the truth and called ok", "none", further,
                 row("off:", "{0} of {2}"))  # fmt: skip
    yield Figure(section, "shipped real logs whose verdict is as they are known to be", "all",
                 "python benchmarks/diagnosis.py --real", row("real:", "{0} of {2}"))  # fmt: skip


def outliers() -> Iterator[Figure]:
    """Yield how much spurious ranges under right ids do."""
    command = "python benchmarks/outliers.py"
    for case, title in (
        ("later", "3 % of the ranges anywhere, but not first observations"),
        ("any", "3 % of the ranges anywhere"),
    ):
        for way, start in (
            ("all taken", "all taken"),
            ("gate .9999", "gate .9999"),
            ("`huber`", "huber"),
            ("`student`", "student"),
        ):
            wanted = "2 to 4 / / / 0" if case == "later" and way != "all taken" else ""
            yield Figure("Outliers", f"{title}, {way}: pose NEES / path, m / landmarks, m / landmarks off by .5 m", wanted,
                         command, row(f"{case} {start}", "{0} / {1} / {3} / {5}"))  # fmt: skip


def tuning() -> Iterator[Figure]:
    """Yield how real logs fit on their second half, tuned by the first."""
    command, shown = "python benchmarks/tuning.py", "{2} / {5} / {9}, {10} m, {11} m to {13}, {14} m, {15} m"
    for log, start in (("Lost in the Woods", "lost_in_the_woods"), ("MRCLAM 6, robot 3", "mrclam_3")):
        for aim, wanted in (("innovations", ".9 to 1.1 after"), ("map", "")):
            name = (
                f"{log}, aim {aim}: NIS of the second half before / after / pose NEES, path, landmarks before and after"
            )
            yield Figure("Tuning by the first half", name, wanted, command, row(f"{start} {aim}:", shown))


def bags() -> Iterator[Figure]:
    """Yield bags with the configurations that `kalmark bag` wrote, and logs as MCAP and back."""
    section, command = "ROS bags", "python benchmarks/bags.py"
    yield Figure(section, "nav2 bag, no line edited: fixes / rejected / off, median / largest", "no fix rejected", command,
                 row("nav2:", "{6} / {7} / {10} m / {13} m"))  # fmt: skip
    yield Figure(section, "TagSLAM test 13 with its 39 wrong detections: RMSE of the path, as it is / gate of .9999 / Huber", "-", f"{command} wrong",
                 row("wrong, test 13:", "{7} m / {16} m / {24} m"))  # fmt: skip
    for test, edits in ((1, 2), (13, 2), (22, 3)):
        name = f"TagSLAM test {test} by topic, {edits} lines edited: RMS of the corners, px (by its importer)"
        yield Figure(section, name, "as its importer", command, row(f"tags, test {test}:", "{10} {12}"))
    for name in ("mrclam", "victoria_park_known"):
        yield Figure(section, f"`{name}` as MCAP and back: events / log / map", "the same to the last bit", command,
                     row(f"mcap, {name}:", "{0} / {7} {8} / {10} {11}"))  # fmt: skip


def images() -> Iterator[Figure]:
    """Yield one camera on recorded images."""
    shown = "{0} {1} {2} {3} {4} m / {6} % / {10} / {11} ms"
    sequences = (
        ("fr1_xyz", "fr1_xyz, 320 x 240, 798 frames, 8.0 m", "0.015 m each / 2 %"),
        ("tsukuba", "tsukuba, 640 x 480, 150 frames, 3.8 m", "0.04 m each / -"),
    )
    for name, label, wanted in sequences:
        yield Figure("Images", f"one camera, {label}: ATE of five seeds, aligned by similarity / scale drift / matched a frame / a frame",
                     wanted, f"python benchmarks/vision.py {name}", row(name, shown))  # fmt: skip
        yield Figure("Images", f"the same with lines, {name}: ATE of five seeds / scale drift / points, lines matched a frame / a frame",
                     wanted, f"python benchmarks/vision.py {name}+lines", row(f"{name}+lines", "{0} {1} {2} {3} {4} m / {6} % / {10}, {12} / {11} ms"))  # fmt: skip
    yield Figure("Images", "one camera, tsukuba, 640 x 480, 54 matched of 84 in view, a frame on one core, median: all / templates / search / new landmarks / patches / filter",
                 "16.7 ms / - / - / - / - / -", "python benchmarks/vision.py tsukuba", row("tsukuba", "{11} ms / {13} / {14} / {15} / {16} / {17} ms"))  # fmt: skip
    unit, wanted = "python benchmarks/vision_inertial.py", "0.02 m / 0.5 deg / 0.05 m/s / 1 % / 1"
    errors = "position / attitude / velocity / scale / NEES of the pose, a dof"
    for name, label in (
        ("euroc", "EuRoC V1_01, 90 frames"),
        ("smoothed", "the same against orientations optimised again"),
    ):
        yield Figure("Images", f"a camera with an inertial unit, {label}, largest of five seeds: {errors}", wanted, unit,
                     row(name, "{0} m / {1} deg / {2} m/s / {3} % / {4}"))  # fmt: skip
    for name in ("data sheet", "in use"):
        yield Figure("Images", f"exact points in the place of its images, densities of the unit {name}: {errors}", "- / - / - / - / 1", f"{unit} points",
                     row(f"{name}:", "{1} m / {3} deg / {5} m/s / {7} % / {9}"))  # fmt: skip
    yield Figure("Images", "one camera, desk video, 640 x 480: end off the start, share of the path, largest of five seeds / a frame",
                 "1 % / -", "python benchmarks/vision.py desk", row("desk", "{8} % / {11} ms"))  # fmt: skip
    yield Figure("Images", "the same against a batch solution of its images, shares of the path, largest of five seeds: end off the start, filter / batch solution / one against the other / RMS of the two paths",
                 "- / - / 1 % / -", "python benchmarks/vision_return.py", row("desk", "{0} / {2} / {4} / {6} %"))  # fmt: skip
    yield Figure("Images", "one camera that begins before a known target, MonoSLAM's sequence, 1,000 frames, worst of five seeds: medians against the target's PnP of position / angle / middle of the target / its corners; scatter of PnP; matched, least",
                 "0.01 m / 1 deg / - / - / - / never lost", "python benchmarks/vision_target.py",
                 row("target", "{0} m / {1} deg / {2} m / {3} px / {4} m / {8}"))  # fmt: skip
    batch = "python benchmarks/vision_target.py batch"
    off = "{5} m, {7} deg / {1} m, {3} deg / {9} m, {11} deg / {13}, {15} px / {17}, {19} px"
    yield Figure("Images", "the same, every eighth frame, medians, three seeds: filter against a batch solution / filter against PnP / batch solution against PnP; corners under the batch solution, withheld from it / under PnP, under PnP of the frames before and after, moved as the filter",
                 "0.01 m, 1 deg / 0.01 m, 1 deg / - / - / -", batch,
                 row("batch, median:", off))  # fmt: skip
    for label, start in (
        ("the focal length of batch solution and PnP times 0.99", "focal length times 0.99:"),
        ("the focal length of batch solution and PnP times 1.01", "focal length times 1.01:"),
        ("corners of 0.05 px in the batch solution, 0.3 px elsewhere", "corners of 0.05 px:"),
        (
            "the lens that a batch solution with free intrinsics found, in filter, batch solution and PnP",
            "fitted lens:",
        ),
    ):
        yield Figure("Images", f"the same, one seed, {label}", "-", batch, row(f"batch, seed 0, {start}", off))
    yield Figure("Images", "the same, medians, three seeds: filter against a batch solution with free intrinsics, lens and size of the target / its chi-square as a share of that with them held / its focal lengths / centre / target",
                 "0.01 m, 1 deg / - / - / - / -", batch,
                 row("free, median:", "{1} m, {3} deg / {5} / {7}, {9} px / {11}, {13} px / {19}, {21} mm"))  # fmt: skip
    yield Figure("Images", "one camera round a room, its walls in view, 520 rendered images: RMS of the position after the first round, each of five seeds / the same without descriptors",
                 "-", "python benchmarks/vision.py loop", row("loop", "{0} {1} {2} {3} {4} m / {5} {6} {7} {8} {9} m"))  # fmt: skip
    worlds = {"": "one camera", "_depth": "a camera with depth", "_stereo": "a rectified pair"}
    for name, label in ((f"textured_room{kind}", label) for kind, label in worlds.items()):
        yield Figure("Images", f"`{name}`, {label}, 450 rendered images, five seeds: largest RMS of the position, not aligned / ANEES of the pose, a dof / in its band / a frame",
                     "- / 1 / 80 % / -", f"python benchmarks/vision.py {name}",
                     row(name, "{0} m / {1} / {2} % / {4} ms"))  # fmt: skip
        yield Figure("Images", f"`{name}`, matches against true points, three seeds: RMS / median as RMS / correlation with the next frame, 50 frames later / chi-square by their noise, a dof / median",
                     "- / - / - / 1 / 1", f"python benchmarks/vision_matches.py {name}",
                     row(name, "{1} px / {2} px / {4}, {5} / {6} / {7}"))  # fmt: skip


def image_peers() -> Iterator[Figure]:
    """Yield what others make of the images that kalmark reads: OpenCV's parts put together, and SVO."""
    camera = "--set log.fps=30 --set 'robots.each.sensors.camera={type: pinhole, fx_px: 615, fy_px: 615, cx_px: 320, cy_px: 240}'"
    for name, log in (
        ("TUM fr1_xyz, 320 x 240, 798 frames", "visual/tum_fr1_xyz"),
        ("Tsukuba, 640 x 480, 150 frames", f"visual/tsukuba150 {camera}"),
        ("EuRoC V1_01, 752 x 480, 90 frames, no inertial unit", "visual/euroc_v101_micro"),
    ):
        command = f'python benchmarks/vision_peers.py {log} --svo "$SVO_PYTHON"'
        rest = "ATE, similarity-aligned, cm / frames tracked, % / scale of both halves / a frame, ms"
        yield Figure(
            "Images",
            f"OpenCV's tracks, essential matrix and PnP, {name}: {rest}",
            "-",
            command,
            row("klt", "{0} / {1} / {2} / {3}"),
        )
        yield Figure("Images", f"SVO (svo-cpp), {name}, three runs: {rest}", "-", command,
                     spread(["svo 0", "svo 1", "svo 2"], [0, 1, 2, 3]))  # fmt: skip


def partial_measurements() -> Iterator[Figure]:
    """Yield the figures of ranges alone and bearings alone."""
    section, command = "Ranges alone", "python benchmarks/range_only.py"
    for label, start in (
        ("beacons at 5 to 20 m", "5 to 20 m"), ("beacons at 20 to 80 m", "20 to 80 m"),
        ("four at 10 to 40 m, scale and bias unknown", "four at 10 to 40 m, scale 7 % and bias .2 m unknown"),
        ("straight line", "5 to 20 m, straight line"),
    ):  # fmt: skip
        for way in ("trilateration", "hypotheses"):
            wanted = "none started" if "straight" in label else "98 to 100 %" if "beacons" in label else ""
            yield Figure(section, f"{label}, {way}: started / squared error within 99 %", wanted, command,
                         row(f"{start} {way}", "{0} / {1}"))  # fmt: skip
    label = "eight around a circle of 10 m, strengths, path loss unknown"
    yield Figure(section, f"{label}: started / squared error within 99 % / mean of it (2)", "- / 98 to 100 %", command,
                 row(f"{label} trilateration", "{0} / {1} / {2}"))  # fmt: skip
    for label, start, wanted in (
        ("Plaza1, scale and bias unknown", "all unknown", ".45 m / .15 m / 1 % of 1.069"),
        ("Plaza1, scale given", "scale given", ".354 / .099 m"),
        ("Plaza1, scale unknown, no bias", "no bias", ""),
        ("Plaza1, hypotheses", "hypotheses", ""),
    ):
        yield Figure(
            section, f"{label}: path / beacons aligned / scale", wanted, command, row(start, "{0} / {1} m / {2}")
        )
    section, command = "Bearings alone, in the plane", "python benchmarks/bearing_only.py"
    wanted = {"inverse depth": ("99 %", "95 %"), "delayed": ("97 %", "90 %"), "naive": ("", "")}
    for reach, way in itertools.product(("5 to 20", "20 to 80"), wanted):
        yield Figure(section, f"{reach} m, {way}: started / consistent / within 20 % / NEES mean, median (2, 1.39)",
                     wanted[way][0 if reach == "5 to 20" else 1], command, row(f"{reach} {way}", "{0} % / {1} % / {2} % / {3}, {4}"))  # fmt: skip
    woods = "kalmark run lost_in_the_woods_bearing --out out/woods_bearing"
    yield Figure(section, "Lost in the Woods without ranges: aligned position / landmarks", ".132 m", woods,
                 saved("out/woods_bearing/summary.json", "{robot[ate_m]:.3f} m / {landmark_rmse_m:.3f} m"))  # fmt: skip
    kinds = ("inverse_depth", "anchored_homogeneous", "homogeneous")
    for case, dof, d in (
        ("bearing and range", 3, 2),
        *((f"pinhole {kind} {db} dB", 6, 3) for kind in kinds for db in (0.1, 1.0)),
    ):
        yield Figure("Sensors that meet on one landmark", f"{case}: of 160 used at least / on average / pose ANEES ({dof}) / in band / landmarks' ({d}) / in band",
                     "150 / - / 90 % in the band, both", "python benchmarks/depths.py",
                     row(f"{case}:", "{1} / {4} / {10} / {15} / {17} / {22}"))  # fmt: skip
    for sensor in ("laser", "sonar", "camera", "rgbd", "arva", "rfid"):
        yield Figure("Presets of [S] Table 2", f"`{sensor}`, 50 runs: pose ANEES", "3",
                     "python examples/05_table2.py 50", row(sensor, "{0}"))  # fmt: skip


def known_maps() -> Iterator[Figure]:
    """Yield the figures of localisation."""
    section, command = "Known maps", "python benchmarks/localization.py steps"
    for how, name in (("ids", "with ids"), ("auto", "without ids, `auto`")):
        yield Figure(section, f"a step with 4,000 exactly known landmarks over one with 10, {name}", "1.2 at most", command,
                     row(f"{how} ratio", "{0}"))  # fmt: skip
    yield Figure(section, "memory of 4,000 exactly known landmarks / rows in P", "", command,
                 row("ids known 4000:", "{4} MB / {6}"))  # fmt: skip
    yield Figure(section, "starts anywhere in a hall of 24 known pillars: found / wrong / median time", "95 of 100 / 0", 
                 "python benchmarks/localization.py hall --runs 100", row("start:", "{1} of {3} / {5} / {10} s"))  # fmt: skip
    yield Figure(section, "world `localization`, 100 runs: pose ANEES / % of steps inside", "3 / 90 %",
                 "kalmark campaign localization --runs 100 --out out/localization",
                 saved("out/localization/summary.json", "{estimators[invariant][pose_anees]:.2f} / {estimators[invariant][pose_inside]:.1%}"))  # fmt: skip


def commands() -> Iterator[Figure]:
    """Yield what commands add to the filter's own time."""
    for verb in ("demo", "evaluate", "explain"):
        yield Figure("Speed", f"`kalmark {verb}`, warm, processor time added to the filter's own: here / 9ae1bee / ratio", "2 s",
                     "python benchmarks/warm.py 9ae1bee", row(f"{verb}, added:", "{0} s / {3} s / {7}"))  # fmt: skip
    for verb in ("demo", "run"):
        yield Figure("Speed", f"of what `kalmark {verb}` adds, imports, cache, pictures and page alone", "2 s",
                     "python benchmarks/warm.py 9ae1bee", row(f"{verb}, imports, cache,", "{3} s"))  # fmt: skip
    yield Figure("Speed", "`kalmark run`, warm, on Lost in the Woods, 61,086 observations: processor time added to the filter's own: here / 9ae1bee / ratio", "2 s",
                 "python benchmarks/warm.py 9ae1bee", row("run, added:", "{0} s / {3} s / {7}"))  # fmt: skip
    yield Figure("Speed", "page of a long run, of three logs of the plane and KITTI's 3,217 landmarks in space: largest / slowest to open",
                 "10 MB / 2 s", "python benchmarks/pages.py", row("pages:", "{1} MB / {4} s"))  # fmt: skip


def speed() -> Iterator[Figure]:
    """Yield the ratios of times within one run, and microseconds for orientation."""
    section, command = "Speed", "python benchmarks/step.py"
    for name, start, wanted in (
        ("`Slam.process`", "Slam.process", "60 us / 2"), ("its compiled kernels", "compiled kernels", ""),
        ("textbook filter, NumPy", "textbook NumPy", ""), ("iSAM2, update and pose marginal", "GTSAM iSAM2", ""),
    ):  # fmt: skip
        yield Figure(section, f"a step with 50 landmarks, 6 observed, {name}: median / times kernels", wanted, command,
                     row(start, "{0} us / {3}"))  # fmt: skip
    yield Figure(section, "1,024 landmarks, 10 observed: control / scan / both over their compiled kernels", "60 us together / 2", command,
                 row("the map that Slam chooses, 10 seen a step:", "{1} us / {4} us / {6}"))  # fmt: skip
    yield Figure(section, "dense step, 1,024 landmarks, 6 observed, over the update of its covariance", "1.6", command,
                 row("1,024 landmarks, dense, 6 seen a step:", "{6}"))  # fmt: skip
    peers = "python benchmarks/peers.py"
    yield Figure(section, "a step at 50 / 100 / 200 / 1,000 / 10,000 landmarks, 10 observed: `Slam.process`", "", peers,
                 row("kalmark, Slam.process", "{0} / {2} / {4} / {6} / {8} us"))  # fmt: skip
    yield Figure(section, "iSAM2 with joint marginals over `Slam.process`, same maps", "- / 10 / - / 20 / 3", peers,
                 row("GTSAM iSAM2, update and marginals", "{0} / {1} / {2} / {3} / {4}"))  # fmt: skip
    yield Figure(section, "iSAM2 with joint marginals over `Slam.process`, 100 / 1,000 landmarks, median of five runs", "10 / 20",
                 f"{peers} --landmarks 100 1000 --ways iSAM2 --runs 5", row("GTSAM iSAM2, update and marginals", "{0} / {1}"))  # fmt: skip
    for name in ("textbook as printed, NumPy", "MRPT kf-slam, number by number"):
        yield Figure(
            section,
            f"{name} over `Slam.process`, 50 / 100 / 200 / 1,000",
            "",
            peers,
            row(name, "{0} / {1} / {2} / {3}"),
        )
    for kind, wanted in (("homogeneous", "1.0"), ("anchored_homogeneous", "2.2"), ("inverse_depth", "2.2")):
        yield Figure(section, f"one camera, 40 points, `{kind}`: a step / times faster than the toolbox", f"{wanted} ms / 20",
                     "python benchmarks/camera.py", row(kind, "{0} ms / {1}"))  # fmt: skip
    for world in ("plane", "space, one camera"):
        yield Figure(section, f"first step of a new process, {world}, `Invariant`, processor time: cold / warm", "- / 1 s",
                     "python benchmarks/start.py", row(f"{world}, `Invariant`", "{2} s / {5} s"))  # fmt: skip
    for world, wanted in (("plane", "20 s"), ("space, one camera", "30 s")):
        yield Figure(section, f"first step with an empty cache, {world}: here / be0e13e / ratio", wanted,
                     "python benchmarks/start.py be0e13e", row(f"{world}, cold:", "{0} s / {3} s / {7}"))  # fmt: skip
    for name in ("invariant", "invariant:iterations=1", "ekf"):
        yield Figure(section, f"campaign, 50 landmarks, 6 observed, `{name}`, steps a core-second: ordinary path / batched engine / ratio / largest difference",
                     "- / 50,000 / - / 1e-9", "python benchmarks/campaign.py", row(name, "{0} / {1} / {2} / {3}"))  # fmt: skip
    for name in ("Trunks", "Walls", "Corners"):
        yield Figure(
            section,
            f"detector `{name}`, a scan of 361 beams",
            "",
            "python benchmarks/detectors.py",
            row(name, "{1} us"),
        )
    section, command = "Large maps", "python benchmarks/map_growth.py"
    for count in ("49", "1,024", "10,000"):
        yield Figure(section, f"mission with {count} landmarks: total / a step / ordinary step, after a full update / worst steps", "15 ms worst" if count == "10,000" else "",
                     command, row(f"{count} ", "{1} s / {3} ms / {5} us, {7} us / {9}, {11}, {13} ms"))  # fmt: skip
    for pace, wanted in (("slow", "45 s / 1.3 ms a step"), ("quick", "45 s, 20 ms worst")):
        yield Figure(section, f"{pace} mission with 10,000 landmarks: total / a step, median, mean, worst", wanted,
                     f"{command} --pace {pace}", row(f"{pace}, 10,000 ", "{1} s / {9} / {12} / {15} ms"))  # fmt: skip
    yield Figure(
        section,
        "mission with 10,000 landmarks: dense filter over compressed map",
        "60",
        command,
        row("10,000 ", "{20}"),
    )
    yield Figure(
        section,
        "ordinary step after a full update, 10,000 over 49 landmarks",
        "1.5",
        command,
        row("ordinary, largest over smallest map:", "{5}"),
    )
    for numbers, wanted in (("float64", "38,000 in 24 GiB"), ("float32", "50,000 in 24 GiB")):
        yield Figure(
            section,
            f"memory of a covariance in `{numbers}`",
            wanted,
            command,
            row(f"{numbers}:", "{9} landmarks in {12} GiB"),
        )
    nearby = "python benchmarks/nearby.py --sides"
    for count, side in (("1,024", 32), ("10,000", 100)):
        yield Figure(section, f"nearest neighbour over known association, {count} landmarks: mission / known place",
                     "2 / 2.5" if count == "10,000" else "- / 2.5", f"{nearby} {side}", row(f"{count} ", "{2} / {5}"))  # fmt: skip


def structure() -> Iterator[Figure]:
    """Yield the counts of the sources."""
    for name, wanted in (
        ("syntax nodes", "440,000"),
        ("branch points", "8,000"),
        ("functions over 15 branch points", "20"),
        ("named numbers and texts", "350"),
        ("protocols", "30"),
        ("functions of 7 arguments or more", "30"),
        ("calls of isinstance, hasattr, getattr", "350"),
        ("functions that take the slam or its state whole", "40"),
        ("docstrings that begin with a question word", "0"),
        ("file names used more than once", "20"),
        ("imports hidden from the contract", "0"),
        ("modules in the largest import cycle", "0"),
        ("public functions of arrays without shapes", "0"),
        ("files that a control and a scan of known ids enter", "18"),
        ("files that a control and a scan of unknown ids enter", "28"),
    ):
        yield Figure("Structure", name, wanted, "python benchmarks/structure.py", row(f"{name}:", "{0}"))
    yield Figure("Structure", "the check of a change from nothing, with the site, 2 cores", "30 min; without the site 20",
                 "bash .ci/run", row("all of it:", "{0} s"))  # fmt: skip
    yield Figure("Structure", "items of the four documents: work / partly / missing", "all but the particle filter",
                 "python docs/site/course_pages.py", row("items:", "{0} / {2} / {4}"))  # fmt: skip
    before = "python benchmarks/{} be0e13e"
    for count in (50, 1000):
        yield Figure("Structure", f"a step with {count} landmarks, as a part of that of be0e13e", ".8",
                     before.format("paired.py"), row(f"{count} landmarks:", "{6}"))  # fmt: skip
    for count, how, wanted in ((50, "", ".4"), (50, " with cov", ".2"), (1000, "", ".5")):
        yield Figure("Structure", f"a step with {count} landmarks{how}, as a part of that of 4ee926b", wanted,
                     "python benchmarks/paired.py 4ee926b", row(f"{count} landmarks{how}:", "{6}"))  # fmt: skip
    yield Figure("Structure", "observations of the shipped real logs with another outcome than at be0e13e", "0",
                 before.format("outcomes.py"), row("all logs:", "{2} of {0}"))  # fmt: skip


def figures() -> list[Figure]:
    """Return all figures, in the order of the page: those of a section together."""
    parts = (
        exactness,
        campaigns,
        motions,
        inertial,
        real_logs,
        unknown_ids,
        gaps,
        storms,
        race_track,
        diagnosis,
        outliers,
        tuning,
        partial_measurements,
        known_maps,
        space,
        commands,
        bags,
        images,
        image_peers,
        speed,
        structure,
    )
    found = [figure for part in parts for figure in part()]
    sections = list(dict.fromkeys(figure.section for figure in found))
    return sorted(found, key=lambda figure: sections.index(figure.section))


HEAD = """# Measured figures

`python benchmarks/figures.py --table` writes this page from [figures.json](figures.json); `--measure WORD ...` runs the
commands of the figures whose names have these words and saves their values. `KALMARK_DATA` and `KALMARK_ORACLE` name the
folders of the real logs and of the recordings. A test has "within" where it asserts the wanted bound. "raw": start pose
given, no alignment. Consistency: pose ANEES (3 in the plane is consistent) / steps inside its 95 % band / joint NEES per
dimension (1) / position RMSE / diverged runs, seed 0. Filter against batch: landmark sigma ratio / worst landmark in
sigmas / map difference, m. Ratios hold between machines; microseconds are for orientation.
"""


def page() -> str:
    """Return docs/figures.md."""
    known, lines, section = json.loads(SAVED.read_text()), [HEAD.rstrip()], ""
    for figure in figures():
        if figure.section != section:
            section = figure.section
            lines += [
                f"\n\n## {section}\n\n| figure | wanted | measured | command | commit | date |",
                "\n|---|---|---|---|---|---|",
            ]
        one = known.get(f"{section}: {figure.name}", {"measured": "", "commit": "", "date": ""})
        lines.append(
            f"\n| {figure.name} | {figure.wanted} | {one['measured']} | `{figure.command}` | {one['commit']} | {one['date']} |"
        )
    return "".join(lines) + "\n"


def measure(words: list[str]) -> None:
    """Run the commands of the figures whose names have these words, and save what they measure."""
    commit = subprocess.check_output(["git", "rev-parse", "--short=7", "HEAD"], cwd=ROOT, text=True).strip()
    chosen = [one for one in figures() if all(word in f"{one.section}: {one.name}" for word in words)]
    for command, group in itertools.groupby(sorted(chosen, key=lambda one: one.command), lambda one: one.command):
        print(command, flush=True)
        done = subprocess.run(command, shell=True, cwd=ROOT, stdout=subprocess.PIPE, text=True, check=True)
        known = json.loads(SAVED.read_text())  # anew: a command may take an hour, in which others are entered
        for one in group:
            value = {"measured": one.read(done.stdout), "commit": commit, "date": str(datetime.date.today())}
            known[f"{one.section}: {one.name}"] = value
            print(f"  {one.name}: {value['measured']}")
        SAVED.write_text(json.dumps(known, indent=1, ensure_ascii=False) + "\n")


def main() -> None:
    """Measure, list, or write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("words", nargs="*", metavar="WORD")
    parser.add_argument("--measure", action="store_true")
    parser.add_argument("--list", action="store_true")
    parser.add_argument("--table", action="store_true")
    given = parser.parse_args()
    if given.list:
        for one in figures():
            if all(word in f"{one.section}: {one.name}" for word in given.words):
                print(f"{one.section}: {one.name}\n    {one.command}")
    if given.measure:
        if not given.words:
            sys.exit("--measure: expected words of the figures to measure")
        measure(given.words)
    if given.measure or given.table:
        PAGE.write_text(page())


if __name__ == "__main__":
    main()
