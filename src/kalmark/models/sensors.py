"""Sensors: what each measures of something in its frame.  [S] A.4, Table 2.

Those of the plane measure something at v = (x, y[, signature]).  Those of space look along x, x forward, y left, z up;
cameras look along z, x right in the image, y down.
"""

from __future__ import annotations

import math
from dataclasses import KW_ONLY, replace
from functools import cached_property, lru_cache
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np

from kalmark.arrays import Array, Flags
from kalmark.compiled import compiled
from kalmark.declare import (
    Estimated,
    Limit,
    NotNegative,
    Number,
    Positive,
    Within,
    built_in,
    declared,
    refuse,
    register,
)
from kalmark.errors import EventError
from kalmark.geometry.directions import inv_spherical_many
from kalmark.geometry.frames import inv_scan_many, scan_many
from kalmark.geometry.gaussian import intersection
from kalmark.models import cameras, lines, seen, tags, walls
from kalmark.models.doppler import Radar2D, Radar3D, RangeRate2D, RangeRate3D
from kalmark.models.radio import RangeDifference2D, RangeDifference3D, SignalStrength2D, SignalStrength3D
from kalmark.models.seen import refuse_negative_ranges
from kalmark.models.state_sensors import (
    AbsolutePose2D,
    AbsolutePose3D,
    BodyVelocity2D,
    BodyVelocity3D,
    Gps2D,
    Gps3D,
    Gravity,
    GroundSpeed,
    Gyro2D,
    Gyro3D,
    Heading,
    Height,
    Inclination,
    Odometer2D,
    Odometer3D,
    Speed,
    ZeroVelocity2D,
    ZeroVelocity3D,
)

__all__ = [
    "AbsolutePose2D", "AbsolutePose3D", "Bearing", "BodyVelocity2D", "BodyVelocity3D", "Gps2D", "Gps3D", "Gravity",
    "GroundSpeed", "Gyro2D", "Gyro3D", "Heading", "Height", "Inclination", "Odometer2D", "Odometer3D",
    "Omnidirectional", "PinHole", "PixelDepth", "Position2D", "Position3D", "Radar2D", "Radar3D", "Range",
    "RangeBearing", "RangeBearing3D", "RangeBearingSignature", "RangeDifference2D", "RangeDifference3D", "RangeRate2D",
    "RangeRate3D", "Segments", "SignalStrength2D", "SignalStrength3D", "Speed", "Stereo", "TagCorners", "TagPose",
    "Wall", "ZeroVelocity2D", "ZeroVelocity3D",
]  # fmt: skip

TELLING = 12.0  # by so much chi-square the second pose of a tag must be worse for the first to be believed
FISHEYE = (400.0, -254.647909)  # 400 px at 90 degrees from the axis, in proportion to the angle
FISHEYE_BACK = (
    254.647909, 0.0, -0.00130899694, 0.0, -1.34575854e-09, 0.0, -1.97650363e-15, 0.0, -3.04801702e-21, 0.0,
    -4.74790438e-27, 0.0, -7.41305337e-33, 0.0, -1.15807555e-38, 0.0, -1.80940987e-44, 0.0, -2.82717051e-50,
)  # fmt: skip

RANGE_BEARING, BEARING, RANGE, POSITION, RANGE_BEARING_SIGNATURE = range(1, 6)  # codes of the planar sensors

# parameters that several sensors have
BearingNoise = Annotated[Positive, "Noise of the bearing."]
PixelNoise = Annotated[Positive, "Noise of each pixel coordinate."]
ImageWidth = Annotated[Positive, "Width of the image."]
ImageHeight = Annotated[Positive, "Height of the image."]
Numbers = Annotated[tuple[float, ...], Within()]


@lru_cache(maxsize=256)
def _cached(variances: tuple[float, ...], count: int) -> Array:
    return np.tile(np.diag(variances), (count, 1, 1))


def constant(variances: tuple[float, ...], count: int) -> Array:
    """Return `count` copies of a diagonal covariance (count, m, m)."""
    return _cached(variances, count).copy()


@compiled
def measured_in_plane(code: int, v: Array) -> tuple[Array, Array]:
    """Return the measurements (K, m) that the built-in sensor `code` makes of v (K, d), and E_v (K, m, d)."""
    k, d = v.shape
    if code == POSITION:
        e, E_v = np.empty((k, 2)), np.zeros((k, 2, d))
        for i in range(k):
            e[i, 0], e[i, 1] = v[i, 0], v[i, 1]
            E_v[i, 0, 0] = E_v[i, 1, 1] = 1.0
        return e, E_v
    y, Y_p = scan_many(v)
    first, last = (1, 2) if code == BEARING else (0, 1 if code == RANGE else 2)
    m = last - first + (1 if code == RANGE_BEARING_SIGNATURE else 0)
    e, E_v = np.empty((k, m)), np.zeros((k, m, d))
    for i in range(k):
        for j in range(first, last):
            e[i, j - first] = y[i, j]
            E_v[i, j - first, 0], E_v[i, j - first, 1] = Y_p[i, j, 0], Y_p[i, j, 1]
        if code == RANGE_BEARING_SIGNATURE:
            e[i, 2], E_v[i, 2, 2] = v[i, 2], 1.0
    return e, E_v


