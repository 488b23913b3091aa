"""Fixes that do not fit: left out alone, and believed once several agree that the robot is elsewhere."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import kalmark as km
from kalmark.arrays import Array
from kalmark.geometry.angles import rotation
from kalmark.geometry.frames import compose
from kalmark.geometry.spaces import POINT2, POINT3, SE2, SE3, Rn, Space
from kalmark.models.landmarks import AnchoredHomogeneous, Wall2D
from kalmark.slam.relocation_by_fixes import Shift, shift_block

R = 0.25 * np.eye(2)


ARM = np.array([2.0, 0.7, 0.0])


def rover() -> km.Robot:
    sensors = {"lidar": km.Mount(km.sensors.RangeBearing(0.1, 0.02)), "gps": km.Mount(km.sensors.Gps2D(0.5), at=ARM)}
    return km.Robot("r", motion=km.motion.Odometry2D(), sensors=sensors, cov=np.diag([0.01, 0.01, 0.001]))


def driven(steps: int, moved: Any, seed: int = 0, sensor: bool = False) -> tuple[km.Slam, Array, list[Any]]:
    """Drive a circle with fixes; after half of the steps the robot is carried to another place, `moved`.

    With `sensor` the fixes are readings of an antenna.
    """
    rng, slam, x, reports = np.random.default_rng(seed), km.Slam(rover()), np.zeros(3), []
    for k in range(1, steps + 1):
        u = np.array([0.5, 0.0, 0.05])
        x = compose(x, u)[0]
        if k == steps // 2:
            x = compose(np.array(moved), x)[0]
        slam.process(km.Control(0.5 * k, "r", u + rng.normal(0, [0.01, 0.0, 0.01])))
        y = compose(x, ARM if sensor else np.zeros(3))[0][:2] + rng.normal(0, 0.5, 2)
        fix = km.Scan(0.5 * k, "r", "gps", [y]) if sensor else km.Fix(0.5 * k, "r", y, R)
        reports.append(slam.process(fix))
    return slam, x, reports


def test_one_wild_fix_moves_nothing() -> None:
    slam, _, _ = driven(20, (0.0, 0.0, 0.0))
    before, P = slam.mean("r"), slam.covariance("r")
    report = slam.process(km.Fix(11.0, "r", slam.mean("r")[:2] + np.array([59.0, 0.0]), R))
    assert [o.outcome for o in report.observations] == ["rejected"]
    assert report.replaced == 0.0
    np.testing.assert_array_equal(slam.mean("r"), before)
    np.testing.assert_array_equal(slam.covariance("r"), P)


@pytest.mark.parametrize("sensor", [False, True], ids=["fixes", "antenna"])
@pytest.mark.parametrize("seed", range(5))
def test_a_robot_that_was_carried_away_is_placed_by_the_fixes_that_agree(seed: int, sensor: bool) -> None:
    slam, truth, reports = driven(180, (40.0, -25.0, 1.2), seed, sensor)
    moved = [report.replaced for report in reports if report.replaced]
    assert len(moved) == 1
    assert moved[0] > 10
    error = slam.robots["r"].motion.space.minus(slam.mean("r"), truth)
    assert error @ np.linalg.solve(slam.covariance("r"), error) < 21.1  # .9999 of chi-square of 3
    assert np.sqrt(slam.covariance("r")[2, 2]) < 0.2


PILLARS = {k: np.array([6.0 * np.cos(k), 10.0 + 14.0 * np.sin(k)]) for k in range(12)}


@pytest.mark.parametrize("map_", ["dense", "postponed"])
@pytest.mark.parametrize("start", [(8.0, 0.0, 0.0), (-300.0, 250.0, 1.5), (0.0, 0.0, 2.8)])
def test_a_wrong_start_is_mended_with_all_of_the_map_by_the_first_fixes(start: Any, map_: Any) -> None:
    """Landmarks that were mapped from a wrong start would pull the robot back to it."""
    rng, x = np.random.default_rng(2), np.zeros(3)
    laser = km.Mount(km.sensors.RangeBearing(0.1, 0.02))
    slam = km.Slam([km.Robot("r", km.motion.Odometry2D(), sensors={"lidar": laser}, start=start)], map=map_)
    for k in range(1, 81):
        u = np.array([0.5, 0.0, 0.05])
        x = compose(x, u)[0]
        slam.process(km.Control(0.5 * k, "r", u + rng.normal(0, [0.01, 0.0, 0.01])))
        y = km.geometry.observe(x, np.array([*PILLARS.values()]))[0] + rng.normal(size=(12, 2)) * (0.1, 0.02)
        slam.process(km.Scan(0.5 * k, "r", "lidar", y, [*PILLARS]))
        if k % 3 == 0:
            slam.process(km.Fix(0.5 * k, "r", x[:2] + rng.normal(0, 0.5, 2), R))
    off = slam.robots["r"].motion.space.minus(slam.mean("r"), x)
    assert off @ np.linalg.solve(slam.covariance("r"), off) < 21.1
    assert np.linalg.norm(off[:2]) < 0.6
    of_landmarks = [(slam.mean(name) - at, slam.covariance(name)) for name, at in PILLARS.items()]
    assert np.mean([d @ np.linalg.solve(P, d) for d, P in of_landmarks]) < 9.2


@pytest.mark.parametrize("space", [SE2, POINT2, SE3, POINT3, Wall2D().space, AnchoredHomogeneous().space, Rn(2)])
def test_the_motion_of_a_block_by_an_error_of_the_shift_matches_differences(space: Space) -> None:
    rng, h = np.random.default_rng(3), 1e-6
    x = space.plus(np.r_[np.zeros(space.size - 1), 1.0], rng.normal(size=space.dof))
    d = 2 if space.world == "plane" or not space.world else 3
    shift = Shift(0.7, rng.normal(size=d), rng.normal(size=d), np.eye(d + 1))
    new, G = shift_block(space, x, shift)
    for k in range(d):
        other, _ = shift_block(space, x, shift._replace(t=shift.t + h * np.eye(d)[k]))
        np.testing.assert_allclose(space.minus(other, new) / h, G[:, k], atol=1e-5)
    turn = rotation(h)  # about the pivot
    about = shift.pivot[:2] + turn @ (shift.t[:2] - shift.pivot[:2])
    other, _ = shift_block(space, x, shift._replace(yaw=shift.yaw + h, t=np.r_[about, shift.t[2:]]))
    np.testing.assert_allclose(space.minus(other, new) / h, G[:, d], atol=1e-5)


def test_wild_fixes_that_do_not_agree_never_move_it() -> None:
    slam, _, _ = driven(20, (0.0, 0.0, 0.0))
    rng = np.random.default_rng(1)
    for k in range(30):
        slam.process(km.Control(20.0 + k, "r", [0.5, 0.0, 0.05]))
        report = slam.process(km.Fix(20.0 + k, "r", rng.uniform(-200, 200, 2), R))
        assert report.replaced == 0.0


def test_fixes_left_out_are_kept_when_a_map_is_saved(tmp_path: Path) -> None:
    whole, _, _ = driven(80, (40.0, -25.0, 1.2))
    rng, x = np.random.default_rng(0), np.zeros(3)
    slam = km.Slam(rover())
    for k in range(1, 81):
        u = np.array([0.5, 0.0, 0.05])
        x = compose(x, u)[0]
        x = compose(np.array([40.0, -25.0, 1.2]), x)[0] if k == 40 else x
        slam.process(km.Control(0.5 * k, "r", u + rng.normal(0, [0.01, 0.0, 0.01])))
        slam.process(km.Fix(0.5 * k, "r", x[:2] + rng.normal(0, 0.5, 2), R))
        if k == 42:
            slam.save(tmp_path / "map.kmk")
            slam = km.Slam.load(tmp_path / "map.kmk")
    np.testing.assert_array_equal(slam.mean("r"), whole.mean("r"))


def test_a_robot_of_space_is_placed_too() -> None:
    sensors = {"gps": km.Mount(km.sensors.Gps3D(0.5))}
    robot = km.Robot("r", motion=km.motion.Odometry3D(), sensors=sensors, cov=np.diag([0.01] * 3 + [0.001] * 3))
    slam, rng, moved = km.Slam(robot), np.random.default_rng(0), 0.0
    x = np.zeros(3)
    for k in range(1, 121):
        x = compose(x, np.array([0.5, 0.0, 0.05]))[0]
        x = compose(np.array([30.0, 10.0, 2.0]), x)[0] if k == 30 else x
        slam.process(km.Control(float(k), "r", [0.5, 0, 0, 0, 0, 0.05]))
        y = np.array([*x[:2], 0.0 if k < 30 else 8.0]) + rng.normal(0, 0.3, 3)
        moved += slam.process(km.Fix(float(k), "r", y, 0.09 * np.eye(3))).replaced
    assert moved > 8
    np.testing.assert_allclose(slam.mean("r")[:3], [*x[:2], 8.0], atol=0.8)
