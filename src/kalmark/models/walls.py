"""Walls: lines of the plane with an extent, how they look from a pose, and what a laser measures of them.

The line is {p : n . (p - a) = 0}, n = (cos alpha, sin alpha), with the state l = (a, alpha): an anchor a (2) on it and
the direction alpha of its normal.  A translation of the world moves the anchor and nothing else, as it moves a
point, and a rotation turns the anchor and alpha.  So the atoms of points and headings serve; with the distance rho of
the line from the origin, rho = n . a, a translation t would add n . t, which depends on the estimate (docs/walls.md).
The anchor is in the middle of the first observed segment.

A point of the line is given by its abscissa t, p = a + t tau, tau = (-sin alpha, cos alpha).  A sensor observes
v: the distance of the line along n, negative if n points to the sensor, and the direction of n in the sensor's frame.
(v1, v2) and (-v1, v2 + pi) are the same line.
"""

from __future__ import annotations

import math

import numpy as np

from kalmark.arrays import Array, Flags
from kalmark.compiled import compiled
from kalmark.geometry.angles import wrap


@compiled
def wall_seen_from(T: Array, l: Array) -> tuple[Array, Array, Array]:
    """Return the views v (K, 2) of walls l (K, 3) from T (3,): distance and normal; V_T and V_l (K, 2, 3)."""
    k = len(l)
    v, V_T, V_l = np.empty((k, 2)), np.zeros((k, 2, 3)), np.zeros((k, 2, 3))
    for i in range(k):
        c, s = math.cos(l[i, 2]), math.sin(l[i, 2])
        x, y = l[i, 0] - T[0], l[i, 1] - T[1]
        v[i, 0], v[i, 1] = c * x + s * y, wrap(l[i, 2] - T[2])
        V_T[i, 0, 0], V_T[i, 0, 1], V_T[i, 1, 2] = -c, -s, -1.0
        V_l[i, 0, 0], V_l[i, 0, 1], V_l[i, 0, 2], V_l[i, 1, 2] = c, s, c * y - s * x, 1.0
    return v, V_T, V_l


@compiled
def wall_from_view(T: Array, v: Array) -> tuple[Array, Array, Array]:
    """Return the walls l (K, 3) that look like v (K, 4) from T (3,), L_T (K, 3, 3) and L_v (K, 3, 4).

    v has the distance, the direction of the normal and the abscissas of both ends of the segment, from the foot of the
    perpendicular on.
    """
    k = len(v)
    l, L_T, L_v = np.empty((k, 3)), np.zeros((k, 3, 3)), np.zeros((k, 3, 4))
    for i in range(k):
        rho, t = v[i, 0], 0.5 * (v[i, 2] + v[i, 3])
        c, s = math.cos(T[2] + v[i, 1]), math.sin(T[2] + v[i, 1])
        x, y = rho * c - t * s, rho * s + t * c
        l[i, 0], l[i, 1], l[i, 2] = T[0] + x, T[1] + y, wrap(T[2] + v[i, 1])
        L_T[i, 0, 0] = L_T[i, 1, 1] = L_T[i, 2, 2] = L_v[i, 2, 1] = 1.0
        L_T[i, 0, 2] = L_v[i, 0, 1] = -y
        L_T[i, 1, 2] = L_v[i, 1, 1] = x
        L_v[i, 0, 0], L_v[i, 1, 0] = c, s
        L_v[i, 0, 2] = L_v[i, 0, 3] = -0.5 * s
        L_v[i, 1, 2] = L_v[i, 1, 3] = 0.5 * c
    return l, L_T, L_v


@compiled
def wall(code: int, par: Array, angular: Flags, v: Array, y: Array) -> tuple[Array, Array, Array]:
    """Return e (K, 4), z (K, 2), E_v (K, 2, 2) of walls v (K, 2): distance, normal; y (K, 4) has the ends, too.

    Of the two descriptions of a line the one is expected whose normal is nearer to the measured one: so a line through
    the sensor is measured on either side of it, and the innovation passes through rho = 0.
    """
    k = len(v)
    e, z, E_v = y.copy(), np.empty((k, 2)), np.zeros((k, 2, 2))
    for i in range(k):
        sign = 1.0 if math.cos(y[i, 1] - v[i, 1]) >= 0.0 else -1.0
        e[i, 0], e[i, 1] = sign * v[i, 0], v[i, 1] if sign > 0.0 else wrap(v[i, 1] + math.pi)
        z[i, 0], z[i, 1] = y[i, 0] - e[i, 0], wrap(y[i, 1] - e[i, 1])
        E_v[i, 0, 0], E_v[i, 1, 1] = sign, 1.0
    return e, z, E_v


def orient_segments(y: Array) -> Array:
    """Return segments y (K, 4) with distances of at least 0: the same lines, with the opposite normals."""
    other = np.column_stack([-y[:, 0], wrap(y[:, 1] + math.pi), -y[:, 3], -y[:, 2]])
    return np.asarray(np.where(y[:, :1] < 0.0, other, y))


