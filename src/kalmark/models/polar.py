"""Sensors of ranges and directions, in plane and space: each measures something at v in its frame.  [S] A.4, Table 2.

In the plane v is (x, y[, signature]), with a height (x, y, z), in space (x, y, z) or a ray with its inverse distance.
The numbers of a place are range and bearing in the plane, range, azimuth and elevation in three dimensions.
"""

from __future__ import annotations

from dataclasses import KW_ONLY, replace
from functools import cached_property
from typing import Annotated, ClassVar, Self

import numpy as np

from kalmark.arrays import Array, Flags
from kalmark.compiled import compiled
from kalmark.declare import Estimated, NotNegative, Number, Positive, declared, refuse, register
from kalmark.geometry.directions import inv_spherical_many, spherical_many
from kalmark.geometry.frames import inv_scan_many, scan_many
from kalmark.geometry.gaussian import intersection
from kalmark.models.landmark_views import (
    Cone,
    Distancing,
    Expecting,
    InPlane,
    InSpace,
    Raised,
    length_of_view,
    raise_views,
    refuse_negative_ranges,
    residual,
)

__all__ = [
    "Bearing", "Bearing3D", "Range", "Range3D", "RangeBearing", "RangeBearing3D", "RangeBearingHeight",
    "RangeBearingSignature",
]  # fmt: skip

BearingNoise = Annotated[Positive, "Noise of the bearing."]
AzimuthNoise = Annotated[Positive, "Noise of the azimuth."]
ElevationNoise = Annotated[Positive, "Noise of the elevation."]


@compiled
def polar(code: int, par: Array, angular: Flags, v: Array, y: Array) -> tuple[Array, Array, Array]:
    """Expect range and angles of v (K, n) by the `code`, 4 d + first: of d numbers of a place those from `first` on.

    A signature, behind these in v, follows.  `par` are gain and offset of the range, if it is measured, and the height
    of the sensor, if it is raised.  Returns e (K, m), the innovations z (K, m) of y (K, m), and E_v (K, m, n).
    """
    d, n, m = code // 4, v.shape[1], y.shape[1]
    e, E_v = scan_many(v) if d == 2 else spherical_many(raise_views(v, par[2]) if len(par) > 2 else v)
    if m != d or n != d:
        e, E_v = some_numbers(v, e, E_v, code % 4, m)
    if len(par) > 0 and (par[0] != 1.0 or par[1] != 0.0):
        for i in range(len(v)):
            e[i, 0] = (e[i, 0] + par[1]) / par[0]
            for b in range(n):
                E_v[i, 0, b] /= par[0]
    return e, residual(y, e, angular), E_v


@compiled
def some_numbers(v: Array, place: Array, P_v: Array, first: int, m: int) -> tuple[Array, Array]:
    """Return m numbers e (K, m) of a place (K, d), and E_v (K, m, n), from `first` on, then those of v (K, n)."""
    (k, n), d = v.shape, place.shape[1]
    e, E_v, numbers = np.empty((k, m)), np.zeros((k, m, n)), min(d, n)
    for j in range(m):
        a = first + j
        if a < d:
            e[:, j], E_v[:, j, :numbers] = place[:, a], P_v[:, a, :numbers]
        else:
            e[:, j], E_v[:, j, a] = v[:, a], 1.0
    return e, E_v


def place_of_polar(y: Array, d: int) -> tuple[Array, Array]:
    """Return the places (K, d) at ranges and angles, the first d of y (K, m), and V_y (K, d, m).  [S] (62)."""
    p, P_y = (inv_scan_many if d == 2 else inv_spherical_many)(np.ascontiguousarray(y[:, :d]))
    return p, np.concatenate([P_y, np.zeros((len(y), d, y.shape[1] - d))], axis=2)


@compiled
def distance(code: int, par: Array, angular: Flags, v: Array, y: Array) -> tuple[Array, Array, Array]:
    """Return e, z (K, 1), E_v (K, 1, d) of ranges of v (K, d), e = (|v| + offset) / gain; `par` = gain, offset, height.

    At v = 0, where a range has no derivative, E_v is 0.
    """
    k, d = v.shape
    e, E_v = np.empty((k, 1)), np.empty((k, 1, d))
    for i in range(k):
        r, direction = length_of_view(v, i, par[2], 0.0, 0.0)
        e[i, 0] = (r + par[1]) / par[0]
        for j in range(d):
            E_v[i, 0, j] = direction[j] / par[0]
    return e, y - e, E_v


