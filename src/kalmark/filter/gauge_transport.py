"""Covariance transport of the invariant filter: the blocks that depend on the gauge, and their rotation.

The map turns with the sensor that observes it: the gauge (docs/invariant.md).  The error d of a vector of the world may
be correlated with the error of a lever arm a, or with the rotation errors of other inertial units r relative to the
observing robot:

    d = L_a d_a + L_r (d_theta_r - d_theta) + e,    L = Cov(d, .) Cov(., .)^-1

is its linear regression by the covariance before the correction, e its residual, which is uncorrelated with them.  The
transport turns the dependent part by E, the turn of the robot that has the arm, or of r, and e with the map.  A turn of
the whole world changes no difference of rotations.
Where the map turns with a sensor, the position of its robot depends on arm and rotation of the mount.
"""

from __future__ import annotations

import numpy as np

from kalmark.arrays import Array, Index
from kalmark.compiled import address_of, by_address, compiled, signature_of
from kalmark.filter.kernels import RAISED, cholesky_inverse
from kalmark.geometry.angles import exponential_v
from kalmark.geometry.frames import product
from kalmark.geometry.rotations import exp, left_jacobian, log, matrix, multiply
from kalmark.geometry.spaces import ANGLE, LINEAR, OWN, ROTATION, SCALAR, TURNED, VECTOR, Table

BLIND = 1e-6  # of a Jacobian's largest number: what is smaller is zero, of a user's model by differences, too

Turning = tuple[Index, int, int]  # rows of what turns, and how many are of the mount's rotation and of a lever arm

TURNING = "Tuple((i8[::1], i8, i8))"
REGRESSION = signature_of(f"f8[:, ::1](f8[:, ::1], i8[::1], i8[:, ::1], {TURNING}, i8, f8[:, ::1], b1)")
HEADING_LAST = signature_of("f8[::1](f8[::1], f8[::1], i8, i8)")
TURN_MATRICES = signature_of(f"Tuple((f8[:, :, ::1], f8[:, :, ::1], f8[::1]))(f8[::1], f8[::1], {TURNING}, i8)")
CARRY = signature_of("none(i8[:, ::1], f8[::1], f8[:, ::1], f8[:, :, ::1], f8[::1])")
DISPLACEMENT = signature_of(
    f"f8[:, ::1](i8[:, ::1], f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[:, :, ::1], f8[::1], {TURNING}, i8[::1], "
    "f8[:, ::1], f8[:, ::1], i8)"
)
call_regression, call_heading_last, call_turn_matrices = map(by_address, (REGRESSION, HEADING_LAST, TURN_MATRICES))
call_carry, call_displacement = by_address(CARRY), by_address(DISPLACEMENT)


def addresses(dependent: bool) -> tuple[int, ...]:
    """Return the addresses of the five functions below that are called by address, compiled now.

    Where no mount and no inertial unit is in the map, nothing is `dependent` on other rows, and little is left of them.
    """
    whole = regression_on_units, heading_last, turn_matrices, carry, displacement_columns
    little = independent, correction_itself, no_matrices, carry_nothing, generators_difference
    signatures = REGRESSION, HEADING_LAST, TURN_MATRICES, CARRY, DISPLACEMENT
    return tuple(map(address_of, whole if dependent else little, signatures))


@compiled
def independent(
    B: Array, index: Index, atoms: Table, turning: Turning, axes: int, R: Array, rays: bool
) -> Array:  # fmt: skip
    """Return `regression_on_units` on no rows (n, 0)."""
    return np.empty((B.shape[1], 0))


@compiled
def correction_itself(correction: Array, turn: Array, level: int, at: int) -> Array:
    """Return `heading_last` of a robot that is no inertial unit."""
    return correction


@compiled
def no_matrices(turn: Array, correction: Array, turning: Turning, axes: int) -> tuple[Array, Array, Array]:
    """Return `turn_matrices` of no rows."""
    return np.empty((0, 2, 2)), np.empty((0, 2, 2)), np.empty(0)


@compiled
def carry_nothing(atoms: Table, x: Array, L: Array, W: Array, d: Array) -> None:
    """Move no vectors, as `carry` where none depends on other rows."""


@compiled
def generators_difference(
    atoms: Table, now: Array, then: Array, L: Array, E: Array, d: Array, turning: Turning, index: Index, R: Array,
    R_now: Array, level: int,
) -> Array:  # fmt: skip
    """Return `displacement_columns` where no vector depends on other rows: now - then (n, axes)."""
    out = np.empty(now.shape)
    for i in range(now.shape[0]):
        for a in range(now.shape[1]):
            out[i, a] = now[i, a] - then[i, a]
    return out


