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
from kalmark.events import Id
from kalmark.filter.estimators import Map
from kalmark.filter.map import X_AT, StochasticMap
from kalmark.filter.postponed import PostponedMap
from kalmark.filter.reading import AT_ONCE
from kalmark.geometry.spaces import HEADING, RHO, VECTOR, VECTOR3, Space, Table

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

    from kalmark.slam.slam import Slam
    from kalmark.tracks.members import Members

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]
Excerpt = tuple[StochasticMap, int, int, Index]  # a map, and the slots in it of a robot, its mount and landmarks

NONE = np.zeros(0, dtype=np.int64)
TINY_M, FAR_M = 1e-9, 1e100
AT_REST = 8  # to be asked for their own means, of each place: they have moved on by what is pending
REGION = 256  # landmarks round a scan, to compare with this one and the next
WIDER = 1.5  # times as far as this one needs
FEW = 16  # numbers to be kept in order


def has_place(space: Space) -> bool:
    """Return whether the first numbers of a block are where it is."""
    return space.kinds[0] in (VECTOR, VECTOR3) and not {RHO, HEADING} & set(space.kinds)


@compiled
def distance(p: Array, place: Array) -> float:
    """Return how far two places (d,) are apart."""
    square = 0.0
    for j in range(len(p)):
        square += (p[j] - place[j]) ** 2
    return math.sqrt(square)


@compiled
def distances(p: Array, places: Array) -> Array:
    """Return how far places (N, d) are from p (K, d): (K, N)."""
    gaps = np.empty((len(p), len(places)))
    for k in range(len(p)):
        for i in range(len(places)):
            gaps[k, i] = distance(p[k], places[i])
    return gaps


@compiled
def least(gaps: Array, count: int) -> float:
    """Return the `count`-th least of some gaps (N,), inf where there are fewer."""
    if not 0 < count <= len(gaps):
        return np.inf
    if count > FEW:
        return float(np.partition(gaps, count - 1)[count - 1])
    kept = np.full(count, np.inf)
    for gap in gaps:
        j = count - 1
        if gap < kept[j]:
            while j > 0 and kept[j - 1] > gap:
                kept[j] = kept[j - 1]
                j -= 1
            kept[j] = gap
    return kept[count - 1]


@compiled
def limits(gaps: Array, nearest: int, farther: float) -> Array:
    """Return how far (K,) the nearest of each row of gaps (K, N) are, none so many times farther than the nearest."""
    out = np.empty(len(gaps))
    for k in range(len(gaps)):
        out[k] = min(farther * max(least(gaps[k], 1), TINY_M), least(gaps[k], nearest))
    return out


@compiled
def paired(p: Array, places: Array, nearest: int, farther: float) -> tuple[Index, Index, Index]:
    """Return rows of p (K, d) and numbers of places (N, d), both (M,): of each p the nearest, as `limits` has it.

    The places are numbered as they come up: `used` (L,) has which they are.
    """
    gaps = distances(p, places)
    limit, count, n = limits(gaps, nearest, farther), len(p), len(places)
    rows, numbers = np.empty(count * min(n, nearest), np.int64), np.empty(count * min(n, nearest), np.int64)
    used, number = np.empty(n, np.int64), np.full(n, -1)
    found = L = 0
    for k in range(count):
        first = found
        for i in range(n):
            if gaps[k, i] <= limit[k] and found < first + nearest:
                if number[i] < 0:
                    number[i], used[L] = L, i
                    L += 1
                rows[found], numbers[found] = k, number[i]
                found += 1
    return rows[:found].copy(), numbers[:found].copy(), used[:L].copy()


@compiled
def awake(
    p: Array, x: Array, blocks: Table, slots: Index, sorts: tuple[Index, Flags], nearest: int, farther: float
) -> tuple[Index, Array]:
    """Return the slots (N,) of active landmarks within the `limits` (K,) of p (K, d), and these.

    `slots` are those of the active blocks, `sorts` say what is there and wanted.
    """
    here = np.empty(len(slots), np.int64)
    n, d = 0, p.shape[1]
    for i in range(len(slots)):
        if sorts[1][sorts[0][slots[i]]]:
            here[n] = i
            n += 1
    places = np.empty((n, d))
    for i in range(n):
        for j in range(d):
            places[i, j] = x[blocks[here[i], X_AT] + j]
    gaps = distances(p, places)
    limit, found = limits(gaps, nearest, farther), np.zeros(n, np.bool_)
    for k in range(len(p)):
        for i in range(n):
            found[i] = found[i] or gaps[k, i] <= limit[k]
    return slots[here[:n][found]], limit


