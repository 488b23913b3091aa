"""Three dimensions in the filter: models' Jacobians, the compiled seam, gauge about all three axes, consistency."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

import kalmark as km
from kalmark.errors import ModelError
from kalmark.geometry import POINT3, SE3, Space
from kalmark.geometry.rotations import exp, log, matrix, multiply
from kalmark.geometry.spaces import ROTATION, SCALAR, VECTOR3
from kalmark.models.observe import expectation, inverse_expectation, linearize, view_of

SENSORS = [km.sensors.RangeBearing3D(), km.sensors.Position3D()]
ESTIMATORS = [km.estimators.Invariant(), km.estimators.Ekf(), km.estimators.Fej()]
NAVIGATION = Space("navigation", (VECTOR3, ROTATION, VECTOR3, SCALAR))


def pose(rng: np.random.Generator, spread: float = 5.0) -> np.ndarray:
    return np.concatenate([rng.normal(size=3) * spread, exp(rng.normal(size=3) * 1.5)])


def difference(function: Any, space: Space, x: np.ndarray, angular: tuple[bool, ...] = ()) -> np.ndarray:
    """Return d function / d error of x by central differences; the function's values are plain or poses."""
    columns = []
    for d in np.eye(space.dof) * 1e-6:
        high, low = function(space.plus(x, d)), function(space.plus(x, -d))
        rise = SE3.minus(high, low) if len(high) == 7 else high - low
        columns.append((km.geometry.wrap(rise) if any(angular) else rise) / 2e-6)
    return np.stack(columns, axis=-1)


def close(analytic: np.ndarray, numeric: np.ndarray) -> None:
    np.testing.assert_allclose(analytic, numeric, rtol=1e-5, atol=1e-6 * (1 + np.abs(numeric).max()))


@pytest.mark.parametrize("space", [SE3, POINT3, NAVIGATION], ids=lambda s: s.name)
def test_a_spatial_space_has_plus_minus_and_a_generator(space: Space) -> None:
    rng = np.random.default_rng(1)
    for _ in range(50):
        x = rng.normal(size=space.size)
        if ROTATION in space.kinds:
            x[3:7] /= np.linalg.norm(x[3:7])
        d = rng.uniform(-1.5, 1.5, size=space.dof)  # a rotation vector shorter than pi
        np.testing.assert_allclose(space.minus(space.plus(x, d), x), d, atol=1e-12)
        for axis, e in enumerate(np.eye(3) * 1e-6):
            slope = space.minus(space.rotated(x, e), space.rotated(x, -e)) / 2e-6
            np.testing.assert_allclose(space.generator(x)[:, axis], slope, atol=1e-8)


def test_odometry_in_space_has_the_jacobians_of_its_differences() -> None:
    rng, odometry = np.random.default_rng(2), km.motion.Odometry3D()
    for i in range(200):
        r, u = pose(rng), rng.normal(size=6) * 10.0 ** -(i % 9)
        _, R_r, R_u = odometry.move(r, u, 0.0)
        close(R_r, difference(lambda x, u=u: odometry.move(x, u, 0.0)[0], SE3, r))
        close(R_u, difference(lambda x, r=r: odometry.move(r, x, 0.0)[0], km.geometry.Rn(6), u))


@pytest.mark.parametrize("sensor", SENSORS, ids=lambda s: type(s).__name__)
def test_a_spatial_sensor_has_the_jacobians_of_its_differences_and_undoes_itself(sensor: Any) -> None:
    rng, landmark = np.random.default_rng(3), km.landmarks.Point3D()
    for _ in range(200):
        r, s, l = pose(rng), pose(rng, 0.5), rng.normal(size=(1, 3)) * 10
        e, E_r, E_s, E_l = expectation(r, s, sensor, landmark, l)
        close(E_r[0], difference(lambda x: expectation(x, s, sensor, landmark, l)[0][0], SE3, r, sensor.angular))
        close(E_s[0], difference(lambda x: expectation(r, x, sensor, landmark, l)[0][0], SE3, s, sensor.angular))
        close(
            E_l[0],
            difference(lambda x: expectation(r, s, sensor, landmark, x[None])[0][0], POINT3, l[0], sensor.angular),
        )
        back, L_r, _, L_y, _ = inverse_expectation(r, s, sensor, landmark, e)
        np.testing.assert_allclose(back, l, atol=1e-9)
        close(L_r[0], difference(lambda x: inverse_expectation(x, s, sensor, landmark, e)[0][0], SE3, r))
        close(L_y[0] @ E_l[0], np.eye(3))
        view = view_of(sensor, landmark, s)
        assert isinstance(view, tuple), "built-in models take the compiled way"
        seen, z, *Jacobians = linearize(view, r, l, e)
        np.testing.assert_allclose(z, 0, atol=1e-12)
        for fast, written in zip((seen, *Jacobians), (e, E_r, E_l), strict=True):
            np.testing.assert_allclose(fast, written, atol=1e-12)


