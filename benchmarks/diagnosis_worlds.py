"""Faults planted in further worlds: two robots, fixes, a robot that stands, many landmarks, stereo, space, walls.

    python benchmarks/diagnosis_worlds.py                    # 2 logs a fault, 5 clean ones a world
    python benchmarks/diagnosis_worlds.py --runs 1 --clean 1 --only walls

A line a log: what was planted, the verdict on the map beside what the truth says of it, and what is named, best first.
By the truth a map is doubtful that is off by more than three of its own sigmas and 1 % of its extent, and wrong if that
is more than 20 %.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from diagnosis import kidnapped, none, seen
from kalmark.config import build_slam
from kalmark.diagnosis.effect import LEAST, MOST_OFF, SIGMAS
from kalmark.diagnosis.verdict import diagnose
from kalmark.events import Control, Fix, Scan, sort_key
from kalmark.logs.log import Log
from kalmark.results.measures import rigid, rmse
from kalmark.results.record import record
from kalmark.results.run import Run
from kalmark.simulate import load_world, simulate

Plant = Callable[[Log, np.random.Generator], Log]
Change = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Place:
    """A world with what is changed of it, what its logs have besides, and its faults: right names and what is done."""

    world: str
    settings: Sequence[str] = ()
    with_it: Plant = none
    faults: dict[str, tuple[tuple[str, ...], Plant]] = field(default_factory=dict)


def scans(change: Change, robot: str = "", sensor: str = "") -> Plant:
    """Return what changes the measurements y (K, m) of all scans, or of a robot, or of a sensor."""

    def plant(log: Log, rng: np.random.Generator) -> Log:
        def of(e: Any) -> Any:
            mine = isinstance(e, Scan) and robot in (e.robot, "") and sensor in (e.sensor, "")
            return seen(e, y=change(e.y.copy())) if mine else e

        return replace(log, events=[*map(of, log.events)])

    return plant


def controls(change: Change, robot: str = "") -> Plant:
    """Return what changes the controls u (m,) of all robots, or of one."""

    def plant(log: Log, rng: np.random.Generator) -> Log:
        def of(e: Any) -> Any:
            mine = isinstance(e, Control) and robot in (e.robot, "")
            return Control(t_ns=e.t_ns, robot=e.robot, u=change(e.u.copy())) if mine else e

        return replace(log, events=[*map(of, log.events)])

    return plant


def late(by_s: float, robot: str = "", sensor: str = "") -> Plant:
    """Return what stamps scans late."""

    def plant(log: Log, rng: np.random.Generator) -> Log:
        def of(e: Any) -> Any:
            mine = isinstance(e, Scan) and robot in (e.robot, "") and sensor in (e.sensor, "")
            return seen(e, t_ns=e.t_ns + round(by_s * 1e9)) if mine else e

        return replace(log, events=sorted(map(of, log.events), key=sort_key))

    return plant


def carried(robot: str) -> Plant:
    """Return what carries a robot away in the middle fifth of the log: it says that it stands, and sees nothing."""

    def plant(log: Log, rng: np.random.Generator) -> Log:
        begin, end = (log.events[k * len(log.events) // 5].t_ns for k in (2, 3))
        events = []
        for e in log.events:
            if not begin <= e.t_ns < end:
                events.append(e)
            elif isinstance(e, Control):
                events.append(Control(t_ns=e.t_ns, robot=robot, u=0 * e.u) if e.robot == robot else e)
            elif e.robot != robot:
                kept = [k for k, name in enumerate(e.ids) if name != robot]
                events += [seen(e, y=e.y[kept], ids=[e.ids[k] for k in kept])] if kept else []
        return replace(log, events=events)

    return plant


def fixed(log: Log, rng: np.random.Generator) -> Log:
    """Add a fix of .3 m every two seconds."""
    fixes = [
        Fix(t_ns=int(t), robot=name, y=pose[:2] + rng.normal(size=2) * 0.3, cov=0.09 * np.eye(2))
        for name, truth in log.truth.items()
        for t, pose in [*zip(truth.t_ns, truth.poses, strict=True)][10::10]
    ]
    return replace(log, events=sorted([*log.events, *fixes], key=sort_key))


def times(*by: float) -> Change:
    return lambda values: values * by


def plus(*by: float) -> Change:
    return lambda values: values + by


def wrapped(angle: float) -> Change:
    """Return what turns the bearings, the last column."""
    return lambda y: np.column_stack([y[:, :-1], (y[:, -1] + angle + np.pi) % (2 * np.pi) - np.pi])


def normals(angle: float) -> Change:
    """Return what turns the normals of walls, the second column."""

    def turned(y: np.ndarray) -> np.ndarray:
        return np.column_stack([y[:, :1], wrapped(angle)(y[:, :2])[:, 1:], y[:, 2:]])

    return turned


def disparity(by: float) -> Change:
    """Return what a pair of cameras measures that are farther apart."""
    return lambda y: np.column_stack([y[:, :2], y[:, 0] - by * (y[:, 0] - y[:, 2]), y[:, 3]])


TURN = (("odometry_turn",), controls(times(1.0, 1.05)))
# a constant control shows no time offset: it moves the sensor on its robot
WAVES = (
    "robots.robot.route={type: waypoints, points_m: [[4, 0, 1], [0, 4, 0], [-4, 0, 1], [0, -4, 0]], speed_mps: 0.8}",
)
IN_SPACE = {
    "turn 5 %": (("odometry_turn",), controls(times(1, 1, 1, 1, 1, 1.05))),
    "time offset .1 s": (("time_offset",), late(0.1)),
    "kidnapped": (("kidnapped",), kidnapped),
}
FIELD = {
    "range scale 5 %": (("range_scale",), scans(times(1.05, 1.0))),
    "turn 5 %": TURN,
    "time offset .1 s": (("time_offset",), late(0.1)),
    "kidnapped": (("kidnapped",), kidnapped),
    "mount 90 deg": (("mount",), scans(wrapped(np.pi / 2))),
}
SMALL = ("world.count=40", "world.size_m=24", "steps=700", "robots.rover.start={x_m: 12, y_m: 12, theta_rad: 0}")
STOPS = "robots.rover.route={type: constant, u: [0.8, 0.2], drive_s: 20, stop_s: 20}"
STANDS = (*SMALL[:2], "steps=900", SMALL[3], STOPS)
LARGE = ("world.count=300", "world.size_m=70", "steps=1500", "robots.rover.start={x_m: 35, y_m: 35, theta_rad: 0}")
HALL = (
    "steps=500",
    "robots.robot.sensors={walls: {type: wall, range_max_m: 20.0, mount: {x_m: 0.2}, sigma_distance_m: 0.02}}",
    "robots.robot.sensing={walls: {every: 2}}",
)
WALLS = {
    "distance 5 cm": (("range_offset",), scans(plus(0.05, 0.0, 0.0, 0.0))),
    "turn 8 %": (("odometry_turn",), controls(times(1, 1, 1.08))),
    "time offset .1 s": (("time_offset",), late(0.1)),
    "kidnapped": (("kidnapped",), kidnapped),
    "mount 90 deg": (("mount",), scans(normals(np.pi / 2))),
}
PLACES = {
    "two robots": Place(
        "two_robots",
        faults={
            "range scale 5 %": (("range_scale",), scans(times(1.05, 1.0), "alpha")),
            "turn 5 %": (("odometry_turn",), controls(times(1, 1, 1.05), "beta")),
            "time offset .1 s": (("time_offset",), late(0.3, "beta")),
            "kidnapped": (("kidnapped",), carried("beta")),
            "mount 90 deg": (("mount",), scans(wrapped(np.pi / 2), "beta")),
        },
    ),
    "fixes": Place("random_field", SMALL, fixed, FIELD | {"kidnapped": (("kidnapped",), carried("rover"))}),
    "stands": Place("random_field", STANDS, none, FIELD),
    "300 landmarks": Place("random_field", LARGE, none, FIELD),
    "stereo": Place(
        "thick_cloister_stereo",
        WAVES,
        faults=IN_SPACE
        | {
            "baseline 5 %": (("range_scale",), scans(disparity(1.05))),
            "steps in mm": (("units",), controls(times(1e3, 1e3, 1e3, 1, 1, 1))),
        },
    ),
    "points of space": Place(
        "thick_cloister", WAVES, faults=IN_SPACE | {"range scale 5 %": (("range_scale",), scans(times(1.05, 1, 1)))}
    ),
    "walls": Place("hall_of_walls", (*HALL, "ids=true"), none, WALLS),
    "walls, no ids": Place("hall_of_walls", ("steps=600",), none, {
        "range scale 5 %": (("range_scale",), scans(times(1.05, 1.0))),
        "turn 8 %": (("odometry_turn",), controls(times(1, 1, 1.08))),
        "time offset .1 s": (("time_offset",), late(0.1)),
        "kidnapped": (("kidnapped",), kidnapped),
        "mount 90 deg": (("mount",), scans(plus(0.0, np.pi / 2))),
    }),
}  # fmt: skip


def planted(place: Place, plant: Plant, seed: int) -> tuple[Log, Run]:
    """Return the run of a log with a fault."""
    world = load_world(place.world, place.settings)
    log = place.with_it(simulate(world, seed), np.random.default_rng(seed))
    log = plant(log, np.random.default_rng(seed))
    seen = log.without_truth()
    return log, record(build_slam(world.config(), seen), seen, progress=False)


def by_truth(log: Log, run: Run) -> str:
    """Return what the truth says of a run's map: its shape, walls by where they lie; "?" without ids."""
    true = {str(name): np.asarray(place) for name, place in log.landmarks.items()}
    marks = run.landmarks
    rows = [k for k, name in enumerate(marks.ids) if str(name) in true]
    if len(rows) < 3:
        return "?"
    there = np.array([true[str(marks.ids[k])] for k in rows])
    places, P = (values[rows] for values in marks.positions())
    if marks.kinds[rows[0]] == "wall":  # from the first pose, which is exact
        ends, along = np.array([marks.means[k] for k in rows]), there[:, 2:] - there[:, :2]
        normal = np.column_stack([along[:, 1], -along[:, 0]]) / np.linalg.norm(along, axis=1)[:, None]
        off = rmse(
            np.concatenate([np.sum((ends[:, k : k + 2] - there[:, :2]) * normal, axis=1) for k in (0, 2)])[:, None]
        )
        there = there[:, :2]
    else:
        off = rmse(rigid(places, there)(places) - there)
    extent, sigma = rmse(there - there.mean(axis=0)), float(np.median(np.sqrt(np.trace(P, axis1=1, axis2=2))))
    state = "ok" if off < max(LEAST * extent, SIGMAS * sigma) else "doubtful" if off < MOST_OFF * extent else "wrong"
    return f"{state} {off:.3f} m of {extent:.1f}"


