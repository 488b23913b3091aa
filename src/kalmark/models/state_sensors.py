"""Sensors that measure their own robot: its pose, its velocity, or how it moved since their last reading.

Each makes one reading at a time.  It measures a `view` of the state (`models/state_view.py`).  A reading outside
the gate that `pass_share` of good readings pass is left out.  Constants of a sensor with a sigma, or with a random
walk, are in the map and are estimated (docs/state_sensors.md).
"""

from __future__ import annotations

import math
from dataclasses import KW_ONLY, replace
from functools import cached_property
from typing import Annotated, Any, ClassVar, Self

import numpy as np

from kalmark.arrays import Array, Flags
from kalmark.compiled import compiled
from kalmark.declare import NotNegative, Number, Positive, Probability, Within, declared, refuse, register
from kalmark.events import unit_quaternion
from kalmark.geometry.rotations import left_jacobian_inverse, log, matrix, skew, to_euler
from kalmark.models import landmark_views
from kalmark.models.landmark_views import Sensing, components, residual
from kalmark.models.protocols import CHANGE, POSE, TWIST

__all__ = [
    "AbsolutePose2D", "AbsolutePose3D", "BodyVelocity2D", "BodyVelocity3D", "Gps2D", "Gps3D", "Gravity", "GroundSpeed",
    "Gyro2D", "Gyro3D", "Heading", "Height", "Inclination", "Odometer2D", "Odometer3D", "Speed", "ZeroVelocity2D",
    "ZeroVelocity3D",
]  # fmt: skip

STILL_MPS = 1e-6  # a ground speed below which its direction means nothing
STANDARD_GRAVITY = 9.80665  # m/s^2


# ------------------------------------------------------------------ what is expected: e, z and E_v of one reading
@compiled
def heading(code: int, par: Array, angular: Flags, v: Array, y: Array) -> tuple[Array, Array, Array]:
    """Expect the heading of a pose v (1, 3) or (1, 7), of the sensor's x axis, less the declination `par`."""
    if v.shape[1] == 3:
        e, E_v = np.array([[v[0, 2] - par[0]]]), np.zeros((1, 1, 3))
        E_v[0, 0, 2] = 1.0
    else:
        Q, E_v = matrix(v[0, 3:].copy()), np.zeros((1, 1, 6))
        e = np.array([[math.atan2(Q[1, 0], Q[0, 0]) - par[0]]])
        steep = Q[2, 0] / (Q[0, 0] ** 2 + Q[1, 0] ** 2)
        E_v[0, 0, 3], E_v[0, 0, 4], E_v[0, 0, 5] = -Q[0, 0] * steep, -Q[1, 0] * steep, 1.0
    return e, residual(y, e, angular), E_v


@compiled
def inclination(code: int, par: Array, angular: Flags, v: Array, y: Array) -> tuple[Array, Array, Array]:
    """Expect roll and pitch of a pose v (1, 7)."""
    euler, E_q = to_euler(v[0, 3:].copy())
    e, E_v = np.array([[euler[0], euler[1]]]), np.zeros((1, 2, 6))
    E_v[0, :, 3:] = E_q[:2]
    return e, residual(y, e, angular), E_v


@compiled
def gravity(code: int, par: Array, angular: Flags, v: Array, y: Array) -> tuple[Array, Array, Array]:
    """Expect what an accelerometer at rest measures at a pose v (1, 7): g upwards, `par` = (g, bias (3,))."""
    R, up = matrix(v[0, 3:].copy()).T.copy(), np.array([0.0, 0.0, par[0]])
    e, E_v = (R @ up + par[1:]).reshape((1, 3)), np.zeros((1, 3, 6))
    E_v[0, :, 3:] = R @ skew(up)
    return e, y - e, E_v


@compiled
def velocity(code: int, par: Array, angular: Flags, v: Array, y: Array) -> tuple[Array, Array, Array]:
    """Expect the first numbers of the velocity of a twist v (1, 3) or (1, 6), divided by the gain `par`."""
    m = y.shape[1]
    e, E_v = np.empty((1, m)), np.zeros((1, m, v.shape[1]))
    for i in range(m):
        e[0, i], E_v[0, i, i] = v[0, i] / par[0], 1.0 / par[0]
    return e, y - e, E_v


