"""The corrections: textbook, invariant and first-estimates, each one function from innovation to corrected map.

The same source runs twice: compiled for the built-in models, as plain Python for a user's (`linearize` is the only
place that differs).  A map is its mean x, covariance P with n rows in use, tables of `blocks` and `atoms`, the axes of
its gauge, and the addresses of the `routines` that its kinds of blocks need.  A scan is the slots of its robot and of
its sensor's mount (-1: not in the map), the slots of K landmarks of which the first d numbers are seen, measurements y
(K, m) with the noise R (K, p, p) of their innovations, and the gate on d2.  The head of the observed block is the
robot's pose and, if it is in the map, the mount.  Nothing is changed unless all of it succeeds.

What is called by address is compiled once, alone; what a map has no use for is not compiled at all.  Compiled code
here indexes its arrays: slices, products and fancy indices are what takes numba long.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from numba import types
from numba.extending import overload

from kalmark.arrays import Array, Flags, Index
from kalmark.compiled import address_of, by_address, compiled, signature_of
from kalmark.filter import parallax
from kalmark.filter.kernels import (
    RAISED,
    add_square,
    cholesky_inverse,
    downdate,
    downdate_and_transport,
    lower_product,
    rows_of,
    submatrix,
    transport,
)
from kalmark.filter.observed import (
    Linear,
    chosen,
    diagonal_blocks,
    head_sizes,
    innovation,
    joint_innovation,
    least_squares,
    linearized,
    observed_block,
    raveled,
    settled,
    sparse_product,
    squared_distances,
    stacked,
    transport_rows,
    within,
)
from kalmark.filter.parallax import anchored
from kalmark.geometry.angles import exponential_v
from kalmark.geometry.rotations import exp, left_jacobian, matrix
from kalmark.geometry.spaces import (
    ANGLE,
    SCALAR,
    TURNED,
    VECTOR,
    VECTOR3,
    Table,
    generator,
    generator_plane,
    retract,
    retract_plane,
)
from kalmark.models.observe import VIEW, linearize, sensor_address, sensor_at

Routines = tuple[int, int, int, int, int, int, int, int]  # addresses, see `routines`
Map = tuple[Array, Array, int, Table, Table, int, Routines]  # x, P, n, blocks, atoms, axes, routines
Scan = tuple[int, int, Index, int, Array, Array, float]  # robot, mount, slots, d, y, R, gate

RETRACT = signature_of("none(i8[:, ::1], f8[::1], f8[::1], f8[::1])")
GENERATOR = signature_of("f8[:, ::1](i8[:, ::1], f8[::1], i8, i8, f8[::1])")
TO_ITERATE = (
    f"{VIEW}, UniTuple(i8, 8), UniTuple(i8, 4), i8[:, ::1], f8[::1], f8[:, ::1], f8[:, ::1], f8[:, :, ::1], "
    "Tuple((f8[::1], f8[:, ::1], f8[:, ::1], f8[:, ::1])), Tuple((i8, f8))"
)
ITERATE = signature_of(f"Tuple((f8[:, ::1], f8[:, ::1], f8[::1], b1))({TO_ITERATE})")
TO_CORRECT = (  # all but the last argument
    f"{VIEW}, Tuple((f8[::1], f8[:, ::1], i8, i8[:, ::1], i8[:, ::1], i8, UniTuple(i8, 8))), "
    "Tuple((i8, i8, i8[::1], i8, f8[:, ::1], f8[:, :, ::1], f8))"
)
ROUNDS, SETTLED = 20, 0.01  # of Huber's weights, and by how much these may still change
BLIND = 1e-6  # of a Jacobian's largest number: what is smaller is zero, of a user's model by differences, too
call_retract, call_generator, call_iterate = by_address(RETRACT), by_address(GENERATOR), by_address(ITERATE)
_RETRACT, _GENERATOR, _ITERATE, _SENSOR_AT, _SPREAD, _RETRACT_PARALLAX, _CARRY_BACK, _TRANSPORT_PARALLAX = range(8)


@cache
def generator_address(axes: int) -> int:
    """Return the address of the `generator` of a map of these axes, compiled now."""
    return address_of(generator_plane if axes == 1 else generator, GENERATOR)


@cache
def routines(axes: int, inverse_depths: bool) -> Routines:
    """Return the addresses of what a correction calls in a map of these axes, compiled now.

    They are `retract`, `generator` and `iterate`, and what inverse distances need, 0 where there are none.
    """
    iterates = address_of(compiled_iterate, ITERATE)  # first: what `compile_correction` does is waited for here
    first = address_of(retract_plane if axes == 1 else retract, RETRACT), generator_address(axes), iterates
    return (*first, *((sensor_address(axes), *parallax.addresses()) if inverse_depths else (0, 0, 0, 0, 0)))


def compile_correction(name: str, option: str, axes: int, inverse_depths: bool) -> None:
    """Compile one of the corrections below, whose last argument has the type `option`, and its routines."""
    address_of(compiled_iterate, ITERATE)
    globals()[f"compiled_{name}"].compile(signature_of(f"none({TO_CORRECT}, {option})").args)
    routines(axes, inverse_depths)


@compiled
def turning_rows(table: Table, pose: int, head: int, axes: int, alone: int, H: Array) -> Index:
    """Return the rows of the head that turn the map: of the pose (axes,), then of a mount that is in the map (1 or 3).

    The map turns with the sensor that observes it, so with its mount (docs/invariant.md).  A second block that is no
    mount turns nothing, nor does one of a sensor that sees no directions: the columns of its rotation in H are zero.
    Of such a mount the rows of its position (2 or 3) follow, which turns with the robot: its lever arm.  So it is of a
    robot that is `alone`: landmarks lean on the arm as the robot does, and would have to turn with it.
    """
    dof, turns, last = (3, 1, 4) if pose == 3 else (6, 3, 5)  # last: of the atoms of a pose and a mount
    mounted = head > pose and table[2, 0] == SCALAR and table[last, 0] == (ANGLE if pose == 3 else TURNED)
    begin, more = 2 * dof - turns, turns
    if mounted:
        most = turning = 0.0
        for i in range(len(H)):
            for j in range(H.shape[1]):
                most = max(most, abs(H[i, j]))
                if 2 * dof - turns <= j < 2 * dof:
                    turning = max(turning, abs(H[i, j]))
        if turning <= BLIND * most:
            begin, more = dof, (dof - turns) * alone
    rows = np.empty(axes + more if mounted else axes, np.int64)
    for a in range(len(rows)):
        rows[a] = dof - axes + a if a < axes else begin + a - axes
    return rows


@compiled
def is_alone(blocks: Table, atoms: Table, robot: int, mount: int) -> int:
    """Return 1 if nothing but a robot with a mount in the map has a place in it, else 0."""
    first, last = blocks[robot, 0], blocks[robot, 0] + blocks[robot, 1]
    for a in range(len(atoms)):
        kind, at = atoms[a, 0], atoms[a, 1]
        if (kind == VECTOR or kind >= VECTOR3) and not first <= at < last and kind != TURNED:
            return 0
    return 1 if mount >= 0 else 0


@compiled
def arm_of(rows: Index, axes: int, pose: int) -> int:
    """Return how many of the `turning_rows` are of a lever arm: 2, 3 or 0."""
    return len(rows) - axes if len(rows) > axes and rows[axes] == (3 if pose == 3 else 6) else 0


@compiled
def frame_of(x: Array, at: int, size: int) -> Array:
    """Return R_r (size, size) of the pose at this place of a mean x, in whose frame its mounts are.

    `size`: 3 in space, in the plane 2 of positions, and 1 of rotations.
    """
    if size < 2:
        return np.eye(1)
    if size == 2:
        R = np.empty((2, 2))
        R[0, 0] = R[1, 1] = np.cos(x[at + 2])
        R[1, 0], R[0, 1] = np.sin(x[at + 2]), -np.sin(x[at + 2])
        return R
    q = np.empty(4)
    for i in range(4):
        q[i] = x[at + 3 + i]
    return matrix(q)


@compiled
def turns_of(g: Array, R: Array, x: Array, at: int, last: int, columns: int, arm: int) -> Array:
    """Return a generator g (n, axes) with, up to so many columns, how a turn of the mount moves everything: g R.

    R is R_r before the correction, the pose of the robot is at this place of the mean x now.  Its own rotation, whose
    rows end with `last`, moves by -R_r: a correction leaves d_theta_r + R_r d_theta_s as it is, that of the sensor.
    Its position moves by -R_r B with a lever arm (`arm` rows), where R is the B of `leaning`.
    """
    n, axes = g.shape
    turns = columns - axes
    if turns == 0:
        return g
    out = np.zeros((n, columns))
    for i in range(n):
        for a in range(axes):
            out[i, a] = g[i, a]
        for c in range(turns - arm):
            for a in range(turns):
                out[i, axes + c] += g[i, axes - turns + a] * R[a, c]
    now, first = frame_of(x, at, turns), last + 1 - (turns if arm == 0 else 3 if arm == 2 else 6)
    now = product(now, R) if arm > 0 else now
    for a in range(turns):
        for c in range(turns):
            out[first + a, axes + c] = -now[a, c]
    return out


@compiled
def product(A: Array, B: Array) -> Array:
    """Return A B of two small square matrices."""
    out = np.zeros(A.shape)
    for i in range(len(A)):
        for j in range(len(A)):
            for c in range(len(A)):
                out[i, j] += A[i, c] * B[c, j]
    return out


@compiled
def leaning(P: Array, R: Array, arm: int) -> Array:
    """Return B (arm, arm): in the robot's frame, R = R_r, its position leans on the lever arm by -B.

    That is d_p = -R_r B d_a + C d_theta + what both do not explain, of the covariance P of the head: B is I where an
    antenna's place is known and the heading is not, 0 where the robot's place is known.
    """
    turns = 1 if arm == 2 else 3
    pose, n = arm + turns, arm + turns
    A, B, most = np.empty((n, n)), np.zeros((arm, arm)), 0.0
    rows = np.empty(n, np.int64)
    for i in range(n):
        rows[i] = pose + i if i < arm else i  # of the arm, then of the rotation
    for i in range(n):
        for j in range(n):
            A[i, j] = P[rows[i], rows[j]]
        A[i, i] += RAISED * max(A[i, i], 1.0)
        most = max(most, A[i, i] if i < arm else 0.0)
    M, positive = cholesky_inverse(A)
    if most <= RAISED or not positive:
        return B
    for i in range(arm):
        for j in range(arm):
            for a in range(arm):
                for b in range(n):
                    for c in range(n):  # R' P_p. M' M
                        B[i, j] -= R[a, i] * P[a, rows[b]] * M[c, b] * M[c, j]
    return B


@compiled
def frames_of(P: Array, x: Array, at: int, columns: int, arm: int) -> tuple[Array, Array]:
    """Return R_r, before a correction, and what `turns_of` takes for it, of the covariance P of the head."""
    R = frame_of(x, at, columns)
    return R, leaning(P, R, arm) if arm > 0 else R


@compiled
def carry_arm(x: Array, at: int, R: Array, turn: Array, d: Array) -> None:
    """Move the position of a robot, at this place of the mean x, for what a correction d (k,) of its lever arm does.

    With a turn E it moves by (V - E) R d, R = R_r B: what the arm explains of it turns with E.
    """
    k, M = len(d), np.zeros((3, 3))  # V - E
    if k == 2:
        p, q = exponential_v(turn[0])
        M[0, 0] = M[1, 1] = p - np.cos(turn[0])
        M[1, 0], M[0, 1] = q - np.sin(turn[0]), np.sin(turn[0]) - q
    else:
        whole = turn[len(turn) - 3 :].copy()
        M = left_jacobian(whole) - matrix(exp(whole))
    for i in range(k):
        for j in range(k):
            for c in range(k):
                x[at + i] += M[i, j] * R[j, c] * d[c]


@compiled
def arm_in(correction: Array, rows: Index, axes: int) -> Array:
    """Return what a correction of the head is of the lever arm (2,) or (3,), whose rows are the last ones."""
    d = np.empty(len(rows) - axes)
    for i in range(len(d)):
        d[i] = correction[rows[axes + i]]
    return d


@compiled
def gauge(mean: Array, correction: Array, rows: Index, axes: int, arm: int) -> Array:
    """Return the motion of the gauge (axes,), d_theta or (xi_p, d_theta), in a correction of the head.

    The observing robot's pose comes first in `mean` and in `correction`; `rows` are its `turning_rows`.
    """
    turn, turns = np.empty(axes), len(rows) - axes - arm
    for a in range(axes):
        turn[a] = correction[rows[a]]
    if turns > 0:  # of the sensor: d_theta + R_r d_theta_s
        R = frame_of(mean, 0, turns)
        for a in range(turns):
            for c in range(turns):
                turn[axes - turns + a] += R[a, c] * correction[rows[axes + c]]
    if axes == 6:  # xi_p = d_p - generator_p d_theta
        turn[0] += mean[1] * turn[5] - mean[2] * turn[4]
        turn[1] += mean[2] * turn[3] - mean[0] * turn[5]
        turn[2] += mean[0] * turn[4] - mean[1] * turn[3]
    return turn


@compiled
def picked(index: Index, rows: Index) -> Index:
    """Return index[rows]."""
    out = np.empty(len(rows), np.int64)
    for i in range(len(rows)):
        out[i] = index[rows[i]]
    return out


def iterate(
    model: Any, ways: Routines, sizes: tuple[int, int, int, int], table: Table, mean: Array, P_ss: Array, y: Array,
    R: Array, linear: Linear, limits: tuple[int, float],
) -> tuple[Array, Array, Array, bool]:  # fmt: skip
    """Relinearise on the observed block only: return H, M = L^-1 of its Z, and the innovation to fuse.

    The first time is `linear`, at the mean.  `limits`: at most so many times, until nothing moves by more than that
    many of its sigmas.

    The prior covariance P_ss is in the error coordinates of the prior mean; the Jacobian H_j at the iterate x_j is in
    those of x_j, so H_j is transported: H~_j = H_j (I + (generator(x_j) - generator(x)) e_theta'), and likewise carried
    back where inverse distances are corrected by their parallax.
    """
    (pose, head, axes, alone), (most, tolerance) = sizes, limits
    k = len(y)
    theta = turning_rows(table, pose, head, axes, alone, linear[1])
    correction = np.zeros(len(P_ss))
    origin = mean[:3].copy()
    last, arm = theta[axes - 1], arm_of(theta, axes, pose)
    R_r, B = frames_of(P_ss, mean, 0, len(theta) - axes, arm)
    turned = call_generator(ways[_GENERATOR], (table, mean, len(P_ss), axes, origin))
    turned = turns_of(turned, B, mean, 0, last, len(theta), arm)
    parallaxes = most > 1 and ways[_SPREAD] != 0  # a single step is worse off with them: docs/bearing_only.md
    depths = anchored(table if parallaxes else table[:0])
    v, H, HP, Z = linear
    s, S = s_j, S_j = v, HP  # of the types of a sensor's place and Jacobian, which only inverse distances need
    baselines = (depths, s, S, s)
    if len(depths):
        s, S = sensor_at(model, mean[:head], ways[_SENSOR_AT])
        rows = np.arange(S.shape[1])
        baselines = (depths, s, S, parallax.call_spread(ways[_SPREAD], (P_ss, rows, mean, s, S, depths)))
        s_j, S_j = s, S
    x_j = mean
    for j in range(most):
        if j > 0:
            _e, z, E_r, E_l = linearize(model, x_j[:head], x_j[head:].reshape(k, (len(mean) - head) // k), y)
            H, v = stacked(E_r, E_l), raveled(z)
            if len(depths):
                parallax.call_carry_back(ways[_CARRY_BACK], (H, mean, x_j, baselines, s_j, S_j))
            now = call_generator(ways[_GENERATOR], (table, x_j, len(P_ss), axes, origin))
            transport_rows(H, v, turns_of(now, B, x_j, 0, last, len(theta), arm), turned, theta, correction)
            HP, Z = joint_innovation(H, P_ss, R, E_r.shape[2])
        M, positive = cholesky_inverse(Z)
        if not positive:
            break
        before, correction = correction, least_squares(HP, M, v)
        if settled(table, correction, before, P_ss, tolerance):
            break
        x_j = mean.copy()
        turn = gauge(mean, correction, theta, axes, arm)
        call_retract(ways[_RETRACT], (table, x_j, correction, turn))
        if arm > 0:
            carry_arm(x_j, 0, product(R_r, B), turn, arm_in(correction, theta, axes))
        if len(depths):
            s_j, S_j = sensor_at(model, x_j[:head], ways[_SENSOR_AT])
            d_head = correction[: S.shape[1]]
            parallax.call_retract(ways[_RETRACT_PARALLAX], (x_j, mean, baselines, correction, d_head, s_j))
    return H, M, v, positive


compiled_iterate = compiled(iterate)


def iterated(
    model: Any, ways: Routines, sizes: tuple[int, int, int, int], table: Table, mean: Array, P_ss: Array, y: Array,
    R: Array, linear: Linear, limits: tuple[int, float],
) -> tuple[Array, Array, Array, bool]:  # fmt: skip
    """Return what `iterate` returns, compiled for a compiled model."""
    if isinstance(model, tuple):
        return call_iterate(ways[_ITERATE], (model, ways, sizes, table, mean, P_ss, y, R, linear, limits))
    return iterate(model, ways, sizes, table, mean, P_ss, y, R, linear, limits)


@overload(iterated, strict=False)  # type: ignore[untyped-decorator]
def _compiled_iterated(
    model: Any, ways: Any, sizes: Any, table: Any, mean: Any, P_ss: Any, y: Any, R: Any, linear: Any, limits: Any
) -> Any:
    def call(model, ways, sizes, table, mean, P_ss, y, R, linear, limits):  # type: ignore[no-untyped-def]
        return call_iterate(ways[_ITERATE], (model, ways, sizes, table, mean, P_ss, y, R, linear, limits))

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


def invariant(
    model: Any, map_: Map, scan: Scan, limits: tuple[int, float]
) -> tuple[Array, Array, Array, Array, Flags, bool]:  # fmt: skip
    """Correct with one scan: gate, iterate, fuse, retract, transport; inverse distances by their parallax.

    docs/invariant.md, docs/bearing_only.md.  Returns e, z, Z, d2 at the prediction, which were fused, and whether all
    covariances are valid: an observation whose Z is none is left out, and if that of all together is none, nothing is
    fused.
    """
    x, P, n, blocks, atoms, axes, ways = map_
    robot, mount, slots, d, y, R, gate = scan
    index, table, mean = observed_block(x, blocks, atoms, robot, mount, slots, d)
    pose, head = head_sizes(blocks, atoms, robot, mount)
    alone = is_alone(blocks, atoms, robot, mount)
    e, z, E_r, E_l = linearize(model, mean[:head], mean[head:].reshape(len(slots), d), y)
    h = E_r.shape[2]
    P_ss = submatrix(P, index)
    linear = linearized(z, E_r, E_l, P_ss, R)
    Z = diagonal_blocks(linear[3], z.shape[1])
    d2, valid = squared_distances(Z, z)
    near, count = within(d2, gate)
    if count == 0:
        return e, z, Z, d2, near, valid
    if count < len(near):
        slots, y, R = chosen(near, count, slots, y, R)
        index, table, mean = observed_block(x, blocks, atoms, robot, mount, slots, d)
        P_ss = submatrix(P, index)
        _e, z_near, E_r, E_l = linearize(model, mean[:head], mean[head:].reshape(count, d), y)
        linear = linearized(z_near, E_r, E_l, P_ss, R)
    H, M, v, positive = iterated(model, ways, (pose, head, axes, alone), table, mean, P_ss, y, R, linear, limits)
    if not positive:
        return e, z, Z, d2, within(d2, -1.0)[0], False
    origin = mean[:3].copy()
    theta, at = turning_rows(table, pose, head, axes, alone, linear[1]), blocks[robot, 0]
    last, arm = index[theta[axes - 1]], arm_of(theta, axes, pose)
    R_r, B = frames_of(P_ss, x, at, len(theta) - axes, arm)
    before = turns_of(call_generator(ways[_GENERATOR], (atoms, x, n, axes, origin)), B, x, at, last, len(theta), arm)
    V, correction = gain(sparse_product(H, rows_of(P, index, n), h, count), M, v)
    depths = anchored(atoms if limits[0] > 1 and ways[_SPREAD] != 0 else atoms[:0])
    s, S = v, H  # of the types, as in `iterate`
    rows, baselines, x_before = index[:h], (depths, s, S, s), x
    if len(depths):
        s, S = sensor_at(model, mean[:head], ways[_SENSOR_AT])
        x_before = x.copy()
        baselines = (depths, s, S, parallax.call_spread(ways[_SPREAD], (P, rows, x, s, S, depths)))
    d_head = np.empty(h)
    for i in range(h):
        d_head[i] = correction[rows[i]]
    turn = gauge(mean, d_head, theta, axes, arm)
    call_retract(ways[_RETRACT], (atoms, x, correction, turn))
    if arm > 0:
        carry_arm(x, at, product(R_r, B), turn, arm_in(d_head, theta, axes))
    now = turns_of(call_generator(ways[_GENERATOR], (atoms, x, n, axes, origin)), B, x, at, last, len(theta), arm)
    for i in range(n):
        for a in range(len(theta)):
            now[i, a] -= before[i, a]
    downdate_and_transport(P, V, now, picked(index, theta))
    if len(depths):
        observer = observed_block(x, blocks, atoms, robot, mount, slots[:0], d)[2]
        s, S = sensor_at(model, observer, ways[_SENSOR_AT])
        parallax.call_retract(ways[_RETRACT_PARALLAX], (x, x_before, baselines, correction, d_head, s))
        parallax.call_transport(ways[_TRANSPORT_PARALLAX], (P, n, rows, x_before, x, baselines, s, S))
    return e, z, Z, d2, near, valid


def compared(model: Any, map_: Map, scan: Scan) -> tuple[Array, Array]:
    """Return each observation's innovation covariance Z (K, p, p) and d2 (K,); nothing is corrected.  [S] (83)."""
    x, P, _n, blocks, atoms, _axes, _ways = map_
    robot, mount, slots, d, y, R, _gate = scan
    index, _table, mean = observed_block(x, blocks, atoms, robot, mount, slots, d)
    head = head_sizes(blocks, atoms, robot, mount)[1]
    _e, z, E_h, E_l = linearize(model, mean[:head], mean[head:].reshape(len(slots), d), y)
    Z, d2, _valid = innovation(P, index, E_h, E_l, R, z)
    return Z, d2


def weighed(model: Any, map_: Map, scan: Scan, student: bool) -> Array:
    """Return R (K, p, p) divided by robust weights of what a scan leaves of each whitened innovation r.

    Huber's min(1, k / |r|), or Student's min(1, (k + p) / (k + |r|^2)) of k degrees of freedom; k is in the place of
    the gate.  Huber 1964, Annals of Mathematical Statistics 35; Lange, Little, Taylor 1989, Journal of the American
    Statistical Association 84.  Iterated least squares on the scan as it is linearised at the prediction, with the
    covariance of the prior.
    """
    x, P, _n, blocks, atoms, _axes, _ways = map_
    robot, mount, slots, d, y, R, k = scan
    index, _table, mean = observed_block(x, blocks, atoms, robot, mount, slots, d)
    head, p = head_sizes(blocks, atoms, robot, mount)[1], R.shape[1]
    _e, z, E_r, E_l = linearize(model, mean[:head], mean[head:].reshape(len(slots), d), y)
    P_ss, H, v, inflated = submatrix(P, index), stacked(E_r, E_l), raveled(z), R.copy()
    r = np.empty((len(y), p))
    for _ in range(ROUNDS):
        HP, Z = joint_innovation(H, P_ss, inflated, E_r.shape[2])
        M, positive = cholesky_inverse(Z)
        if not positive:
            return R
        step, changed = least_squares(HP, M, v), 0.0
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


def fit(model: Any, map_: Map, scan: Scan, limits: tuple[int, float]) -> tuple[float, float]:
    """Return d2 = v' Z^-1 v of a scan as a whole, where it is linearised in the end, and log |Z|; inf if not valid."""
    x, P, _n, blocks, atoms, axes, ways = map_
    robot, mount, slots, d, y, R, _gate = scan
    index, table, mean = observed_block(x, blocks, atoms, robot, mount, slots, d)
    pose, head = head_sizes(blocks, atoms, robot, mount)
    alone = is_alone(blocks, atoms, robot, mount)
    _e, z, E_r, E_l = linearize(model, mean[:head], mean[head:].reshape(len(slots), d), y)
    P_ss = submatrix(P, index)
    linear = linearized(z, E_r, E_l, P_ss, R)
    _H, M, v, positive = iterated(model, ways, (pose, head, axes, alone), table, mean, P_ss, y, R, linear, limits)
    if not positive:
        return np.inf, np.inf
    w, log_det = M @ v, 0.0
    for i in range(len(M)):
        log_det -= 2.0 * np.log(M[i, i])
    return (w * w).sum(), log_det


def averaged(
    model: Any, map_: Map, scan: Scan, limits: tuple[int, float], pairs: Index, weights: Array, transports: bool
) -> tuple[Array, bool]:
    """Correct by the mean over H matchings: x <- sum w_h x_h, P <- sum w_h (P_h + (x_h - x) (x_h - x)').  [F], JPDA.

    `pairs` (H, K) are the numbers of slots, -1 for none; `weights` (H,) add up to 1.  Each matching is linearised where
    it would be alone; inverse distances are corrected as they are.  Returns d2 (K,) of the first matching's pairs, each
    for itself, NaN for none, and whether the covariances are valid.
    """
    x, P, n, blocks, atoms, axes, ways = map_
    robot, mount, slots, d, y, R, _gate = scan
    pose, head = head_sizes(blocks, atoms, robot, mount)
    alone = is_alone(blocks, atoms, robot, mount)
    q = R.shape[1]
    V, D, H = np.zeros((q * (pairs >= 0).sum(), n)), np.zeros((n, len(pairs))), np.zeros((0, head))
    d2, used = np.full(len(y), np.nan), 0
    for i in range(len(pairs)):
        rows = np.flatnonzero(pairs[i] >= 0)
        if len(rows) == 0:
            continue
        index, table, mean = observed_block(x, blocks, atoms, robot, mount, slots[pairs[i][rows]], d)
        _e, z, E_r, E_l = linearize(model, mean[:head], mean[head:].reshape(len(rows), d), y[rows])
        if i == 0:
            d2[rows] = innovation(P, index, E_r, E_l, R[rows], z)[1]
        S = submatrix(P, index)
        linear = linearized(z, E_r, E_l, S, R[rows])
        H, M, v, positive = iterated(
            model, ways, (pose, head, axes, alone), table, mean, S, y[rows], R[rows], linear, limits
        )
        if not positive:
            return d2, False
        V_i, D[:, i] = gain(sparse_product(H, rows_of(P, index, n), E_r.shape[2], len(rows)), M, v)
        V[used : used + len(V_i)] = np.sqrt(weights[i]) * V_i
        used += len(V_i)
    index, table, mean = observed_block(x, blocks, atoms, robot, mount, slots[:0], d)
    theta, at = turning_rows(table, pose, head, axes, alone, H), blocks[robot, 0]
    correction = D @ weights
    spread = (D - correction.reshape(n, 1)) * np.sqrt(weights)
    origin = mean[:3].copy()
    last, arm = index[theta[axes - 1]], arm_of(theta, axes, pose)
    R_r, B = frames_of(submatrix(P, index), x, at, len(theta) - axes, arm)
    before = turns_of(call_generator(ways[_GENERATOR], (atoms, x, n, axes, origin)), B, x, at, last, len(theta), arm)
    turn = gauge(mean, correction[index], theta, axes, arm) if transports else np.zeros(0)
    call_retract(ways[_RETRACT], (atoms, x, correction, turn))
    if transports and arm > 0:
        carry_arm(x, at, product(R_r, B), turn, correction[index[theta[axes:]]])
    downdate(P, V)
    add_square(P, spread)
    if transports:
        now = turns_of(call_generator(ways[_GENERATOR], (atoms, x, n, axes, origin)), B, x, at, last, len(theta), arm)
        transport(P, now - before, picked(index, theta))
    return d2, True


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
    rows, V = rows_of(P, index, n), np.zeros((k * p, n))
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


def first_estimates(
    model: Any, map_: Map, scan: Scan, x_first: Array
) -> tuple[Array, Array, Array, Array, Flags, bool]:  # fmt: skip
    """Correct with one scan, innovation at the estimate, Jacobians at the first estimates `x_first`."""
    x, P, n, blocks, atoms, _axes, ways = map_
    robot, mount, slots, d, y, R, gate = scan
    k, head = len(slots), head_sizes(blocks, atoms, robot, mount)[1]
    index, _, mean = observed_block(x, blocks, atoms, robot, mount, slots, d)
    _, _, first = observed_block(x_first, blocks, atoms, robot, mount, slots, d)
    e, z, _, _ = linearize(model, mean[:head], mean[head:].reshape(k, d), y)
    _, _, E_r, E_l = linearize(model, first[:head], first[head:].reshape(k, d), y)
    Z, d2, valid = innovation(P, index, E_r, E_l, R, z)
    near, count = within(d2, gate)
    if count == 0:
        return e, z, Z, d2, near, valid
    index, _, _ = observed_block(x, blocks, atoms, robot, mount, slots[near], d)
    H = stacked(E_r[near], E_l[near])
    M, positive = cholesky_inverse(joint_innovation(H, submatrix(P, index), R[near], E_r.shape[2])[1])
    if not positive:
        return e, z, Z, d2, within(d2, -1.0)[0], False
    V, correction = gain(sparse_product(H, rows_of(P, index, n), E_r.shape[2], count), M, z[near].ravel())
    downdate(P, V)
    call_retract(ways[_RETRACT], (atoms, x, correction, np.zeros(0)))
    return e, z, Z, d2, near, valid


compiled_invariant = compiled(invariant)
compiled_compared = compiled(compared)
compiled_weighed = compiled(weighed)
compiled_fit = compiled(fit)
compiled_averaged = compiled(averaged)
compiled_textbook = compiled(textbook)
compiled_first_estimates = compiled(first_estimates)