@compiled
def in_plane(code: int, par: Array, angular: Flags, v: Array, y: Array) -> tuple[Array, Array, Array]:
    """Return e (K, m), the innovations z (K, m) of y (K, m), and E_v (K, m, d)."""
    e, E_v = measured_in_plane(code, v)
    if len(par) == 2:  # gain and offset of the range
        for i in range(len(e)):
            e[i, 0] = (e[i, 0] + par[1]) / par[0]
            for j in range(E_v.shape[2]):
                E_v[i, 0, j] /= par[0]
    return e, seen.residual(y, e, angular), E_v


@compiled
def by_gain_and_offset(code: int, par: Array, angular: Flags, v: Array, e: Array) -> Array:
    """Return E_p (K, m, 2): how measurements e (K, m), the first a range, change with its gain and offset."""
    E_p = np.zeros((len(e), e.shape[1], 2))
    for i in range(len(e)):
        E_p[i, 0, 0], E_p[i, 0, 1] = -e[i, 0] / par[0], 1.0 / par[0]
    return E_p


class _Sensor:
    """What all sensors share: `columns`, and white noise whose `sigmas` are the parameters of these names."""

    columns: ClassVar[tuple[str, ...]]
    sigmas: ClassVar[tuple[str, ...]]

    @property
    def angular(self) -> tuple[bool, ...]:
        """Which components are angles: those in rad."""
        return tuple(column.endswith("_rad") for column in self.columns)

    def noise(self, y: Array) -> Array:
        """Return the noise R (K, p, p) of the innovations of measurements y (K, m)."""
        return constant(self._variances, len(y))

    @cached_property
    def _variances(self) -> tuple[float, ...]:
        return tuple(vars(self)[name] ** 2 for name in self.sigmas)


# ---------------------------------------------------------------------- of the plane
@declared
class _Planar(_Sensor):
    """What the planar sensors share: limits of sight, built-in expectation."""

    _: KW_ONLY
    range_min_m: Annotated[NotNegative, "Nearest landmark the sensor sees."] = 0.0
    range_max_m: Annotated[Limit, "Farthest landmark the sensor sees."] = math.inf
    fov_rad: Annotated[Positive, "Field of view, centred forward."] = 2 * math.pi

    world: ClassVar[str] = "plane"
    expected: ClassVar[Any] = in_plane
    code: ClassVar[int]

    def expect(self, v: Array) -> tuple[Array, Array]:
        """Return the expected measurements (K, m) of v (K, d), and E_v (K, m, d)."""
        return measured_in_plane(self.code, np.ascontiguousarray(v, dtype=np.float64))

    def sees(self, v: Array) -> Flags:
        """Return which of v (K, d) lie within the sensor's range limits and field of view."""
        distance, bearing = np.hypot(v[:, 0], v[:, 1]), np.abs(np.arctan2(v[:, 1], v[:, 0]))
        inside: Flags = (self.range_min_m <= distance) & (distance <= self.range_max_m)
        return inside & (bearing <= self.fov_rad / 2)


