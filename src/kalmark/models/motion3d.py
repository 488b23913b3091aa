"""Motion models in space: odometry increments, held velocities, constant velocity.  [TB] 4.1."""

from __future__ import annotations

from functools import cached_property
from typing import Annotated, Any, ClassVar

import numpy as np
import numpy.typing as npt

from kalmark.compiled import compiled
from kalmark.declare import NotNegative, register
from kalmark.geometry import frames3d
from kalmark.geometry.rotations import exp, left_jacobian, left_jacobian_rate, matrix, multiply, skew
from kalmark.geometry.spaces import ROTATION, SCALAR, SE3, VECTOR3, Space
from kalmark.models.moving import Compiled

__all__ = ["ConstantVelocity3D", "Odometry3D", "Velocity3D"]

Array = npt.NDArray[np.float64]


@compiled
def increment(r: Array, u: Array, par: Array, dt: float) -> tuple[Array, Array, Array]:
    """Move r (7,) by u (6,) = (dx, dy, dz, rotation vector) in its own frame: the new r, R_r, R_u (6, 6)."""
    return frames3d.move(r, u)


@compiled
def twist(r: Array, u: Array, par: Array, dt: float) -> tuple[Array, Array, Array]:
    """Move r (7,) for dt s by the constant velocity u = (v, w) in its own frame, exactly; R_r (6, 6), R_u (6, 6)."""
    Q, turn, way = matrix(r[3:]), u[3:] * dt, u[:3] * dt
    V = left_jacobian(turn)
    moved, step = np.empty(7), Q @ (V @ way)
    moved[:3] = r[:3] + step
    moved[3:] = multiply(r[3:], exp(turn))
    R_r, R_u = np.eye(6), np.zeros((6, 6))
    R_r[:3, 3:] = -skew(step)
    R_u[:3, :3] = Q @ V * dt
    R_u[:3, 3:] = Q @ left_jacobian_rate(turn, way) * dt
    R_u[3:, 3:] = Q @ V * dt
    return moved, R_r, R_u


@compiled
def coast(r: Array, u: Array, par: Array, dt: float) -> tuple[Array, Array, Array]:
    """Move r (13,) for dt s at its own velocity, which u then changes; R_r (12, 12), R_u (12, 6).  [TB] constVel."""
    Q, turn = matrix(r[3:7]), r[10:] * dt
    moved = r.copy()
    moved[:3] += r[7:10] * dt
    moved[3:7] = multiply(r[3:7], exp(turn))
    moved[7:] += u
    R_r, R_u = np.eye(12), np.zeros((12, 6))
    for i in range(3):
        R_r[i, 6 + i] = dt
    R_r[3:6, 9:] = Q @ left_jacobian(turn) * dt
    for i in range(6):
        R_u[6 + i, i] = 1.0
    return moved, R_r, R_u


@register("motion", "odometry_3d")
class Odometry3D(Compiled):
    """Increments dx, dy, dz and a rotation vector rx, ry, rz, in the robot's frame.

    A control is u (6,), m and rad.  The sigmas are those of one increment.
    """

    sigma_x_m: Annotated[NotNegative, "Error of one increment, forward."] = 0.01
    sigma_y_m: Annotated[NotNegative, "Error of one increment, to the left."] = 0.01
    sigma_z_m: Annotated[NotNegative, "Error of one increment, upwards."] = 0.01
    sigma_rotation_rad: Annotated[NotNegative, "Error of one increment, rotation about each axis."] = 0.005

    space: ClassVar[Space] = SE3
    columns: ClassVar[tuple[str, ...]] = ("dx_m", "dy_m", "dz_m", "rx_rad", "ry_rad", "rz_rad")
    held: ClassVar[bool] = False
    moves: ClassVar[Any] = increment

    @cached_property
    def _N(self) -> Array:
        return np.diag(np.square([self.sigma_x_m, self.sigma_y_m, self.sigma_z_m, *3 * [self.sigma_rotation_rad]]))

    def control_noise(self, u: Array) -> Array:
        """Return N (6, 6) of one increment."""
        return self._N

    def diffusion(self, u: Array, dt_s: float) -> None:
        """Return None: all noise of an increment is in its control u (6,)."""


