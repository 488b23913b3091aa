"""Correct inverse distances through the parallax they stand for.  docs/bearing_only.md.

An anchored landmark is seen along m - rho t, t = s - a the way from its anchor a to the sensor s: pictures measure the
parallax q = rho n, n = sqrt(|t|^2 + c2), not rho.  They do not determine the scale of map and motion, which moves s and
a along straight lines but rho along a hyperbola, so that a plain correction of rho takes the gap for information on the
scale.  Here it is the error of the parallax, d_q = n d_rho + g.(d_s - d_a) with g = rho t / n, that a correction adds
to q and that keeps its meaning from x- to x+, just as xi does.  c2 = trace Cov(t) at the prediction: where the baseline
is less than its own uncertainty, rho is corrected as it is.  In space an anchor is an atom ANCHOR, in the plane the
vector that a block with RHO begins with.

`inverse_distance_table` has the rows (rho's place in x and in P, its anchor's place in x and in P).  The sensor is at
s, (2 or 3,), with the Jacobian S (., h) in the head: the robot's pose and, if it is in the map, the mount.
"""

from __future__ import annotations

import numpy as np

from kalmark.arrays import Array, Index
from kalmark.compiled import address_of, by_address, compiled, signature_of
from kalmark.filter.kernels import quadratic, submatrix, take_rows
from kalmark.geometry.spaces import ANCHOR, KIND, P_AT, RHO, VECTOR, X_AT, Table

Baselines = tuple[Table, Array, Array, Array]  # of the anchored at the prediction: table, s, S, c2
RHO_X, RHO_P, ANCHOR_X, ANCHOR_P = range(4)

BASELINES = "Tuple((i8[:, ::1], f8[::1], f8[:, ::1], f8[::1]))"
SPREAD = signature_of("f8[::1](f8[:, ::1], i8[::1], f8[::1], f8[::1], f8[:, ::1], i8[:, ::1])")
RETRACT = signature_of(f"none(f8[::1], f8[::1], {BASELINES}, f8[::1], f8[::1], f8[::1])")
CARRY_BACK = signature_of(f"none(f8[:, ::1], f8[::1], f8[::1], {BASELINES}, f8[::1], f8[:, ::1])")
TRANSPORT = signature_of(f"none(f8[:, ::1], i8, i8[::1], f8[::1], f8[::1], {BASELINES}, f8[::1], f8[:, ::1])")
call_spread, call_retract = by_address(SPREAD), by_address(RETRACT)
call_carry_back, call_transport = by_address(CARRY_BACK), by_address(TRANSPORT)


def addresses() -> tuple[int, int, int, int]:
    """Return the addresses of the four functions below that are called by address, compiled now."""
    return (
        address_of(baseline_variances, SPREAD), address_of(retract_parallax, RETRACT),
        address_of(carry_back, CARRY_BACK), address_of(transport_parallax, TRANSPORT),
    )  # fmt: skip


@compiled
def inverse_distance_table(atoms: Table) -> Table:
    """Return the table (N, 4) of the inverse distances among the atoms; an anchor counts for all that follow it."""
    rows = np.empty((len(atoms), 4), np.int64)
    count = anchor = 0
    for i in range(len(atoms)):
        if atoms[i, KIND] == ANCHOR or atoms[i, KIND] == VECTOR:
            anchor = i
        elif atoms[i, KIND] == RHO:
            rows[count, RHO_X], rows[count, RHO_P] = atoms[i, X_AT], atoms[i, P_AT]
            rows[count, ANCHOR_X], rows[count, ANCHOR_P] = atoms[anchor, X_AT], atoms[anchor, P_AT]
            count += 1
    return rows[:count]


@compiled
def baseline_variances(P: Array, head: Index, x: Array, s: Array, S: Array, table: Table) -> Array:
    """Return c2 = trace Cov(s - a) of each row of the table; `head` are the rows of P of the head.

    In the plane it is that of t without its turn with the robot's heading, which does not change its length.
    """
    size, h = S.shape
    c2, rows, D = np.empty(len(table)), np.empty(h + size, np.int64), np.zeros((size, h + size))
    for j in range(h):
        rows[j] = head[j]
    for a in range(size):
        D[a, h + a] = -1.0
    for i in range(len(table)):
        for a in range(size):
            rows[h + a] = table[i, ANCHOR_P] + a
            for j in range(h):
                D[a, j] = S[a, j]
        if size == 2:
            at = table[i, ANCHOR_X]
            D[0, 2] += s[1] - x[at + 1]
            D[1, 2] -= s[0] - x[at]
        C = quadratic(D, submatrix(P, rows))
        c2[i] = 1e-12
        for a in range(size):
            c2[i] += C[a, a]
    return c2


@compiled
def baseline(s: Array, x: Array, at: int, c2: float) -> tuple[Array, float]:
    """Return the way t = s - a (2 or 3,) from the anchor, at `at` in x, to the sensor, and n = sqrt(|t|^2 + c2)."""
    t, n2 = np.empty(len(s)), c2
    for a in range(len(s)):
        t[a] = s[a] - x[at + a]
        n2 += t[a] * t[a]
    return t, np.sqrt(n2)


