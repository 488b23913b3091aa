"""Square tags, landmarks of six degrees of freedom: l = (x, y, z, qx, qy, qz, qw), the tag's frame in the map.

The tag lies in the plane z = 0 of its frame, with its corners at (-s, -s), (s, -s), (s, s), (-s, s), s half its size.
A sensor observes v, the tag's frame in its own; errors of l are those of frames in the map, errors of v
(position, rotation vector) are in the sensor's frame.  A camera measures the four corners, y = (u1, v1, ..., u4, v4).
"""

from __future__ import annotations

import math

import numpy as np

from kalmark.arrays import Array
from kalmark.compiled import compiled
from kalmark.geometry.frames3d import compose, minus, plus, turned_rates
from kalmark.geometry.rotations import conjugate, from_matrix, left_jacobian_inverse, matrix, multiply, skew
from kalmark.models.cameras import project

ITERATIONS = 50
SAME = 1e-4  # distance (tag sizes) and angle (rad) below which two solutions are one


@compiled
def corners(size: float) -> Array:
    """Return the corners (4, 3) of a tag in its frame."""
    s = 0.5 * size
    return np.array([[-s, -s, 0.0], [s, -s, 0.0], [s, s, 0.0], [-s, s, 0.0]])


@compiled
def tag_seen_from(T: Array, l: Array) -> tuple[Array, Array, Array]:
    """Express tags l (K, 7) in the frame T (7,): v (K, 7), V_T (K, 6, 6), V_l (K, 6, 6)."""
    Q = matrix(T[3:]).T.copy()
    k = len(l)
    v, V_T, V_l = np.empty((k, 7)), np.zeros((k, 6, 6)), np.zeros((k, 6, 6))
    for i in range(k):
        d = l[i, :3] - T[:3]
        v[i, :3] = Q @ d
        v[i, 3:] = multiply(conjugate(T[3:]), l[i, 3:])
        V_T[i, :3, :3] = -Q
        V_T[i, :3, 3:] = turned_rates(Q, d)
        V_T[i, 3:, 3:] = -Q
        V_l[i, :3, :3] = Q
        V_l[i, 3:, 3:] = Q
    return v, V_T, V_l


@compiled
def tag_from_view(T: Array, v: Array) -> tuple[Array, Array, Array]:
    """Return the tags l (K, 7) that are at v (K, 7) in the frame T (7,), L_T (K, 6, 6), L_v (K, 6, 6)."""
    k = len(v)
    l, L_T, L_v = np.empty((k, 7)), np.empty((k, 6, 6)), np.empty((k, 6, 6))
    for i in range(k):
        l[i], L_T[i], L_v[i] = compose(T, v[i])
    return l, L_T, L_v


@compiled
def project_corners(lens: int, v: Array, size: Array, par: Array) -> tuple[Array, Array]:
    """Return the pixels e (K, 8) of the corners of tags at v (K, 7), of sizes (K,) in m, and E_v (K, 8, 6)."""
    k = len(v)
    p, arm = np.empty((4 * k, 3)), np.empty((4 * k, 3))
    for i in range(k):
        arm[4 * i : 4 * i + 4] = corners(size[i]) @ matrix(v[i, 3:]).T.copy()
        p[4 * i : 4 * i + 4] = v[i, :3] + arm[4 * i : 4 * i + 4]
    pixels, E_p = project(lens, p, par)
    e, E_v = np.empty((k, 8)), np.empty((k, 8, 6))
    for i in range(k):
        for c in range(4):
            j, rows = 4 * i + c, slice(2 * c, 2 * c + 2)
            e[i, rows] = pixels[j]
            E_v[i, rows, :3] = E_p[j]
            E_v[i, rows, 3:] = -(E_p[j] @ skew(arm[j]))
    return e, E_v


