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
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np

from kalmark.arrays import Array, Flags, Index, block_diagonal
from kalmark.association.ratio import log_ratios
from kalmark.events import Id
from kalmark.filter.map import Map
from kalmark.geometry.angles import rotation
from kalmark.geometry.frames import from_frame
from kalmark.geometry.gaussian import gate as chi2_gate
from kalmark.geometry.spaces import HEADING, SCALAR, VECTOR
from kalmark.management.merge import EQUAL_M, GATE
from kalmark.report import Repeat
from kalmark.tracks.track import Tracks

NEAREST = 6  # landmarks seen together with one, of which triangles are made
AROUND = 16  # landmarks seen together with a corner of a triangle, by which a hypothesis is judged at first
ALIKE = 8  # triangles that one is compared with
MOST_TRIANGLES, MOST_MATCHES, TRIES = 60_000, 8_000, 24
JUDGED = 6  # constellations, the largest
FEWEST = 5  # pairs
SIGMAS = 4.0  # by which landmarks that agree may miss, and
SLACK = 0.04  # of the spacing of landmarks, for errors that are not in the covariance
LOOSE = 0.25  # of the spacing, above which a landmark is not paired
ROUNDS = 12
FALSE_ALARMS = 1e-3  # expected of a map without repeats
SAMPLE, MOVES = 40, 600  # landmarks of a part, and transforms, by which it is compared with itself
WEIGHED = 40  # pairs that are weighed together
SURE = 1e-9  # expected of a map without repeats, below which a repeat is accepted
FITS = 0.9999  # of right shapes pass
GROWN, GROWN_BY = 5, 0.2  # landmarks that have come or gone, or so many of all, until a map is searched again
TURNED_RAD = 0.1  # a sigma of the turn that is allowed for at least
IN_A_REPEAT = "in a repeat"  # ends the reason of a merge
CLEAR = 0.2  # from a half, the share of the last scan's landmarks that decides in which part a robot is
MISSED = math.log(0.1)  # log ratio of a landmark without a partner where one should be


def find_repeats(map_: Map, tracks: Tracks) -> list[Repeat]:
    """Return the repeats in a map of points in the plane, the surest first.  O(n log n)."""
    look = _RepeatCandidates.of(map_, tracks)
    if look is None:
        return []
    found: list[tuple[_Constellation, Repeat]] = []
    tried: list[_Constellation] = []
    for T, seeds in _hypotheses(look):
        if any(each.holds(seeds) for each in tried):
            continue
        grown = _grown(look, T, seeds)
        tried.append(grown)
        if len(tried) == TRIES:
            break
    tried.sort(key=lambda each: each.missing - len(each.pairs))
    judged = 0
    for each in tried:
        if judged == JUDGED or len(each.pairs) < FEWEST or any(each.overlaps(other) for other, _ in found):
            continue
        repeat, judged = _judged(look, each, tried), judged + 1
        if repeat is not None:
            found.append((each, repeat))
    return sorted((repeat for _, repeat in found), key=lambda repeat: repeat.p)


