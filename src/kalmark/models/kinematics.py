"""Formulas of several motions: exact arcs in the plane with their noise, and the bases of all models of a motion."""

from __future__ import annotations

import math
from dataclasses import KW_ONLY
from functools import cached_property
from typing import Annotated, ClassVar

import numpy as np

from kalmark.arrays import Array
from kalmark.compiled import compiled
from kalmark.declare import Estimated, NotNegative, declared
from kalmark.geometry.angles import exponential_v, exponential_v_rate
from kalmark.geometry.frames import compose, product
from kalmark.geometry.spaces import SE2
from kalmark.models.observe import Compiled

NODES, WEIGHTS = (0.5 * (each + k) for each, k in zip(np.polynomial.legendre.leggauss(5), (1.0, 0.0), strict=True))


@compiled
def arc(r: Array, v: float, w: float, dt: float) -> tuple[Array, Array, Array]:
    """Move r along the exact arc of speed v and turn rate w; R_u (3, 2) with respect to (v, w).

    Both limits of [F] are regular: a straight line for w -> 0 and a turn on the spot for v -> 0.
    """
    a = w * dt
    p, q = exponential_v(a)
    p_a, q_a = exponential_v_rate(a)
    s = v * dt
    step, R_u = np.empty(3), np.empty((3, 2))
    step[0], step[1], step[2] = s * p, s * q, a
    r2, R_r, R_d = compose(r, step)
    for i in range(3):
        R_u[i, 0] = R_d[i, 0] * (dt * p) + R_d[i, 1] * (dt * q)
        R_u[i, 1] = R_d[i, 0] * (s * dt * p_a) + R_d[i, 1] * (s * dt * q_a) + R_d[i, 2] * dt
    return r2, R_r, R_u


@compiled
def screw(r: Array, v: Array, dt: float) -> tuple[Array, Array, Array]:
    """Move r (3,) for dt s by the constant velocity v (3,) = (vx, vy, w) in its own frame, exactly; R_v (3, 3)."""
    step, S_v = velocity_step(v, dt)
    r2, R_r, R_d = compose(r, step)
    return r2, R_r, product(R_d, S_v)


@compiled
def velocity_step(v: Array, dt: float) -> tuple[Array, Array]:
    """Return the step (3,) of a velocity v (3,) that lasts dt s, in the robot's first frame, and S_v (3, 3)."""
    a = v[2] * dt
    p, q = exponential_v(a)
    p_a, q_a = exponential_v_rate(a)
    x, y = v[0] * dt, v[1] * dt
    step, S_v = np.empty(3), np.zeros((3, 3))
    step[0], step[1], step[2] = x * p - y * q, x * q + y * p, a
    S_v[0, 0], S_v[0, 1], S_v[0, 2] = dt * p, -dt * q, dt * (x * p_a - y * q_a)
    S_v[1, 0], S_v[1, 1], S_v[1, 2] = dt * q, dt * p, dt * (x * q_a + y * p_a)
    S_v[2, 2] = dt
    return step, S_v


@compiled
def still_to_come(v: Array, dt: float) -> tuple[Array, Array]:
    """Return what a small step, and a small change of velocity, at dt s before the end of an arc do at its end.

    Both matrices (3, 3) are in the robot's frame, the step's where it happens, the results where the arc ends.
    """
    step, S_v = velocity_step(v, dt)
    S_d, c, s = np.eye(3), math.cos(step[2]), math.sin(step[2])
    S_d[0, 2], S_d[1, 2] = -step[1], step[0]
    for S in (S_d, S_v):
        for j in range(3):
            S[0, j], S[1, j] = c * S[0, j] + s * S[1, j], c * S[1, j] - s * S[0, j]
    return S_d, S_v