@compiled
def by_gain_and_offset(code: int, par: Array, angular: Flags, v: Array, e: Array) -> Array:
    """Return E_p (K, m, 2): how measurements e (K, m), the first a range, change with its gain and offset."""
    E_p = np.zeros((len(e), e.shape[1], 2))
    for i in range(len(e)):
        E_p[i, 0, 0], E_p[i, 0, 1] = -e[i, 0] / par[0], 1.0 / par[0]
    return E_p


@compiled
def range_noise(numbers: Array, e: Array) -> Array:
    """Return the noise (K, p, p) of measurements e (K, m), the first a range r: its variance is a^2 + (b r)^2.

    `numbers` (p + 1,) are the constant variances, a^2 first, and b.
    """
    p = len(numbers) - 1
    R = np.zeros((len(e), p, p))
    for i in range(len(e)):
        for j in range(p):
            R[i, j, j] = numbers[j]
        R[i, 0, 0] += (numbers[p] * e[i, 0]) ** 2
    return R


class _Polar(Cone):
    """Base of the sensors of directions: limits of range, built-in expectation."""

    expected = polar
    code: ClassVar[int]


@declared
class _Ranging(Expecting):
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

    varied, noisy = by_gain_and_offset, range_noise
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

    def distances(self, y: Array) -> Array:
        """Return the distances (K,) that measurements y (K, m) stand for."""
        return np.asarray((y[:, 0] - self.bias_m) / self.scale)

    @property
    def additive(self) -> bool:
        """True if the range's noise does not grow with it."""
        return self.sigma_range_rel == 0.0

    def range_variance(self, y: Array) -> Array:
        """Return a^2 + (b range)^2 (K,) of measurements y (K, m)."""
        return self.noise(y)[:, 0, 0]

    def noise(self, y: Array) -> Array:
        """Return the noise R (K, m, m) of measurements y (K, m)."""
        if self.sigma_range_rel == 0.0:
            return super().noise(y)
        return np.asarray(range_noise(self.noise_numbers, np.array(y, dtype=np.float64)))

    @cached_property
    def noise_numbers(self) -> Array:
        """The constant variances (p,) of the measurements, and the part of the range's sigma that grows with it."""
        return np.array([*self._variances, self.sigma_range_rel])

    def noise_at(self, v: Array) -> Array:
        """Return the noise R (K, m, m) of measuring v (K, d): of the expected range, not of the noisy one."""
        return self.noise(self.expect(v)[0])

    check = staticmethod(refuse_negative_ranges)


class _Placing(_Ranging, _Polar):
    """Sensors of a range and all angles, which start landmarks."""

    def invert(self, y: Array) -> tuple[Array, Array]:
        """Return what is at v (K, d or more), and V_y (K, ., m): places, and what is measured beside.  [S] (62)."""
        d, k = self.point_size, y.shape[1]
        measured = y.copy()
        measured[:, 0] = self.distances(y)
        p, P_y = place_of_polar(measured, d)
        P_y[:, :, 0] /= self.scale
        beside = np.tile(np.eye(k)[d:], (len(y), 1, 1))
        return np.column_stack([p, y[:, d:]]), np.concatenate([P_y, beside], axis=1)


@register("sensor", "range_bearing")
class RangeBearing(InPlane, _Placing):
    """Distance and direction of a landmark: a laser.

    sigma_range^2 = sigma_range_m^2 + (sigma_range_rel range)^2.  [S] (61).

    >>> lidar = km.Mount(km.sensors.RangeBearing(sigma_range_m=0.05), at=(0.2, 0.0, 0.0))
    >>> slam = km.Slam(km.Robot("rover", km.motion.Unicycle(), sensors={"lidar": lidar}))
    >>> report = slam.process(km.Scan(0.0, "rover", "lidar", [[4.0, 0.3], [2.0, -1.0]], ids=[7, 8]))
    >>> slam.mean(7).round(3)
    array([4.021, 1.182])
    """

    sigma_bearing_rad: BearingNoise = 0.02

    code = 8
    columns = ("range_m", "bearing_rad")
    sigmas = ("sigma_range_m", "sigma_bearing_rad")


