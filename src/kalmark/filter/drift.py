"""How far blocks at rest are from where the coordinates of their errors were left, as told by those that are not.

A block at rest moves with the blocks that have entered the active map, and with where the robots were when it came to
rest: by a correction that is a regression on theirs.  Theirs is looked at, in units of the sigmas they have now, or had
then where they move by themselves.
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


NO_NUMBERS = np.zeros(0)
NO_ROWS = np.zeros(0, dtype=np.int64)


TAU = 5e-4  # how far, in its sigmas and radians of heading, a block at rest may be from where its coordinates are,
SMALL = 5000  # in a map of so many rows at most; in a larger one farther by as much, since a flush costs more


def tolerance(n: int) -> float:
    """Return how far a block at rest may be from where its coordinates are, in a map of n rows."""
    return TAU * max(1.0, n / SMALL)


class Watch(NamedTuple):
    """Numbers of a block in the active map, and where they were at rest.

    And the first row of P of what each is part of, and how many rows that has.
    """

    at: Index
    frozen: Array
    first: Index
    size: Index


@compiled
def is_farther(
    P: Array, turn: Index, kept: Index, x: Array, kept_x: Index, at: Index, frozen: Array, first: Index, size: Index,
    G: Array, s: Array, per_sigma: Array, tau: float,
) -> bool:  # fmt: skip
    """Return whether a number is more than so many sigmas from where it was: of those that stand, or among G s.

    So many are tau over what is not known of the robot's turn since it was kept, or was corrected of it: `turn` and
    `kept` are the rows of P, `kept_x` the numbers of what was kept.
    """
    variance = 1e-300
    for i in range(len(turn)):
        variance += P[turn[i], turn[i]] + P[kept[i], kept[i]] - 2.0 * P[kept[i], turn[i]] + x[kept_x[i]] ** 2
    limit = tau / math.sqrt(variance)
    for i in range(len(at)):
        own = 0.0
        for j in range(first[i], first[i] + size[i]):
            own += P[j, j]
        if own > 0.0 and (x[at[i]] - frozen[i]) ** 2 > limit * limit * own:
            return True
    for i in range(len(per_sigma)):
        moved = 0.0
        for j in range(len(s)):
            moved += G[i, j] * s[j]
        if abs(moved) * per_sigma[i] > limit:
            return True
    return False


class Drift:
    """Watches the blocks that have entered."""

    def __init__(self) -> None:
        self._standing: dict[int, Watch] = {}
        self._at_rest: dict[int, Array] = {}  # one over the sigmas that they had there
        self._all: Watch | None = None
        self.moving: list[int] = []  # the blocks that move by themselves,
        self._rows: Index = NO_ROWS  # the rows of their positions,
        self._per_sigma: Array = NO_NUMBERS  # one over those sigmas,
        self._rest: Array | None = None  # and their covariance at rest with the blocks that have entered
        self._left: Array = NO_NUMBERS  # the shadows' mean when the coordinates were left

    def watch(self, slot: int, space: Space, at: int, first: int, frozen: Array, variances: Array) -> None:
        """Watch those numbers of a block on which its coordinates depend.

        They are `at` and further in the active map, their rows from `first` on; `variances` they had at rest.
        """
        where, rows, sizes, sigmas = list[int](), list[int](), list[int](), list[float]()
        for kind, offset, row in space.atoms.tolist():
            if kind in (VECTOR, VECTOR3, DIRECTION) or kind >= HOMOGENEOUS:
                count, size = int(MEAN_SIZE[kind]), int(ERROR_SIZE[kind])
                where += range(offset, offset + count)
                rows += [first + row] * count
                sizes += [size] * count
                sigmas += [math.sqrt(max(0.0, variances[row : row + size].sum()))] * count
        if where:
            index = np.array(where)
            self._standing[slot] = Watch(index + at, frozen[index], np.array(rows), np.array(sizes))
            self._at_rest[slot] = np.array([1.0 / sigma if sigma > 0 else 0.0 for sigma in sigmas])
            self._all = None

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
            self.moving.append(slot)
            self._rows = np.concatenate([self._rows, rows])
            self._per_sigma = np.concatenate([self._per_sigma, self._at_rest[slot][: len(rows)]])
            self._rest = None

    def leave(self, x: Array, s: Array) -> None:
        """Take note that the coordinates are left where all is now: x of the active map, the shadows' mean s."""
        for slot, watch in self._standing.items():
            self._standing[slot] = watch._replace(frozen=x[watch.at])
        self._all, self._left = None, s

    def is_beyond(
        self, P: Array, turn: Index, kept: Index, x: Array, kept_x: Index, s: Array, n: int,
        read: Callable[[Index, int], Array],
    ) -> bool:  # fmt: skip
        """Return whether the rest has moved too far for the coordinates in which its errors were left.

        P and x are the covariance and the mean of the active map, `turn` the rows there of the turn of the robot that
        corrects, `kept` and `kept_x` the rows and numbers of that kept last, s the mean of the shadows, n the rows of
        the whole map; `read` returns rows' covariance at rest with the shadows from a first one on.
        """
        if self._all is None:
            parts = zip(*self._standing.values(), strict=True)
            self._all = (
                Watch(*map(np.concatenate, parts)) if self._standing else Watch(NO_ROWS, NO_NUMBERS, NO_ROWS, NO_ROWS)
            )
        if self._rest is None:
            self._rest = read(self._rows, 0)
        elif self._rest.shape[1] < len(s):
            self._rest = np.hstack([self._rest, read(self._rows, self._rest.shape[1])])
        if len(self._left):
            s = s.copy()
            s[: len(self._left)] -= self._left
        return bool(is_farther(P, turn, kept, x, kept_x, *self._all, self._rest, s, self._per_sigma, tolerance(n)))
