"""Two parts of a map that are one place: found by constellations of landmarks that agree under a shift and a turn.

A robot that lost its way unnoticed maps a place again beside the first map, and the filter is certain that both are
different.  So the covariance of the map cannot find it: shapes do.  Triangles of landmarks that were seen together are
compared by their sides; a match is a hypothesis T, l_b = T l_a, which is extended to all landmarks it maps on others.

Which of them are chance?  Desolneux, Moisan, Morel 2008, ch. 3: the number of false alarms of a hypothesis with k
agreeing landmarks of m is the number of hypotheses times the binomial tail of k in m.  Landmarks without a partner
where one should be count among the m.  The probability that one agrees by chance is that of landmarks at random, or,
where it is larger, as much as landmarks agree that are certainly different: a grid agrees with itself at many places.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from itertools import chain, combinations
from typing import Any, NamedTuple

import numpy as np

from kalmark.arrays import Array, Flags, Index
from kalmark.events import Id
from kalmark.filter.map import Map
from kalmark.geometry.gaussian import gate as chi2_gate
from kalmark.geometry.spaces import SCALAR, VECTOR
from kalmark.management.constellations import (
    NEAREST,
    Places,
    Transform,
    agreement_with_itself,
    count_agreeing,
    extended,
    fit,
    hull,
)
from kalmark.management.merge import EQUAL_M, GATE, SLACK
from kalmark.report import Repeat
from kalmark.tracks.track import Tracks

ALIKE = 8  # triangles that one is compared with
TRIES = 24  # constellations
JUDGED = 6  # constellations, the largest
FEWEST = 5  # pairs
SIGMAS = 4.0  # by which landmarks that agree may miss, and
FALSE_ALARMS = 1e-3  # expected of a map without repeats
SAMPLE = 40  # landmarks of a part that is compared with itself
WEIGHED = 40  # pairs that are weighed together
SURE = 1e-9  # expected of a map without repeats, below which a repeat is accepted
FITS = 0.9999  # of right shapes pass
GROWN = 5  # landmarks that have come or gone until a map is searched again
IN_A_REPEAT = "in a repeat"  # ends the reason of a merge
MISSED = math.log(0.1)  # log ratio of a landmark without a partner where one should be


def find_repeats(map_: Map, tracks: Tracks, since: int = 0) -> list[Repeat]:
    """Return the repeats in a map of points in the plane, the surest first.  O(n log n).

    Only those are searched that have landmarks which entered the map after so many changes of it.
    """
    look = _RepeatCandidates.of(map_, tracks, since)
    if look is None:
        return []
    found, judged = list[tuple[_Constellation, Repeat]](), 0
    tried = _constellations(look)
    for each in tried:
        if judged == JUDGED or len(each.pairs) < FEWEST or any(each.overlaps(other) for other, _ in found):
            continue
        repeat, judged = _judged(look, each, tried), judged + 1
        if repeat is not None:
            found.append((each, repeat))
    return sorted((repeat for _, repeat in found), key=lambda repeat: repeat.p)


@dataclass(frozen=True, eq=False)
class _RepeatCandidates:
    """Landmarks (N,) that may be repeated: their names, slots and `places`, and `near` (N, 6) those seen with each.

    Where fewer were seen with one the rest is -1.  `new` (N,) are those of which repeats are searched.
    """

    map: Map
    names: list[Id]
    slots: Index
    places: Places
    near: Index
    new: Flags

    @classmethod
    def of(cls, map_: Map, tracks: Tracks, since: int) -> _RepeatCandidates | None:
        points = [track for track in tracks.confirmed.values() if len(track.covisible) > 2 and _is_point(track)]
        kinds = Counter(track.model.kind for track in points)
        kind = max(kinds, key=lambda each: kinds[each], default="")
        points = [track for track in points if track.model.kind == kind]
        names = [track.id for track in points]
        at, given = {name: i for i, name in enumerate(names)}, np.array([not tracks.is_invented(n) for n in names])
        together = [[at[other] for other in track.covisible if other in at and other != track.id] for track in points]
        counts = np.array([len(row) for row in together])
        some = np.flatnonzero(counts)
        if len(some) < 2 * FEWEST or given.all():
            return None
        slots, whose = tracks.slots_of(names), np.repeat(np.arange(len(names)), counts)
        z = map_.means(slots, 2).view(np.complex128).ravel()
        seen = np.fromiter(chain.from_iterable(together), np.int64)
        far = np.abs(z[seen] - z[whose])
        order = np.lexsort((seen, far, whose))
        seen, first, by_x = seen[order], np.concatenate([[0], np.cumsum(counts)]), np.argsort(z.real, kind="stable")
        ranks, spacing = np.arange(NEAREST), float(np.median(far[order][first[some]]))
        near = np.where(ranks < counts[:, None], seen[np.minimum(first[:-1, None] + ranks, len(seen) - 1)], -1)
        chosen = some[:: max(1, len(some) // SAMPLE)]
        P = _of_differences(_joint_covariance(map_, slots[np.append(chosen, near[chosen, 0])]), np.eye(2))
        sigma = math.sqrt(max(float(np.median(np.diag(P).reshape(-1, 2).mean(axis=1))), 0.0))  # relative to the nearest
        tolerance = SIGMAS * sigma + 2.0 * SLACK * spacing
        places = Places(z, z.real[by_x], by_x, first, seen, given, tolerance, spacing)
        return cls(map_, names, slots, places, near, np.array([track.entered >= since for track in points]))


def _is_point(track: Any) -> bool:
    first, *others = track.model.space.kinds
    return bool(first == VECTOR and not {*others} - {SCALAR})


def _joint_covariance(map_: Map, slots: Index) -> Array:
    """Return the joint covariance (2 K, 2 K) of the places of landmarks."""
    P, sizes = map_.covariance(slots.tolist()), [len(map_.rows(slot)) for slot in slots.tolist()]
    index = (np.cumsum([0, *sizes[:-1]])[:, None] + np.arange(2)).ravel()
    return P[np.ix_(index, index)]


def _of_differences(P: Array, A: Array) -> Array:
    """Return the covariance (2 K, 2 K) of q - A p, P (4 K, 4 K) being that of places p, then q."""
    k = len(P) // 4
    J = np.hstack([-np.kron(np.eye(k), A), np.eye(2 * k)])
    return np.asarray(J @ P @ J.T)


# ---------------------------------------------------------------------- constellations
class _Constellation(NamedTuple):
    """Pairs (K, 2) of landmarks that agree under T, and how many landmarks among them have no partner."""

    T: Transform
    pairs: Index
    missing: int

    def overlaps(self, other: _Constellation) -> bool:
        """Return whether a third of the landmarks are those of another one."""
        return 3 * len(np.intersect1d(self.pairs, other.pairs)) > 2 * min(len(self.pairs), len(other.pairs))

    def differs(self, other: _Constellation) -> bool:
        """Return whether another one pairs the same landmarks with others."""
        mine, its = (np.sort(each.pairs, axis=1) @ [1 << 32, 1] for each in (self, other))
        return 2 * len(np.intersect1d(mine, its)) < min(len(mine), len(its))


def _constellations(look: _RepeatCandidates) -> list[_Constellation]:
    """Return the constellations that the best hypotheses are extended to, the largest first."""
    found, pairs = list[_Constellation](), _hypotheses(look)
    while len(pairs) and len(found) < TRIES:
        found.append(_Constellation(*extended(look.places, pairs[0])))
        partner = np.full(len(look.names), -1)
        partner[found[-1].pairs[:, 0]] = found[-1].pairs[:, 1]
        a, b = pairs[1:, :, 0], pairs[1:, :, 1]
        pairs = pairs[1:][((partner[a] != b) & (partner[b] != a)).any(axis=1)]
    return sorted(found, key=lambda each: each.missing - len(each.pairs))


def _hypotheses(look: _RepeatCandidates) -> Index:
    """Return hypotheses, three pairs (M, 3, 2) each; those first that fit most neighbours."""
    from scipy.spatial import cKDTree

    triangles, shape = _triangles(look)
    reach, new = 2.0 * look.places.tolerance, look.new[triangles].any(axis=1)
    gaps: Any = cKDTree(shape).query(shape[new], k=ALIKE + 1, distance_upper_bound=reach)
    one = np.repeat(np.flatnonzero(new), gaps[1].shape[1])
    two, miss = gaps[1].ravel(), gaps[0].ravel()
    keep = np.isfinite(miss) & ((one < two) | ~np.append(new, False)[two])
    pairs = np.stack([triangles[one[keep]], triangles[two[keep]]], axis=2)
    counts = count_agreeing(look.places, pairs)
    best = np.argsort(-counts, kind="stable")
    return pairs[best[counts[best] >= FEWEST - 1]]


def _triangles(look: _RepeatCandidates) -> tuple[Index, Array]:
    """Return triangles (M, 3) of landmarks seen together, and their sides (M, 3) [m] and orientation as shapes (M, 4).

    The corners are ordered by the sides opposite to them.
    """
    n, z = len(look.names), look.places.z
    near = look.near[:, np.array([*combinations(range(NEAREST), 2)])].reshape(-1, 2)
    corners = np.sort(np.column_stack([np.repeat(np.arange(n), len(near) // n), near])[(near >= 0).all(axis=1)], axis=1)
    codes = np.unique((corners[:, 0] * n + corners[:, 1]) * n + corners[:, 2])
    corners = np.column_stack([codes // n**2, codes // n % n, codes % n])
    p = z[corners]
    sides = np.abs(p[:, [1, 2, 0]] - p[:, [2, 0, 1]])
    order = np.argsort(sides, axis=1)
    corners, sides = np.take_along_axis(corners, order, axis=1), np.take_along_axis(sides, order, axis=1)
    p = z[corners]
    area = (np.conj(p[:, 1] - p[:, 0]) * (p[:, 2] - p[:, 0])).imag
    wide = np.abs(area) > 2.0 * look.places.tolerance * sides[:, 2]
    mirrored = np.where(area > 0, 1e3, -1e3) * look.places.spacing
    return corners[wide], np.column_stack([sides, mirrored])[wide]


# ---------------------------------------------------------------------- judgement
def _judged(look: _RepeatCandidates, found: _Constellation, all_: list[_Constellation]) -> Repeat | None:
    """Return the repeat that a constellation is, None if it may be chance."""
    from scipy.special import betainc

    of, k, m = look.places, len(found.pairs), len(found.pairs) + found.missing
    corners = hull(of, found.pairs[:, 1])
    area = 0.5 * float((np.conj(np.roll(corners, 1)) * corners).imag.sum())
    if area <= 0.0:
        return None
    density = m / area
    pairs = found.pairs.take(np.argsort(np.median(found.pairs, axis=0), kind="stable"), axis=1)  # the older first
    older, newer = of.z[pairs[:, 0]], of.z[pairs[:, 1]]
    T = fit(older, newer)
    if np.median(np.abs(T[0] * newer + T[1] - older)) <= of.spacing / 2:
        return None  # each part is the other one turned: the world is symmetric
    score, fits, agrees = _weighed(look, T, pairs, density)
    score += MISSED * found.missing
    # as likely by chance: the ratio exceeds 1 over it as seldom; one that the covariance excludes is less likely yet
    if score <= -math.log(FALSE_ALARMS if agrees else SURE):
        return None
    p, edges, few = 0.0, (look.near >= 0).sum() / 2, min(1.0, SAMPLE / m)
    chance = min(density * math.pi * of.tolerance**2, 1.0)
    for each in chain([chance], (_self_similarity(of, part) for part in found.pairs.T)):
        p = max(p, 2.0 * float(edges**2 * betainc(few * k - 2, few * (m - k) + 1, each)))
        if p > FALSE_ALARMS:
            return None
    rivals = any(
        other is not found and 2 * len(other.pairs) > k and other.overlaps(found) and found.differs(other)
        for other in all_
    )
    named = [(look.names[a], look.names[b]) for a, b in pairs.tolist()]
    older, middle, b = (np.array([z.real, z.imag]) for z in (*of.z[pairs].mean(axis=0), T[1]))
    sure = bool(p <= SURE and fits and not rivals)
    return Repeat(named, np.append(b, np.angle(T[0])), middle, middle - older, score, p, agrees, sure)


def _self_similarity(of: Places, part: Index) -> float:
    """Return the probability with which landmarks of a part agree with others of it that are certainly different.

    Each edge between two that were seen together is moved on each other; the probability is that of which the best
    transform is expected once.
    """
    from scipy.special import betaincinv

    far = np.abs(of.z[part] - of.z[part].mean())
    k, m, number = agreement_with_itself(of, part[np.argsort(far, kind="stable")[:SAMPLE]])
    some = (k > 0) & (m > 0)
    if not some.any():
        return 0.0
    k, m = k[some], np.maximum(m[some], k[some])
    return float(betaincinv(k, m - k + 1, 1.0 / number).max())


def _weighed(look: _RepeatCandidates, T: Transform, pairs: Index, density: float) -> tuple[float, bool, bool]:
    """Return the log-likelihood ratio of pairs that are one, T unknown, whether their shapes fit, and places do."""
    some = pairs[:: max(1, -(-len(pairs) // WEIGHED))]
    k, of, (a, b) = len(some), look.places, T
    p, q = of.z[some[:, 0]], of.z[some[:, 1]]
    P, moved = _joint_covariance(look.map, look.slots[some.T.ravel()]), a * p + b
    slack = (SLACK * of.spacing) ** 2 * np.eye(2 * k)
    G = np.column_stack([np.tile(np.eye(2), (k, 1)), (1j * (moved - moved.mean())).view(np.float64)])
    extent = max(np.ptp(of.z.real), np.ptp(of.z.imag))
    prior = np.diag([extent**2, extent**2, math.pi**2 / 3.0])
    Z = _of_differences(P, np.array([[a.real, -a.imag], [a.imag, a.real]])) + slack + G @ prior @ G.T
    z = (q - moved).view(np.float64)
    d2 = float(z @ np.linalg.solve(Z, z))
    score = -0.5 * (d2 + float(np.linalg.slogdet(Z)[1])) - k * math.log(2.0 * math.pi * density)
    Z = _of_differences(P, np.eye(2)) + EQUAL_M**2 * np.eye(2 * k) + slack
    z = (q - p).view(np.float64)
    return score, d2 <= chi2_gate(FITS, 2 * k - 3), bool(z @ np.linalg.solve(Z, z) <= chi2_gate(GATE, 2 * k))


# ---------------------------------------------------------------------- merging
def is_due(tracks: Tracks) -> bool:
    """Return whether so many landmarks have come or gone that a map should be searched again."""
    return tracks.changes - tracks.searched >= GROWN
