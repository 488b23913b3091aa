"""Are the causes named in worlds of several robots, of several sensors and of stereo cameras?"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

import kalmark as km
from kalmark.arrays import Array
from kalmark.config import build_slam, config_dict
from kalmark.diagnosis.verdict import Verdict
from kalmark.events import Control, Event, Scan, sort_key
from kalmark.logs.log import Log
from kalmark.simulate import load_world, simulate

Plant = Callable[[Log], Log]


def scans(change: Callable[[Array], Array], robot: str = "", late_s: float = 0.0) -> Plant:
    def of(e: Event) -> Event:
        if not isinstance(e, Scan) or (robot and e.robot != robot):
            return e
        t_ns = e.t_ns + round(late_s * 1e9)
        return Scan(t_ns=t_ns, robot=e.robot, sensor=e.sensor, y=change(e.y.copy()), ids=e.ids)

    return lambda log: replace(log, events=sorted(map(of, log.events), key=sort_key))


def carried(log: Log) -> Log:
    """Leave out a fifth of the log: the robot is elsewhere when it comes again."""
    begin, end = (log.events[k * len(log.events) // 5].t_ns for k in (2, 3))
    rest = [replace(e, t_ns=e.t_ns - end + begin) for e in log.events if e.t_ns >= end]
    return replace(log, events=[*(e for e in log.events if e.t_ns < begin), *rest])


def verdict_on(world: str, plant: Plant, *settings: str) -> Verdict:
    made = load_world(world, settings)
    log = plant(simulate(made, 0))
    kept = plant is carried  # the maps before a jump
    return km.diagnose(km.record(build_slam(made.config(), log), log, progress=False, pictures=kept))


def disparity(y: Array) -> Array:
    return np.column_stack([y[:, :2], y[:, 0] - 1.05 * (y[:, 0] - y[:, 2]), y[:, 3]])


CASES: dict[str, tuple[str, Plant, tuple[str, ...], str, str, str]] = {
    # one robot's ranges are long: not the other's short, and the ways of both
    "ranges of one": (
        "two_robots", scans(lambda y: y * [1.05, 1.0], "alpha"), ("steps=250",),
        "doubtful", "ranges of alpha.lidar are 4", "alpha.sensors.lidar.scale=1.0",
    ),
    # the robots that it sees are where they were, too
    "times of one": (
        "two_robots", scans(lambda y: y, "beta", 0.3), ("steps=300",),
        "ok", "scans of beta.camera were made 0.2", "log.shift_s.beta.camera=-0.2",
    ),
    # poses have other innovations than columns
    "poses of tags that are late": (
        "tags_room", scans(lambda y: y, late_s=0.15), (
            "steps=100", "robots.rig.sensors={camera: {type: tag_pose}}",
            "robots.rig.route={type: waypoints, points_m: [[6, 1.5, 1.2], [6, 4.5, 1.5], [2, 4.5, 1.2], [2, 1.5, 1]],"
            " speed_mps: 0.5, turn_radius_m: 0.4}",
        ),
        "ok", "scans of rig.camera were made 0.[01]", "log.shift_s.rig.camera=-0.[01]",
    ),
    # on a circle a mount does the same, and always the ways
    "ranges of one of two that are far apart": (
        "two_robots", scans(lambda y: y * [1.05, 1.0], "alpha"), (
            "steps=300", "world.size_m=40", "world.count=100", "sight_robots=false",
            "robots.alpha.start={x_m: 10, y_m: 6, theta_rad: 0}", "robots.beta.start={x_m: 25, y_m: 25, theta_rad: 0}",
            "robots.beta.route={type: waypoints, points_m: [[35, 25], [35, 35], [25, 35], [25, 25]], speed_mps: 0.8,"
            " turn_radius_m: 1}",
        ),
        "doubtful", "ranges of alpha.lidar .*distinguish this from mount_position .*odometry_scale",
        "alpha.sensors.lidar.scale=1.0",
    ),
    "a laser that looks aside": (
        "hall_of_walls", scans(lambda y: np.add(y, [0.0, math.pi / 2])), ("steps=150",),
        "wrong", "walls and corners of robot look -90 deg away", "corners.mount.theta_rad=-1.5708",
    ),
    "a laser with a scale": (
        "hall_of_walls", scans(lambda y: y * [1.05, 1.0]), ("steps=600",),
        "doubtful", "ranges of all sensors of robot are [56][.].* too long", "log.factors.robot.range_m=0.9",
    ),
    # without ids, the scans of fast turns are of no landmark: that they are late shows in the others hardly
    "a laser that is late": (
        "hall_of_walls", scans(lambda y: y, late_s=0.1), ("steps=240",),
        "doubtful", "scans of all sensors of robot were made 0.1 s earlier", "log.shift_s.robot=-0.1",
    ),
    "a laser that is carried away": (
        "hall_of_walls", carried, ("steps=400",),
        "wrong", "robot was elsewhere from t=16", "^$",
    ),
    "a baseline": (
        "thick_cloister_stereo", scans(disparity), (),
        "doubtful", "distances of robot.stereo are 5[.].* too short", "sensors.stereo.baseline_m=0.31",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_the_cause_is_named_first(case: str) -> None:
    world, plant, settings, status, evidence, cure = CASES[case]
    verdict = verdict_on(world, plant, *settings)
    assert verdict.map == status, verdict.causes
    assert re.search(evidence, verdict.causes[0].evidence), verdict.causes
    assert re.search(cure, verdict.causes[0].cure), verdict.causes[0].cure


def test_a_camera_that_is_turned_against_its_mount_is_named_with_its_angles() -> None:
    world = load_world("thick_cloister_stereo")
    log = simulate(load_world("thick_cloister_stereo", ("robots.robot.sensors.stereo.mount.yaw_deg=-86",)), 0)
    run = km.record(
        build_slam(world.config(), log), log, config=config_dict(world.config()), progress=False, pictures=False
    )
    cause, *_ = km.diagnose(run).causes
    assert cause.name == "mount" and cause.evidence.startswith("the sensor robot.stereo is turned by 4")
    cure = re.search("robots.robot.sensors.stereo.mount.yaw_deg=(-[0-9.]*)", cause.cure)
    assert cure is not None and float(cure[1]) == pytest.approx(-86.0, abs=0.5)


def test_what_a_turn_that_is_too_large_makes_vanish_is_explained_by_it() -> None:
    def turned(log: Log) -> Log:
        return replace(
            log, events=[replace(e, u=e.u * [1, 1, 1.08]) if isinstance(e, Control) else e for e in log.events]
        )

    verdict = verdict_on("hall_of_walls", turned, "steps=600")
    assert verdict.causes[0].name == "odometry_turn"
    assert "kidnapped" not in [cause.name for cause in verdict.causes]  # with its cure nothing vanishes
