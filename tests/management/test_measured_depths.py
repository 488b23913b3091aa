"""Landmarks of unknown depth whose distance another sensor determines."""

from __future__ import annotations

from collections import Counter
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import pytest

import kalmark as km
from differences import agree, derivative
from kalmark.geometry import frames, frames3d
from kalmark.models.landmarks import AsPoint
from kalmark.models.observe import expectation, linearize, view_of

CAMERA_AT = np.array([0, 0, 0, -0.5, 0.5, -0.5, 0.5])  # z forward
STEPS, POINTS = 40, 8
PRIOR = {"prior_rho_per_m": 0.12, "sigma_rho_per_m": 0.06}
IN_SPACE = [
    km.landmarks.InverseDepth3D(**PRIOR),
    km.landmarks.AnchoredHomogeneous(**PRIOR),
    km.landmarks.Homogeneous(**PRIOR),
]
RANGE = km.pointwise(lambda v: np.array([np.sqrt(v @ v)]), np.array([[0.01]]), columns=("distance",))


@pytest.mark.parametrize("landmark", [km.landmarks.InverseDepth2D(**PRIOR), *IN_SPACE], ids=lambda kind: kind.kind)
def test_what_a_sensor_sees_of_the_point_and_its_jacobians(landmark: Any) -> None:
    rng, plane = np.random.default_rng(0), landmark.kind == "inverse_depth_2d"
    T = np.array([0.4, -0.2, 0.7]) if plane else np.array([0.4, -0.2, 0.3, 0.1, 0.2, -0.3, np.sqrt(0.86)])
    mount = np.zeros(3) if plane else np.array([0, 0, 0, 0, 0, 0, 1.0])
    sensor: Any = km.sensors.RangeBearing() if plane else km.sensors.RangeBearing3D()
    seen, d = AsPoint(landmark), 2 if plane else 3
    l = landmark.from_view(T, np.column_stack([rng.normal(size=(3, d)), [0.1, 0.3, 0.5]]))[0]
    y = np.ones((3, d))
    e, z, E_h, E_l = linearize(view_of(sensor, seen, mount), T, l, y)
    np.testing.assert_allclose(e, expectation(T, mount, sensor, seen, l)[0], atol=1e-12)
    np.testing.assert_allclose(E_h, expectation(T, mount, sensor, seen, l)[1], atol=1e-12)
    p = landmark.to_point(l)[0]
    v = (frames if plane else frames3d).to_frame_many(T, p)[0]
    np.testing.assert_allclose(e, sensor.expect(v)[0], atol=1e-12)

    def expected(T: Any, l: Any) -> Any:
        return sensor.expect(seen.seen_from(T, l[None])[0])[0][0]

    for k in range(3):
        agree(E_h[k], derivative(partial(expected, l=l[k]), T, "plain" if plane else "frame"))
        agree(E_l[k], derivative(partial(expected, T), l[k], first=0.005))
    assert np.isfinite(z).all()


class Outcome(NamedTuple):
    """What became of one run."""

    outcomes: Counter[str]
    pose_nees: float
    landmark_nees: float


def of_landmarks(slam: km.Slam, points: np.ndarray) -> float:
    errors = [(slam.place(i)[0] - points[i], slam.place(i)[1]) for i in slam.landmarks().ids]
    return float(np.mean([e @ np.linalg.solve(P, e) for e, P in errors]))


def in_space(landmark: Any, radio: Any, seed: int) -> Outcome:
    rng, camera = np.random.default_rng(seed), km.sensors.PinHole()
    motion = km.motion.Odometry3D()
    sensors = {
        "camera": km.Mount(camera, at=CAMERA_AT, landmark=landmark),
        "radio": km.Mount(radio, landmark=km.landmarks.Point3D()),
    }
    slam = km.Slam([km.Robot("r", motion, sensors=sensors)])
    points = np.column_stack([rng.uniform(5, 14, POINTS), rng.uniform(-3, 3, POINTS), rng.uniform(-2, 2, POINTS)])
    T, N, found, nees = np.array([0, 0, 0, 0, 0, 0, 1.0]), motion.control_noise(np.zeros(6)), Counter[str](), []
    for k in range(STEPS):
        u, t = np.array([0.05, 0.1 * np.cos(k / 6), 0.03, 0, 0, 0.005]), 0.1 * (k + 1)
        T = motion.move(T, u, 0.0)[0]
        slam.process(km.Control(t, "r", u + rng.multivariate_normal(np.zeros(6), N)))
        v = frames3d.to_frame_many(frames3d.compose(T, CAMERA_AT)[0], points)[0]
        y, seen = camera.expect(v)[0] + rng.normal(size=(POINTS, 2)), np.flatnonzero(camera.sees(v))
        slam.process(km.Scan(t, "r", "camera", y[seen], seen.tolist()))
        if k % 2:
            e = radio.expect(frames3d.to_frame_many(T, points)[0])[0]
            y = e + np.array([rng.multivariate_normal(np.zeros(len(R)), R) for R in radio.noise(e)])
            found.update(o.outcome for o in slam.process(km.Scan(t, "r", "radio", y, [*range(POINTS)])).observations)
        d = frames3d.minus(slam.mean("r"), T)
        nees.append(d @ np.linalg.solve(slam.covariance("r") + 1e-15 * np.eye(6), d))
    return Outcome(found, float(np.mean(nees)), of_landmarks(slam, points))


