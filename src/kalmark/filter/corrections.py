"""The corrections: textbook, invariant and first-estimates, each one function from innovation to corrected map.

The same source runs twice: compiled for the built-in models, as plain Python for a user's (`linearize` is the only
place that differs).  A map is its mean x, covariance P with n rows in use, tables of `blocks` and `atoms`, the axes of
its gauge, and the addresses of the `routines` that its kinds of blocks need.  A scan is the slots of its robot and of
its sensor's mount (-1: not in the map), the slots of K landmarks of which the first d numbers are seen, measurements y
(K, m) with the noise R (K, p, p) of their innovations, and the gate on d2.  The head of the observed block is the
robot's pose and, if it is in the map, the mount.  Nothing is changed unless all of it succeeds.

A function that is called by address is compiled once, alone, and only if a map uses it.
"""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numba import types
from numba.extending import overload

from kalmark.arrays import Array, Flags, Index
from kalmark.compiled import address_of, by_address, compiled, compiled_by_model, signature_of
from kalmark.filter import gauge_transport, parallax
from kalmark.filter.gauge_transport import (
    TURNING,
    Turning,
    call_carry,
    call_displacement,
    call_heading_last,
    call_regression,
    call_turn_matrices,
    extend_rows,
    gauge,
    is_level,
    rotation_at,
    turning_rows,
    units,
)
from kalmark.filter.kernels import (
    RAISED,
    add_square,
    cholesky_inverse,
    downdate,
    downdate_and_transport,
    lower_product,
    submatrix,
    take_rows,
)
from kalmark.filter.observed_block import (
    Linear,
    cost_of,
    diagonal_blocks,
    has_settled,
    head_sizes,
    innovation,
    joint_innovation,
    least_squares,
    observation_of,
    observed_block,
    sparse_product,
    squared_distances,
    stack_jacobians,
    transport_rows,
    within_gate,
)
from kalmark.filter.parallax import inverse_distance_table
from kalmark.geometry.spaces import Table, generator, generator_plane, retract, retract_plane
from kalmark.models.observe import VIEW, linearize, sensor_address, sensor_at

Routines = tuple[int, ...]  # 13 addresses, see `routines`
Map = tuple[Array, Array, int, Table, Table, int, Routines]  # x, P, n, blocks, atoms, axes, routines
Sizes = tuple[int, int, int, int, int, int]  # see `predicted`
Scan = tuple[int, int, Index, int, Array, Array, float]  # robot, mount, slots, d, y, R, gate
Block = tuple[Index, Index, Table, Array, Array, Sizes, Turning]  # rows in P, places of the head in x, atoms, mean, P
Placed = tuple[Table, Index, Index, Array, int]  # atoms of a mean, rows of an observed block, places of its head, x, n


class Coordinates(NamedTuple):
    """Error coordinates of a mean, which is `placed`: all that does not change while it is corrected.

    `head` (h,) is its part that observes, `theta` (k,) are the rows of the errors that turn others, L (n, m) is the
    regression on those of a mount and of other units, R_r the robot's rotation, `generator` (n, axes) how all errors
    move when the world turns.
    """

    placed: Placed
    head: Array
    theta: Index
    L: Array
    R_r: Array
    generator: Array
    baselines: parallax.Baselines
    turns: tuple[Turning, Sizes]


