"""Motion models in the plane: odometry increments ([S] A.3), unicycle with the exact arc ([F]), Ackermann.

Three kinds of noise.  The *control's error* (`sigma_v_mps`, ...) is constant as long as the control is held, so its
displacement is sigma times the duration.  Its *bias* (`sigma_v_bias_mps`, ...), what is to be added to all of them, is
in the map and estimated.  A *diffusion* (`..._per_sqrt_s`) is white: its variance grows with time, along, across and
about the robot, while the control is not zero (a robot told to stand does not wander).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from kalmark.compiled import compiled
from kalmark.geometry.angles import exponential_v, exponential_v_rate
from kalmark.geometry.frames import compose
from kalmark.geometry.spaces import SE2, Space
from kalmark.models.parameters import check_parameters

Array = npt.NDArray[np.float64]


@compiled
def increment(r: Array, u: Array) -> tuple[Array, Array, Array]:
    """Move r by u = (dx, dy, dtheta) in its own frame.  [S] (59)-(60)."""
    return compose(r, u)


@compiled
def arc(r: Array, v: float, w: float, dt: float) -> tuple[Array, Array, Array]:
    """Move r along the exact arc of speed v and turn rate w; R_u (3, 2) with respect to (v, w).

    Both limits of [F] are regular: a straight line for w -> 0 and a turn on the spot for v -> 0.
    """
    a = w * dt
    p, q = exponential_v(a)
    p_a, q_a = exponential_v_rate(a)
    s = v * dt
    r2, R_r, R_d = compose(r, np.array([s * p, s * q, a]))
    D_u = np.array([[dt * p, s * dt * p_a], [dt * q, s * dt * q_a], [0.0, dt]])
    return r2, R_r, R_d @ D_u


@compiled
def ackermann(r: Array, u: Array, dt: float, wheelbase: float, offset: float) -> tuple[Array, Array, Array]:
    """Move the rear axle's centre r by u = (speed of the left rear wheel, steering), along the exact arc."""
    tan = math.tan(u[1])
    slip = 1.0 / (1.0 - tan * offset / wheelbase)
    v, w = u[0] * slip, u[0] * slip * tan / wheelbase
    tan_s = 1.0 + tan * tan
    slip_s = slip * slip * tan_s * offset / wheelbase
    v_s = u[0] * slip_s
    VW_u = np.array([[slip, v_s], [slip * tan / wheelbase, (v_s * tan + v * tan_s) / wheelbase]])
    r2, R_r, R_vw = arc(r, v, w, dt)
    return r2, R_r, R_vw @ VW_u


class Planar:
    """What the planar motions share: the space and the diffusion."""

    space: ClassVar[Space] = SE2
    sigma_along_m_per_sqrt_s: float
    sigma_across_m_per_sqrt_s: float
    sigma_theta_rad_per_sqrt_s: float

    def __post_init__(self) -> None:
        check_parameters(self)

    @cached_property
    def _density(self) -> Array | None:
        sigmas = (self.sigma_along_m_per_sqrt_s, self.sigma_across_m_per_sqrt_s, self.sigma_theta_rad_per_sqrt_s)
        return np.diag(np.square(sigmas)) if any(sigmas) else None

    def diffusion(self, u: Array, dt_s: float) -> Array | None:
        """Return the covariance (3, 3) of the white noise gathered in `dt_s`, in the robot's frame."""
        return None if self._density is None or not u.any() else self._density * dt_s


