"""Worlds of space: layouts, routes, noise, faults, and campaigns that are honest in six dimensions."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import kalmark as km
from kalmark.errors import ConfigError
from kalmark.events import Control
from kalmark.geometry import SE3
from kalmark.geometry.rotations import from_euler, matrix
from kalmark.logs import write_native
from kalmark.logs.log import Log
from kalmark.models.observe import expectation
from kalmark.simulate import load_world, simulate
from kalmark.simulate.layouts import RandomBox, TagRoom
from kalmark.simulate.robots import simulation
from kalmark.simulate.routes import control_in_space
from space_worlds import assert_sigma, faulty, scans, world


def residuals(log: Log, sensor: Any, mount: np.ndarray) -> np.ndarray:
    rows = []
    for s in scans(log):
        l = np.array([log.landmarks[i] for i in s.ids])
        e = expectation(log.truth[s.robot].at(s.t_ns), mount, sensor, km.landmarks.Point3D(), l)[0]
        z = s.y - e
        rows.append(np.where(sensor.angular, km.geometry.wrap(z), z))
    return np.concatenate(rows)


MOUNT = np.concatenate([[0.2, 0.0, 0.3], from_euler(np.radians([0.0, 20.0, 0.0]))[0]])


def test_measurements_of_space_have_the_noise_that_was_asked_for() -> None:
    z = residuals(simulate(world(steps=200), 1), km.sensors.RangeBearing3D(), MOUNT)
    for column, sigma in enumerate((0.1, 0.02, 0.02)):
        assert_sigma(z[:, column], sigma)
    position = {"type": "position_3d", "sigma_x_m": 0.05, "sigma_z_m": 0.3}
    z = residuals(
        simulate(world(steps=200, robot={"sensors": {"s": position}}), 1), km.sensors.Position3D(), SE3_ORIGIN
    )
    for column, sigma in enumerate((0.05, 0.1, 0.3)):
        assert_sigma(z[:, column], sigma)


SE3_ORIGIN = np.array([0.0, 0, 0, 0, 0, 0, 1])


def test_the_control_is_disturbed_and_the_robot_of_space_moves_exactly_or_the_other_way_round() -> None:
    log = simulate(world(steps=300), 2)
    u = np.array([e.u for e in log if isinstance(e, Control)])
    assert_sigma(u[:, 1], 0.01)
    assert_sigma(u[:, 5] - 0.05, 0.01)
    exact = SE3_ORIGIN
    for _ in range(300):
        exact = km.geometry.frames3d.move(exact, np.array([0.1, 0.0, 0.01, 0.0, 0.01, 0.05]))[0]
    np.testing.assert_allclose(SE3.minus(log.truth["r"].poses[-1], exact), 0, atol=1e-9)
    u = np.array([e.u for e in simulate(world(steps=30, noise_on="robot"), 2) if isinstance(e, Control)])
    assert (u == [0.1, 0.0, 0.01, 0.0, 0.01, 0.05]).all()


def test_a_start_with_sigmas_is_drawn_around_its_position_and_its_angles() -> None:
    start = {
        "x_m": 1.0,
        "z_m": 2.0,
        "roll_deg": 30.0,
        "yaw_deg": 60.0,
        "sigma_position_m": 0.5,
        "sigma_rotation_deg": 4.0,
    }
    at = np.concatenate([[1.0, 0.0, 2.0], from_euler(np.radians([30.0, 0.0, 60.0]))[0]])
    starts = [simulate(world(steps=1, robot={"start": start}), k).truth["r"].poses[0] for k in range(300)]
    d = np.array([SE3.minus(pose, at) for pose in starts])
    for axis in range(6):
        assert_sigma(d[:, axis], 0.5 if axis < 3 else math.radians(4.0))


def test_a_mount_with_sigmas_truly_sits_elsewhere_and_the_log_does_not_tell(monkeypatch: pytest.MonkeyPatch) -> None:
    from kalmark.simulate import robots

    build = robots.build_robot

    def uncertain(*arguments: Any) -> Any:
        robot = build(*arguments)
        for mount in robot.sensors.values():
            object.__setattr__(mount, "cov", np.diag([0.05**2] * 3 + [0.03**2] * 3))
        return robot

    monkeypatch.setattr(robots, "build_robot", uncertain)
    d = np.array([SE3.minus(simulation(world(steps=1), k).mounts["r", "lidar"], MOUNT) for k in range(300)])
    for axis in range(6):
        assert_sigma(d[:, axis], 0.05 if axis < 3 else 0.03)
    one = simulation(world(steps=100), 3)
    z = residuals(one.log, km.sensors.RangeBearing3D(), one.mounts["r", "lidar"])
    assert_sigma(z[:, 0], 0.1)


def test_a_sensor_of_a_slower_rate_scans_at_its_own_steps() -> None:
    two = {
        "fast": {"type": "range_bearing_3d"},
        "slow": {"type": "position_3d", "mount": {"yaw_deg": 90.0}},
    }
    log = simulate(world(robot={"sensors": two, "sensing": {"slow": {"every": 5}}}), 1)
    times = {name: [s.t_ns for s in scans(log) if s.sensor == name] for name in two}
    assert len(times["fast"]) == 60
    assert times["slow"] == [k * 500_000_000 for k in range(1, 13)]


def test_false_measurements_are_as_many_as_asked_for_and_leave_the_others_as_they_were() -> None:
    clean, dirty = (simulation(world(steps=200, robot=faults), 4) for faults in ({}, faulty(outliers=0.1)))
    same, wrong = [], []
    for a, b in zip(scans(clean.log), scans(dirty.log), strict=True):
        real = dirty.origins[b.t_ns, "r", "lidar"]
        keep = np.array([name is not None for name in real])
        same.append(np.abs(a.y - b.y)[keep].max())
        wrong.append(~keep)
    assert max(same) == 0
    assert np.concatenate(wrong).mean() == pytest.approx(0.1, abs=0.025)


def test_false_measurements_lie_all_over_the_field_of_view() -> None:
    ahead = {"lidar": {"type": "range_bearing_3d", "range_max_m": 8.0, "fov_rad": 2.0}}
    sim = simulation(world(steps=300, robot={"sensors": ahead} | faulty(outliers=1.0)), 4)
    y = np.concatenate([s.y for s in scans(sim.log)])
    assert all(name is None for real in sim.origins.values() for name in real)
    assert (y[:, 0] < 8.5).all() and np.abs(y[:, 1]).max() < 1.2
    assert np.median(y[:, 0]) == pytest.approx(8.0 * 0.5 ** (1 / 3), abs=0.3)  # uniform in the volume


def test_dropouts_hidden_and_swapped_ids_begin_when_they_are_told_to() -> None:
    keys = {"dropouts": 0.2, "swapped": ((1, 2),), "hidden": (5,), "faults_from_step": 11}
    clean, dirty = (simulation(world(steps=150, robot=faults), 4) for faults in ({}, faulty(**keys)))
    early, late = [(a, b) for a, b in zip(scans(clean.log), scans(dirty.log), strict=True)][:10], scans(dirty.log)[10:]
    assert all((a.y == b.y).all() and a.ids == b.ids for a, b in early)
    assert all(5 not in s.ids for s in late)
    assert np.mean([len(s.ids) for s in late]) == pytest.approx(0.8 * 11, abs=0.5)
    s = next(s for s in late if 1 in s.ids)
    assert dirty.origins[s.t_ns, "r", "lidar"][s.ids.index(1)] == 2


def test_a_robot_of_space_passes_its_waypoints_and_levels_itself() -> None:
    points = ((5.0, 0.0, 0.0), (5.0, 5.0, 3.0), (0.0, 5.0, 1.0))
    route = {"type": "waypoints", "points_m": points, "speed_mps": 1.0, "turn_radius_m": 0.4}
    log = simulate(world(steps=300, robot={"route": route, "start": {"roll_deg": 40.0}}), 1)
    path = log.truth["r"].poses
    for point in points:
        assert np.linalg.norm(path[:, :3] - point, axis=1).min() < 0.85
    assert np.linalg.norm(np.diff(path[:, :3], axis=0), axis=1).max() < 0.1 + 1e-9
    wings = np.array([matrix(q)[2, 1] for q in path[:, 3:]])
    assert wings[0] > 0.6 and np.abs(wings[10:]).max() < 0.4 and np.median(np.abs(wings)) < 0.01


def test_a_wandering_robot_of_space_stays_in_the_box() -> None:
    route = {"type": "wander", "speed_mps": 2.0, "turn_radius_m": 0.8}
    path = simulate(world(steps=600, robot={"route": route}), 1).truth["r"].poses[:, :3]
    assert (path.min(axis=0) > [-8, -8, -4]).all() and (path.max(axis=0) < [8, 8, 6]).all()
    assert np.ptp(path, axis=0).min() > 2.5


def test_a_screw_of_the_odometry_is_what_its_velocities_add_up_to() -> None:
    v, w = np.array([1.0, 0.2, -0.1]), np.array([0.3, -0.2, 0.9])
    u = control_in_space(km.motion.Odometry3D(), SE3_ORIGIN, v, w, 0.5)
    whole, *_ = km.motion.Odometry3D().move(SE3_ORIGIN, u, 0.0)
    small = SE3_ORIGIN
    for _ in range(5000):
        small = km.geometry.frames3d.move(small, np.concatenate([v, w]) * 1e-4)[0]
    np.testing.assert_allclose(SE3.minus(whole, small), 0, atol=1e-4)


def test_layouts_of_space_fill_what_they_are_told_to() -> None:
    box = RandomBox(count=3000, min_m=(0.0, -2.0, 1.0), max_m=(4.0, 2.0, 1.5)).place(np.random.default_rng(0))
    np.testing.assert_allclose(box.mean(axis=0), [2, 0, 1.25], atol=0.1)
    assert (box >= [0, -2, 1]).all() and (box <= [4, 2, 1.5]).all()
    room = TagRoom(length_m=8.0, width_m=6.0).scenery(np.random.default_rng(0))
    inwards = np.array([-matrix(tag[3:].copy())[:, 2] for tag in room.tags])  # they look against their z axis
    to_middle = np.array([4.0, 3.0, 1.3]) - room.tags[:, :3]
    assert len(room.tags) == 32 and (np.einsum("ki,ki->k", inwards, to_middle) > 2.9).all()
    assert all(matrix(tag[3:].copy())[2, 1] == pytest.approx(-1) for tag in room.tags)  # y is down


def test_landmarks_of_a_plane_are_on_the_ground_of_space_and_ids_go_over_all_sorts() -> None:
    log = simulate(world(steps=1, world={"type": "cloister"}), 0)
    assert all(len(l) == 3 and l[2] == 0 for l in log.landmarks.values())
    listed = {
        "type": "list",
        "points_m": ((1, 0, 0), (0, 1, 2)),
        "segments_m": ((0, 0, 0, 1, 1, 1),),
        "tags": ({"x_m": 3.0},),
    }
    log = simulate(world(steps=1, world=listed), 0)
    assert [len(l) for l in log.landmarks.values()] == [3, 3, 6, 7]
    assert [*log.landmarks] == [1, 2, 3, 4]


def test_the_same_seed_gives_the_same_log_of_space() -> None:
    one, same, other = (simulate(world(), seed) for seed in (1, 1, 2))
    assert all((a.y == b.y).all() and a.ids == b.ids for a, b in zip(scans(one), scans(same), strict=True))
    assert (one.landmarks[1] != other.landmarks[1]).all()


def test_the_thick_cloister_goes_round_twice_and_comes_back() -> None:
    w = load_world("thick_cloister")
    path = simulate(w, 0).truth["robot"].poses
    np.testing.assert_allclose(path[400, :3], [0, -5, 0], atol=1e-9)
    np.testing.assert_allclose(path[-1, :3], [0, -5, 0], atol=1e-9)
    assert path[:, 0].max() == pytest.approx(0.08 / math.radians(0.9), rel=0.01)


def test_a_log_of_space_is_written_and_read_back(tmp_path: Path) -> None:
    log = simulate(world(), 2)
    write_native(log, tmp_path / "log")
    back = km.open_log(tmp_path / "log")
    assert all((a.y == b.y).all() and a.ids == b.ids for a, b in zip(scans(log), scans(back), strict=True))
    assert (back.truth["r"].poses == log.truth["r"].poses).all()
    assert all((back.landmarks[i] == l).all() for i, l in log.landmarks.items())


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("robots.robot.route.u=[0.1, 0]", "u has the 6 numbers of odometry_3d, not 2"),
        ("robots.robot.sensing={laser: {every: 2}}", "expected sensing of lidar, not of 'laser'"),
        (
            "robots.robot.sensing={lidar: {outliers: 2}}",
            "robots.robot.sensing.lidar.outliers: got 2, expected a number of at least 0 up to 1",
        ),
        ("robots.rover={motion: {type: unicycle}, route: {type: wander}}", "all move in the plane, or all in space"),
        ("world={type: random_box, min_m: [1, 0, 0], max_m: [0, 1, 1]}", "expected max_m nowhere below min_m"),
        ("world={type: list}", "expected points_m, segments_m, tags or walls_m"),
        ("world={type: list, points_m: [[1, 2], [1, 2, 3]]}", "expected points .x, y., or all of them .x, y, z."),
        ("robots={r: {motion: {type: unicycle}, route: {type: wander}}}", "its landmarks are in space"),
    ],
)
def test_a_wrong_world_of_space_is_refused_with_value_and_expectation(override: str, said: str) -> None:
    with pytest.raises(ConfigError, match=said) as error:
        load_world("thick_cloister", [override])
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("motion", ["odometry_3d", "velocity_3d", "constant_velocity_3d"])
def test_every_motion_of_space_is_steered_through_the_same_places(motion: str) -> None:
    points = ((5.0, 0.0, 0.0), (5.0, 5.0, 3.0), (0.0, 5.0, 1.0))
    route = {"type": "waypoints", "points_m": points, "speed_mps": 1.0, "turn_radius_m": 0.4}
    path = simulate(world(steps=250, robot={"motion": {"type": motion}, "route": route}), 1).truth["r"].poses
    for point in points:
        assert np.linalg.norm(path[:, :3] - point, axis=1).min() < 1.0
