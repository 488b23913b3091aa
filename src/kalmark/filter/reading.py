"""How blocks of a postponed map are read together, those at rest where they are."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from kalmark.filter import kernels
from kalmark.filter.map import ATOM_AT, ATOMS, P_AT, P_SIZE, X_AT, X_SIZE, StochasticMap

if TYPE_CHECKING:
    from kalmark.filter.postponed import PostponedMap

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]
NO_ROWS = np.zeros(0, dtype=np.int64)


def joint(map_: PostponedMap, slots: Sequence[int]) -> Array:
    """Return the joint covariance of blocks, in the order given."""
    ats = [map_._owners.get(slot) for slot in slots]
    if all(at is not None for at in ats):
        return kernels.submatrix(map_.active.P, np.concatenate([map_.active.rows(at) for at in ats]))  # type: ignore[arg-type]
    rows, extra = [map_.rows(slot) for slot in slots], map_._resting_rows()
    own = [NO_ROWS if at is None else map_.active.rows(at) for at in ats]
    index = np.concatenate([extra, *own])
    starts, place = np.cumsum([0, *(len(r) for r in rows)]), len(extra)
    T, Q = np.zeros((starts[-1], len(index))), np.zeros((starts[-1], starts[-1]))
    resting = [i for i, at in enumerate(ats) if at is None]
    if map_._job is not None:
        for i in resting:
            map_._job.know(slots[i])
    for i, slot in enumerate(slots):
        here = slice(starts[i], starts[i + 1])
        if i in resting:
            T[here, : len(extra)] = map_._preview(slot)[1]
            for j in resting:
                Q[here, starts[j] : starts[j + 1]] = map_._read(rows[i], rows[j])
        else:
            T[here, place : place + len(rows[i])] = np.eye(len(rows[i]))
            place += len(rows[i])
    C = T @ (kernels.submatrix(map_.active.P, index) @ T.T) + Q
    return 0.5 * (C + C.T)


def places(map_: PostponedMap, slots: Index, d: int) -> Array:
    """Return the first d numbers (K, d) of blocks at rest, all carried along at once."""
    for slot in slots.tolist() if map_._job is not None else ():
        map_._job.know(slot)  # type: ignore[union-attr]
    b = map_.blocks[slots]
    numbers, rows, atoms = (
        _spans(b[:, at], b[:, count]) for at, count in ((X_AT, X_SIZE), (P_AT, P_SIZE), (ATOM_AT, ATOMS))
    )
    first = np.cumsum(b[:, X_SIZE]) - b[:, X_SIZE]
    moved = np.column_stack(
        [np.zeros_like(first), first - b[:, X_AT], np.cumsum(b[:, P_SIZE]) - b[:, P_SIZE] - b[:, P_AT]]
    )
    table = map_.atoms[atoms] + np.repeat(moved, b[:, ATOMS], axis=0)
    now = map_._way().carried(table, map_.x[numbers], map_._read(rows, map_._A0))
    return now.x[first[:, None] + np.arange(d)]


def _spans(first: Index, count: Index) -> Index:
    """Return first[0], first[0] + 1, ..., so many of each."""
    return np.repeat(first - np.cumsum(count) + count, count) + np.arange(count.sum())


def excerpt(map_: PostponedMap, robot: int, mount: int, slots: Index) -> tuple[StochasticMap, int, int, Index]:
    """Return a dense map to read these blocks from, and their slots there: the active one if all are there."""
    at = map_._at[slots]
    if robot in map_._owners and (mount < 0 or mount in map_._owners) and (not len(at) or at.min() >= 0):
        return map_.active, map_._owners[robot], map_._owners.get(mount, -1), at
    copied, m = dict.fromkeys([robot, *([mount] if mount >= 0 else []), *slots.tolist()]), StochasticMap()
    for slot in copied:
        copied[slot] = m.add(map_.spaces[slot], map_.mean(slot))
    P = map_.covariance(list(copied))
    m.P[: m.n, : m.n], m.axes = P, map_.axes
    here = np.array([copied[slot] for slot in slots.tolist()], dtype=np.int64)
    return m, copied[robot], copied.get(mount, -1), here  # type: ignore[return-value]