@compiled
def add_noise(D: Array, G: Array, q: Array, share: float) -> None:
    """Add share G q G' to a covariance D (n, n), with G (n, k) and q (k, k)."""
    G_q = product(G, q)
    for i in range(len(D)):
        for j in range(len(D)):
            for k in range(len(q)):
                D[i, j] += share * G_q[i, k] * G[j, k]


@compiled
def white_steps(v: Array, q: Array, dt: float, between: bool) -> Array:
    """Return the covariance (3, 3), in the frame where an arc ends, of white noise of the steps along it.

    The arc is that of the velocity v (3,) for dt s, q (3, 3) the covariance of the steps in a second, in the robot's
    frame.  With `between`, it is that of a noise of which the sum over the arc is known: a Brownian bridge.  The
    covariance does not depend on how an arc is divided.  Chong and Kleeman 1997, here by quadrature of Gauss-Legendre.
    """
    D, mean = np.zeros((3, 3)), np.zeros((3, 3))
    pieces = 1 + int(abs(v[2] * dt))
    for k in range(pieces):
        for n in range(len(NODES)):
            share = WEIGHTS[n] / pieces
            G = still_to_come(v, (k + NODES[n]) * dt / pieces)[0]
            add_noise(D, G, q, share * dt)
            for i in range(3):
                for j in range(3):
                    mean[i, j] += share * G[i, j]
    if between:
        add_noise(D, mean, q, -dt)
    return D


@compiled
def white_accelerations(v: Array, q: Array, dt: float) -> Array:
    """Return the covariance (6, 6) of pose and velocity, in the frame where an arc ends, of white accelerations.

    The arc is that of the velocity v (3,) for dt s, q (3, 3) the covariance of the changes of velocity in a second.
    The covariance does not depend on how an arc is divided: the integral along it, by quadrature of Gauss-Legendre.
    """
    D, G = np.zeros((6, 6)), np.zeros((6, 3))
    pieces = 1 + int(abs(v[2] * dt))
    for k in range(pieces):
        for n in range(len(NODES)):
            G_v = still_to_come(v, (k + NODES[n]) * dt / pieces)[1]
            for i in range(3):
                G[3 + i, i] = 1.0
                for j in range(3):
                    G[i, j] = G_v[i, j]
            add_noise(D, G, q, WEIGHTS[n] / pieces * dt)
    return D


Scale = Annotated[Estimated, "Share of the way that is missing in all controls"]
TurnScale = Annotated[Estimated, "Share of the turn that is missing in all controls"]
TurnPerMetre = Annotated[Estimated, "Turn that is missing for each metre (unequal wheels)"]
WheelSpeedBias = Annotated[Estimated, "Constant part of the wheel speed's error"]
SteeringNoise = Annotated[NotNegative, "Error of the steering angle held over its interval."]
SteeringBias = Annotated[Estimated, "Constant part of the steering angle's error"]
SteeringScale = Annotated[Estimated, "Share that the steering angle lacks"]
TurnBias = Annotated[Estimated, "Constant part of the turn rate's error"]


class MotionModel(Compiled):
    """Base of the motions: white noise of a control, by the names of its parameters, and its calibration.

    `calibrations` are the name and the parameter, a sigma, of each constant by which a control may be wrong.  Those
    with a sigma above 0 are in the map and are estimated.
    """

    sigmas: ClassVar[tuple[str, ...]]
    calibrations: ClassVar[tuple[tuple[str, str], ...]] = ()

    @cached_property
    def _N(self) -> Array:
        return np.diag(np.square([vars(self)[name] for name in self.sigmas]))

    def control_noise(self, u: Array) -> Array:
        """Return N (m, m) of a control (m,): of an increment, of an impulse or of what is held."""
        return self._N

    @cached_property
    def _unknown(self) -> list[int]:
        return [k for k, (_, sigma) in enumerate(self.calibrations) if vars(self)[sigma] > 0]

    @property
    def calibration(self) -> tuple[str, ...]:
        """The names of the c constants that are in the map."""
        return tuple(self.calibrations[k][0] for k in self._unknown)

    @property
    def calibration_cov(self) -> Array:
        """Their covariance (c, c)."""
        return np.diag([vars(self)[self.calibrations[k][1]] ** 2 for k in self._unknown])

    def calibration_effect(self, u: Array, dt_s: float) -> Array:
        """Return B (m, c): with the constants a, a control u (m,) of `dt_s` is u + B a in truth."""
        return np.ascontiguousarray(self._effects(u, dt_s)[:, self._unknown])

    def _effects(self, u: Array, dt_s: float) -> Array:
        """Return B by all `calibrations`: by default an offset of each component, then its share."""
        return np.hstack([np.eye(len(u)), np.diag(u)])

    def diffusion(self, u: Array, dt_s: float) -> Array | None:
        """Return the covariance (dof, dof) of the white noise gathered in `dt_s`, None: all noise is in u (m,)."""
        return None


