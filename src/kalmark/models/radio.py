"""Sensors of radio and sound: the strength of a landmark that sends, the difference of its times of arrival.

Neither finds where a landmark is at once: they correct landmarks that other sensors have started, or a survey.
Strengths from several places do, in the plane: `management/trilateration.py`.
"""

from __future__ import annotations

import math
from dataclasses import KW_ONLY, replace
from functools import cached_property
from typing import Annotated, ClassVar, Self

import numpy as np

from kalmark.arrays import Array, Flags
from kalmark.compiled import compiled
from kalmark.declare import Estimated, Limit, Number, Positive, declared, register
from kalmark.models.landmark_views import Distancing, InSpace, Raised, length_of_view

__all__ = ["RangeDifference2D", "RangeDifference3D", "SignalStrength2D", "SignalStrength3D"]

NEAREST_M = 1e-3  # nearer than this a receiver and a transmitter are at one place
DECIBELS = 10.0 / math.log(10.0)  # in one unit of a natural logarithm of power


@compiled
def strength(code: int, par: Array, angular: Flags, v: Array, y: Array) -> tuple[Array, Array, Array]:
    """Expect the strength of what is at v (K, d): `par` = (strength at 1 m, exponent, height).  Log-distance."""
    k, d = v.shape
    e, E_v = np.empty((k, 1)), np.empty((k, 1, d))
    for i in range(k):
        r, direction = length_of_view(v, i, par[2], 0.0, NEAREST_M)
        e[i, 0] = par[0] - par[1] * DECIBELS * math.log(r)
        for j in range(d):
            E_v[i, 0, j] = -par[1] * DECIBELS * direction[j] / r
    return e, y - e, E_v


@compiled
def by_path_loss(code: int, par: Array, angular: Flags, v: Array, e: Array) -> Array:
    """Return E_p (K, 1, 2): how strengths e (K, 1) change with the strength at 1 m and the exponent."""
    E_p = np.empty((len(e), 1, 2))
    for i in range(len(e)):
        E_p[i, 0, 0], E_p[i, 0, 1] = 1.0, (e[i, 0] - par[0]) / par[1]
    return E_p


@compiled
def range_difference(code: int, par: Array, angular: Flags, v: Array, y: Array) -> tuple[Array, Array, Array]:
    """Expect how much farther v (K, d) is from the right receiver than the left one; `par` = (baseline, height)."""
    k, d = v.shape
    e, E_v = np.empty((k, 1)), np.empty((k, 1, d))
    for i in range(k):  # the right receiver is at y = -par / 2
        right, to_right = length_of_view(v, i, par[1], 0.5 * par[0], NEAREST_M)
        left, to_left = length_of_view(v, i, par[1], -0.5 * par[0], NEAREST_M)
        e[i, 0] = right - left
        for j in range(d):
            E_v[i, 0, j] = to_right[j] - to_left[j]
    return e, y - e, E_v


@declared
class _Receiver(Distancing):
    """Base of both: a point of either world, and a largest distance."""

    _: KW_ONLY
    range_max_m: Annotated[Limit, "Farthest landmark that is received."] = math.inf

    def sees(self, v: Array) -> Flags:
        """Return which of v (K, d) are near enough."""
        near: Flags = np.linalg.norm(self.risen(v), axis=1) <= self.range_max_m
        return near


