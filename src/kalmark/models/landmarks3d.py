"""Point landmarks of space, and how they look from a pose T = (x, y, z, qx, qy, qz, qw).  [TB] 4.3; Sola 2012.

===================  ====================================  ====================
type                 state l                               the point
===================  ====================================  ====================
Euclidean            p (3)                                 p
inverse depth        anchor (3), azimuth, elevation, rho   anchor + m / rho
anchored             anchor (3), m (3), rho                anchor + m / rho
homogeneous          h (3), rho                            h / rho
===================  ====================================  ====================

The last three are for sensors that measure no depth.  Such a sensor observes v = rho (point - position of T) in
its frame: the ray to the point, regular for points at infinity, rho = 0, too.  `..._from_view` takes a ray of any
length and an inverse distance rho, the prior of the distance.  A sensor that measures ranges requires the Euclidean
point, `..._to_point`.  The anchored point is called homogeneous as well; its m is a unit vector when it is made,
free later.
"""

from __future__ import annotations

import math

import numpy as np

from kalmark.arrays import Array
from kalmark.compiled import compiled
from kalmark.geometry.directions import direction_many, spherical_many, unit_many
from kalmark.geometry.frames import multiply_many
from kalmark.geometry.frames3d import from_frame_many, to_frame_many
from kalmark.geometry.rotations import matrix

point_seen_from = to_frame_many
point_from_view = from_frame_many


@compiled
def anchored_seen_from(T: Array, l: Array) -> tuple[Array, Array, Array]:
    """Return the rays v (K, 3) to anchored points l (K, 7), V_T (K, 3, 6) and V_l (K, 3, 7)."""
    Q, k = matrix(T[3:]), len(l)
    v, V_T, V_l = np.zeros((k, 3)), np.empty((k, 3, 6)), np.zeros((k, 3, 7))
    base, ray = np.empty(3), np.empty(3)
    for i in range(k):
        rho = l[i, 6]
        for a in range(3):
            base[a] = l[i, a] - T[a]
            ray[a] = l[i, 3 + a] + rho * base[a]
        for j in range(3):
            for a in range(3):
                b, c = (a + 1) % 3, (a + 2) % 3
                v[i, j] += Q[a, j] * ray[a]
                V_l[i, j, 6] += Q[a, j] * base[a]
                V_l[i, j, a], V_l[i, j, 3 + a] = rho * Q[a, j], Q[a, j]
                V_T[i, j, a], V_T[i, j, 3 + a] = -rho * Q[a, j], Q[b, j] * ray[c] - Q[c, j] * ray[b]
    return v, V_T, V_l


@compiled
def inverse_depth_seen_from(T: Array, l: Array) -> tuple[Array, Array, Array]:
    """Return the rays v (K, 3) to inverse-depth points l (K, 6), V_T (K, 3, 6) and V_l (K, 3, 6)."""
    h, H_l = inverse_depth_to_anchored(l)
    v, V_T, V_h = anchored_seen_from(T, h)
    return v, V_T, multiply_many(V_h, H_l)


@compiled
def homogeneous_seen_from(T: Array, l: Array) -> tuple[Array, Array, Array]:
    """Return the rays v (K, 3) to homogeneous points l (K, 4), V_T (K, 3, 6) and V_l (K, 3, 4)."""
    anchored = np.zeros((len(l), 7))  # at the origin
    anchored[:, 3:] = l
    v, V_T, V_anchored = anchored_seen_from(T, anchored)
    return v, V_T, V_anchored[:, :, 3:].copy()


@compiled
def world_rays(T: Array, ray: Array) -> tuple[Array, Array, Array]:
    """Return the world's unit vectors m (K, 3) along rays (K, 3) of T, M_theta (K, 3, 3) and M_ray (K, 3, 3)."""
    Q, k = matrix(T[3:]), len(ray)
    w, M_theta, M_ray = np.zeros((k, 3)), np.zeros((k, 3, 3)), np.zeros((k, 3, 3))
    for i in range(k):
        for a in range(3):
            for b in range(3):
                w[i, a] += ray[i, b] * Q[a, b]
    m, M_w = unit_many(w)
    for i in range(k):
        for a in range(3):
            b, c = (a + 1) % 3, (a + 2) % 3
            M_theta[i, b, c], M_theta[i, c, b] = m[i, a], -m[i, a]
            for j in range(3):
                for d in range(3):
                    M_ray[i, a, j] += M_w[i, a, d] * Q[d, j]
    return m, M_theta, M_ray