@declared
class _Ranging(_Planar):
    """Sensors whose first component is a range, scale * distance + bias: its noise may grow with it.  [F].

    Where the scale or the bias has a sigma they are in the map, as the `parameters` gain = 1 / scale and offset =
    bias / scale of distance = gain * range - offset: so what a wrong scale does to landmarks is linear in its error,
    and the filter stays consistent (docs/range_only.md).
    """

    sigma_range_m: Annotated[NotNegative, "Constant part a of the range noise sqrt(a^2 + (b r)^2)."] = 0.1
    _: KW_ONLY
    sigma_range_rel: Annotated[NotNegative, "Part b of the range noise, growing with range."] = 0.0
    scale: Annotated[Positive, "Measured range per metre of distance."] = 1.0
    bias_m: Annotated[Number, "Added to every range."] = 0.0
    sigma_scale: Annotated[Estimated, "Standard deviation of the scale"] = 0.0
    sigma_bias_m: Annotated[Estimated, "Standard deviation of the bias"] = 0.0

    def __post_init__(self) -> None:
        if not (self.sigma_range_m or self.sigma_range_rel):
            raise refuse(self, "sigma_range_m", "a positive number")

    varied: ClassVar[Any] = by_gain_and_offset
    parameter_names: ClassVar[tuple[str, ...]] = ("gain", "offset")

    @property
    def parameters(self) -> Array:
        """Gain and offset of the range (2,)."""
        return np.array([1.0, self.bias_m]) / self.scale

    @property
    def parameter_cov(self) -> Array | None:
        """The covariance (2, 2) of gain and offset, None if both are known."""
        if not (self.sigma_scale or self.sigma_bias_m):
            return None
        J = np.array([[-1.0 / self.scale, 0.0], [-self.bias_m / self.scale, 1.0]]) / self.scale
        return np.asarray(J @ np.diag([self.sigma_scale**2, self.sigma_bias_m**2]) @ J.T)

    def with_parameters(self, parameters: Array) -> Self:
        """Return the sensor with another gain and offset (2,)."""
        gain, offset = parameters.tolist()
        return replace(self, scale=1.0 / gain, bias_m=offset / gain)

    def expect(self, v: Array) -> tuple[Array, Array]:
        """Return the expected measurements (K, m) of v (K, d), and E_v (K, m, d)."""
        e, E_v = super().expect(v)
        e[:, 0] = self.scale * e[:, 0] + self.bias_m
        E_v[:, 0] *= self.scale
        return e, E_v

    def parameters_jacobian(self, v: Array) -> Array:
        """Return E_p (K, m, 2): how the measurements of v (K, d) change with gain and offset."""
        e, _ = self.expect(v)
        E_p = np.zeros((*e.shape, 2))
        E_p[:, 0, 0], E_p[:, 0, 1] = -self.scale * e[:, 0], self.scale
        return E_p

    def distances(self, y: Array) -> Array:
        """Return the distances (K,) that measurements y (K, m) stand for."""
        return np.asarray((y[:, 0] - self.bias_m) / self.scale)

    def points(self, y: Array) -> tuple[Array, Array]:
        """Return the points (K, 2) that ranges and bearings y (K, 2) stand for, and V_y (K, 2, 2).  [S] (62)."""
        seen = y[:, :2].copy()
        if self.scale == 1.0 and self.bias_m == 0.0:
            return inv_scan_many(seen)
        seen[:, 0] = self.distances(y)
        p, P_y = inv_scan_many(seen)
        P_y[:, :, 0] /= self.scale
        return p, P_y

    @property
    def additive(self) -> bool:
        """Whether the range's noise does not grow with it."""
        return self.sigma_range_rel == 0.0

    def range_variance(self, y: Array) -> Array:
        """Return a^2 + (b range)^2 (K,) of measurements y (K, m)."""
        return np.asarray(self.sigma_range_m**2 + (self.sigma_range_rel * y[:, 0]) ** 2)

    def noise(self, y: Array) -> Array:
        """Return the noise R (K, m, m) of measurements y (K, m)."""
        R = super().noise(y)
        if not self.additive:
            R[:, 0, 0] = self.range_variance(y)
        return R

    def noise_at(self, v: Array) -> Array:
        """Return the noise R (K, m, m) of measuring v (K, d): of the expected range, not of the noisy one."""
        return self.noise(self.expect(v)[0])

    def check(self, y: Array) -> None:
        """Refuse negative ranges."""
        refuse_negative_ranges(y)


@register("sensor", "range_bearing")
class RangeBearing(_Ranging):
    """Distance and direction of a landmark: a laser.

    sigma_range^2 = sigma_range_m^2 + (sigma_range_rel range)^2.  [S] (61).
    """

    sigma_bearing_rad: BearingNoise = 0.02

    code: ClassVar[int] = RANGE_BEARING
    columns: ClassVar[tuple[str, ...]] = ("range_m", "bearing_rad")
    sigmas: ClassVar[tuple[str, ...]] = ("sigma_range_m", "sigma_bearing_rad")

    def invert(self, y: Array) -> tuple[Array, Array]:
        """Return points v (K, 2) and V_y (K, 2, 2).  [S] (62)."""
        return self.points(y)


@register("sensor", "bearing")
class Bearing(_Planar):
    """Direction of a landmark: a camera, a radio direction finder."""

    sigma_bearing_rad: BearingNoise = 0.02

    code: ClassVar[int] = BEARING
    columns: ClassVar[tuple[str, ...]] = ("bearing_rad",)
    sigmas: ClassVar[tuple[str, ...]] = ("sigma_bearing_rad",)
    finds_depth: ClassVar[bool] = False
    sees_kinds: ClassVar[tuple[str, ...]] = ("point", "inverse_depth_2d")

    def invert(self, y: Array) -> tuple[Array, Array]:
        """Return rays v (K, 2) of length 1 and V_y (K, 2, 1)."""
        c, s = np.cos(y), np.sin(y)
        return np.hstack([c, s]), np.stack([-s, c], axis=1)

    def meet(self, T: Array, y: Array, y2: Array) -> Array:
        """Return where the rays y (K, 1) from the origin and y2 (K, 1) from T meet: (K, 1, 2), NaN if nowhere."""
        at_origin = np.column_stack([np.zeros((len(y), 2)), y])
        at_T = np.column_stack([np.tile(T[:2], (len(y2), 1)), T[2] + y2])
        return intersection(at_origin, at_T)[0][:, None]


@register("sensor", "range")
class Range(_Ranging):
    """Distance to a landmark: a radio beacon, a sonar with a wide lobe."""

    code: ClassVar[int] = RANGE
    columns: ClassVar[tuple[str, ...]] = ("range_m",)
    sigmas: ClassVar[tuple[str, ...]] = ("sigma_range_m",)