@declared
class _InThree(_Placing):
    """Range, azimuth and elevation, of points in space or at heights above the plane."""

    sigma_azimuth_rad: AzimuthNoise = 0.02
    sigma_elevation_rad: ElevationNoise = 0.02

    code = 12
    columns = ("range_m", "azimuth_rad", "elevation_rad")
    sigmas = ("sigma_range_m", "sigma_azimuth_rad", "sigma_elevation_rad")


@register("sensor", "range_bearing_3d")
class RangeBearing3D(InSpace, _InThree):
    """Distance, azimuth and elevation of a landmark; x is forward, z up: a 3-D laser, a radar.

    >>> lidar = km.Mount(km.sensors.RangeBearing3D())
    >>> slam = km.Slam(km.Robot("drone", km.motion.Odometry3D(), sensors={"lidar": lidar}))
    >>> report = slam.process(km.Scan(0.0, "drone", "lidar", [[5.0, 0.0, 0.6435]], ids=[7]))
    >>> slam.mean(7).round(2)
    array([4., 0., 3.])
    """


@register("sensor", "range_bearing_3d")
class RangeBearingHeight(_InThree, Raised):
    """Distance, azimuth and elevation of a landmark at a height, seen by a robot of the plane; x is forward, z up.

    >>> lidar = km.Mount(km.sensors.RangeBearingHeight())
    >>> slam = km.Slam(km.Robot("rover", km.motion.Unicycle(), sensors={"lidar": lidar}))
    >>> report = slam.process(km.Scan(0.0, "rover", "lidar", [[5.0, 0.0, 0.6435]], ids=[7]))
    >>> slam.mean(7).round(2)
    array([4., 0., 3.])
    """

    sees_kinds: ClassVar[tuple[str, ...]] = ("point_height",)

    def sees(self, v: Array) -> Flags:
        """Return which of v (K, 2 or 3) lie within the range limits and the cone of sight about x."""
        return super().sees(self.risen(v))

    def invert(self, y: Array) -> tuple[Array, Array]:
        """Return points v (K, 3), at their height above the plane, and V_y (K, 3, 3)."""
        v, V_y = super().invert(y)
        v[:, 2] += self.height_m
        return v, V_y


class _Directing(_Polar):
    """Sensors of all angles and no range."""

    finds_depth = False

    def invert(self, y: Array) -> tuple[Array, Array]:
        """Return rays v (K, d) of length 1 and V_y (K, d, m)."""
        v, V_y = place_of_polar(np.column_stack([np.ones(len(y)), y]), self.point_size)
        return v, V_y[:, :, 1:]


@register("sensor", "bearing")
class Bearing(InPlane, _Directing):
    """Direction of a landmark: a camera, a radio direction finder.

    >>> eye = km.Mount(km.sensors.Bearing(sigma_bearing_rad=0.01))
    >>> slam = km.Slam(km.Robot("rover", km.motion.Unicycle(), sensors={"eye": eye}))
    >>> report = slam.process(km.Scan(0.0, "rover", "eye", [[0.5]], ids=[7]))
    >>> slam.landmark_model(7).kind
    'inverse_depth_2d'
    """

    sigma_bearing_rad: BearingNoise = 0.02

    code = 9
    columns = ("bearing_rad",)
    sigmas = ("sigma_bearing_rad",)
    sees_kinds = ("point", "inverse_depth_2d")

    def meet(self, T: Array, y: Array, y2: Array) -> Array:
        """Return where the rays y (K, 1) from the origin and y2 (K, 1) from T meet: (K, 1, 2), NaN if nowhere."""
        at_origin = np.column_stack([np.zeros((len(y), 2)), y])
        at_T = np.column_stack([np.tile(T[:2], (len(y2), 1)), T[2] + y2])
        return intersection(at_origin, at_T)[0][:, None]