@compiled
def anchored_from_view(T: Array, ray: Array, rho: Array) -> tuple[Array, Array, Array, Array]:
    """Return anchored points l (K, 7) on rays (K, 3) of T at inverse distances rho (K,), anchored at T.

    With L_T (K, 7, 6), L_ray (K, 7, 3) and L_rho (K, 7, 1).
    """
    k = len(ray)
    m, M_theta, M_ray = world_rays(T, ray)
    l, L_T, L_ray, L_rho = np.empty((k, 7)), np.zeros((k, 7, 6)), np.zeros((k, 7, 3)), np.zeros((k, 7, 1))
    l[:, :3], l[:, 3:6], l[:, 6] = T[:3], m, rho
    L_T[:, :3, :3], L_T[:, 3:6, 3:], L_ray[:, 3:6], L_rho[:, 6] = np.eye(3), M_theta, M_ray, 1.0
    return l, L_T, L_ray, L_rho


@compiled
def inverse_depth_from_view(T: Array, ray: Array, rho: Array) -> tuple[Array, Array, Array, Array]:
    """Return inverse-depth points l (K, 6) on rays (K, 3) of T at inverse distances rho (K,), anchored at T.

    With L_T (K, 6, 6), L_ray (K, 6, 3) and L_rho (K, 6, 1).
    """
    h, H_T, H_ray, H_rho = anchored_from_view(T, ray, rho)
    l, L_h = anchored_to_inverse_depth(h)
    return l, multiply_many(L_h, H_T), multiply_many(L_h, H_ray), multiply_many(L_h, H_rho)


@compiled
def homogeneous_from_view(T: Array, ray: Array, rho: Array) -> tuple[Array, Array, Array, Array]:
    """Return homogeneous points l (K, 4) on rays (K, 3) of T at inverse distances rho (K,) from T.

    With L_T (K, 4, 6), L_ray (K, 4, 3) and L_rho (K, 4, 1).
    """
    k = len(ray)
    m, M_theta, M_ray = world_rays(T, ray)
    l, L_T, L_ray, L_rho = np.empty((k, 4)), np.zeros((k, 4, 6)), np.zeros((k, 4, 3)), np.zeros((k, 4, 1))
    l[:, 3], L_T[:, :3, 3:], L_ray[:, :3], L_rho[:, 3] = rho, M_theta, M_ray, 1.0
    for i in range(k):
        for a in range(3):
            l[i, a] = m[i, a] + rho[i] * T[a]
            L_T[i, a, a], L_rho[i, a, 0] = rho[i], T[a]
    return l, L_T, L_ray, L_rho


@compiled
def inverse_depth_to_anchored(l: Array) -> tuple[Array, Array]:
    """Return the anchored points h (K, 7) of inverse-depth points l (K, 6), and H_l (K, 7, 6)."""
    m, M_a = direction_many(l[:, 3:5])
    h, H_l = np.empty((len(l), 7)), np.zeros((len(l), 7, 6))
    h[:, :3], h[:, 3:6], h[:, 6] = l[:, :3], m, l[:, 5]
    H_l[:, :3, :3], H_l[:, 3:6, 3:5], H_l[:, 6, 5] = np.eye(3), M_a, 1.0
    return h, H_l


@compiled
def anchored_to_inverse_depth(h: Array) -> tuple[Array, Array]:
    """Return the inverse-depth points l (K, 6) of anchored points h (K, 7), and L_h (K, 6, 7): rho / |m| is kept."""
    y, Y_m = spherical_many(h[:, 3:6])
    l, L_h = np.empty((len(h), 6)), np.zeros((len(h), 6, 7))
    for i in range(len(h)):
        l[i, :3], l[i, 3:5], l[i, 5] = h[i, :3], y[i, 1:], h[i, 6] / y[i, 0]
        for a in range(3):
            L_h[i, a, a] = 1.0
            L_h[i, 3, 3 + a], L_h[i, 4, 3 + a] = Y_m[i, 1, a], Y_m[i, 2, a]
            L_h[i, 5, 3 + a] = -l[i, 5] / y[i, 0] * Y_m[i, 0, a]
        L_h[i, 5, 6] = 1.0 / y[i, 0]
    return l, L_h


