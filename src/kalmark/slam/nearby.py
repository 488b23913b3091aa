"""Which landmarks are near a place, without a look at the whole map.

Where the map keeps means up to date one by one (all of a dense map, the active ones of a postponed one), these are
compared; those at rest are found in a tree of the means they had when the phase began, and then asked for their own.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

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

TINY_M = 1e-9
AT_REST = 8  # looked up in the tree: their means have moved on by what is pending


def has_place(space: Space) -> bool:
    """Return whether the first numbers of a block are where it is."""
    return space.kinds[0] in (VECTOR, VECTOR3) and not {RHO, HEADING} & set(space.kinds)


class Nearby:
    """The landmarks near a place."""

    def __init__(self) -> None:
        self._tree: cKDTree | None = None
        self._slots: Index = np.zeros(0, dtype=np.int64)  # of the places in the tree
        self._phase = -1

    def pairs(
        self, slam: Slam, kinds: frozenset[str], p: Array, nearest: int, farther: float
    ) -> tuple[Index, list[Id]]:
        """Return observations (their numbers) and landmarks of `kinds` that may belong together; p (K, 2 or 3)."""
        map_, names, all_kinds = slam.map, slam.members.names, slam.members.kinds
        slots, places = map_.awake(p.shape[1])
        use = [i for i, s in enumerate(slots.tolist()) if s in names and all_kinds[names[s]].kind in kinds]
        slots, gaps = slots[use], np.linalg.norm(p[:, None] - places[use], axis=2)
        if isinstance(map_, PostponedMap):
            reach = farther * np.maximum(gaps.min(axis=1, initial=np.inf), TINY_M)
            resting = self._at_rest(map_, slam.members, p, reach, max(AT_REST, nearest))
            resting = resting[[s in names and all_kinds[names[s]].kind in kinds for s in resting.tolist()]]
            if len(resting):
                more = np.linalg.norm(p[:, None] - map_.places(resting, p.shape[1]), axis=2)
                slots, gaps = np.concatenate([slots, resting]), np.hstack([gaps, more])
        if len(slots) > nearest:
            near = np.argpartition(gaps, nearest - 1, axis=1)[:, :nearest]
            gaps = np.take_along_axis(gaps, near, axis=1)
            slots = slots[near]
        else:
            slots = np.tile(slots, (len(p), 1))
        rows, columns = np.nonzero(
            gaps <= farther * np.maximum(gaps.min(axis=1, keepdims=True, initial=np.inf), TINY_M)
        )
        return rows, [names[s] for s in slots[rows, columns].tolist()]

    def _at_rest(self, map_: PostponedMap, members: Members, p: Array, reach: Array, count: int) -> Index:
        """Return the slots of the blocks at rest that were nearest to p, within reach, when they came to rest."""
        if map_.phase != self._phase:
            from scipy.spatial import cKDTree

            placed = [slot for slot, name in members.names.items() if has_place(members.kinds[name].space)]
            self._slots, self._phase = np.array(placed, dtype=np.int64), map_.phase
            places = map_.x[map_.blocks[self._slots, X_AT][:, None] + np.arange(p.shape[1])]
            self._tree = cKDTree(places) if placed else None
        known = np.isfinite(p).all(axis=1)
        if self._tree is None or not known.any():
            return self._slots[:0]
        gaps, found = self._tree.query(p[known], np.arange(1, 1 + min(count, len(self._slots))))
        slots = self._slots[np.asarray(found)[gaps <= reach[known, None]]]
        return np.unique(slots[map_.is_at_rest(slots)])
