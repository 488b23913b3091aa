"""Bags with the configuration that `kalmark bag` wrote, and logs as MCAP and back.

    KALMARK_DATA=... python benchmarks/bags.py [nav2] [tags] [wrong] [mcap]

nav2: the bag of a TurtleBot, odometry and the pose of AMCL as fixes, no line edited.  `fixes`: given to the filter and
rejected; `off`: distance of the fixes from where the filter expects them, median and largest.
tags: TagSLAM's bags by topic.  Their cameras, the sizes of the tags, the wrong detections and the mount are in files of
their own: those are the lines edited.  `corners`: RMS of their distances from the filter's, px; in brackets of the
importer of those files.
wrong: tests 13 and 22 with the wrong detections in, as they are, with a gate, with a robust loss: observations that are
left out and the RMSE of the path, m.
mcap: a log written as MCAP and read back: events, and whether log and map are the same to the last bit.
"""

from __future__ import annotations

import json
import re
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from kalmark.bags.first_config import first_config
from kalmark.bags.run_messages import export
from kalmark.bags.survey import survey
from kalmark.bags.tagslam import SIGMA, TagSetup, frame_of, read_cameras, read_scene
from kalmark.config import build_slam, open_run
from kalmark.events import Scan, fixed_seconds
from kalmark.geometry.frames3d import compose, inverse
from kalmark.geometry.named_poses import describe_pose
from kalmark.logs import Log, find_data, open_log
from kalmark.results.record import record
from kalmark.slam.slam import Slam

TESTS = (1, 13, 22)
NOISE_PX = 0.5  # of a corner, as in the shipped configuration `tagslam`
LOGS = ("victoria_park_known", "mrclam")


def nav2(folder: Path) -> None:
    """Run the bag of the TurtleBot as `kalmark bag` maps it."""
    file = folder / "nav2.yaml"
    file.write_text(first_config(survey(find_data("rosbags/nav2_turtlebot.mcap")), file))
    config, log = open_run(file)
    run = record(build_slam(config, log), log, progress=False)
    fixes = run.history.fixes
    away = [float(np.linalg.norm(fix.z)) for fix in fixes]
    rejected = sum(not fix.used for fix in fixes)
    print(f"nav2: 0 lines edited, {len(log)} events, fixes {len(fixes)}, {rejected} rejected, ", end="")
    print(f"off {np.median(away):.3f} m, largest {max(away):.3f} m")


def tags(test: int, folder: Path) -> None:
    """Run one of TagSLAM's bags by topic, and with the importer of its own files."""
    own_config, own = open_run("tagslam", f"tagslam_test/test_{test}")
    where = find_data(f"tagslam_test/test_{test}")
    before = first_config(survey(where / "tag_detections.bag.bz2")).splitlines()
    lines = edited(before, where, own)
    file = folder / f"test_{test}.yaml"
    file.write_text("\n".join(lines) + "\n")
    changed = sum(a != b for a, b in zip(before, lines, strict=True))
    config, log = open_run(file)
    found, other = (
        record(build_slam(c, each), each, progress=False).evaluate() for c, each in ((config, log), (own_config, own))
    )
    print(f"tags, test {test}: {changed} lines edited, {found['landmarks']} tags ({other['landmarks']}), ", end="")
    print(f"{found['observations']} observations ({other['observations']}), ", end="")
    print(f"corners {found['corner_rms_px']:.2f} px ({other['corner_rms_px']:.2f})")


def wrong(test: int, folder: Path) -> None:
    """Run one of TagSLAM's bags with the detections that its file calls wrong."""
    own = open_run("tagslam", f"tagslam_test/test_{test}")[1]
    where = find_data(f"tagslam_test/test_{test}")
    lines = edited(first_config(survey(where / "tag_detections.bag.bz2")).splitlines(), where, own)
    text, out = re.sub(r", ignore: \{[^}]*\}", "", "\n".join(lines)), []
    truth = replace(own, truth={"robot": own.truth["rig"]})
    for what, changed in (
        ("plain", text),
        ("gate .9999", f"{text}\nassociation: {{type: identity, gate: 0.9999}}"),
        ("huber", text.replace('"sigma_px"', '"robust": "huber", "sigma_px"')),
    ):
        file = folder / f"wrong_{test}.yaml"
        file.write_text(changed + "\n")
        config, log = open_run(file)
        found = record(build_slam(config, log), log, progress=False).with_truth(truth).evaluate()
        seen, lost, off = found["observations"], found["rejected"], found["robots"]["robot"]["ate_m"]
        out.append(f"{what} {lost} of {seen} left out, path {off:.4f}")
    print(f"wrong, test {test}: {'; '.join(out)}")


