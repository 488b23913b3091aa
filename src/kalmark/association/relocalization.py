"""The pose that observed places and landmarks in pairs determine in closed form, l = T v: Umeyama 1991."""

from __future__ import annotations

import math

import numpy as np

from kalmark.arrays import Array
from kalmark.geometry.angles import wrap
from kalmark.geometry.frames3d import minus
from kalmark.geometry.rotations import from_matrix

SAME_M, SAME_RAD = 0.5, 0.1  # two matchings so near to each other are of one pose


def align_points(v: Array, l: Array, weights: Array) -> Array:
    """Return the pose T, (3,) or (7,), with the least weighted squares of l - T v; v and l are (K, 2) or (K, 3)."""
    w = weights / weights.sum()
    a, b = w @ v, w @ l
    U, _, Vt = np.linalg.svd((v - a).T * w @ (l - b))
    proper = np.append(np.ones(len(a) - 1), np.sign(np.linalg.det(U @ Vt)))
    Q = Vt.T * proper @ U.T
    turn = [math.atan2(Q[1, 0], Q[0, 0])] if len(a) == 2 else from_matrix(Q)
    return np.concatenate([b - Q @ a, turn])


def is_same_pose(one: Array, other: Array) -> bool:
    """Return whether two poses, (3,) or (7,), are so near to each other that they are one."""
    turn = wrap(one[2] - other[2]) if len(one) == 3 else np.linalg.norm(minus(one, other)[3:])
    d = 2 if len(one) == 3 else 3
    return math.dist(one[:d], other[:d]) <= SAME_M and abs(float(turn)) <= SAME_RAD