@dataclass(frozen=True)
class Odometry2D(Planar):
    """Odometry: u = (dx, dy, dtheta) in the robot's frame, the motion that ended at its time.  [S] (57)-(60).

    The sigmas are those of one increment.  A diffusion counts the time since the last increment, none for the first.
    """

    sigma_x_m: float = 0.01
    sigma_y_m: float = 0.0
    sigma_theta_rad: float = 0.02
    sigma_along_m_per_sqrt_s: float = 0.0
    sigma_across_m_per_sqrt_s: float = 0.0
    sigma_theta_rad_per_sqrt_s: float = 0.0

    columns: ClassVar[tuple[str, ...]] = ("dx_m", "dy_m", "dtheta_rad")
    held: ClassVar[bool] = False

    @cached_property
    def _N(self) -> Array:
        return np.diag(np.square([self.sigma_x_m, self.sigma_y_m, self.sigma_theta_rad]))

    def move(self, r: Array, u: Array, dt_s: float) -> tuple[Array, Array, Array]:
        """Return the moved pose (3,), R_r (3, 3), R_u (3, 3)."""
        return increment(r, u)

    def control_noise(self, u: Array) -> Array:
        """Return N (3, 3) of one increment."""
        return self._N


@dataclass(frozen=True)
class Unicycle(Planar):
    """Unicycle: u = (v m/s, w rad/s), held from its time on; the exact arc of [F] with both its limits."""

    sigma_v_mps: float = 0.1
    sigma_w_radps: float = 0.05
    sigma_along_m_per_sqrt_s: float = 0.0
    sigma_across_m_per_sqrt_s: float = 0.0
    sigma_theta_rad_per_sqrt_s: float = 0.0
    sigma_v_bias_mps: float = 0.0
    sigma_w_bias_radps: float = 0.0

    columns: ClassVar[tuple[str, ...]] = ("v_mps", "w_radps")
    held: ClassVar[bool] = True

    @cached_property
    def _N(self) -> Array:
        return np.diag(np.square([self.sigma_v_mps, self.sigma_w_radps]))

    def move(self, r: Array, u: Array, dt_s: float) -> tuple[Array, Array, Array]:
        """Return the moved pose (3,), R_r (3, 3), R_u (3, 2)."""
        return arc(r, u[0], u[1], dt_s)

    def control_noise(self, u: Array) -> Array:
        """Return N (2, 2) of the held speed and turn rate."""
        return self._N

    @property
    def bias_cov(self) -> Array | None:
        """The covariance (2, 2) of the bias of speed and turn rate, None if there is none."""
        return _bias_cov(self.sigma_v_bias_mps, self.sigma_w_bias_radps)


@dataclass(frozen=True)
class Ackermann(Planar):
    """Car: u = (speed of the left rear wheel m/s, steering rad), held; the state is the rear axle's centre.

    `encoder_offset_m` is the wheel's distance to the left of the centre line, negative to the right; 0 for a speed that
    is the axle's own.
    """

    wheelbase_m: float = 2.83
    encoder_offset_m: float = 0.76
    sigma_v_mps: float = 0.1
    sigma_steering_rad: float = 0.02
    sigma_along_m_per_sqrt_s: float = 0.0
    sigma_across_m_per_sqrt_s: float = 0.0
    sigma_theta_rad_per_sqrt_s: float = 0.0
    sigma_v_bias_mps: float = 0.0
    sigma_steering_bias_rad: float = 0.0

    columns: ClassVar[tuple[str, ...]] = ("v_mps", "steering_rad")
    held: ClassVar[bool] = True

    def __post_init__(self) -> None:
        check_parameters(self, positive=("wheelbase_m",))

    @cached_property
    def _N(self) -> Array:
        return np.diag(np.square([self.sigma_v_mps, self.sigma_steering_rad]))

    def move(self, r: Array, u: Array, dt_s: float) -> tuple[Array, Array, Array]:
        """Return the moved pose (3,), R_r (3, 3), R_u (3, 2)."""
        return ackermann(r, u, dt_s, self.wheelbase_m, self.encoder_offset_m)

    def control_noise(self, u: Array) -> Array:
        """Return N (2, 2) of the held speed and steering."""
        return self._N

    @property
    def bias_cov(self) -> Array | None:
        """The covariance (2, 2) of the bias of speed and steering, None if there is none."""
        return _bias_cov(self.sigma_v_bias_mps, self.sigma_steering_bias_rad)


def _bias_cov(*sigmas: float) -> Array | None:
    return np.diag(np.square(sigmas)) if any(sigmas) else None
