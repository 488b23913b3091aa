"""Directions of space: unit vectors, azimuth and elevation, and with a range the spherical coordinates of points.

Azimuth is measured from x towards y, elevation from the xy plane towards z.  Everything for K rows at once.  On the z
axis an azimuth is undefined: it is returned as atan2(0, 0) = 0, and the Jacobians of azimuths grow without bound there.
"""

from __future__ import annotations

import math

import numpy as np

from kalmark.arrays import Array
from kalmark.compiled import compiled

__all__ = ["direction_many", "inv_spherical_many", "spherical_many", "unit_many"]


@compiled
def unit_many(v: Array) -> tuple[Array, Array]:
    """Return the unit vectors m along v (K, 3), and M_v (K, 3, 3) = (I - m m') / |v|.

    >>> km.geometry.directions.unit_many(np.array([[3.0, 0.0, 4.0]]))[0].round(3)
    array([[0.6, 0. , 0.8]])
    """
    k = len(v)
    m, M_v = np.empty((k, 3)), np.empty((k, 3, 3))
    for i in range(k):
        length = math.sqrt(v[i, 0] * v[i, 0] + v[i, 1] * v[i, 1] + v[i, 2] * v[i, 2])
        for a in range(3):
            m[i, a] = v[i, a] / length
        for a in range(3):
            for b in range(3):
                M_v[i, a, b] = ((1.0 if a == b else 0.0) - m[i, a] * m[i, b]) / length
    return m, M_v


@compiled
def direction_many(a: Array) -> tuple[Array, Array]:
    """Return the unit vectors m (K, 3) of azimuths and elevations a (K, 2), rad, and M_a (K, 3, 2).

    >>> km.geometry.directions.direction_many(np.array([[np.pi / 2, 0.0]]))[0].round(3)
    array([[0., 1., 0.]])
    """
    k = len(a)
    m, M_a = np.empty((k, 3)), np.zeros((k, 3, 2))
    for i in range(k):
        ca, sa, ce, se = math.cos(a[i, 0]), math.sin(a[i, 0]), math.cos(a[i, 1]), math.sin(a[i, 1])
        m[i, 0], m[i, 1], m[i, 2] = ce * ca, ce * sa, se
        M_a[i, 0, 0], M_a[i, 1, 0] = -ce * sa, ce * ca
        M_a[i, 0, 1], M_a[i, 1, 1], M_a[i, 2, 1] = -se * ca, -se * sa, ce
    return m, M_a


@compiled
def spherical_many(p: Array) -> tuple[Array, Array]:
    """Measure range (m), azimuth, elevation (rad) of points p (K, 3): y (K, 3), Y_p (K, 3, 3).  [S] (61) in space.

    >>> km.geometry.directions.spherical_many(np.array([[3.0, 0.0, 4.0]]))[0].round(3)
    array([[5.   , 0.   , 0.927]])
    """
    k = len(p)
    y, Y_p = np.empty((k, 3)), np.empty((k, 3, 3))
    for i in range(k):
        px, py, pz = p[i, 0], p[i, 1], p[i, 2]
        flat2 = px * px + py * py
        flat, r2 = math.sqrt(flat2), flat2 + pz * pz
        r = math.sqrt(r2)
        y[i, 0], y[i, 1], y[i, 2] = r, math.atan2(py, px), math.atan2(pz, flat)
        Y_p[i, 0, 0], Y_p[i, 0, 1], Y_p[i, 0, 2] = px / r, py / r, pz / r
        Y_p[i, 1, 0], Y_p[i, 1, 1], Y_p[i, 1, 2] = -py / flat2, px / flat2, 0.0
        Y_p[i, 2, 0], Y_p[i, 2, 1], Y_p[i, 2, 2] = -pz * px / (flat * r2), -pz * py / (flat * r2), flat / r2
    return y, Y_p


@compiled
def inv_spherical_many(y: Array) -> tuple[Array, Array]:
    """Return the points p (K, 3) at ranges, azimuths and elevations y (K, 3), and P_y (K, 3, 3).  [S] (62) in space.

    >>> km.geometry.directions.inv_spherical_many(np.array([[5.0, 0.0, 0.0]]))[0].round(3)
    array([[5., 0., 0.]])
    """
    m, M_a = direction_many(y[:, 1:])
    p, P_y = np.empty_like(m), np.empty((len(y), 3, 3))
    for i in range(len(y)):
        for a in range(3):
            p[i, a] = y[i, 0] * m[i, a]
            P_y[i, a, 0] = m[i, a]
            P_y[i, a, 1], P_y[i, a, 2] = y[i, 0] * M_a[i, a, 0], y[i, 0] * M_a[i, a, 1]
    return p, P_y