@dataclass(frozen=True, eq=False)
class _RepeatCandidates:
    """Landmarks (N,) that may be repeated: names, slots, places (N, 2), the `codes` a N + b of those seen in one scan.

    `given` (N,) have an id of the log.  `near` are the landmarks seen with each, the nearest first.  `tolerance` [m] is
    by how much two that are one may miss, `spacing` [m] the distance to the nearest.
    """

    map: Map
    names: list[Id]
    slots: Index
    places: Array
    codes: Index
    given: Flags
    near: list[Index]
    spacing: float
    tolerance: float
    tree: Any

    @classmethod
    def of(cls, map_: Map, tracks: Tracks) -> _RepeatCandidates | None:
        from scipy.spatial import cKDTree

        points = [track for track in tracks.confirmed.values() if len(track.covisible) > 2 and _is_point(track)]
        kinds = Counter(track.model.kind for track in points)
        names = [track.id for track in points if track.model.kind == kinds.most_common(1)[0][0]]
        if len(names) < 2 * FEWEST or not any(map(tracks.is_invented, names)):
            return None
        slots, at = tracks.slots_of(names), {name: i for i, name in enumerate(names)}
        places, near, codes = map_.means(slots, 2), [], []
        given = np.array([not tracks.is_invented(name) for name in names])
        for i, name in enumerate(names):
            seen = np.array([at[n] for n in tracks.confirmed[name].covisible if n in at and n != name], dtype=np.int64)
            far = np.linalg.norm(places[seen] - places[i], axis=1)
            near.append(seen[np.argsort(far, kind="stable")])
            codes += [i * len(names) + seen, np.array([i * len(names) + i])]
        nearest = [float(np.linalg.norm(places[n[0]] - places[i])) for i, n in enumerate(near) if len(n)]
        if len(nearest) < 2 * FEWEST:
            return None
        spacing, sigma = float(np.median(nearest)), _relative_sigma(map_, slots, near)
        tolerance = SIGMAS * math.sqrt(2.0) * sigma + SLACK * spacing
        tree, together = cKDTree(places), np.unique(np.concatenate(codes))
        return cls(map_, names, slots, places, together, given, near, spacing, tolerance, tree)

    def may_be(self, a: Index, b: Index) -> Flags:
        """Return whether landmarks a and b may be one: they were not seen together and have not two ids."""
        wanted = a * len(self.names) + b
        at = np.minimum(np.searchsorted(self.codes, wanted), len(self.codes) - 1)
        return np.asarray((self.codes[at] != wanted) & ~(self.given[a] & self.given[b]))

    def covariance(self, rows: Index) -> Array:
        """Return the joint covariance (2 K, 2 K) of the places of some landmarks."""
        P = self.map.covariance([int(slot) for slot in self.slots[rows]])
        sizes = [len(self.map.mean(int(slot))) for slot in self.slots[rows]]
        starts = np.cumsum([0, *sizes[:-1]])
        index = (starts[:, None] + np.arange(2)).ravel()
        return P[np.ix_(index, index)]


def _is_point(track: Any) -> bool:
    first, *others = track.model.space.kinds
    return bool(first == VECTOR and not {*others} - {SCALAR})