@compiled
def units(atoms: Table, observer: int) -> Index:
    """Return the rows (3 k,) of the rotations of all inertial units but the one whose rows begin at `observer`."""
    rows, count = np.empty(3 * len(atoms), np.int64), 0
    for i in range(len(atoms) - 1):
        if atoms[i, 0] == ROTATION and atoms[i + 1, 0] == OWN and atoms[i, 2] != observer + 3:
            for a in range(3):
                rows[count + a] = atoms[i, 2] + a
            count += 3
    return rows[:count]


@compiled
def is_level(atoms: Table, first: int, count: int) -> int:
    """Return 1 if a robot, the `count` atoms from `first` on, is an inertial unit whose gravity is known, else 0."""
    own = 0
    for i in range(first, first + count):
        own += atoms[i, 0] == OWN
    return 1 if own == 1 else 0


@compiled
def about_vertical(E: Array) -> Array:
    """Return the part (3, 3) about z of a rotation matrix."""
    c, s = E[0, 0] + E[1, 1], E[1, 0] - E[0, 1]
    out, n = np.eye(3), np.hypot(c, s)
    if n > 0.0:
        out[0, 0] = out[1, 1] = c / n
        out[1, 0], out[0, 1] = s / n, -s / n
    return out


@compiled
def heading_last(correction: Array, turn: Array, level: int, at: int) -> Array:
    """Return the correction (n,) that moves the mean: a unit whose rotation is at the row `at` is tilted first.

    Then it turns by its heading, S(psi) Exp(tau): its errors of tilt tau turn by psi, in `displacement_columns`.
    """
    if level == 0:
        return correction
    d, tilt, heading, whole = correction.copy(), np.zeros(3), np.zeros(3), np.empty(3)
    tilt[0], tilt[1], heading[2] = d[at], d[at + 1], d[at + 2]
    for a in range(3):
        whole[a] = turn[len(turn) - 3 + a]
    own = log(multiply(exp(-whole), multiply(exp(heading), exp(tilt))))
    for a in range(3):
        d[at + a] = whole[a] + own[a]
    return d


@compiled
def extend_rows(index: Index, table: Table, head: int, rows: Index) -> tuple[Index, Table]:
    """Return the rows of P and the atoms of an observed block that has further rows of P behind those of its head."""
    k, out, moved = len(rows), np.empty(len(index) + len(rows), np.int64), table.copy()
    for i in range(len(out)):
        out[i] = index[i] if i < head else rows[i - head] if i < head + k else index[i - k]
    for i in range(len(table)):
        if table[i, 2] >= head:
            moved[i, 2] += k
    return out, moved


@compiled
def turning_rows(table: Table, sizes: tuple[int, int, int, int, int, int], H: Array) -> Turning:
    """Return the rows of the observed block that turn the map: of the pose (axes,), of a mount, of other units.

    The map turns with the sensor that observes it, so with its mount (1 or 3 rows, if it is in the map).  A second
    block that is no mount turns nothing, nor does one of a sensor that measures no directions: the columns of its
    rotation in H are zero.  The rows of the mount's position (2 or 3) follow, the lever arm.
    """
    pose, head, axes, behind, others, _ = sizes
    dof, turns, last = (3, 1, 4) if pose == 3 else (6, 3, 5)  # last: of the atoms of a pose and a mount
    first, arm = 2 * dof - turns, dof - turns
    if head <= pose or table[2, 0] != SCALAR or table[last, 0] != (ANGLE if pose == 3 else TURNED):
        turns = arm = 0
    else:
        most = turning = 0.0
        for i in range(len(H)):
            for j in range(H.shape[1]):
                most = max(most, abs(H[i, j]))
                if first <= j < 2 * dof:
                    turning = max(turning, abs(H[i, j]))
        if turning <= BLIND * most:
            turns = 0
    rows, k = np.empty(axes + turns + arm + others, np.int64), 0
    for start, count in ((dof - axes, axes), (first, turns), (dof, arm), (behind, others)):
        for i in range(count):
            rows[k] = start + i
            k += 1
    return rows, turns, arm


@compiled
def rotation_at(x: Array, at: int, axes: int) -> Array:
    """Return R_r of the rotation of the pose at this place of a mean x: (3, 3) in space, (1, 1) in the plane."""
    if axes == 1:
        return np.eye(1)
    q = np.empty(4)
    for i in range(4):
        q[i] = x[at + 3 + i]
    return matrix(q)


