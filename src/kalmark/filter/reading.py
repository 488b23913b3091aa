"""How blocks of a postponed map are read together, those at rest where they are."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import numpy.typing as npt

from kalmark.filter import kernels
from kalmark.filter.map import ATOM_AT, ATOMS, P_AT, P_SIZE, X_AT, X_SIZE, StochasticMap

if TYPE_CHECKING:
    from kalmark.filter.postponed import PostponedMap

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]
NO_ROWS = np.zeros(0, dtype=np.int64)


class Resting(NamedTuple):
    """Blocks at rest, one after the other: their means x, where each begins there (K,), their Jacobian G in
    `_resting_rows`, and their rows of the storage.
    """

    x: Array
    first: Index
    G: Array
    rows: Index


def resting(map_: PostponedMap, slots: Index) -> Resting:
    """Return blocks at rest as they are now, all carried along at once."""
    for slot in slots.tolist() if map_._job is not None else ():
        map_._job.know(slot)  # type: ignore[union-attr]
    b = map_.blocks[slots]
    spans = ((X_AT, X_SIZE), (P_AT, P_SIZE), (ATOM_AT, ATOMS))
    numbers, rows, atoms = (_spans(b[:, at], b[:, count]) for at, count in spans)
    first, first_row = (np.cumsum(b[:, count]) - b[:, count] for count in (X_SIZE, P_SIZE))
    moved = np.column_stack([np.zeros_like(first), first - b[:, X_AT], first_row - b[:, P_AT]])
    table = map_.atoms[atoms] + np.repeat(moved, b[:, ATOMS], axis=0)
    G = map_._read(rows, map_._A0)
    now = map_._way().carried(table, map_.x[numbers], G)
    return Resting(now.x, first, np.hstack([G, now.a]), rows)


def _spans(first: Index, count: Index) -> Index:
    """Return first[0], first[0] + 1, ..., so many of each."""
    return np.repeat(first - np.cumsum(count) + count, count) + np.arange(count.sum())


def places(map_: PostponedMap, slots: Index, d: int) -> Array:
    """Return the first d numbers (K, d) of blocks at rest."""
    now = resting(map_, slots)
    return now.x[now.first[:, None] + np.arange(d)]


def joint(map_: PostponedMap, slots: Sequence[int]) -> Array:
    """Return the joint covariance of blocks, in the order given."""
    at_rest = np.array([slot for slot in dict.fromkeys(slots) if slot not in map_._owners], dtype=np.int64)
    if not len(at_rest):
        rows = [map_.active.rows(map_._owners[slot]) for slot in slots]
        return kernels.submatrix(map_.active.P, np.concatenate([NO_ROWS, *rows]))
    return _joint(map_, slots, resting(map_, at_rest), at_rest)


def _joint(map_: PostponedMap, slots: Sequence[int], rest: Resting, at_rest: Index) -> Array:
    """Return the joint covariance of blocks of which some, `at_rest`, are not active: P = T P_active T' + Q."""
    m, sizes = map_.active, [map_.blocks[slot, P_SIZE] for slot in slots]
    starts = np.cumsum([0, *sizes])
    extra = map_._resting_rows()
    own = [m.rows(map_._owners[slot]) if slot in map_._owners else NO_ROWS for slot in slots]
    index, place = np.concatenate([extra, *own]), len(extra)
    T = np.zeros((starts[-1], len(index)))
    first = dict(
        zip(at_rest.tolist(), np.cumsum(map_.blocks[at_rest, P_SIZE]) - map_.blocks[at_rest, P_SIZE], strict=True)
    )
    here, there = [], []  # the rows of what is at rest, in the result and in `rest`
    for i, slot in enumerate(slots):
        rows = np.arange(starts[i], starts[i + 1])
        if slot in first:
            here.append(rows)
            there.append(first[slot] + np.arange(len(rows)))
        else:
            T[rows, place + np.arange(len(rows))] = 1.0
            place += len(rows)
    to, of = np.concatenate(here), np.concatenate(there)
    T[to, : len(extra)] = rest.G[of]
    C = T @ (kernels.submatrix(m.P, index) @ T.T)
    C[np.ix_(to, to)] += map_._read(rest.rows[of], rest.rows[of])
    return 0.5 * (C + C.T)


def excerpt(map_: PostponedMap, robot: int, mount: int, slots: Index) -> tuple[StochasticMap, int, int, Index]:
    """Return a dense map to read these blocks from, and their slots there: the active one if all are there."""
    at = map_._at[slots]
    if robot in map_._owners and (mount < 0 or mount in map_._owners) and (not len(at) or at.min() >= 0):
        return map_.active, map_._owners[robot], map_._owners.get(mount, -1), at
    copied, m = dict.fromkeys([robot, *([mount] if mount >= 0 else []), *slots.tolist()]), StochasticMap()
    at_rest = np.array([slot for slot in copied if slot not in map_._owners], dtype=np.int64)
    rest = resting(map_, at_rest)
    means = dict(zip(at_rest.tolist(), np.split(rest.x, rest.first[1:]), strict=True))
    for slot in copied:
        copied[slot] = m.add(map_.spaces[slot], means[slot] if slot in means else map_.mean(slot))
    P = _joint(map_, list(copied), rest, at_rest)
    m.P[: m.n, : m.n], m.axes = P, map_.axes
    here = np.array([copied[slot] for slot in slots.tolist()], dtype=np.int64)
    return m, copied[robot], copied.get(mount, -1), here  # type: ignore[return-value]