@declared
class PlanarMotion(MotionModel):
    """Base of the planar motions: the space and the diffusion."""

    _: KW_ONLY
    sigma_along_m_per_sqrt_s: Annotated[NotNegative, "Random walk along the heading, while it moves."] = 0.0
    sigma_across_m_per_sqrt_s: Annotated[NotNegative, "Random walk across the heading, while it moves."] = 0.0
    sigma_theta_rad_per_sqrt_s: Annotated[NotNegative, "Random walk of the heading, while it moves."] = 0.0

    space = SE2

    @cached_property
    def _density(self) -> Array | None:
        sigmas = (self.sigma_along_m_per_sqrt_s, self.sigma_across_m_per_sqrt_s, self.sigma_theta_rad_per_sqrt_s)
        return np.diag(np.square(sigmas)) if any(sigmas) else None

    def diffusion(self, u: Array, dt_s: float) -> Array | None:
        """Return the covariance (3, 3) of the white noise gathered in `dt_s`, in the robot's frame."""
        return None if self._density is None or not u.any() else self._density * dt_s


@declared
class SpeedAndTurn(PlanarMotion):
    """A speed and a turn rate, each held until the next control: what a unicycle takes, whether it slips or not."""

    sigma_v_mps: Annotated[NotNegative, "Error of the speed held over its interval."] = 0.1
    sigma_w_radps: Annotated[NotNegative, "Error of the turn rate held over its interval."] = 0.05
    sigma_v_bias_mps: Annotated[Estimated, "Constant part of the speed's error"] = 0.0
    sigma_w_bias_radps: TurnBias = 0.0
    sigma_v_scale: Scale = 0.0
    sigma_w_scale: TurnScale = 0.0
    sigma_turn_rad_per_m: TurnPerMetre = 0.0

    columns = ("v_mps", "w_radps")
    held = True
    sigmas = ("sigma_v_mps", "sigma_w_radps")
    calibrations = (
        ("v_mps", "sigma_v_bias_mps"),
        ("w_radps", "sigma_w_bias_radps"),
        ("v_scale", "sigma_v_scale"),
        ("w_scale", "sigma_w_scale"),
        ("turn_rad_per_m", "sigma_turn_rad_per_m"),
    )

    def _effects(self, u: Array, dt_s: float) -> Array:
        return np.array([[1.0, 0.0, u[0], 0.0, 0.0], [0.0, 1.0, 0.0, u[1], abs(u[0])]])


class Steered(PlanarMotion):
    """Base of a car and a tricycle: the speed of a wheel and a steering angle, each held until the next control."""

    columns = ("v_mps", "steering_rad")
    held = True
    sigmas = ("sigma_v_mps", "sigma_steering_rad")
    calibrations = (
        ("v_mps", "sigma_v_bias_mps"),
        ("steering_rad", "sigma_steering_bias_rad"),
        ("v_scale", "sigma_v_scale"),
        ("steering_scale", "sigma_steering_scale"),
    )
