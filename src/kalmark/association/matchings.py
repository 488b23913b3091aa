"""Whole matchings of a scan with landmarks, as sets of pairs that agree with each other, whatever the pose.

Two pairs agree if the two landmarks are as far from each other as the two places that were seen.  Such a set is a
clique of pairs.  Bailey 2002, ch. 3.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from kalmark.compiled import compiled

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]
Places = tuple[Array, Array, Array, Array]  # v (K, n), V (K, n, n) seen; l (L, n), C (L n, L n) of the landmarks


@compiled
def agree(i: int, a: int, j: int, b: int, places: Places, gate: float) -> bool:
    """Return whether observation i can be of landmark a and j of b: their distances differ by no more than chance."""
    v, V, l, C = places
    n, r, s, var = v.shape[1], 0.0, 0.0, 0.0
    for c in range(n):
        r += (v[i, c] - v[j, c]) ** 2
        s += (l[a, c] - l[b, c]) ** 2
    r, s = math.sqrt(r), math.sqrt(s)
    if r == 0.0 or s == 0.0:
        return False
    for c in range(n):
        for d in range(n):
            p, q = a * n + c, b * n + c
            P_ab = C[p, a * n + d] + C[q, b * n + d] - C[p, b * n + d] - C[q, a * n + d]
            var += (l[a, c] - l[b, c]) * (l[a, d] - l[b, d]) / s**2 * P_ab
            var += (v[i, c] - v[j, c]) * (v[i, d] - v[j, d]) / r**2 * (V[i, c, d] + V[j, c, d])
    return (r - s) ** 2 <= gate * var


@compiled
def narrow(alive: Flags, m: int, of: Index, landmark: Index, places: Places, gate: float, left: Flags) -> int:
    """Write into `left` (M,) which of the pairs `alive` (M,) agree with pair m; return the number of tests."""
    asked = 0
    for c in range(len(alive)):
        left[c] = False
        if alive[c] and of[c] != of[m] and landmark[c] != landmark[m]:
            asked += 1
            left[c] = agree(of[c], landmark[c], of[m], landmark[m], places, gate)
    return asked


@compiled
def possible(alive: Flags, first: Index, i: int) -> int:
    """Return how many observations from i on have a pair in `alive` (M,)."""
    count = 0
    for j in range(i, len(first) - 1):
        count += int(alive[first[j] : first[j + 1]].any())
    return count


@compiled
def matchings(  # noqa: C901 - one compiled loop: a recursion without calls
    first: Index, landmark: Index, places: Places, gate: float, slack: int, most: int, keep: int
) -> tuple[Index, bool]:
    """Return the matchings (N, K) of pairs that agree, -1 for an observation without one, and whether all were found.

    The pairs of observation i are first[i] to first[i + 1] - 1, best first; pair m is with landmark[m].  Returned are
    those to which no pair can be added and that have at most `slack` pairs less than the largest.  After `most`
    comparisons, or where more than `keep` are as large, the search ends before it is finished.
    """
    k, pairs = len(first) - 1, len(landmark)
    of = np.empty(pairs, np.int64)
    for i in range(k):
        of[first[i] : first[i + 1]] = i
    alive = np.zeros((k + 1, pairs), np.bool_)  # of each count of pairs chosen, those that agree with all of them
    alive[0] = True
    found, sizes, n = np.full((keep, k), -1), np.zeros(keep, np.int64), 0
    taken, at = np.full(k, -1), first[:-1].copy()
    i = count = asked = best = 0
    while i >= 0 and asked < most:
        if i < k and taken[i] >= 0:  # back from below: this pair has been tried
            taken[i], count = -1, count - 1
        if i == k or at[i] > first[i + 1]:  # a leaf, or all has been tried
            if i == k and count >= max(1, best - slack) and not alive[count].any():
                best = max(best, count)
                if n == keep:  # leave out what is too small by now
                    kept = 0
                    for j in range(n):
                        if sizes[j] >= best - slack:
                            found[kept], sizes[kept], kept = found[j], sizes[j], kept + 1
                    n = kept
                if n == keep:
                    break
                found[n], sizes[n], n = taken, count, n + 1
            i -= 1
            continue
        m, skip = at[i], at[i] == first[i + 1]
        at[i] += 1
        if not skip:
            if not alive[count, m]:
                continue
            asked += narrow(alive[count], m, of, landmark, places, gate, alive[count + 1])
        if count + (not skip) + possible(alive[count + (not skip)], first, i + 1) < best - slack:
            continue
        if not skip:
            taken[i], count = m, count + 1
        i += 1
        if i < k:
            at[i] = first[i]
    return found[:n][sizes[:n] >= best - slack], i < 0
