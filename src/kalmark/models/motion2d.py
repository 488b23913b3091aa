"""Motion models in the plane: odometry increments ([S] A.3), unicycle with the exact arc ([F]), Ackermann.

Three kinds of noise.  The *control's error* (`sigma_v_mps`, ...) is constant as long as the control is held, so its
displacement is sigma times the duration.  Its *bias* (`sigma_v_bias_mps`, ...), what is to be added to all of them, is
in the map and estimated.  A *diffusion* (`..._per_sqrt_s`) is white: its variance grows with time, along, across and
about the robot, while the control is not zero (a robot told to stand does not wander).
"""

from __future__ import annotations

import math
from functools import cached_property
from typing import Annotated, Any, ClassVar

import numpy as np
import numpy.typing as npt

from kalmark.compiled import compiled
from kalmark.declare import NotNegative, Number, Positive, register
from kalmark.geometry.angles import exponential_v, exponential_v_rate
from kalmark.geometry.frames import compose
from kalmark.geometry.spaces import SE2, Space
from kalmark.models.moving import Compiled

__all__ = ["Ackermann", "Odometry2D", "Unicycle"]

Array = npt.NDArray[np.float64]

# parameters that several motions have
Along = Annotated[NotNegative, "Random walk along the heading, while it moves."]
Across = Annotated[NotNegative, "Random walk across the heading, while it moves."]
Turning = Annotated[NotNegative, "Random walk of the heading, while it moves."]


@compiled
def increment(r: Array, u: Array, par: Array, dt: float) -> tuple[Array, Array, Array]:
    """Move r (3,) by u (3,) = (dx, dy, dtheta) in its own frame: the new r, R_r, R_u (3, 3).  [S] (59)-(60)."""
    return compose(r, u)


@compiled
def unicycle(r: Array, u: Array, par: Array, dt: float) -> tuple[Array, Array, Array]:
    """Move r (3,) by the speed and turn rate u (2,) for dt s: the new r, R_r (3, 3), R_u (3, 2)."""
    return arc(r, u[0], u[1], dt)


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
def ackermann(r: Array, u: Array, par: Array, dt: float) -> tuple[Array, Array, Array]:
    """Move the rear axle's centre r (3,) by u (2,) = (speed of the left rear wheel, steering), along the exact arc.

    `par`: wheelbase and offset of the encoder.
    """
    wheelbase, offset = par[0], par[1]
    tan = math.tan(u[1])
    slip = 1.0 / (1.0 - tan * offset / wheelbase)
    v, w = u[0] * slip, u[0] * slip * tan / wheelbase
    tan_s = 1.0 + tan * tan
    slip_s = slip * slip * tan_s * offset / wheelbase
    v_s = u[0] * slip_s
    VW_u = np.array([[slip, v_s], [slip * tan / wheelbase, (v_s * tan + v * tan_s) / wheelbase]])
    r2, R_r, R_vw = arc(r, v, w, dt)
    return r2, R_r, R_vw @ VW_u


class Planar(Compiled):
    """What the planar motions share: the space and the diffusion."""

    space: ClassVar[Space] = SE2
    sigma_along_m_per_sqrt_s: float
    sigma_across_m_per_sqrt_s: float
    sigma_theta_rad_per_sqrt_s: float

    @cached_property
    def _density(self) -> Array | None:
        sigmas = (self.sigma_along_m_per_sqrt_s, self.sigma_across_m_per_sqrt_s, self.sigma_theta_rad_per_sqrt_s)
        return np.diag(np.square(sigmas)) if any(sigmas) else None

    def diffusion(self, u: Array, dt_s: float) -> Array | None:
        """Return the covariance (3, 3) of the white noise gathered in `dt_s`, in the robot's frame."""
        return None if self._density is None or not u.any() else self._density * dt_s