@compiled
def asleep(
    p: Array, limit: Array, most: int, centre: Array, radius: float, slots: Index, places: Array, at: Index,
    sorts: tuple[Index, Flags],
) -> tuple[Index, bool]:  # fmt: skip
    """Return which `slots` of a region, at rest and wanted, are among the `most` nearest to p within a limit (K,).

    And whether these are all in the region.  `at` tells what is active, `sorts` what is there and wanted.
    """
    here = np.empty(len(slots), np.int64)
    n, inside = 0, True
    for i in range(len(slots)):
        if at[slots[i]] < 0 and sorts[1][sorts[0][slots[i]]]:
            here[n] = i
            n += 1
    found, near, gaps = np.zeros(n, np.bool_), np.empty(n, np.int64), np.empty(n)
    for k in range(len(p)):
        count, far = 0, limit[k]
        for i in range(n):
            if abs(p[k, 0] - places[here[i], 0]) <= far:
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


class Pairs(NamedTuple):
    """Observations (M,) and the `numbers` (M,) of landmarks that may belong together.

    Of the landmarks: their slots (L,), where they are (L, 2 or 3) and, if not too many are at rest, what was read.
    """

    rows: Index
    numbers: Index
    slots: Index
    places: Array
    excerpt: Excerpt | None


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
        map_, d = slam.map, p.shape[1]
        sorts = slam.members.sorts_of(kinds, len(map_.blocks))
        slots, limit = awake(p, *map_.awake(), sorts, nearest, farther)
        still = self._at_rest(map_, slam.members, sorts, p, limit, max(AT_REST, nearest))
        slots = np.concatenate([slots, still]) if len(still) else slots
        read = map_.excerpt(*head, slots) if len(still) <= AT_ONCE else None
        places = map_.means(slots, d) if read is None else read[0].means(read[3], d)
        rows, numbers, used = paired(p, places, nearest, farther)
        return Pairs(rows, numbers, slots[used], places[used], None if read is None else (*read[:3], read[3][used]))

    def around(self, slam: Slam, kind: str, p: Array, count: int) -> list[Id]:
        """Return the landmarks of a kind nearest to p (2 or 3,), nearest first: at rest as the last flush left them."""
        map_, members = slam.map, slam.members
        sorts = members.sorts_of(frozenset({kind}), len(map_.blocks))
        slots, limit = awake(p[None], *map_.awake(), sorts, count, math.inf)
        still = self._at_rest(map_, members, sorts, p[None], limit, count)
        left = map_.x[map_.blocks[still, X_AT][:, None] + np.arange(len(p))]
        gaps = distances(p[None], np.concatenate([map_.means(slots, len(p)), left]))[0]
        slots = np.concatenate([slots, still])
        return [members.names[s] for s in slots[np.argsort(gaps, kind="stable")[:count]].tolist()]

    def _at_rest(
        self, map_: Map, members: Members, sorts: tuple[Index, Flags], p: Array, limit: Array, count: int
    ) -> Index:
        """Return the slots of the blocks at rest nearest to p, within a limit (K,), when they came to rest."""
        if not isinstance(map_, PostponedMap) or not self._known(map_, members, p.shape[1]):
            return NONE
        if not (np.abs(p) < FAR_M).all():
            near = (np.abs(p) < FAR_M).all(axis=1)
            return self._at_rest(map_, members, sorts, p[near], limit[near], count) if near.any() else NONE
        region, size, wider = self._region, REGION, 1.0
        while True:
            if region is not None:
                centre, radius, slots, places = region
                found, inside = asleep(p, limit, count, centre, radius / wider, slots, places, map_._at, sorts)
                if inside:
                    self._region = region
                    return found
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
