"""What the sensors share: their noise by the names of its parameters, and a compiled expectation.  [S] A.4."""

from __future__ import annotations

from functools import cached_property, lru_cache
from typing import Any, ClassVar

import numpy as np

from kalmark.arrays import Array


@lru_cache(maxsize=256)
def _cached(variances: tuple[float, ...], count: int) -> Array:
    return np.tile(np.diag(variances), (count, 1, 1))


def constant(variances: tuple[float, ...], count: int) -> Array:
    """Return `count` copies of a diagonal covariance (count, m, m)."""
    return _cached(variances, count).copy()


class Sensing:
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


class Expecting(Sensing):
    """A sensor whose expectation is `expected`, compiled, of the form `seen.EXPECT`."""

    expected: ClassVar[Any]

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


class Spatial(Expecting):
    """What sensors of space, and of walls, share."""

    world: ClassVar[str] = "space"
    sees_kinds: ClassVar[tuple[str, ...]] = ("point3",)
    additive: ClassVar[bool] = True
