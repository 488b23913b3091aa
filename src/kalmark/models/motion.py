"""Motion models: odometry increments ([S] A.3), held velocities on exact arcs ([F]), Ackermann, constant velocity.

Wheels of other kinds are in `wheels`, velocities in the state of a robot of the plane in `coasting`, inertial units in
`inertial`, what all share in `kinematics`; all have their names here.

Three kinds of noise.  The *control's error* (`sigma_v_mps`, ...) is constant as long as the control is held, so its
displacement is sigma times the duration.  The *error common to all controls*, a constant or a share of them
(`sigma_v_bias_mps`, `sigma_scale`, ...), is in the map and estimated.  A *diffusion* (`..._per_sqrt_s`) is white: its
variance grows with time; in the plane along, across and about the robot, while the control is not zero (a robot with
zero control does not wander).
"""

from __future__ import annotations

import math
from functools import cached_property
from typing import Annotated

import numpy as np

from kalmark.arrays import Array
from kalmark.compiled import compiled
from kalmark.declare import Estimated, NotNegative, Number, Positive, register
from kalmark.geometry import frames3d
from kalmark.geometry.frames import compose
from kalmark.geometry.rotations import exp, left_jacobian, left_jacobian_rate, matrix, multiply, skew
from kalmark.geometry.spaces import ROTATION, SCALAR, SE3, VECTOR3, Space
from kalmark.models.kinematics import (
    MotionModel,
    PlanarMotion,
    Scale,
    SpeedAndTurn,
    Steered,
    SteeringBias,
    SteeringNoise,
    SteeringScale,
    TurnPerMetre,
    TurnScale,
    WheelSpeedBias,
    arc,
)
from kalmark.models.observe import CompiledVelocity
from kalmark.models.things import Thing

__all__ = [
    "Ackermann",
    "ConstantTurnRate",
    "ConstantVelocity",
    "ConstantVelocity3D",
    "DifferentialDrive",
    "Inertial",
    "InertialGravity",
    "Mecanum",
    "Odometry2D",
    "Odometry3D",
    "Omnidirectional",
    "SlippingUnicycle",
    "Thing",
    "Tricycle",
    "Unicycle",
    "Velocity3D",
    "noise_densities",
    "start_at_rest",
]  # fmt: skip


@compiled
def increment_in_plane(r: Array, u: Array, par: Array, dt: float) -> tuple[Array, Array, Array]:
    """Move r (3,) by u (3,) = (dx, dy, dtheta) in its own frame: the new r, R_r, R_u (3, 3).  [S] (59)-(60)."""
    return compose(r, u)


@compiled
def unicycle(r: Array, u: Array, par: Array, dt: float) -> tuple[Array, Array, Array]:
    """Move r (3,) by the speed and turn rate u (2,) for dt s: the new r, R_r (3, 3), R_u (3, 2)."""
    return arc(r, u[0], u[1], dt)


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


@compiled
def increment_in_space(r: Array, u: Array, par: Array, dt: float) -> tuple[Array, Array, Array]:
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


@compiled
def velocity_of_coasting(r: Array, par: Array) -> tuple[Array, Array]:
    """Return the velocity (v, w) of a state r (13,) in the robot's frame (6,), and its Jacobian (6, 12)."""
    Q_t, b, B_r = np.ascontiguousarray(matrix(r[3:7]).T), np.empty(6), np.zeros((6, 12))
    b[:3] = Q_t @ r[7:10]
    b[3:] = r[10:]
    B_r[:3, 3:6] = Q_t @ skew(r[7:10])
    B_r[:3, 6:9] = Q_t
    for i in range(3, 6):
        B_r[i, 6 + i] = 1.0
    return b, B_r


def _halves(u: Array) -> Array:
    """Return the first and the last three numbers of a control (6,) in a column each."""
    out = np.zeros((6, 2))
    out[:3, 0], out[3:, 1] = u[:3], u[3:]
    return out


@register("motion", "unicycle")
class Unicycle(SpeedAndTurn):
    """Speed and turn rate, each held until the next control.

    A control is u = (v m/s, w rad/s); the exact arc of [F] with both its limits.

    >>> km.motion.Unicycle().move(np.zeros(3), np.array((1.0, 0.5)), 2.0)[0].round(3)
    array([1.683, 0.919, 1.   ])
    """

    moves = unicycle


