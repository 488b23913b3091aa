"""Where lines of space end: endpoints kept beside the filter, and the part of a segment that a camera sees.  [TB] 4.3.

A line (see `lines`) has no ends; those of the segment seen so far are abscissas t (K, 2) on it, ascending.  On Pluecker
lines t counts metres along v, from the point closest to the origin or, if anchored, to the anchor; on lines through two
points it goes from 0 at the first to 1 at the second.  Points at infinity have no coordinates: inf or NaN.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from kalmark.compiled import compiled
from kalmark.geometry.directions import unit_many
from kalmark.geometry.frames3d import to_frame_many
from kalmark.geometry.rotations import matrix, skew
from kalmark.models.landmarks3d import anchored_to_point, homogeneous_to_point, inverse_depth_to_point
from kalmark.models.lines import crossed, ends, joined

Array = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]

PLUECKER_ABSCISSAS_M = (-8.0, 8.0)  # of a new line.  [TB]
POINT_ABSCISSAS = (0.0, 1.0)
NEAREST_M = 1e-3  # a camera sees nothing nearer


@compiled
def anchored_pluecker_endpoints(l: Array, t: Array) -> tuple[Array, Array]:
    """Return the points p (K, 2, 3) at abscissas t (K, 2) of anchored Pluecker lines l (K, 9), and P_l (K, 2, 3, 9)."""
    v = l[:, 6:].copy()
    foot, F_v, F_n = crossed(v, l[:, 3:6].copy())
    u, U_v = unit_many(v)
    p, P_l = np.empty((len(l), 2, 3)), np.empty((len(l), 2, 3, 9))
    for i in range(len(l)):
        v2 = v[i, 0] * v[i, 0] + v[i, 1] * v[i, 1] + v[i, 2] * v[i, 2]
        for end in range(2):
            for j in range(3):
                p[i, end, j] = l[i, j] + foot[i, j] / v2 + t[i, end] * u[i, j]
                for a in range(3):
                    P_l[i, end, j, a] = 1.0 if a == j else 0.0
                    P_l[i, end, j, 3 + a] = F_n[i, j, a] / v2
                    turn = F_v[i, j, a] / v2 + t[i, end] * U_v[i, j, a]
                    P_l[i, end, j, 6 + a] = turn - 2 * foot[i, j] * v[i, a] / (v2 * v2)
    return p, P_l


@compiled
def pluecker_endpoints(l: Array, t: Array) -> tuple[Array, Array]:
    """Return the points p (K, 2, 3) at abscissas t (K, 2) of Pluecker lines l (K, 6), and P_l (K, 2, 3, 6)."""
    p, P_l = anchored_pluecker_endpoints(np.hstack((np.zeros((len(l), 3)), l)), t)
    return p, P_l[:, :, :, 3:].copy()


@compiled
def points_between(a: tuple[Array, Array], b: tuple[Array, Array], t: Array, shared: int) -> tuple[Array, Array]:
    """Return the points (1 - t) a + t b, t (K, 2), of lines through a, b (K, 3); an unused one may be at infinity."""
    nothing = np.zeros_like(a[1])
    A_l, B_l = joined(a[1], nothing, shared), joined(nothing, b[1], shared)
    p, P_l = np.zeros((len(t), 2, 3)), np.zeros((len(t), 2, 3, A_l.shape[2]))
    for i in range(len(t)):
        for end in range(2):
            if t[i, end] != 1.0:
                p[i, end] += (1.0 - t[i, end]) * a[0][i]
                P_l[i, end] += (1.0 - t[i, end]) * A_l[i]
            if t[i, end] != 0.0:
                p[i, end] += t[i, end] * b[0][i]
                P_l[i, end] += t[i, end] * B_l[i]
    return p, P_l


@compiled
def inverse_depth_line_endpoints(l: Array, t: Array) -> tuple[Array, Array]:
    """Return the points p (K, 2, 3) at abscissas t (K, 2) of inverse-depth lines l (K, 9), and P_l (K, 2, 3, 9)."""
    a, b = ends(l, 3)
    return points_between(inverse_depth_to_point(a), inverse_depth_to_point(b), t, 3)


@compiled
def anchored_homogeneous_line_endpoints(l: Array, t: Array) -> tuple[Array, Array]:
    """Return the points p (K, 2, 3) at t (K, 2) of anchored homogeneous lines l (K, 11), and P_l (K, 2, 3, 11)."""
    a, b = ends(l, 3)
    return points_between(anchored_to_point(a), anchored_to_point(b), t, 3)


@compiled
def homogeneous_line_endpoints(l: Array, t: Array) -> tuple[Array, Array]:
    """Return the points p (K, 2, 3) at abscissas t (K, 2) of homogeneous lines l (K, 8), and P_l (K, 2, 3, 8)."""
    a, b = ends(l, 0)
    return points_between(homogeneous_to_point(a), homogeneous_to_point(b), t, 0)


@compiled
def abscissas(T: Array, p: Array, rays: Array) -> Array:
    """Return where rays (K, 6) of T pass nearest the lines through p (K, 2, 3), from 0 at p[:, 0] to 1 at p[:, 1].

    NaN where that is behind T, or nowhere: rays along the line.
    """
    Q = matrix(T[3:])
    t = np.full((len(p), 2), np.nan)
    for i in range(len(p)):
        base, d = T[:3] - p[i, 0], p[i, 1] - p[i, 0]
        for end in range(2):
            r = Q @ rays[i, 3 * end : 3 * end + 3].copy()
            dd, dr, rr, db, rb = np.dot(d, d), np.dot(d, r), np.dot(r, r), np.dot(d, base), np.dot(r, base)
            det = dd * rr - dr * dr
            if det > 1e-14 * dd * rr and dr * db - dd * rb > 0:
                t[i, end] = (rr * db - dr * rb) / det
    return t


@compiled
def unit_abscissas(k: int) -> Array:
    """Return the abscissas (k, 2), 0 and 1, of k lines."""
    t = np.zeros((k, 2))
    t[:, 1] = 1.0
    return t


@compiled
def pluecker_abscissas(T: Array, l: Array, rays: Array) -> Array:
    """Return the abscissas t (K, 2) at which rays (K, 6) of T pass nearest Pluecker lines l (K, 6); see `abscissas`."""
    return abscissas(T, pluecker_endpoints(l, unit_abscissas(len(l)))[0], rays)


@compiled
def anchored_pluecker_abscissas(T: Array, l: Array, rays: Array) -> Array:
    """Return the abscissas t (K, 2) at which rays (K, 6) of T pass nearest anchored Pluecker lines l (K, 9)."""
    return abscissas(T, anchored_pluecker_endpoints(l, unit_abscissas(len(l)))[0], rays)


@compiled
def inverse_depth_line_abscissas(T: Array, l: Array, rays: Array) -> Array:
    """Return the abscissas t (K, 2) at which rays (K, 6) of T pass nearest inverse-depth lines l (K, 9)."""
    return abscissas(T, inverse_depth_line_endpoints(l, unit_abscissas(len(l)))[0], rays)


@compiled
def anchored_homogeneous_line_abscissas(T: Array, l: Array, rays: Array) -> Array:
    """Return the abscissas t (K, 2) at which rays (K, 6) of T pass nearest anchored homogeneous lines l (K, 11)."""
    return abscissas(T, anchored_homogeneous_line_endpoints(l, unit_abscissas(len(l)))[0], rays)


@compiled
def homogeneous_line_abscissas(T: Array, l: Array, rays: Array) -> Array:
    """Return the abscissas t (K, 2) at which rays (K, 6) of T pass nearest homogeneous lines l (K, 8)."""
    return abscissas(T, homogeneous_line_endpoints(l, unit_abscissas(len(l)))[0], rays)


@compiled
def crossing_angles(T: Array, p: Array, rays: Array) -> Array:
    """Return the angles (K, 2), 0 to pi/2, between rays (K, 6) of T and the lines through p (K, 2, 3)."""
    Q = matrix(T[3:])
    angles = np.empty((len(p), 2))
    for i in range(len(p)):
        across = skew(p[i, 1] - p[i, 0]) @ Q
        for end in range(2):
            r = rays[i, 3 * end : 3 * end + 3].copy()
            c = across @ r
            angles[i, end] = math.atan2(math.sqrt(np.dot(c, c)), abs(np.dot(p[i, 1] - p[i, 0], Q @ r)))
    return angles


def extended(
    t_old: Array,
    t_measured: Array,
    sigma_px: Array | None = None,
    angles: Array | None = None,
    switch_px: float = 10.0,
    least_angle: float = math.pi / 4,
) -> Array:
    """Return the abscissas (K, 2), ascending, of segments t_old (K, 2) after a measurement at t_measured (K, 2).

    Segments only grow.  Except, if the largest sigmas of their endpoints in the image sigma_px (K,) are given (Pluecker
    lines), those not below `switch_px` become what was measured; and, if the `angles` (K, 2) between rays and lines are
    given (lines through two points), those with one not above `least_angle` stay as they are.  Measured abscissas that
    are not finite leave their segment as it is.  [TB] `extPolicy`, `extSwitch`.
    """
    usable: Bools = np.isfinite(t_measured.sum(axis=1))
    if angles is not None:
        usable = usable & (angles.min(axis=1) > least_angle)
    keeps: Bools = np.ones(len(t_old), dtype=np.bool_) if sigma_px is None else sigma_px < switch_px
    both = np.where(keeps[:, None], t_old, t_measured)
    low, high = np.minimum(both, t_measured).min(axis=1), np.maximum(both, t_measured).max(axis=1)
    return np.where(usable[:, None], np.stack([low, high], axis=1), t_old)


@compiled
def clipped(a: Array, b: Array) -> tuple[float, float]:
    """Return the first and last s in [0, 1] with all a + s (b - a) >= 0, a, b (n,); none: first > last."""
    first, last = 0.0, 1.0
    for j in range(len(a)):
        if a[j] < 0 and b[j] < 0:
            return 1.0, 0.0
        if a[j] < 0:
            first = max(first, a[j] / (a[j] - b[j]))
        elif b[j] < 0:
            last = min(last, a[j] / (a[j] - b[j]))
    return first, last


@compiled
def from_borders(v: Array, k: Array, size: Array) -> Array:
    """Return depth times the distances (5,) in pixels from the borders of the image; the depth from the nearest."""
    x, y = k[0] * v[0] + k[2] * v[2], k[1] * v[1] + k[3] * v[2]
    return np.array([x, size[0] * v[2] - x, y, size[1] * v[2] - y, v[2] - NEAREST_M])


@compiled
def visible_segment(T: Array, p1: Array, p2: Array, k: Array, size: Array, min_length_px: float) -> tuple[Bools, Array]:
    """Return which segments from p1 to p2 (K, 3) a camera at T sees, and their pixels (K, 4) trimmed to the image.

    Seen are those with at least `min_length_px` in an image of size (2,) = (width, height), borders included, and in
    front of the camera: trimmed in space, so that an end behind it does no harm.  Outside the image or not finite: NaN.
    """
    visible, segment = np.zeros(len(p1), dtype=np.bool_), np.full((len(p1), 4), np.nan)
    a, b = to_frame_many(T, p1)[0], to_frame_many(T, p2)[0]
    for i in range(len(p1)):
        if not math.isfinite(a[i].sum() + b[i].sum()):
            continue
        first, last = clipped(from_borders(a[i], k, size), from_borders(b[i], k, size))
        if not first <= last:
            continue
        for end, s in ((0, first), (1, last)):
            v = a[i] + s * (b[i] - a[i])
            for j in range(2):
                segment[i, 2 * end + j] = min(max(k[2 + j] + k[j] * v[j] / v[2], 0.0), size[j])
        length = math.hypot(segment[i, 2] - segment[i, 0], segment[i, 3] - segment[i, 1])
        visible[i] = length >= min_length_px
    return visible, segment