def axes(alpha: Array) -> tuple[Array, Array]:
    """Return the normals n and the directions tau (K, 2) of walls whose normals have the directions alpha (K,)."""
    c, s = np.cos(alpha), np.sin(alpha)
    return np.stack([c, s], axis=-1), np.stack([-s, c], axis=-1)


def wall_endpoints(l: Array, t: Array) -> tuple[Array, Array]:
    """Return the points (K, 2, 2) of walls l (K, 3) at the abscissas t (K, 2), and P_l (K, 2, 2, 3)."""
    n, tau = axes(l[:, 2])
    p = l[:, None, :2] + t[:, :, None] * tau[:, None]
    P_l = np.zeros((*p.shape, 3))
    P_l[..., 0, 0] = P_l[..., 1, 1] = 1.0
    P_l[..., 2] = -t[:, :, None] * n[:, None]
    return p, P_l


def wall_abscissas(T: Array, l: Array, v: Array) -> Array:
    """Return the abscissas (K, 2), in order, on walls l (K, 3) of the ends of segments v (K, 4) seen from T (3,)."""
    n, tau = axes(T[2] + v[:, 1])
    p = T[:2] + v[:, :1, None] * n[:, None] + v[:, 2:, None] * tau[:, None]
    t: Array = np.einsum("kej,kj->ke", p - l[:, None, :2], axes(l[:, 2])[1])
    return np.sort(t, axis=1)


def wall_difference(a: Array, b: Array, t: float) -> tuple[Array, Array, Array]:
    """Return how the line of wall b differs from that of a, both (3,): z (2,), Z_a and Z_b (2, 3).

    z is the angle between them, at most a right one, and the distance of b from the point of a at the abscissa t.
    That is the same after any motion of the world.
    """
    sign = 1.0 if math.cos(b[2] - a[2]) >= 0.0 else -1.0
    (n_a, n_b), (_, tau_b) = axes(np.array([a[2], b[2]]))
    m = a[:2] + t * axes(a[2])[1]
    z = np.array([wrap(b[2] - a[2] + (0.0 if sign > 0.0 else math.pi)), sign * (n_b @ (b[:2] - m))])
    Z_a, Z_b = np.zeros((2, 3)), np.zeros((2, 3))
    Z_a[0, 2], Z_b[0, 2] = -1.0, 1.0
    Z_a[1] = sign * np.array([-n_b[0], -n_b[1], t * (n_b @ n_a)])
    Z_b[1] = sign * np.array([*n_b, tau_b @ (b[:2] - m)])
    return z, Z_a, Z_b


def visible_wall(
    T: Array, p1: Array, p2: Array, limits: tuple[float, float, float], shortest: float
) -> tuple[Flags, Array]:
    """Return which segments from p1 to p2 (K, 2) are seen from T (3,), and distance, normal, right and left end (K, 4).

    `limits` are the least and the greatest range and half the field of view; what is within is `shortest` at least.
    Nothing hides anything here.
    """
    c, s = math.cos(T[2]), math.sin(T[2])
    R = np.array([[c, -s], [s, c]])
    a, b = (p1 - T[:2]) @ R, (p2 - T[:2]) @ R
    tau = b - a
    length = np.maximum(np.linalg.norm(tau, axis=1), 1e-12)
    tau = tau / length[:, None]
    n = np.column_stack([tau[:, 1], -tau[:, 0]])
    rho = np.einsum("kj,kj->k", n, a)
    side = np.where(rho >= 0.0, 1.0, -1.0)
    rho, n, tau = side * rho, side[:, None] * n, side[:, None] * tau
    t = np.sort(np.stack([np.einsum("kj,kj->k", tau, p) for p in (a, b)], axis=1), axis=1)
    near, far, half = limits
    reach = np.sqrt(np.maximum(far**2 - rho**2, 0.0))
    normal = np.arctan2(n[:, 1], n[:, 0])
    best, width = np.zeros_like(t), np.full(len(t), -np.inf)
    for turn in (0.0, 2 * math.pi, -2 * math.pi):  # the bearing of the abscissa t is normal + atan(t / rho)
        bounds = np.array([-half, half])[:, None] if half < math.pi else np.array([[-np.inf], [np.inf]])
        edges = np.clip(bounds + turn - normal, -math.pi / 2, math.pi / 2)
        with np.errstate(over="ignore", invalid="ignore"):
            right, left = (np.nan_to_num(rho * np.tan(edge), nan=0.0) for edge in edges)
        first, last = np.maximum.reduce([t[:, 0], right, -reach]), np.minimum.reduce([t[:, 1], left, reach])
        wider = last - first > width
        best[wider], width[wider] = np.column_stack([first, last])[wider], (last - first)[wider]
    seen: Flags = (width >= shortest) & (rho <= far) & (np.hypot(rho, best.max(axis=1)) >= near)
    return seen, np.column_stack([rho, normal, best])