@compiled
def gauge(mean: Array, correction: Array, turning: Turning, axes: int) -> Array:
    """Return the motion of the gauge (axes,), d_theta or (xi_p, d_theta), in a correction of the head.

    The observing robot's pose comes first in `mean` and in `correction`.
    """
    rows, turns, _ = turning
    turn = np.empty(axes)
    for a in range(axes):
        turn[a] = correction[rows[a]]
    if turns > 0:  # of the sensor: d_theta + R_r d_theta_s
        R = rotation_at(mean, 0, axes)
        for a in range(turns):
            for c in range(turns):
                turn[axes - turns + a] += R[a, c] * correction[rows[axes + c]]
    if axes == 6:  # xi_p = d_p - generator_p d_theta
        turn[0] += mean[1] * turn[5] - mean[2] * turn[4]
        turn[1] += mean[2] * turn[3] - mean[0] * turn[5]
        turn[2] += mean[0] * turn[4] - mean[1] * turn[3]
    return turn


@compiled
def regression_on_units(
    B: Array, index: Index, atoms: Table, turning: Turning, axes: int, R: Array, rays: bool
) -> Array:
    """Return L (n, m): linear regression of each vector of some atoms on the m rows of a mount and of other units.

    `B` (k, n) are the rows of P, before the correction, of all rows that turn; `index` are these rows, R that of the
    robot's rotation.  The sensor's rotation is among the regressors, without a column of L.  On a mount that turns
    the map only the position of its own robot depends, and with `rays` in the map no vector: their parallaxes are
    relative to that position.
    """
    _rows, turns, arm = turning
    m, (t, s) = len(index) - axes, (1, 2) if axes == 1 else (3, 3)
    L, robot = np.zeros((B.shape[1], m)), index[axes - t]
    if m == 0:
        return L
    W = inverse_covariance(B, index, axes - t)
    for c in range(turns):  # dependence on the robot's rotation is that on the sensor's, d_theta + R_r d_theta_s
        for a in range(t):
            for b in range(t + m):
                W[t + c, b] -= R[a, c] * W[a, b]
    for a in range(len(atoms)):
        for j in range(atoms[a, 2], atoms[a, 2] + vectors(atoms[a, 0])):
            for c in range(0 if turns == 0 or (robot - s <= j < robot and not rays) else turns + arm, m):
                for b in range(t + m):
                    L[j, c] += W[t + c, b] * B[axes - t + b, j]
    return L


@compiled
def inverse_covariance(B: Array, index: Index, first: int) -> Array:
    """Return S^-1 of the covariance S of the rows B of P from `first` on, at `index`; 0 where S is singular."""
    S = np.empty((len(index) - first, len(index) - first))
    for i in range(len(S)):
        for j in range(len(S)):
            S[i, j] = B[first + i, index[first + j]]
        S[i, i] += RAISED * max(S[i, i], 1.0)
    M, positive = cholesky_inverse(S)
    return product(np.ascontiguousarray(M.T), M) if positive else np.zeros(S.shape)


@compiled
def vectors(kind: int) -> int:
    """Return how many leading numbers of an atom are vectors of the world that may depend on rows that turn."""
    return 2 if kind == VECTOR else 0 if kind < 0 or kind == OWN else LINEAR[kind]


@compiled
def rotation_of(turn: Array) -> tuple[Array, Array]:
    """Return V and E of a turn: (1,) in the plane, in space the last three of (3,) or (6,)."""
    if len(turn) > 1:
        whole = turn[len(turn) - 3 :].copy()
        return left_jacobian(whole), matrix(exp(whole))
    V, E = np.empty((2, 2)), np.empty((2, 2))
    V[0, 0], V[1, 0] = exponential_v(turn[0])
    E[0, 0], E[1, 0] = np.cos(turn[0]), np.sin(turn[0])
    V[1, 1], V[0, 1], E[1, 1], E[0, 1] = V[0, 0], -V[1, 0], E[0, 0], -E[1, 0]
    return V, E


@compiled
def turn_matrices(turn: Array, correction: Array, turning: Turning, axes: int) -> tuple[Array, Array, Array]:
    """Return E - 1 and W - V (m, s, s) of the m rows that others depend on, and their errors (m,) by a correction.

    A dependent part becomes E of it, and moves the mean by W, where a vector moves by V otherwise: V of the gauge's
    `turn`, E and W of the turn of the robot; that of another unit goes on from that of the gauge, and so does that of
    the robot where the map turns with its sensor.
    """
    rows, turns, arm = turning
    m, s = len(rows) - axes, 2 if axes == 1 else 3
    E, W, d = np.empty((m, s, s)), np.empty((m, s, s)), np.empty(m)
    if m == 0:
        return E, W, d
    t = 1 if axes == 1 else 3
    V, E_turn = rotation_of(turn)
    own, others = np.zeros(t), turns + arm
    E_c, W_c = E_turn, E_turn
    for c in range(m):
        axis = (c - others) % 3
        if c == 0 or (c >= others and axis == 0):
            at = axes - t if c < others else axes + c
            for a in range(t):
                own[a] = correction[rows[at + a]] - turn[axes - t + a]
            V_own, E_own = rotation_of(own)
            E_c, W_c = product(E_turn, E_own), product(E_turn, V_own)
        d[c] = own[axis] if c >= others else correction[rows[axes + c]]
        for a in range(s):
            for b in range(s):
                E[c, a, b] = E_c[a, b] - (1.0 if a == b else 0.0)
                W[c, a, b] = (E_c[a, b] if turns <= c < others else W_c[a, b]) - V[a, b]
    return E, W, d


