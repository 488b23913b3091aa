"""The pose that observed places and landmarks in pairs determine in closed form, l = T v: Umeyama 1991."""

from __future__ import annotations

import math

import numpy as np

from kalmark.arrays import Array
from kalmark.geometry.angles import wrap
from kalmark.geometry.frames import from_frame

SAME_M, SAME_RAD = 0.5, 0.1  # two matchings so near to each other are of one pose


def align_points(v: Array, l: Array, weights: Array) -> Array:
    """Return the pose T (3,) with the least weighted squares of l - T v; v and l are (K, 2)."""
    w = weights / weights.sum()
    a, b = w @ v, w @ l
    p, q = v - a, l - b
    theta = math.atan2(float(w @ (p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0])), float(w @ np.sum(p * q, axis=1)))
    x, y = b - from_frame(np.array([0.0, 0.0, theta]), a)[0]
    return np.array([x, y, theta])


def is_same_pose(one: Array, other: Array) -> bool:
    """Return whether two poses (3,) are so near to each other that they are one."""
    return math.dist(one[:2], other[:2]) <= SAME_M and abs(wrap(one[2] - other[2])) <= SAME_RAD