@register("motion", "odometry_2d")
class Odometry2D(PlanarMotion):
    """Increments dx, dy, dtheta in the robot's frame.

    A control u (3,) is the motion that ended at its time.  [S] (57)-(60).  The sigmas are those of one increment.  A
    diffusion counts the time since the last increment, none for the first.

    >>> km.motion.Odometry2D().move(np.zeros(3), np.array((1.0, 0.0, 0.1)), 0.1)[0].round(3)
    array([1. , 0. , 0.1])
    """

    sigma_x_m: Annotated[NotNegative, "Error of one increment, forward."] = 0.01
    sigma_y_m: Annotated[NotNegative, "Error of one increment, to the left."] = 0.0
    sigma_theta_rad: Annotated[NotNegative, "Error of one increment, heading."] = 0.02
    sigma_scale: Scale = 0.0
    sigma_turn_scale: TurnScale = 0.0
    sigma_turn_bias_radps: Annotated[Estimated, "Turn that all increments lack, in a second"] = 0.0
    sigma_turn_rad_per_m: TurnPerMetre = 0.0

    columns = ("dx_m", "dy_m", "dtheta_rad")
    held = False
    moves = increment_in_plane
    sigmas = ("sigma_x_m", "sigma_y_m", "sigma_theta_rad")
    calibrations = (
        ("scale", "sigma_scale"),
        ("turn_scale", "sigma_turn_scale"),
        ("turn_radps", "sigma_turn_bias_radps"),
        ("turn_rad_per_m", "sigma_turn_rad_per_m"),
    )

    def _effects(self, u: Array, dt_s: float) -> Array:
        return np.array([[u[0], 0, 0, 0], [u[1], 0, 0, 0], [0, u[2], dt_s, math.hypot(u[0], u[1])]])


@register("motion", "ackermann")
class Ackermann(Steered):
    """A car: wheel speed and steering angle, each held until the next control.

    A control is u = (speed of the left rear wheel m/s, steering rad); the state is the rear axle's centre.
    `encoder_offset_m` is the wheel's distance to the left of the centre line, negative to the right; 0 for a speed that
    is the axle's own.

    >>> km.motion.Ackermann().move(np.zeros(3), np.array((1.0, 0.2)), 1.0)[0].round(3)
    array([1.057, 0.04 , 0.076])
    """

    wheelbase_m: Annotated[Positive, "Distance between the axles."] = 2.83
    encoder_offset_m: Annotated[Number, "Wheel encoder, left of the middle of the rear axle."] = 0.76
    sigma_v_mps: Annotated[NotNegative, "Error of the wheel speed held over its interval."] = 0.1
    sigma_steering_rad: SteeringNoise = 0.02
    sigma_v_bias_mps: WheelSpeedBias = 0.0
    sigma_steering_bias_rad: SteeringBias = 0.0
    sigma_v_scale: Scale = 0.0
    sigma_steering_scale: SteeringScale = 0.0

    moves = ackermann

    @cached_property
    def parameters(self) -> Array:
        """The wheelbase and the offset of the encoder (2,), m."""
        return np.array([self.wheelbase_m, self.encoder_offset_m])


@register("motion", "odometry_3d")
class Odometry3D(MotionModel):
    """Increments dx, dy, dz and a rotation vector rx, ry, rz, in the robot's frame.

    A control is u (6,), m and rad.  The sigmas are those of one increment.

    >>> start = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
    >>> km.motion.Odometry3D().move(start, np.array((1.0, 0.0, 0.0, 0.0, 0.0, 0.1)), 1.0)[0].round(3)
    array([1.   , 0.   , 0.   , 0.   , 0.   , 0.05 , 0.999])
    """

    sigma_x_m: Annotated[NotNegative, "Error of one increment, forward."] = 0.01
    sigma_y_m: Annotated[NotNegative, "Error of one increment, to the left."] = 0.01
    sigma_z_m: Annotated[NotNegative, "Error of one increment, upwards."] = 0.01
    sigma_rotation_rad: Annotated[NotNegative, "Error of one increment, rotation about each axis."] = 0.005
    sigma_scale: Scale = 0.0
    sigma_turn_scale: TurnScale = 0.0
    sigma_turn_bias_radps: Annotated[Estimated, "Turn about each axis that they lack, in a second"] = 0.0

    space = SE3
    columns = ("dx_m", "dy_m", "dz_m", "rx_rad", "ry_rad", "rz_rad")
    held = False
    moves = increment_in_space
    sigmas = ("sigma_x_m", "sigma_y_m", "sigma_z_m", *3 * ("sigma_rotation_rad",))
    calibrations = (
        ("scale", "sigma_scale"),
        ("turn_scale", "sigma_turn_scale"),
        *((f"turn_{axis}_radps", "sigma_turn_bias_radps") for axis in "xyz"),
    )

    def _effects(self, u: Array, dt_s: float) -> Array:
        return np.hstack([_halves(u), np.vstack([np.zeros((3, 3)), dt_s * np.eye(3)])])