@pytest.mark.parametrize(
    "radio", [km.sensors.RangeBearing3D(), km.sensors.SignalStrength3D(1.0), RANGE], ids=["full", "strength", "own"]
)
@pytest.mark.parametrize("landmark", IN_SPACE, ids=lambda kind: kind.kind)
def test_another_sensor_tells_the_depth_of_what_a_camera_began(landmark: Any, radio: Any) -> None:
    runs = [in_space(landmark, radio, seed) for seed in range(5)]
    for run in runs:
        assert run.outcomes["associated"] >= 150, run.outcomes
    assert 4.0 < np.mean([run.pose_nees for run in runs]) < 9.0
    assert 1.5 < np.mean([run.landmark_nees for run in runs]) < 4.5


def in_plane(seed: int, noise: np.ndarray, sigma_scale: float, sigma_bias_m: float) -> Outcome:
    rng = np.random.default_rng(seed)
    scale, bias_m = rng.normal([1.0, 0.0], [sigma_scale, sigma_bias_m])
    motion = km.motion.Odometry2D(*noise)
    camera = km.sensors.Bearing(sigma_bearing_rad=0.01)
    radio = km.sensors.Range(sigma_range_m=0.1, sigma_scale=sigma_scale, sigma_bias_m=sigma_bias_m)
    prior = km.landmarks.InverseDepth2D(0.12, 0.06)
    mounts = {"camera": km.Mount(camera, landmark=prior), "radio": km.Mount(radio)}
    slam = km.Slam([km.Robot("r", motion, sensors=mounts)])
    angles = np.linspace(0, 2 * np.pi, POINTS, endpoint=False)
    points = [3, 0] + rng.uniform(6, 12, (POINTS, 1)) * np.column_stack([np.cos(angles), np.sin(angles)])
    x, found, nees = np.zeros(3), Counter[str](), []
    for k in range(STEPS):
        u, t = np.array([0.15, 0, 0.02]), 0.1 * (k + 1)
        x = frames.compose(x, u)[0]
        slam.process(km.Control(t, "r", u + rng.normal(size=3) * noise))
        v = frames.to_frame_many(x, points)[0]
        y = np.arctan2(v[:, 1], v[:, 0]) + 0.01 * rng.normal(size=POINTS)
        slam.process(km.Scan(t, "r", "camera", y[:, None], [*range(POINTS)]))
        if k % 2:
            y = scale * np.hypot(v[:, 0], v[:, 1]) + bias_m + 0.1 * rng.normal(size=POINTS)
            found.update(
                o.outcome for o in slam.process(km.Scan(t, "r", "radio", y[:, None], [*range(POINTS)])).observations
            )
        d = slam.mean("r") - x
        nees.append(d @ np.linalg.solve(slam.covariance("r"), d))
    return Outcome(found, float(np.mean(nees)), of_landmarks(slam, points))


@pytest.mark.parametrize(
    ("noise", "unknown"), [((0.02, 0.02, 0.005), (0.0, 0.0)), ((0.005, 0.005, 0.002), (0.05, 0.3))]
)
def test_a_range_tells_the_depth_of_what_a_bearing_began(noise: Any, unknown: tuple[float, float]) -> None:
    runs = [in_plane(seed, np.array(noise), *unknown) for seed in range(20)]
    for run in runs:
        assert run.outcomes["associated"] == STEPS // 2 * POINTS
    assert 2.0 < np.mean([run.pose_nees for run in runs]) < 4.2
    assert 1.3 < np.mean([run.landmark_nees for run in runs]) < 2.8


def standing(landmark: Any, seed: int) -> float:
    """Return the mean pose NEES (6) of a robot that stands before a stereo pair."""
    rng, pair, motion = np.random.default_rng(seed), km.sensors.Stereo(), km.motion.Odometry3D(1e-4, 1e-4, 1e-4, 1e-4)
    slam = km.Slam([km.Robot("r", motion, sensors={"pair": km.Mount(pair, at=CAMERA_AT, landmark=landmark)})])
    points = np.column_stack([rng.uniform(4, 14, POINTS), rng.uniform(-3, 3, POINTS), rng.uniform(-2, 2, POINTS)])
    T, N, nees = np.array([0, 0, 0, 0, 0, 0, 1.0]), motion.control_noise(np.zeros(6)), []
    for k in range(100):
        T = motion.move(T, rng.multivariate_normal(np.zeros(6), N), 0.0)[0]
        slam.process(km.Control(0.1 * k, "r", np.zeros(6)))
        v = frames3d.to_frame_many(frames3d.compose(T, CAMERA_AT)[0], points)[0]
        seen, y = np.flatnonzero(pair.sees(v)), pair.expect(v)[0] + rng.normal(size=(POINTS, 4))
        slam.process(km.Scan(0.1 * k, "r", "pair", y[seen], seen.tolist()))
        d = frames3d.minus(slam.mean("r"), T)
        nees.append(d @ np.linalg.solve(slam.covariance("r"), d))
    return float(np.mean(nees))


@pytest.mark.parametrize("landmark", IN_SPACE[:2], ids=lambda kind: kind.kind)
def test_anchored_points_of_a_stereo_pair_that_stands_are_not_corrected_by_parallaxes(landmark: Any) -> None:
    assert 3.5 < np.mean([standing(landmark, seed) for seed in range(5)]) < 9.0