@compiled
def retract_parallax(x: Array, before: Array, baselines: Baselines, d: Array, d_head: Array, s_now: Array) -> None:
    """Set rho = (n rho + n d_rho + g.d_t) / n+ in place, x being the mean after, `before` the one before d."""
    table, s, S, c2 = baselines
    for i in range(len(table)):
        at, p, a, a_p = table[i, RHO_X], table[i, RHO_P], table[i, ANCHOR_X], table[i, ANCHOR_P]
        t, n = baseline(s, before, a, c2[i])
        along = 0.0  # t.d_t
        for j in range(len(s)):
            d_t = -d[a_p + j]
            for c in range(len(d_head)):
                d_t += S[j, c] * d_head[c]
            along += t[j] * d_t
        x[at] = (n * (before[at] + d[p]) + before[at] / n * along) / baseline(s_now, x, a, c2[i])[1]


@compiled
def inverse_distance_error_terms(before: Array, x: Array, baselines: Baselines, s_now: Array, S_now: Array) -> Array:
    """Return what rho's error at x is made of (N, h + 3 + 1): of the errors of head, anchor and rho.

    All errors are those at x, after the transport by the generator, but rho's own, which is the one before.
    """
    table, s, S, c2 = baselines
    size, h = S.shape
    pose, C = 6 if size == 3 else 3, np.zeros((len(table), h + size + 1))
    turns, turned = 3 if size == 3 else 1, np.zeros(3)
    mounted = False  # but the state of a robot
    if h >= 2 * pose:
        for j in range(size):
            mounted = mounted or S[j, pose] != 0.0
    for i in range(len(table)):
        at, a = table[i, RHO_X], table[i, ANCHOR_X]
        (g, n), (t, n_now) = baseline(s, before, a, c2[i]), baseline(s_now, x, a, c2[i])
        for j in range(size):
            g[j] *= before[at] / n
            g_now = x[at] / n_now * t[j]
            for c in range(h):
                C[i, c] += g[j] * (S_now[j, c] if c < pose else S[j, c]) - g_now * S_now[j, c]
            C[i, h + j] = g_now - g[j]
        for j in range(turns):  # g x t; in the plane, its third component
            k, l = ((j + 1) % 3, (j + 2) % 3) if size == 3 else (0, 1)
            turned[j] = g[k] * t[l] - g[l] * t[k]
            C[i, pose - turns + j] += turned[j]
        if mounted:  # the map turns with it, too: turning.turning_rows
            for j in range(turns):
                then = 0.0
                for b in range(size):
                    turned[j] += g[b] * S_now[b, pose - turns + j]
                    then += g[b] * S[b, pose - turns + j]
                for c in range(turns):  # S has R_r at the position of the mount
                    now_jc, then_jc = (S_now[j, pose + c], S[j, pose + c]) if size == 3 else (1.0, 1.0)
                    C[i, 2 * pose - turns + c] += turned[j] * now_jc - then * then_jc
        C[i, h + size] = n
        for c in range(h + size + 1):
            C[i, c] /= n_now
    return C


@compiled
def carry_back(H: Array, before: Array, x: Array, baselines: Baselines, s_now: Array, S_now: Array) -> None:
    """H <- H T in place, T the map of errors of `inverse_distance_error_terms`; the head is H's first columns."""
    table, head = baselines[0], S_now.shape[1]
    C = inverse_distance_error_terms(before, x, baselines, s_now, S_now)
    last = C.shape[1] - 1
    for i in range(len(table)):
        p, anchor = table[i, RHO_P], table[i, ANCHOR_P]
        for r in range(len(H)):
            h = H[r, p]
            for c in range(last):
                H[r, c if c < head else anchor + c - head] += h * C[i, c]
            H[r, p] = h * C[i, last]


@compiled
def add_combined(X: Array, i: int, C: Array, first: int, rows: Array) -> None:
    """Add the rows (k, n), weighted by the numbers of C[i] from `first` on, to X[i] (n,)."""
    for k in range(len(rows)):
        c = C[i, first + k]
        for j in range(rows.shape[1]):
            X[i, j] += c * rows[k, j]


@compiled
def transport_parallax(
    P: Array, n: int, head: Index, before: Array, x: Array, baselines: Baselines, s_now: Array, S_now: Array
) -> None:  # fmt: skip
    """P <- T P T' in place, on the lower triangle: one row and one column of each inverse distance.  O(N n).

    T is the map of errors that `inverse_distance_error_terms` describes.
    """
    table, C = baselines[0], inverse_distance_error_terms(before, x, baselines, s_now, S_now)
    h, count = len(head), len(table)
    size = C.shape[1] - h - 1
    X = np.zeros((count, n))  # (T - I) P at the rows of rho
    common, own = take_rows(P, head, n), np.empty(size + 1, np.int64)
    for i in range(count):
        for k in range(size):
            own[k] = table[i, ANCHOR_P] + k
        own[size] = table[i, RHO_P]
        rows = take_rows(P, own, n)
        C[i, h + size] -= 1.0
        add_combined(X, i, C, 0, common)
        add_combined(X, i, C, h, rows)
    for i in range(count):
        p = table[i, RHO_P]
        for j in range(p + 1):
            P[p, j] += X[i, j]
        for j in range(p, n):
            P[j, p] += X[i, j]
    for j in range(count):  # (T - I) P (T - I)'
        for i in range(count):
            a, b = table[i, RHO_P], table[j, RHO_P]
            for k in range(h + size + 1 if a >= b else 0):
                at = head[k] if k < h else (b if k == h + size else table[j, ANCHOR_P] + k - h)
                P[a, b] += X[i, at] * C[j, k]
