"""Search for inactive blocks near places, by the means that they had when the compression interval began.

And how well such blocks are known relative to each other: what is between them and the robot need not be read then.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from kalmark.arrays import Array, Index
from kalmark.compiled import compiled
from kalmark.filter.layout import Layout
from kalmark.filter.nearest_blocks import Sorts, distance, has_place, kth_least
from kalmark.filter.nearest_of_each import Nearest

Joint = Callable[[Index], Array]

NONE = np.zeros(0, dtype=np.int64)
FAR_M = 1e100
REGION = 256  # blocks round a scan, to compare with this one and the next
WIDER = 1.5  # times as far as this one needs
NO, YES, OUTSIDE = 0, 1, 2


@compiled
def near_in_region(
    p: Array, limit: Array, most: int, centre: Array, radius: float, slots: Index, places: Array, at: Index,
    sorts: Sorts,
) -> tuple[Index, bool]:  # fmt: skip
    """Return which wanted inactive `slots` of a region are among the `most` nearest to p (K, d) within a limit (K,).

    And whether the region has all of these.  `at` (by slot) is negative for inactive blocks.
    """
    here, d = np.empty(len(slots), np.int64), p.shape[1]
    low, high = np.full(d, np.inf), np.full(d, -np.inf)  # what is outside this box is near none
    for k in range(len(p)):
        for j in range(d):
            low[j], high[j] = min(low[j], p[k, j] - limit[k]), max(high[j], p[k, j] + limit[k])
    n, inside = 0, True
    for i in range(len(slots)):
        near_some = at[slots[i]] < 0 and sorts[1][sorts[0][slots[i]]]
        for j in range(d):
            near_some = near_some and low[j] <= places[i, j] <= high[j]
        if near_some:
            here[n] = i
            n += 1
    found, near, gaps = np.zeros(n, np.bool_), np.empty(n, np.int64), np.empty(n)
    for k in range(len(p)):
        count, far = 0, limit[k]
        for i in range(n):
            gap = distance(p[k], places[here[i]])
            if gap <= far:
                near[count], gaps[count] = i, gap
                count += 1
        if count >= most:
            far = kth_least(gaps[:count], most)
        for i in range(count):
            found[near[i]] = found[near[i]] or gaps[i] <= far
        inside = inside and distance(p[k], centre) + far <= radius
    return slots[here[:n][found]], inside


@compiled
def is_nearest(
    p: Array, d2: Array, sigma: Array, limit: Array, own: Index, centre: Array, radius: float, slots: Index,
    places: Array, spread: Array, at: Index, sorts: Sorts,
) -> tuple[int, Index]:  # fmt: skip
    """Return whether no wanted inactive block can be nearer to an observation than the one that is nearest now.

    That takes `NO`, `YES`, another region (`OUTSIDE`) or the spread of some blocks, of which the numbers are returned.
    The observations seem to be at p (K, d); their blocks `own` (K,), -1 for new ones, are at d2 (K,) with the sigma
    (K,) of the distance, and no block farther away than a limit (K,) is in question.  The sigma of the distance to
    another block is no larger than the sum of it and of the `spread` of both, of what they are off by relative to a
    third one.
    """
    d, unknown, verdict = p.shape[1], np.zeros(len(slots), np.bool_), YES
    for k in range(len(p)):
        if not distance(p[k], centre) + limit[k] <= radius:
            return OUTSIDE, slots[:0]
        mine = -1
        for i in range(len(slots)):
            if slots[i] == own[k]:
                mine = i
        for i in range(len(slots)):
            near = at[slots[i]] < 0 and sorts[1][sorts[0][slots[i]]]
            for j in range(d):
                near = near and abs(places[i, j] - p[k, j]) <= limit[k]
            gap = distance(p[k], places[i]) if near else np.inf
            if not gap <= limit[k]:
                continue
            if mine < 0:
                return NO, slots[:0]
            if spread[i] < 0.0 or spread[mine] < 0.0:
                unknown[i], unknown[mine] = spread[i] < 0.0, spread[mine] < 0.0
            elif not gap > math.sqrt(d2[k]) * (sigma[k] + spread[mine] + spread[i]):
                verdict = NO
    return verdict, np.flatnonzero(unknown) if verdict == YES else slots[:0]


class Region(NamedTuple):
    """All blocks within a radius of a centre, and where they were when the interval began.

    `spread` are the sigmas of what they were off by then relative to one block, or -1 until they are needed.
    """

    centre: Array
    radius: float
    slots: Index
    places: Array
    spread: Array


class InactiveSearch:
    """A tree of the blocks of one compression interval, made when it is first needed."""

    def __init__(self) -> None:
        self._tree: Any = None
        self._slots: Index = NONE  # of the places in the tree
        self._planted = False
        self._region: Region | None = None  # of the last scan
        self._reference = -1  # the block relative to which spreads are

    def near(self, layout: Layout, at: Index, sorts: Sorts, p: Array, limit: Array, count: int) -> Index:
        """Return the slots of wanted inactive blocks, the `count` nearest to each p (K, d) within a limit (K,)."""
        if not self._planted:
            self._plant(layout, sorts, p.shape[1])
        if not np.abs(p).max(initial=0.0) < FAR_M:
            finite = (np.abs(p) < FAR_M).all(axis=1)
            p, limit = p[finite], limit[finite]
        if self._tree is None or not len(p):
            return NONE
        region, size, wider = self._region, REGION, 1.0
        while True:
            if region is not None:
                centre, radius, slots, places, _ = region
                found, inside = near_in_region(p, limit, count, centre, radius / wider, slots, places, at, sorts)
                if inside:
                    self._region = region
                    return found
            region, size, wider = self._around(p, size), 2 * size, WIDER

    def none_nearer(
        self, layout: Layout, at: Index, sorts: Sorts, p: Array, found: Nearest, own: Index, covariance: Joint
    ) -> bool:  # fmt: skip
        """Return whether no wanted inactive block can be nearer to an observation at p (K, d) than the nearest `found`.

        `own` (K,) are these, -1 for one that was not there when the interval began.  `covariance` is that of the places
        of some blocks then.  It has not grown since: blocks that do not move only gain information.
        """
        if not self._planted:
            self._plant(layout, sorts, p.shape[1])
        if self._tree is None:
            return True
        region = self._region or self._around(p, REGION)
        while True:
            asked = p, found.d2, found.sigma, found.limit, own, *region, at, sorts
            verdict, unknown = is_nearest(*asked)
            if len(unknown):
                self._reference = self._reference if self._reference >= 0 else int(own.max())
                slots = np.append(self._reference, region.slots[unknown])
                region.spread[unknown] = _spread(covariance(slots), p.shape[1])
            elif verdict == OUTSIDE and region is self._region:
                region = self._around(p, REGION)
            else:
                self._region = region
                return verdict == YES

    def _plant(self, layout: Layout, sorts: Sorts, d: int) -> None:
        from scipy.spatial import cKDTree

        self._planted, spaces = True, enumerate(layout.spaces)
        placed = [i for i, space in spaces if space is not None and sorts[0][i] >= 0 and has_place(space)]
        self._slots = np.array(placed, dtype=np.int64)
        self._tree = cKDTree(layout.stored(self._slots, d)) if placed else None

    def _around(self, p: Array, count: int) -> Region:
        """Return the blocks nearest to the middle of p (K, 2 or 3)."""
        centre, total = p.mean(axis=0), len(self._tree.data)
        gaps, found = self._tree.query(centre, np.arange(1, 1 + min(count, total)))
        radius = float(gaps[-1]) if count < total else math.inf
        return Region(centre, radius, self._slots[found], self._tree.data[found], np.full(len(found), -1.0))


def _spread(C: Array, d: int) -> Array:
    """Return the sigmas (N,) of places relative to a first one; C ((N + 1) d, (N + 1) d) is the covariance of all."""
    P = C.reshape(len(C) // d, d, -1, d)
    own, with_first = np.einsum("icic->i", P), np.einsum("cic->i", P[0])
    return np.sqrt(np.maximum(own[1:] + own[0] - 2.0 * with_first[1:], 0.0))
