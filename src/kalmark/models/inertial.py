"""Inertial units: angular rate and specific force drive pose, velocity and the biases of both.

The state is that of Barrau and Bonnabel's extended poses, SE2(3), with the biases behind it: the "imperfect" invariant
filter of Hartley, Ghaffari, Eustice and Grizzle, Contact-aided invariant extended Kalman filtering, 2020.  Rate and
force are held from one reading to the next, and the motion is integrated exactly for that.  docs/inertial.md.
"""

from __future__ import annotations

import math
from functools import cached_property
from typing import Annotated, Any, ClassVar, NamedTuple

import numpy as np

from kalmark.arrays import Array
from kalmark.compiled import compiled
from kalmark.declare import NotNegative, Positive, register
from kalmark.errors import ModelError
from kalmark.geometry.rotations import (
    exp,
    left_jacobian,
    left_jacobian_rate,
    matrix,
    multiply,
    skew,
)
from kalmark.geometry.spaces import OWN, ROTATION, SCALAR, VECTOR3, Space
from kalmark.models.kinematics import NODES, WEIGHTS, MotionModel

GRAVITY = 16  # where the gravity begins in a state that has it
INERTIAL_DOF = 15  # of one that has none
WINDOW_S, WINDOWS = 0.1, 5  # of readings that are compared, and how many of them at least are at rest
SIGMAS = 5.0  # by which a window at rest may differ from the mean of those before it
SPECTRUM, BAND_HZ = 128, 10.0  # readings, whose spectrum is taken; what is slower may be the motion of the vehicle
SHAKEN = 100.0  # times the noise of the data sheet that readings at rest may scatter by: motors run


@compiled
def second_integral(v: Array) -> Array:
    """Return W(v) (3, 3), the integral of (1 - s) Exp(s v) for s from 0 to 1: I / 2 + b [v]x + c [v]x^2."""
    b, c = _integrals(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])[:2]
    X = skew(v)
    return 0.5 * np.eye(3) + b * X + c * (X @ X)


