"""The views of space, compiled: what a landmark of any kind looks like from a pose, what a sensor makes of that view.

======================================  ===========================================  ==================
landmark                                view v (K, d)                                sensors
======================================  ===========================================  ==================
Euclidean point                         the point in the sensor's frame, 3           points, cameras
inverse depth, anchored, homogeneous    the ray rho (p - t) and rho, 4               cameras
tag                                     its pose in the sensor's frame, 7            tags
line                                    normal of the plane through it, 3            segments
======================================  ===========================================  ==================

The rows below, `seen_in_space` by the landmark's code and `expected_in_space` by the sensor's, are the whole table of
models that the compiled filter knows in space; the plane's are in `landmarks` and `sensors`.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from kalmark.compiled import compiled
from kalmark.geometry.angles import wrap
from kalmark.geometry.directions import spherical_many
from kalmark.models import cameras, landmarks3d, lenses, lines, tags

Array = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

# landmarks
POINT, INVERSE_DEPTH, ANCHORED, HOMOGENEOUS_POINT, TAG = range(5)
PLUECKER_LINE, ANCHORED_PLUECKER_LINE, INVERSE_DEPTH_LINE, ANCHORED_LINE, HOMOGENEOUS_LINE = range(5, 10)
# sensors
RANGE_BEARING_3D, POSITION_3D, CAMERA, STEREO, SEGMENTS, TAG_POSE, TAG_CORNERS = range(10, 17)


@compiled
def seen_in_space(kind: int, T: Array, l: Array) -> tuple[Array, Array, Array]:
    """Return the views v (K, d) of landmarks l (K, n) of one kind, V_T (K, ., 6) and V_l (K, ., n)."""
    if kind == POINT:
        return landmarks3d.point_seen_from(T, l)
    if kind == TAG:
        return tags.tag_seen_from(T, l)
    if kind == PLUECKER_LINE:
        return lines.pluecker_seen_from(T, l)
    if kind == ANCHORED_PLUECKER_LINE:
        return lines.anchored_pluecker_seen_from(T, l)
    if kind == INVERSE_DEPTH_LINE:
        return lines.inverse_depth_line_seen_from(T, l)
    if kind == ANCHORED_LINE:
        return lines.anchored_homogeneous_line_seen_from(T, l)
    if kind == HOMOGENEOUS_LINE:
        return lines.homogeneous_line_seen_from(T, l)
    if kind == INVERSE_DEPTH:
        ray, R_T, R_l = landmarks3d.inverse_depth_seen_from(T, l)
    elif kind == ANCHORED:
        ray, R_T, R_l = landmarks3d.anchored_seen_from(T, l)
    else:
        ray, R_T, R_l = landmarks3d.homogeneous_seen_from(T, l)
    k, n = l.shape  # the inverse distance is their last number
    v, V_T, V_l = np.empty((k, 4)), np.zeros((k, 4, 6)), np.zeros((k, 4, n))
    v[:, :3], v[:, 3] = ray, l[:, n - 1]
    V_T[:, :3], V_l[:, :3], V_l[:, 3, n - 1] = R_T, R_l, 1.0
    return v, V_T, V_l


@compiled
def expected_in_space(
    code: int, lens: int, par: Array, angular: Flags, v: Array, y: Array
) -> tuple[Array, Array, Array]:
    """Return what a sensor expects to measure e (K, m), the innovations z (K, p) of y (K, m), and E_v = -Z_v."""
    if code == SEGMENTS:
        return lines.segment_innovation(v, y, par)
    if code == TAG_POSE:
        z, E_v = tags.pose_residual(y, v)
        return v.copy(), z, E_v
    if code == TAG_CORNERS:
        corners, E_v = tags.project_corners(lens, v, y[:, 8].copy(), par)
        e = y.copy()
        e[:, :8] = corners
        return e, y[:, :8] - corners, E_v
    if code == CAMERA:
        e, E_ray = lenses.project(lens, v[:, :3].copy(), par)
        E_v = padded(E_ray, v.shape[1])
    elif code == STEREO:
        e, E_v = cameras.project_stereo(v, par[:4], par[4])
    elif code == RANGE_BEARING_3D:
        e, E_v = spherical_many(v)
    else:
        e, E_v = v.copy(), np.zeros((len(v), 3, 3))
        for j in range(3):
            E_v[:, j, j] = 1.0
    return e, residual(y, e, angular), E_v


@compiled
def padded(E_v: Array, d: int) -> Array:
    """Return E_v (K, m, 3) as (K, m, d): the pixel of a ray does not depend on its inverse distance."""
    if d == 3:
        return E_v
    wide = np.zeros((E_v.shape[0], E_v.shape[1], d))
    wide[:, :, :3] = E_v
    return wide


@compiled
def residual(y: Array, e: Array, angular: Flags) -> Array:
    """Return z = y - e (K, m), the angles among them wrapped.  [S] (26)."""
    z = y - e
    for j in range(len(angular)):
        if angular[j]:
            for i in range(len(z)):
                z[i, j] = wrap(z[i, j])
    return z