@register("sensor", "bearing")
class Bearing3D(InSpace, _Directing):
    """Direction of a landmark, azimuth and elevation; x is forward, z up: a theodolite, an antenna array.

    >>> eye = km.Mount(km.sensors.Bearing3D())
    >>> slam = km.Slam(km.Robot("drone", km.motion.Odometry3D(), sensors={"eye": eye}))
    >>> slam.add_landmark("a", (4.0, 3.0, 0.0), 0.01 * np.eye(3), km.landmarks.Point3D())
    >>> slam.expect("drone", "eye").e.round(2)
    array([[0.64, 0.  ]])
    """

    sigma_azimuth_rad: AzimuthNoise = 0.02
    sigma_elevation_rad: ElevationNoise = 0.02

    code = 13
    columns = ("azimuth_rad", "elevation_rad")
    sigmas = ("sigma_azimuth_rad", "sigma_elevation_rad")
    sees_kinds = ("point3", "inverse_depth", "anchored_homogeneous", "homogeneous")


@declared
class _Range(_Ranging, Cone, Distancing):
    """A range alone, of either world."""

    expected = distance
    columns = ("range_m",)
    sigmas = ("sigma_range_m",)

    def sees(self, v: Array) -> Flags:
        """Return which of v (K, 2 or 3) lie within the range limits and the cone of sight about x."""
        return super().sees(self.risen(v))


@register("sensor", "range")
class Range(_Range, Raised):
    """Distance to a landmark: a radio beacon, a sonar with a wide lobe.

    >>> tag = km.Mount(km.sensors.Range(sigma_range_m=0.1))
    >>> slam = km.Slam(km.Robot("rover", km.motion.Unicycle(), sensors={"tag": tag}, cov=np.eye(3)))
    >>> for name, place in {"a": (0.0, 5.0), "b": (5.0, 0.0), "c": (-4.0, -3.0)}.items():
    ...     slam.add_landmark(name, place, cov=1e-6 * np.eye(2))
    >>> report = slam.process(km.Scan(0.0, "rover", "tag", [[5.2], [5.0], [4.8]], ids=["a", "b", "c"]))
    >>> slam.mean("rover")[:2].round(2), np.sqrt(np.diag(slam.covariance("rover")))[:2].round(2)
    (array([-0.02, -0.26]), array([0.09, 0.13]))
    """

    def distances(self, y: Array) -> Array:
        """Return the distances (K,) in the plane that ranges y (K, 1) of landmarks at height 0 stand for."""
        return self.level(super().distances(y))


@register("sensor", "range")
class Range3D(InSpace, _Range):
    """Distance to a landmark: a radio beacon, a sonar with a wide lobe.

    >>> own = km.Mount(km.sensors.Range3D(sigma_range_m=0.1))
    >>> slam = km.Slam(km.Robot("drone", km.motion.Odometry3D(), sensors={"own": own}))
    >>> slam.add_landmark("a", mean=(4.0, 3.0, 12.0), cov=0.01 * np.eye(3))
    >>> slam.expect("drone", "own").e.round(2)
    array([[13.]])
    """


@register("sensor", "range_bearing_signature")
class RangeBearingSignature(InPlane, _Placing):
    """Distance, direction and signature of a landmark, a number that differs from landmark to landmark.

    [T] 3: a landmark is (x, y, s).

    >>> own = km.Mount(km.sensors.RangeBearingSignature())
    >>> slam = km.Slam(km.Robot("rover", km.motion.Unicycle(), sensors={"own": own}))
    >>> report = slam.process(km.Scan(0.0, "rover", "own", [[4.0, 0.0, 7.5]], ids=["tree"]))
    >>> slam.mean("tree").round(2)  # x, y, signature
    array([4. , 0. , 7.5])
    """

    sigma_bearing_rad: BearingNoise = 0.02
    sigma_signature: Annotated[Positive, "Noise of the signature."] = 0.1

    code = 8
    columns = ("range_m", "bearing_rad", "signature")
    sigmas = ("sigma_range_m", "sigma_bearing_rad", "sigma_signature")
