"""Inertial units: the exact motion and its Jacobians, the noise of a data sheet, the group of extended poses."""

from __future__ import annotations

import gzip
from typing import Any

import numpy as np
import pytest

import kalmark as km
from kalmark.filter.prediction import noise_in_world
from kalmark.geometry.rotations import exp, matrix, multiply
from kalmark.geometry.spaces import ROTATION, Space
from kalmark.models.inertial import inertial_noise, second_integral, second_integral_rate
from kalmark.models.model_check import check_model
from kalmark.models.observe import step, step_of

Array = np.ndarray[Any, np.dtype[np.float64]]
MOTIONS: list[Any] = [km.motion.Inertial(), km.motion.InertialGravity()]
SIGMAS = (0.01, 0.002, 0.05, 0.004)  # larger than those of a data sheet: what each does shows


def named(motion: Any) -> str:
    return type(motion).__name__


def drawn(space: Space, rng: np.random.Generator) -> Array:
    origin = np.zeros(space.size)
    origin[6] = 1.0
    return space.plus(origin, rng.normal(size=space.dof))


@pytest.mark.parametrize("motion", MOTIONS, ids=named)
def test_the_jacobians_are_those_of_differences(motion: Any) -> None:
    findings = check_model(motion, np.random.default_rng(0))
    assert {"R_r", "R_u", "diffusion is a covariance"} <= {one.what for one in findings}
    assert max(one.error for one in findings) < 1e-6


@pytest.mark.parametrize("motion", MOTIONS, ids=named)
def test_the_compiled_step_is_the_written_one(motion: Any) -> None:
    rng, model = np.random.default_rng(1), step_of(motion)
    assert isinstance(model, tuple), "built-in models take the compiled way"
    for _ in range(10):
        r, u = drawn(motion.space, rng), rng.normal(size=6)
        for ours, written in zip(step(model, r, u, 0.01), motion.move(r, u, 0.01), strict=True):
            np.testing.assert_array_equal(ours, written)


@pytest.mark.parametrize("angle", [1e-9, 1e-3, 0.1, 0.499, 0.501, 3.0, 20.0])
def test_the_second_integral_of_a_rotation_is_that_of_quadrature(angle: float) -> None:
    """And its rate that of differences, on both sides of where its series ends."""
    rng = np.random.default_rng(2)
    v, a = angle * np.array([0.6, -0.48, 0.64]), rng.normal(size=3)
    s, w = np.polynomial.legendre.leggauss(40)
    s, w = 0.5 * s + 0.5, 0.5 * w
    found = sum(w_k * (1 - s_k) * matrix(exp(s_k * v)) for s_k, w_k in zip(s, w, strict=True))
    np.testing.assert_allclose(second_integral(v), found, atol=1e-13)
    h = 1e-4
    far = [[second_integral(v + k * h * d) @ a for k in (-2, -1, 1, 2)] for d in np.eye(3)]
    rate = np.column_stack([(8 * (f[2] - f[1]) - (f[3] - f[0])) / (12 * h) for f in far])
    np.testing.assert_allclose(second_integral_rate(v, a), rate, atol=1e-10)


def test_a_step_is_the_integral_of_rate_and_force() -> None:
    """The motion of many small steps of Euler's, extrapolated to none."""
    motion, rng, dt = km.motion.Inertial(), np.random.default_rng(3), 0.5
    r, u = drawn(motion.space, rng), rng.normal(size=6) * 2

    def euler(n: int) -> Array:
        p, q, v, h = r[:3].copy(), r[3:7].copy(), r[7:10].copy(), dt / n
        for _ in range(n):
            middle = matrix(multiply(q, exp((u[:3] - r[10:13]) * 0.5 * h)))
            a = middle @ (u[3:] - r[13:16]) - [0, 0, 9.81]
            p, v = p + h * v + 0.5 * h * h * a, v + h * a
            q = multiply(q, exp((u[:3] - r[10:13]) * h))
        return np.concatenate([p, q, v])

    coarse, fine = euler(1000), euler(2000)
    np.testing.assert_allclose(motion.move(r, u, dt)[0][:10], fine + (fine - coarse) / 3, atol=1e-9)


def test_an_accelerometer_at_rest_reads_gravity_upwards() -> None:
    motion = km.motion.Inertial(gravity_mps2=9.8)
    r = np.array([1.0, 2, 3, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0])
    np.testing.assert_allclose(motion.move(r, np.array([0, 0, 0, 0, 0, 9.8]), 3.0)[0], r, atol=1e-12)


