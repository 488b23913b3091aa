"""How blocks of a postponed map are read together, those at rest where they are."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import numpy.typing as npt

from kalmark.compiled import compiled
from kalmark.filter import kernels
from kalmark.filter.map import P_SIZE, StochasticMap
from kalmark.geometry.spaces import Table

if TYPE_CHECKING:
    from kalmark.filter.postponed import PostponedMap

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]


class Resting(NamedTuple):
    """Blocks at rest, laid out one after the other: their tables and means x there, their Jacobian G in
    `_resting_rows`, and their rows of the storage.
    """

    blocks: Table
    atoms: Table
    x: Array
    G: Array
    rows: Index


@compiled
def laid_out(blocks: Table, atoms: Table) -> tuple[Table, Table, Index, Index]:
    """Return the tables of these blocks, one after the other, and the numbers and rows they had before."""
    own, table = np.empty_like(blocks), np.empty((blocks[:, 5].sum(), 3), np.int64)
    numbers, rows = np.empty(blocks[:, 1].sum(), np.int64), np.empty(blocks[:, 3].sum(), np.int64)
    x_to = p_to = atom_to = 0
    for k in range(len(blocks)):
        x_at, x_size, p_at, p_size, atom_at, count = blocks[k]
        own[k, 0], own[k, 1], own[k, 2], own[k, 3], own[k, 4], own[k, 5] = x_to, x_size, p_to, p_size, atom_to, count
        for i in range(x_size):
            numbers[x_to + i] = x_at + i
        for i in range(p_size):
            rows[p_to + i] = p_at + i
        for i in range(count):
            kind, x, p = atoms[atom_at + i]
            table[atom_to + i, 0], table[atom_to + i, 1], table[atom_to + i, 2] = kind, x - x_at + x_to, p - p_at + p_to
        x_to, p_to, atom_to = x_to + x_size, p_to + p_size, atom_to + count
    return own, table, numbers, rows


def resting(map_: PostponedMap, slots: Index) -> Resting:
    """Return blocks at rest as they are now, all carried along at once."""
    for slot in slots.tolist() if map_._job is not None else ():
        map_._job.know(slot)  # type: ignore[union-attr]
    blocks, atoms, numbers, rows = laid_out(map_.blocks[slots], map_.atoms)
    G = map_._read(rows, map_._A0)
    now = map_._way().carried(atoms, map_.x[numbers], G)
    return Resting(blocks, atoms, now.x, np.hstack([G, now.a]), rows)


def places(map_: PostponedMap, slots: Index, d: int) -> Array:
    """Return the first d numbers (K, d) of blocks at rest."""
    now = resting(map_, slots)
    return now.x[now.blocks[:, :1] + np.arange(d)]


def joint(map_: PostponedMap, slots: Sequence[int]) -> Array:
    """Return the joint covariance of blocks, in the order given."""
    rests = {slot: slot not in map_._owners for slot in slots}
    if not any(rests.values()):
        return kernels.submatrix(map_.active.P, _active_rows(map_, slots))
    order = sorted(rests, key=lambda slot: rests[slot])  # those at rest last
    asleep = np.array([slot for slot in order if rests[slot]], dtype=np.int64)
    P = _joint(map_, _active_rows(map_, [slot for slot in order if not rests[slot]]), resting(map_, asleep))
    ends = np.cumsum([map_.blocks[slot, P_SIZE] for slot in order])
    rows = {slot: np.arange(end - map_.blocks[slot, P_SIZE], end) for slot, end in zip(order, ends, strict=True)}
    return kernels.submatrix(P, np.concatenate([rows[slot] for slot in slots]))


def _active_rows(map_: PostponedMap, slots: Sequence[int]) -> Index:
    rows = [map_.active.rows(map_._owners[slot]) for slot in slots]
    return np.concatenate(rows) if rows else np.zeros(0, dtype=np.int64)


def _joint(map_: PostponedMap, own: Index, rest: Resting) -> Array:
    """Return the joint covariance of the active rows `own` and of blocks at rest: P_BA = G P, P_BB = G P G' + Q."""
    extra = map_._resting_rows()
    e, n = len(extra), len(own)
    S = kernels.submatrix(map_.active.P, np.concatenate([extra, own]))
    B = rest.G @ S[:e]
    C = B[:, :e] @ rest.G.T + map_._read(rest.rows, rest.rows)
    P = np.empty((n + len(C), n + len(C)))
    P[:n, :n], P[n:, :n], P[:n, n:], P[n:, n:] = S[e:, e:], B[:, e:], B[:, e:].T, 0.5 * (C + C.T)
    return P


def excerpt(map_: PostponedMap, robot: int, mount: int, slots: Index) -> tuple[StochasticMap, int, int, Index]:
    """Return a dense map to read these blocks from, and their slots there: the active one if all are there."""
    at, head = map_._at[slots], [robot] if mount < 0 else [robot, mount]
    if (not len(at) or at.min() >= 0) and all(slot in map_._owners for slot in head):
        return map_.active, map_._owners[robot], map_._owners.get(mount, -1), at
    copied = np.array(list(dict.fromkeys([*head, *slots.tolist()])), dtype=np.int64)
    is_at_rest = map_.is_at_rest(copied)
    awake, rest = copied[~is_at_rest], resting(map_, copied[is_at_rest])
    blocks, atoms, numbers, rows = laid_out(map_.active.blocks[map_._at[awake]], map_.active.atoms)
    moved = np.array([len(numbers), 0, len(rows), 0, len(atoms), 0])
    m = StochasticMap.of(
        np.concatenate([map_.active.x[numbers], rest.x]),
        _joint(map_, rows, rest),
        np.concatenate([blocks, rest.blocks + moved]),
        np.concatenate([atoms, rest.atoms + np.array([0, len(numbers), len(rows)])]),
        map_.axes,
    )
    here = dict(zip([*awake.tolist(), *copied[is_at_rest].tolist()], range(len(copied)), strict=True))
    return m, here[robot], here.get(mount, -1), np.array([here[slot] for slot in slots.tolist()], dtype=np.int64)
