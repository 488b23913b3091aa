"""The view of landmarks that are known exactly: their coordinates come with the measurements, not from the map.

Such a landmark has no block.  An observation of it is one of the robot alone: y (K, m + n) has what was measured, then
the landmark's n numbers.  So the corrections stay as they are: E_l has no columns, and the slots are the robot's.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from kalmark.arrays import Array
from kalmark.compiled import address_of, compiled
from kalmark.models.observe import LINEARIZE, MOUNT, View, linearize_in_plane, linearize_in_space
from kalmark.models.velocity_view import linearize_moving


@dataclass(frozen=True)
class KnownView:
    """A view evaluated in Python, of landmarks that are known exactly."""

    view: Any

    @property
    def mount(self) -> Array:
        """The mount of the sensor, (3,) or (7,)."""
        mount: Array = self.view.mount
        return mount

    def linearize(self, head: Array, l: Array, y: Array) -> tuple[Array, Array, Array, Array]:
        """Return e (K, m + n), z (K, p), E_h (K, p, h) and E_l (K, p, 0) of measurements and landmarks y (K, m + n)."""
        m = len(self.view.angular)
        e, z, E_h, _ = self.view.linearize(head, np.ascontiguousarray(y[:, m:]), np.ascontiguousarray(y[:, :m]))
        return np.concatenate([e, y[:, m:]], axis=1), z, E_h, np.zeros((*z.shape, 0))


def known_view(view: Any) -> Any:
    """Return the argument of `linearize` for landmarks known exactly, of the one for landmarks of the map."""
    if not isinstance(view, tuple):
        return KnownView(view)
    of_mount = {3: linearize_known_in_plane, 7: linearize_known_in_space}
    linearize = of_mount.get(len(view[MOUNT]), linearize_known_moving)  # of a mount with a mark behind it
    return address_of(linearize, LINEARIZE), *view[1:]


@compiled
def split_columns(y: Array, m: int) -> tuple[Array, Array]:
    """Return the first m columns of y (K, m + n) and the others."""
    k, size = y.shape
    measured, known = np.empty((k, m)), np.empty((k, size - m))
    for i in range(k):
        for j in range(m):
            measured[i, j] = y[i, j]
        for j in range(size - m):
            known[i, j] = y[i, m + j]
    return measured, known


@compiled
def append_columns(e: Array, y: Array) -> Array:
    """Return e (K, m) with the columns of y (K, m + n) behind the first m."""
    out = y.copy()
    for i in range(e.shape[0]):
        for j in range(e.shape[1]):
            out[i, j] = e[i, j]
    return out


@compiled
def linearize_known_in_plane(view: View, head: Array, l: Array, y: Array) -> tuple[Array, Array, Array, Array]:
    """Return e (K, m + n), z (K, p), E_h (K, p, h) and E_l (K, p, 0) in the plane; y (K, m + n), l (K, 0)."""
    measured, known = split_columns(y, len(view[6]))
    e, z, E_h, _E_l = linearize_in_plane(view, head, known, measured)
    return append_columns(e, y), z, E_h, np.zeros((z.shape[0], z.shape[1], 0))


@compiled
def linearize_known_in_space(view: View, head: Array, l: Array, y: Array) -> tuple[Array, Array, Array, Array]:
    """Return e (K, m + n), z (K, p), E_h (K, p, h) and E_l (K, p, 0) in space; y (K, m + n), l (K, 0)."""
    measured, known = split_columns(y, len(view[6]))
    e, z, E_h, _E_l = linearize_in_space(view, head, known, measured)
    return append_columns(e, y), z, E_h, np.zeros((z.shape[0], z.shape[1], 0))


@compiled
def linearize_known_moving(view: View, head: Array, l: Array, y: Array) -> tuple[Array, Array, Array, Array]:
    """Return e (K, m + n), z (K, p), E_h (K, p, h), E_l (K, p, 0) of a sensor with its own velocity; y (K, m + n)."""
    measured, known = split_columns(y, len(view[6]))
    e, z, E_h, _E_l = linearize_moving(view, head, known, measured)
    return append_columns(e, y), z, E_h, np.zeros((z.shape[0], z.shape[1], 0))
