"""Joint reads of active and inactive blocks: the arrays alone."""

from __future__ import annotations

import numpy as np

from kalmark.arrays import Array, Index
from kalmark.compiled import compiled
from kalmark.filter import kernels
from kalmark.filter.compressed.immediate import transport_mean
from kalmark.filter.layout import concatenate_tables
from kalmark.geometry.spaces import Table


@compiled
def carried_along(
    atoms: Table, x: Array, C: Array, S: Array, U: Array, robots: Index, turn: Array, turns: Array, origins: Array,
    axes: int,
) -> tuple[Array, Array, Array, Array]:  # fmt: skip
    """Return inactive blocks as they are now: x, G, Q, and their means after the last immediate correction.

    G is their Jacobian in the auxiliary states and all turns, Q their covariance besides.  C is the stored covariance
    with the auxiliary states and, behind that, their own; all from S on are `Displacements`.
    """
    count = C.shape[1] - len(C)
    G = C[:, :count].copy()
    x, x_left, a = transport_mean(atoms, x, G, S, U, robots, turn, turns, origins, axes)
    return x, np.concatenate((G, a), axis=1), C[:, count:].copy(), x_left


@compiled
def split_active(at: Index, slots: Index) -> tuple[Index, Index, Index]:
    """Return of blocks those that are active, by their slots in the active map, and the inactive ones, each once.

    And the place (K,) of each where active ones come first; a slot of -1 is none.
    """
    own, rest, here = np.empty(len(slots), np.int64), np.empty(len(slots), np.int64), np.full(len(slots), -1)
    n = m = 0
    for k in range(len(slots)):
        if slots[k] < 0:
            continue
        active = at[slots[k]] >= 0
        some, number, count = (own, at[slots[k]], n) if active else (rest, slots[k], m)
        i = 0
        while i < count and some[i] != number:
            i += 1
        if i == count:
            some[i] = number
            n, m = (n + 1, m) if active else (n, m + 1)
        here[k] = i if active else -2 - i
    for k in range(len(slots)):
        if here[k] < -1:
            here[k] = n - 2 - here[k]
    return own[:n].copy(), rest[:m].copy(), here


@compiled
def joint_marginal(
    x: Array, P: Array, blocks: Table, atoms: Table, extra: Index,
    blocks_B: Table, atoms_B: Table, x_B: Array, C: Array,
    S: Array, U: Array, robots: Index, turn: Array, turns: Array, origins: Array, axes: int,
) -> tuple[Array, Array, Table, Table]:  # fmt: skip
    """Return mean, covariance and tables of some active blocks, followed by inactive blocks B as they are stored.

    P_BA = G P, P_BB = G P G' + Q, where G is in the rows `extra` of P.
    """
    x_B, G, Q, _ = carried_along(atoms_B, x_B, C, S, U, robots, turn, turns, origins, axes)
    own, table, numbers, rows = concatenate_tables(blocks, atoms)
    e, n, b, a = len(extra), len(rows), len(own), len(table)
    P_own = kernels.submatrix(P, np.concatenate((extra, rows)))
    B = G @ P_own[:e]
    joint = np.empty((n + len(G), n + len(G)))
    joint[:n, :n], joint[n:, :n], joint[:n, n:] = P_own[e:, e:], B[:, e:], B[:, e:].T
    P_BB = np.ascontiguousarray(B[:, :e]) @ G.T + Q
    joint[n:, n:] = 0.5 * (P_BB + P_BB.T)
    own, table = np.concatenate((own, blocks_B)), np.concatenate((table, atoms_B))
    own[b:, 0] += len(numbers)
    own[b:, 2] += n
    own[b:, 4] += a
    table[a:, 1] += len(numbers)
    table[a:, 2] += n
    return np.concatenate((x[numbers], x_B)), joint, own, table