@register("motion", "unicycle")
class Unicycle(Planar):
    """Speed and turn rate, each held until the next control.

    A control is u = (v m/s, w rad/s); the exact arc of [F] with both its limits.
    """

    sigma_v_mps: Annotated[NotNegative, "Error of the speed held over its interval."] = 0.1
    sigma_w_radps: Annotated[NotNegative, "Error of the turn rate held over its interval."] = 0.05
    sigma_along_m_per_sqrt_s: Along = 0.0
    sigma_across_m_per_sqrt_s: Across = 0.0
    sigma_theta_rad_per_sqrt_s: Turning = 0.0
    sigma_v_bias_mps: Annotated[
        NotNegative, "Constant part of the speed's error; above 0 it is in the map and is estimated."
    ] = 0.0
    sigma_w_bias_radps: Annotated[
        NotNegative, "Constant part of the turn rate's error; above 0 it is in the map and is estimated."
    ] = 0.0

    columns: ClassVar[tuple[str, ...]] = ("v_mps", "w_radps")
    held: ClassVar[bool] = True
    moves: ClassVar[Any] = unicycle

    @cached_property
    def _N(self) -> Array:
        return np.diag(np.square([self.sigma_v_mps, self.sigma_w_radps]))

    def control_noise(self, u: Array) -> Array:
        """Return N (2, 2) of the held speed and turn rate."""
        return self._N

    @property
    def bias_cov(self) -> Array | None:
        """The covariance (2, 2) of the bias of speed and turn rate, None if there is none."""
        return _bias_cov(self.sigma_v_bias_mps, self.sigma_w_bias_radps)


@register("motion", "odometry_2d")
class Odometry2D(Planar):
    """Increments dx, dy, dtheta in the robot's frame.

    A control u (3,) is the motion that ended at its time.  [S] (57)-(60).  The sigmas are those of one increment.  A
    diffusion counts the time since the last increment, none for the first.
    """

    sigma_x_m: Annotated[NotNegative, "Error of one increment, forward."] = 0.01
    sigma_y_m: Annotated[NotNegative, "Error of one increment, to the left."] = 0.0
    sigma_theta_rad: Annotated[NotNegative, "Error of one increment, heading."] = 0.02
    sigma_along_m_per_sqrt_s: Along = 0.0
    sigma_across_m_per_sqrt_s: Across = 0.0
    sigma_theta_rad_per_sqrt_s: Turning = 0.0

    columns: ClassVar[tuple[str, ...]] = ("dx_m", "dy_m", "dtheta_rad")
    held: ClassVar[bool] = False
    moves: ClassVar[Any] = increment

    @cached_property
    def _N(self) -> Array:
        return np.diag(np.square([self.sigma_x_m, self.sigma_y_m, self.sigma_theta_rad]))

    def control_noise(self, u: Array) -> Array:
        """Return N (3, 3) of one increment."""
        return self._N


@register("motion", "ackermann")
class Ackermann(Planar):
    """A car: wheel speed and steering angle, each held until the next control.

    A control is u = (speed of the left rear wheel m/s, steering rad); the state is the rear axle's centre.
    `encoder_offset_m` is the wheel's distance to the left of the centre line, negative to the right; 0 for a speed that
    is the axle's own.
    """

    wheelbase_m: Annotated[Positive, "Distance between the axles."] = 2.83
    encoder_offset_m: Annotated[Number, "Wheel encoder, left of the middle of the rear axle."] = 0.76
    sigma_v_mps: Annotated[NotNegative, "Error of the wheel speed held over its interval."] = 0.1
    sigma_steering_rad: Annotated[NotNegative, "Error of the steering angle held over its interval."] = 0.02
    sigma_along_m_per_sqrt_s: Along = 0.0
    sigma_across_m_per_sqrt_s: Across = 0.0
    sigma_theta_rad_per_sqrt_s: Turning = 0.0
    sigma_v_bias_mps: Annotated[
        NotNegative, "Constant part of the wheel speed's error; above 0 it is in the map and is estimated."
    ] = 0.0
    sigma_steering_bias_rad: Annotated[
        NotNegative, "Constant part of the steering angle's error; above 0 it is in the map and is estimated."
    ] = 0.0

    columns: ClassVar[tuple[str, ...]] = ("v_mps", "steering_rad")
    held: ClassVar[bool] = True
    moves: ClassVar[Any] = ackermann

    @cached_property
    def parameters(self) -> Array:
        """The wheelbase and the offset of the encoder, m."""
        return np.array([self.wheelbase_m, self.encoder_offset_m])

    @cached_property
    def _N(self) -> Array:
        return np.diag(np.square([self.sigma_v_mps, self.sigma_steering_rad]))

    def control_noise(self, u: Array) -> Array:
        """Return N (2, 2) of the held speed and steering."""
        return self._N

    @property
    def bias_cov(self) -> Array | None:
        """The covariance (2, 2) of the bias of speed and steering, None if there is none."""
        return _bias_cov(self.sigma_v_bias_mps, self.sigma_steering_bias_rad)


def _bias_cov(*sigmas: float) -> Array | None:
    return np.diag(np.square(sigmas)) if any(sigmas) else None