def _relative_sigma(map_: Map, slots: Index, near: list[Index]) -> float:
    """Return the median sigma [m] of landmarks relative to those seen with them."""
    out, step = [], max(1, len(near) // 200)
    for i in range(0, len(near), step):
        if len(near[i]):
            pair = [int(slots[i]), int(slots[near[i][0]])]
            P, n = map_.covariance(pair), len(map_.mean(pair[0]))
            D = P[:2, :2] + P[n : n + 2, n : n + 2] - P[:2, n : n + 2] - P[n : n + 2, :2]
            out.append(math.sqrt(max(float(np.trace(D)) / 2, 0.0)))
    return float(np.median(out)) / math.sqrt(2.0)


# ---------------------------------------------------------------------- hypotheses
def _hypotheses(look: _RepeatCandidates) -> list[tuple[Array, Index]]:
    """Return transforms T (3,), each with the three pairs (3, 2) it is of; those first that fit most neighbours."""
    from scipy.spatial import cKDTree

    triangles, shape = _triangles(look)
    if len(triangles) < 2:
        return []
    reach = 2.0 * look.tolerance
    gaps: Any = cKDTree(shape).query(shape, k=min(ALIKE + 1, len(shape)), distance_upper_bound=reach)
    one = np.repeat(np.arange(len(shape)), gaps[1].shape[1])
    two, miss = gaps[1].ravel(), gaps[0].ravel()
    keep = np.isfinite(miss) & (one < two)
    one, two, miss = one[keep], two[keep], miss[keep]
    pairs = np.stack([triangles[one], triangles[two]], axis=2)  # (M, 3, 2)
    free = look.may_be(pairs[..., 0], pairs[..., 1]).all(axis=1)
    order = np.flatnonzero(free)[np.argsort(miss[free], kind="stable")[:MOST_MATCHES]]
    pairs = pairs[order]
    T = _transforms(look.places[pairs[..., 0]], look.places[pairs[..., 1]])
    counts = _agreeing_nearby(look, T, pairs)
    best = np.argsort(-counts, kind="stable")
    return [(T[i], pairs[i]) for i in best[counts[best] >= FEWEST - 1].tolist()]


def _triangles(look: _RepeatCandidates) -> tuple[Index, Array]:
    """Return triangles (M, 3) of landmarks seen together, and their sides (M, 3) [m] and orientation as shapes (M, 4).

    The corners are ordered by the sides opposite to them.
    """
    near = np.full((len(look.near), NEAREST), -1)
    for i, mine in enumerate(look.near):
        near[i, : len(mine)] = mine[:NEAREST]
    two = np.array([*combinations(range(NEAREST), 2)])
    first = np.broadcast_to(np.arange(len(near))[:, None, None], (len(near), len(two), 1))
    corners = np.concatenate([first, near[:, two]], axis=2).reshape(-1, 3)
    corners = np.unique(np.sort(corners[(corners >= 0).all(axis=1)], axis=1), axis=0)
    corners = corners[:: max(1, -(-len(corners) // MOST_TRIANGLES))]
    p = look.places[corners]
    sides = np.linalg.norm(np.roll(p, -1, axis=1) - np.roll(p, -2, axis=1), axis=2)
    order = np.argsort(sides, axis=1)
    corners, sides = np.take_along_axis(corners, order, axis=1), np.take_along_axis(sides, order, axis=1)
    p = look.places[corners]
    u, v = p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]
    area = u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]
    wide = np.abs(area) > 2.0 * look.tolerance * sides[:, 2]
    mirrored = np.where(area > 0, 1e3, -1e3) * look.spacing
    return corners[wide], np.column_stack([sides, mirrored])[wide]


def _transforms(p: Array, q: Array) -> Array:
    """Return the poses T (M, 3) with the least squares of q - T p; p and q are (M, K, 2)."""
    a, b = p.mean(axis=1), q.mean(axis=1)
    u, v = p - a[:, None], q - b[:, None]
    turn = np.arctan2((u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]).sum(axis=1), (u * v).sum(axis=(1, 2)))
    c, s = np.cos(turn), np.sin(turn)
    x, y = b[:, 0] - c * a[:, 0] + s * a[:, 1], b[:, 1] - s * a[:, 0] - c * a[:, 1]
    return np.column_stack([x, y, turn])


def _moved(T: Array, p: Array) -> Array:
    """Return points p (M, K, 2), or (K, 2) for all, moved by T (M, 3)."""
    c, s = np.cos(T[:, 2])[:, None], np.sin(T[:, 2])[:, None]
    x, y = p[..., 0], p[..., 1]
    return np.stack([c * x - s * y + T[:, :1], s * x + c * y + T[:, 1:2]], axis=2)


def _agreeing_nearby(look: _RepeatCandidates, T: Array, pairs: Index) -> Index:
    """Return of each transform how many landmarks near its triangle it maps on others."""
    if not len(T):
        return np.zeros(0, dtype=np.int64)
    width = min(AROUND, max(len(near) for near in look.near))
    table = np.array([np.resize(near, width) if len(near) < width else near[:width] for near in look.near])
    mine = table[pairs[:, 0, 0]]  # (M, AROUND), some twice where there are few
    far, nearest = look.tree.query(_moved(T, look.places[mine]))
    same = (far <= 2.0 * look.tolerance) & look.may_be(mine, nearest)
    marked = np.sort(np.where(same, mine, -1), axis=1)
    return np.asarray((np.diff(marked, axis=1, prepend=-1) > 0).sum(axis=1) + 1)


# ---------------------------------------------------------------------- constellations
@dataclass(frozen=True, eq=False)
class _Constellation:
    """Pairs (K, 2) of landmarks that agree under T, and how many landmarks among them have no partner."""

    T: Array
    pairs: Index
    missing: int

    def holds(self, pairs: Index) -> bool:
        """Return whether other pairs are all among these, in either order."""
        mine = {*map(tuple, self.pairs.tolist())}
        return all((a, b) in mine or (b, a) in mine for a, b in pairs.tolist())

    def overlaps(self, other: _Constellation) -> bool:
        """Return whether a third of the landmarks are those of another one."""
        mine, its = {*self.pairs.ravel().tolist()}, {*other.pairs.ravel().tolist()}
        return 3 * len(mine & its) > min(len(mine), len(its))


def _grown(look: _RepeatCandidates, T: Array, pairs: Index) -> _Constellation:
    """Return a hypothesis with all pairs that agree with it.

    A landmark is of the part with which it was seen more often.
    """
    before: set[tuple[int, int]] = set()
    for _ in range(ROUNDS):
        a, b = _agreeing(look, T, pairs)
        free = look.may_be(a, b)
        if free.sum() < 3:
            break
        pairs = np.column_stack([a[free], b[free]])
        (T,) = _transforms(look.places[None, pairs[:, 0]], look.places[None, pairs[:, 1]])
        now = {*map(tuple, pairs.tolist())}
        if now == before:
            break
        before = now
    return _Constellation(T, pairs, _missing(look, T, pairs) if len(pairs) >= FEWEST else 0)


def _agreeing(look: _RepeatCandidates, T: Array, pairs: Index) -> tuple[Index, Index]:
    """Return the landmarks of the part of the first of pairs, and those of the other part, on which T moves them."""
    sides = _sides(look, pairs)
    return _matched(look, T, pairs, sides > 0, sides < 0)


def _matched(look: _RepeatCandidates, T: Array, pairs: Index, of: Flags, others: Flags) -> tuple[Index, Index]:
    """Return the landmarks of some (N,) that T, of these pairs, moves onto others (N,), each the nearest of its own."""
    middle = look.places[pairs[:, 0]].mean(axis=0)
    spread = math.sqrt(float(((look.places[pairs[:, 0]] - middle) ** 2).sum()))
    lever = np.linalg.norm(look.places - middle, axis=1) / max(spread, look.tolerance)
    reach = look.tolerance * (1.0 + lever)
    far, onto = look.tree.query(_moved(T[None], look.places)[0])
    a = np.flatnonzero(of & others[onto] & (far <= reach) & (reach <= LOOSE * look.spacing + look.tolerance))
    a = a[np.argsort(far[a], kind="stable")]
    b, first = np.unique(onto[a], return_index=True)
    return a[first], b


def _sides(look: _RepeatCandidates, pairs: Index) -> Index:
    """Return of each landmark with how many more of the first than of the second of pairs it was seen (N,)."""
    votes = np.zeros(len(look.names), dtype=np.int64)
    for column, vote in ((0, 1), (1, -1)):
        for i in pairs[:, column].tolist():
            votes[look.near[i]] += vote
            votes[i] += vote
    return votes


def _missing(look: _RepeatCandidates, T: Array, pairs: Index) -> int:
    """Return how many landmarks of either part have no partner and are among those that have."""
    sides = _sides(look, pairs)
    rest = np.ones(len(sides), dtype=np.bool_)
    rest[pairs.ravel()] = False
    hull = look.places[pairs[:, 1]]
    alone = [_moved(T[None], look.places[rest & (sides > 0)])[0], look.places[rest & (sides < 0)]]
    return int(_inside(hull, np.concatenate(alone)).sum())


def _inside(hull: Array, p: Array) -> Flags:
    """Return which points p (K, 2) are within the convex hull of others."""
    from scipy.spatial import Delaunay, QhullError

    if len(hull) < 3 or not len(p):
        return np.zeros(len(p), dtype=np.bool_)
    try:
        return np.asarray(Delaunay(hull).find_simplex(p) >= 0)
    except QhullError:  # they are on a line
        return np.zeros(len(p), dtype=np.bool_)


def _area(p: Array) -> float:
    from scipy.spatial import ConvexHull, QhullError

    try:
        return float(ConvexHull(p).volume)  # of two dimensions: the area
    except QhullError:
        return 0.0


# ---------------------------------------------------------------------- judgement
def _judged(look: _RepeatCandidates, found: _Constellation, all_: list[_Constellation]) -> Repeat | None:
    """Return the repeat that a constellation is, None if it may be chance."""
    from scipy.special import betainc

    k, m = len(found.pairs), len(found.pairs) + found.missing
    area = _area(look.places[found.pairs[:, 1]])
    if area <= 0.0:
        return None
    density = m / area
    edges, few = sum(min(len(near), NEAREST) for near in look.near) / 2, min(1.0, SAMPLE / m)

    def false_alarms(chance: float) -> float:
        return 2.0 * edges**2 * float(betainc(few * k - 2, few * (m - k) + 1, chance))

    chance = min(density * math.pi * look.tolerance**2, 1.0)
    if false_alarms(chance) > FALSE_ALARMS:
        return None
    p = false_alarms(max(chance, *(_self_similarity(look, part) for part in found.pairs.T)))
    if p > FALSE_ALARMS:
        return None
    pairs = found.pairs
    if np.median(pairs[:, 0]) > np.median(pairs[:, 1]):  # the order of landmarks is that of their age
        pairs = pairs[:, ::-1]
    (T,) = _transforms(look.places[None, pairs[:, 0]], look.places[None, pairs[:, 1]])
    back = np.linalg.norm(from_frame(T, look.places[pairs[:, 1]])[0] - look.places[pairs[:, 0]], axis=1)
    if np.median(back) <= look.spacing / 2:  # each part is the other one turned: the world is symmetric
        return None
    score, fits, agrees = _weighed(look, T, pairs, density)
    score += MISSED * found.missing
    rivals = any(
        other is not found and 2 * len(other.pairs) > k and other.overlaps(found) and _differ(found, other)
        for other in all_
    )
    # as likely by chance: the ratio exceeds 1 over it as seldom; one that the covariance excludes is less likely yet
    if score <= -math.log(FALSE_ALARMS if agrees else SURE):
        return None
    sure, newer = bool(p <= SURE and fits and not rivals), _newer(look, T, pairs)
    if sure:  # then two of a pair that were seen in one scan were so by a wrong association
        a, b = _matched(look, T, pairs, ~newer, newer)
        pairs = np.column_stack([a, b])[~(look.given[a] & look.given[b])]
    named = [(look.names[a], look.names[b]) for a, b in pairs.tolist()]
    named_newer = [look.names[i] for i in np.flatnonzero(newer).tolist()]
    middle = look.places[pairs[:, 1]].mean(axis=0)
    shift = middle - look.places[pairs[:, 0]].mean(axis=0)
    return Repeat(named, T, middle, shift, score, p, agrees, sure, named_newer)


def _newer(look: _RepeatCandidates, T: Array, pairs: Index) -> Flags:
    """Return which landmarks (N,) are of the newer part: begun since its onset, and seen with no more of the older one.

    The onset is where most of those that T moves onto younger ones have one on either side, others were taken for
    another; of such times that which parts fewest landmarks that were seen together.
    """
    n, every = len(look.names), np.ones(len(look.names), dtype=np.bool_)
    a, b = _matched(look, T, pairs, every, every)
    pairs = np.column_stack([a, b])[a < b]
    onset = int(np.lexsort((_parted(np.column_stack(np.divmod(look.codes, n)), n), -_parted(pairs, n)))[0])
    sides = _sides(look, pairs[(pairs[:, 0] < onset) & (onset <= pairs[:, 1])])
    return np.asarray((sides <= 0) & (np.arange(n) >= onset))


def _parted(pairs: Index, n: int) -> Index:
    """Return of each time (n,), that before a landmark, how many pairs (K, 2) in the order of their age it parts."""
    ends = (np.bincount(column, minlength=n) for column in np.sort(pairs, axis=1).T)
    begun, ended = (np.concatenate([[0], np.cumsum(each)[:-1]]) for each in ends)
    return np.asarray(begun - ended)


def _differ(one: _Constellation, other: _Constellation) -> bool:
    """Return whether two constellations pair the same landmarks with others."""
    mine = {frozenset(pair) for pair in one.pairs.tolist()}
    its = {frozenset(pair) for pair in other.pairs.tolist()}
    return 2 * len(mine & its) < min(len(mine), len(its))


def _self_similarity(look: _RepeatCandidates, part: Index) -> float:
    """Return the probability with which landmarks of a part agree with others of it that are certainly different.

    Each edge between two that were seen together is moved on each other; the probability is that of which the best
    transform is expected once.
    """
    from scipy.special import betaincinv

    middle = look.places[part].mean(axis=0)
    part = part[np.argsort(np.linalg.norm(look.places[part] - middle, axis=1), kind="stable")[:SAMPLE]]
    p = look.places[part]
    a, b = (x.ravel() for x in np.meshgrid(np.arange(len(part)), np.arange(len(part)), indexing="ij"))
    far = np.linalg.norm(p[a] - p[b], axis=1)
    rank = np.argsort(np.argsort(far.reshape(len(part), -1), axis=1), axis=1).ravel()
    edges = np.flatnonzero((a != b) & (rank <= NEAREST))
    one, two = (x.ravel() for x in np.meshgrid(edges, edges, indexing="ij"))
    alike = (np.abs(far[one] - far[two]) <= 2.0 * look.tolerance) & (a[one] != a[two]) & (b[one] != b[two])
    alike &= ~look.may_be(part[a[one]], part[a[two]]) & ~look.may_be(part[b[one]], part[b[two]])
    chosen, number = np.flatnonzero(alike), int(alike.sum())
    chosen = chosen[:: max(1, -(-len(chosen) // MOVES))]
    if not len(chosen):
        return 0.0
    one, two = one[chosen], two[chosen]
    T = _transforms(np.stack([p[a[one]], p[b[one]]], axis=1), np.stack([p[a[two]], p[b[two]]], axis=1))
    moved = _moved(T, p)  # (M, K, 2)
    gaps = (moved[:, :, None, 0] - p[:, 0]) ** 2 + (moved[:, :, None, 1] - p[:, 1]) ** 2
    gaps[:, np.arange(len(p)), np.arange(len(p))] = np.inf
    k = (gaps.min(axis=2) <= look.tolerance**2).sum(axis=1) - 2
    m = _inside(p, moved.reshape(-1, 2)).reshape(len(T), -1).sum(axis=1) - 2
    some = (k > 0) & (m > 0)
    if not some.any():
        return 0.0
    k, m = k[some], np.maximum(m[some], k[some])
    return float(betaincinv(k, m - k + 1, 1.0 / number).max())


def _weighed(look: _RepeatCandidates, T: Array, pairs: Index, density: float) -> tuple[float, bool, bool]:
    """Return the log-likelihood ratio of pairs that are one, T unknown, whether their shapes fit, and places do."""
    some = pairs[:: max(1, -(-len(pairs) // WEIGHED))]
    k, rows = len(some), np.concatenate([some[:, 0], some[:, 1]])
    P, p = look.covariance(rows), look.places[rows]
    moved = from_frame(T, p[:k])[0]
    slack = (SLACK * look.spacing / 2) ** 2 * np.eye(2 * k)
    c, s = math.cos(T[2]), math.sin(T[2])
    J = np.hstack([-np.kron(np.eye(k), np.array([[c, -s], [s, c]])), np.eye(2 * k)])
    offset = moved - moved.mean(axis=0)
    G = np.column_stack([np.tile(np.eye(2), (k, 1)), np.column_stack([-offset[:, 1], offset[:, 0]]).ravel()])
    extent = float(np.ptp(look.places, axis=0).max())
    prior = np.diag([extent**2, extent**2, math.pi**2 / 3.0])
    Z = J @ P @ J.T + slack + G @ prior @ G.T
    z = p[k:] - moved
    score = float(log_ratios(z, Z, np.full(k, math.log(density))).ratio.sum())
    fits = z.ravel() @ np.linalg.solve(Z, z.ravel()) <= chi2_gate(FITS, 2 * k - 3)
    J = np.hstack([-np.eye(2 * k), np.eye(2 * k)])
    Z = J @ P @ J.T + EQUAL_M**2 * np.eye(2 * k) + slack
    z = (p[k:] - p[:k]).ravel()
    return score, bool(fits), bool(z @ np.linalg.solve(Z, z) <= chi2_gate(GATE, 2 * k))


# ---------------------------------------------------------------------- merging
def is_due(tracks: Tracks) -> bool:
    """Return whether so many landmarks have come or gone that a map should be searched again."""
    return tracks.changes - tracks.searched >= max(GROWN, GROWN_BY * len(tracks.confirmed))


def is_in(part: list[Id], tracks: Tracks) -> bool | None:
    """Return whether the landmarks of the last scan are of a part of the map; None if only some are."""
    newer = {*part}
    inside = [name in newer for name in tracks.last_scan if name in tracks.confirmed]
    share = sum(inside) / max(len(inside), 1)
    return None if not inside or abs(share - 0.5) < CLEAR else share > 0.5


class Displacement(NamedTuple):
    """Blocks `slots` whose means move to `means`, and the covariance of their rows to F P F' + Q."""

    slots: list[int]
    means: list[Array]
    F: Array
    Q: Array


def displacement(map_: Map, slots: list[int], repeat: Repeat) -> Displacement:
    """Return the move of blocks of the newer part of a repeat onto the older one, of an error unknown until now.

    The shift and the turn of the whole part, about the middle of its pairs, have sigmas as large as they are: a robot
    that lost its way by so much might have lost it so.
    """
    R, turn = rotation(-repeat.T[2]), -float(repeat.T[2])
    t = -R @ repeat.T[:2]
    middle = from_frame(np.array([*t, turn]), repeat.middle)[0]
    means, F, G = [], [], []
    for slot in slots:
        space, x = map_.spaces[slot], map_.mean(slot)
        assert space is not None
        moved, F_x = space.rotated(x, turn), np.eye(space.dof)
        G_x = np.zeros((space.dof, 3))
        for kind, at, k in space.atoms.tolist():
            if kind == VECTOR:
                moved[at : at + 2] += t
                off = moved[at : at + 2] - middle
                F_x[k : k + 2, k : k + 2] = R
                G_x[k : k + 2] = [[1.0, 0.0, -off[1]], [0.0, 1.0, off[0]]]
            elif kind == HEADING:
                G_x[k] = [0.0, 0.0, 1.0]
        means.append(moved)
        F.append(F_x)
        G.append(G_x)
    far, all_ = float(repeat.shift @ repeat.shift), np.concatenate(G)
    return Displacement(
        slots, means, block_diagonal(F), all_ @ np.diag([far, far, max(abs(turn), TURNED_RAD) ** 2]) @ all_.T
    )
