"""The batch solution in space: equal to dense least squares, and what it says of the filter."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import least_squares

import kalmark as km
from kalmark.batch.batch_state import LANDMARKS, POSES, BatchState
from kalmark.batch.data import replay_events
from kalmark.config import build_slam, load_config, open_config_log
from kalmark.errors import KalmarkError
from kalmark.events import Control, Event, Scan
from kalmark.geometry import frames3d, rotations
from kalmark.geometry.spaces import SE3
from kalmark.results.batch import batch_input, compare_with_filter, solve_batch
from kalmark.results.record import record
from kalmark.results.run import Run

Array = np.ndarray
FORWARD = np.concatenate([[0.1, 0.05, 0.2], rotations.from_euler(np.radians([-90.0, 0.0, -90.0]))[0]])
AT_REST = np.array([0.0, 0, 0, 0, 0, 0, 1])
START = np.concatenate([[1.0, -2.0, 0.5], rotations.exp(np.array([0.1, -0.2, 0.7]))])
TURN = np.array([0.3, 0.05, -0.02, 0.01, -0.03, 0.06])  # one step
SIGMA_U = np.array([0.03, 0.02, 0.02, 0.01, 0.01, 0.01])
ODOMETRY = km.motion.Odometry3D(0.03, 0.02, 0.02, 0.01)
SENSORS = {
    "lidar": km.Mount(km.sensors.Position3D(0.05, 0.05, 0.08), at=AT_REST),
    "camera": km.Mount(km.sensors.PinHole(sigma_px=1.0), at=FORWARD),
    "stereo": km.Mount(
        km.sensors.Stereo(baseline_m=0.5, sigma_ul_px=0.3, sigma_vl_px=0.3, sigma_ur_px=0.3, sigma_vr_px=0.3),
        at=FORWARD,
    ),
    "radar": km.Mount(km.sensors.RangeBearing3D(0.05, 0.02, 0.02), at=AT_REST),
}


def world(rng: np.random.Generator, points: int) -> Array:
    """Return points around the circle that the robot is on."""
    angle, radius = np.linspace(-1.0, 3.0, points), rng.uniform(7, 11, points)
    centre = np.array([0.0, 5.0, 0.0])
    ring = np.column_stack([radius * np.sin(angle), -radius * np.cos(angle), rng.uniform(-3, 3, points)])
    return frames3d.from_frame(START, ring + centre)[0]


def scans(pose: Array, t_s: float, points: Array, names: tuple[str, ...], rng: np.random.Generator) -> list[Event]:
    out: list[Event] = []
    for name in names:
        mount = SENSORS[name]
        v = frames3d.to_frame(frames3d.compose(pose, mount.at)[0], points)[0]
        seen = np.flatnonzero(mount.sensor.sees(v))
        v = v[seen]
        y = mount.sensor.expect(v)[0]
        y = y + np.sqrt(np.diagonal(mount.sensor.noise(y), axis1=1, axis2=2)) * rng.normal(size=y.shape)
        out.append(Scan(t_s, "r", name, y, ids=seen.tolist()))
    return out


def odometry_log(steps: int, points: int, names: tuple[str, ...], seed: int = 3) -> tuple[list[Event], Array, Array]:
    """Return events, points and the true poses."""
    rng = np.random.default_rng(seed)
    landmarks, truth = world(rng, points), [START]
    events: list[Event] = []
    for k in range(steps):
        truth.append(frames3d.move(truth[-1], TURN)[0])
        events.append(Control(k + 1.0, "r", TURN + SIGMA_U * rng.normal(size=6)))
        events += scans(truth[-1], k + 1.0, landmarks, names, rng)
    return events, landmarks, np.array(truth)


def robot(motion: object, names: tuple[str, ...], **more: object) -> km.Robot:
    return km.Robot("r", motion, start=START, sensors={name: SENSORS[name] for name in names}, **more)


def filtered(who: km.Robot, events: list[Event], **more: object) -> Run:
    more = {"association": km.association.ByIdentity(), "landmarks": km.landmarks.Point3D()} | more
    return record(km.Slam([who], **more), events, progress=False, pictures=False)


def dense(events: list[Event], landmarks: Array) -> tuple[Array, Array, Array, float]:
    """Return poses, points, their covariances and chi2 by least squares over the errors of the odometry themselves."""
    controls = [e for e in events if isinstance(e, Control)]
    seen = [e for e in events if isinstance(e, Scan)]
    steps = [frames3d.move(AT_REST, e.u) for e in controls]

    def poses(g: Array) -> Array:
        out = [START]
        for (step, _, S_u), row in zip(steps, g.reshape(-1, 6), strict=True):
            out.append(frames3d.compose(out[-1], frames3d.plus(step, S_u @ (SIGMA_U * row)))[0])
        return np.array(out[1:])

    def residuals(x: Array) -> Array:
        path, points = poses(x[: 6 * len(steps)]), x[6 * len(steps) :].reshape(-1, 3)
        out = [x[: 6 * len(steps)]]
        for scan in seen:
            mount = SENSORS[scan.sensor]
            T = frames3d.compose(path[round(scan.t_s) - 1], mount.at)[0]
            sigma = np.sqrt(np.diagonal(mount.sensor.noise(scan.y), axis1=1, axis2=2))
            out.append(
                ((scan.y - mount.sensor.expect(frames3d.to_frame(T, points[list(scan.ids)])[0])[0]) / sigma).ravel()
            )
        return np.concatenate(out)

    x = np.concatenate([np.zeros(6 * len(steps)), landmarks.ravel()])
    found = least_squares(residuals, x, jac="3-point", x_scale="jac", xtol=1e-15, ftol=1e-15, gtol=1e-12)
    P = np.linalg.inv(found.jac.T @ found.jac)
    at = 6 * len(steps) + 3 * np.arange(len(landmarks))
    blocks = np.array([P[k : k + 3, k : k + 3] for k in at])
    return poses(found.x[: 6 * len(steps)]), found.x[6 * len(steps) :].reshape(-1, 3), blocks, float(2 * found.cost)


def test_odometry_points_and_pixels_equal_dense_least_squares() -> None:
    names = ("lidar", "camera")
    events, landmarks, _ = odometry_log(6, 4, names)
    batch = solve_batch(filtered(robot(ODOMETRY, names), events), events)
    poses, points, P, chi2 = dense(events, landmarks)
    assert batch.ids == [0, 1, 2, 3]
    assert sum(len(e.y) for e in events if isinstance(e, Scan) and e.sensor == "camera") > 4
    np.testing.assert_allclose(batch.means, points, atol=1e-7)
    apart = [frames3d.minus(a, b) for a, b in zip(batch.poses[::2], poses, strict=True)]
    np.testing.assert_allclose(apart, 0, atol=1e-7)
    np.testing.assert_allclose(batch.covariances, P, rtol=1e-4, atol=1e-9)
    assert batch.chi2 == pytest.approx(chi2, rel=1e-7)
    assert batch.dof == sum(e.y.size for e in events if isinstance(e, Scan)) - 4 * 3


def test_the_hessian_in_space_is_the_derivative_of_the_gradient() -> None:
    names = ("lidar", "camera")
    events, *_ = odometry_log(3, 3, names)
    problem = replay_events(batch_input(filtered(robot(ODOMETRY, names), events)), events)
    start = problem.start
    n = len(start.groups[POSES])
    m = 50 * np.random.default_rng(0).normal(size=6 * n)

    def gradient(d: Array) -> Array:
        poses = np.array([SE3.plus(*row) for row in zip(start.groups[POSES], d[: 6 * n].reshape(n, 6), strict=True)])
        points = start.groups[LANDMARKS] + d[6 * n :].reshape(-1, 3)
        at = problem.at(BatchState(start.spaces, (poses, points)))
        return at.J.T @ m - at.H.T @ at.z

    numerical = np.array([(gradient(d) - gradient(-d)) / 2e-5 for d in 1e-5 * np.eye(start.ends[-1])])
    C = problem.hessian(start, m).toarray()
    np.testing.assert_allclose(C, 0.5 * (numerical + numerical.T), atol=1e-5 * np.abs(numerical).max())


@pytest.mark.parametrize("names", [("radar",), ("stereo",)])
def test_filter_and_optimum_agree_in_space(names: tuple[str, ...]) -> None:
    events, *_ = odometry_log(40, 30, names)
    run = filtered(robot(ODOMETRY, names), events)
    figures = run.evaluate(batch=True)["batch"]
    assert 0.95 < figures["sigma_ratio"] < 1.05
    assert figures["map_difference_sigma"] < 0.3
    assert figures["landmarks"] == len(run.landmarks) > 15
    assert figures["chi2_per_dof"] == pytest.approx(1.0, abs=0.2)


def test_points_that_a_camera_started_by_their_inverse_depth_are_euclidean_in_the_optimum() -> None:
    events, landmarks, _ = odometry_log(40, 30, ("camera",))
    run = filtered(robot(ODOMETRY, ("camera",)), events, landmarks=km.landmarks.AnchoredHomogeneous())
    batch = solve_batch(run, events)
    error = batch.means - landmarks[batch.ids]
    d2 = np.einsum("ki,kij,kj->k", error, np.linalg.inv(batch.covariances), error)
    assert d2.max() < 16.3  # 99.9 %
    figures = compare_with_filter(run, batch)
    assert 0.8 < figures["sigma_ratio"] < 1.2
    assert figures["map_difference_sigma"] < 2.0  # a filter of rays is not as near its optimum as one of points


def test_velocities_held_across_scans_share_their_error() -> None:
    rng = np.random.default_rng(4)
    motion = km.motion.Velocity3D(*(5 * SIGMA_U))
    landmarks, pose = world(rng, 30), START
    events: list[Event] = []
    for k in range(20):
        events.append(Control(float(k), "r", TURN + 5 * SIGMA_U * rng.normal(size=6)))
        for part in (0.3, 0.8):
            there = motion.move(pose, TURN, part)[0]
            events += scans(there, k + part, landmarks, ("stereo",), rng)
        pose = motion.move(pose, TURN, 1.0)[0]
    run = filtered(robot(motion, ("stereo",)), events)
    motions = replay_events(batch_input(run), events).motions
    assert abs(motions.Q[6:12, 12:18]).max() > 1e-4
    figures = compare_with_filter(run, solve_batch(run, events))
    assert 0.9 < figures["sigma_ratio"] < 1.1
    assert figures["map_difference_sigma"] < 0.5
    assert figures["chi2_per_dof"] == pytest.approx(1.0, abs=0.2)


def test_what_is_no_pose_and_no_known_mount_is_refused() -> None:
    names = ("lidar",)
    events, *_ = odometry_log(3, 3, names)
    coasting = [e for e in events if isinstance(e, Scan)]
    run = filtered(robot(km.motion.ConstantVelocity3D(), names), coasting)
    with pytest.raises(KalmarkError, match="robot 'r' has 13 state coordinates, expected a pose alone"):
        solve_batch(run, coasting)
    mount = km.Mount(SENSORS["lidar"].sensor, at=AT_REST, cov=1e-4 * np.eye(6))
    run = filtered(km.Robot("r", ODOMETRY, start=START, sensors={"lidar": mount}), events)
    with pytest.raises(KalmarkError, match=r"mount 'r\.lidar' is in the map, expected mounts that are known"):
        solve_batch(run, events)


def test_on_starry_night_the_invariant_filter_ends_near_the_optimum(data: Callable[[str], Path]) -> None:
    data("starry_night")
    config = load_config("starry_night", ["estimator.type=invariant"])
    log = open_config_log(config)
    run = record(build_slam(config, log), log, progress=False, pictures=False)
    figures = run.evaluate(batch=True)["batch"]
    assert figures["path_ratio"] < 1.5
    assert 0.9 < figures["sigma_ratio"] < 1.1
    assert figures["map_difference_sigma"] < 0.5