@pytest.mark.parametrize("motion", MOTIONS, ids=named)
def test_the_step_moves_in_two_parts_as_in_one(motion: Any) -> None:
    rng = np.random.default_rng(4)
    for _ in range(10):
        r, u = drawn(motion.space, rng), rng.normal(size=6)
        apart = motion.move(motion.move(r, u, 0.3)[0], u, 0.7)[0]
        np.testing.assert_allclose(motion.space.minus(apart, motion.move(r, u, 1.0)[0]), 0.0, atol=1e-12)


def gathered(motion: Any, r: Array, u: Array, dt_s: float, parts: int) -> Array:
    """Return the covariance (dof, dof) after `dt_s`, as the filter predicts it in so many parts."""
    P = np.zeros((motion.space.dof,) * 2)
    for _ in range(parts):
        D = motion.diffusion_at(r, u, dt_s / parts)
        r, R_r, _ = motion.move(r, u, dt_s / parts)
        P = R_r @ P @ R_r.T + noise_in_world(r, D)
    return P


@pytest.mark.parametrize("kind", [km.motion.Inertial, km.motion.InertialGravity])
def test_the_noise_does_not_depend_on_how_the_time_is_divided(kind: Any) -> None:
    motion, rng = kind(*SIGMAS), np.random.default_rng(5)
    r, u = drawn(motion.space, rng), rng.normal(size=6)
    np.testing.assert_allclose(gathered(motion, r, u, 0.4, 9), gathered(motion, r, u, 0.4, 1), atol=1e-13)


def test_the_noise_is_that_of_the_textbook_over_a_short_time() -> None:
    """Kalibr's wiki, "IMU noise model": sigma / sqrt(dt) is the noise of a reading, sigma sqrt(dt) the walk's step."""
    motion, rng, dt = km.motion.Inertial(*SIGMAS), np.random.default_rng(6), 1e-4
    gyro, gyro_walk, force, force_walk = SIGMAS
    r, u = drawn(motion.space, rng), rng.normal(size=6)
    D, R_u = noise_in_world(motion.move(r, u, dt)[0], motion.diffusion_at(r, u, dt)), motion.move(r, u, dt)[2]
    N = np.diag(np.repeat([gyro**2 / dt, force**2 / dt], 3))
    textbook = R_u @ N @ R_u.T
    np.testing.assert_allclose(D[3:9, 3:9], textbook[3:9, 3:9], atol=2e-4 * textbook[3:9, 3:9].max())
    walks = np.repeat([gyro_walk**2 * dt, force_walk**2 * dt], 3)
    np.testing.assert_allclose(D[9:, 9:], np.diag(walks), atol=1e-18)


def test_a_unit_that_stands_gathers_the_covariance_of_its_random_walks() -> None:
    """Closed forms: the way of white accelerations sigma^2 t^3 / 3, of a walking bias sigma^2 t^5 / 20."""
    _, _, force, walk = SIGMAS
    D = inertial_noise(np.zeros(3), np.zeros(3), np.repeat(np.square([0.0, force, 0.0, walk]), 3), 2.0, 15)
    np.testing.assert_allclose(D[:3, :3], np.eye(3) * (force**2 * 2**3 / 3 + walk**2 * 2**5 / 20), rtol=1e-12)
    np.testing.assert_allclose(D[6:9, 6:9], np.eye(3) * (force**2 * 2 + walk**2 * 2**3 / 3), rtol=1e-12)
    np.testing.assert_allclose(D[:3, 12:], -np.eye(3) * walk**2 * 2**3 / 6, rtol=1e-12)


# ---------------------------------------------------------------------- the group of extended poses
def turning(space: Space, r: Array) -> Array:
    """Return d / xi (dof, dof): errors d of a state r by the right-invariant ones, d = xi + generator d_theta."""
    theta = next(k for kind, _, k in space.atoms if kind == ROTATION)
    T = np.eye(space.dof)
    T[:, theta : theta + 3] = space.generator(r)
    return T


@pytest.mark.parametrize("motion", MOTIONS, ids=named)
def test_in_invariant_errors_the_jacobian_depends_on_no_pose_and_no_velocity(motion: Any) -> None:
    """Barrau and Bonnabel 2017: the motion is group affine, but for the biases."""
    rng, dt, found = np.random.default_rng(7), 0.3, []
    u, biases = rng.normal(size=6), rng.normal(size=6)
    for _ in range(3):
        r = drawn(motion.space, rng)
        r[10:16], r[16:] = biases, [0.1, -0.2, -9.8][: len(r) - 16]
        moved, R_r, _ = motion.move(r, u, dt)
        F = np.linalg.solve(turning(motion.space, moved), R_r @ turning(motion.space, r))
        found.append(np.delete(F, range(9, 15), axis=1))
    np.testing.assert_allclose(found[1], found[0], atol=1e-12)
    np.testing.assert_allclose(found[2], found[0], atol=1e-12)