WORLD = np.random.default_rng(0).uniform([-8, -8, -3], [8, 8, 3], (12, 3))
MOUNT = np.concatenate([[0.2, -0.1, 0.3], exp(np.array([0.3, -0.2, 1.0]))])
U = np.array([0.1, 0.0, 0.02, 0.01, -0.02, 0.05])
SIGMAS = np.array([0.01, 0.01, 0.01, 0.005, 0.005, 0.005])
NOISE = np.array([0.1, 0.02, 0.02])


def robot(cov: Any = None, start: Any = None) -> km.Robot:
    lidar = km.Mount(km.sensors.RangeBearing3D(*NOISE), MOUNT)
    return km.Robot("r", km.motion.Odometry3D(0.01, 0.01, 0.01, 0.005), start, {"lidar": lidar}, cov)


def observations(truth: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    y = expectation(truth, MOUNT, km.sensors.RangeBearing3D(), km.landmarks.Point3D(), WORLD)[0]
    return y + rng.normal(size=y.shape) * NOISE


def drive(slam: km.Slam, steps: int, seed: int, truth: np.ndarray) -> np.ndarray:
    rng, odometry = np.random.default_rng(seed), km.motion.Odometry3D()
    for t in range(1, steps + 1):
        truth = odometry.move(truth, U, 0.0)[0]
        slam.process(km.Control(t, "r", U + rng.normal(size=6) * SIGMAS))
        slam.process(km.Scan(t, "r", "lidar", observations(truth, rng), range(12)))
    return truth


ORIGIN = np.array([0.0, 0, 0, 0, 0, 0, 1])


@pytest.mark.parametrize(("estimator", "learns"), [*zip(ESTIMATORS, (False, True, False), strict=True)])
def test_a_robot_that_stands_still_in_space_learns_nothing_of_its_orientation(estimator: Any, learns: bool) -> None:
    rng, truth = np.random.default_rng(4), np.concatenate([[0.2, -0.3, 0.1], exp(np.array([0.1, 0.2, -0.15]))])
    prior = np.diag([0.5, 0.5, 0.5, *np.radians([20, 20, 20])]) ** 2
    slam = km.Slam([robot(prior)], km.association.ByIdentity("off"), estimator)
    for t in range(100):
        slam.process(km.Scan(t, "r", "lidar", observations(truth, rng), range(12)))
    sigmas = np.degrees(np.sqrt(np.diag(slam.covariance("r"))[3:]))
    if learns:
        assert sigmas.min() < 15
    else:
        np.testing.assert_allclose(sigmas, 20, atol=1e-6)


def test_an_uncertain_start_in_space_leaves_the_map_relative_to_the_robot_as_it_is() -> None:
    maps = []
    for cov in (None, np.diag([0.5, 0.5, 0.5, *np.radians([20, 20, 20])]) ** 2):
        slam = km.Slam([robot(cov)], estimator=km.estimators.Invariant(tolerance=1e-9))
        drive(slam, 60, 5, ORIGIN)
        r = slam.mean("r")
        maps.append(np.array([matrix(r[3:]).T @ (slam.mean(i) - r[:3]) for i in range(12)]))
    np.testing.assert_allclose(maps[0], maps[1], atol=1e-9)


def test_rotating_the_world_rotates_the_estimate_about_any_axis() -> None:
    turn = exp(np.array([0.7, -1.1, 0.4]))
    a, b = km.Slam([robot()]), km.Slam([robot(start=np.concatenate([np.zeros(3), turn]))])
    for slam, start in ((a, ORIGIN), (b, ORIGIN)):
        drive(slam, 40, 6, start)  # the same controls and observations: they are in the robot's frame
    Q = matrix(turn)
    for i in range(12):
        np.testing.assert_allclose(Q @ a.mean(i), b.mean(i), atol=1e-9)
        np.testing.assert_allclose(Q @ a.covariance(i) @ Q.T, b.covariance(i), atol=1e-9)
    np.testing.assert_allclose(
        log(multiply(b.mean("r")[3:], multiply(turn, a.mean("r")[3:]) * [-1, -1, -1, 1])), 0, atol=1e-9
    )


@pytest.mark.parametrize("estimator", ESTIMATORS, ids=lambda e: type(e).__name__)
def test_the_pose_in_space_is_as_certain_as_it_says(estimator: Any) -> None:
    nees = []
    for seed in range(12):
        slam = km.Slam([robot()], km.association.ByIdentity("off"), estimator)
        truth = drive(slam, 100, 100 + seed, ORIGIN)
        d = SE3.minus(truth, slam.mean("r"))
        nees.append(d @ np.linalg.solve(slam.covariance("r"), d))
    limit = 9.5 if not isinstance(estimator, km.estimators.Ekf) else 60
    assert 3.0 < np.mean(nees) < limit


def test_a_fix_in_space_and_a_saved_map(tmp_path: Any) -> None:
    slam = km.Slam([robot(np.eye(6) * 0.01)])
    drive(slam, 5, 8, ORIGIN)
    slam.process(km.Fix(5, "r", slam.mean("r")[:3] + 0.1, 1e-6 * np.eye(3)))
    slam.save(tmp_path / "map.kmk")
    again = km.Slam.load(tmp_path / "map.kmk")
    assert again.covariance("r", 3).tobytes() == slam.covariance("r", 3).tobytes()
    assert again.mean("r").tobytes() == slam.mean("r").tobytes()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: km.Robot("r", km.motion.Odometry3D(), (0, 0, 0)), "seven finite numbers"),
        (lambda: km.Robot("r", km.motion.Odometry3D(), (0, 0, 0, 0, 0, 0, 2)), "unit quaternion"),
        (
            lambda: km.Robot("r", km.motion.Unicycle(), sensors={"l": km.Mount(SENSORS[0], MOUNT)}),
            "three finite numbers",
        ),
    ],
)
def test_a_mixture_of_plane_and_space_is_refused(make: Any, message: str) -> None:
    with pytest.raises(ModelError, match=message):
        make()