@compiled
def ground_speed(code: int, par: Array, angular: Flags, v: Array, y: Array) -> tuple[Array, Array, Array]:
    """Expect the speed of a twist v (1, 3) or (1, 6), whatever its direction."""
    d, square, E_v = 2 if v.shape[1] == 3 else 3, 0.0, np.zeros((1, 1, v.shape[1]))
    for i in range(d):
        square += v[0, i] * v[0, i]
    speed = math.sqrt(square)
    if speed > STILL_MPS:
        for i in range(d):
            E_v[0, 0, i] = v[0, i] / speed
    e = np.array([[speed]])
    return e, y - e, E_v


@compiled
def increment(code: int, par: Array, angular: Flags, v: Array, y: Array) -> tuple[Array, Array, Array]:
    """Expect a change of pose v (1, 3) or (1, 7), its way divided by the gain `par`, its turn a rotation vector."""
    m = y.shape[1]
    d = m // 3 + 1  # 2 numbers of 3 are the way in the plane, 3 of 6 in space
    e, E_v = np.empty((1, m)), np.zeros((1, m, m))
    for i in range(d):
        e[0, i], E_v[0, i, i] = v[0, i] / par[0], 1.0 / par[0]
    if m == 3:
        e[0, 2], E_v[0, 2, 2] = v[0, 2], 1.0
    else:
        turn = log(v[0, 3:].copy())
        angle = np.sqrt(np.sum(turn**2))
        if angle > 0.0:  # the same turn the other way round, if that is nearer to y: about half a turn both may be read
            other = turn * (1.0 - 2.0 * np.pi / angle)
            if np.sum((other - y[0, 3:]) ** 2) < np.sum((turn - y[0, 3:]) ** 2):
                turn = other
        e[0, 3:] = turn
        E_v[0, 3:, 3:] = left_jacobian_inverse(turn)
    return e, residual(y, e, angular), E_v


# ------------------------------------------------------------------ and how that changes with the sensor's constants
@compiled
def subtract_constant(code: int, par: Array, angular: Flags, v: Array, e: Array) -> Array:
    """Return E_p (1, 1, 1) of a constant that is taken off."""
    return -np.ones((1, 1, 1))


@compiled
def add_constants(code: int, par: Array, angular: Flags, v: Array, e: Array) -> Array:
    """Return E_p (1, m, c) of constants that are added to the last numbers of a measurement."""
    m, c = e.shape[1], len(par)
    E_p = np.zeros((1, m, c))
    for i in range(m):
        E_p[0, i, c - m + i] = 1.0
    return E_p


@compiled
def plus_gravity(code: int, par: Array, angular: Flags, v: Array, e: Array) -> Array:
    """Return E_p (1, 3, 4) of g and of the biases of an accelerometer."""
    Q, E_p = matrix(v[0, 3:].copy()), add_constants(code, par, angular, v, e)
    for i in range(3):
        E_p[0, i, 0] = Q[2, i]
    return E_p


@compiled
def by_gain(code: int, par: Array, angular: Flags, v: Array, e: Array) -> Array:
    """Return E_p (1, m, 1) of the gain of all that are no angles."""
    E_p = np.zeros((1, e.shape[1], 1))
    for i in range(e.shape[1]):
        if not angular[i]:
            E_p[0, i, 0] = -e[0, i] / par[0]
    return E_p


Bias = Annotated[Number, "Constant part of every reading."]
Scale = Annotated[Positive, "Reading for each metre, or metre a second, in truth."]
SigmaBias = Annotated[NotNegative, "Standard deviation of the bias; above 0 it is in the map and is estimated."]
SigmaScale = Annotated[NotNegative, "Standard deviation of the scale; above 0 it is in the map and is estimated."]
Walk = Annotated[NotNegative, "Random walk of the bias; above 0 it is in the map and is estimated."]