@register("motion", "velocity_3d")
class Velocity3D(MotionModel):
    """Velocity and turn rate in the robot's frame, each held until the next control.

    A control is u = (vx, vy, vz, wx, wy, wz), m/s and rad/s.

    >>> start = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
    >>> km.motion.Velocity3D().move(start, np.array((1.0, 0.0, 0.0, 0.0, 0.0, 0.1)), 1.0)[0].round(3)
    array([0.998, 0.05 , 0.   , 0.   , 0.   , 0.05 , 0.999])
    """

    sigma_vx_mps: Annotated[NotNegative, "Error of the velocity held over its interval, forward."] = 0.1
    sigma_vy_mps: Annotated[NotNegative, "Error of the velocity held over its interval, to the left."] = 0.1
    sigma_vz_mps: Annotated[NotNegative, "Error of the velocity held over its interval, upwards."] = 0.1
    sigma_wx_radps: Annotated[NotNegative, "Error of the turn rate held over its interval, about x."] = 0.05
    sigma_wy_radps: Annotated[NotNegative, "Error of the turn rate held over its interval, about y."] = 0.05
    sigma_wz_radps: Annotated[NotNegative, "Error of the turn rate held over its interval, about z."] = 0.05
    sigma_v_bias_mps: Annotated[Estimated, "Constant part of the speed's error on each axis"] = 0.0
    sigma_w_bias_radps: Annotated[Estimated, "Constant part of the turn rate's error about each axis"] = 0.0
    sigma_v_scale: Scale = 0.0
    sigma_w_scale: TurnScale = 0.0

    space = SE3
    columns = ("vx_mps", "vy_mps", "vz_mps", "wx_radps", "wy_radps", "wz_radps")
    held = True
    moves = twist
    sigmas = tuple(f"sigma_{column}" for column in columns)
    calibrations = (
        *((name, "sigma_v_bias_mps") for name in columns[:3]),
        *((name, "sigma_w_bias_radps") for name in columns[3:]),
        ("v_scale", "sigma_v_scale"),
        ("w_scale", "sigma_w_scale"),
    )

    def _effects(self, u: Array, dt_s: float) -> Array:
        return np.hstack([np.eye(6), _halves(u)])


@register("motion", "constant_velocity_3d")
class ConstantVelocity3D(MotionModel, CompiledVelocity):
    """Velocity and turn rate are in the state: it goes on as it goes, controls are changes of both, and needs none.

    The state is pose, velocity (world, m/s) and body rate (rad/s), 13 numbers and 12 errors.  The robot coasts to the
    time of each event.  A control is an impulse u = (dv (world), dw (body)) at its time, with sigmas `sigma_v_mps`,
    `sigma_w_radps`; `..._per_sqrt_s` are random walks of velocity and rate.

    >>> start = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 1.0, 0.0, 0.5, 0.0, 0.0, 0.0)
    >>> slam = km.Slam(km.Robot("drone", km.motion.ConstantVelocity3D(), start=start))
    >>> for t in (0.0, 2.0):
    ...     report = slam.process(km.Control(t, "drone", np.zeros(6)))
    >>> slam.mean("drone")[:3].round(2)
    array([2., 0., 1.])
    """

    sigma_v_mps: Annotated[NotNegative, "Error of the change of velocity that a control is."] = 0.01
    sigma_w_radps: Annotated[NotNegative, "Error of the change of turn rate that a control is."] = 0.002
    sigma_v_mps_per_sqrt_s: Annotated[NotNegative, "Random walk of the velocity, all the time."] = 0.0
    sigma_w_radps_per_sqrt_s: Annotated[NotNegative, "Random walk of the turn rate, all the time."] = 0.0

    space = Space("SE3 with velocity", (VECTOR3, ROTATION, VECTOR3, SCALAR, SCALAR, SCALAR))
    columns = ("dvx_mps", "dvy_mps", "dvz_mps", "dwx_radps", "dwy_radps", "dwz_radps")
    held = False
    moves = coast
    velocity = velocity_of_coasting
    coasts = True
    state_columns = ("vx_mps", "vy_mps", "vz_mps", "wx_radps", "wy_radps", "wz_radps")
    sigmas = (*3 * ("sigma_v_mps",), *3 * ("sigma_w_radps",))

    def diffusion(self, u: Array, dt_s: float) -> Array | None:
        """Return the covariance (12, 12) of the walks of velocity and rate, and of the way and turn they make."""
        v, w = self.sigma_v_mps_per_sqrt_s**2, self.sigma_w_radps_per_sqrt_s**2
        if not (v or w):
            return None
        way = np.array([[dt_s**3 / 3, dt_s**2 / 2], [dt_s**2 / 2, dt_s]])
        return np.kron(way, np.diag([v, v, v, w, w, w]))


# after those above, which messages and the page of the configuration name first
from kalmark.models.wheels import DifferentialDrive, Mecanum, Omnidirectional, SlippingUnicycle, Tricycle  # noqa: E402, I001
from kalmark.models.coasting import ConstantTurnRate, ConstantVelocity  # noqa: E402
from kalmark.models.inertial import Inertial, InertialGravity, start_at_rest, noise_densities  # noqa: E402
