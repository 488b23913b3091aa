"""Which landmarks are near a place, without a look at the whole map.

Where the map keeps means up to date one by one (all of a dense map, the active ones of a postponed one), these are
compared; those at rest are found in a tree of the means they had when the phase began, and then asked for their own.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from kalmark.compiled import compiled
from kalmark.filter.map import X_AT
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
AT_REST = 8  # looked up in the tree: their means have moved on by what is pending


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
def closest(gaps: Array, nearest: int, farther: float) -> tuple[Index, Index]:
    """Return rows and columns (M,) of the so many least of each row, none so many times as large as the least."""
    count, n = gaps.shape
    rows, columns = np.empty(count * min(n, nearest), np.int64), np.empty(count * min(n, nearest), np.int64)
    found = 0
    for k in range(count):
        limit = farther * max(gaps[k].min(), TINY_M) if n else 0.0
        if n > nearest:
            limit = min(limit, np.partition(gaps[k], nearest - 1)[nearest - 1])
        first = found
        for i in range(n):
            if gaps[k, i] <= limit and found < first + nearest:
                rows[found], columns[found] = k, i
                found += 1
    return rows[:found], columns[:found]


class Nearby:
    """The landmarks near a place."""

    def __init__(self) -> None:
        self._tree: cKDTree | None = None
        self._slots: Index = np.zeros(0, dtype=np.int64)  # of the places in the tree
        self._phase = -1

    def pairs(
        self, slam: Slam, kinds: frozenset[str], p: Array, nearest: int, farther: float
    ) -> tuple[Index, list[Id], Array]:
        """Return observations (M,) and landmarks of `kinds` that may belong together, and where these are (M, 2 or 3).

        That is, to each of the places p (K, 2 or 3), the nearest ones, none so many times farther than the nearest.
        """
        map_, names, sorts = slam.map, slam.members.names, slam.members.sorts
        slots, places = map_.awake(p.shape[1])
        use = [s in names and sorts[names[s]] in kinds for s in slots.tolist()]
        slots, places = slots[use], places[use]
        if isinstance(map_, PostponedMap):
            reach = farther * np.maximum(distances(p, places).min(axis=1, initial=np.inf), TINY_M)
            resting = self._at_rest(map_, slam.members, p, reach, max(AT_REST, nearest))
            resting = resting[[s in names and sorts[names[s]] in kinds for s in resting.tolist()]]
            if len(resting):
                slots = np.concatenate([slots, resting])
                places = np.concatenate([places, map_.means(resting, p.shape[1])])
        rows, columns = closest(distances(p, places), nearest, farther)
        return rows, [names[s] for s in slots[columns].tolist()], places[columns]

    def around(self, slam: Slam, kind: str, p: Array, count: int) -> list[Id]:
        """Return the landmarks of a kind nearest to p (2 or 3,), nearest first: at rest as the last flush left them."""
        map_, names, kinds = slam.map, slam.members.names, slam.members.kinds
        slots, places = map_.awake(len(p))
        gaps = np.linalg.norm(places - p, axis=1)
        if isinstance(map_, PostponedMap):
            found, at = self._looked_up(map_, slam.members, p[None], count)
            here = map_.is_at_rest(found[0])
            slots, gaps = np.concatenate([slots, found[0, here]]), np.concatenate([gaps, at[0, here]])
        near = [names.get(s) for s in slots[np.argsort(gaps, kind="stable")].tolist()]
        return [n for n in near if n in kinds and kinds[n].kind == kind][:count]

    def _at_rest(self, map_: PostponedMap, members: Members, p: Array, reach: Array, count: int) -> Index:
        """Return the slots of the blocks at rest that were nearest to p, within reach, when they came to rest."""
        found, gaps = self._looked_up(map_, members, p, count)
        slots = found[gaps <= reach[:, None]]
        return np.unique(slots[map_.is_at_rest(slots)])

    def _looked_up(self, map_: PostponedMap, members: Members, p: Array, count: int) -> tuple[Index, Array]:
        """Return the slots (K, count) that were nearest to p when the phase began, and how far they were."""
        if map_.phase != self._phase:
            from scipy.spatial import cKDTree

            placed = [slot for slot, name in members.names.items() if has_place(members.kinds[name].space)]
            self._slots, self._phase = np.array(placed, dtype=np.int64), map_.phase
            places = map_.x[map_.blocks[self._slots, X_AT][:, None] + np.arange(p.shape[1])]
            self._tree = cKDTree(places) if placed else None
        if self._tree is None:
            return np.zeros((len(p), 0), dtype=np.int64), np.zeros((len(p), 0))
        nearest = np.arange(1, 1 + min(count, len(self._slots)))
        gaps, found = self._tree.query(np.where(np.isfinite(p), p, FAR_M), nearest)
        return self._slots[found], gaps