@declared
class StateSensor(Sensing):
    """Base of all sensors of the state.

    `constants` are, for each number that `expected` takes, the parameter, that of its sigma, and that of its walk.
    """

    _: KW_ONLY
    pass_share: Annotated[Probability, "Share of good readings that pass the gate; others are left out."] = 0.9999

    views: ClassVar[str]
    expected: ClassVar[Any]
    constants: ClassVar[tuple[tuple[str, str, str], ...]] = ()
    code: ClassVar[int] = 0
    sees_kinds = ()

    def expect(self, v: Array, y: Array | None = None) -> tuple[Array, Array]:
        """Return the expected readings (K, m) of views v (K, d), and E_v (K, p, errors of the view)."""
        y = np.zeros((len(v), len(self.columns))) if y is None else y
        par, angular = np.array(self.parameters), np.array(self.angular, dtype=np.bool_)
        of = type(self).expected
        rows = [
            of(self.code, par, angular, np.ascontiguousarray(v[k : k + 1]), np.array(y[k : k + 1]))
            for k in range(len(v))
        ]
        return np.concatenate([e for e, _, _ in rows]), np.concatenate([E_v for _, _, E_v in rows])

    # ------------------------------------------------------------------ its constants
    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Their names."""
        return tuple(name for name, _, _ in self.constants)

    @cached_property
    def parameters(self) -> Array:
        """The constants (p,) of its expectation."""
        return np.array([vars(self)[name] for name, _, _ in self.constants], dtype=np.float64)

    @cached_property
    def parameter_cov(self) -> Array | None:
        """Their covariance (p, p), None if they are known and stay as they are."""
        sigmas = np.array([vars(self).get(name, 0.0) for _, name, _ in self.constants])
        return np.diag(sigmas**2) if sigmas.any() or self._walks.any() else None

    @cached_property
    def _walks(self) -> Array:
        return np.array([vars(self).get(name, 0.0) for _, _, name in self.constants])

    def with_parameters(self, parameters: Array) -> Self:
        """Return the sensor with other constants (p,)."""
        names = [name for name, _, _ in self.constants]
        return replace(self, **dict(zip(names, np.asarray(parameters).tolist(), strict=True)))

    def parameters_jacobian(self, v: Array) -> Array:
        """Return E_p (K, m, p): how the readings of views v (K, d) change with the constants."""
        if type(self).varied is None:
            return np.zeros((len(v), len(self.columns), 0))
        e, par, angular = self.expect(v)[0], np.array(self.parameters), np.array(self.angular, dtype=np.bool_)
        rows = [np.ascontiguousarray(each)[None] for each in v]
        return np.concatenate(
            [type(self).varied(0, par, angular, row, each[None]) for row, each in zip(rows, e, strict=True)]
        )

    def drift(self, dt_s: float) -> Array:
        """Return the variances (p,) that the constants gather in `dt_s`."""
        return np.asarray(self._walks**2 * dt_s)


# ------------------------------------------------------------------ of the pose
@register("sensor", "heading")
class Heading(StateSensor):
    """A compass: the heading of the sensor's x axis, from the map's x axis to the left, less the declination.

    >>> own = km.Mount(km.sensors.Heading())
    >>> slam = km.Slam(km.Robot("rover", km.motion.Unicycle(), sensors={"own": own}, cov=np.eye(3)))
    >>> report = slam.process(km.Scan(0.0, "rover", "own", [[0.3]]))
    >>> slam.mean("rover").round(2)
    array([0. , 0. , 0.3])
    """

    sigma_heading_rad: Annotated[Positive, "Noise of the heading."] = 0.05
    _: KW_ONLY
    declination_rad: Annotated[Number, "Heading in the map of what reads 0."] = 0.0
    sigma_declination_rad: Annotated[
        NotNegative, "Standard deviation of the declination; above 0 it is in the map and is estimated."
    ] = 0.0

    columns = ("heading_rad",)
    sigmas = ("sigma_heading_rad",)
    views = POSE
    expected = heading
    varied = subtract_constant
    constants = (("declination_rad", "sigma_declination_rad", ""),)


@declared
class _Gps(StateSensor):
    sigma_m: Annotated[Positive, "Noise of each coordinate."] = 1.0
    _: KW_ONLY
    sigma_bias_m: Annotated[
        NotNegative, "Standard deviation of an error that lasts, at first; above 0 it is in the map and is estimated."
    ] = 0.0
    sigma_bias_m_per_sqrt_s: Annotated[
        NotNegative, "Random walk of an error that lasts; above 0 it is in the map and is estimated."
    ] = 0.0

    views = POSE
    expected = components
    varied = add_constants


@register("sensor", "gps")
class Gps2D(_Gps):
    """The position of an antenna, at its mount, in the map's frame: GPS, a total station, a beacon system.

    >>> own = km.Mount(km.sensors.Gps2D())
    >>> slam = km.Slam(km.Robot("rover", km.motion.Unicycle(), sensors={"own": own}, cov=np.eye(3)))
    >>> report = slam.process(km.Scan(0.0, "rover", "own", [[2.0, 1.0]]))
    >>> slam.mean("rover").round(2)
    array([ 1. ,  0.5, -0. ])
    """

    _: KW_ONLY
    bias_x_m: Bias = 0.0
    bias_y_m: Bias = 0.0

    world = "plane"
    columns = ("x_m", "y_m")
    sigmas = ("sigma_m",) * 2
    constants = tuple((f"bias_{axis}_m", "sigma_bias_m", "sigma_bias_m_per_sqrt_s") for axis in "xy")


@register("sensor", "gps")
class Gps3D(_Gps):
    """The position of an antenna, at its mount, in the map's frame.

    >>> own = km.Mount(km.sensors.Gps3D())
    >>> slam = km.Slam(km.Robot("drone", km.motion.Odometry3D(), sensors={"own": own}, cov=np.eye(6)))
    >>> report = slam.process(km.Scan(0.0, "drone", "own", [[2.0, 1.0, 0.5]]))
    >>> slam.mean("drone")[:3].round(2)
    array([1.  , 0.5 , 0.25])
    """

    _: KW_ONLY
    sigma_z_m: Annotated[float | None, Within(gt=0), "Noise of the height; sigma_m if absent."] = None
    bias_x_m: Bias = 0.0
    bias_y_m: Bias = 0.0
    bias_z_m: Bias = 0.0

    world = "space"
    columns = ("x_m", "y_m", "z_m")
    sigmas = ("sigma_m", "sigma_m", "sigma_z_m")
    constants = tuple((f"bias_{axis}_m", "sigma_bias_m", "sigma_bias_m_per_sqrt_s") for axis in "xyz")

    @cached_property
    def _variances(self) -> tuple[float, ...]:
        return tuple((vars(self)[name] or self.sigma_m) ** 2 for name in self.sigmas)


@register("sensor", "absolute_pose")
class AbsolutePose2D(StateSensor):
    """A pose in the map's frame: motion capture, another localisation.

    >>> own = km.Mount(km.sensors.AbsolutePose2D())
    >>> slam = km.Slam(km.Robot("rover", km.motion.Unicycle(), sensors={"own": own}, cov=np.eye(3)))
    >>> report = slam.process(km.Scan(0.0, "rover", "own", [[2.0, 1.0, 0.3]]))
    >>> slam.mean("rover").round(2)
    array([2. , 1. , 0.3])
    """

    sigma_m: Annotated[Positive, "Noise of each coordinate."] = 0.01
    sigma_theta_rad: Annotated[Positive, "Noise of the heading."] = 0.01

    world = "plane"
    columns = ("x_m", "y_m", "theta_rad")
    sigmas = ("sigma_m", "sigma_m", "sigma_theta_rad")
    views = POSE
    expected = components


@register("sensor", "absolute_pose")
class AbsolutePose3D(StateSensor):
    """A pose in the map's frame: motion capture, another localisation.

    >>> own = km.Mount(km.sensors.AbsolutePose3D())
    >>> slam = km.Slam(km.Robot("drone", km.motion.Odometry3D(), sensors={"own": own}, cov=np.eye(6)))
    >>> report = slam.process(km.Scan(0.0, "drone", "own", [[2.0, 1.0, 0.5, 0.0, 0.0, 0.0, 1.0]]))
    >>> slam.mean("drone")[:3].round(2)
    array([2. , 1. , 0.5])
    """

    sigma_m: Annotated[Positive, "Noise of each coordinate."] = 0.01
    sigma_rotation_rad: Annotated[Positive, "Noise of the rotation about each axis."] = 0.01

    world = "space"
    columns = ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")
    sigmas = (*("sigma_m",) * 3, *("sigma_rotation_rad",) * 3)
    cov_size = 6
    views = POSE
    expected = landmark_views.tag_pose

    def expect(self, v: Array, y: Array | None = None) -> tuple[Array, Array]:
        """Return the poses v (K, 7) themselves, and how the innovations of y (K, 7) change with them (K, 6, 6)."""
        return super().expect(v, v if y is None else y)

    def check(self, y: Array) -> None:
        """Refuse a quaternion that is none."""
        unit_quaternion(y[0, 3:])


@register("sensor", "height")
class Height(StateSensor):
    """Height above the map's origin: a barometer, with the drift of its bias.

    >>> own = km.Mount(km.sensors.Height())
    >>> slam = km.Slam(km.Robot("drone", km.motion.Odometry3D(), sensors={"own": own}, cov=np.eye(6)))
    >>> report = slam.process(km.Scan(0.0, "drone", "own", [[1.5]]))
    >>> slam.mean("drone")[:3].round(2)
    array([0.  , 0.  , 1.38])
    """

    sigma_z_m: Annotated[Positive, "Noise of the height."] = 0.3
    _: KW_ONLY
    bias_m: Bias = 0.0
    sigma_bias_m: SigmaBias = 0.0
    sigma_bias_m_per_sqrt_s: Walk = 0.0

    world = "space"
    columns = ("z_m",)
    sigmas = ("sigma_z_m",)
    views = POSE
    expected = components
    code = 2
    varied = add_constants
    constants = (("bias_m", "sigma_bias_m", "sigma_bias_m_per_sqrt_s"),)


@register("sensor", "inclination")
class Inclination(StateSensor):
    """Roll and pitch of the sensor: an inclinometer, a vertical reference.

    >>> own = km.Mount(km.sensors.Inclination())
    >>> slam = km.Slam(km.Robot("drone", km.motion.Odometry3D(), sensors={"own": own}, cov=np.eye(6)))
    >>> report = slam.process(km.Scan(0.0, "drone", "own", [[0.1, 0.0]]))
    >>> slam.mean("drone")[3:].round(2)
    array([0.05, 0.  , 0.  , 1.  ])
    """

    sigma_rad: Annotated[Positive, "Noise of each angle."] = 0.01

    world = "space"
    columns = ("roll_rad", "pitch_rad")
    sigmas = ("sigma_rad",) * 2
    views = POSE
    expected = inclination


@register("sensor", "gravity")
class Gravity(StateSensor):
    """An accelerometer where its robot does not accelerate: it measures g, upwards, in its own frame.

    >>> own = km.Mount(km.sensors.Gravity())
    >>> slam = km.Slam(km.Robot("drone", km.motion.Odometry3D(), sensors={"own": own}, cov=np.eye(6)))
    >>> report = slam.process(km.Scan(0.0, "drone", "own", [[0.0, 0.98, 9.76]]))
    >>> slam.mean("drone")[3:].round(2)
    array([0.05, 0.  , 0.  , 1.  ])
    """

    sigma_mps2: Annotated[Positive, "Noise of each component, unmodelled accelerations included."] = 0.2
    _: KW_ONLY
    gravity_mps2: Annotated[Positive, "Acceleration of gravity."] = STANDARD_GRAVITY
    bias_x_mps2: Bias = 0.0
    bias_y_mps2: Bias = 0.0
    bias_z_mps2: Bias = 0.0
    sigma_bias_mps2: SigmaBias = 0.0

    world = "space"
    columns = ("ax_mps2", "ay_mps2", "az_mps2")
    sigmas = ("sigma_mps2",) * 3
    views = POSE
    expected = gravity
    varied = plus_gravity
    constants = (
        ("gravity_mps2", "", ""), *((f"bias_{axis}_mps2", "sigma_bias_mps2", "") for axis in "xyz"),
    )  # fmt: skip


# ------------------------------------------------------------------ of the velocity
@declared
class _Gyro(StateSensor):
    sigma_radps: Annotated[NotNegative, "Noise of a reading."] = 0.002
    _: KW_ONLY
    sigma_rad_per_sqrt_s: Annotated[
        NotNegative, "Angle random walk, the density of a data sheet: what a reading has besides, by the time it means."
    ] = 0.0
    sigma_bias_radps: SigmaBias = 0.0
    sigma_bias_radps_per_sqrt_s: Walk = 0.0

    views = TWIST
    sees_rates: ClassVar[bool] = True
    expected = components
    varied = add_constants

    def __post_init__(self) -> None:
        if not (self.sigma_radps or self.sigma_rad_per_sqrt_s):
            raise refuse(self, "sigma_radps", "a positive number")

    def noise_since(self, dt_s: float) -> Array:
        """Return the noise R (1, m, m) of a reading that means the time since the last one, `dt_s`."""
        variance = self.sigma_radps**2 + self.sigma_rad_per_sqrt_s**2 / dt_s
        return variance * np.eye(len(self.columns))[None]


@register("sensor", "gyro")
class Gyro2D(_Gyro):
    """A gyroscope: the turn rate, with the bias of the sensor and its random walk.

    >>> own = km.Mount(km.sensors.Gyro2D())
    >>> slam = km.Slam(km.Robot("rover", km.motion.ConstantTurnRate(), sensors={"own": own}, cov=np.eye(5)))
    >>> report = slam.process(km.Scan(0.0, "rover", "own", [[0.2]]))
    >>> slam.mean("rover")[3:].round(2)
    array([0. , 0.2])
    """

    _: KW_ONLY
    bias_radps: Bias = 0.0

    world = "plane"
    code = 2
    columns = ("w_radps",)
    sigmas = ("sigma_radps",)
    constants = (("bias_radps", "sigma_bias_radps", "sigma_bias_radps_per_sqrt_s"),)


@register("sensor", "gyro")
class Gyro3D(_Gyro):
    """A gyroscope: the rates about the sensor's axes, with the biases of the sensor and their random walk.

    >>> own = km.Mount(km.sensors.Gyro3D())
    >>> slam = km.Slam(km.Robot("drone", km.motion.ConstantVelocity3D(), sensors={"own": own}, cov=np.eye(12)))
    >>> report = slam.process(km.Scan(0.0, "drone", "own", [[0.0, 0.0, 0.2]]))
    >>> slam.mean("drone")[10:].round(2)
    array([0. , 0. , 0.2])
    """

    _: KW_ONLY
    bias_x_radps: Bias = 0.0
    bias_y_radps: Bias = 0.0
    bias_z_radps: Bias = 0.0

    world = "space"
    code = 3
    columns = ("wx_radps", "wy_radps", "wz_radps")
    sigmas = ("sigma_radps",) * 3
    constants = tuple((f"bias_{axis}_radps", "sigma_bias_radps", "sigma_bias_radps_per_sqrt_s") for axis in "xyz")


@declared
class _Scaled(StateSensor):
    """A sensor with a scale.  In the map is the gain = 1 / scale: so what a wrong scale does is linear in its error."""

    _: KW_ONLY
    scale: Scale = 1.0
    sigma_scale: SigmaScale = 0.0

    varied = by_gain

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """The name of the gain."""
        return ("gain",)

    @cached_property
    def parameters(self) -> Array:
        """The gain (1,)."""
        return np.array([1.0 / self.scale])

    @cached_property
    def parameter_cov(self) -> Array | None:
        """Its variance (1, 1), None if it is known."""
        return np.array([[self.sigma_scale**2 / self.scale**4]]) if self.sigma_scale else None

    def with_parameters(self, parameters: Array) -> Self:
        """Return the sensor with another gain (1,)."""
        return replace(self, scale=1.0 / float(parameters[0]))


@declared
class _Velocity(_Scaled):
    sigma_mps: Annotated[Positive, "Noise of each component."] = 0.05

    views = TWIST
    expected = velocity


@register("sensor", "body_velocity")
class BodyVelocity2D(_Velocity):
    """The velocity in the sensor's frame: optical flow, a Doppler log, wheels that do not slip.

    >>> own = km.Mount(km.sensors.BodyVelocity2D())
    >>> slam = km.Slam(km.Robot("rover", km.motion.ConstantVelocity(), sensors={"own": own}, cov=np.eye(6)))
    >>> report = slam.process(km.Scan(0.0, "rover", "own", [[0.5, 0.1]]))
    >>> slam.mean("rover")[3:5].round(2)
    array([0.5, 0.1])
    """

    world = "plane"
    columns = ("vx_mps", "vy_mps")
    sigmas = ("sigma_mps",) * 2


@register("sensor", "body_velocity")
class BodyVelocity3D(_Velocity):
    """The velocity in the sensor's frame: a Doppler log, optical flow with a height.

    >>> own = km.Mount(km.sensors.BodyVelocity3D())
    >>> slam = km.Slam(km.Robot("drone", km.motion.ConstantVelocity3D(), sensors={"own": own}, cov=np.eye(12)))
    >>> report = slam.process(km.Scan(0.0, "drone", "own", [[0.5, 0.1, 0.0]]))
    >>> slam.mean("drone")[7:10].round(2)
    array([0.5, 0.1, 0. ])
    """

    world = "space"
    columns = ("vx_mps", "vy_mps", "vz_mps")
    sigmas = ("sigma_mps",) * 3


@register("sensor", "speed")
class Speed(_Velocity):
    """The velocity along the sensor's x axis: wheel speeds.

    >>> own = km.Mount(km.sensors.Speed())
    >>> slam = km.Slam(km.Robot("rover", km.motion.ConstantTurnRate(), sensors={"own": own}, cov=np.eye(5)))
    >>> report = slam.process(km.Scan(0.0, "rover", "own", [[0.5]]))
    >>> slam.mean("rover")[3:].round(2)
    array([0.5, 0. ])
    """

    columns = ("v_mps",)
    sigmas = ("sigma_mps",)


@register("sensor", "ground_speed")
class GroundSpeed(StateSensor):
    """The speed in any direction, as GPS receivers measure it.

    >>> own = km.Mount(km.sensors.GroundSpeed())
    >>> start = (0.0, 0.0, 0.0, 1.0, 0.0)
    >>> motion, cov = km.motion.ConstantTurnRate(), np.eye(5)
    >>> slam = km.Slam(km.Robot("rover", motion, start=start, sensors={"own": own}, cov=cov))
    >>> report = slam.process(km.Scan(0.0, "rover", "own", [[1.5]]))
    >>> slam.mean("rover")[3:].round(2)
    array([1.5, 0. ])
    """

    sigma_mps: Annotated[Positive, "Noise of the speed."] = 0.1

    columns = ("speed_mps",)
    sigmas = ("sigma_mps",)
    views = TWIST
    expected = ground_speed


@declared
class _ZeroVelocity(StateSensor):
    window_s: Annotated[Positive, "Time over which a robot must stand to be detected."] = 1.0
    _: KW_ONLY
    slowest_mps: Annotated[Positive, "The slowest motion that is not to be taken for standing."] = 0.05
    slowest_radps: Annotated[Positive, "The slowest turn that is not to be taken for standing."] = 0.05
    false_alarm: Annotated[Probability, "Share of windows in which so slow a motion is taken for standing."] = 0.001
    sigma_mps: Annotated[Positive, "Velocity of a robot that stands, on each axis."] = 0.005
    sigma_radps: Annotated[Positive, "Turn rate of a robot that stands, about each axis."] = 0.005

    views = TWIST
    sees_rates: ClassVar[bool] = True
    expected = components


@register("sensor", "zero_velocity")
class ZeroVelocity2D(_ZeroVelocity):
    """Readings of zero velocity, made where the other sensors show that the robot stands.

    No rows in the log are needed; rows that there are, of a brake for example, are readings.  docs/state_sensors.md.

    >>> km.sensors.ZeroVelocity2D().columns
    ('vx_mps', 'vy_mps', 'w_radps')
    """

    world = "plane"
    columns = ("vx_mps", "vy_mps", "w_radps")
    sigmas = ("sigma_mps", "sigma_mps", "sigma_radps")


@register("sensor", "zero_velocity")
class ZeroVelocity3D(_ZeroVelocity):
    """Readings of zero velocity, made where the other sensors show that the robot stands.

    No rows in the log are needed; rows that there are, of a brake for example, are readings.  docs/state_sensors.md.

    >>> km.sensors.ZeroVelocity3D(sigma_mps=0.002).sigma_mps
    0.002
    """

    world = "space"
    columns = ("vx_mps", "vy_mps", "vz_mps", "wx_radps", "wy_radps", "wz_radps")
    sigmas = (*("sigma_mps",) * 3, *("sigma_radps",) * 3)


# ------------------------------------------------------------------ of the way since the last reading
@declared
class _Odometer(_Scaled):
    sigma_m: Annotated[Positive, "Noise of each coordinate of one increment."] = 0.01
    sigma_rad: Annotated[Positive, "Noise of each angle of one increment."] = 0.01
    _: KW_ONLY
    keep: Annotated[
        int,
        Within(ge=0),
        "Poses of its last scans that are kept: an `id`, the time of one, names the reference; 0: of a whole log "
        "those that later readings count from.",
    ] = 1

    views = CHANGE
    expected = increment


@register("sensor", "odometer")
class Odometer2D(_Odometer):
    """The motion of the sensor since its last reading, in its frame at that time: a second odometry, scan matching.

    >>> own = km.Mount(km.sensors.Odometer2D())
    >>> slam = km.Slam(km.Robot("rover", km.motion.Unicycle(), sensors={"own": own}, cov=np.eye(3)))
    >>> for t, y in enumerate([[0.0, 0.0, 0.0], [0.5, 0.0, 0.1]]):
    ...     report = slam.process(km.Control(float(t), "rover", (0.4, 0.1)))
    ...     report = slam.process(km.Scan(float(t), "rover", "own", [y]))
    >>> slam.mean("rover").round(2)
    array([0.5 , 0.02, 0.1 ])
    """

    world = "plane"
    columns = ("dx_m", "dy_m", "dtheta_rad")
    sigmas = ("sigma_m", "sigma_m", "sigma_rad")


@register("sensor", "odometer")
class Odometer3D(_Odometer):
    """The motion of the sensor since its last reading, in its frame at that time; its turn is a rotation vector.

    >>> own = km.Mount(km.sensors.Odometer3D())
    >>> slam = km.Slam(km.Robot("drone", km.motion.ConstantVelocity3D(), sensors={"own": own}, cov=np.eye(12)))
    >>> for t, y in enumerate([np.zeros(6), [0.5, 0.0, 0.0, 0.0, 0.0, 0.1]]):
    ...     report = slam.process(km.Scan(float(t), "drone", "own", [y]))
    >>> slam.mean("drone")[:3].round(2)
    array([0.5 , 0.02, 0.  ])
    """

    world = "space"
    columns = ("dx_m", "dy_m", "dz_m", "rx_rad", "ry_rad", "rz_rad")
    sigmas = (*("sigma_m",) * 3, *("sigma_rad",) * 3)
