"""Change of inactive blocks since the last full update, estimated from the active blocks.

An inactive block moves with the blocks that have entered the active map, and with where the robots were at the last
full update: its correction is a regression on theirs.  Theirs is compared with the sigmas they have now, or, if they
move by themselves, with those at the full update.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from kalmark.arrays import Array, Index
from kalmark.compiled import compiled
from kalmark.geometry.spaces import DIRECTION, ERROR_SIZE, HOMOGENEOUS, MEAN_SIZE, VECTOR, VECTOR3, Space

NO_NUMBERS = np.zeros(0)
NO_ROWS = np.zeros(0, dtype=np.int64)
Standing = tuple[Index, Array, Index, Index]  # as `Watch`
Moved = tuple[Array, Array, Array]  # of `is_farther`: G, left, one over the sigmas

TAU = 5e-4  # how far, in sigmas and radians of heading, an inactive block may be from its error coordinates,
SMALL = 5000  # in a map of so many rows at most; in a larger one farther by as much: a full update costs more


def tolerance(n: int) -> float:
    """Return how far an inactive block may be from where its error coordinates are, in a map of n rows."""
    return TAU * max(1.0, n / SMALL)


class Watch(NamedTuple):
    """Numbers of a block in the active map, and their values at the full update.

    And the first row of P of what each is part of, and how many rows that has.
    """

    at: Index
    frozen: Array
    first: Index
    size: Index


NOTHING = Watch(NO_ROWS, NO_NUMBERS, NO_ROWS, NO_ROWS)


@compiled
def is_farther(
    P: Array, x: Array, s: Array, last: tuple[Index, Index, Index], standing: Standing, moving: Moved, tau: float
) -> bool:  # fmt: skip
    """Return whether a number is more than so many sigmas from where it was: of standing blocks, or among G (s - left).

    The limit is tau over the uncertainty and the correction of the robot's turn since it was cloned: `last` are the
    rows in P of turn and clones, and the numbers of the clones.
    """
    (turn, clones, clones_x), (at, frozen, first, size), (G, left, per_sigma) = last, standing, moving
    variance = 1e-300
    for i in range(len(turn)):
        variance += P[turn[i], turn[i]] + P[clones[i], clones[i]] - 2.0 * P[clones[i], turn[i]] + x[clones_x[i]] ** 2
    limit = tau / math.sqrt(variance)
    for i in range(len(at)):
        own = 0.0
        for j in range(first[i], first[i] + size[i]):
            own += P[j, j]
        if own > 0.0 and (x[at[i]] - frozen[i]) ** 2 > limit * limit * own:
            return True
    for i in range(len(per_sigma)):
        moved = 0.0
        for j in range(G.shape[1]):
            moved += G[i, j] * (s[j] - left[j] if j < len(left) else s[j])
        if abs(moved) * per_sigma[i] > limit:
            return True
    return False


class Drift:
    """Watches the blocks that have entered."""

    def __init__(self) -> None:
        self.standing: dict[int, Watch] = {}
        self._stored: dict[int, Array] = {}  # one over the sigmas that they had at the full update
        self._all: Standing | None = None  # of all of these
        self._moved: Moved | None = None
        self.moving: list[int] = []  # the blocks that move by themselves,
        self._rows: Index = NO_ROWS  # the rows of their positions,
        self._per_sigma: Array = NO_NUMBERS  # one over those sigmas,
        self._rest: Array | None = None  # and their stored covariance with the blocks that have entered
        self._left: Array = NO_NUMBERS  # the auxiliary states' mean when the coordinates were left

    def watch(self, slot: int, space: Space, at: int, first: int, frozen: Array, variances: Array) -> None:
        """Watch those numbers of a block on which its coordinates depend.

        They are `at` and further in the active map, their rows from `first` on; `variances` are those stored.
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
            self.standing[slot] = Watch(index + at, frozen[index], np.array(rows), np.array(sizes))
            self._stored[slot] = np.array([1.0 / sigma if sigma > 0 else 0.0 for sigma in sigmas])
            self._all = None

    def forget(self, slot: int) -> None:
        """Stop watching a block."""
        if self.standing.pop(slot, None) is not None:
            self._all = None

    def moves(self, slot: int, rows: Index) -> None:
        """Take note that a block, if it is watched, moves by itself: of use is only its stored position, those rows."""
        if slot in self.standing:
            self.forget(slot)
            self.moving.append(slot)
            self._rows = np.concatenate([self._rows, rows])
            self._per_sigma = np.concatenate([self._per_sigma, self._stored[slot][: len(rows)]])
            self._rest = self._moved = None

    def leave(self, x: Array, s: Array) -> None:
        """Take note that the coordinates are left at x of the active map and the auxiliary states' mean s."""
        for slot, watch in self.standing.items():
            self.standing[slot] = watch._replace(frozen=x[watch.at])
        self._all, self._left, self._moved = None, s, None

    def is_beyond(
        self, P: Array, x: Array, s: Array, count: int, last: tuple[Index, Index, Index], n: int,
        read: Callable[[Index, int], Array],
    ) -> bool:  # fmt: skip
        """Return whether inactive blocks are too far from where their error coordinates were left.

        P and x are the covariance and the mean of the active map, s (`count` or more,) the mean of the auxiliary
        states, `last` the rows there of the turn of the robot that corrects, and the rows and numbers of its last
        clone, n the rows of the whole map; `read` returns the stored covariance of rows with those of A0 from a first
        one on.
        """
        if self._all is None:
            at, frozen, first, size = zip(NOTHING, *self.standing.values(), strict=True)
            self._all = np.concatenate(at), np.concatenate(frozen), np.concatenate(first), np.concatenate(size)
        if self._moved is None or self._moved[0].shape[1] < count:
            if self._rest is None:
                self._rest = read(self._rows, 0)
            elif self._rest.shape[1] < count:
                self._rest = np.hstack([self._rest, read(self._rows, self._rest.shape[1])])
            self._moved = self._rest, self._left, self._per_sigma
        return bool(is_farther(P, x, s, last, self._all, self._moved, tolerance(n)))