@compiled
def anchored_to_point(l: Array) -> tuple[Array, Array]:
    """Return the Euclidean points p (K, 3) of anchored points l (K, 7), and P_l (K, 3, 7)."""
    p, P_l = np.empty((len(l), 3)), np.zeros((len(l), 3, 7))
    for i in range(len(l)):
        for a in range(3):
            p[i, a] = l[i, a] + l[i, 3 + a] / l[i, 6]
            P_l[i, a, a], P_l[i, a, 3 + a] = 1.0, 1.0 / l[i, 6]
            P_l[i, a, 6] = -l[i, 3 + a] / (l[i, 6] * l[i, 6])
    return p, P_l


@compiled
def inverse_depth_to_point(l: Array) -> tuple[Array, Array]:
    """Return the Euclidean points p (K, 3) of inverse-depth points l (K, 6), and P_l (K, 3, 6)."""
    h, H_l = inverse_depth_to_anchored(l)
    p, P_h = anchored_to_point(h)
    return p, multiply_many(P_h, H_l)


@compiled
def homogeneous_to_point(l: Array) -> tuple[Array, Array]:
    """Return the Euclidean points p (K, 3) of homogeneous points l (K, 4), and P_l (K, 3, 4)."""
    p, P_l = np.empty((len(l), 3)), np.zeros((len(l), 3, 4))
    for i in range(len(l)):
        for a in range(3):
            p[i, a] = l[i, a] / l[i, 3]
            P_l[i, a, a], P_l[i, a, 3] = 1.0 / l[i, 3], -p[i, a] / l[i, 3]
    return p, P_l


@compiled
def anchored_linearity(T: Array, l: Array, sigma_rho: Array) -> Array:
    """Return the linearity indices (K,) of anchored points l (K, 7) seen from T, sigma_rho (K,) the sigmas of rho.

    4 (sigma_depth / distance) |cos alpha|, alpha between the rays from the anchor and from T: a point may become
    Euclidean where it is below 0.1.  Civera, Davison and Montiel 2008; [TB] `ahmLinearTest`.
    """
    index = np.empty(len(l))
    for i in range(len(l)):
        m, rho = l[i, 3:6], l[i, 6]
        h = l[i, :3] + m / rho - T[:3]
        h2 = h[0] * h[0] + h[1] * h[1] + h[2] * h[2]
        length = math.sqrt(m[0] * m[0] + m[1] * m[1] + m[2] * m[2])
        sigma_depth = length * sigma_rho[i] / (rho * rho)
        cos = abs(m[0] * h[0] + m[1] * h[1] + m[2] * h[2]) / (length * math.sqrt(h2))
        index[i] = 4 * sigma_depth / math.sqrt(h2) * cos
    return index


@compiled
def inverse_depth_linearity(T: Array, l: Array, sigma_rho: Array) -> Array:
    """Return the linearity indices (K,) of inverse-depth points l (K, 6), as `anchored_linearity` does."""
    return anchored_linearity(T, inverse_depth_to_anchored(l)[0], sigma_rho)


@compiled
def anchored_as_point(T: Array, l: Array) -> tuple[Array, Array, Array]:
    """Return the points v (K, 3) of anchored points l (K, 7) in the frame T, V_T (K, 3, 6) and V_l (K, 3, 7)."""
    return through_point(T, *anchored_to_point(l))


@compiled
def inverse_depth_as_point(T: Array, l: Array) -> tuple[Array, Array, Array]:
    """Return the points v (K, 3) of inverse-depth points l (K, 6) in the frame T, V_T (K, 3, 6) and V_l (K, 3, 6)."""
    return through_point(T, *inverse_depth_to_point(l))


@compiled
def homogeneous_as_point(T: Array, l: Array) -> tuple[Array, Array, Array]:
    """Return the points v (K, 3) of homogeneous points l (K, 4) in the frame T, V_T (K, 3, 6) and V_l (K, 3, 4)."""
    return through_point(T, *homogeneous_to_point(l))


@compiled
def through_point(T: Array, p: Array, P_l: Array) -> tuple[Array, Array, Array]:
    """Return points p (K, 3) in the frame T, v (K, 3), V_T (K, 3, 6) and V_l (K, 3, n), by their P_l (K, 3, n)."""
    v, V_T, V_p = to_frame_many(T, p)
    return v, V_T, multiply_many(V_p, P_l)
