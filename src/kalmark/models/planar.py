"""Sensors of the plane: each measures something at v = (x, y[, signature]) in its frame.  [S] A.4, Table 2.

A range alone has the same equation in space and to a landmark at another height: r = |v|, v with three numbers.
"""

from __future__ import annotations

import math
from dataclasses import KW_ONLY, replace
from functools import cached_property
from typing import Annotated, ClassVar, Self

import numpy as np

from kalmark.arrays import Array, Flags
from kalmark.compiled import compiled
from kalmark.declare import Estimated, NotNegative, Number, Positive, declared, refuse, register
from kalmark.geometry.frames import inv_scan_many, scan_many
from kalmark.geometry.gaussian import intersection
from kalmark.models import landmark_views
from kalmark.models.landmark_views import Cone, Distancing, Expecting, Raised, raise_views, refuse_negative_ranges

__all__ = ["Bearing", "Position2D", "Range", "Range3D", "RangeBearing", "RangeBearingSignature"]

RANGE_BEARING, BEARING, RANGE_BEARING_SIGNATURE = range(1, 4)  # codes of the sensors
BearingNoise = Annotated[Positive, "Noise of the bearing."]


@compiled
def measured_in_plane(code: int, v: Array) -> tuple[Array, Array]:
    """Return the measurements (K, m) that the built-in sensor `code` makes of v (K, d), and E_v (K, m, d)."""
    k, d = v.shape
    y, Y_p = scan_many(v)
    first = 1 if code == BEARING else 0
    m = 2 - first + (1 if code == RANGE_BEARING_SIGNATURE else 0)
    e, E_v = np.empty((k, m)), np.zeros((k, m, d))
    for i in range(k):
        for j in range(first, 2):
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
    return e, landmark_views.residual(y, e, angular), E_v


@compiled
def distance(code: int, par: Array, angular: Flags, v: Array, y: Array) -> tuple[Array, Array, Array]:
    """Return e, z (K, 1), E_v (K, 1, d) of ranges of v (K, d), e = (|v| + offset) / gain; `par` = gain, offset, height.

    At v = 0, where a range has no derivative, E_v is 0.
    """
    k, d = v.shape
    p, e, E_v = raise_views(v, par[2]), np.empty((k, 1)), np.zeros((k, 1, d))
    for i in range(k):
        r = math.sqrt(p[i, 0] * p[i, 0] + p[i, 1] * p[i, 1] + p[i, 2] * p[i, 2])
        e[i, 0] = (r + par[1]) / par[0]
        for j in range(d if r > 0.0 else 0):
            E_v[i, 0, j] = p[i, j] / r / par[0]
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


class _Planar(Cone):
    """Base of the planar sensors: limits of range, built-in expectation."""

    world = "plane"
    expected = in_plane
    code: ClassVar[int]
    point_size = 2


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
        if self.additive:
            return super().noise(y)
        return np.asarray(range_noise(self.noise_numbers, np.array(y, dtype=np.float64)))

    @cached_property
    def noise_numbers(self) -> Array:
        """The constant variances (p,) of the measurements, and the part of the range's sigma that grows with it."""
        return np.array([*self._variances, self.sigma_range_rel])

    def noise_at(self, v: Array) -> Array:
        """Return the noise R (K, m, m) of measuring v (K, d): of the expected range, not of the noisy one."""
        return self.noise(self.expect(v)[0])

    def check(self, y: Array) -> None:
        """Refuse negative ranges."""
        refuse_negative_ranges(y)


class _RangingBearing(_Ranging, _Planar):
    """Sensors of the plane whose first components are a range and a bearing."""

    def points(self, y: Array) -> tuple[Array, Array]:
        """Return the points (K, 2) that ranges and bearings y (K, 2) stand for, and V_y (K, 2, 2).  [S] (62)."""
        measured = y[:, :2].copy()
        if self.scale == 1.0 and self.bias_m == 0.0:
            return inv_scan_many(measured)
        measured[:, 0] = self.distances(y)
        p, P_y = inv_scan_many(measured)
        P_y[:, :, 0] /= self.scale
        return p, P_y


