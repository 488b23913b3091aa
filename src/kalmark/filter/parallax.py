"""Correct inverse distances through the parallax they stand for.  docs/bearing_only.md.

An anchored landmark is seen along m - rho t, t = s - a the way from its anchor a to the sensor s: pictures measure the
parallax q = rho n, n = sqrt(|t|^2 + c2), not rho.  What they leave open, the scale of map and motion, moves s and a
along straight lines but rho along a hyperbola, so that a plain correction of rho reads the gap as news of the scale.
Here it is the error of the parallax, d_q = n d_rho + g.(d_s - d_a) with g = rho t / n, that a correction adds to q and
that keeps its meaning from x- to x+, just as xi does.  c2 = trace Cov(t) at the prediction: where the baseline is less
than its own uncertainty, rho is corrected as it is.  In space an anchor is an atom ANCHOR, in the plane the vector that
a block with RHO begins with.

A table of the `anchored` has the rows (rho's place in x and in P, its anchor's place in x and in P).  The sensor is
at s, (2 or 3,), with the Jacobian S (., h) in the head: the robot's pose and, if it is in the map, the mount.
"""

from __future__ import annotations

import numpy as np

from kalmark.arrays import Array, Index
from kalmark.compiled import address_of, by_address, compiled, signature_of
from kalmark.filter.kernels import rows_of, submatrix
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
    """Return the addresses of `spread`, `retract_parallax`, `carry_back` and `transport_parallax`, compiled now."""
    return (
        address_of(spread, SPREAD), address_of(retract_parallax, RETRACT), address_of(carry_back, CARRY_BACK),
        address_of(transport_parallax, TRANSPORT),
    )  # fmt: skip


@compiled
def anchored(atoms: Table) -> Table:
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
def spread(P: Array, head: Index, x: Array, s: Array, S: Array, table: Table) -> Array:
    """Return c2 = trace Cov(s - a) of each row of the table; `head` are the rows of P of the head.

    In the plane it is that of t without its turn with the robot's heading, which tells nothing of its length.
    """
    size, h = S.shape
    c2, rows, D = np.empty(len(table)), np.empty(h + size, np.int64), np.zeros((size, h + size))
    rows[:h] = head
    for i in range(len(table)):
        D[:, :h], D[:, h:] = S, -np.eye(size)
        if size == 2:
            a = table[i, ANCHOR_X]
            D[0, 2] += s[1] - x[a + 1]
            D[1, 2] -= s[0] - x[a]
        rows[h:] = np.arange(table[i, ANCHOR_P], table[i, ANCHOR_P] + size)
        c2[i] = np.trace(D @ submatrix(P, rows) @ D.T) + 1e-12
    return c2


@compiled
def retract_parallax(x: Array, before: Array, baselines: Baselines, d: Array, d_head: Array, s_now: Array) -> None:
    """Set rho = (n rho + n d_rho + g.d_t) / n+ in place, x being the mean after, `before` the one before d."""
    table, s, S, c2 = baselines
    size, d_s = len(s), S @ d_head
    for i in range(len(table)):
        at, p, a, a_p = table[i]
        t, t_now = s - before[a : a + size], s_now - x[a : a + size]
        n, n_now = np.sqrt((t * t).sum() + c2[i]), np.sqrt((t_now * t_now).sum() + c2[i])
        along = (t * (d_s - d[a_p : a_p + size])).sum()
        x[at] = (n * (before[at] + d[p]) + before[at] / n * along) / n_now


@compiled
def carried(before: Array, x: Array, baselines: Baselines, s_now: Array, S_now: Array) -> Array:
    """Return what rho's error at x is made of (N, h + 3 + 1): of the errors of head, anchor and rho.

    All errors are those at x, after the transport by the generator, but rho's own, which is the one before.
    """
    table, s, S, c2 = baselines
    size, h = S.shape
    C = np.empty((len(table), h + size + 1))
    for i in range(len(table)):
        at, _, a, _ = table[i]
        t, t_now = s - before[a : a + size], s_now - x[a : a + size]
        n, n_now = np.sqrt((t * t).sum() + c2[i]), np.sqrt((t_now * t_now).sum() + c2[i])
        g, g_now = before[at] / n * t, x[at] / n_now * t_now
        pose = 2 * size if size == 3 else 3
        C[i, :h] = g @ S - g_now @ S_now
        C[i, :pose] = ((g - g_now) @ S_now)[:pose]
        if size == 3:
            C[i, 3:6] += np.cross(g, t_now)
        else:
            C[i, 2] += g[0] * t_now[1] - g[1] * t_now[0]
        C[i, h : h + size] = g_now - g
        C[i, -1] = n
        C[i] /= n_now
    return C


@compiled
def carry_back(H: Array, before: Array, x: Array, baselines: Baselines, s_now: Array, S_now: Array) -> None:
    """H <- H T in place, T the map of errors that `carried` describes; the head is H's first columns."""
    table, head = baselines[0], S_now.shape[1]
    C = carried(before, x, baselines, s_now, S_now)
    last = C.shape[1] - 1
    for i in range(len(table)):
        p, anchor = table[i, RHO_P], table[i, ANCHOR_P]
        for r in range(len(H)):
            h = H[r, p]
            H[r, :head] += h * C[i, :head]
            H[r, anchor : anchor + last - head] += h * C[i, head:last]
            H[r, p] = h * C[i, last]


@compiled
def transport_parallax(
    P: Array, n: int, head: Index, before: Array, x: Array, baselines: Baselines, s_now: Array, S_now: Array
) -> None:  # fmt: skip
    """P <- T P T' in place, on the lower triangle: one row and one column of each inverse distance.  O(N n).

    T is the map of errors that `carried` describes.
    """
    table, C = baselines[0], carried(before, x, baselines, s_now, S_now)
    h, count = len(head), len(table)
    size = C.shape[1] - h - 1
    X = np.empty((count, n))  # (T - I) P at the rows of rho
    common = rows_of(P, head, n)
    for i in range(count):
        anchor = np.arange(table[i, ANCHOR_P], table[i, ANCHOR_P] + size)
        own = rows_of(P, table[i, RHO_P : RHO_P + 1], n)
        X[i] = C[i, :h] @ common + C[i, h : h + size] @ rows_of(P, anchor, n) + own[0] * (C[i, -1] - 1.0)
    D = np.empty((count, count))  # (T - I) P (T - I)'
    for i in range(count):
        for j in range(count):
            s = X[i, table[j, RHO_P]] * (C[j, -1] - 1.0)
            for k in range(h):
                s += X[i, head[k]] * C[j, k]
            for k in range(size):
                s += X[i, table[j, ANCHOR_P] + k] * C[j, h + k]
            D[i, j] = s
    for i in range(count):
        p = table[i, RHO_P]
        P[p, : p + 1] += X[i, : p + 1]
        P[p:n, p] += X[i, p:n]
    for i in range(count):
        for j in range(count):
            a, b = table[i, RHO_P], table[j, RHO_P]
            if a >= b:
                P[a, b] += D[i, j]
