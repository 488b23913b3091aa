"""The landmarks of a scan without ids where each observation can be of one landmark only, in one compiled call."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from kalmark.arrays import Array, Index
from kalmark.compiled import compiled
from kalmark.filter.corrections import Map, seen_at
from kalmark.filter.kernels import cholesky_inverse
from kalmark.filter.nearest_blocks import Sorts, distance, nearest_pairs, wanted_places
from kalmark.filter.observed_block import innovation

Seen = tuple[int, int, int, Array, Array]  # slots of robot and mount, numbers of a landmark, y (K, m), R (K, p, p)
Asked = tuple[Sorts, Array, int, float, float]  # wanted sorts, places, most, farther, gate: see `nearest_landmarks`


class Nearest(NamedTuple):
    """The block nearest to each observation: its slot (K,), d2 (K,) and `sigma` (K,) [m], that of their distance.

    No other is in question within `limit` (K,) [m] of where the observation seems to be.  All pairs that were compared:
    `rows` and `numbers` (M,), their d2 `compared` (M,), and of these numbers the `slots` (L,) and `places` (L, n).
    """

    at: Index
    d2: Array
    sigma: Array
    limit: Array
    rows: Index
    numbers: Index
    compared: Array
    slots: Index
    places: Array


@compiled
def nearest_landmarks(
    model: Any, map_: Map, scan: Seen, slots: Index, asked: Asked
) -> tuple[bool, tuple[Index, Array, Array, Array, Index, Index, Array, Index, Array]]:  # fmt: skip
    """Return the `Nearest` of a scan, and whether each observation is of another block and within the gate on d2.

    `slots` are those by which the blocks of the map are to be named, -1 for none; wanted are those of some `sorts`.  Of
    an observation, which seems to be at its p (K, n), the `most` nearest in metres are compared, within `farther` times
    the least distance.
    """
    robot, mount, d, y, R = scan
    sorts, p, most, farther, gate = asked
    here, places = wanted_places(map_[0], map_[3], slots, sorts, p.shape[1])
    rows, numbers, used = nearest_pairs(p, places, most, farther)
    named, l = slots[here[used]], places[used]
    pairs = robot, mount, here[used[numbers]], d, y[rows], R[rows], gate
    index, _e, z, E_h, E_l = seen_at(model, map_, pairs)
    Z, compared, _valid = innovation(map_[1], index, E_h, E_l, pairs[5], z)
    best, limit = _best_pairs(p, rows, numbers, compared, l, most, farther)
    at, d2, sigma, clear = np.full(len(p), -1), np.full(len(p), np.inf), np.full(len(p), np.inf), True
    for k in range(len(p)):
        if best[k] >= 0:
            at[k], d2[k] = named[numbers[best[k]]], compared[best[k]]
        clear = clear and d2[k] <= gate and at[k] not in at[:k]
        if clear:
            sigma[k] = _sigma(E_l[best[k]], Z[best[k]])
    return clear, (at, d2, sigma, limit, rows, numbers, compared, named, l)


@compiled
def _best_pairs(
    p: Array, rows: Index, numbers: Index, d2: Array, places: Array, most: int, farther: float
) -> tuple[Index, Array]:  # fmt: skip
    """Return the pair (K,) of least d2 of each observation, -1 for none, and how far off others may be (K,)."""
    best, pairs = np.full(len(p), -1), np.zeros(len(p), np.int64)
    limit, least, farthest = np.empty(len(p)), np.full(len(p), np.inf), np.zeros(len(p))
    for m in range(len(rows)):
        k, gap = rows[m], distance(p[rows[m]], places[numbers[m]])
        least[k], farthest[k], pairs[k] = min(least[k], gap), max(farthest[k], gap), pairs[k] + 1
        if d2[m] < (np.inf if best[k] < 0 else d2[best[k]]):
            best[k] = m
    for k in range(len(p)):
        limit[k] = farthest[k] if pairs[k] == most else farther * least[k]
    return best, limit


@compiled
def _sigma(E_l: Array, Z: Array) -> float:
    """Return the root of the trace of (E_l' Z^-1 E_l)^-1, inf where a measurement does not determine a place."""
    p, d = E_l.shape
    M, positive = cholesky_inverse(Z)
    if not positive:
        return np.inf
    A, I = np.zeros((p, d)), np.zeros((d, d))
    for a in range(p):
        for c in range(d):
            for b in range(a + 1):
                A[a, c] += M[a, b] * E_l[b, c]
    for c in range(d):
        for b in range(d):
            for a in range(p):
                I[c, b] += A[a, c] * A[a, b]
    M, positive = cholesky_inverse(I)
    if not positive:
        return np.inf
    trace = 0.0
    for a in range(d):
        for b in range(a + 1):
            trace += M[a, b] ** 2
    return math.sqrt(trace)
