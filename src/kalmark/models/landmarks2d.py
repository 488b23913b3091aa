"""Point landmarks of the plane, and how they look from a pose T = (x, y, heading).  [S] (55), (56), 2.3.6.

===================  ====================================  ===================================
type                 state l                               the point
===================  ====================================  ===================================
Euclidean            p (2), attributes                     p
polar                anchor (2), direction alpha, d        anchor + d (cos alpha, sin alpha)
inverse depth        anchor (2), direction alpha, rho      anchor + (cos alpha, sin alpha) / rho
===================  ====================================  ===================================

The second is for sensors whose bearings are so poor that the density is an arc and no ellipse: [S] 2.3.5.  The
third is for sensors that measure no depth.  Such a sensor observes v = rho (point - position of T) in its
frame: the ray to the point, regular for points at infinity, rho = 0, too.
"""

from __future__ import annotations

import math

import numpy as np

from kalmark.arrays import Array
from kalmark.compiled import compiled
from kalmark.geometry.angles import wrap
from kalmark.geometry.frames import from_frame_many, multiply_many, to_frame_many


@compiled
def point_seen_from(T: Array, l: Array) -> tuple[Array, Array, Array]:
    """Return v (K, d) of points l (K, d) with d - 2 attributes, V_T (K, d, 3), V_l (K, d, d).  [S] (56)."""
    return with_attributes(l, to_frame_many(T, l))


@compiled
def point_from_view(T: Array, v: Array) -> tuple[Array, Array, Array]:
    """Return points l (K, d) with attributes that look like v (K, d) from T, L_T, L_v.  [S] (55)."""
    return with_attributes(v, from_frame_many(T, v))