RETRACT = signature_of("none(i8[:, ::1], f8[::1], f8[::1], f8[::1])")
GENERATOR = signature_of("f8[:, ::1](i8[:, ::1], f8[::1], i8, i8, f8[::1])")
BLOCK = f"Tuple((i8[::1], i8[::1], i8[:, ::1], f8[::1], f8[:, ::1], UniTuple(i8, 6), {TURNING}))"
TO_ITERATE = (
    f"{VIEW}, UniTuple(i8, 13), {BLOCK}, f8[:, ::1], "
    "f8[:, :, ::1], Tuple((f8[::1], f8[:, ::1], f8[:, ::1], f8[:, ::1])), Tuple((i8, f8))"
)
ITERATE = signature_of(f"Tuple((f8[:, ::1], f8[:, ::1], f8[::1], b1))({TO_ITERATE})")
TO_CORRECT = (  # all but the last argument
    f"{VIEW}, Tuple((f8[::1], f8[:, ::1], i8, i8[:, ::1], i8[:, ::1], i8, UniTuple(i8, 13))), "
    "Tuple((i8, i8, i8[::1], i8, f8[:, ::1], f8[:, :, ::1], f8))"
)
ROUNDS, SETTLED = 20, 0.01  # of Huber's weights, and by how much these may still change
RISE = 0.01  # by which a step may raise the cost before it is halved
call_retract, call_generator, call_iterate = by_address(RETRACT), by_address(GENERATOR), by_address(ITERATE)
_RETRACT, _GENERATOR, _ITERATE, _REGRESSION, _HEADING_LAST, _TURN_MATRICES, _CARRY, _DISPLACEMENT = range(8)
_SENSOR_AT, _SPREAD, _RETRACT_PARALLAX, _CARRY_BACK, _TRANSPORT_PARALLAX = range(8, 13)


@cache
def generator_address(axes: int) -> int:
    """Return the address of the `generator` of a map of these axes, compiled now."""
    return address_of(generator_plane if axes == 1 else generator, GENERATOR)


@cache
def routines(axes: int, inverse_depths: bool, dependent: bool) -> Routines:
    """Return the addresses of what a correction calls in a map of these axes, compiled now.

    They are `retract`, `generator` and `iterate`, what moves vectors that may be `dependent` on a mount or on an
    inertial unit, and what inverse distances need, 0 where there are none.
    """
    iterates = address_of(compiled_iterate, ITERATE)  # first: what `compile_correction` does is waited for here
    first = address_of(retract_plane if axes == 1 else retract, RETRACT), generator_address(axes), iterates
    rays = (sensor_address(), *parallax.addresses()) if inverse_depths else (0, 0, 0, 0, 0)
    return (*first, *gauge_transport.addresses(dependent), *rays)


def compile_correction(name: str, option: str, axes: int, inverse_depths: bool, dependent: bool) -> None:
    """Compile one of the corrections below, whose last argument has the type `option`, and its routines."""
    address_of(compiled_iterate, ITERATE)
    globals()[name].compile(signature_of(f"none({TO_CORRECT}, {option})").args)
    routines(axes, inverse_depths, dependent)


@compiled_by_model
def predicted(model: Any, map_: Map, scan: Scan) -> tuple[Array, Array, Block, Linear]:
    """Return e and z of each observation, the block that a scan observes, and the scan linearised at the block's mean.

    The rows of other units that turn are behind those of the head.  The sizes of a block are the numbers of the pose
    and of the head, the axes of the gauge, the rows of the head and of other units, and whether the robot is an
    inertial unit whose gravity is known, whose errors of tilt turn.  [S] (26), (27).
    """
    x, P, _n, blocks, atoms, axes, _ways = map_
    robot, mount, slots, d, y, R, _gate = scan
    index, table, mean = observed_block(x, blocks, atoms, robot, mount, slots, d)
    pose, head = head_sizes(blocks, atoms, robot, mount)
    others, h = units(atoms, blocks[robot, 2]), 3 if pose == 3 else 6
    h += blocks[mount, 3] if mount >= 0 else 0
    if len(others):
        index, table = extend_rows(index, table, h, others)
    places = np.empty(head, np.int64)
    for i in range(head):
        places[i] = blocks[robot, 0] + i if i < pose else blocks[mount, 0] + i - pose
    sizes = pose, head, axes, h, len(others), is_level(atoms, blocks[robot, 4], blocks[robot, 5])
    e, z, E_r, E_l = linearize(model, mean[:head], mean[head:].reshape(len(slots), d), y)
    P_ss = submatrix(P, index)
    linear = observation_of(z, E_r, E_l, P_ss, R)
    return e, z, (index, places, table, mean, P_ss, sizes, turning_rows(table, sizes, linear[1])), linear


