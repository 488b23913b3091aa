"""The pose that observed points or directions and landmarks in pairs determine in closed form.

Points, l = T v: Umeyama 1991.  Directions: Hartley and Zisserman, Multiple View Geometry 7.
"""

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


def resect(v: Array, l: Array) -> Array:
    """Return the pose T, (3,) or (7,), from which landmarks l (K, d) are in the directions v (K, d), in least squares.

    It is the direct linear transformation: v x (Q l + t) = 0 is linear in Q and t, of which the scale is free.  K is at
    least 3 in the plane, 6 in space.
    """
    d, middle = v.shape[1], l.mean(axis=0)
    p = (l - middle) / max(float(np.abs(l - middle).max()), 1e-300)
    if d == 2:  # Q = [[c, s], [-s, c]]
        across = np.stack([v[:, 1], -v[:, 0]], axis=1)
        A = np.column_stack([np.sum(across * p, axis=1), across[:, 0] * p[:, 1] - across[:, 1] * p[:, 0], across])
        c, s, *t = np.linalg.svd(A)[2][-1]
        M = np.array([[c, s], [-s, c]])
    else:
        across = np.linalg.svd(v[:, None, :])[2][:, 1:]
        A = np.concatenate([np.einsum("kad,ke->kade", across, p).reshape(len(v), 2, 9), across], axis=2)
        x = np.linalg.svd(A.reshape(-1, 12))[2][-1]
        M, t = x[:9].reshape(3, 3), x[9:]
    M, t = (a * np.sign(np.sum((p @ M.T + t) * v)) for a in (M, np.array(t)))  # in front of the sensor
    U, size, Vt = np.linalg.svd(M)
    Q = U @ np.diag(np.append(np.ones(d - 1), np.linalg.det(U @ Vt))) @ Vt
    t = t / max(float(size.mean()), 1e-300) * np.abs(l - middle).max()
    place = middle - Q.T @ t
    return np.append(place, math.atan2(Q.T[1, 0], Q.T[0, 0])) if d == 2 else np.concatenate([place, from_matrix(Q.T)])


def is_same_pose(one: Array, other: Array) -> bool:
    """Return whether two poses, (3,) or (7,), are so near to each other that they are one."""
    turn = wrap(one[2] - other[2]) if len(one) == 3 else np.linalg.norm(minus(one, other)[3:])
    d = 2 if len(one) == 3 else 3
    return math.dist(one[:d], other[:d]) <= SAME_M and abs(float(turn)) <= SAME_RAD
