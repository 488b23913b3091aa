"""How far blocks at rest are from where the coordinates of their errors were left, as told by those that are not.

A block at rest moves with the blocks that have entered the active map, and with where the robots were when it came to
rest: by a correction that is a regression on theirs.  Theirs is looked at, in units of their sigmas at that time.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from kalmark.compiled import compiled
from kalmark.geometry.spaces import DIRECTION, ERROR_SIZE, HOMOGENEOUS, MEAN_SIZE, VECTOR, VECTOR3, Space

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]


class Watch(NamedTuple):
    """Numbers of a block in the active map, where they were at rest, and one over their sigmas."""

    at: Index
    frozen: Array
    per_sigma: Array


@compiled
def farthest(x: Array, at: Index, frozen: Array, per_sigma: Array) -> float:
    """Return how far the numbers `at` are from where they were, in sigmas."""
    most = 0.0
    for i in range(len(at)):
        most = max(most, abs(x[at[i]] - frozen[i]) * per_sigma[i])
    return most


class Drift:
    """Watches the blocks that have entered."""

    def __init__(self) -> None:
        self._standing: dict[int, Watch] = {}
        self._moving: dict[int, tuple[Index, Array]] = {}  # of robots, rows of their positions, and one over the sigmas
        self._all: Watch | None = None
        self._rest: dict[int, Array] = {}  # of moving robots, their covariance with the blocks that have entered

    def watch(self, slot: int, space: Space, at: int, frozen: Array, variances: Array) -> None:
        """Watch those numbers of a block, `at` and further in the active map, on which its coordinates depend."""
        where: list[int] = []
        per_sigma: list[float] = []
        for kind, offset, row in space.atoms.tolist():
            if kind in (VECTOR, VECTOR3, DIRECTION) or kind >= HOMOGENEOUS:
                sigma = math.sqrt(max(0.0, variances[row : row + ERROR_SIZE[kind]].sum()))
                where += range(offset, offset + int(MEAN_SIZE[kind]))
                per_sigma += [1.0 / sigma if sigma > 0 else 0.0] * int(MEAN_SIZE[kind])
        if where:
            index = np.array(where)
            self._standing[slot] = Watch(index + at, frozen[index], np.array(per_sigma))
            self._all = None

    @property
    def moving(self) -> list[int]:
        """The blocks that move by themselves."""
        return [*self._moving]

    def stands(self, slot: int) -> bool:
        """Return whether a block is watched that has not moved by itself."""
        return slot in self._standing

    def forget(self, slot: int) -> None:
        """Watch a block no longer."""
        if self._standing.pop(slot, None) is not None:
            self._all = None

    def moves(self, slot: int, rows: Index) -> None:
        """Take note that a block moves by itself, so that only its position at rest, those rows, tells anything."""
        watch = self._standing.get(slot)
        if watch is not None:
            self.forget(slot)
            self._moving[slot] = rows, watch.per_sigma[: len(rows)]

    def is_beyond(self, limit: float, x: Array, s: Array, read: Callable[[Index, int], Array]) -> bool:
        """Return whether a block is farther than `limit` sigmas from where it was.

        x is the mean of the active map, s that of its shadows; `read` returns rows' covariance at rest with the shadows
        from a first one on.
        """
        if self._all is None and self._standing:
            self._all = Watch(*(np.concatenate(parts) for parts in zip(*self._standing.values(), strict=True)))
        if self._all is not None and self._standing and farthest(x, *self._all) > limit:
            return True
        for slot, (rows, per_sigma) in self._moving.items():
            G = self._rest.get(slot)
            if G is None:
                G = self._rest[slot] = read(rows, 0)
            elif G.shape[1] < len(s):
                G = self._rest[slot] = np.hstack([G, read(rows, G.shape[1])])
            if (np.abs(G @ s) * per_sigma).max() > limit:
                return True
        return False
