"""Landmarks of the plane: Euclidean points, with or without a signature, and how they look from a pose."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from kalmark.compiled import compiled
from kalmark.geometry import frames3d
from kalmark.geometry.frames import from_frame_many, to_frame_many
from kalmark.geometry.spaces import POINT2, POINT3, SCALAR, VECTOR, Space

Array = npt.NDArray[np.float64]


@compiled
def seen_from(T: Array, l: Array) -> tuple[Array, Array, Array]:
    """Return v (K, d) of points l (K, d) with d - 2 attributes, V_T (K, d, 3), V_l (K, d, d).  [S] (56)."""
    k, d = l.shape
    p, P_T, P_l = to_frame_many(T, l)
    if d == 2:
        return p, P_T, P_l
    v, V_T, V_l = l.copy(), np.zeros((k, d, 3)), np.zeros((k, d, d))
    v[:, :2], V_T[:, :2], V_l[:, :2, :2] = p, P_T, P_l
    for j in range(2, d):
        V_l[:, j, j] = 1.0
    return v, V_T, V_l


@compiled
def from_view(T: Array, v: Array) -> tuple[Array, Array, Array]:
    """Return points l (K, d) with attributes that look like v (K, d) from T, L_T, L_v.  [S] (55)."""
    k, d = v.shape
    p, P_T, P_v = from_frame_many(T, v)
    if d == 2:
        return p, P_T, P_v
    l, L_T, L_v = v.copy(), np.zeros((k, d, 3)), np.zeros((k, d, d))
    l[:, :2], L_T[:, :2], L_v[:, :2, :2] = p, P_T, P_v
    for j in range(2, d):
        L_v[:, j, j] = 1.0
    return l, L_T, L_v


@dataclass(frozen=True)
class Point2D:
    """A point (x, y) in metres."""

    kind: ClassVar[str] = "point"
    space: ClassVar[Space] = POINT2

    def seen_from(self, T: Array, l: Array) -> tuple[Array, Array, Array]:
        """Return v (K, d), V_T (K, d, 3), V_l (K, d, d)."""
        return seen_from(T, np.ascontiguousarray(l))

    def from_view(self, T: Array, v: Array) -> tuple[Array, Array, Array]:
        """Return l (K, d), L_T (K, d, 3), L_v (K, d, d)."""
        return from_view(T, np.ascontiguousarray(v))


@dataclass(frozen=True)
class PointSignature2D(Point2D):
    """A point with a signature, (x, y, s): [T]'s landmark, d = 3N + 3."""

    kind: ClassVar[str] = "point_signature"
    space: ClassVar[Space] = Space("point_signature", (VECTOR, SCALAR))


@dataclass(frozen=True)
class Point3D:
    """A point (x, y, z) in metres."""

    kind: ClassVar[str] = "point3"
    space: ClassVar[Space] = POINT3

    def seen_from(self, T: Array, l: Array) -> tuple[Array, Array, Array]:
        """Return v (K, 3), V_T (K, 3, 6), V_l (K, 3, 3)."""
        return frames3d.to_frame_many(T, np.ascontiguousarray(l))

    def from_view(self, T: Array, v: Array) -> tuple[Array, Array, Array]:
        """Return l (K, 3), L_T (K, 3, 6), L_v (K, 3, 3)."""
        return frames3d.from_frame_many(T, np.ascontiguousarray(v))


BUILT_IN = (Point2D, PointSignature2D, Point3D)