@compiled_by_model
def coordinates(
    model: Any, ways: Routines, turns: tuple[Turning, Sizes], placed: Placed, P: Array, iterates: bool
) -> Coordinates:  # fmt: skip
    """Return the error coordinates of a mean x whose covariance are the first n rows of P, as `retract_in` takes them.

    In a correction that `iterates` inverse distances are corrected by their parallax: a single step is worse off with
    it.  docs/invariant.md, docs/bearing_only.md.
    """
    (turning, sizes), (table, rows, places, x, n) = turns, placed
    axes, h, head = sizes[2], sizes[3], x[places]
    theta, R_r = rows[turning[0]], rotation_at(x, places[0], axes)
    B = take_rows(P, theta, n)
    L = call_regression(ways[_REGRESSION], (B, theta, table, turning, axes, R_r, ways[_SPREAD] != 0))
    generator = call_generator(ways[_GENERATOR], (table, x, n, axes, head))
    depths = inverse_distance_table(table if iterates and ways[_SPREAD] != 0 else table[:0])
    s, S, c2 = head, L, head  # of the types of a sensor's place and Jacobian, which only inverse distances need
    if len(depths):
        s, S = sensor_at(model, head, ways[_SENSOR_AT])
        c2 = parallax.call_spread(ways[_SPREAD], (P, rows[:h], x, s, S, depths))
    return Coordinates(placed, head, theta, L, R_r, generator, (depths, s, S, c2), turns)


@compiled_by_model
def retract_in(
    model: Any, ways: Routines, prior: Coordinates, x: Array, correction: Array
) -> tuple[Array, Array, Array]:  # fmt: skip
    """Move a mean x by a correction (n,); return how the error coordinates change, and the sensor's place and Jacobian.

    The errors d of those that turn, the rows theta, change the others by a d_theta, a (n, k).  The sensor is that of
    inverse distances, where there are any.
    """
    (table, rows, places, before, n), head, theta, L, R_r, then, baselines, (turning, sizes) = prior
    axes, h, level = sizes[2], sizes[3], sizes[5]
    own = correction[rows]
    turn = gauge(head, own, turning, axes)
    step = call_heading_last(ways[_HEADING_LAST], (correction, turn, level, rows[0] + 3))  # the row of the rotation
    E, W, d = call_turn_matrices(ways[_TURN_MATRICES], (turn, step[rows], turning, axes))
    call_retract(ways[_RETRACT], (table, x, step, turn))
    call_carry(ways[_CARRY], (table, x, L, W, d))
    now = call_generator(ways[_GENERATOR], (table, x, n, axes, head))
    moved = table, now, then, L, E, d, turning, theta, R_r, rotation_at(x, places[0], axes), level
    a = call_displacement(ways[_DISPLACEMENT], moved)
    s, S = baselines[1], baselines[2]
    if len(baselines[0]):
        s, S = sensor_at(model, x[places], ways[_SENSOR_AT])
        parallax.call_retract(ways[_RETRACT_PARALLAX], (x, before, baselines, correction, own[:h], s))
    return a, s, S


