"""The corrections: textbook, invariant and first-estimates, each one function from innovation to corrected map.

The same source runs twice: compiled for the built-in models, as plain Python for a user's (`linearize` is the only
place that differs).  A map is its mean x, covariance P with n rows in use, tables of `blocks` and `atoms`, and the axes
of its gauge.  A scan is the slots of its robot and of its sensor's mount (-1: not in the map), the slots of K landmarks
of which the first d numbers are seen, measurements y (K, m) with the noise R (K, p, p) of their innovations, and the
gate on d2.  The head of the observed block is the robot's pose and, if it is in the map, the mount.  Nothing is changed
unless all of it succeeds.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from numba.extending import register_jitable

from kalmark.compiled import compiled
from kalmark.filter.kernels import (
    Index,
    add_square,
    cholesky_inverse,
    columns,
    downdate,
    downdate_and_transport,
    submatrix,
    transport,
)
from kalmark.filter.parallax import anchored, carried, carry_back, retract_parallax, spread, transport_parallax
from kalmark.geometry.spaces import ERROR_SIZE, HEADING, Table, generator, retract
from kalmark.models.observe import linearize, sensor_at

Array = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]
Map = tuple[Array, Array, int, Table, Table, int]  # x, P, n, blocks, atoms, axes
Scan = tuple[int, int, Index, int, Array, Array, float]  # robot, mount, slots, d, y, R, gate


@compiled
def head_sizes(blocks: Table, atoms: Table, robot: int, mount: int) -> tuple[int, int]:
    """Return the numbers of a robot's pose, and those of the head: the pose and, if it is in the map, the mount.

    With the mount come the parameters that its sensor has in the map.
    """
    pose = 3 if atoms[blocks[robot, 4] + 1, 0] == HEADING else 7
    return pose, pose if mount < 0 else pose + blocks[mount, 1]


@compiled
def observed_block(
    x: Array, blocks: Table, atoms: Table, robot: int, mount: int, slots: Index, d: int
) -> tuple[Index, Table, Array]:
    """Return the rows in P, the atoms and the mean of the head and of the first d numbers of K landmarks."""
    pose, head = head_sizes(blocks, atoms, robot, mount)
    before = 1 if mount < 0 else 2  # blocks in the head
    size = head + d * len(slots)
    index, mean = np.empty(size, np.int64), np.empty(size)
    table = np.empty((size, 3), np.int64)
    count = x_to = p_to = 0
    for i in range(before + len(slots)):
        slot, width = (robot, pose) if i == 0 else ((mount, head - pose) if i < before else (slots[i - before], d))
        x_at, p_at, first = blocks[slot, 0], blocks[slot, 2], blocks[slot, 4]
        mean[x_to : x_to + width] = x[x_at : x_at + width]
        rows = 0
        for a in range(first, first + blocks[slot, 5]):
            if atoms[a, 1] - x_at < width:
                table[count, 0] = atoms[a, 0]
                table[count, 1], table[count, 2] = x_to + atoms[a, 1] - x_at, p_to + rows
                rows += ERROR_SIZE[atoms[a, 0]]
                count += 1
        for j in range(rows):
            index[p_to + j] = p_at + j
        x_to, p_to = x_to + width, p_to + rows
    return index[:p_to], table[:count], mean


@compiled
def gauge(mean: Array, correction: Array, pose: int, axes: int) -> Array:
    """Return the motion of the gauge (axes,), d_theta or (xi_p, d_theta), in a correction of the robot's pose.

    The observing robot's pose comes first in `mean` and in `correction`.
    """
    theta = (3 if pose == 3 else 6) - axes
    turn = correction[theta : theta + axes].copy()
    if axes == 6:
        turn[:3] += np.cross(mean[:3], turn[3:])  # xi_p = d_p - generator_p d_theta
    return turn


@compiled
def innovation(P: Array, index: Index, E_r: Array, E_l: Array, R: Array, z: Array) -> tuple[Array, Array, bool]:
    """Return each observation's innovation covariance Z (K, p, p) and d2 = z' Z^-1 z (K,).  [S] (27), (83).

    d2 is NaN where nothing can be expected (a landmark at the sensor).  The last answer is False if a Z is not positive
    definite: the filter is broken.
    """
    k, m, d = E_l.shape
    head = E_r.shape[2]
    Z, d2, healthy = np.empty((k, m, m)), np.empty(k), True
    rows, H = np.empty(head + d, np.int64), np.empty((m, head + d))
    rows[:head] = index[:head]
    for i in range(k):
        rows[head:] = index[head + i * d : head + (i + 1) * d]
        H[:, :head], H[:, head:] = E_r[i], E_l[i]
        S = submatrix(P, rows)
        for a in range(m):
            for b in range(a + 1):
                s = R[i, a, b]
                for c in range(head + d):
                    t = 0.0
                    for f in range(head + d):
                        t += S[c, f] * H[b, f]
                    s += H[a, c] * t
                Z[i, a, b] = Z[i, b, a] = s
        M, positive = cholesky_inverse(Z[i])
        d2[i] = np.nan
        if positive:
            w = 0.0
            for a in range(m):
                s = 0.0
                for b in range(a + 1):
                    s += M[a, b] * z[i, b]
                w += s * s
            d2[i] = w
        elif np.isfinite(Z[i]).all():
            healthy = False
    return Z, d2, healthy


@compiled
def stacked(E_r: Array, E_l: Array) -> Array:
    """Return the Jacobian H (K p, head + K d) of all observations of a scan with respect to the observed block."""
    k, m, d = E_l.shape
    head = E_r.shape[2]
    H = np.zeros((k * m, head + k * d))
    for i in range(k):
        H[i * m : (i + 1) * m, :head] = E_r[i]
        H[i * m : (i + 1) * m, head + i * d : head + (i + 1) * d] = E_l[i]
    return H


@compiled
def sparse_product(H: Array, S: Array, head: int, k: int) -> Array:
    """Return H S, H being zero but in the columns of the head and, for each of K observations, of its landmark."""
    q, n = len(H) // k, S.shape[1]
    d = (H.shape[1] - head) // k
    out = np.zeros((len(H), n))
    for r in range(len(H)):
        own = r // q * d
        for i in range(head + d):
            c = i if i < head else own + i
            h = H[r, c]
            for j in range(n):
                out[r, j] += h * S[c, j]
    return out


@compiled
def add_blocks(S: Array, R: Array) -> None:
    """S += blockdiag(R), R (K, p, p)."""
    k, m, _ = R.shape
    for i in range(k):
        S[i * m : (i + 1) * m, i * m : (i + 1) * m] += R[i]


@compiled
def settled(table: Table, change: Array, P: Array, tolerance: float) -> bool:
    """Return whether each atom of a mean changes by less than that many of its sigmas, however the world is turned."""
    for i in range(len(table)):
        size, variance = 0.0, 0.0
        for j in range(table[i, 2], table[i, 2] + ERROR_SIZE[table[i, 0]]):
            size += change[j] ** 2
            variance += P[j, j]
        if size > tolerance**2 * variance:
            return False
    return True


@register_jitable  # type: ignore[untyped-decorator]
def iterate(
    view: Any,
    sizes: tuple[int, int, int],
    table: Table,
    mean: Array,
    P_ss: Array,
    y: Array,
    R: Array,
    linear: tuple[Array, Array, Array],
    limits: tuple[int, float],
) -> tuple[Array, Array, Array, bool]:
    """Relinearise on the observed block only: return H, M = L^-1 of its Z, and the innovation to fuse.

    It begins with the innovations and Jacobians at the mean, z, E_r and E_l.

    `limits`: at most so many times, until nothing moves by more than that many of its sigmas.

    The prior covariance P_ss is in the error coordinates of the prior mean; the Jacobian H_j at the iterate x_j is in
    those of x_j, so H_j is transported: H~_j = H_j (I + (generator(x_j) - generator(x)) e_theta'), and likewise carried
    back where inverse distances are corrected by their parallax.
    """
    (pose, head, axes), (most, tolerance) = sizes, limits
    k, d = len(y), (len(mean) - head) // len(y)
    theta = (3 if pose == 3 else 6) - axes
    correction = np.zeros(len(P_ss))
    turned = generator(table, mean, len(P_ss), axes, mean[:3])
    depths = anchored(table if most > 1 else table[:0])  # a single step is worse off with it: docs/bearing_only.md
    s, S = s_j, S_j = sensor_at(view, mean[:head])
    h = S.shape[1]
    baselines = (depths, s, S, spread(P_ss, np.arange(h), mean, s, S, depths))
    x_j, (z, E_r, E_l) = mean, linear
    for j in range(most):
        if j > 0:
            _e, z, E_r, E_l = linearize(view, x_j[:head], x_j[head:].reshape(k, d), y)
        H = stacked(E_r, E_l)
        carry_back(H, h, depths, carried(mean, x_j, baselines, s_j, S_j))
        H[:, theta : theta + axes] += H @ (generator(table, x_j, len(P_ss), axes, mean[:3]) - turned)
        v = z.ravel() + H @ correction
        HP = sparse_product(H, P_ss, h, k)
        Z = sparse_product(H, HP.T.copy(), h, k)
        add_blocks(Z, R)
        M, positive = cholesky_inverse(Z)
        if not positive:
            break
        step = HP.T @ (M.T @ (M @ v))
        change = step - correction
        correction = step
        x_j = mean.copy()
        retract(table, x_j, correction, gauge(mean, correction, pose, axes))
        s_j, S_j = sensor_at(view, x_j[:head])
        retract_parallax(x_j, mean, baselines, correction, correction[:h], s_j)
        if settled(table, change, P_ss, tolerance):
            break
    return H, M, v, positive


@compiled
def gain(P: Array, n: int, index: Index, H: Array, M: Array, v: Array) -> tuple[Array, Array]:
    """Return W = P H' L^-T, M = L^-1, of which P loses W W', and the mean's correction K v (n,).  [S] (28)-(30)."""
    W = (columns(P, index, n) @ H.T) @ M.T
    return W, W @ (M @ v)


def invariant(
    view: Any, map_: Map, scan: Scan, limits: tuple[int, float]
) -> tuple[Array, Array, Array, Array, Flags, bool]:  # fmt: skip
    """Correct with one scan: gate, iterate, fuse, retract, transport; inverse distances by their parallax.

    docs/invariant.md, docs/bearing_only.md.

    Returns e, z, Z, d2 at the prediction, which were fused, and whether the filter can go on.
    """
    x, P, n, blocks, atoms, axes = map_
    robot, mount, slots, d, y, R, gate = scan
    index, table, mean = observed_block(x, blocks, atoms, robot, mount, slots, d)
    pose, head = head_sizes(blocks, atoms, robot, mount)
    e, z, E_r, E_l = linearize(view, mean[:head], mean[head:].reshape(len(slots), d), y)
    Z, d2, healthy = innovation(P, index, E_r, E_l, R, z)
    near = (d2 <= gate) & (d2 < np.inf)
    if not healthy or not near.any():
        return e, z, Z, d2, near, healthy
    linear = z, E_r, E_l
    if not near.all():
        y, R, linear = y[near], R[near], (z[near], E_r[near], E_l[near])
        index, table, mean = observed_block(x, blocks, atoms, robot, mount, slots[near], d)
    H, M, v, positive = iterate(view, (pose, head, axes), table, mean, submatrix(P, index), y, R, linear, limits)
    if not positive:
        return e, z, Z, d2, near, False
    before, x_before = generator(atoms, x, n, axes, mean[:3]), x.copy()
    depths = anchored(atoms if limits[0] > 1 else atoms[:0])
    s, S = sensor_at(view, mean[:head])
    rows = index[: S.shape[1]]
    baselines = (depths, s, S, spread(P, rows, x, s, S, depths))
    W, correction = gain(P, n, index, H, M, v)
    retract(atoms, x, correction, gauge(mean, correction[index], pose, axes))
    theta = index[(3 if pose == 3 else 6) - axes]
    downdate_and_transport(P, W, generator(atoms, x, n, axes, mean[:3]) - before, theta)
    if len(depths):
        s_now, S_now = sensor_at(view, observed_block(x, blocks, atoms, robot, mount, slots[:0], d)[2])
        retract_parallax(x, x_before, baselines, correction, correction[rows], s_now)
        transport_parallax(P, n, rows, depths, carried(x_before, x, baselines, s_now, S_now))
    return e, z, Z, d2, near, True


def fit(view: Any, map_: Map, scan: Scan, limits: tuple[int, float]) -> tuple[float, float]:
    """Return d2 = v' Z^-1 v of a scan as a whole, where it is linearised in the end, and log |Z|; inf if it is sick."""
    x, P, _n, blocks, atoms, axes = map_
    robot, mount, slots, d, y, R, _gate = scan
    index, table, mean = observed_block(x, blocks, atoms, robot, mount, slots, d)
    pose, head = head_sizes(blocks, atoms, robot, mount)
    _e, z, E_r, E_l = linearize(view, mean[:head], mean[head:].reshape(len(slots), d), y)
    linear = z, E_r, E_l
    _H, M, v, positive = iterate(view, (pose, head, axes), table, mean, submatrix(P, index), y, R, linear, limits)
    if not positive:
        return np.inf, np.inf
    w, log_det = M @ v, 0.0
    for i in range(len(M)):
        log_det -= 2.0 * np.log(M[i, i])
    return (w * w).sum(), log_det


def averaged(
    view: Any, map_: Map, scan: Scan, limits: tuple[int, float], pairs: Index, weights: Array, transports: bool
) -> tuple[Array, bool]:
    """Correct by the mean over H matchings: x <- sum w_h x_h, P <- sum w_h (P_h + (x_h - x) (x_h - x)').  [F], JPDA.

    `pairs` (H, K) are the numbers of slots, -1 for none; `weights` (H,) add up to 1.  Each matching is linearised where
    it would be alone; inverse distances are corrected as they are.  Returns d2 (K,) of the first matching's pairs, each
    for itself, NaN for none, and whether the filter can go on.
    """
    x, P, n, blocks, atoms, axes = map_
    robot, mount, slots, d, y, R, _gate = scan
    pose, head = head_sizes(blocks, atoms, robot, mount)
    q = R.shape[1]
    W, D = np.zeros((n, q * (pairs >= 0).sum())), np.zeros((n, len(pairs)))
    d2, used = np.full(len(y), np.nan), 0
    for i in range(len(pairs)):
        rows = np.flatnonzero(pairs[i] >= 0)
        if len(rows) == 0:
            continue
        index, table, mean = observed_block(x, blocks, atoms, robot, mount, slots[pairs[i][rows]], d)
        _e, z, E_r, E_l = linearize(view, mean[:head], mean[head:].reshape(len(rows), d), y[rows])
        if i == 0:
            d2[rows] = innovation(P, index, E_r, E_l, R[rows], z)[1]
        linear, S = (z, E_r, E_l), submatrix(P, index)
        H, M, v, positive = iterate(view, (pose, head, axes), table, mean, S, y[rows], R[rows], linear, limits)
        if not positive:
            return d2, False
        W_i, D[:, i] = gain(P, n, index, H, M, v)
        W[:, used : used + W_i.shape[1]] = np.sqrt(weights[i]) * W_i
        used += W_i.shape[1]
    index, _, mean = observed_block(x, blocks, atoms, robot, mount, slots[:0], d)
    correction = D @ weights
    spread = (D - correction.reshape(n, 1)) * np.sqrt(weights)
    before = generator(atoms, x, n, axes, mean[:3])
    retract(atoms, x, correction, gauge(mean, correction[index], pose, axes) if transports else np.zeros(0))
    downdate(P, W)
    add_square(P, spread)
    if transports:
        theta = index[(3 if pose == 3 else 6) - axes]
        transport(P, generator(atoms, x, n, axes, mean[:3]) - before, theta)
    return d2, True


def textbook(
    view: Any, map_: Map, scan: Scan, _: None
) -> tuple[Array, Array, Array, Array, Flags, bool]:  # fmt: skip
    """Correct with one landmark after the other, each at the state the last one left.  [S] (26)-(30), C.3."""
    x, P, n, blocks, atoms, _axes = map_
    robot, mount, slots, d, y, R, gate = scan
    k, p = len(y), R.shape[1]
    e, z, Z, d2 = np.empty((k, y.shape[1])), np.empty((k, p)), np.empty((k, p, p)), np.empty(k)
    near, healthy, head = np.zeros(k, np.bool_), True, head_sizes(blocks, atoms, robot, mount)[1]
    for i in range(k):
        one = slice(i, i + 1)
        index, _table, mean = observed_block(x, blocks, atoms, robot, mount, slots[one], d)
        e[one], z[one], E_r, E_l = linearize(view, mean[:head], mean[head:].reshape(1, d), y[one])
        Z[one], d2[one], sound = innovation(P, index, E_r, E_l, R[one], z[one])
        healthy = healthy and sound
        near[i] = d2[i] < gate
        if near[i]:
            M, _positive = cholesky_inverse(Z[i])
            W, correction = gain(P, n, index, stacked(E_r, E_l), M, z[i].copy())
            downdate(P, W)
            retract(atoms, x, correction, np.zeros(0))
    return e, z, Z, d2, near, healthy


def first_estimates(
    view: Any, map_: Map, scan: Scan, x_first: Array
) -> tuple[Array, Array, Array, Array, Flags, bool]:  # fmt: skip
    """Correct with one scan, innovation at the estimate, Jacobians at the first estimates `x_first`."""
    x, P, n, blocks, atoms, _axes = map_
    robot, mount, slots, d, y, R, gate = scan
    k, head = len(slots), head_sizes(blocks, atoms, robot, mount)[1]
    index, _, mean = observed_block(x, blocks, atoms, robot, mount, slots, d)
    _, _, first = observed_block(x_first, blocks, atoms, robot, mount, slots, d)
    e, z, _, _ = linearize(view, mean[:head], mean[head:].reshape(k, d), y)
    _, _, E_r, E_l = linearize(view, first[:head], first[head:].reshape(k, d), y)
    Z, d2, healthy = innovation(P, index, E_r, E_l, R, z)
    near = (d2 <= gate) & (d2 < np.inf)
    if not healthy or not near.any():
        return e, z, Z, d2, near, healthy
    index, _, _ = observed_block(x, blocks, atoms, robot, mount, slots[near], d)
    H = stacked(E_r[near], E_l[near])
    Z_all = H @ (submatrix(P, index) @ H.T)
    add_blocks(Z_all, R[near])
    M, positive = cholesky_inverse(Z_all)
    if positive:
        W, correction = gain(P, n, index, H, M, z[near].ravel())
        downdate(P, W)
        retract(atoms, x, correction, np.zeros(0))
    return e, z, Z, d2, near, positive


compiled_invariant = compiled(invariant)
compiled_fit = compiled(fit)
compiled_averaged = compiled(averaged)
compiled_textbook = compiled(textbook)
compiled_first_estimates = compiled(first_estimates)