@register("sensor", "position")
class Position2D(_Planar):
    """Position of a landmark (x, y) in the sensor's frame.

    [F]'s second measurement model.
    """

    sigma_x_m: Annotated[Positive, "Noise, forward."] = 0.1
    sigma_y_m: Annotated[Positive, "Noise, to the left."] = 0.1

    code: ClassVar[int] = POSITION
    columns: ClassVar[tuple[str, ...]] = ("x_m", "y_m")
    sigmas: ClassVar[tuple[str, ...]] = ("sigma_x_m", "sigma_y_m")

    def invert(self, y: Array) -> tuple[Array, Array]:
        """Return the points (K, 2) and the identities (K, 2, 2)."""
        return y.copy(), np.tile(np.eye(2), (len(y), 1, 1))


@register("sensor", "range_bearing_signature")
class RangeBearingSignature(_Ranging):
    """Distance, direction and signature of a landmark, a number that differs from landmark to landmark.

    [T] 3: a landmark is (x, y, s).
    """

    sigma_bearing_rad: BearingNoise = 0.02
    sigma_signature: Annotated[Positive, "Noise of the signature."] = 0.1

    code: ClassVar[int] = RANGE_BEARING_SIGNATURE
    columns: ClassVar[tuple[str, ...]] = ("range_m", "bearing_rad", "signature")
    sigmas: ClassVar[tuple[str, ...]] = ("sigma_range_m", "sigma_bearing_rad", "sigma_signature")

    def invert(self, y: Array) -> tuple[Array, Array]:
        """Return (x, y, signature) (K, 3) and V_y (K, 3, 3)."""
        p, P_y = self.points(y)
        V_y = np.zeros((len(y), 3, 3))
        V_y[:, :2, :2], V_y[:, 2, 2] = P_y, 1.0
        return np.column_stack([p, y[:, 2]]), V_y


# ---------------------------------------------------------------------- of space
class Spatial(_Sensor):
    """What sensors of space, and of walls, share: the compiled expectation `expected`, of the form `seen.EXPECT`."""

    world: ClassVar[str] = "space"
    expected: ClassVar[Any]
    sees_kinds: ClassVar[tuple[str, ...]] = ("point3",)
    additive: ClassVar[bool] = True

    @property
    def code(self) -> int:
        """What `expected` is told of the sensor: the lens of a camera, 0 for other sensors."""
        return 0

    @property
    def parameters(self) -> Array:
        """The numbers (n,) of the compiled expectation."""
        return np.zeros(0)

    def expect(self, v: Array, y: Array | None = None) -> tuple[Array, Array]:
        """Return the expected measurements (K, m) of views v (K, d), and E_v (K, p, d or the view's errors).

        `y` (K, m), what was measured, is needed where it tells what cannot be expected: a tag's size, a segment's ends.
        """
        y = np.zeros((len(v), len(self.columns))) if y is None else y
        angular = np.array(self.angular, dtype=np.bool_)
        v, y = np.ascontiguousarray(v, dtype=np.float64), np.ascontiguousarray(y, dtype=np.float64)
        e, _, E_v = type(self).expected(self.code, np.array(self.parameters), angular, v, y)
        return e, E_v


@register("sensor", "wall")
class Wall(Spatial):
    """Walls seen by a laser: distance of the line, direction of its normal, and what is seen of it.

    The ends of the segment, right and left, are abscissas from the foot of the perpendicular on.  Innovations and noise
    have two numbers: the ends are where the laser's view ends, not where the wall does.  docs/walls.md.
    """

    sigma_distance_m: Annotated[Positive, "Noise of the distance of the line."] = 0.02
    sigma_normal_rad: Annotated[Positive, "Noise of the direction of its normal."] = 0.01
    _: KW_ONLY
    range_min_m: Annotated[NotNegative, "Nearest part of a wall the sensor sees."] = 0.0
    range_max_m: Annotated[Limit, "Farthest part of a wall the sensor sees."] = math.inf
    fov_rad: Annotated[Positive, "Field of view, centred forward."] = 2 * math.pi
    min_length_m: Annotated[NotNegative, "Shortest segment that counts as seen."] = 0.5

    world: ClassVar[str] = "plane"
    expected: ClassVar[Any] = walls.wall
    cov_size: ClassVar[int] = 2
    columns: ClassVar[tuple[str, ...]] = ("distance_m", "normal_rad", "right_m", "left_m")
    sigmas: ClassVar[tuple[str, ...]] = ("sigma_distance_m", "sigma_normal_rad")
    sees_kinds: ClassVar[tuple[str, ...]] = ("wall",)

    def invert(self, y: Array) -> tuple[Array, Array]:
        """Return the segments themselves (K, 4), and V_y (K, 4, 2)."""
        return y.copy(), np.tile(np.eye(4, 2), (len(y), 1, 1))

    def sees(self, v: Array) -> Flags:
        """Return (K,) that all lines are in view: a line has no end."""
        return np.ones(len(v), dtype=np.bool_)

    def sees_segments(self, T: Array, p1: Array, p2: Array) -> tuple[Flags, Array]:
        """Return which segments from p1 to p2 (K, 2) are seen from T, and their measurements (K, 4)."""
        limits = self.range_min_m, self.range_max_m, self.fov_rad / 2
        return walls.visible_wall(T, p1, p2, limits, self.min_length_m)

    def check(self, y: Array) -> None:
        """Refuse negative distances, and segments y (K, 4) whose right end is not to the right of the left one."""
        for i, row in enumerate(y):
            if row[0] < 0:
                raise EventError(f"observation {i}: distance_m is {row[0]}, expected at least 0")
            if not row[2] < row[3]:
                raise EventError(f"observation {i}: right_m is {row[2]}, expected less than left_m, {row[3]}")


