"""Which landmarks are near a place, without a look at the whole map.

Where the map keeps means up to date one by one (all of a dense map, the active ones of a postponed one), these are
compared; those at rest are found by the means they had when the phase began, and then asked for their own.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import numpy.typing as npt

from kalmark.compiled import compiled
from kalmark.filter.map import X_AT, StochasticMap
from kalmark.filter.postponed import PostponedMap
from kalmark.geometry.spaces import HEADING, RHO, VECTOR, VECTOR3, Space
from kalmark.slam.events import Id

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

    from kalmark.slam.members import Members
    from kalmark.slam.slam import Slam

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]

TINY_M, FAR_M = 1e-9, 1e100
AT_REST = 8  # to be asked for their own means, of each place: they have moved on by what is pending
REGION = 512  # landmarks round a scan, to compare with this one and the next
WIDER = 1.5  # times as far as this one needs
FEW = 16  # numbers to be kept in order


def has_place(space: Space) -> bool:
    """Return whether the first numbers of a block are where it is."""
    return space.kinds[0] in (VECTOR, VECTOR3) and not {RHO, HEADING} & set(space.kinds)


@compiled
def distances(p: Array, places: Array) -> Array:
    """Return how far places (N, d) are from p (K, d): (K, N)."""
    gaps = np.empty((len(p), len(places)))
    for k in range(len(p)):
        for i in range(len(places)):
            square = 0.0
            for j in range(p.shape[1]):
                square += (p[k, j] - places[i, j]) ** 2
            gaps[k, i] = math.sqrt(square)
    return gaps


@compiled
def least(gaps: Array, count: int) -> Array:
    """Return the `count`-th least (K,) of each row, inf where there are fewer."""
    out, kept = np.full(len(gaps), np.inf), np.empty(count)
    for k in range(len(gaps)):
        if count > FEW and count <= gaps.shape[1]:
            out[k] = np.partition(gaps[k], count - 1)[count - 1]
        elif count <= gaps.shape[1]:
            kept[:] = np.inf
            for i in range(gaps.shape[1]):
                j = count - 1
                if gaps[k, i] < kept[j]:
                    while j > 0 and kept[j - 1] > gaps[k, i]:
                        kept[j] = kept[j - 1]
                        j -= 1
                    kept[j] = gaps[k, i]
            out[k] = kept[count - 1]
    return out


@compiled
def within(gaps: Array, nearest: int, limit: Array) -> tuple[Index, Index]:
    """Return rows and columns (M,) of what is within the limit (K,) of its row, of each row at most so many."""
    count, n = gaps.shape
    rows, columns = np.empty(count * min(n, nearest), np.int64), np.empty(count * min(n, nearest), np.int64)
    found = 0
    for k in range(count):
        first = found
        for i in range(n):
            if gaps[k, i] <= limit[k] and found < first + nearest:
                rows[found], columns[found] = k, i
                found += 1
    return rows[:found].copy(), columns[:found].copy()


def limits(gaps: Array, nearest: int, farther: float) -> Array:
    """Return how far (K,) the nearest of each row of gaps (K, N) are, none so many times farther than the nearest."""
    return np.minimum(farther * np.maximum(least(gaps, 1), TINY_M), least(gaps, nearest))


class Pairs(NamedTuple):
    """Observations (M,) and the slots of landmarks that may belong together, and where these are (M, 2 or 3).

    Those at rest have been read: `at` are their slots in the `excerpt` (map, robot, mount), -1 of all others.
    """

    rows: Index
    slots: Index
    places: Array
    at: Index
    excerpt: tuple[StochasticMap, int, int] | None

    def some(self, which: Index | list[int]) -> Pairs:
        """Return some of them."""
        return Pairs(self.rows[which], self.slots[which], self.places[which], self.at[which], self.excerpt)


class Region(NamedTuple):
    """All landmarks within a radius of a centre, and where they were when the phase began."""

    centre: Array
    radius: float
    slots: Index
    places: Array


class Nearby:
    """The landmarks near a place."""

    def __init__(self) -> None:
        self._tree: cKDTree | None = None
        self._slots: Index = np.zeros(0, dtype=np.int64)  # of the places in the tree
        self._phase = -1
        self._region: Region | None = None  # where the last scan was

    def pairs(
        self, slam: Slam, kinds: frozenset[str], head: tuple[int, int], p: Array, nearest: int, farther: float
    ) -> Pairs:
        """Return which observations that seem to come from p (K, 2 or 3) and landmarks of `kinds` may belong together.

        That is, of each place the nearest ones, none so many times farther than the nearest.  `head` are the slots of
        the robot and, if it is in the map, its mount: those at rest are read with them.
        """
        map_, members, d = slam.map, slam.members, p.shape[1]
        slots, places = map_.awake(d)
        use = members.are_of(kinds, slots)
        slots, places, excerpt = slots[use], places[use], None
        gaps, at = distances(p, places), np.full(len(slots), -1)
        if isinstance(map_, PostponedMap):
            resting = self._at_rest(map_, members, kinds, p, limits(gaps, nearest, farther), max(AT_REST, nearest))
            if len(resting):
                m, robot, mount, here = map_.excerpt(*head, resting)
                more, excerpt = m.means(here, d), (m, robot, mount)
                slots, at = np.concatenate([slots, resting]), np.concatenate([at, here])
                places, gaps = np.concatenate([places, more]), np.concatenate([gaps, distances(p, more)], axis=1)
        rows, columns = within(gaps, nearest, limits(gaps, nearest, farther))
        return Pairs(rows, slots[columns], places[columns], at[columns], excerpt)

    def around(self, slam: Slam, kind: str, p: Array, count: int) -> list[Id]:
        """Return the landmarks of a kind nearest to p (2 or 3,), nearest first: at rest as the last flush left them."""
        map_, members = slam.map, slam.members
        slots, places = map_.awake(len(p))
        gaps = distances(p[None], places)[0]
        if isinstance(map_, PostponedMap) and self._known(map_, members, len(p)):
            found = self._nearest(p, count)
            here = map_.is_at_rest(found.slots)
            slots = np.concatenate([slots, found.slots[here]])
            gaps = np.concatenate([gaps, distances(p[None], found.places[here])[0]])
        use = members.are_of(frozenset({kind}), slots)
        slots, gaps = slots[use], gaps[use]
        return [members.names[s] for s in slots[np.argsort(gaps, kind="stable")[:count]].tolist()]

    def _at_rest(
        self, map_: PostponedMap, members: Members, kinds: frozenset[str], p: Array, limit: Array, count: int
    ) -> Index:
        """Return the slots of the blocks at rest nearest to p, within a limit (K,), when they came to rest."""
        near = (np.abs(p) < FAR_M).all(axis=1)
        if not self._known(map_, members, p.shape[1]) or not near.any():
            return np.zeros(0, dtype=np.int64)
        p, limit, region, size, wider = p[near], limit[near], self._region, REGION, 1.0
        while True:
            if region is not None:
                slots, places = region.slots, region.places
                use = map_.is_at_rest(slots) & members.are_of(kinds, slots)
                slots, gaps = slots[use], distances(p, places[use])
                limit_here = np.minimum(limit, least(gaps, count))
                if wider * (np.linalg.norm(p - region.centre, axis=1) + limit_here).max() <= region.radius:
                    self._region = region
                    return np.unique(slots[within(gaps, count, limit_here)[1]])
            region, size, wider = self._nearest(p.mean(axis=0), size), 2 * size, WIDER

    def _known(self, map_: PostponedMap, members: Members, d: int) -> bool:
        """Make a tree of all landmarks when a phase has begun; return whether there are any."""
        if map_.phase != self._phase:
            from scipy.spatial import cKDTree

            placed = [slot for slot, name in members.names.items() if has_place(members.kinds[name].space)]
            self._slots, self._phase, self._region = np.array(placed, dtype=np.int64), map_.phase, None
            self._tree = cKDTree(map_.x[map_.blocks[self._slots, X_AT][:, None] + np.arange(d)]) if placed else None
        return self._tree is not None

    def _nearest(self, p: Array, count: int) -> Region:
        """Return the landmarks nearest to p (2 or 3,) when the phase began."""
        assert self._tree is not None
        gaps, found = self._tree.query(p, np.arange(1, 1 + min(count, len(self._slots))))
        radius = float(gaps[-1]) if count < len(self._slots) else math.inf
        return Region(p, radius, self._slots[found], self._tree.data[found])
