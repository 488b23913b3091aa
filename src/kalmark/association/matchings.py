"""Whole matchings of a scan with landmarks: searches among the sets of pairs of an observation and a landmark.

*Jointly compatible* is the largest set of pairs that fit together, by branch and bound.  Neira and Tardos 2001.  *In
agreement*, whatever the pose, are two pairs if the two landmarks are as far from each other as the two places that were
seen; a set of such pairs is a clique.  Bailey 2002, ch. 3.
"""

from __future__ import annotations

import math

import numpy as np

from kalmark.arrays import Array, Flags, Index
from kalmark.compiled import compiled

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
    tests = 0
    for c in range(len(alive)):
        left[c] = False
        if alive[c] and of[c] != of[m] and landmark[c] != landmark[m]:
            tests += 1
            left[c] = agree(of[c], landmark[c], of[m], landmark[m], places, gate)
    return tests


@compiled
def count_possible(alive: Flags, first: Index, i: int) -> int:
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
    i = count = tests = best = 0
    while i >= 0 and tests < most:
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
            tests += narrow(alive[count], m, of, landmark, places, gate, alive[count + 1])
        if count + (not skip) + count_possible(alive[count + (not skip)], first, i + 1) < best - slack:
            continue
        if not skip:
            taken[i], count = m, count + 1
        i += 1
        if i < k:
            at[i] = first[i]
    return found[:n][sizes[:n] >= best - slack], i < 0


# ---------------------------------------------------------------------- joint compatibility
@compiled
def extend(L: Array, w: Array, z: Array, Z: Array, chosen: Index, count: int, m: int, p: int) -> float:
    """Append pair m to the factor L (n, n) of the `count` pairs chosen, and to w (n,) = L^-1 z; return the added d2.

    z (M p,) and Z (M p, M p) are those of all pairs.  inf if the covariance is not positive definite with it.
    """
    n, added = count * p, 0.0
    for a in range(p):
        row = n + a
        for c in range(count):
            for b in range(p):
                L[row, c * p + b] = Z[m * p + a, chosen[c] * p + b]
        for b in range(a + 1):
            L[row, n + b] = Z[m * p + a, m * p + b]
        for j in range(row + 1):
            s = L[row, j]
            for k in range(j):
                s -= L[row, k] * L[j, k]
            if j < row:
                L[row, j] = s / L[j, j]
            elif s > 0.0:
                L[row, j] = math.sqrt(s)
            else:
                return np.inf
        s = z[m, a]
        for k in range(row):
            s -= L[row, k] * w[k]
        w[row] = s / L[row, row]
        added += w[row] ** 2
    return added


@compiled
def best_matching(  # noqa: C901 - one compiled loop: a recursion without calls
    first: Index, landmark: Index, z: Array, Z: Array, more: Array, gates: Array, most: int
) -> tuple[Index, bool]:
    """Return the pair chosen for each of K observations (-1: none), and whether the search was finished.

    The pairs of observation i are first[i] to first[i + 1] - 1, best first; pair m is with landmark[m], has the
    innovation z[m] (p,), adds `more` (M,) to d2, and Z (M p, M p) is the covariance of all of them.  As many pairs as
    possible with a joint d2 of at most gates[number of pairs]; among those the smallest d2.  After `most` nodes the
    best so far is returned.
    """
    k, p = len(first) - 1, z.shape[1]
    L, w = np.zeros((k * p, k * p)), np.zeros(k * p)
    taken, chosen, best = np.full(k, -1), np.empty(k, np.int64), np.full(k, -1)
    at, d2, rest = first[:-1].copy(), np.zeros(k + 1), np.zeros(k + 1, np.int64)
    for i in range(k - 1, -1, -1):  # observations from i on that could still be paired
        rest[i] = rest[i + 1] + (first[i + 1] > first[i])
    i = count = nodes = best_count = 0
    best_d2 = 0.0
    while i >= 0 and nodes < most:
        if i < k and taken[i] >= 0:  # back from below: this pair has been tried
            taken[i], count = -1, count - 1
        if i == k or at[i] > first[i + 1]:  # a leaf, or all has been tried
            if i == k and (count > best_count or (count == best_count and d2[k] < best_d2)):
                best_count, best_d2 = count, d2[k]
                best[:] = taken
            i -= 1
            continue
        m, skip = at[i], at[i] == first[i + 1]
        at[i] += 1
        nodes += 1
        d2[i + 1] = d2[i]
        if not skip:
            free = True
            for c in range(count):
                free = free and landmark[chosen[c]] != landmark[m]
            if not free:
                continue
            d2[i + 1] += more[m] + extend(L, w, z, Z, chosen, count, m, p)
            if not d2[i + 1] <= gates[count + 1]:
                continue
        could = count + (not skip) + rest[i + 1]
        if could < best_count or (could == best_count and d2[i + 1] >= best_d2):
            continue
        if not skip:
            taken[i], chosen[count], count = m, m, count + 1
        i += 1
        if i < k:
            at[i] = first[i]
    return best, nodes < most