@pytest.mark.parametrize("motion", MOTIONS, ids=named)
def test_what_is_unobservable_before_a_step_is_unobservable_after_it(motion: Any) -> None:
    """A shift, and a turn about the gravity; with the gravity in the state a turn about any axis."""
    rng = np.random.default_rng(8)
    for _ in range(5):
        r = drawn(motion.space, rng)
        moved, R_r, _ = motion.move(r, rng.normal(size=6), 0.3)
        shift = np.eye(motion.space.dof)[:, :3]
        np.testing.assert_allclose(R_r @ shift, shift, atol=1e-14)
        axes = slice(None) if motion.space.dof == 18 else slice(2, 3)
        turns = R_r @ motion.space.generator(r)[:, axes]
        np.testing.assert_allclose(turns, motion.space.generator(moved)[:, axes], atol=1e-12)


# ---------------------------------------------------------------------- at rest
SHEET = (1.7e-4, 2.0e-5, 2.0e-3, 3.0e-4)


def readings(motion: Any, truth: Array, seconds: float, rng: np.random.Generator) -> tuple[Array, Array]:
    """Return times (N,) and readings (N, 6) at 200 Hz of a unit at rest whose biases end at those of the truth."""
    n, dt = round(seconds * 200), 1 / 200
    white, walk = motion.densities[:6] / np.sqrt(dt), motion.densities[6:] * np.sqrt(dt)
    steps = rng.normal(size=(n, 6)) * walk
    biases = truth[10:16] - np.cumsum(steps[::-1], axis=0)[::-1] + steps
    g = truth[16:] if len(truth) > 16 else np.array([0.0, 0.0, -9.81])
    f = -matrix(truth[3:7].copy()).T @ g
    u: Array = np.concatenate([np.zeros(3), f]) + biases + rng.normal(size=(n, 6)) * white
    t: Array = np.arange(n) * dt
    return t, u


@pytest.mark.parametrize("kind", [km.motion.Inertial, km.motion.InertialGravity])
@pytest.mark.parametrize("seconds", [1.0, 6.0])
def test_a_start_at_rest_is_as_far_from_the_truth_as_it_says(kind: Any, seconds: float) -> None:
    motion, rng, values = kind(*SHEET), np.random.default_rng(9), []
    dof = motion.space.dof
    known = np.zeros(dof)
    known[3 if dof == 18 else 5 : 6] = 0.002  # the attitude, or the heading alone
    known[9:12], known[12:15] = 0.01, 0.05
    free = np.array([*range(3, 6), *range(9, 15), *range(15, dof)][:11])  # the gravity's length is known
    for _ in range(200):
        start = np.zeros(motion.space.size)
        start[3:7] = exp(np.array([0.0, 0.0, 0.5]))
        if dof == 18:  # a vertical that nobody knows
            start[3:7], g = exp(rng.normal(size=3)), matrix(exp(np.array([0.3, -0.4, 0.0]))) @ [0, 0, -9.81]
            start[16:] = g
        error = rng.normal(size=dof) * known
        truth = motion.space.plus(start, error)
        if dof == 15:  # tilted, a little or a lot
            heading = exp(np.array([0.0, 0.0, 0.5 + error[5]]))
            tilt = np.append(rng.normal(size=2) * 0.3, 0.0)
            truth[3:7] = multiply(heading, exp(tilt))
            start[3:7] = multiply(exp(np.array([0.0, 0.0, -error[5]])), truth[3:7])
        found = km.motion.start_at_rest(motion, *readings(motion, truth, seconds, rng), start, np.diag(known**2))
        assert found.until_s >= 0.8 * seconds - 0.2
        d = motion.space.minus(truth, found.start)
        P = found.cov[np.ix_(free, free)]
        values.append(float(d[free] @ np.linalg.solve(P, d[free])))
    assert abs(np.mean(values) - len(free)) < 5 * np.sqrt(2 * len(free) / len(values))


