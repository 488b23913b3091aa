"""Signal strengths and differences of arrival: Jacobians, and what they find out."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import kalmark as km
from kalmark.geometry.spaces import SE2, SE3, mount_space
from kalmark.models.model_check import check_model
from kalmark.models.observe import linearize, view_of
from kalmark.models.pointwise import jacobian

STRENGTH = {"strength_dbm": -35.0, "exponent": 2.7, "sigma_strength_db": 5.0, "sigma_exponent": 0.5}
SENSORS: list[Any] = [
    km.sensors.SignalStrength2D(**STRENGTH), km.sensors.SignalStrength3D(**STRENGTH),
    km.sensors.RangeDifference2D(baseline_m=0.7), km.sensors.RangeDifference3D(baseline_m=0.7),
]  # fmt: skip


@pytest.mark.parametrize("sensor", SENSORS, ids=lambda s: type(s).__name__)
def test_a_check_finds_nothing(sensor: Any) -> None:
    assert all(found.ok for found in check_model(sensor, np.random.default_rng(0)))


@pytest.mark.parametrize("sensor", SENSORS, ids=lambda s: type(s).__name__)
def test_jacobians_on_a_mount_in_the_map_are_those_of_differences(sensor: Any) -> None:
    rng, plane = np.random.default_rng(1), sensor.world == "plane"
    pose, landmark = (SE2, km.landmarks.Point2D()) if plane else (SE3, km.landmarks.Point3D())
    origin = np.zeros(pose.size) if plane else np.array([0, 0, 0, 0, 0, 0, 1.0])
    at = mount_space(pose.size).plus(origin, rng.normal(0, 0.3, pose.dof))
    own = sensor.parameters if "exponent" in vars(sensor) else np.zeros(0)
    view, r = view_of(sensor, landmark, at), pose.plus(origin, rng.normal(0, 1, pose.dof))
    l, y = rng.normal(0, 3, (1, landmark.space.size)), np.zeros((1, 1))
    e, z, E_h, E_l = linearize(view, np.concatenate([r, at, own]), l, y)
    np.testing.assert_array_equal(z, -e)

    def at_point(x: Any) -> Any:
        return linearize(view, np.concatenate([r, at, own]), x[None], y)[0][0]

    np.testing.assert_allclose(E_l[0], jacobian(at_point, l[0], (False,)), rtol=1e-6, atol=1e-7)
    for first, space, x in ((0, pose, r), (pose.dof, mount_space(pose.size), at)):
        for j in range(pose.dof):
            d = np.eye(pose.dof)[j] * 1e-6
            heads = [space.plus(x, s * d) for s in (1, -1)]
            values = [
                linearize(view, np.concatenate([h, at, own] if first == 0 else [r, h, own]), l, y)[0] for h in heads
            ]
            np.testing.assert_allclose(E_h[0, 0, first + j], (values[0] - values[1])[0, 0] / 2e-6, atol=1e-6)
    if len(own):
        of = jacobian(lambda p: linearize(view, np.concatenate([r, at, p]), l, y)[0][0], own, (False,))
        np.testing.assert_allclose(E_h[0, :, 2 * pose.dof :], of, rtol=1e-6, atol=1e-6)


def test_strengths_of_surveyed_senders_tell_where_a_robot_is_and_how_the_signal_fades() -> None:
    """Twenty drives among four senders: position, strength at 1 m and exponent are as wrong as the filter says."""
    senders = {1: (0.0, 0.0), 2: (40.0, 0.0), 3: (40.0, 40.0), 4: (0.0, 40.0)}
    nees, constants = [], []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        sensor = km.sensors.SignalStrength2D(
            2.0, strength_dbm=-40.0, exponent=2.0, sigma_strength_db=4.0, sigma_exponent=0.4
        )
        true = np.array([-40.0 + rng.normal(0, 4), 2.0 + rng.normal(0, 0.4)])
        start, x = np.array([20.0, 10.0, 0.0]), np.array([20.0, 10.0, 0.0]) + rng.normal(0, [1, 1, 0.1])
        robot = km.Robot("r", motion=km.motion.Odometry2D(0.05, 0.0, 0.02), start=start, cov=np.diag([1, 1, 0.01]),
                         sensors={"radio": km.Mount(sensor)})  # fmt: skip
        slam = km.Slam(robot)
        for name, place in senders.items():
            slam.add_landmark(name, place, 1e-4 * np.eye(2))
        for k in range(1, 61):
            u = np.array([0.5, 0.0, 0.06])
            x = slam.robots["r"].motion.move(x, u + rng.normal(0, [0.05, 0.0, 0.02]), 1.0)[0]
            slam.process(km.Control(float(k), "r", u))
            d = np.linalg.norm(np.array([*senders.values()]) - x[:2], axis=1)
            y = true[0] - true[1] * 10 * np.log10(d) + rng.normal(0, 2, 4)
            slam.process(km.Scan(float(k), "r", "radio", y[:, None], [*senders]))
        error = SE2.minus(slam.mean("r"), x)
        nees.append(error @ np.linalg.solve(slam.covariance("r"), error))
        d, P = slam.mean("r.radio")[3:] - true, slam.covariance("r.radio")[3:, 3:]
        constants.append(d @ np.linalg.solve(P, d))
    assert 1.6 < np.mean(nees) < 4.9  # 99.7 % of the mean of 20 chi-squares of 3 are within 1.7 and 4.8
    assert 0.9 < np.mean(constants) < 3.6


def test_a_strength_alone_starts_no_landmark() -> None:
    slam = km.Slam(
        km.Robot("r", motion=km.motion.Unicycle(), sensors={"radio": km.Mount(km.sensors.SignalStrength2D())})
    )
    o = slam.process(km.Scan(0.0, "r", "radio", [[-60.0]], [3])).observations[0]
    assert o.outcome == "ignored"
    assert "alone cannot start a landmark; several can, with initialization: trilateration" in o.reason
