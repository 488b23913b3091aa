"""Which landmarks are near a place, without a look at the whole map.

Where the map keeps means up to date one by one (all of a dense map, the active ones of a postponed one), these are
compared; those at rest are found in a tree of the means they had when the phase began, and then asked for their own.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from kalmark.filter.map import X_AT, StochasticMap
from kalmark.filter.postponed import PostponedMap
from kalmark.geometry.spaces import RHO, VECTOR, VECTOR3, Space
from kalmark.slam.events import Id

if TYPE_CHECKING:
    from kalmark.slam.members import Members
    from kalmark.slam.slam import Slam

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]

NEAREST = 4  # of so many, the nearest to where an observation seems to come from, one is the landmark if any is
AT_REST = 8  # looked up in the tree: their means have moved on by what is pending
FARTHER = 10.0  # than the nearest, so many times: out of the question


def has_place(space: Space) -> bool:
    """Return whether the first numbers of a block are where it is."""
    return space.kinds[0] in (VECTOR, VECTOR3) and RHO not in space.kinds


class Nearby:
    """The landmarks near a place."""

    def __init__(self) -> None:
        self._tree: cKDTree | None = None
        self._slots: Index = np.zeros(0, dtype=np.int64)  # of the places in the tree
        self._phase = -1

    def pairs(self, slam: Slam, kinds: frozenset[str], p: Array) -> tuple[Index, list[Id]]:
        """Return observations (their numbers) and landmarks of `kinds` that may belong together; p (K, 2 or 3)."""
        slots, places = slam.map.awake(p.shape[1])
        if not isinstance(slam.map, StochasticMap):
            resting = self._at_rest(slam.map, slam.members, p)
            slots = np.concatenate([slots, resting])
            places = np.vstack([places, slam.map.places(resting, p.shape[1])])
        names, all_kinds = slam.members.names, slam.members.kinds
        named = [names.get(slot) for slot in slots.tolist()]
        use = [i for i, name in enumerate(named) if name is not None and all_kinds[name].kind in kinds]
        gaps = np.linalg.norm(p[:, None] - places[use], axis=2)
        if len(use) > NEAREST:
            near = np.argpartition(gaps, NEAREST - 1, axis=1)[:, :NEAREST]
        else:
            near = np.tile(np.arange(len(use)), (len(p), 1))
        gap = np.take_along_axis(gaps, near, axis=1)
        rows, columns = np.nonzero(gap <= FARTHER * gap.min(axis=1, keepdims=True, initial=np.inf))
        return rows, [named[use[i]] for i in near[rows, columns].tolist()]

    def _at_rest(self, map_: PostponedMap, members: Members, p: Array) -> Index:
        """Return the slots of the blocks at rest that were nearest to p when they came to rest."""
        p = p[np.isfinite(p).all(axis=1)]
        if map_.phase != self._phase:
            placed = [slot for slot, name in members.names.items() if has_place(members.kinds[name].space)]
            self._slots, self._phase = np.array(placed, dtype=np.int64), map_.phase
            places = map_.x[map_.blocks[self._slots, X_AT][:, None] + np.arange(p.shape[1])]
            self._tree = cKDTree(places) if placed else None
        if self._tree is None or len(p) == 0:
            return self._slots[:0]
        slots = self._slots[np.unique(self._tree.query(p, min(AT_REST, len(self._slots)))[1])]
        return slots[map_.is_at_rest(slots)]