@register("sensor", "range_bearing")
class RangeBearing(_RangingBearing):
    """Distance and direction of a landmark: a laser.

    sigma_range^2 = sigma_range_m^2 + (sigma_range_rel range)^2.  [S] (61).

    >>> lidar = km.Mount(km.sensors.RangeBearing(sigma_range_m=0.05), at=(0.2, 0.0, 0.0))
    >>> slam = km.Slam(km.Robot("rover", km.motion.Unicycle(), sensors={"lidar": lidar}))
    >>> report = slam.process(km.Scan(0.0, "rover", "lidar", [[4.0, 0.3], [2.0, -1.0]], ids=[7, 8]))
    >>> slam.mean(7).round(3)
    array([4.021, 1.182])
    """

    sigma_bearing_rad: BearingNoise = 0.02

    code = RANGE_BEARING
    columns = ("range_m", "bearing_rad")
    sigmas = ("sigma_range_m", "sigma_bearing_rad")

    def invert(self, y: Array) -> tuple[Array, Array]:
        """Return points v (K, 2) and V_y (K, 2, 2).  [S] (62)."""
        return self.points(y)


@register("sensor", "bearing")
class Bearing(_Planar):
    """Direction of a landmark: a camera, a radio direction finder.

    >>> eye = km.Mount(km.sensors.Bearing(sigma_bearing_rad=0.01))
    >>> slam = km.Slam(km.Robot("rover", km.motion.Unicycle(), sensors={"eye": eye}))
    >>> report = slam.process(km.Scan(0.0, "rover", "eye", [[0.5]], ids=[7]))
    >>> slam.landmark_model(7).kind
    'inverse_depth_2d'
    """

    sigma_bearing_rad: BearingNoise = 0.02

    code = BEARING
    columns = ("bearing_rad",)
    sigmas = ("sigma_bearing_rad",)
    finds_depth = False
    sees_kinds = ("point", "inverse_depth_2d")

    def invert(self, y: Array) -> tuple[Array, Array]:
        """Return rays v (K, 2) of length 1 and V_y (K, 2, 1)."""
        c, s = np.cos(y), np.sin(y)
        return np.hstack([c, s]), np.stack([-s, c], axis=1)

    def meet(self, T: Array, y: Array, y2: Array) -> Array:
        """Return where the rays y (K, 1) from the origin and y2 (K, 1) from T meet: (K, 1, 2), NaN if nowhere."""
        at_origin = np.column_stack([np.zeros((len(y), 2)), y])
        at_T = np.column_stack([np.tile(T[:2], (len(y2), 1)), T[2] + y2])
        return intersection(at_origin, at_T)[0][:, None]


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
class Range3D(_Range):
    """Distance to a landmark: a radio beacon, a sonar with a wide lobe.

    >>> own = km.Mount(km.sensors.Range3D(sigma_range_m=0.1))
    >>> slam = km.Slam(km.Robot("drone", km.motion.Odometry3D(), sensors={"own": own}))
    >>> slam.add_landmark("a", mean=(4.0, 3.0, 12.0), cov=0.01 * np.eye(3))
    >>> slam.expect("drone", "own").e.round(2)
    array([[13.]])
    """

    world = "space"
    sees_kinds = ("point3",)


@register("sensor", "position")
class Position2D(_Planar):
    """Position of a landmark (x, y) in the sensor's frame.

    [F]'s second measurement model.

    >>> camera = km.Mount(km.sensors.Position2D(), at=(0.0, 0.0, 1.5708))
    >>> slam = km.Slam(km.Robot("rover", km.motion.Unicycle(), sensors={"camera": camera}))
    >>> report = slam.process(km.Scan(0.0, "rover", "camera", [[2.0, 0.0]], ids=["post"]))
    >>> slam.mean("post").round(3)  # to the left, as the sensor looks
    array([-0.,  2.])
    """

    sigma_x_m: Annotated[Positive, "Noise, forward."] = 0.1
    sigma_y_m: Annotated[Positive, "Noise, to the left."] = 0.1

    code = 0
    expected = landmark_views.components
    columns = ("x_m", "y_m")
    sigmas = ("sigma_x_m", "sigma_y_m")

    def invert(self, y: Array) -> tuple[Array, Array]:
        """Return the points (K, 2) and the identities (K, 2, 2)."""
        return y.copy(), np.tile(np.eye(2), (len(y), 1, 1))


@register("sensor", "range_bearing_signature")
class RangeBearingSignature(_RangingBearing):
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

    code = RANGE_BEARING_SIGNATURE
    columns = ("range_m", "bearing_rad", "signature")
    sigmas = ("sigma_range_m", "sigma_bearing_rad", "sigma_signature")

    def invert(self, y: Array) -> tuple[Array, Array]:
        """Return (x, y, signature) (K, 3) and V_y (K, 3, 3)."""
        p, P_y = self.points(y)
        V_y = np.zeros((len(y), 3, 3))
        V_y[:, :2, :2], V_y[:, 2, 2] = P_y, 1.0
        return np.column_stack([p, y[:, 2]]), V_y
