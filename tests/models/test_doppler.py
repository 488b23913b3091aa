"""Range rates: Jacobians in every argument, what they find out, and what they refuse."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import kalmark as km
from kalmark.errors import EventError, MapError, ModelError
from kalmark.geometry.spaces import SE2, SE3
from kalmark.models.model_check import check_model
from kalmark.models.observe import PythonView, linearize, sensor_address, sensor_at, view_of
from kalmark.models.protocols import has_velocity_state

SENSORS: list[Any] = [km.sensors.RangeRate2D(), km.sensors.RangeRate3D(), km.sensors.Radar2D(), km.sensors.Radar3D()]
COASTING: list[Any] = [km.motion.ConstantVelocity(), km.motion.ConstantTurnRate(), km.motion.ConstantVelocity3D()]
MOTIONS: list[Any] = [*COASTING, km.motion.Inertial(), km.motion.Unicycle(), km.motion.Odometry3D()]  # two have none
SINCE = np.array([0.3, 0.5, -0.2, 0.4, 0.0, 0.0, 9.8])  # s since the last scan, and the control in force
CASES = [(s, m) for s in SENSORS for m in MOTIONS if s.world == m.space.world]


def drawn(space: Any, rng: np.random.Generator) -> Any:
    origin = np.zeros(space.size)
    if space.world == "space":
        origin[6] = 1.0
    return space.plus(origin, rng.normal(0, 1, space.dof))


@pytest.mark.parametrize("sensor", SENSORS, ids=lambda s: type(s).__name__)
def test_a_check_finds_nothing(sensor: Any) -> None:
    assert all(found.ok for found in check_model(sensor, np.random.default_rng(0)))


@pytest.mark.parametrize(("sensor", "motion"), CASES, ids=lambda c: type(c).__name__)
def test_jacobians_in_pose_state_and_landmark_are_those_of_differences(sensor: Any, motion: Any) -> None:
    rng, plane = np.random.default_rng(1), sensor.world == "plane"
    pose, landmark = (SE2, km.landmarks.Point2D()) if plane else (SE3, km.landmarks.Point3D())
    at, angular = drawn(pose, rng), np.array(sensor.angular)
    view = view_of(sensor, landmark, at, motion, SINCE)
    in_python = PythonView(sensor, landmark, at, angular, motion, SINCE)
    behind = motion.space if has_velocity_state(motion) else pose
    for _ in range(5):
        r, x = drawn(pose, rng), drawn(behind, rng)
        l, y = rng.normal(0, 5, (3, landmark.space.size)), np.zeros((3, len(sensor.columns)))

        def seen(r: Any, x: Any, l: Any) -> Any:
            return linearize(view, np.concatenate([r, x]), l, y)[0]

        e, z, E_h, E_l = linearize(view, np.concatenate([r, x]), l, e_y := seen(r, x, l))
        np.testing.assert_allclose(z, 0.0, atol=1e-12)
        for a, b in zip((e, z, E_h, E_l), in_python.linearize(np.concatenate([r, x]), l, e_y), strict=True):
            np.testing.assert_allclose(a, b, atol=1e-12)
        for first, space, at_ in ((0, pose, r), (pose.dof, behind, x)):
            for j in range(space.dof):
                d = np.eye(space.dof)[j] * 1e-6
                ends = [space.plus(at_, s * d) for s in (1, -1)]
                up, down = (seen(o, x, l) if first == 0 else seen(r, o, l) for o in ends)
                rise = np.where(angular, np.sin(up - down), up - down) / 2e-6
                np.testing.assert_allclose(E_h[:, :, first + j], rise, atol=1e-6)
        for j in range(l.shape[1]):
            d = np.eye(l.shape[1])[j] * 1e-6
            up, down = seen(r, x, l + d), seen(r, x, l - d)
            rise = np.where(angular, np.sin(up - down), up - down) / 2e-6
            np.testing.assert_allclose(E_l[:, :, j], rise, atol=1e-6)
        e_known, _, E_known, none = linearize(view, np.concatenate([r, x]), np.zeros((3, 0)), np.hstack([y, l]))
        np.testing.assert_array_equal(e_known, np.hstack([e, l]))
        np.testing.assert_array_equal(E_known, E_h)
        assert none.shape == (3, len(sensor.angular), 0)


@pytest.mark.parametrize("motion", MOTIONS, ids=lambda m: type(m).__name__)
def test_the_place_of_a_sensor_depends_on_the_pose_alone(motion: Any) -> None:
    rng, plane = np.random.default_rng(2), motion.space.world == "plane"
    pose = SE2 if plane else SE3
    sensor, landmark = (SENSORS[2], km.landmarks.Point2D()) if plane else (SENSORS[3], km.landmarks.Point3D())
    at, r, x = drawn(pose, rng), drawn(pose, rng), drawn(motion.space, rng)
    S, S_h = sensor_at(view_of(sensor, landmark, at, motion, SINCE), np.concatenate([r, x]), sensor_address())
    from kalmark.models.observe import sensor_pose

    np.testing.assert_allclose(S, sensor_pose(r, at)[0][: len(S)], atol=1e-14)
    np.testing.assert_array_equal(S_h[:, pose.dof :], 0.0)
    assert S_h.shape[1] == pose.dof + motion.space.dof


def test_a_rate_is_how_fast_the_range_changes() -> None:
    motion, at = km.motion.ConstantVelocity(), np.array([0.7, -0.4, 0.5])
    state, landmark = np.array([1.0, 2.0, 0.3, 1.5, -0.4, 0.6]), np.array([[8.0, 5.0]])
    radar = view_of(km.sensors.Radar2D(), km.landmarks.Point2D(), at, motion, SINCE)

    def seen(x: Any) -> Any:
        return linearize(radar, np.concatenate([x[:3], x]), landmark, np.zeros((1, 3)))[0][0]

    h = 1e-6
    later, before = (seen(motion.move(state, np.zeros(3), s * h)[0]) for s in (1, -1))
    np.testing.assert_allclose(seen(state)[2], (later[0] - before[0]) / (2 * h), rtol=1e-6)


def test_rates_of_surveyed_landmarks_tell_the_velocity() -> None:
    """Standing anywhere, four rates determine velocity and, on a lever arm, the turn rate: as wrong as is said."""
    nees = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        cov = np.diag([1e-8, 1e-8, 1e-8, 1.0, 1.0, 0.25])
        motion = km.motion.ConstantVelocity()
        truth = motion.space.plus(np.array([0.0, 0, 0, 1.0, 0.2, 0.1]), rng.normal(0, np.sqrt(np.diag(cov))))
        sensor = km.sensors.RangeRate2D(0.05)
        mounts = {name: km.Mount(sensor, at=(1.0, y, 0.0)) for name, y in (("left", 1.0), ("right", -1.0))}
        slam = km.Slam(km.Robot("r", motion=motion, start=(0, 0, 0, 1.0, 0.2, 0.1), cov=cov, sensors=mounts))
        buoys = {1: (20.0, 0.0), 2: (0.0, 20.0), 3: (-15.0, 5.0), 4: (3.0, -9.0)}
        for name, place in buoys.items():
            slam.add_landmark(name, place, None if name % 2 else 1e-6 * np.eye(2))
        for name, mount in mounts.items():
            view = view_of(sensor, km.landmarks.Point2D(), np.array(mount.at), motion, SINCE)
            e = linearize(view, np.concatenate([truth[:3], truth]), np.array([*buoys.values()]), np.zeros((4, 1)))[0]
            report = slam.process(km.Scan(0.0, "r", name, e + rng.normal(0, 0.05, e.shape), [*buoys]))
            assert all(o.outcome == "associated" for o in report.observations)
        error = motion.space.minus(slam.mean("r"), truth)[3:]
        P = slam.covariance("r")[3:, 3:]
        assert np.sqrt(np.diag(P)).max() < 0.1
        nees.append(error @ np.linalg.solve(P, error))
    assert 1.6 < np.mean(nees) < 4.9  # 99.7 % of the mean of 20 chi-squares of 3 are within 1.7 and 4.8


@pytest.mark.parametrize("estimator", [km.estimators.Invariant(), km.estimators.Ekf(), km.estimators.Fej()])
def test_a_radar_starts_landmarks_and_finds_its_velocity(estimator: Any) -> None:
    rng, motion = (
        np.random.default_rng(0),
        km.motion.ConstantTurnRate(sigma_v_mps_per_sqrt_s=0.01, sigma_w_radps_per_sqrt_s=0.01),
    )
    cov = np.diag([0.0, 0, 0, 1.0, 0.25])
    robot = km.Robot(
        "r", motion=motion, start=(0, 0, 0, 1.0, 0.0), cov=cov, sensors={"radar": km.Mount(km.sensors.Radar2D())}
    )
    slam, truth = km.Slam(robot, estimator=estimator), np.array([0.0, 0, 0, 1.7, 0.1])
    buoys, view = np.array([[10.0, 3.0], [5.0, -8.0], [-9.0, 4.0]]), None
    view = view_of(km.sensors.Radar2D(), km.landmarks.Point2D(), np.zeros(3), motion, SINCE)
    for k in range(20):
        e = linearize(view, np.concatenate([truth[:3], truth]), buoys, np.zeros((3, 3)))[0]
        report = slam.process(km.Scan(0.2 * k, "r", "radar", e + rng.normal(0, [0.2, 0.02, 0.1], (3, 3)), [1, 2, 3]))
        assert {o.outcome for o in report.observations} == {"new" if k == 0 else "associated"}
        truth = motion.move(truth, np.zeros(2), 0.2)[0]
    np.testing.assert_allclose(slam.mean("r")[3:], truth[3:], atol=0.1)
    seen = slam.expect("r", "radar")
    assert seen.in_view.all()
    assert seen.E_r.shape == (3, 3, 3)
    assert (np.diagonal(seen.Z, axis1=1, axis2=2) >= [0.04, 0.0004, 0.01]).all()


def drives(seed: int, steps: int = 60) -> tuple[km.Slam, Any, list[Any]]:
    """Drive a unicycle with poor speeds among three posts, with a radar; return where it is, too, and the reports."""
    rng, motion = np.random.default_rng(seed), km.motion.Unicycle(0.3, 0.05)
    at, posts, x = np.array([0.5, 0.2, 0.3]), np.array([[10.0, 3.0], [5.0, -8.0], [-9.0, 4.0]]), np.zeros(3)
    radar, since = km.sensors.Radar2D(0.05), np.array([0.2])
    slam = km.Slam(km.Robot("r", motion=motion, sensors={"radar": km.Mount(radar, at=at)}))
    view, reports = view_of(radar, km.landmarks.Point2D(), at, motion, since), []
    for k in range(steps):
        u = np.array([1.0, 0.2])
        slam.process(km.Control(0.2 * k, "r", u + rng.normal(0, [0.3, 0.05])))
        before, x = x, motion.move(x, u, 0.2)[0]
        e = linearize(view, np.concatenate([x, before]), posts, np.zeros((3, 3)))[0]
        y = e + rng.normal(0, [0.2, 0.02, 0.05], (3, 3))
        reports.append(slam.process(km.Scan(0.2 * (k + 1), "r", "radar", y, [1, 2, 3])))
    return slam, x, reports


def test_where_no_state_has_the_velocity_it_is_the_mean_since_the_last_scan(tmp_path: Path) -> None:
    """Twelve drives: as wrong as is said, and with a clone of the pose at the last scan alone."""
    nees = []
    for seed in range(12):
        slam, truth, reports = drives(seed)
        first = [o.reason for o in reports[0].observations]
        assert first == ["the first scan: none to count the velocity from"] * 3
        assert {o.outcome for o in reports[1].observations} == {"new"}
        assert {o.outcome for o in reports[-1].observations} == {"associated"}
        error = SE2.minus(slam.mean("r"), truth)
        nees.append(error @ np.linalg.solve(slam.covariance("r"), error))
    assert 1.3 < np.mean(nees) < 5.6  # 99.7 % of the mean of 12 chi-squares of 3 are within 1.5 and 5.3
    assert len(slam.state.clones.clones) == 1
    with pytest.raises(MapError, match="'radar' of 'r' expects nothing: at the time of the last scan"):
        slam.expect("r", "radar")
    slam.save(tmp_path / "map.kmk")
    again, more = km.Slam.load(tmp_path / "map.kmk"), km.Scan(12.2, "r", "radar", [[9.0, 0.0, 0.0]], [1])
    asked: list[Any] = []
    slam.before_scan = lambda *key: asked.append(slam.expect(*key))
    report = slam.process(more)
    assert report.observations == again.process(more).observations
    assert asked[0].E_r.shape == (3, 3, 3)
    np.testing.assert_allclose(asked[0].e[0], report.e[0], rtol=1e-12)
    np.testing.assert_allclose(asked[0].Z[0], report.Z[0], rtol=1e-6)
    np.testing.assert_array_equal(again.mean("r"), slam.mean("r"))


def test_a_second_scan_at_one_time_has_no_velocity() -> None:
    slam, _, _ = drives(0, 5)
    o = slam.process(km.Scan(1.0, "r", "radar", [[5.0, 0.0, 0.0]], [1])).observations[0]
    assert (o.outcome, o.reason) == ("ignored", "at the time of the last scan: none to count the velocity from")


def test_an_unknown_mount_is_refused() -> None:
    mount = km.Mount(km.sensors.Radar2D(), cov=0.01 * np.eye(3))
    with pytest.raises(ModelError, match="the mount of a Radar2D has sigmas, expected one that is known"):
        km.Slam(km.Robot("r", motion=km.motion.ConstantVelocity(), sensors={"radar": mount}))


def test_a_negative_range_is_refused_and_a_rate_alone_starts_no_landmark() -> None:
    sensors = {"radar": km.Mount(km.sensors.Radar2D()), "rate": km.Mount(km.sensors.RangeRate2D())}
    slam = km.Slam(km.Robot("r", motion=km.motion.ConstantVelocity(), sensors=sensors))
    with pytest.raises(EventError, match=r"range is -1\.0 m, expected at least 0"):
        slam.process(km.Scan(0.0, "r", "radar", [[-1.0, 0.0, 0.0]], [3]))
    o = slam.process(km.Scan(0.0, "r", "rate", [[-1.0]], [3])).observations[0]
    assert (o.outcome, o.reason) == ("ignored", "a RangeRate2D measurement alone cannot start a landmark")


def test_a_radar_tells_the_depth_of_what_bearings_have_begun() -> None:
    nees, at = [], np.array([0.3, 0.2, 0.1])
    posts = np.array([[10.0, 3.0], [8.0, -6.0], [14.0, 4.0], [12.0, -2.0]])
    motion, radar = km.motion.Unicycle(0.05, 0.02), km.sensors.Radar2D(0.05)
    camera = km.Mount(km.sensors.Bearing(0.01), landmark=km.landmarks.InverseDepth2D())
    view = view_of(radar, km.landmarks.Point2D(), at, motion, np.array([0.2]))
    for seed in range(12):
        rng, x, outcomes = np.random.default_rng(seed), np.zeros(3), set[str]()
        slam = km.Slam(km.Robot("r", motion=motion, sensors={"camera": camera, "radar": km.Mount(radar, at=at)}))
        for k in range(30):
            slam.process(km.Control(0.2 * k, "r", np.array([1.0, 0.05]) + rng.normal(0, [0.05, 0.02])))
            before, x = x, motion.move(x, np.array([1.0, 0.05]), 0.2)[0]
            y = linearize(view, np.concatenate([x, before]), posts, np.zeros((4, 3)))[0]
            bearings = km.geometry.observe(x, posts)[0][:, 1:] + rng.normal(0, 0.01, (4, 1))
            slam.process(km.Scan(0.2 * (k + 1), "r", "camera", bearings, [1, 2, 3, 4]))
            if k > 3:
                scan = km.Scan(0.2 * (k + 1), "r", "radar", y + rng.normal(0, [0.2, 0.02, 0.05], (4, 3)), [1, 2, 3, 4])
                outcomes |= {o.outcome for o in slam.process(scan).observations if k > 4}
        assert outcomes == {"associated"}
        error = SE2.minus(slam.mean("r"), x)
        nees.append(error @ np.linalg.solve(slam.covariance("r"), error))
    assert 1.3 < np.mean(nees) < 5.6  # 99.7 % of the mean of 12 chi-squares of 3 are within 1.5 and 5.3


@pytest.mark.filterwarnings("error")
def test_a_range_rate_of_what_bearings_have_begun_tells_no_distance() -> None:
    sensors = {
        "camera": km.Mount(km.sensors.Bearing(0.01), landmark=km.landmarks.InverseDepth2D()),
        "rate": km.Mount(km.sensors.RangeRate2D(0.05)),
    }
    motion = km.motion.ConstantTurnRate()
    slam = km.Slam(km.Robot("r", motion=motion, start=(0, 0, 0, 1.0, 0), sensors=sensors))
    slam.process(km.Scan(0.0, "r", "camera", [[0.3]], [1]))
    before = np.sqrt(slam.covariance(1)[-1, -1])
    o = slam.process(km.Scan(0.1, "r", "rate", [[-np.cos(0.3)]], [1])).observations[0]
    assert o.outcome == "associated"
    assert np.sqrt(slam.covariance(1)[-1, -1]) > 0.9 * before
