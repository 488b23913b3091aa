"""Search for the blocks nearest to places, among means that are compared one by one."""

from __future__ import annotations

import math

import numpy as np

from kalmark.arrays import Array, Flags, Index
from kalmark.compiled import compiled
from kalmark.filter.layout import X_AT
from kalmark.geometry.spaces import HEADING, RHO, VECTOR, VECTOR3, Space, Table

TINY_M = 1e-9

Sorts = tuple[Index, Flags]  # by slot: a number of what is there, -1 for nothing to be found; by number: whether wanted


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
def kth_least(gaps: Array, count: int) -> float:
    """Return the `count`-th least of some gaps (N,), inf where there are fewer."""
    if not 0 < count <= len(gaps):
        return np.inf
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
    """Return the distance (K,) of the `nearest`-th of each row of gaps (K, N), at most `farther` times the least."""
    out = np.empty(len(gaps))
    for k in range(len(gaps)):
        out[k] = min(farther * max(kth_least(gaps[k], 1), TINY_M), kth_least(gaps[k], nearest))
    return out


@compiled
def nearest_pairs(p: Array, places: Array, nearest: int, farther: float) -> tuple[Index, Index, Index]:
    """Return rows of p (K, d) and numbers of places (N, d), both (M,): of each p the nearest, within its `limits`.

    The places are numbered in the order in which they are found: `used` (L,) has which they are.
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
def wanted_places(x: Array, blocks: Table, slots: Index, sorts: Sorts, d: int) -> tuple[Index, Array]:
    """Return which of the `blocks` are wanted (N,), and where they are (N, d); `slots` are theirs, -1 for none."""
    here = np.empty(len(slots), np.int64)
    n = 0
    for i in range(len(slots)):
        if sorts[1][sorts[0][slots[i]]]:
            here[n] = i
            n += 1
    places = np.empty((n, d))
    for i in range(n):
        for j in range(d):
            places[i, j] = x[blocks[here[i], X_AT] + j]
    return here[:n], places


@compiled
def near_places(
    p: Array, x: Array, blocks: Table, slots: Index, sorts: Sorts, nearest: int, farther: float
) -> tuple[Index, Array]:
    """Return the slots (N,) of wanted blocks within the `limits` (K,) of p (K, d), and these limits.

    `slots` are those of the `blocks`, -1 for none.
    """
    here, places = wanted_places(x, blocks, slots, sorts, p.shape[1])
    gaps = distances(p, places)
    limit, found = limits(gaps, nearest, farther), np.zeros(len(here), np.bool_)
    for k in range(len(p)):
        for i in range(len(here)):
            found[i] = found[i] or gaps[k, i] <= limit[k]
    return slots[here[found]], limit