@declared
class _Cone(Spatial):
    """Range sensors: limits of sight about x."""

    _: KW_ONLY
    range_min_m: Annotated[NotNegative, "Nearest landmark the sensor sees."] = 0.0
    range_max_m: Annotated[Limit, "Farthest landmark the sensor sees."] = math.inf
    fov_rad: Annotated[Positive, "Field of view, a cone about the sensor's x axis."] = 2 * math.pi

    def sees(self, v: Array) -> Flags:
        """Return which of v (K, 3) lie within the range limits and the cone of sight about x."""
        distance = np.linalg.norm(v, axis=1)
        off = np.arctan2(np.hypot(v[:, 1], v[:, 2]), v[:, 0])
        return (self.range_min_m <= distance) & (distance <= self.range_max_m) & (off <= self.fov_rad / 2)


@register("sensor", "range_bearing_3d")
class RangeBearing3D(_Cone):
    """Distance, azimuth and elevation of a landmark; x is forward, z up: a 3-D laser, a radar."""

    sigma_range_m: Annotated[Positive, "Noise of the range."] = 0.1
    sigma_azimuth_rad: Annotated[Positive, "Noise of the azimuth."] = 0.02
    sigma_elevation_rad: Annotated[Positive, "Noise of the elevation."] = 0.02

    expected: ClassVar[Any] = seen.range_bearing
    columns: ClassVar[tuple[str, ...]] = ("range_m", "azimuth_rad", "elevation_rad")
    sigmas: ClassVar[tuple[str, ...]] = ("sigma_range_m", "sigma_azimuth_rad", "sigma_elevation_rad")

    def invert(self, y: Array) -> tuple[Array, Array]:
        """Return points v (K, 3) and V_y (K, 3, 3)."""
        return inv_spherical_many(np.ascontiguousarray(y))

    def check(self, y: Array) -> None:
        """Refuse negative ranges in y (K, 3)."""
        refuse_negative_ranges(y)


@register("sensor", "position_3d")
class Position3D(_Cone):
    """Position of a landmark (x, y, z) in the sensor's frame; x is forward, z up: an RGB-D camera, a lidar."""

    sigma_x_m: Annotated[Positive, "Noise, along x."] = 0.1
    sigma_y_m: Annotated[Positive, "Noise, along y."] = 0.1
    sigma_z_m: Annotated[Positive, "Noise, along z."] = 0.1

    expected: ClassVar[Any] = seen.position
    columns: ClassVar[tuple[str, ...]] = ("x_m", "y_m", "z_m")
    sigmas: ClassVar[tuple[str, ...]] = ("sigma_x_m", "sigma_y_m", "sigma_z_m")

    def invert(self, y: Array) -> tuple[Array, Array]:
        """Return the points (K, 3) and the identities (K, 3, 3)."""
        return y.copy(), np.tile(np.eye(3), (len(y), 1, 1))


@register("sensor", "tag_pose")
class TagPose(Spatial):
    """The poses of square tags (x, y, z, qx, qy, qz, qw) in the sensor's frame.

    Innovations and noise have 6 numbers.
    """

    sigma_position_m: Annotated[Positive, "Noise of each coordinate."] = 0.02
    sigma_rotation_rad: Annotated[Positive, "Noise of the rotation about each axis."] = 0.02

    expected: ClassVar[Any] = seen.tag_pose
    cov_size: ClassVar[int] = 6
    columns: ClassVar[tuple[str, ...]] = ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")
    sigmas: ClassVar[tuple[str, ...]] = (*3 * ("sigma_position_m",), *3 * ("sigma_rotation_rad",))
    sees_kinds: ClassVar[tuple[str, ...]] = ("tag",)

    def invert(self, y: Array) -> tuple[Array, Array]:
        """Return the poses themselves and the identity (K, 6, 6)."""
        return y.copy(), np.tile(np.eye(6), (len(y), 1, 1))

    def sees(self, v: Array) -> Flags:
        """Return (K,) that all tags are in view."""
        return np.ones(len(v), dtype=np.bool_)

    def check(self, y: Array) -> None:
        """Refuse poses y (K, 7) whose quaternion is not of norm 1."""
        for i, row in enumerate(y):
            if abs(np.linalg.norm(row[3:]) - 1) > 1e-6:
                raise EventError(f"observation {i}: the quaternion is {row[3:].tolist()}, expected one of length 1")


