"""Angles, rotations of the plane and the exponential's V, in the one place where angles are wrapped."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from kalmark.arrays import Array
from kalmark.compiled import compiled


@compiled
def wrap(a: Any) -> Any:
    """Return the angle (rad; a number or an array) brought into (-pi, pi].

    >>> km.geometry.wrap(4.0)
    -2.2831853071795862
    """
    return a - 2 * np.pi * np.ceil((a - np.pi) / (2 * np.pi))


@compiled
def rotation(a: float) -> Array:
    """Return the rotation matrix (2, 2) of an angle.  [S] (54).

    >>> km.geometry.rotation(np.pi / 2).round(3)
    array([[ 0., -1.],
           [ 1.,  0.]])
    """
    c, s = math.cos(a), math.sin(a)
    return np.array([[c, -s], [s, c]])


@compiled
def exponential_v(a: float) -> tuple[float, float]:
    """Return (p, q) of V(a) = [[p, -q], [q, p]] = [[sin a, -(1-cos a)], [1-cos a, sin a]] / a."""
    if a == 0.0:
        return 1.0, 0.0
    half = math.sin(0.5 * a)
    return math.sin(a) / a, 2.0 * half * half / a


@compiled
def exponential_v_rate(a: float) -> tuple[float, float]:
    """Return the derivatives (p', q') of `exponential_v`."""
    if abs(a) < 0.05:
        a2 = a * a
        return a * (-1 / 3 + a2 * (1 / 30 - a2 / 840)), 0.5 - a2 * (1 / 8 - a2 * (1 / 144 - a2 / 5760))
    half = math.sin(0.5 * a)
    return (a * math.cos(a) - math.sin(a)) / (a * a), (a * math.sin(a) - 2.0 * half * half) / (a * a)


def V(a: float) -> Array:
    """Return V(a) (2, 2), which carries a twist's translation along a turn by `a` rad.

    >>> km.geometry.V(0.2).round(3)
    array([[ 0.993, -0.1  ],
           [ 0.1  ,  0.993]])
    """
    p, q = exponential_v(a)
    return np.array([[p, -q], [q, p]])


def V_inverse(a: float) -> Array:
    """Return the inverse of V(a), shape (2, 2).

    >>> (km.geometry.V_inverse(0.2) @ km.geometry.V(0.2)).round(3)
    array([[ 1., -0.],
           [ 0.,  1.]])
    """
    p, q = exponential_v(a)
    return np.array([[p, q], [-q, p]]) / (p * p + q * q)
