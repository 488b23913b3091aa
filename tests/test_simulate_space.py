"""Worlds of space: layouts, routes, noise, faults, and campaigns that are honest in six dimensions."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import kalmark as km
from kalmark.campaign import errors, run_campaign
from kalmark.campaign.running import Plan, configs_of
from kalmark.errors import ConfigError
from kalmark.geometry import SE3
from kalmark.geometry.rotations import exp, from_euler, matrix
from kalmark.geometry.spaces import retract
from kalmark.logs import write_native
from kalmark.logs.log import Log
from kalmark.models.observe import expectation
from kalmark.simulate import World, load_world, simulate
from kalmark.simulate.layouts3d import RandomBox, TagRoom
from kalmark.simulate.robots import simulation
from kalmark.simulate.routes import control_in_space
from kalmark.slam.events import Control, Scan


def world(**keys: Any) -> World:
    """Return a small world: a box of points, a robot that climbs a helix and measures ranges and angles."""
    robot = {
        "motion": {"type": "odometry_3d", "sigma_rotation_rad": 0.01},
        "route": {"type": "constant", "u": (0.1, 0.0, 0.01, 0.0, 0.01, 0.05)},
        "sensors": {"lidar": {"type": "range_bearing_3d", "mount": {"x_m": 0.2, "z_m": 0.3, "pitch_deg": 20.0}}},
    } | keys.pop("robot", {})
    box = {"type": "random_box", "count": 12, "min_m": (-6.0, -6.0, -2.0), "max_m": (6.0, 6.0, 4.0)}
    return World(**({"world": box, "robots": {"r": robot}, "steps": 60} | keys))


def scans(log: Log) -> list[Scan]:
    return [e for e in log if isinstance(e, Scan)]


def residuals(log: Log, sensor: Any, mount: np.ndarray) -> np.ndarray:
    rows = []
    for s in scans(log):
        l = np.array([log.landmarks[i] for i in s.ids])
        e = expectation(log.truth[s.robot].at(s.t_ns), mount, sensor, km.landmarks.Point3D(), l)[0]
        z = s.y - e
        rows.append(np.where(sensor.angular, km.geometry.wrap(z), z))
    return np.concatenate(rows)


def assert_sigma(sample: np.ndarray, sigma: float) -> None:
    n = len(sample)
    assert abs(sample.mean()) < 4 * sigma / math.sqrt(n)
    assert abs(sample.std() / sigma - 1) < 4 / math.sqrt(2 * n)


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


def faulty(**keys: Any) -> dict[str, Any]:
    return {"sensing": {"lidar": keys}}


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


@pytest.mark.parametrize("coordinates", ["log", "world"])
def test_an_error_is_what_the_estimator_would_have_to_correct_by(coordinates: str) -> None:
    rng = np.random.default_rng(5)
    for _ in range(50):
        mean, truth = (np.concatenate([rng.normal(size=3), exp(rng.normal(size=3))]) for _ in range(2))
        turn = rng.normal(size=3) * 0.5
        d = errors.state_error(mean, truth, turn, coordinates)
        x = mean.copy()
        retract(SE3.atoms, x, d, turn if coordinates == "log" else np.zeros(0))
        np.testing.assert_allclose(SE3.minus(x, truth), 0, atol=1e-9)


def test_a_point_whose_depth_is_not_known_yet_is_not_judged() -> None:
    class Ray:
        def to_point(self, l: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            P_l = np.zeros((1, 3, 7))
            P_l[0, :, 6] = -l[0, 3:6] / l[0, 6] ** 2
            return l[:, :3] + l[:, 3:6] / l[:, 6:], P_l

    l = np.array([0, 0, 0, 1.0, 0, 0, 0.2])  # five metres ahead
    for sigma, known in ((0.01, True), (0.1, False)):
        P = np.diag([0, 0, 0, 0, 0, 0, sigma**2])
        judged = errors.landmark(Ray(), l, P, np.array([5.5, 0, 0]), np.zeros(3), "world", np.zeros(3))
        assert (judged is not None) == known
        if judged is not None:
            np.testing.assert_allclose(judged.own, [0.5, 0, 0])


def test_a_line_is_judged_across_itself_where_its_ends_are() -> None:
    class Line:
        def endpoints(self, l: np.ndarray, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            a, b = l[:, None, :3], l[:, None, 3:]
            P_l = np.zeros((1, 2, 3, 6))
            for i in range(2):
                P_l[0, i, :, :3], P_l[0, i, :, 3:] = (1 - t[0, i]) * np.eye(3), t[0, i] * np.eye(3)
            return a + t[:, :, None] * (b - a), P_l

    l, P, eye = np.array([1.0, 0, 0, 2, 0, 0]), 1e-4 * np.eye(6), np.array([0.0, 2.0, 0.0])  # along x
    truth = np.array([-3.0, 0.1, 0.2, 4.0, 0.1, -0.2])
    judged = errors.landmark(Line(), l, P, truth, np.zeros(3), "log", eye)
    assert judged is not None and judged.own.shape == (4,) and judged.F.shape == (4, 6)
    np.testing.assert_allclose(np.linalg.norm(judged.own.reshape(2, 2), axis=1), [math.hypot(0.1, 0.2)] * 2)
    np.testing.assert_allclose(judged.truth - judged.place, [[0, 0.1, 0.2], [0, 0.1, -0.2]], atol=1e-12)
    assert errors.landmark(Line(), l, 0.1 * np.eye(6), truth, np.zeros(3), "log", eye) is None
    d = np.array([0.0, 0.01, -0.02, 0.0, 0.03, 0.01])
    moved = errors.landmark(Line(), l + d, P, truth, np.zeros(3), "log", eye)
    assert moved is not None
    lengths = [
        np.linalg.norm((judged.own - judged.F @ d).reshape(2, 2), axis=1),
        np.linalg.norm(moved.own.reshape(2, 2), axis=1),
    ]
    np.testing.assert_allclose(*lengths, atol=2e-3)


def test_in_space_the_invariant_filter_is_as_sure_as_it_should_be_and_the_textbook_surer() -> None:
    keys = {"motion": {"type": "odometry_3d", "sigma_rotation_rad": 0.03}, "start": {"sigma_position_m": 0.1}}
    campaign = run_campaign(
        world(steps=80, robot=keys), 40, ["invariant", "ekf"], seed=4, jobs=1, skip=10, progress=False
    )
    invariant, ekf = campaign.summary()["estimators"].values()
    assert campaign.summary()["dof"] == {"pose": 6, "heading": 3, "landmarks": 3, "joint": 1}
    assert invariant["pose_anees"] == pytest.approx(6.0, abs=0.9)
    assert invariant["pose_inside"] > 0.8
    assert invariant["joint_anees"] == pytest.approx(1.0, abs=0.07)
    assert invariant["landmarks_anees"] == pytest.approx(3.0, rel=0.35)
    assert invariant["nis_per_dof"] == pytest.approx(1.0, abs=0.05)
    assert ekf["joint_anees"] > 1.15 and ekf["joint_inside"] < 0.2
    assert campaign.label("heading") == "orientation (3)"


def test_withheld_ids_and_ghosts_are_scored_by_what_was_really_seen() -> None:
    w = world(steps=30, ids=False, robot=faulty(outliers=0.05))
    score = Plan(w, configs_of(w, None), 0, 10).run(0)["invariant"]
    assert score.landmarks >= 8
    assert np.isfinite(score.series["joint"][0, 29])
    assert score.landmark_rmse_raw_m < 2.0


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
            "robots.robot.sensing.lidar.outliers: got 2, expected a number <= 1",
        ),
        ("robots.rover={motion: {type: unicycle}, route: {type: wander}}", "all move in the plane, or all in space"),
        ("world={type: random_box, min_m: [1, 0, 0], max_m: [0, 1, 1]}", "expected max_m nowhere below min_m"),
        ("world={type: list}", "expected points_m, segments_m or tags"),
        ("world={type: list, points_m: [[1, 2], [1, 2, 3]]}", "expected points .x, y., or all of them .x, y, z."),
        ("robots={r: {motion: {type: unicycle}, route: {type: wander}}}", "its landmarks are in space"),
    ],
)
def test_a_wrong_world_of_space_is_refused_with_value_and_expectation(override: str, said: str) -> None:
    with pytest.raises(ConfigError, match=said) as error:
        load_world("thick_cloister", [override])
    assert "\n" not in str(error.value)


AHEAD = {"roll_deg": -90.0, "yaw_deg": -90.0}


def camera_world(sensor: dict[str, Any], **keys: Any) -> World:
    return world(robot={"sensors": {"s": {"mount": AHEAD} | sensor}}, **keys)


def in_camera(log: Log, scan: Scan, l: np.ndarray) -> np.ndarray:
    T = km.geometry.frames3d.compose(log.truth["r"].at(scan.t_ns), AHEAD_POSE)[0]
    return km.geometry.frames3d.to_frame_many(T, l)[0]


AHEAD_POSE = np.concatenate([np.zeros(3), from_euler(np.radians([-90.0, 0.0, -90.0]))[0]])


@pytest.mark.parametrize(
    ("section", "sensor"),
    [
        ({"type": "pinhole", "distortion": (-0.3, 0.1)}, km.sensors.PinHole(distortion=(-0.3, 0.1))),
        ({"type": "omnidirectional"}, km.sensors.Omnidirectional()),
        ({"type": "stereo"}, km.sensors.Stereo()),
    ],
    ids=["pinhole", "omnidirectional", "stereo"],
)
def test_cameras_see_what_is_in_their_image_and_are_wrong_by_their_pixels(section: dict[str, Any], sensor: Any) -> None:
    log = simulate(camera_world(section, steps=150), 3)
    z = []
    for s in scans(log):
        v = in_camera(log, s, np.array([log.landmarks[i] for i in s.ids]))
        assert sensor.sees(v).all()
        hidden = in_camera(log, s, np.array([l for i, l in log.landmarks.items() if i not in s.ids]))
        assert not sensor.sees(hidden).any()
        z.append(s.y - sensor.expect(v)[0])
    z = np.concatenate(z)
    for column in z.T:
        assert_sigma(column, 1.0)


def test_a_camera_of_segments_measures_both_ends_within_the_image() -> None:
    house = {"type": "house", "x_m": 3.0, "y_m": -2.5}
    still = {"type": "constant", "u": (0.0, 0.0, 0.0, 0.0, 0.0, 0.02)}
    robot = {"sensors": {"s": {"type": "segments", "mount": AHEAD}}, "route": still}
    log = simulate(world(world=house, robot=robot, steps=100), 3)
    lengths, across = [], []
    for s in scans(log):
        assert (s.y > -6).all() and (s.y < [646, 486, 646, 486]).all()
        lengths.append(np.hypot(s.y[:, 2] - s.y[:, 0], s.y[:, 3] - s.y[:, 1]))
        for i, y in zip(s.ids, s.y, strict=True):
            a, b = in_camera(log, s, log.landmarks[i].reshape(2, 3))
            k = np.array([[320, 0, 320], [0, 320, 240], [0, 0, 1.0]])
            line = np.linalg.inv(k).T @ np.cross(a, b)
            across += [(line @ [*end, 1.0]) / np.hypot(*line[:2]) for end in y.reshape(2, 2)]
    assert np.concatenate(lengths).min() > 20 - 6
    assert len({i for s in scans(log) for i in s.ids}) > 15
    assert_sigma(np.array(across), 1.0)


@pytest.mark.parametrize("kind", ["tag_corners", "tag_pose"])
def test_a_camera_sees_the_tags_that_face_it(kind: str) -> None:
    behind = {"x_m": 4.0, "y_m": 1.0, "roll_deg": -90.0, "yaw_deg": 90.0, "size_m": 0.5}  # its back
    tags = ({"x_m": 4.0, "roll_deg": -90.0, "yaw_deg": -90.0, "size_m": 0.5}, behind)
    still = {"type": "constant", "u": (0.0,) * 6}
    robot = {"sensors": {"s": {"type": kind, "mount": AHEAD}}, "route": still}
    log = simulate(world(world={"type": "list", "tags": tags}, robot=robot, steps=300), 3)
    y = np.concatenate([s.y for s in scans(log)])
    assert {i for s in scans(log) for i in s.ids} == {1} and len(y) == 300
    if kind == "tag_corners":
        half = 320 * 0.25 / 4
        corners = np.array(
            [320 - half, 240 - half, 320 + half, 240 - half, 320 + half, 240 + half, 320 - half, 240 + half]
        )
        np.testing.assert_allclose(y[:, 8], 0.5)
        for column in (y[:, :8] - corners).T:
            assert_sigma(column, 1.0)
    else:
        np.testing.assert_allclose(np.linalg.norm(y[:, 3:], axis=1), 1)
        d = np.array([SE3.minus(pose, np.array([0, 0, 4.0, 0, 0, 0, 1])) for pose in y])
        for column in d.T:
            assert_sigma(column, 0.02)


def test_a_robot_of_constant_velocity_coasts_from_the_start_in_the_filter_too() -> None:
    start = {"vx_mps": 1.0, "wz_radps": 0.3}
    robot = {
        "motion": {"type": "constant_velocity_3d", "sigma_v_mps": 0.02, "sigma_w_radps": 0.01},
        "start": start,
        "route": {"type": "constant", "u": (0.0,) * 6},
    }
    campaign = run_campaign(world(robot=robot, steps=60), 30, ["invariant"], seed=2, jobs=1, skip=10, progress=False)
    f = campaign.summary()["estimators"]["invariant"]
    assert f["state_anees"] == pytest.approx(12.0, abs=1.5)
    assert f["pose_anees"] == pytest.approx(6.0, abs=1.0)
    assert f["joint_anees"] == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize("motion", ["odometry_3d", "velocity_3d", "constant_velocity_3d"])
def test_every_motion_of_space_is_steered_through_the_same_places(motion: str) -> None:
    points = ((5.0, 0.0, 0.0), (5.0, 5.0, 3.0), (0.0, 5.0, 1.0))
    route = {"type": "waypoints", "points_m": points, "speed_mps": 1.0, "turn_radius_m": 0.4}
    path = simulate(world(steps=250, robot={"motion": {"type": motion}, "route": route}), 1).truth["r"].poses
    for point in points:
        assert np.linalg.norm(path[:, :3] - point, axis=1).min() < 1.0


def test_a_camera_mount_finds_itself_in_a_world_of_two_robots() -> None:
    world_ = load_world("self_calibration", ["steps=250", "world.count=40"])
    f = run_campaign(world_, 3, ["invariant"], seed=1, jobs=1, progress=False).summary()["estimators"]["invariant"]
    assert f["mount_deg"] < 0.25 and f["mount_m"] < 0.02  # of 2.6 deg and 0.087 m
    assert f["mount_sure"] == 3