@compiled
def carry(atoms: Table, x: Array, L: Array, W: Array, d: Array) -> None:
    """Move the vectors of a mean x by a correction d (m,) of the rows that they depend on by L (n, m)."""
    s = W.shape[1]
    for i in range(len(atoms)):
        at, k = atoms[i, 1], atoms[i, 2]
        for v in range(0, vectors(atoms[i, 0]), s):
            for c in range(len(d)):
                for a in range(s):
                    for b in range(s):
                        x[at + v + a] += W[c, a, b] * L[k + v + b, c] * d[c]


@compiled
def displacement_columns(
    atoms: Table, now: Array, then: Array, L: Array, E: Array, d: Array, turning: Turning, index: Index, R: Array,
    R_now: Array, level: int,
) -> Array:  # fmt: skip
    """Return the columns (n, rows that turn) by which errors change from a mean to a corrected one.

    `now` and `then` (n, axes) are the generators there, `index` the rows that turn, R and R_now those of the robot's
    rotation, before and now, d (m,) the correction of the rows that others depend on.  The errors of tilt of a unit
    whose gravity is known, `level`, turn with its heading.
    """
    _rows, turns, arm = turning
    n, axes = now.shape
    first = axes + turns
    out = np.zeros((n, len(index)))
    for i in range(n):
        for a in range(axes):
            out[i, a] = now[i, a] - then[i, a]
    L = add_arm(out, L, d, axes, turns)
    apply_regression(out, atoms, L, E, axes, first + arm, index)
    for i in range(n):  # other units turn by d_theta_r - d_theta
        for c in range(first + arm, len(index)):
            out[i, axes - 3 + (c - first - arm) % 3] -= out[i, c]
    for c in range(turns):  # a mount moves all as d_theta does, but the robot's own rotation by -R_r
        for a in range(turns):
            for i in range(n):
                out[i, axes + c] += out[i, axes - turns + a] * R[a, c]
            out[index[axes - turns + a], axes + c] -= R_now[a, c] - R[a, c]
    if level:
        E_z = about_vertical(product(R_now, np.ascontiguousarray(R.T)))
        for a in range(3):
            for b in range(3):
                out[index[axes - 3 + a], axes - 3 + b] += E_z[a, b] - (1.0 if a == b else 0.0)
    return out


@compiled
def add_arm(out: Array, L: Array, d: Array, axes: int, turns: int) -> Array:
    """Return L of a mount's rotation with its arm as corrected, by d (m,): L_a x d_a more, which is added to `out`."""
    L = L.copy() if turns else L
    for i in range(len(L) if turns else 0):
        for c in range(turns):
            a, b = (turns, turns + 1) if turns == 1 else (turns + (c + 1) % 3, turns + (c + 2) % 3)
            more = L[i, a] * d[b] - L[i, b] * d[a]
            L[i, c] += more
            out[i, axes + c] += more
    return L


@compiled
def apply_regression(out: Array, atoms: Table, L: Array, E: Array, axes: int, others: int, index: Index) -> None:
    """Set the last columns of `out` (n, .), those of a mount and from `others` on of other units, to (E - 1) L.

    A vector of a unit's own turns with it by its generator, in the first columns, whatever it depends on.
    """
    m, s, rotation = L.shape[1], E.shape[1], -1
    first = out.shape[1] - m
    for i in range(len(atoms) if m else 0):
        kind, k = atoms[i, 0], atoms[i, 2]
        for v in range(0, vectors(kind), s):
            for c in range(m):
                for a in range(s):
                    for b in range(s):
                        out[k + v + a, first + c] += E[c, a, b] * L[k + v + b, c]
        rotation = k if kind == ROTATION else rotation
        for c in range(others if kind == OWN else len(index), len(index), 3):
            for a in range(3 if index[c] == rotation else 0):
                for b in range(3):
                    out[k + a, c + b] = out[k + a, axes - 3 + b]