# ---------------------------------------------------------------------- cameras
class _Camera(Spatial):
    """Cameras: an image, a lens, the points in view."""

    columns: ClassVar[tuple[str, ...]] = ("u_px", "v_px")
    sigmas: ClassVar[tuple[str, ...]] = ("sigma_px",) * 2
    expected: ClassVar[Any] = seen.camera
    sees_kinds: ClassVar[tuple[str, ...]] = ("point3", "inverse_depth", "anchored_homogeneous", "homogeneous")
    finds_depth: ClassVar[bool] = False

    width_px: float
    height_px: float

    @property
    def image(self) -> tuple[float, float]:
        """Width and height of the image, px."""
        return self.width_px, self.height_px

    def sees(self, v: Array) -> Flags:
        """Return which of v (K, 3 or 4) appear in the image, borders included."""
        rays = np.ascontiguousarray(v[:, :3], dtype=np.float64)
        return cameras.in_view(self.code, rays, np.array(self.parameters), np.array(self.image, dtype=np.float64))

    def invert(self, y: Array) -> tuple[Array, Array]:
        """Return the viewing rays (K, 3), unit vectors, of pixels y (K, 2), and their Jacobian (K, 3, 2)."""
        return cameras.back_project(self.code, np.ascontiguousarray(y), np.array(self.parameters))

    def rays(self, y: Array) -> Array:
        """Return the viewing rays (K, 3), unit vectors, of pixels y (K, 2)."""
        return _Camera.invert(self, y)[0]


@declared
class _PinHole(_Camera):
    """The intrinsics of a pin-hole camera."""

    fx_px: Annotated[Positive, "Focal length, across."] = 320.0
    fy_px: Annotated[Positive, "Focal length, down."] = 320.0
    cx_px: Annotated[Number, "Principal point, from the left."] = 320.0
    cy_px: Annotated[Number, "Principal point, from above."] = 240.0
    width_px: ImageWidth = 640
    height_px: ImageHeight = 480

    @cached_property
    def intrinsics(self) -> Array:
        """The focal lengths and the principal point (4,), px."""
        return np.array([self.fx_px, self.fy_px, self.cx_px, self.cy_px], dtype=np.float64)

    @property
    def parameters(self) -> Array:
        """The numbers (4,) of the compiled expectation: the intrinsics."""
        return self.intrinsics


@declared
class _Lens(_PinHole):
    """A pin-hole camera with a lens.

    `lens`: "radial" (coefficients of r^2, r^4, ...), "radtan" (k1, k2, p1, p2, k3), "equidistant" (k1 to k4, fish-eye),
    "tsai" (coefficients of r_d^2, r_d^4, ... that take the distortion off), "davison" (k), "fov" (w).
    """

    lens: Annotated[
        Literal["radial", "radtan", "equidistant", "tsai", "davison", "fov"],
        "What `distortion` means: `radial` d1 r^2 + d2 r^4 + ..., `radtan` k1 k2 p1 p2 k3, `equidistant` k1 to k4,"
        " `tsai` c1 r_d^2 + c2 r_d^4 + ... to undistort, `davison` k of r_d = r / sqrt(1 + 2 k r^2), `fov` w in rad.",
    ] = "radial"
    distortion: Annotated[Numbers, "Coefficients of the lens; none for an ideal one."] = ()
    sigma_px: PixelNoise = 1.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "distortion", tuple(float(d) for d in self.distortion))
        self.parameters  # noqa: B018 - a lens that folds the image over is refused here

    @property
    def code(self) -> int:
        """The code of the lens."""
        return cameras.LENSES[self.lens]

    @cached_property
    def parameters(self) -> Array:
        """The numbers (n,) of the lens as `cameras.project` takes them."""
        return cameras.parameters(self.lens, self.intrinsics, self.distortion, size=self.image)


@register("sensor", "pinhole")
class PinHole(_Lens):
    """A camera that sees points: pixels u, v.

    [TB] pinHole.  `calibration` names a file of OpenCV, Kalibr, ROS or EuRoC instead: cameras.md.
    """


@register("sensor", "pixel_depth")
class PixelDepth(_Lens):
    """A camera that measures the depth of its pixels along its axis (RGB-D): u, v and the inverse depth.

    Structured light and stereo measure a disparity, proportional to 1 / z: its noise is the same at any depth, that of
    the depth is sigma_rho z^2.  Khoshelham and Elberink 2012 (Kinect): 1.4e-3 / m.
    """

    sigma_rho_per_m: Annotated[Positive, "Noise of the inverse depth: that of a depth z is sigma_rho z^2."] = 0.003

    expected: ClassVar[Any] = seen.pixel_depth
    columns: ClassVar[tuple[str, ...]] = ("u_px", "v_px", "rho_per_m")
    sigmas: ClassVar[tuple[str, ...]] = ("sigma_px", "sigma_px", "sigma_rho_per_m")
    finds_depth: ClassVar[bool] = True

    def invert(self, y: Array) -> tuple[Array, Array]:
        """Return unit rays with their inverse distances (K, 4) of y (K, 3), and their Jacobian (K, 4, 3)."""
        m, M_y = super().invert(np.array(y[:, :2]))
        V_y = np.zeros((len(y), 4, 3))
        V_y[:, :3, :2], V_y[:, 3, :2], V_y[:, 3, 2] = M_y, M_y[:, 2] * y[:, 2:], m[:, 2]
        return np.column_stack([m, m[:, 2] * y[:, 2]]), V_y

    def check(self, y: Array) -> None:
        """Refuse observations y (K, 3) behind the camera."""
        for i, row in enumerate(y):
            if row[2] < 0:
                raise EventError(f"observation {i}: rho_per_m is {row[2]}, expected at least 0")


