"""Range rates: Jacobians in every argument, what they find out, and what they refuse."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import kalmark as km
from kalmark.errors import EventError, ModelError
from kalmark.geometry.spaces import SE2, SE3
from kalmark.models.check import check_model
from kalmark.models.known import known_view
from kalmark.models.observe import linearize, sensor_address, sensor_at
from kalmark.models.velocity_view import PythonMovingView, moving_view_of

SENSORS: list[Any] = [km.sensors.RangeRate2D(), km.sensors.RangeRate3D(), km.sensors.Radar2D(), km.sensors.Radar3D()]
MOTIONS: list[Any] = [km.motion.ConstantVelocity(), km.motion.ConstantTurnRate(), km.motion.ConstantVelocity3D()]
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
    view, in_python = (
        moving_view_of(sensor, landmark, motion, at),
        PythonMovingView(sensor, landmark, motion, at, angular),
    )
    for _ in range(5):
        r, x = drawn(pose, rng), drawn(motion.space, rng)
        l, y = rng.normal(0, 5, (3, landmark.space.size)), np.zeros((3, len(sensor.columns)))

        def seen(r: Any, x: Any, l: Any) -> Any:
            return linearize(view, np.concatenate([r, x]), l, y)[0]

        e, z, E_h, E_l = linearize(view, np.concatenate([r, x]), l, e_y := seen(r, x, l))
        np.testing.assert_allclose(z, 0.0, atol=1e-12)
        for a, b in zip((e, z, E_h, E_l), in_python.linearize(np.concatenate([r, x]), l, e_y), strict=True):
            np.testing.assert_allclose(a, b, atol=1e-12)
        for first, space, of in ((0, pose, r), (pose.dof, motion.space, x)):
            for j in range(space.dof):
                d = np.eye(space.dof)[j] * 1e-6
                ends = [space.plus(of, s * d) for s in (1, -1)]
                up, down = (seen(o, x, l) if first == 0 else seen(r, o, l) for o in ends)
                rise = np.where(angular, np.sin(up - down), up - down) / 2e-6
                np.testing.assert_allclose(E_h[:, :, first + j], rise, atol=1e-6)
        for j in range(l.shape[1]):
            d = np.eye(l.shape[1])[j] * 1e-6
            up, down = seen(r, x, l + d), seen(r, x, l - d)
            rise = np.where(angular, np.sin(up - down), up - down) / 2e-6
            np.testing.assert_allclose(E_l[:, :, j], rise, atol=1e-6)
        e_known, _, E_known, none = linearize(
            known_view(view), np.concatenate([r, x]), np.zeros((3, 0)), np.hstack([y, l])
        )
        np.testing.assert_array_equal(e_known, np.hstack([e, l]))
        np.testing.assert_array_equal(E_known, E_h)
        assert none.shape == (3, len(sensor.angular), 0)


@pytest.mark.parametrize("motion", MOTIONS, ids=lambda m: type(m).__name__)
def test_the_place_of_a_sensor_depends_on_the_pose_alone(motion: Any) -> None:
    rng, plane = np.random.default_rng(2), motion.space.world == "plane"
    pose = SE2 if plane else SE3
    sensor, landmark = (SENSORS[2], km.landmarks.Point2D()) if plane else (SENSORS[3], km.landmarks.Point3D())
    at, r, x = drawn(pose, rng), drawn(pose, rng), drawn(motion.space, rng)
    S, S_h = sensor_at(
        moving_view_of(sensor, landmark, motion, at), np.concatenate([r, x]), sensor_address(motion.space.axes)
    )
    from kalmark.models.observe import composed

    np.testing.assert_allclose(S, composed(r, at)[0][: len(S)], atol=1e-14)
    np.testing.assert_array_equal(S_h[:, pose.dof :], 0.0)
    assert S_h.shape[1] == pose.dof + motion.space.dof


def test_a_rate_is_how_fast_the_range_changes() -> None:
    motion, at = km.motion.ConstantVelocity(), np.array([0.7, -0.4, 0.5])
    state, landmark = np.array([1.0, 2.0, 0.3, 1.5, -0.4, 0.6]), np.array([[8.0, 5.0]])
    radar = moving_view_of(km.sensors.Radar2D(), km.landmarks.Point2D(), motion, at)

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
            view = moving_view_of(sensor, km.landmarks.Point2D(), motion, np.array(mount.at))
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
    view = moving_view_of(km.sensors.Radar2D(), km.landmarks.Point2D(), motion, np.zeros(3))
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


def test_what_has_no_velocity_in_its_state_or_an_unknown_mount_is_refused() -> None:
    with pytest.raises(
        ModelError, match="a Radar2D is on a robot with the motion Unicycle, expected one with the velo"
    ):
        km.Slam(km.Robot("r", motion=km.motion.Unicycle(), sensors={"radar": km.Mount(km.sensors.Radar2D())}))
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