@compiled
def pose_residual(y: Array, v: Array) -> tuple[Array, Array]:
    """Return the innovations z (K, 6) = y - v of measured poses y (K, 7), and E_v (K, 6, 6) = -dz/dv."""
    z, E_v = np.empty((len(v), 6)), np.zeros((len(v), 6, 6))
    for i in range(len(v)):
        z[i] = minus(y[i], v[i])
        E_v[i, :3, :3] = np.eye(3)
        E_v[i, 3:, 3:] = left_jacobian_inverse(-z[i, 3:])  # Log(Q Exp(-d)): the right Jacobian
    return z, E_v


@np.errstate(all="ignore")  # corners of no tag are infinite numbers on the way to NaN
def tags_from_corners(lens: int, y: Array, rays: Array, size: Array, par: Array) -> tuple[Array, Array, Array]:
    """Find the two tags whose corners fit y (K, 8): v (K, 2, 7), V_y (K, 2, 6, 8), sums of squares (K, 2) px^2.

    `rays` (K, 4, 3) are the corners' viewing rays.  From afar the corners are nearly the same when the tag is mirrored
    along the line of sight, so that the sum of squared pixels has two minima: both are sought, by Levenberg's method
    from the homography of the corners and from its mirror image, and the lower one comes first.  Where noise has left
    but one, the second is its mirror image, without V_y.  All is NaN where the four pixels are no convex quadrangle of
    rays ahead.  V_y = (E'E)^-1 E' of Gauss-Newton, so that V_y N V_y' is the covariance for noise N of the pixels.
    """
    k = len(y)
    v, V_y, cost = np.full((k, 2, 7), np.nan), np.full((k, 2, 6, 8), np.nan), np.full((k, 2), np.nan)
    for i in range(k):
        first, second = from_homography(rays[i], size[i])
        a, E_a, cost_a = refine_tag_pose(lens, y[i], size[i], first, par)
        b, E_b, cost_b = refine_tag_pose(lens, y[i], size[i], second, par)
        if cost_b < cost_a or math.isnan(cost_a):
            a, b, E_a, E_b, cost_a, cost_b = b, a, E_b, E_a, cost_b, cost_a
        if math.isnan(cost_a):
            continue
        v[i, 0], V_y[i, 0], cost[i, 0] = a, np.linalg.solve(E_a.T @ E_a, E_a.T), cost_a
        apart = minus(a, b)
        same = np.abs(apart[:3]).max() < SAME * size[i] and np.abs(apart[3:]).max() < SAME
        if same or math.isnan(cost_b):
            b = mirror_pose(a)
            e = project_corners(lens, b.reshape((1, 7)), np.array([size[i]]), par)[0]
            cost_b = np.sum((y[i] - e[0]) ** 2)
            v[i, 1], cost[i, 1] = b, cost_b if math.isfinite(cost_b) else np.inf
        else:
            v[i, 1], V_y[i, 1], cost[i, 1] = b, np.linalg.solve(E_b.T @ E_b, E_b.T), cost_b
    return v, V_y, cost


def refine_tag_pose(lens: int, y: Array, size: float, start: Array, par: Array) -> tuple[Array, Array, float]:
    """Minimise |y - e(v)|^2 from a start (7,) by Levenberg's method: v (7,), E_v (8, 6), the least sum; or NaN."""
    v, sizes, damping = start.copy().reshape((1, 7)), np.array([size]), 1e-3
    e, E_v = project_corners(lens, v, sizes, par)
    cost = np.sum((y - e[0]) ** 2)
    for _ in range(ITERATIONS if math.isfinite(cost) else 0):
        E = E_v[0]
        A = E.T @ E
        for j in range(6):
            A[j, j] *= 1.0 + damping
        step = np.linalg.solve(A, E.T @ (y - e[0]))
        new = plus(v[0], step).reshape((1, 7))
        e_new, E_new = project_corners(lens, new, sizes, par)
        cost_new = np.sum((y - e_new[0]) ** 2)
        change = max(np.abs(step[:3]).max() / np.abs(v[0, :3]).max(), np.abs(step[3:]).max())
        lower = cost_new < cost
        if lower:
            v, e, E_v, cost, damping = new, e_new, E_new, cost_new, 0.1 * damping
        else:
            damping = max(10.0 * damping, 1e-9)
        if change < (1e-13 if lower else 1e-7) or damping > 1e9:  # below 1e-7 the cost has no digits left
            break
    return v[0], E_v[0], cost if math.isfinite(cost) else np.nan