@register("motion", "velocity_3d")
class Velocity3D(Compiled):
    """Velocity and turn rate in the robot's frame, each held until the next control.

    A control is u = (vx, vy, vz, wx, wy, wz), m/s and rad/s.
    """

    sigma_vx_mps: Annotated[NotNegative, "Error of the velocity held over its interval, forward."] = 0.1
    sigma_vy_mps: Annotated[NotNegative, "Error of the velocity held over its interval, to the left."] = 0.1
    sigma_vz_mps: Annotated[NotNegative, "Error of the velocity held over its interval, upwards."] = 0.1
    sigma_wx_radps: Annotated[NotNegative, "Error of the turn rate held over its interval, about x."] = 0.05
    sigma_wy_radps: Annotated[NotNegative, "Error of the turn rate held over its interval, about y."] = 0.05
    sigma_wz_radps: Annotated[NotNegative, "Error of the turn rate held over its interval, about z."] = 0.05
    sigma_v_bias_mps: Annotated[
        NotNegative, "Constant part of the speed's error on each axis; above 0 it is in the map and is estimated."
    ] = 0.0
    sigma_w_bias_radps: Annotated[
        NotNegative,
        "Constant part of the turn rate's error about each axis; above 0 it is in the map and is estimated.",
    ] = 0.0

    space: ClassVar[Space] = SE3
    columns: ClassVar[tuple[str, ...]] = ("vx_mps", "vy_mps", "vz_mps", "wx_radps", "wy_radps", "wz_radps")
    held: ClassVar[bool] = True
    moves: ClassVar[Any] = twist

    @cached_property
    def _N(self) -> Array:
        v, w = (self.sigma_vx_mps, self.sigma_vy_mps, self.sigma_vz_mps), (self.sigma_wx_radps, self.sigma_wy_radps)
        return np.diag(np.square([*v, *w, self.sigma_wz_radps]))

    def control_noise(self, u: Array) -> Array:
        """Return N (6, 6) of the held velocity."""
        return self._N

    @property
    def bias_cov(self) -> Array | None:
        """The covariance (6, 6) of the bias of the velocity, the same for all axes, None if there is none."""
        sigmas = np.repeat([self.sigma_v_bias_mps, self.sigma_w_bias_radps], 3)
        return np.diag(sigmas**2) if sigmas.any() else None

    def diffusion(self, u: Array, dt_s: float) -> None:
        """Return None: all noise is in the control u (6,)."""


@register("motion", "constant_velocity_3d")
class ConstantVelocity3D(Compiled):
    """Velocity and turn rate are in the state: it goes on as it goes, controls are changes of both, and needs none.

    The state is pose, velocity (world, m/s) and body rate (rad/s), 13 numbers and 12 errors.  The robot coasts to the
    time of each event.  A control is an impulse u = (dv (world), dw (body)) at its time, with sigmas `sigma_v_mps`,
    `sigma_w_radps`; `..._per_sqrt_s` are random walks of velocity and rate.
    """

    sigma_v_mps: Annotated[NotNegative, "Error of the change of velocity that a control is."] = 0.01
    sigma_w_radps: Annotated[NotNegative, "Error of the change of turn rate that a control is."] = 0.002
    sigma_v_mps_per_sqrt_s: Annotated[NotNegative, "Random walk of the velocity, all the time."] = 0.0
    sigma_w_radps_per_sqrt_s: Annotated[NotNegative, "Random walk of the turn rate, all the time."] = 0.0

    space: ClassVar[Space] = Space("SE3 with velocity", (VECTOR3, ROTATION, VECTOR3, SCALAR, SCALAR, SCALAR))
    columns: ClassVar[tuple[str, ...]] = ("dvx_mps", "dvy_mps", "dvz_mps", "dwx_radps", "dwy_radps", "dwz_radps")
    held: ClassVar[bool] = False
    moves: ClassVar[Any] = coast
    coasts: ClassVar[bool] = True

    @cached_property
    def _N(self) -> Array:
        return np.diag(np.square([*3 * [self.sigma_v_mps], *3 * [self.sigma_w_radps]]))

    def control_noise(self, u: Array) -> Array:
        """Return N (6, 6) of one impulse."""
        return self._N

    def diffusion(self, u: Array, dt_s: float) -> Array | None:
        """Return the covariance (12, 12) of the walks of velocity and rate, and of the way and turn they make."""
        v, w = self.sigma_v_mps_per_sqrt_s**2, self.sigma_w_radps_per_sqrt_s**2
        if not (v or w):
            return None
        way = np.array([[dt_s**3 / 3, dt_s**2 / 2], [dt_s**2 / 2, dt_s]])
        return np.kron(way, np.diag([v, v, v, w, w, w]))
