"""Constellations of landmarks of the plane that agree under a shift and a turn: searched in compiled code.

A place is a complex number z = x + i y [m], a shift and a turn are T = (a, b), |a| = 1: T z = a z + b.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from kalmark.arrays import Array, Flags, Index
from kalmark.compiled import compiled

AROUND = 16  # landmarks seen together with a corner of a triangle, by which a hypothesis is judged at first
NEAREST = 6  # landmarks seen together with one, of which triangles and edges are made
LOOSE = 0.25  # of the spacing, above which a landmark is not paired
ROUNDS = 12
MOVES = 600  # transforms by which a part is compared with itself

Complex = Any  # a complex number, or an array of them
Transform = tuple[Complex, Complex]


class Places(NamedTuple):
    """Landmarks in the order of their age: their places `z` (N,), and their x (N,) in the order `by_x`, that of x.

    `seen[first[l] : first[l + 1]]` are those that were seen together with l, the nearest first.  `given` (N,) have an
    id of the log.  `tolerance` [m] is by how much two that are one may miss, `spacing` [m] the distance to the nearest.
    """

    z: Complex
    x: Array
    by_x: Index
    first: Index
    seen: Index
    given: Flags
    tolerance: float
    spacing: float


@compiled
def are_two(of: Places, a: int, b: int) -> bool:
    """Return whether landmarks are certainly two: they were seen together, or have two ids."""
    two = a == b or (of.given[a] and of.given[b])
    k = of.first[a]
    while not two and k < of.first[a + 1]:
        two, k = of.seen[k] == b, k + 1
    return bool(two)


@compiled
def nearest(of: Places, z: Complex, reach: float) -> tuple[int, float]:
    """Return the landmark nearest to a place, and how far it is; -1 if none is within `reach` [m]."""
    best, far, low, high = -1, reach, 0, len(of.x)
    while low < high:
        k = (low + high) // 2
        low, high = (k + 1, high) if of.x[k] < z.real - reach else (low, k)
    while low < len(of.x) and of.x[low] <= z.real + far:
        gap = abs(of.z[of.by_x[low]] - z)
        if gap <= far:
            best, far = of.by_x[low], gap
        low += 1
    return best, far


@compiled
def fit(p: Complex, q: Complex) -> Transform:
    """Return the T of the least squares of q - T p, places (K,)."""
    a = np.sum(np.conj(p - p.mean()) * (q - q.mean()))
    a = a / abs(a) if a != 0.0 else a + 1.0
    return a, q.mean() - a * p.mean()


@compiled
def count_agreeing(of: Places, triangles: Index) -> Index:
    """Return how many landmarks near the first of three pairs (M, 3, 2) are moved on others by the T of these (M,).

    It is 0 where a pair is certainly of two.
    """
    out = np.zeros(len(triangles), np.int64)
    for m in range(len(triangles)):
        p, q = triangles[m, :, 0], triangles[m, :, 1]
        if not (are_two(of, p[0], q[0]) or are_two(of, p[1], q[1]) or are_two(of, p[2], q[2])):
            (a, b), out[m] = fit(of.z[p], of.z[q]), 1
            for l in of.seen[of.first[p[0]] : min(of.first[p[0]] + AROUND, of.first[p[0] + 1])]:
                other = nearest(of, a * of.z[l] + b, 2.0 * of.tolerance)[0]
                out[m] += other >= 0 and not are_two(of, l, other)
    return out


@compiled
def sides(of: Places, pairs: Index) -> Index:
    """Return of each landmark with how many more of the first than of the second of pairs (K, 2) it was seen (N,)."""
    votes = np.zeros(len(of.z), np.int64)
    for k in range(len(pairs)):
        for l, vote in ((pairs[k, 0], 1), (pairs[k, 1], -1)):
            votes[l] += vote
            votes[of.seen[of.first[l] : of.first[l + 1]]] += vote
    return votes


@compiled
def matched(of: Places, T: Transform, pairs: Index, some: Flags, others: Flags) -> Index:
    """Return pairs (M, 2) of landmarks of some (N,) that T, of these pairs (K, 2), moves onto others (N,).

    Each is the nearest of its own.  They may miss by more the farther they are from the middle.
    """
    z, n = of.z[pairs[:, 0]], len(of.z)
    middle = z.mean()
    spread = max(np.sqrt(np.sum(np.abs(z - middle) ** 2)), of.tolerance)
    partner, gaps = np.full(n, -1), np.full(n, np.inf)
    for l in range(n):
        reach = of.tolerance * (1.0 + abs(of.z[l] - middle) / spread)
        if some[l] and reach <= LOOSE * of.spacing + of.tolerance:
            other, far = nearest(of, T[0] * of.z[l] + T[1], reach)
            if other >= 0 and others[other] and far < gaps[other]:
                partner[other], gaps[other] = l, far
    onto = np.flatnonzero(partner >= 0)
    return np.column_stack((partner[onto], onto))


@compiled
def extended(of: Places, pairs: Index) -> tuple[Transform, Index, int]:
    """Return the T of a hypothesis, three pairs (3, 2), all pairs (K, 2) that agree with it, and how many do not.

    A landmark is of the part with which it was seen more often.  Those do not that have no partner and are among those
    that have.
    """
    T = fit(of.z[pairs[:, 0]], of.z[pairs[:, 1]])
    for _ in range(ROUNDS):
        votes = sides(of, pairs)
        found = matched(of, T, pairs, votes > 0, votes < 0)
        found = found[np.array([not are_two(of, a, b) for a, b in found])]
        if len(found) < 3:
            break
        same = len(found) == len(pairs) and (found == pairs).all()
        pairs = found
        T = fit(of.z[pairs[:, 0]], of.z[pairs[:, 1]])
        if same:
            break
    votes, corners = sides(of, pairs), hull(of, pairs[:, 1])
    votes[pairs.ravel()] = 0
    missing = 0
    for l in range(len(of.z)):
        missing += votes[l] != 0 and is_inside(corners, T[0] * of.z[l] + T[1] if votes[l] > 0 else of.z[l])
    return T, pairs, missing


@compiled
def hull(of: Places, some: Index) -> Complex:
    """Return the corners (H,) of the convex hull of some landmarks, counterclockwise.  Andrew 1979."""
    among = np.zeros(len(of.z), np.bool_)
    among[some] = True
    z = of.z[of.by_x[among[of.by_x]]]
    corners, count, least = np.empty(2 * len(z), np.complex128), 0, 1
    for k, corner in enumerate(np.concatenate((z, z[-2::-1]))):  # there and back
        least = count if k == len(z) else least
        while count > least and area(corners[count - 2], corners[count - 1], corner) <= 0.0:
            count -= 1
        corners[count] = corner
        count += 1
    return corners[: count - 1]


@compiled
def area(a: Complex, b: Complex, c: Complex) -> float:
    """Return twice the area of a triangle, positive if its corners are counterclockwise."""
    return (np.conj(b - a) * (c - a)).imag


@compiled
def is_inside(corners: Complex, z: Complex) -> bool:
    """Return whether a place is inside a convex polygon with these corners (H,)."""
    inside, k = len(corners) > 2, 0
    while inside and k < len(corners):
        inside, k = area(corners[k - 1], corners[k], z) >= 0.0, k + 1
    return inside


@compiled
def agreement_with_itself(of: Places, part: Index) -> tuple[Index, Index, int]:
    """Return how many landmarks of a part (K,) agree with others of it that are certainly different, and of how many.

    Each edge between two that were seen together is moved on each other, and T is that of all that agree then, as of a
    repeat; there are that many such T, of which at most about `MOVES` are in both (M,).
    """
    z, corners, is_in = of.z, hull(of, part), np.zeros(len(of.z), np.bool_)
    is_in[part] = True
    r = [np.abs(z[part] - z[a]) for a in part]
    edges = [(part[i], part[j], r[i][j]) for i in range(len(part)) for j in range(len(part))
             if i != j and (r[i] < r[i][j]).sum() <= NEAREST]  # fmt: skip
    alike = [(a, b, c, d) for a, b, long in edges for c, d, other in edges if abs(long - other) <= 2.0 * of.tolerance
             and a != c and b != d and are_two(of, a, c) and are_two(of, b, d)]  # fmt: skip
    chosen = alike[:: max(1, -(-len(alike) // MOVES))]
    agreeing, among = np.full(len(chosen), -2), np.full(len(chosen), -2)
    for m, (a, b, c, d) in enumerate(chosen):
        pairs = np.array([(a, c), (b, d)])
        alike_too = matched(of, fit(z[pairs[:, 0]], z[pairs[:, 1]]), pairs, is_in, is_in)
        pairs = alike_too if len(alike_too) > 1 else pairs
        turn, shift = fit(z[pairs[:, 0]], z[pairs[:, 1]])
        for l in part:
            moved = turn * z[l] + shift
            other = nearest(of, moved, of.tolerance)[0]
            agreeing[m] += other >= 0 and other != l and is_in[other]
            among[m] += is_inside(corners, moved)
    return agreeing, among, len(alike)