def test_the_start_of_euroc_s_drone_is_found_with_its_motors_on(data: Any) -> None:
    """V1_01 stands for some 5 s and shakes; the biases of its truth are those of a visual-inertial solution."""
    folder, motion = data("visual/euroc_v101_micro"), km.motion.Inertial(1.6968e-4, 1.9393e-5, 2.0e-3, 3.0e-3)
    with gzip.open(folder / "mav0" / "imu0" / "data.csv.gz", "rt") as file:
        rows = [line.split(",") for line in file.readlines()[1:3001]]
    u = np.array([[float(cell) for cell in row[1:]] for row in rows])
    true = np.array((folder / "gt_V1_01_easy.csv").read_text().splitlines()[1].split(",")[1:], dtype=float)
    truth = true[[0, 1, 2, 4, 5, 6, 3, *range(7, 16)]]
    start = np.append(truth[:7], np.zeros(9))
    prior = np.diag(np.square(np.repeat([0.0, 0.01, 0.0, 0.1, 0.1], 3)))
    found = km.motion.start_at_rest(motion, np.arange(len(u)) / 200, u, start, prior)
    assert 4.0 < found.until_s < 5.2
    d, sigmas = motion.space.minus(truth, found.start), np.sqrt(np.diag(found.cov))
    assert (np.abs(d[9:12]) < 4 * sigmas[9:12]).all(), "the truth is 100 times as far from no bias"
    assert (np.abs(d[[3, 4, 12, 13, 14]]) < 2 * sigmas[[3, 4, 12, 13, 14]]).all()


@pytest.mark.parametrize(
    ("change", "what"),
    [
        (lambda u: u + np.array([0.1, 0, 0, 0, 0, 0]), "the unit begins with [0.0997"),
        (lambda u: u + np.array([0, 0, 0, 0, 0, 0.6]), "expected it at rest for 0.5 s"),
        (lambda u: u + np.linspace(0, 5, len(u))[:, None] * [0, 0, 0, 1, 0, 0], "expected it at rest for 0.5 s"),
        (lambda u: u[:60], "there are 60 readings"),
    ],
)
def test_a_unit_that_does_not_begin_at_rest_is_refused(change: Any, what: str) -> None:
    motion, start = km.motion.Inertial(*SHEET), np.zeros(16)
    start[6] = 1.0
    cov = np.diag(np.repeat([0, 0, 0, 1e-4, 0.0025], 3))
    t, u = readings(motion, start, 2.0, np.random.default_rng(10))
    u = change(u)
    with pytest.raises(km.KalmarkError) as refused:
        km.motion.start_at_rest(motion, t[: len(u)], u, start, cov)
    assert what in str(refused.value)


def test_the_rest_ends_before_the_motion_begins() -> None:
    motion, start = km.motion.Inertial(*SHEET), np.zeros(16)
    start[6] = 1.0
    cov = np.diag(np.repeat([0, 0, 0, 1e-4, 0.0025], 3))
    t, u = readings(motion, start, 5.0, np.random.default_rng(11))
    u[600:, 3] += 0.5 * (t[600:] - 3.0)  # from 3 s on it accelerates
    found = km.motion.start_at_rest(motion, t, u, start, cov)
    assert 2.5 < found.until_s < 3.0


@pytest.mark.parametrize("motion", MOTIONS, ids=named)
def test_the_velocity_under_a_reading_is_that_at_which_the_unit_moves(motion: Any) -> None:
    """The velocity is the state's, whatever the reading; the turn rate is the reading's, less the bias."""
    rng, dt, pose = np.random.default_rng(12), 1e-6, km.geometry.SE3
    for _ in range(20):
        r, u = drawn(motion.space, rng), rng.normal(0, 1, 6)
        way = pose.minus(motion.move(r, u, dt)[0][:7], r[:7]) / dt
        Q_t = matrix(r[3:7]).T
        np.testing.assert_allclose(np.kron(np.eye(2), Q_t) @ way, motion.body_velocity_under(r, u)[0], atol=1e-4)
        at_rest = motion.body_velocity_under(r, np.full(6, np.nan))[0]
        np.testing.assert_array_equal(at_rest[3:], 0.0)


def test_a_unit_that_shakes_shows_its_noise_and_not_the_motion_of_its_vehicle_or_the_hum_of_a_motor() -> None:
    rng, t = np.random.default_rng(4), np.arange(1200) / 200.0
    density = np.repeat([0.002, 0.03], 3)
    white = rng.normal(size=(1200, 6)) * density * np.sqrt(200.0)
    moved = np.sin(2 * np.pi * 1.5 * t)[:, None] * [1.0, 0.5, 2.0, 3.0, 1.0, 2.0]
    hum = 0.5 * np.sin(2 * np.pi * 73.0 * t)[:, None] * np.ones(6)
    assert km.motion.noise_densities(t, white + moved + hum) == pytest.approx((0.002, 0.03), rel=0.15)
    assert max(km.motion.noise_densities(t, moved)) < 1e-3
    assert km.motion.noise_densities(t[:200], white[:200]) == (0.0, 0.0)  # too few