@register("sensor", "omnidirectional")
class Omnidirectional(_Camera):
    """Scaramuzza's camera with a wide view that sees points: pixels u, v.

    `cameras.project_omni` explains the polynomials.  [TB] omniCam.
    """

    cx_px: Annotated[Number, "Centre of the image, from the left."] = 640.0
    cy_px: Annotated[Number, "Centre of the image, from above."] = 400.0
    c: Annotated[Number, "Affine correction [c d; e 1] of the image."] = 1.0
    d: Annotated[Number, "Affine correction."] = 0.0
    e: Annotated[Number, "Affine correction."] = 0.0
    projection: Annotated[
        Numbers, "Polynomial from the ray's elevation to the distance from the centre, lowest power first."
    ] = FISHEYE
    back_projection: Annotated[
        Numbers, "Polynomial from the distance from the centre to the ray's height, lowest power first."
    ] = FISHEYE_BACK
    width_px: ImageWidth = 1280
    height_px: ImageHeight = 800
    sigma_px: PixelNoise = 1.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "projection", tuple(float(a) for a in self.projection))
        object.__setattr__(self, "back_projection", tuple(float(a) for a in self.back_projection))

    @property
    def code(self) -> int:
        """The code of the lens."""
        return cameras.OMNI

    @cached_property
    def parameters(self) -> Array:
        """The numbers (n,) of the lens as `cameras.project` takes them."""
        k = (self.cx_px, self.cy_px, self.c, self.d, self.e)
        return cameras.parameters("omnidirectional", k, self.projection, self.back_projection)


@register("sensor", "stereo")
class Stereo(_PinHole):
    """A rectified pair of cameras that sees points: u, v in the left image and u, v in the right one."""

    baseline_m: Annotated[Positive, "Distance of the right camera from the left one, whose frame is the sensor's."] = (
        0.2
    )
    sigma_ul_px: Annotated[Positive, "Noise of the left u."] = 1.0
    sigma_vl_px: Annotated[Positive, "Noise of the left v."] = 1.0
    sigma_ur_px: Annotated[Positive, "Noise of the right u."] = 1.0
    sigma_vr_px: Annotated[Positive, "Noise of the right v."] = 1.0

    expected: ClassVar[Any] = seen.stereo
    columns: ClassVar[tuple[str, ...]] = ("ul_px", "vl_px", "ur_px", "vr_px")
    sigmas: ClassVar[tuple[str, ...]] = ("sigma_ul_px", "sigma_vl_px", "sigma_ur_px", "sigma_vr_px")
    finds_depth: ClassVar[bool] = True

    @cached_property
    def parameters(self) -> Array:
        """The intrinsics and the baseline (5,)."""
        return np.append(self.intrinsics, self.baseline_m)

    def rays(self, y: Array) -> Array:
        """Return the viewing rays (K, 3), unit vectors, of pixels y (K, 2) of the left image."""
        return cameras.back_project_pinhole(np.ascontiguousarray(y), self.intrinsics, np.zeros(0))[0]

    def invert(self, y: Array) -> tuple[Array, Array]:
        """Return unit rays with their inverse distances (K, 4), and their Jacobian (K, 4, 4)."""
        return cameras.back_project_stereo(np.ascontiguousarray(y), self.intrinsics, self.baseline_m)

    def sees(self, v: Array) -> Flags:
        """Return which of v (K, 3 or 4) appear in both images, borders included."""
        e, _ = self.expect(v)
        return cameras.in_image(e, v, self.image)

    def check(self, y: Array) -> None:
        """Refuse observations y (K, 4) of points behind the cameras, with a negative disparity."""
        for i, row in enumerate(y):
            if row[0] < row[2]:
                raise EventError(f"observation {i}: ul_px {row[0]} is less than ur_px {row[2]}, expected at least it")


