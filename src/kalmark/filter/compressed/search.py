"""Search for inactive blocks near places, by the means that they had when the compression interval began."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from kalmark.arrays import Array, Index
from kalmark.compiled import compiled
from kalmark.filter.layout import Layout
from kalmark.filter.neighbours import Sorts, distance, has_place, least

NONE = np.zeros(0, dtype=np.int64)
FAR_M = 1e100
REGION = 256  # blocks round a scan, to compare with this one and the next
WIDER = 1.5  # times as far as this one needs


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
            far = least(gaps[:count], most)
        for i in range(count):
            found[near[i]] = found[near[i]] or gaps[i] <= far
        inside = inside and distance(p[k], centre) + far <= radius
    return slots[here[:n][found]], inside


class Region(NamedTuple):
    """All blocks within a radius of a centre, and where they were when the interval began."""

    centre: Array
    radius: float
    slots: Index
    places: Array


class Search:
    """A tree of the blocks of one compression interval, made when it is first asked."""

    def __init__(self) -> None:
        self._tree: Any = None
        self._slots: Index = NONE  # of the places in the tree
        self._planted = False
        self._region: Region | None = None  # of the last scan

    def near(self, layout: Layout, at: Index, sorts: Sorts, p: Array, limit: Array, count: int) -> Index:
        """Return the slots of wanted inactive blocks, the `count` nearest to each p (K, d) within a limit (K,)."""
        if not self._planted:
            self._plant(layout, sorts, p.shape[1])
        finite = (np.abs(p) < FAR_M).all(axis=1)
        if self._tree is None or not finite.any():
            return NONE
        p, limit = p[finite], limit[finite]
        region, size, wider = self._region, REGION, 1.0
        while True:
            if region is not None:
                centre, radius, slots, places = region
                found, inside = near_in_region(p, limit, count, centre, radius / wider, slots, places, at, sorts)
                if inside:
                    self._region = region
                    return found
            region, size, wider = self._around(p, size), 2 * size, WIDER

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
        return Region(centre, radius, self._slots[found], self._tree.data[found])
