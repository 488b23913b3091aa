"""The pose that observed points or directions and landmarks in pairs determine in closed form.

Points, l = T v: Umeyama 1991.  Directions: in the plane by least squares, a quartic in exp(i theta); in space by three
of them, Grunert 1841.
"""

from __future__ import annotations

import math

import numpy as np

from kalmark.arrays import Array
from kalmark.geometry.rotations import from_matrix
from kalmark.geometry.spaces import SE2, SE3

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


def resect(v: Array, l: Array, o: Array) -> list[Array]:
    """Return poses T, (3,) or (7,), from which landmarks l (K, d) are in the directions v (K, d); K is at least 3.

    Up to four: in the plane seen from the places o (K, 2) in the frame of T, in space by three directions that are far
    apart, as if from its origin.
    """
    return _resect_in_plane(v, l, o) if v.shape[1] == 2 else _resect_by_three(v, l)


def _resect_in_plane(v: Array, l: Array, o: Array) -> list[Array]:
    """Return the poses (3,) of the extreme sums of squares, if all landmarks are ahead there.

    Across a ray, n'(Q l + u - o) = 0 is linear in u = -Q t and in c and s, Q = [[c, s], [-s, c]].  The least u leaves a
    quadratic form of x = (c, s), x'G x + 2 g'x, which is extreme where a quartic in exp(i theta) is 0.
    """
    middle, n = l.mean(axis=0), np.stack([-v[:, 1], v[:, 0]], axis=1)
    p, u_of = l - middle, np.linalg.inv(n.T @ n) @ n.T
    A = np.column_stack([np.sum(n * p, axis=1), n[:, 0] * p[:, 1] - n[:, 1] * p[:, 0], -np.sum(n * o, axis=1)])
    left = A - n @ (u_of @ A)
    G, g = left[:, :2].T @ left[:, :2], left[:, :2].T @ left[:, 2]
    even, odd = complex(G[0, 1], 0.5 * (G[0, 0] - G[1, 1])), complex(g[1], g[0])
    poses = list[Array]()
    for theta in np.angle(np.roots([even, odd, 0.0, odd.conjugate(), even.conjugate()])):
        c, s = math.cos(theta), math.sin(theta)
        Q, u = np.array([[c, s], [-s, c]]), -u_of @ (A @ [c, s, 1.0])
        if (np.sum((p @ Q.T + u - o) * v, axis=1) > 0.0).all():
            poses.append(np.append(middle - Q.T @ u, theta))
    return poses


def _resect_by_three(v: Array, l: Array) -> list[Array]:
    """Return the poses (7,) by three directions: the law of cosines, a quartic in w.  Grunert 1841.

    The distances of the three are s (1, u, w), a, b and c those between them, opposite to each.  Of complex roots,
    which noise makes of a double one, it is the real part.
    """
    v = v / np.linalg.norm(v, axis=1, keepdims=True)
    first = int(np.argmin(v @ v.mean(axis=0)))
    second = int(np.argmin(v @ v[first]))
    three = [first, second, int(np.argmax(np.abs(v @ np.cross(v[first], v[second]))))]
    j, p, poses = v[three], l[three], list[Array]()
    cos_a, cos_b, cos_c = j[1] @ j[2], j[0] @ j[2], j[0] @ j[1]
    b2 = max(float(np.sum((p[0] - p[2]) ** 2)), 1e-300)
    a2, c2 = np.sum((p[1] - p[2]) ** 2) / b2, np.sum((p[0] - p[1]) ** 2) / b2
    B = np.poly1d([1.0, -2.0 * cos_b, 1.0])  # b^2 = s^2 B(w); a^2 - c^2 gives u = N(w) / D(w)
    N, D = B * (a2 - c2) - np.poly1d([1.0, 0.0, -1.0]), np.poly1d([-2.0 * cos_a, 2.0 * cos_c])
    quartic = N * N - N * D * (2.0 * cos_c) + D * D * (1.0 - B * c2)  # c^2 = s^2 (1 + u^2 - 2 u cos c)
    with np.errstate(divide="ignore", invalid="ignore"):
        for w in quartic.roots.real:
            s = np.sqrt(b2 / B(w)) * np.array([1.0, N(w) / D(w), w])
            if np.isfinite(s).all() and (s > 0.0).all():
                poses.append(align_points(s[:, None] * j, p, np.ones(3)))
    return poses


def is_same_pose(one: Array, other: Array) -> bool:
    """Return whether two poses, (3,) or (7,), are so near to each other that they are one."""
    space = SE2 if len(one) == 3 else SE3
    off, d = space.minus(one, other), space.d
    return bool(np.linalg.norm(off[:d]) <= SAME_M and np.linalg.norm(off[d:]) <= SAME_RAD)