@register("sensor", "segments")
class Segments(_PinHole):
    """A camera that sees line segments: pixels of both ends, which lie anywhere on the line.

    So only the distances of the measured ends from the expected line count.  [TB] Fig. 9: the innovation is two
    distances, `ortDst`.
    """

    sigma_px: Annotated[Positive, "Noise of each pixel coordinate of an end."] = 1.0
    min_length_px: Annotated[NotNegative, "Shortest segment that counts as seen."] = 20.0

    expected: ClassVar[Any] = seen.segment
    columns: ClassVar[tuple[str, ...]] = ("u1_px", "v1_px", "u2_px", "v2_px")
    sees_kinds: ClassVar[tuple[str, ...]] = (
        "pluecker_line", "anchored_pluecker_line", "inverse_depth_line", "anchored_homogeneous_line",
        "homogeneous_line",
    )  # fmt: skip

    def noise_from(self, y: Array, cov: Array) -> Array:
        """Return the noise (K, 2, 2) of the two distances, of pixels' covariances (K, 4, 4)."""
        return lines.segment_noise(np.ascontiguousarray(y), np.ascontiguousarray(cov))

    def invert(self, y: Array) -> tuple[Array, Array]:
        """Return the viewing rays (K, 6) of both ends, and V_y (K, 6, 4)."""
        none, both = np.zeros(0), np.zeros((len(y), 6, 4))
        ends = (np.ascontiguousarray(y[:, i : i + 2]) for i in (0, 2))
        (a, A_y), (b, B_y) = (cameras.back_project_pinhole(end, self.intrinsics, none) for end in ends)
        both[:, :3, :2], both[:, 3:, 2:] = A_y, B_y
        return np.column_stack([a, b]), both

    def sees_segments(self, T: Array, p1: Array, p2: Array) -> tuple[Flags, Array]:
        """Return which segments from p1 to p2 (K, 3) of the world are seen from T, and their pixels in the image."""
        size = np.array(self.image, dtype=np.float64)
        a, b = np.ascontiguousarray(p1), np.ascontiguousarray(p2)
        return lines.visible_segment(T, a, b, self.intrinsics, size, self.min_length_px)

    def start_noise(self, y: Array) -> Array:
        """Return the noise (K, 4, 4) of the pixels themselves, which starts a line."""
        return constant((self.sigma_px**2,) * 4, len(y))

    def check(self, y: Array) -> None:
        """Refuse segments y (K, 4) whose ends coincide."""
        for i, row in enumerate(y):
            if row[0] == row[2] and row[1] == row[3]:
                raise EventError(f"observation {i}: both ends are at {row[:2].tolist()} px, expected a segment")


@register("sensor", "tag_corners")
class TagCorners(_Lens):
    """A camera that sees square tags of known size: pixels of their four corners.

    Corners in the tag's frame: (-s, -s), (s, -s), (s, s), (-s, s), s half the size.
    """

    expected: ClassVar[Any] = seen.tag_corners
    cov_size: ClassVar[int] = 8
    sigmas: ClassVar[tuple[str, ...]] = ("sigma_px",) * 8
    columns: ClassVar[tuple[str, ...]] = (
        "u1_px", "v1_px", "u2_px", "v2_px", "u3_px", "v3_px", "u4_px", "v4_px", "size_m",
    )  # fmt: skip
    sees_kinds: ClassVar[tuple[str, ...]] = ("tag",)
    finds_depth: ClassVar[bool] = True

    def invert(self, y: Array) -> tuple[Array, Array]:
        """Return the tags' poses (K, 7) in the camera, and V_y (K, 6, 8).

        NaN where none explains the corners, and where two do: a small tag looks like its mirror image.
        """
        v, V_y, chi2 = self.both(y)
        v[~(chi2[:, 1] - chi2[:, 0] >= TELLING)] = np.nan
        return np.ascontiguousarray(v[:, 0]), V_y[:, 0]

    def both(self, y: Array) -> tuple[Array, Array, Array]:
        """Return the two poses (K, 2, 7) that look like y, the better first, V_y (K, 2, 6, 8), chi-squares (K, 2)."""
        corners, sizes = np.ascontiguousarray(y[:, :8]), np.ascontiguousarray(y[:, 8])
        par = np.array(self.parameters)
        rays = cameras.back_project(self.code, corners.reshape(-1, 2), par)[0].reshape(-1, 4, 3)
        v, V_y, cost = tags.tags_from_corners(self.code, corners, rays, sizes, par)
        return v, V_y, cost / self.sigma_px**2

    def is_far(self, y: Array, z: Array) -> Flags:
        """Tell which tags y (K, 9) are off by half their size or more by their innovations z (K, 8), or unexpected."""
        sides = np.diff(y[:, [0, 1, 2, 3, 4, 5, 6, 7, 0, 1]].reshape(-1, 5, 2), axis=1)
        size = np.linalg.norm(sides, axis=2).mean(axis=1)
        near: Flags = np.sqrt(np.sum(z**2, axis=1) / 4) < 0.5 * size
        return ~near

    def poses(self, y: Array, R: Array) -> tuple[Array, Array]:
        """Return y (K, 9) with noise R (K, 8, 8) as poses (K, 7) with covariances (K, 6, 6); NaN where `invert` is."""
        v, V_y = self.invert(y)
        return v, V_y @ R @ V_y.swapaxes(1, 2)

    def check(self, y: Array) -> None:
        """Refuse tags y (K, 9) without a size."""
        for i, size in enumerate(y[:, 8].tolist()):
            if size <= 0:
                raise EventError(f"observation {i}: size_m is {size}, expected a positive length")


BUILT_IN = built_in("sensor")  # those of landmarks and, by their import, those of the state