def main() -> None:
    """Print the lines."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=2)
    parser.add_argument("--clean", type=int, default=5)
    parser.add_argument("--only", default="", help="worlds with this in their names")
    parser.add_argument("--fault", default="", help="faults with this in their names")
    options = parser.parse_args()
    first = third = count = accused = alarmed = clean = off = missed = 0
    for name, place in PLACES.items():
        if options.only not in name:
            continue
        for fault, (names, plant) in {"none": ((), none), **place.faults}.items():
            if options.fault not in fault:
                continue
            for seed in range(options.runs if names else options.clean):
                log, run = planted(place, plant, seed)
                verdict = diagnose(run)
                told = [cause.name for cause in verdict.causes]
                causes = "; ".join(f"{c.name} ({c.score:.0f}{', harmless' * c.harmless})" for c in verdict.causes)
                truth = by_truth(log, run)
                print(f"{name:16s} {fault:18s} {seed:3d}  {verdict.map:9s} {truth:26s} {causes}", flush=True)
                is_off = truth.startswith(("doubtful", "wrong"))
                off, missed = off + is_off, missed + (is_off and verdict.map == "ok")
                if options.fault:
                    print(*[f"      {c.evidence} | {c.cure}" for c in verdict.causes], verdict.checked, sep="\n")
                if names:
                    count, first = count + 1, first + (told[:1] == [names[0]])
                    third += bool({*told[:3]} & {*names})
                else:
                    clean, accused, alarmed = clean + 1, accused + bool(told), alarmed + (verdict.map != "ok")
    print(f"planted: {first} of {count} named first, {third} among the first three")
    print(f"clean: {accused} of {clean} accused, the map of {alarmed}")
    print(f"off: {missed} of {off} maps that are off by the truth are called ok")


if __name__ == "__main__":
    main()
