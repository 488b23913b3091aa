"""Range rates of landmarks that stand still (Doppler): alone, or with range and direction, as a radar measures them.

A landmark at p in the sensor's frame, of a sensor with the velocity t in the same frame, has the rate of its range
d|p|/dt = -p' t / |p|: a turn of the sensor does not change a distance.  So what is seen is v = (p, t), and how it comes
about is in `models/observe.py`.
"""

from __future__ import annotations

import math
from typing import Annotated, ClassVar

import numpy as np

from kalmark.arrays import Array, Flags
from kalmark.compiled import compiled
from kalmark.declare import Positive, declared, register
from kalmark.geometry.directions import spherical_many
from kalmark.geometry.frames import scan_many
from kalmark.models.landmark_views import Cone, InPlane, InSpace, refuse_negative_ranges, residual
from kalmark.models.polar import AzimuthNoise, BearingNoise, ElevationNoise, place_of_polar

__all__ = ["Radar2D", "Radar3D", "RangeRate2D", "RangeRate3D"]

NEAREST_M = 1e-3  # nearer than this a landmark has no direction


@compiled
def expect_range_rate(code: int, par: Array, angular: Flags, v: Array, y: Array) -> tuple[Array, Array, Array]:
    """Expect the range rate of v = (p, t) (K, 2 d), behind range and angles if y (K, m) has them; E_v (K, m, 2 d)."""
    k, d, m = len(v), v.shape[1] // 2, y.shape[1]
    e, E_v, p = np.empty((k, m)), np.zeros((k, m, 2 * d)), v[:, :d].copy()
    if m > 1:
        e[:, :d], E_v[:, :d, :d] = scan_many(p) if d == 2 else spherical_many(p)
    for i in range(k):
        square, along = NEAREST_M * NEAREST_M, 0.0
        for a in range(d):
            square += p[i, a] * p[i, a]
            along += p[i, a] * v[i, d + a]
        distance = math.sqrt(square)
        e[i, m - 1] = -along / distance
        for a in range(d):
            E_v[i, m - 1, a] = (along * p[i, a] / square - v[i, d + a]) / distance
            E_v[i, m - 1, d + a] = -p[i, a] / distance
    return e, residual(y, e, angular), E_v


@declared
class _Doppler(Cone):
    """Base of these sensors: limits of range, and the expectation."""

    sigma_rate_mps: Annotated[Positive, "Noise of the range rate."] = 0.1

    world: ClassVar[str]
    columns: ClassVar[tuple[str, ...]] = ("range_rate_mps",)
    sigmas: ClassVar[tuple[str, ...]] = ("sigma_rate_mps",)
    expected = expect_range_rate
    sees_velocity: ClassVar[bool] = True


@declared
class _Radar(_Doppler):
    sigma_range_m: Annotated[Positive, "Noise of the range."] = 0.2

    def invert(self, y: Array) -> tuple[Array, Array]:
        """Return points (K, d) and V_y (K, d, m), zero for the rate.  [S] (62)."""
        return place_of_polar(y, self.point_size)

    check = staticmethod(refuse_negative_ranges)


@register("sensor", "range_rate")
class RangeRate2D(InPlane, _Doppler):
    """Rate of the range of a landmark that stands still.

    It starts no landmark.  Where the robot has no velocity in its state it is the mean since the last scan.

    >>> own = km.Mount(km.sensors.RangeRate2D())
    >>> start, motion = (0.0, 0.0, 0.0, 1.0, 0.0), km.motion.ConstantTurnRate()
    >>> slam = km.Slam(km.Robot("rover", motion, start=start, sensors={"own": own}))
    >>> slam.add_landmark("a", mean=(4.0, 3.0), cov=0.01 * np.eye(2))
    >>> slam.expect("rover", "own").e.round(2)
    array([[-0.8]])
    """

    sees_kinds = ("point",)


@register("sensor", "range_rate")
class RangeRate3D(InSpace, _Doppler):
    """Rate of the range of a landmark that stands still.

    It starts no landmark.  Where the robot has no velocity in its state it is the mean since the last scan.

    >>> own = km.Mount(km.sensors.RangeRate3D())
    >>> start = (*[0.0] * 6, 1.0, 1.0, *[0.0] * 5)  # at 1 m/s ahead
    >>> motion = km.motion.ConstantVelocity3D()
    >>> slam = km.Slam(km.Robot("drone", motion, start=start, sensors={"own": own}))
    >>> slam.add_landmark("a", mean=(4.0, 3.0, 0.0), cov=0.01 * np.eye(3))
    >>> slam.expect("drone", "own").e.round(2)
    array([[-0.8]])
    """


@register("sensor", "radar")
class Radar2D(InPlane, _Radar):
    """A radar: range, bearing and range rate of a landmark that stands still.

    Where the robot has no velocity in its state it is the mean since the last scan.

    >>> own = km.Mount(km.sensors.Radar2D())
    >>> start, motion = (0.0, 0.0, 0.0, 1.0, 0.0), km.motion.ConstantTurnRate()
    >>> slam = km.Slam(km.Robot("rover", motion, start=start, sensors={"own": own}))
    >>> slam.add_landmark("a", mean=(4.0, 3.0), cov=0.01 * np.eye(2))
    >>> slam.expect("rover", "own").e.round(2)
    array([[ 5.  ,  0.64, -0.8 ]])
    """

    sigma_bearing_rad: BearingNoise = 0.02

    sees_kinds = ("point",)
    columns = ("range_m", "bearing_rad", "range_rate_mps")
    sigmas = ("sigma_range_m", "sigma_bearing_rad", "sigma_rate_mps")


@register("sensor", "radar")
class Radar3D(InSpace, _Radar):
    """A radar: range, azimuth, elevation and range rate of a landmark that stands still.

    Where the robot has no velocity in its state it is the mean since the last scan.

    >>> own = km.Mount(km.sensors.Radar3D())
    >>> start = (*[0.0] * 6, 1.0, 1.0, *[0.0] * 5)  # at 1 m/s ahead
    >>> motion = km.motion.ConstantVelocity3D()
    >>> slam = km.Slam(km.Robot("drone", motion, start=start, sensors={"own": own}))
    >>> slam.add_landmark("a", mean=(4.0, 3.0, 0.0), cov=0.01 * np.eye(3))
    >>> slam.expect("drone", "own").e.round(2)
    array([[ 5.  ,  0.64,  0.  , -0.8 ]])
    """

    sigma_azimuth_rad: AzimuthNoise = 0.02
    sigma_elevation_rad: ElevationNoise = 0.02

    columns = ("range_m", "azimuth_rad", "elevation_rad", "range_rate_mps")
    sigmas = (
        "sigma_range_m", "sigma_azimuth_rad", "sigma_elevation_rad", "sigma_rate_mps",
    )  # fmt: skip