def iterate(
    model: Any, ways: Routines, block: Block, y: Array, R: Array, linear: Linear, limits: tuple[int, float]
) -> tuple[Array, Array, Array, bool]:  # fmt: skip
    """Relinearise on the observed block only: return H, M = L^-1 of its Z, and the innovation to fuse.

    The first time is `linear`, at the mean.  `limits`: at most so many times, until nothing moves by more than that
    many of its sigmas.

    If that ends where the `cost_of` the scan and the prior is more than at the mean, it goes on from where it was least
    and halves each step that raises it (docs/invariant.md).

    The prior covariance P_ss is in the error coordinates of the prior mean; the Jacobian H_j at the iterate x_j is in
    those of x_j, so H_j is transported: H~_j = H_j (I + a e_theta'), `retract_in`, and likewise carried back where
    inverse distances are corrected by their parallax.
    """
    (_index, _places, table, mean, P_ss, sizes, turning), (most, tolerance) = block, limits
    head, behind, (k, p), n = sizes[1], sizes[3] + sizes[4], (len(y), R.shape[1]), len(P_ss)
    v, H, HP, Z = linear
    placed = table, np.arange(n), np.arange(head), mean, n
    prior = coordinates(model, ways, (turning, sizes), placed, P_ss, most > 1)
    baselines, correction, weights = prior.baselines, np.zeros(n), np.zeros(n)
    best, best_weights = correction, weights
    first = least = cost = cost_of(v.reshape(k, p), R, correction, weights)
    for j in range(2 * most):
        if j == most:
            if not cost > first:  # or a noise is singular, and the cost NaN
                break
            correction, weights = best, best_weights
        if j > 0:
            x_j = mean.copy()
            a, s, S = retract_in(model, ways, prior, x_j, correction)
            _e, z, E_r, E_l = linearize(model, x_j[:head], x_j[head:].reshape(k, (len(mean) - head) // k), y)
            cost = cost_of(z, R, correction, weights)
            H, v = stack_jacobians(E_r, E_l, n), z.ravel()
            if len(baselines[0]):
                parallax.call_carry_back(ways[_CARRY_BACK], (H, mean, x_j, baselines, s, S))
            transport_rows(H, v, a, prior.theta, correction)
            HP, Z = joint_innovation(H, P_ss, R, behind)
        M, positive = cholesky_inverse(Z)
        if not positive:
            break
        if cost < least:
            best, best_weights, least = correction, weights, cost
        elif j > most and cost > least + RISE:  # too long a step
            correction, weights = 0.5 * (best + correction), 0.5 * (best_weights + weights)
            continue
        before = correction
        correction, weights = least_squares(HP, H, M, v)
        if has_settled(table, correction, before, P_ss, tolerance):
            break
    return H, M, v, positive


compiled_iterate = compiled(iterate)


def iterated(
    model: Any, ways: Routines, block: Block, y: Array, R: Array, linear: Linear, limits: tuple[int, float]
) -> tuple[Array, Array, Array, bool]:  # fmt: skip
    """Return what `iterate` returns, compiled for a compiled model."""
    if isinstance(model, tuple):
        return call_iterate(ways[_ITERATE], (model, ways, block, y, R, linear, limits))
    return iterate(model, ways, block, y, R, linear, limits)


@overload(iterated, strict=False)  # type: ignore[untyped-decorator]
def _compiled_iterated(model: Any, ways: Any, block: Any, y: Any, R: Any, linear: Any, limits: Any) -> Any:
    def call(model, ways, block, y, R, linear, limits):  # type: ignore[no-untyped-def]
        return call_iterate(ways[_ITERATE], (model, ways, block, y, R, linear, limits))

    return call if isinstance(model, types.BaseTuple) else None


@compiled
def gain(HP: Array, M: Array, v: Array) -> tuple[Array, Array]:
    """Return V = L^-1 H P, M = L^-1, of which P loses V' V, and the mean's correction K v (n,).  [S] (28)-(30)."""
    V = lower_product(M, HP)
    correction = np.zeros(V.shape[1])
    for i in range(len(M)):
        w = 0.0
        for j in range(i + 1):
            w += M[i, j] * v[j]
        for j in range(V.shape[1]):
            correction[j] += w * V[i, j]
    return V, correction


@compiled
def product_left(E_r: Array, E_l: Array, rows: Array, at: int, V: Array, index: Index, count: int) -> Array:
    """Return H (P - V' V) (p, n) of one observation, H = (E_r, E_l), for the first `count` rows of V (., n).

    `rows` are those of P at `index`: E_r (p, h) is of the first h of them, E_l (p, d) of d from the number `at` on.
    """
    p, h = E_r.shape
    n, size = rows.shape[1], h + E_l.shape[1]
    HP = np.zeros((p, n))
    for a in range(p):
        for c in range(size):
            k, e = (c, E_r[a, c]) if c < h else (at + c - h, E_l[a, c - h])
            for j in range(n):
                HP[a, j] += e * rows[k, j]
        for b in range(count):
            s = 0.0
            for c in range(size):
                s += E_r[a, c] * V[b, index[c]] if c < h else E_l[a, c - h] * V[b, index[at + c - h]]
            for j in range(n):
                HP[a, j] -= s * V[b, j]
    return HP


@compiled
def invariant(
    model: Any, map_: Map, scan: Scan, limits: tuple[int, float]
) -> tuple[Array, Array, Array, Array, Flags, bool]:  # fmt: skip
    """Correct with one scan: gate, iterate, fuse.  docs/invariant.md, docs/bearing_only.md.

    Returns e, z, Z, d2 at the prediction, which were fused, and whether all covariances are valid: an observation whose
    Z is none is left out, and if that of all together is none, nothing is fused.
    """
    e, z, block, linear = predicted(model, map_, scan)
    Z = diagonal_blocks(linear[3], z.shape[1])
    d2, valid = squared_distances(Z, z)
    near, count = within_gate(d2, scan[6])
    if count == 0:
        return e, z, Z, d2, near, valid
    if count < len(near):
        robot, mount, slots, d, y, R, gate = scan
        scan = robot, mount, slots[near], d, y[near], R[near], gate
        _e, _z, block, linear = predicted(model, map_, scan)
    H, M, v, positive = iterated(model, map_[6], block, scan[4], scan[5], linear, limits)
    if not positive:
        return e, z, Z, d2, within_gate(d2, -1.0)[0], False
    fuse_scan(model, map_, block, (H, M, v), count, limits[0] > 1)
    return e, z, Z, d2, near, valid


@compiled_by_model
def fuse_scan(
    model: Any, map_: Map, block: Block, linear: tuple[Array, Array, Array], count: int, iterates: bool
) -> None:  # fmt: skip
    """Set x <- x + K v and P <- P - K Z K' by H, M = L^-1, Z = L L', and v, in the coordinates of the corrected mean.

    `count` observations at once.  [S] (28)-(30).
    """
    (x, P, n, _blocks, atoms, _axes, ways), (H, M, v) = map_, linear
    index, places, _table, _mean, _P_ss, sizes, turning = block
    prior = coordinates(model, ways, (turning, sizes), (atoms, index, places, x.copy(), n), P, iterates)
    V, correction = gain(sparse_product(H, take_rows(P, index, n), sizes[3] + sizes[4], count), M, v)
    a, s, S = retract_in(model, ways, prior, x, correction)
    downdate_and_transport(P, V, a, prior.theta)
    if len(prior.baselines[0]):
        parallax.call_transport(
            ways[_TRANSPORT_PARALLAX], (P, n, index[: sizes[3]], prior.placed[3], x, prior.baselines, s, S)
        )


@compiled_by_model
def seen_at(model: Any, map_: Map, scan: Scan) -> tuple[Index, Array, Array, Array, Array]:
    """Return the rows in P of the block that a scan observes, and e, z, E_h and E_l at its mean, as `linearize`."""
    x, _P, _n, blocks, atoms, _axes, _ways = map_
    robot, mount, slots, d, y, _R, _gate = scan
    index, _table, mean = observed_block(x, blocks, atoms, robot, mount, slots, d)
    head = head_sizes(blocks, atoms, robot, mount)[1]
    e, z, E_h, E_l = linearize(model, mean[:head], mean[head:].reshape(len(slots), d), y)
    return index, e, z, E_h, E_l


@compiled
def innovation_covariances(model: Any, map_: Map, scan: Scan) -> tuple[Array, Array]:
    """Return each observation's innovation covariance Z (K, p, p) and d2 (K,); nothing is corrected.  [S] (83)."""
    index, _e, z, E_h, E_l = seen_at(model, map_, scan)
    Z, d2, _valid = innovation(map_[1], index, E_h, E_l, scan[5], z)
    return Z, d2


@compiled
def robust_noise(model: Any, map_: Map, scan: Scan, student: bool) -> Array:
    """Return R (K, p, p) divided by robust weights of what a scan leaves of each whitened innovation r.

    Huber's min(1, k / |r|), or Student's min(1, (k + p) / (k + |r|^2)) of k degrees of freedom; k is in the place of
    the gate.  Huber 1964, Annals of Mathematical Statistics 35; Lange, Little, Taylor 1989, Journal of the American
    Statistical Association 84.  Iterated least squares on the scan as it is linearised at the prediction, with the
    covariance of the prior.
    """
    index, _e, z, E_r, E_l = seen_at(model, map_, scan)
    y, R, k = scan[4:]
    p = R.shape[1]
    for i in range(len(y)):
        if np.isnan(z[i]).any():  # it has no expectation: it does not change the others
            z[i], E_r[i], E_l[i] = 0.0, 0.0, 0.0
    P_ss, H, v, inflated = submatrix(map_[1], index), stack_jacobians(E_r, E_l, len(index)), z.ravel(), R.copy()
    r = np.empty((len(y), p))
    for _ in range(ROUNDS):
        HP, Z = joint_innovation(H, P_ss, inflated, E_r.shape[2])
        M, positive = cholesky_inverse(Z)
        if not positive:
            return R
        step, changed = least_squares(HP, H, M, v)[0], 0.0
        for i in range(len(y)):
            for a in range(p):
                r[i, a] = v[i * p + a]
                for c in range(len(step)):
                    r[i, a] -= H[i * p + a, c] * step[c]
        d2, _valid = squared_distances(R, r)
        for i in range(len(y)):
            times = (k + d2[i]) / (k + p) if student else np.sqrt(d2[i]) / k
            times = max(1.0, times) if times < np.inf else 1.0
            changed = max(changed, abs(inflated[i, 0, 0] / R[i, 0, 0] / times - 1.0))
            for a in range(p):
                for b in range(p):
                    inflated[i, a, b] = R[i, a, b] * times
        if changed < SETTLED:
            break
    return inflated


@compiled
def scan_fit(model: Any, map_: Map, scan: Scan, limits: tuple[int, float]) -> tuple[float, float]:
    """Return d2 = v' Z^-1 v of a scan as a whole, where it is linearised in the end, and log |Z|; inf if not valid."""
    _e, _z, block, linear = predicted(model, map_, scan)
    _H, M, v, positive = iterated(model, map_[6], block, scan[4], scan[5], linear, limits)
    if not positive:
        return np.inf, np.inf
    w, log_det = M @ v, 0.0
    for i in range(len(M)):
        log_det -= 2.0 * np.log(M[i, i])
    return (w * w).sum(), log_det


@compiled
def correct_by_average(
    model: Any, map_: Map, scan: Scan, limits: tuple[int, float], pairs: Index, weights: Array, transports: bool
) -> tuple[Array, bool]:
    """Correct by the mean over H matchings: x <- sum w_h x_h, P <- sum w_h (P_h + (x_h - x) (x_h - x)').  [F], JPDA.

    `pairs` (H, K) are the numbers of slots, -1 for none; `weights` (H,) add up to 1.  Each matching is linearised where
    it would be alone; inverse distances are corrected as they are.  Returns d2 (K,) of the first matching's pairs, each
    for itself, NaN for none, and whether the covariances are valid.
    """
    x, P, n, _blocks, atoms, _axes, ways = map_
    robot, mount, slots, d, y, R, gate = scan
    V, D = np.zeros((R.shape[1] * (pairs >= 0).sum(), n)), np.zeros((n, len(pairs)))
    d2, used = np.full(len(y), np.nan), 0
    for i in range(len(pairs)):
        rows = np.flatnonzero(pairs[i] >= 0)
        if len(rows) == 0:
            continue
        matched = robot, mount, slots[pairs[i][rows]], d, y[rows], R[rows], gate
        _e, z, block, linear = predicted(model, map_, matched)
        if i == 0:
            d2[rows] = squared_distances(diagonal_blocks(linear[3], z.shape[1]), z)[0]
        H, M, v, positive = iterated(model, ways, block, matched[4], matched[5], linear, limits)
        if not positive:
            return d2, False
        index, places, _table, _mean, _P_ss, sizes, turning = block
        V_i, D[:, i] = gain(sparse_product(H, take_rows(P, index, n), sizes[3] + sizes[4], len(rows)), M, v)
        V[used : used + len(V_i)] = np.sqrt(weights[i]) * V_i
        used += len(V_i)
    correction = D @ weights
    spread = (D - correction.reshape(n, 1)) * np.sqrt(weights)
    if not transports or used == 0:
        call_retract(ways[_RETRACT], (atoms, x, correction, np.zeros(0)))
        downdate(P, V)
        add_square(P, spread)
        return d2, True
    prior = coordinates(model, ways, (turning, sizes), (atoms, index, places, x.copy(), n), P, False)
    a = retract_in(model, ways, prior, x, correction)[0]
    downdate(P, V)
    add_square(P, spread)
    downdate_and_transport(P, V[:0], a, prior.theta)
    return d2, True


@compiled
def textbook(
    model: Any, map_: Map, scan: Scan, _: None
) -> tuple[Array, Array, Array, Array, Flags, bool]:  # fmt: skip
    """Correct with one landmark after the other, each at the state the last one left.  [S] (26)-(30), C.3.

    P is corrected once, at the end: until then it is P - V' V, V (K p, n) the gain rows so far.
    """
    x, P, n, blocks, atoms, _axes, ways = map_
    robot, mount, slots, d, y, R, gate = scan
    k, p = len(y), R.shape[1]
    e, z, Z, d2 = np.empty((k, y.shape[1])), np.empty((k, p)), np.empty((k, p, p)), np.empty(k)
    near, valid, head = np.zeros(k, np.bool_), True, head_sizes(blocks, atoms, robot, mount)[1]
    index, _table, _mean = observed_block(x, blocks, atoms, robot, mount, slots, d)
    rows, V = take_rows(P, index, n), np.zeros((k * p, n))
    for i in range(k):
        one = slice(i, i + 1)
        _index, _table, mean = observed_block(x, blocks, atoms, robot, mount, slots[one], d)
        e[one], z[one], E_r, E_l = linearize(model, mean[:head], mean[head:].reshape(1, d), y[one])
        h = E_r.shape[2]
        at = h + i * E_l.shape[2]
        HP = product_left(E_r[0], E_l[0], rows, at, V, index, i * p)
        for a in range(p):
            for b in range(p):
                Z[i, a, b] = R[i, a, b]
                for c in range(h):
                    Z[i, a, b] += HP[a, index[c]] * E_r[0, b, c]
                for c in range(E_l.shape[2]):
                    Z[i, a, b] += HP[a, index[at + c]] * E_l[0, b, c]
            Z[i, a, a] *= 1.0 + RAISED
        d2[one], positive = squared_distances(Z[one], z[one])
        valid = valid and positive
        near[i] = d2[i] < gate
        if near[i]:
            M, _positive = cholesky_inverse(Z[i])  # which gives d2, too
            V_i, correction = gain(HP, M, z[i])
            for a in range(p):
                for b in range(n):
                    V[i * p + a, b] = V_i[a, b]
            call_retract(ways[_RETRACT], (atoms, x, correction, np.zeros(0)))
    downdate(P, V)
    return e, z, Z, d2, near, valid


@compiled
def first_estimates(
    model: Any, map_: Map, scan: Scan, x_first: Array
) -> tuple[Array, Array, Array, Array, Flags, bool]:  # fmt: skip
    """Correct with one scan, innovation at the estimate, Jacobians at the first estimates `x_first`."""
    x, P, n, blocks, atoms, axes, ways = map_
    robot, mount, slots, d, _y, R, gate = scan
    index, e, z, _E_r, _E_l = seen_at(model, map_, scan)
    _index, _e, _z, E_r, E_l = seen_at(model, (x_first, P, n, blocks, atoms, axes, ways), scan)
    Z, d2, valid = innovation(P, index, E_r, E_l, R, z)
    near, count = within_gate(d2, gate)
    if count == 0:
        return e, z, Z, d2, near, valid
    index, _, _ = observed_block(x, blocks, atoms, robot, mount, slots[near], d)
    H = stack_jacobians(E_r[near], E_l[near], len(index))
    M, positive = cholesky_inverse(joint_innovation(H, submatrix(P, index), R[near], E_r.shape[2])[1])
    if not positive:
        return e, z, Z, d2, within_gate(d2, -1.0)[0], False
    V, correction = gain(sparse_product(H, take_rows(P, index, n), E_r.shape[2], count), M, z[near].ravel())
    downdate(P, V)
    call_retract(ways[_RETRACT], (atoms, x, correction, np.zeros(0)))
    return e, z, Z, d2, near, valid
