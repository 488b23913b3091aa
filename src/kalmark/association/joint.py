"""Joint compatibility: the largest set of pairs that fit together, by branch and bound.  Neira and Tardos 2001."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from kalmark.compiled import compiled

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]


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
    first: Index, landmark: Index, z: Array, Z: Array, gates: Array, most: int
) -> tuple[Index, bool]:
    """Return the pair chosen for each of K observations (-1: none), and whether the search was finished.

    The pairs of observation i are first[i] to first[i + 1] - 1, best first; pair m is with landmark[m], has the
    innovation z[m] (p,), and Z (M p, M p) is the covariance of all of them.  As many pairs as possible with a joint d2
    of at most gates[number of pairs]; among those the smallest d2.  After `most` nodes the best so far is returned.
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
            d2[i + 1] += extend(L, w, z, Z, chosen, count, m, p)
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