@compiled
def with_attributes(a: Array, points: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
    """Return points (K, 2), with Jacobians in a pose and in `a` (K, d), followed by the attributes in `a`."""
    k, d = a.shape
    p, P_T, P_a = points
    if d == 2:
        return p, P_T, P_a
    b, B_T, B_a = a.copy(), np.zeros((k, d, 3)), np.zeros((k, d, d))
    b[:, :2], B_T[:, :2], B_a[:, :2, :2] = p, P_T, P_a
    for j in range(2, d):
        B_a[:, j, j] = 1.0
    return b, B_T, B_a


@compiled
def inverse_depth_seen_from(T: Array, l: Array) -> tuple[Array, Array, Array]:
    """Return the rays v (K, 2) to inverse-depth points l (K, 4), V_T (K, 2, 3) and V_l (K, 2, 4)."""
    k, c, s = len(l), math.cos(T[2]), math.sin(T[2])
    v, V_T, V_l = np.empty((k, 2)), np.empty((k, 2, 3)), np.empty((k, 2, 4))
    for i in range(k):
        m_x, m_y, rho = math.cos(l[i, 2]), math.sin(l[i, 2]), l[i, 3]
        base_x, base_y = l[i, 0] - T[0], l[i, 1] - T[1]
        x, y = m_x + rho * base_x, m_y + rho * base_y
        v[i, 0], v[i, 1] = c * x + s * y, c * y - s * x
        V_T[i, 0, 0], V_T[i, 0, 1], V_T[i, 0, 2] = -rho * c, -rho * s, v[i, 1]
        V_T[i, 1, 0], V_T[i, 1, 1], V_T[i, 1, 2] = rho * s, -rho * c, -v[i, 0]
        V_l[i, 0, 0], V_l[i, 0, 1] = rho * c, rho * s
        V_l[i, 1, 0], V_l[i, 1, 1] = -rho * s, rho * c
        V_l[i, 0, 2], V_l[i, 1, 2] = s * m_x - c * m_y, c * m_x + s * m_y
        V_l[i, 0, 3], V_l[i, 1, 3] = c * base_x + s * base_y, c * base_y - s * base_x
    return v, V_T, V_l


@compiled
def inverse_depth_from_view(T: Array, ray: Array, rho: Array) -> tuple[Array, Array, Array, Array]:
    """Return inverse-depth points l (K, 4) on rays (K, 2) of T at inverse distances rho (K,), anchored at T.

    With L_T (K, 4, 3), L_ray (K, 4, 2) and L_rho (K, 4, 1).
    """
    k = len(ray)
    l, L_T, L_ray, L_rho = np.empty((k, 4)), np.zeros((k, 4, 3)), np.zeros((k, 4, 2)), np.zeros((k, 4, 1))
    for i in range(k):
        x, y = ray[i]
        l[i, 0], l[i, 1], l[i, 2], l[i, 3] = T[0], T[1], wrap(T[2] + math.atan2(y, x)), rho[i]
        L_T[i, 0, 0] = L_T[i, 1, 1] = L_T[i, 2, 2] = 1.0
        L_ray[i, 2, 0], L_ray[i, 2, 1] = -y / (x * x + y * y), x / (x * x + y * y)
        L_rho[i, 3, 0] = 1.0
    return l, L_T, L_ray, L_rho


@compiled
def inverse_depth_to_point(l: Array) -> tuple[Array, Array]:
    """Return the Euclidean points p (K, 2) of inverse-depth points l (K, 4), and P_l (K, 2, 4).  [S] (48)."""
    polar = l.copy()
    for i in range(len(l)):
        polar[i, 3] = 1.0 / l[i, 3]
    p, P_l = polar_to_point(polar)
    for i in range(len(l)):
        P_l[i, 0, 3] *= -polar[i, 3] * polar[i, 3]
        P_l[i, 1, 3] *= -polar[i, 3] * polar[i, 3]
    return p, P_l


@compiled
def inverse_depth_linearity(T: Array, l: Array, sigma_rho: Array) -> Array:
    """Return the linearity indices (K,) of inverse-depth points l (K, 4) seen from T, sigma_rho (K,) those of rho.

    4 (sigma_depth / distance) |cos alpha|, as `landmarks3d.anchored_linearity`.  Civera, Davison and Montiel 2008.
    """
    p, _ = inverse_depth_to_point(l)
    index = np.empty(len(l))
    for i in range(len(l)):
        x, y, rho = p[i, 0] - T[0], p[i, 1] - T[1], l[i, 3]
        along = abs(x * math.cos(l[i, 2]) + y * math.sin(l[i, 2]))
        index[i] = 4 * sigma_rho[i] / (rho * rho) * along / (x * x + y * y)
    return index


@compiled
def polar_to_point(l: Array) -> tuple[Array, Array]:
    """Return the Euclidean points p (K, 2) of polar points l (K, 4), and P_l (K, 2, 4)."""
    p, P_l = np.empty((len(l), 2)), np.zeros((len(l), 2, 4))
    for i in range(len(l)):
        c, s, d = math.cos(l[i, 2]), math.sin(l[i, 2]), l[i, 3]
        p[i, 0], p[i, 1] = l[i, 0] + d * c, l[i, 1] + d * s
        P_l[i, 0, 0] = P_l[i, 1, 1] = 1.0
        P_l[i, 0, 2], P_l[i, 1, 2] = -d * s, d * c
        P_l[i, 0, 3], P_l[i, 1, 3] = c, s
    return p, P_l


@compiled
def polar_seen_from(T: Array, l: Array) -> tuple[Array, Array, Array]:
    """Return v (K, 2) of polar points l (K, 4), V_T (K, 2, 3) and V_l (K, 2, 4)."""
    return through_point(T, *polar_to_point(l))


@compiled
def inverse_depth_as_point(T: Array, l: Array) -> tuple[Array, Array, Array]:
    """Return the points v (K, 2) of inverse-depth points l (K, 4) in the frame T, V_T (K, 2, 3) and V_l (K, 2, 4)."""
    return through_point(T, *inverse_depth_to_point(l))


@compiled
def through_point(T: Array, p: Array, P_l: Array) -> tuple[Array, Array, Array]:
    """Return points p (K, 2) in the frame T, v (K, 2), V_T (K, 2, 3) and V_l (K, 2, 4), by their P_l (K, 2, 4)."""
    v, V_T, V_p = to_frame_many(T, p)
    return v, V_T, multiply_many(V_p, P_l)


@compiled
def polar_from_view(T: Array, v: Array) -> tuple[Array, Array, Array]:
    """Return polar points l (K, 4) anchored at T that look like v (K, 2) from it, L_T (K, 4, 3), L_v (K, 4, 2)."""
    k = len(v)
    l, L_T, L_v = np.empty((k, 4)), np.zeros((k, 4, 3)), np.zeros((k, 4, 2))
    for i in range(k):
        x, y = v[i]
        d = math.hypot(x, y)
        l[i, 0], l[i, 1], l[i, 2], l[i, 3] = T[0], T[1], wrap(T[2] + math.atan2(y, x)), d
        L_T[i, 0, 0] = L_T[i, 1, 1] = L_T[i, 2, 2] = 1.0
        L_v[i, 2, 0], L_v[i, 2, 1] = -y / (d * d), x / (d * d)
        L_v[i, 3, 0], L_v[i, 3, 1] = x / d, y / d
    return l, L_T, L_v