@declared
class _SignalStrength(_Receiver):
    sigma_db: Annotated[Positive, "Noise of the strength, shadows and reflections included."] = 4.0
    _: KW_ONLY
    strength_dbm: Annotated[Number, "Strength at a distance of 1 m."] = -40.0
    exponent: Annotated[Positive, "Of the path loss: 2 in free space, 2 to 4 indoors."] = 2.0
    sigma_strength_db: Annotated[Estimated, "Standard deviation of the strength at 1 m"] = 0.0
    sigma_exponent: Annotated[Estimated, "Standard deviation of the exponent"] = 0.0

    columns = ("rssi_dbm",)
    sigmas = ("sigma_db",)
    expected = strength
    varied = by_path_loss
    parameter_names: ClassVar[tuple[str, ...]] = ("strength_dbm", "exponent")

    @cached_property
    def parameters(self) -> Array:
        """The strength at 1 m and the exponent (2,)."""
        return np.array([self.strength_dbm, self.exponent])

    @property
    def parameter_cov(self) -> Array | None:
        """Their covariance (2, 2), None if both are known."""
        sigmas = np.array([self.sigma_strength_db, self.sigma_exponent])
        return np.diag(sigmas**2) if sigmas.any() else None

    def with_parameters(self, parameters: Array) -> Self:
        """Return the sensor with another strength at 1 m and another exponent (2,)."""
        at_1_m, exponent = np.asarray(parameters).tolist()
        return replace(self, strength_dbm=at_1_m, exponent=exponent)


@register("sensor", "signal_strength")
class SignalStrength2D(_SignalStrength, Raised):
    """Received signal strength of a landmark that sends, by the log-distance path loss.

    >>> own = km.Mount(km.sensors.SignalStrength2D(strength_dbm=-40.0, exponent=2.0))
    >>> slam = km.Slam(km.Robot("rover", km.motion.Unicycle(), sensors={"own": own}))
    >>> slam.add_landmark("a", mean=(10.0, 0.0), cov=0.01 * np.eye(2))
    >>> slam.expect("rover", "own").e.round(2)
    array([[-60.]])
    """

    def distances(self, y: Array) -> Array:
        """Return the distances (K,) in the plane at which strengths y (K, 1) of landmarks at height 0 are expected."""
        return self.level(np.asarray(10.0 ** ((self.strength_dbm - y[:, 0]) / (10.0 * self.exponent))))


@register("sensor", "signal_strength")
class SignalStrength3D(InSpace, _SignalStrength):
    """Received signal strength of a landmark that sends, by the log-distance path loss.

    >>> own = km.Mount(km.sensors.SignalStrength3D(strength_dbm=-40.0, exponent=2.0))
    >>> slam = km.Slam(km.Robot("drone", km.motion.Odometry3D(), sensors={"own": own}))
    >>> slam.add_landmark("a", mean=(0.0, 0.0, 10.0), cov=0.01 * np.eye(3))
    >>> slam.expect("drone", "own").e.round(2)
    array([[-60.]])
    """


@declared
class _RangeDifference(_Receiver):
    sigma_m: Annotated[Positive, "Noise of the difference."] = 0.05
    _: KW_ONLY
    baseline_m: Annotated[Positive, "From the right receiver to the left one, along the sensor's y axis."] = 0.5

    columns = ("difference_m",)
    sigmas = ("sigma_m",)
    expected = range_difference

    @cached_property
    def parameters(self) -> Array:
        """The baseline (1,)."""
        return np.array([self.baseline_m])


@register("sensor", "range_difference")
class RangeDifference2D(_RangeDifference, Raised):
    """Time difference of arrival at two receivers, times the speed of light or sound: right less left.

    >>> own = km.Mount(km.sensors.RangeDifference2D(baseline_m=0.5))
    >>> slam = km.Slam(km.Robot("rover", km.motion.Unicycle(), sensors={"own": own}))
    >>> slam.add_landmark("a", mean=(4.0, 3.0), cov=0.01 * np.eye(2))
    >>> slam.expect("rover", "own").e.round(2)
    array([[0.3]])
    """


@register("sensor", "range_difference")
class RangeDifference3D(InSpace, _RangeDifference):
    """Time difference of arrival at two receivers, times the speed of light or sound: right less left.

    >>> own = km.Mount(km.sensors.RangeDifference3D(baseline_m=0.5))
    >>> slam = km.Slam(km.Robot("drone", km.motion.Odometry3D(), sensors={"own": own}))
    >>> slam.add_landmark("a", mean=(4.0, 3.0, 1.0), cov=0.01 * np.eye(3))
    >>> slam.expect("drone", "own").e.round(2)
    array([[0.29]])
    """
