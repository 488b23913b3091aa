"""Bring your own sensor: one-point functions lifted to batches, with numerical Jacobians where none are given."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from kalmark.arrays import Array
from kalmark.errors import ModelError
from kalmark.geometry.angles import wrap


def jacobian(function: Callable[[Array], Array], x: Array, angular: tuple[bool, ...] = ()) -> Array:
    """Return d f / d x (m, n) at x (n,) by central differences, one step a coordinate; angles wrap."""
    x = np.asarray(x, dtype=np.float64)
    columns = []
    for i in range(len(x)):
        step = np.zeros_like(x)
        step[i] = np.cbrt(np.finfo(float).eps) * max(1.0, abs(x[i]))
        rise = np.atleast_1d(function(x + step)) - np.atleast_1d(function(x - step))
        rise = np.where(angular, wrap(rise), rise) if angular else rise
        columns.append(rise / (2 * step[i]))
    return np.stack(columns, axis=-1)


@dataclass(frozen=True)
class PointwiseSensor:
    """A sensor made of functions of one point; see `pointwise`."""

    measure: Callable[..., Any]
    R: Array
    columns: tuple[str, ...]
    angular: tuple[bool, ...]
    inverse: Callable[[Array], Any] | None = None
    measure_jacobian: Callable[[Array], Any] | None = None
    inverse_jacobian: Callable[[Array], Any] | None = None
    additive: bool = True
    name: str = field(default="pointwise", compare=False)

    def _value(self, v: Array) -> Array:
        n = (np.zeros(len(self.R)),) if not self.additive else ()
        return np.atleast_1d(np.asarray(self.measure(v, *n), dtype=np.float64))

    def expect(self, v: Array) -> tuple[Array, Array]:
        """Return the measurements (K, m) of v (K, d), and E_v (K, m, d)."""
        e = np.array([self._value(one) for one in v])
        if self.measure_jacobian is not None:
            return e, np.array([np.atleast_2d(self.measure_jacobian(one)) for one in v])
        return e, np.array([jacobian(self._value, one, self.angular) for one in v])

    def noise(self, y: Array) -> Array:
        """Return R (K, m, m); for a noise that enters inside the measurement use `noise_at`."""
        return np.tile(self.R, (len(y), 1, 1))


@dataclass(frozen=True)
class PointwiseFullSensor(PointwiseSensor):
    """A pointwise sensor with an inverse, so that it can start landmarks."""

    def invert(self, y: Array) -> tuple[Array, Array]:
        """Return what is at v (K, d) for measurements y (K, m), and V_y (K, d, m)."""
        assert self.inverse is not None
        v = np.array([np.asarray(self.inverse(one), dtype=np.float64) for one in y])
        if self.inverse_jacobian is not None:
            return v, np.array([np.atleast_2d(self.inverse_jacobian(one)) for one in y])
        return v, np.array([jacobian(self.inverse, one) for one in y])


def _noise_at(sensor: PointwiseSensor, v: Array) -> Array:
    """Return E_n N E_n' (K, m, m): [F]'s G_n Sigma G_n', the noise inside y = g(v, n)."""
    zero = np.zeros(len(sensor.R))
    E_n = [jacobian(lambda n, one=one: sensor.measure(one, n), zero, sensor.angular) for one in v]  # type: ignore[misc]
    return np.array([J @ sensor.R @ J.T for J in E_n])


class NoisyPointwiseSensor(PointwiseSensor):
    """A pointwise sensor whose noise enters inside the measurement."""

    noise_at = _noise_at


class NoisyPointwiseFullSensor(PointwiseFullSensor):
    """A pointwise sensor with an inverse and a noise that enters inside the measurement."""

    noise_at = _noise_at


def noise_covariance(noise: Any, what: str) -> Array:
    """Return the covariance (m, m) of a noise.  Raises ModelError if it is none, with `what` it is of."""
    R = np.atleast_2d(np.asarray(noise, dtype=np.float64))
    if R.ndim != 2 or R.shape[0] != R.shape[1] or not np.isfinite(R).all():
        raise ModelError(f"{what}: noise has shape {R.shape}, expected a finite square covariance")
    if not np.allclose(R, R.T) or np.linalg.eigvalsh(R).min() <= 0:
        raise ModelError(f"{what}: noise is {R.tolist()}, expected a symmetric positive definite matrix")
    return R


def pointwise(
    measure: Callable[..., Any],
    noise: Any,
    *,
    inverse: Callable[[Array], Any] | None = None,
    columns: tuple[str, ...] = (),
    angular: tuple[bool, ...] = (),
    jacobian: Callable[[Array], Any] | None = None,
    inverse_jacobian: Callable[[Array], Any] | None = None,
    noise_inside: bool = False,
) -> PointwiseSensor:
    """Make a sensor of `measure(v) -> y` (m,), v = (x, y[, ...]) in the sensor's frame, noise covariance `noise`.

    `inverse(y) -> v` lets it start landmarks.  `jacobian(v)` (m, d) and `inverse_jacobian(y)` (d, m) are numerical when
    not given.  `angular` marks the components that are angles.  With `noise_inside` the sensor is `measure(v, n)` and
    `noise` the covariance of n.

    >>> squared = km.pointwise(lambda v: [v[0] ** 2 + v[1] ** 2], noise=[0.1])
    >>> squared.expect(np.array([[3.0, 4.0]]))[0].round(3)
    array([[25.]])
    """
    R = noise_covariance(noise, "pointwise sensor")
    m = len(angular) or len(columns) or len(R)
    kinds = (PointwiseSensor, NoisyPointwiseSensor), (PointwiseFullSensor, NoisyPointwiseFullSensor)
    return kinds[inverse is not None][noise_inside](
        measure=measure,
        R=R,
        columns=columns or tuple(f"y{i}" for i in range(m)),
        angular=angular or (False,) * m,
        inverse=inverse,
        measure_jacobian=jacobian,
        inverse_jacobian=inverse_jacobian,
        additive=not noise_inside,
    )