@dataclass(frozen=True)
class Drone:
    """A body rate held until the next control, with a diffusion along its own x."""

    space: Space = SE3
    columns: tuple[str, ...] = ("v_mps", "w_radps")
    held: bool = True

    def move(self, r: np.ndarray, u: np.ndarray, dt_s: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        pick = np.zeros((6, 2))
        pick[0, 0] = pick[5, 1] = dt_s
        moved, R_r, R_u = km.geometry.frames3d.move(r, pick @ u)
        return moved, R_r, R_u @ pick

    def control_noise(self, u: np.ndarray) -> np.ndarray:
        return np.diag([0.1, 0.0]) ** 2

    def diffusion(self, u: np.ndarray, dt_s: float) -> np.ndarray:
        return np.diag([0.04, 0, 0, 0, 0, 0]) * dt_s


def test_a_users_held_control_in_space_is_split_by_scans_and_diffuses_along_the_body() -> None:
    up = np.concatenate([np.zeros(3), exp(np.array([0, -np.pi / 2, 0]))])  # x looks up
    whole, split = (km.Slam([km.Robot("d", Drone(), up, {"l": km.Mount(SENSORS[1])})]) for _ in range(2))
    for slam, times in ((whole, []), (split, [0.3, 0.8])):
        slam.process(km.Control(0, "d", (1.0, 0.0)))
        for t in times:
            slam.process(km.Scan(t, "d", "l", np.zeros((0, 3))))
        slam.process(km.Control(1, "d", (0.0, 0.0)))
    np.testing.assert_allclose(whole.mean("d")[:3], [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(split.covariance("d"), whole.covariance("d"), atol=1e-15)
    np.testing.assert_allclose(np.diag(whole.covariance("d"))[:3], [0, 0, 0.04 + 0.1**2], atol=1e-12)


def planar(**arguments: Any) -> km.Robot:
    return km.Robot("p", km.motion.Unicycle(), **arguments)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: km.Slam([robot(), planar()]), "robot 'p' is of the plane, expected one of the space"),
        (lambda: km.Slam([planar(), robot()]), "robot 'r' is of the space, expected one of the plane"),
        (lambda: km.Slam([planar(sensors={"l": km.Mount(SENSORS[0])})]), "RangeBearing3D is of the space"),
        (
            lambda: km.Slam([km.Robot("r", km.motion.Odometry3D(), sensors={"l": km.Mount(km.sensors.Bearing())})]),
            "Bearing is of the plane",
        ),
        (
            lambda: km.Slam(
                [planar(sensors={"l": km.Mount(km.sensors.RangeBearingSignature(), landmark=km.landmarks.Point3D())})]
            ),
            "point3 is of the space",
        ),
        (
            lambda: km.Slam([planar()]).add_landmark(1, (0, 0, 0), landmark=km.landmarks.Point3D()),
            "point3 is of the space",
        ),
    ],
)
def test_what_lives_in_the_plane_is_kept_out_of_space(make: Any, message: str) -> None:
    with pytest.raises(ModelError, match=message):
        make()