def from_homography(m: Array, size: float) -> tuple[Array, Array]:
    """Return both poses (7,) of a tag whose corners are on the rays m (4, 3): the homography's, and its mirror image.

    NaN unless the rays are a convex quadrangle, less than 87 degrees from their mean.
    """
    nothing = np.full(7, np.nan)
    W = _looking_along(m)
    x = np.empty((4, 2))
    for i in range(4):
        r = W @ m[i]
        if not r[2] > 0.05:
            return nothing, nothing
        x[i] = r[:2] / r[2]
    if not _is_convex(x):
        return nothing, nothing
    A, b, at = np.zeros((8, 8)), x.reshape(8), corners(2.0)
    for i in range(4):
        for a in range(2):
            row = 2 * i + a
            A[row, 3 * a], A[row, 3 * a + 1], A[row, 3 * a + 2] = at[i, 0], at[i, 1], 1.0
            A[row, 6], A[row, 7] = -x[i, a] * at[i, 0], -x[i, a] * at[i, 1]
    h = np.linalg.solve(A, b)
    H = W.T.copy() @ np.array([[h[0], h[1], h[2]], [h[3], h[4], h[5]], [h[6], h[7], 1.0]])
    a0, a1 = math.sqrt(np.sum(H[:, 0] ** 2)), math.sqrt(np.sum(H[:, 1] ** 2))
    p, q = H[:, 0] / a0 + H[:, 1] / a1, H[:, 0] / a0 - H[:, 1] / a1  # at right angles, whatever H is
    p, q = p / math.sqrt(2 * np.sum(p * p)), q / math.sqrt(2 * np.sum(q * q))
    Q = np.empty((3, 3))
    Q[:, 0], Q[:, 1] = p + q, p - q
    Q[:, 2] = np.cross(p + q, p - q)
    first = np.empty(7)
    first[:3], first[3:] = H[:, 2] * size / (a0 + a1), from_matrix(Q)
    return first, mirror_pose(first)


def mirror_pose(v: Array) -> Array:
    """Return a tag's pose (7,) mirrored in the plane through its centre across the line of sight, and in its own."""
    sight = v[:3] / math.sqrt(np.sum(v[:3] ** 2))
    mirror = np.eye(3) - 2.0 * sight.reshape((3, 1)) * sight
    out = v.copy()
    out[3:] = from_matrix(mirror @ matrix(v[3:]) @ np.diag(np.array([1.0, 1.0, -1.0])))
    return out


def _looking_along(m: Array) -> Array:
    """Return a rotation matrix whose third row is the mean of rays m (4, 3)."""
    z = m[0] + m[1] + m[2] + m[3]
    z = z / math.sqrt(np.sum(z * z))
    i = np.argmin(np.abs(z))
    x = -z[i] * z
    x[i] += 1.0
    x = x / math.sqrt(np.sum(x * x))
    W = np.empty((3, 3))
    W[0], W[1], W[2] = x, skew(z) @ x, z
    return W


def _is_convex(x: Array) -> bool:
    """Return whether x (4, 2), in this order, go round a convex quadrangle."""
    side = np.roll(x, -1, axis=0) - x
    after = np.roll(side, -1, axis=0)
    turn = side[:, 0] * after[:, 1] - side[:, 1] * after[:, 0]
    least = 1e-9 * np.linalg.norm(side, axis=1) * np.linalg.norm(after, axis=1)
    return bool(np.all(turn > least) or np.all(turn < -least))