@compiled
def second_integral_rate(v: Array, a: Array) -> Array:
    """Return d (W(v) a) / d v (3, 3)."""
    b, c, b_2, c_2 = _integrals(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
    d = np.cross(v, a)
    rate = np.outer(b_2 * d + c_2 * np.cross(v, d), 2.0 * v)
    return rate - b * skew(a) - c * (skew(d) + skew(v) @ skew(a))


@compiled
def _integrals(t2: float) -> tuple[float, float, float, float]:
    """Return b and c of `second_integral` for an angle whose square is t2, and their derivatives in t2."""
    if t2 < 0.25:  # the series, to the last digit
        b = 1 / 6 - t2 * (1 / 120 - t2 * (1 / 5040 - t2 * (1 / 362880 - t2 * (1 / 39916800 - t2 / 6227020800))))
        c = 1 / 24 - t2 * (1 / 720 - t2 * (1 / 40320 - t2 * (1 / 3628800 - t2 * (1 / 479001600 - t2 / 87178291200))))
        b_2 = -1 / 120 + t2 * (1 / 2520 - t2 * (1 / 120960 - t2 * (1 / 9979200 - t2 / 1245404160)))
        c_2 = -1 / 720 + t2 * (1 / 20160 - t2 * (1 / 1209600 - t2 * (1 / 119750400 - t2 / 17435658240)))
        return b, c, b_2, c_2
    t = math.sqrt(t2)
    half = math.sin(0.5 * t)
    b = (t - math.sin(t)) / (t2 * t)
    c = (0.5 - 2.0 * half * half / t2) / t2
    b_2 = half * half / (t2 * t2) - 1.5 * b / t2
    c_2 = (0.5 * b - 2.0 * c) / t2
    return b, c, b_2, c_2


@compiled
def inertial(r: Array, u: Array, par: Array, dt: float) -> tuple[Array, Array, Array]:
    """Move r (16 or 19,) for dt s by a rate and a specific force u (6,) in the robot's frame; R_r (dof, dof), R_u.

    r is the pose, the velocity in the world, the biases of rate and force and, if it has 19 numbers, the gravity in
    the world; else that is `par` = (g,) downwards.  R_u is (dof, 6).
    """
    dof = len(r) - 1
    turn, f = (u[:3] - r[10:13]) * dt, u[3:] - r[13:16]
    Q, V, W = matrix(r[3:7]), left_jacobian(turn), second_integral(turn)
    g = np.array([0.0, 0.0, -par[0]])
    if len(r) > GRAVITY:
        g = r[GRAVITY:].copy()
    step, change = Q @ (W @ f) * dt * dt, Q @ (V @ f) * dt
    moved = r.copy()
    moved[:3] = r[:3] + r[7:10] * dt + step + g * (0.5 * dt * dt)
    moved[3:7] = multiply(r[3:7], exp(turn))
    moved[7:10] = r[7:10] + change + g * dt
    R_r, R_u = np.eye(dof), np.zeros((dof, 6))
    R_r[:3, 3:6], R_r[6:9, 3:6] = -skew(step), -skew(change)
    R_u[:3, :3], R_u[:3, 3:] = Q @ second_integral_rate(turn, f) * dt**3, Q @ W * dt * dt
    R_u[3:6, :3] = Q @ V * dt
    R_u[6:9, :3], R_u[6:9, 3:] = Q @ left_jacobian_rate(turn, f) * dt * dt, Q @ V * dt
    for i in range(dof):
        for j in range(6):
            R_r[i, 9 + j] -= R_u[i, j]
    for i in range(3):
        R_r[i, 6 + i] = dt
        if dof > 15:
            R_r[i, 15 + i], R_r[6 + i, 15 + i] = 0.5 * dt * dt, dt
    return moved, R_r, R_u


@compiled
def inertial_velocity(r: Array, u: Array) -> tuple[Array, Array]:
    """Return the velocity (v, w) of a state r (16 or 19,) in the robot's frame (6,), and its Jacobian (6, dof).

    w is that of the reading in force u (6,) less the bias; its white noise is left out.  Of NaN it is zero.
    """
    Q_t, b, B_r = np.ascontiguousarray(matrix(r[3:7]).T), np.zeros(6), np.zeros((6, len(r) - 1))
    b[:3] = Q_t @ r[7:10]
    B_r[:3, 3:6], B_r[:3, 6:9] = Q_t @ skew(r[7:10]), Q_t
    for i in range(0 if np.isnan(u[0]) else 3):
        b[3 + i], B_r[3 + i, 9 + i] = u[i] - r[10 + i], -1.0
    return b, B_r


@compiled
def inertial_noise(w: Array, f: Array, variances: Array, dt: float, dof: int) -> Array:
    """Return the covariance (dof, dof) gathered in dt s, in the frame where the robot ends, at a rate w and a force f.

    `variances` (12,) are those in a second of the white noise of rate and force and of the walks of their biases.  It
    is the integral of what each does until the end, by quadrature of Gauss-Legendre, and so does not depend on how the
    time is divided.
    """
    D, S = np.zeros((dof, dof)), np.zeros((15, 12))
    for n in range(len(NODES)):
        t = NODES[n] * dt  # still to come
        turn = w * t
        V, W, back = left_jacobian(turn), second_integral(turn), matrix(exp(-turn))
        S[3:6, :3] = back
        S[:3, :3], S[6:9, :3] = back @ skew(W @ f) * (-t * t), back @ skew(V @ f) * -t
        S[:3, 3:6], S[6:9, 3:6] = back * t, back
        S[3:6, 6:9] = back @ V * -t
        S[:3, 6:9] = back @ second_integral_rate(turn, f) * -(t**3)
        S[6:9, 6:9] = back @ left_jacobian_rate(turn, f) * -(t**2)
        S[:3, 9:], S[6:9, 9:] = back @ W * -(t**2), back @ V * -t
        for i in range(6):
            S[9 + i, 6 + i] = 1.0
        for k in range(12):
            share = WEIGHTS[n] * dt * variances[k]
            for i in range(15):
                for j in range(i + 1):
                    D[i, j] += share * S[i, k] * S[j, k]
    for i in range(15):
        for j in range(i):
            D[j, i] = D[i, j]
    return D


@register("motion", "inertial")
class Inertial(MotionModel):
    """An inertial unit: its angular rate and specific force, each held until the next reading, move the robot.

    A control is u = (w (3,) rad/s, f (3,) m/s^2) in the robot's frame; at rest f is g upwards.  The state is pose,
    velocity in the world, and the biases of both, 16 numbers and 15 errors; z of the world is up.  The parameters are
    those of Kalibr's `imu.yaml`, of which a configuration can name one: `data_sheet`.  The noise of each reading is
    white, so a held reading that a scan divides has none in common with itself.

    >>> slam = km.Slam(km.Robot("drone", km.motion.Inertial()))
    >>> u = (0.0, 0.0, 0.0, 0.5, 0.0, 9.80665)  # accelerates ahead
    >>> for t in np.arange(0.0, 2.01, 0.01):
    ...     report = slam.process(km.Control(t, "drone", u))
    >>> slam.mean("drone")[:3].round(2), slam.mean("drone")[7:10].round(2)  # a t^2 / 2, a t
    (array([ 1.  ,  0.  , -0.01]), array([ 1.  ,  0.  , -0.01]))
    """

    gyroscope_noise_density_rad_per_sqrt_s: Annotated[NotNegative, "White noise of the rate, rad/s/sqrt(Hz)."] = 1.7e-4
    gyroscope_random_walk_radps_per_sqrt_s: Annotated[NotNegative, "Random walk of the rate's bias."] = 2.0e-5
    accelerometer_noise_density_mps_per_sqrt_s: Annotated[NotNegative, "White noise of the force, m/s^2/sqrt(Hz)."] = (
        2.0e-3
    )
    accelerometer_random_walk_mps2_per_sqrt_s: Annotated[NotNegative, "Random walk of the force's bias."] = 3.0e-3
    gravity_mps2: Annotated[Positive, "Reading of an accelerometer at rest."] = 9.81

    space = Space("SE2(3) with biases", (VECTOR3, ROTATION, OWN, *(SCALAR,) * 6))
    columns = ("wx_radps", "wy_radps", "wz_radps", "ax_mps2", "ay_mps2", "az_mps2")
    held = True
    moves = inertial
    velocity: ClassVar[Any] = inertial_velocity
    state_columns: ClassVar[tuple[str, ...]] = (
        "vx_mps", "vy_mps", "vz_mps", "bias_wx_radps", "bias_wy_radps", "bias_wz_radps",
        "bias_ax_mps2", "bias_ay_mps2", "bias_az_mps2",
    )  # fmt: skip
    sigmas = ()

    @cached_property
    def parameters(self) -> Array:
        """The gravity (1,), m/s^2."""
        return np.array([self.gravity_mps2])

    def body_velocity_under(self, r: Array, u: Array) -> tuple[Array, Array]:
        """Return the velocity (v, w) of a state r in the robot's frame (6,) under a reading u, and its Jacobian."""
        return inertial_velocity(np.asarray(r, dtype=np.float64), np.array(u, dtype=np.float64))

    def control_noise(self, u: Array) -> Array:
        """Return zeros (6, 6): the noise of a reading u (6,) is white, see `diffusion_at`."""
        return np.zeros((6, 6))

    def diffusion(self, u: Array, dt_s: float) -> Array | None:
        """Return the covariance (dof, dof) gathered in `dt_s` of a reading u (6,) of an unbiased unit."""
        return self.diffusion_at(np.zeros(self.space.size), u, dt_s)

    def diffusion_at(self, r: Array, u: Array, dt_s: float) -> Array | None:
        """Return the covariance (dof, dof) gathered in `dt_s` from a state r (size,) on, in the frame of its end."""
        if not self._variances.any():
            return None
        return inertial_noise(u[:3] - r[10:13], u[3:] - r[13:16], self._variances, dt_s, self.space.dof)

    @cached_property
    def _variances(self) -> Array:
        return np.square(self.densities)

    @cached_property
    def densities(self) -> Array:
        """The densities (12,) of the noise of rate and force, and of the walks of their biases."""
        sigmas = (
            self.gyroscope_noise_density_rad_per_sqrt_s, self.accelerometer_noise_density_mps_per_sqrt_s,
            self.gyroscope_random_walk_radps_per_sqrt_s, self.accelerometer_random_walk_mps2_per_sqrt_s,
        )  # fmt: skip
        return np.repeat(sigmas, 3)


@register("motion", "inertial_gravity")
class InertialGravity(Inertial):
    """An inertial unit in a map whose vertical is not known: the gravity is in the state, and is estimated.

    The state is that of `inertial` with the gravity in the world behind it, (3,) m/s^2, 19 numbers and 18 errors.

    >>> slam = km.Slam(km.Robot("drone", km.motion.InertialGravity()))
    >>> report = slam.process(km.Control(0.0, "drone", (0.0, 0.0, 0.0, 0.0, 0.0, 9.81)))
    >>> slam.mean("drone").size, slam.covariance("drone").shape
    (19, (18, 18))
    """

    space = Space("SE2(3) with biases and gravity", (*Inertial.space.kinds, OWN))
    state_columns = (
        *Inertial.state_columns, "gravity_x_mps2", "gravity_y_mps2", "gravity_z_mps2",
    )  # fmt: skip


# ------------------------------------------------------------------ at rest
class Rest(NamedTuple):
    """A start from readings at rest: the end of the rest, the state (size,) there and its covariance (dof, dof)."""

    until_s: float
    start: Array
    cov: Array


def start_at_rest(motion: Inertial, t_s: Array, u: Array, start: Array, cov: Array) -> Rest:
    """Return the start of a unit of which the first readings u (N, 6), at `t_s` (N,), are made at rest.

    `start` (size,) and `cov` (dof, dof) are what is known without them: position, heading and the prior of the biases
    are taken from there.  The tilt and the bias of the rate come from the means: the attitude of the start is turned
    to the vertical by the shortest way.  A bias of the force is not distinguishable from a tilt, so both have the sigma
    of its prior and are correlated.  With the gravity in the state the attitude is the start's and the gravity is found
    instead.  Raises ModelError if the unit does not begin at rest.

    >>> unit, t_s = km.motion.Inertial(), 0.01 * np.arange(500)
    >>> noise = np.random.default_rng(0).normal(size=(500, 6)) * [*[0.001] * 3, *[0.01] * 3]
    >>> u = noise + [0.01, 0.0, 0.0, 0.0, 0.0, 9.81]
    >>> start, cov = np.array([0.0] * 6 + [1.0] + [0.0] * 9), np.diag([1e-4] * 6 + [1.0] * 3 + [1e-2] * 6)
    >>> rest = km.motion.start_at_rest(unit, t_s, u, start, cov)
    >>> rest.until_s, rest.start[10:13].round(3)  # the bias of the rate
    (4.99, array([ 0.01,  0.  , -0.  ]))
    """
    count = _resting(motion, t_s, u, np.sqrt(np.diag(cov)))
    until_s, dt_s = float(t_s[count - 1]), float(np.median(np.diff(t_s)))
    (w, w_var), (f, f_var) = (_mean_at_rest(motion, u[:count, 3 * k : 3 * k + 3], dt_s, 3 * k) for k in (0, 1))
    state, P = start.copy(), cov.copy()
    state[7:10], state[10:13] = 0.0, w
    P[6:, :], P[:, 6:] = 0.0, 0.0
    shaken = float(u[count - round(WINDOW_S / dt_s) : count, 3:].var(axis=0).mean())
    P[6:9, 6:9] = shaken * (WINDOW_S / (2.0 * math.pi)) ** 2 * np.eye(3)  # vibrations faster than a window
    P[9:12, 9:12] = w_var * np.eye(3)
    up, prior = f / np.linalg.norm(f), float(cov[12, 12])
    if motion.space.dof == INERTIAL_DOF:
        state[3:7] = multiply(exp(_shortest_turn(matrix(start[3:7]) @ up)), start[3:7])
    share = prior / (prior + f_var)  # of what the length of f has too much, that is the bias's
    excess = float(np.linalg.norm(f)) - motion.gravity_mps2
    state[13:16] = share * excess * up
    Q = matrix(state[3:7])
    above = Q @ up
    along = np.outer(above, above)
    B = prior * (np.eye(3) - along) + (1.0 - share) * prior * along  # of the bias of the force, in the world
    if motion.space.dof == INERTIAL_DOF:
        M, rows = skew(above) / motion.gravity_mps2, slice(3, 6)
        P[3:6, :], P[:, 3:6] = 0.0, 0.0
        P[3:6, 3:6] = cov[5, 5] * along
    else:
        M, rows = np.eye(3) - along, slice(15, 18)
        state[GRAVITY:] = -motion.gravity_mps2 * above
        J = -skew(state[GRAVITY:])  # it turns with the attitude of the start
        P[rows, 3:6], P[rows, rows] = J @ P[3:6, 3:6], J @ P[3:6, 3:6] @ J.T
        P[3:6, rows] = P[rows, 3:6].T
    P[rows, rows] += M @ (B + f_var * np.eye(3)) @ M.T
    P[rows, 12:15] = M @ B @ Q
    P[12:15, rows], P[12:15, 12:15] = P[rows, 12:15].T, Q.T @ B @ Q
    return Rest(until_s, state, P)


def noise_densities(t_s: Array, u: Array) -> tuple[float, float]:
    """Return the densities of white noise, of rate [rad/s/sqrt(Hz)] and force [m/s^2/sqrt(Hz)], of readings u (N, 6).

    At `t_s` (N,).  A vehicle that shakes has more than the data sheet gives.  Of the spectrum above what a vehicle
    itself moves by, in bands, the least counts: a motor that hums has no part in it.  Zero of too few readings.

    >>> t_s, rng = 0.01 * np.arange(20000), np.random.default_rng(0)
    >>> u = rng.normal(size=(20000, 6)) * [*[0.02] * 3, *[0.1] * 3]  # density 0.1 times as large
    >>> np.round(km.motion.noise_densities(t_s, u), 4)
    array([0.002 , 0.0099])
    """
    rate = 1.0 / float(np.median(np.diff(t_s))) if len(t_s) > 2 * SPECTRUM else 0.0
    if rate < 4.0 * BAND_HZ:
        return 0.0, 0.0
    hann = np.hanning(SPECTRUM)[:, None]
    parts = [u[k : k + SPECTRUM] for k in range(0, len(u) - SPECTRUM + 1, SPECTRUM // 2)]
    power = np.mean([np.abs(np.fft.rfft((part - part.mean(axis=0)) * hann, axis=0)) ** 2 for part in parts], axis=0)
    bands = (np.arange(len(power)) * rate / SPECTRUM // BAND_HZ).astype(np.int64)[:-1]
    least = np.min([power[:-1][bands == k].mean(axis=0) for k in range(1, bands.max() + 1)], axis=0)
    rate_, force = np.sqrt(least.reshape(2, 3).mean(axis=1) / (rate * np.sum(hann**2))).tolist()
    return rate_, force


def _shortest_turn(v: Array) -> Array:
    """Return the rotation vector (3,) of the shortest turn of a unit vector v (3,) to the vertical."""
    axis = np.array([v[1], -v[0], 0.0])
    sine = math.hypot(v[0], v[1])
    axis = axis / sine if sine > 0 else np.array([1.0, 0.0, 0.0])
    return axis * math.atan2(sine, v[2])


def _resting(motion: Inertial, t_s: Array, u: Array, sigmas: Array) -> int:
    """Return how many of the readings u (N, 6) are made at rest before the first that may not be.

    `sigmas` (dof,) are those of the start.  A window of readings is compared with the mean of all before it.
    """
    dt_s = float(np.median(np.diff(t_s))) if len(t_s) > 1 else 0.0
    n = max(2, round(WINDOW_S / dt_s)) if dt_s > 0 else 2
    count = len(u) // n
    if dt_s <= 0 or count < WINDOWS:
        raise ModelError(
            f"there are {len(u)} readings, expected some at rest for {WINDOWS * WINDOW_S:g} s to start from"
        )
    windows, variances = u[: count * n].reshape(count, n, 6), motion.densities**2
    means, white = windows.mean(axis=1), variances[:6] / dt_s
    own = np.maximum(windows.var(axis=1, ddof=1), white)  # of a reading: more than white noise, where it vibrates
    scatter, first, k = own[:WINDOWS].mean(axis=0), means[:WINDOWS].mean(axis=0), np.arange(1, count)[:, None]
    off = np.append(np.abs(first[:3]), abs(float(np.linalg.norm(first[3:])) - motion.gravity_mps2))
    known = np.append(sigmas[9:12], sigmas[12]) + np.sqrt(scatter[:4] / (n * WINDOWS))
    spread = (own[1:] + np.cumsum(own, axis=0)[:-1] / k**2) / n + variances[6:] * (k * n * dt_s)
    still = (np.abs(means[1:] - np.cumsum(means, axis=0)[:-1] / k) <= SIGMAS * np.sqrt(spread)).all(axis=1)
    resting = count if still.all() else int(np.argmin(still))  # less the window in which it may begin to move
    if resting < WINDOWS or (scatter > SHAKEN**2 * white).any() or (off > SIGMAS * known).any():
        w, f = np.round(first[:3], 4).tolist(), np.round(first[3:], 3).tolist()
        what = f"the unit begins with {w} rad/s and {f} m/s^2"
        raise ModelError(f"{what}, expected it at rest for {WINDOWS * WINDOW_S:g} s to start from")
    return resting * n


def _mean_at_rest(motion: Inertial, u: Array, dt_s: float, at: int) -> tuple[Array, float]:
    """Return the mean of the last readings u (N, 3) at rest, and its variance as the bias of now.

    So many that white noise and the walk of the bias weigh most favourably; `at` is 0 for rates, 3 for forces.
    """
    white, walk = float(motion.densities[at] ** 2), float(motion.densities[6 + at] ** 2)
    best = math.sqrt(3.0 * white / walk) if walk > 0 else math.inf
    n = min(len(u), max(round(WINDOWS * WINDOW_S / dt_s), math.ceil(min(best / dt_s, len(u)))))
    size = max(2, round(WINDOW_S / dt_s))
    means = u[len(u) - n // size * size :].reshape(-1, size, 3).mean(axis=1)  # vibrations are not white
    variance = max(white / (n * dt_s), float(means.var(axis=0, ddof=1).mean()) / len(means)) + walk * n * dt_s / 3.0
    return u[-n:].mean(axis=0), variance