def edited(lines: list[str], where: Path, own: Log) -> list[str]:
    """Return the lines of a first configuration with what only a user knows: the camera, the sizes, the mount."""
    (camera,) = own.describes["robots"]["rig"]["sensors"].values()
    scene, (cameras, poses) = read_scene(where / "tagslam.yaml"), read_cameras(where)
    mount = poses[next(iter(cameras))]
    for body in scene.odometry.values():  # the robot's frame is that of its odometry
        mount = compose(inverse(frame_of(body["T_body_odom"]))[0], mount)[0]
    section = camera | {"mount": describe_pose(mount), "sigma_px": NOISE_PX}
    scans = [event for event in own.events if isinstance(event, Scan)]
    sizes = {tag: float(y[8]) for scan in scans for tag, y in zip(scan.ids or (), scan.y, strict=True)}
    usual = max(set(sizes.values()), key=list(sizes.values()).count)
    others = {str(tag): size for tag, size in sizes.items() if size != usual}
    size = f"size_m: {usual}" + (f", sizes: {json.dumps(others)}" if others else "")
    ignored: dict[int, list[str]] = {}
    for t_ns, tag in sorted(scene.squashed):
        ignored.setdefault(tag, []).append(fixed_seconds(t_ns))
    size += f", ignore: {json.dumps(ignored)}" if ignored else ""
    noise = odometry_noise(scene, scans)
    out = [re.sub(r"size_m: [0-9.]+", size, line) for line in lines]
    out = [re.sub(r"(\w+_tags\w*): \{type: tag_corners.*", rf"\1: {json.dumps(section)}", line) for line in out]
    moved = "motion: {type: odometry_3d"
    return [line.replace(moved, f"{moved}, {noise}") for line in out]


def odometry_noise(scene: TagSetup, scans: list[Scan]) -> str:
    """Return the noise of the odometry's increments: that of TagSLAM's file over the usual interval of the scans."""
    share = np.sqrt(np.median(np.diff([scan.t_ns for scan in scans])) * 1e-9)
    body: dict[str, Any] = next(iter(scene.odometry.values()), {})
    m, rad = (share * float(body.get(f"odom_{what}_noise", SIGMA)) for what in ("translation", "rotation"))
    return f"sigma_x_m: {m:.4f}, sigma_y_m: {m:.4f}, sigma_z_m: {m:.4f}, sigma_rotation_rad: {rad:.4f}"


def mcap(name: str, folder: Path) -> None:
    """Write the log of a shipped configuration as MCAP and compare what comes back, and its map."""
    config, log = open_run(name)
    counts = export(folder / f"{name}.mcap", log)
    back = open_log(folder / f"{name}.mcap")
    here, there = (bytes_of_map(build_slam(config, each), each) for each in (log, back))
    same = len(log) == len(back) and all(map(same_events, log.events, back.events))
    size = (folder / f"{name}.mcap").stat().st_size / 1e6
    print(f"mcap, {name}: {len(log)} events, {sum(counts.values())} messages, {size:.1f} MB, ", end="")
    print(f"events {'the same' if same else 'DIFFER'}, map {'the same' if here == there else 'DIFFERS'}")


def same_events(a: Any, b: Any) -> bool:
    """Return whether two events have the same time, numbers and ids."""
    numbers = [(each.u if hasattr(each, "u") else each.y).tobytes() for each in (a, b)]
    covs = [None if each.cov is None else each.cov.tobytes() for each in (a, b)]
    return (type(a), a.t_ns, a.robot, numbers[0], covs[0]) == (type(b), b.t_ns, b.robot, numbers[1], covs[1])


def bytes_of_map(slam: Slam, log: Log) -> bytes:
    """Return means and covariance of the map at the end."""
    for event in log:
        slam.process(event)
    names = [*slam.robots, *(landmark.id for landmark in slam.landmarks())]
    return b"".join(slam.mean(name).tobytes() for name in names) + slam.covariance(*names).tobytes()


def main() -> None:
    """Print the figures."""
    wanted = sys.argv[1:] or ["nav2", "tags", "wrong", "mcap"]
    with tempfile.TemporaryDirectory() as aside:
        folder = Path(aside)
        if "nav2" in wanted:
            nav2(folder)
        for test in TESTS if "tags" in wanted else ():
            tags(test, folder)
        for test in TESTS[1:] if "wrong" in wanted else ():
            wrong(test, folder)
        for name in LOGS if "mcap" in wanted else ():
            mcap(name, folder)


if __name__ == "__main__":
    main()
