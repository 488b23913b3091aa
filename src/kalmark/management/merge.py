"""Two landmarks that are one: found by their joint covariance, constrained equal, and one of them removed.

A loop that closes late leaves duplicates: the robot did not recognise the place and mapped it again.  Landmarks that
were never observed in one scan may be the same; the recently observed ones are compared together, and merged only when
their log-likelihood ratio is accepted (`association/ratio.py`).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from kalmark.arrays import Array, Index
from kalmark.association.ratio import log_density_about, log_ratios
from kalmark.events import Id
from kalmark.filter import kernels
from kalmark.filter.layout import P_AT, P_SIZE
from kalmark.filter.map import Map, StochasticMap
from kalmark.geometry.gaussian import gate as chi2_gate
from kalmark.geometry.spaces import SCALAR, VECTOR, VECTOR3, Space
from kalmark.tracks.classes import distance_of_landmarks
from kalmark.tracks.scan import Start
from kalmark.tracks.track import RECENT, Tracks

Pair = tuple[Id, Id]

EVERY = 5  # observations of a landmark, after which it is compared again
NEAREST = 128  # landmarks near it, among which are those that it may be,
NEAR = 32  # and so many at first:
FEW = 3  # of these, by where they became inactive, show how near the nearest is
TRIES = 8  # of those that it may be
WIDE = 1.5  # times the gate of the nearest it may be, within which all are that it may be
SLACK_M, SLACK_RAD = 0.3, 0.3  # by which covisible landmarks may miss, and by which they may be turned
GATE = 0.99
EQUAL_M = 1e-4  # how equal two landmarks are made
SLACK = 0.02  # of the spacing of landmarks: a sigma for errors that are not in the covariance
LINEAR = (VECTOR, VECTOR3, SCALAR)  # atoms of which a difference is one


class Merge(NamedTuple):
    """Pairs of landmarks that are one, and the log-likelihood ratio of all of them together."""

    pairs: list[Pair]
    ratio: float


class MergeSearch:
    """Landmarks to compare after a scan: those observed in it, and those covisible with merged ones."""

    def __init__(self, tracks: Tracks, observed: Sequence[Id]) -> None:
        self._tracks, self._observed = tracks, iter(observed)
        self._merged: list[Id] = []
        self._around: list[Id] = []
        self._tried: set[Id] | None = None

    def next(self) -> Id | None:
        """Return the next landmark to compare, None at the end."""
        tracks = self._tracks
        for name in self._observed:
            if name in tracks.confirmed and (self._merged or self._is_due(name)) and self._fits(name):
                return name
        while self._around or self._merged:
            if self._tried is None:
                self._tried = set(tracks.recent)
            if not self._around:
                at = self._merged.pop(0)
                covisible = tracks.confirmed[at].covisible if at in tracks.confirmed else ()
                self._around = sorted((n for n in covisible if n not in self._tried), key=str)
                self._tried.update(self._around)
                continue
            name = self._around.pop(0)
            if name in tracks.confirmed and self._fits(name):
                return name
        return None

    def was_merged(self, kept: Id) -> None:
        """Take note that a landmark has been merged: now the others are known better relative to each other."""
        self._merged.append(kept)

    @property
    def is_first_pass(self) -> bool:
        """True if the landmarks of the scan itself are being compared."""
        return self._tried is None

    def _is_due(self, name: Id) -> bool:
        """Return whether to compare a landmark: if the map has not changed, only when observed twice as often."""
        track = self._tracks.confirmed[name]
        count, (before, changes) = track.observations, track.compared
        return count % EVERY == 0 and (changes != self._tracks.changes or count >= 2 * before)

    def _fits(self, name: Id) -> bool:
        return all(kind in LINEAR for kind in self._tracks.confirmed[name].model.space.kinds)


def proposal(map_: Map, tracks: Tracks, name: Id, robot: int, sensor: Array, odds: float) -> Merge | None:
    """Return a landmark, and others recently observed, paired with those that they are; None if that is not accepted.

    Its possible partners are tried one by one: the others, moved along, are paired with their nearest.  Of the
    hypotheses with most pairs, the one of the largest log ratio must be accepted at these odds against chance and
    against any other that has no pair in common with it.  They may miss by `SLACK` of the distance to the nearest that
    was seen with the first.  `robot` is the slot of a robot, `sensor` (3,) or (7,) the pose of the sensor.
    """
    d = 2 if len(sensor) == 3 else 3
    l = map_.means(tracks.slots_of([name, *(tracks.confirmed[name].covisible & tracks.confirmed.keys() - {name})]), d)
    slack_m = max(SLACK * min(np.linalg.norm(l[1:] - l[0], axis=1), default=0.0), EQUAL_M)
    look, tried = _Reading(map_, tracks, robot, d, slack_m), []
    for pairs in _hypotheses(look, name, l[0]):
        z, Z = look.differences(pairs)
        chance = log_density_about(map_, tracks, [name], sensor)
        of_classes = [distance_of_landmarks(*(tracks.confirmed[n].classes for n in pair)) for pair in pairs]
        found = log_ratios(z, Z, chance + 0.5 * np.array(of_classes))
        best = int(np.argmax(np.cumsum(found.ratio))) + 1
        d2 = 2.0 * float((found.bound - found.ratio)[:best].sum())
        if d2 <= chi2_gate(GATE, z.shape[1] * best):
            tried.append(Merge([pairs[i] for i in found.order[:best]], float(found.ratio[:best].sum())))
    if not tried:
        return None
    chosen = max(tried, key=lambda each: each.ratio)
    rival = max((other.ratio for other in tried if not set(other.pairs) & set(chosen.pairs)), default=0.0)
    return chosen if chosen.ratio - max(rival, 0.0) >= math.log(odds) else None


def difference(map_: Map, tracks: Tracks, pair: Pair) -> Start:
    """Return the difference of two landmarks as a block, to be observed as zero."""
    one, other = (tracks.slot(name) for name in pair)
    space = tracks.confirmed[pair[0]].model.space
    n = space.dof
    G = np.hstack([-np.eye(n), np.eye(n)])
    l = map_.mean(other) - map_.mean(one)
    return Start(Space("difference", space.kinds), l, ((one, n), (other, n)), G, np.zeros((n, n)))


def order_pairs(tracks: Tracks, pairs: Sequence[Pair]) -> list[Pair]:
    """Return of each pair the landmark that stays and the one that goes: an id of the log stays, else the older one."""
    age = {name: i for i, name in enumerate(tracks.confirmed)}
    sorted_ = [sorted(pair, key=lambda name: (tracks.is_invented(name), age[name])) for pair in pairs]
    return [(kept, gone) for kept, gone in sorted_]


class _Reading(NamedTuple):
    """Data to compare landmarks of d dimensions, which may miss by `slack_m`."""

    map: Map
    tracks: Tracks
    robot: int
    d: int
    slack_m: float

    def places(self, names: Sequence[Id]) -> Array:
        """Return where landmarks are (N, d)."""
        return self.map.means(self.tracks.slots_of(names), self.d) if names else np.zeros((0, self.d))

    def marginal(self, names: Sequence[Id]) -> tuple[StochasticMap, Index]:
        """Return a map to read landmarks from, and their slots (K,) there."""
        m, _, _, here = self.map.marginal(self.robot, -1, self.tracks.slots_of(names))
        return m, here

    def differences(self, pairs: Sequence[Pair]) -> tuple[Array, Array]:
        """Return the differences z (M, n) of pairs of landmarks and their joint covariance (M n, M n)."""
        names = list(dict.fromkeys(name for pair in pairs for name in pair))
        m, here = self.marginal(names)
        n = int(m.blocks[here[0], P_SIZE])
        P = kernels.submatrix(m.P, (m.blocks[here, P_AT][:, None] + np.arange(n)).ravel())
        at, rows = {name: i for i, name in enumerate(names)}, np.arange(len(pairs))
        of = np.zeros((len(pairs), len(names)))
        of[rows, [at[b] for _, b in pairs]] = 1.0
        of[rows, [at[a] for a, _ in pairs]] = -1.0
        J = (of[:, None, :, None] * np.eye(n)[:, None]).reshape(len(pairs) * n, -1)
        slack = np.where(np.arange(n) < self.d, self.slack_m, EQUAL_M) ** 2
        return of @ m.means(here, n), J @ P @ J.T + np.diag(np.tile(slack, len(pairs)))


def _hypotheses(look: _Reading, name: Id, at: Array) -> Iterator[list[Pair]]:
    """Return what a landmark `at` (d,) and others recently observed may be: lists of pairs, its own first."""
    from scipy.spatial import cKDTree

    tracks = look.tracks
    for count in (NEAR, NEAREST):  # most can be none of those nearby, and so of none
        others, possible = _others(look, name, at, count)
        enough = count == NEAREST or len(possible) >= FEW
        if enough and (not possible or _is_out_of_reach(look, name, [others[l] for l in possible[:FEW]])):
            return
    places = look.places(others)
    far = np.linalg.norm(places - at, axis=1)
    possible.sort(key=lambda l: far[l])
    reach = _reach(look.differences([(name, others[possible[0]])])[1])
    possible = [l for l in possible if far[l] <= reach]
    if not possible:
        return
    covisible = _covisible(look, name)
    mine = look.places(covisible)
    moved = mine[:, None] + (places[possible] - at)  # (C, L, d): were the landmark the l-th that it may be
    gaps: Any = cKDTree(places).query(moved)
    found, nearest = gaps[0], gaps[1]
    given = {n for n in others if not tracks.is_invented(n)}
    known = [tracks.confirmed[c].covisible | {c} | (given if not tracks.is_invented(c) else set()) for c in covisible]
    apart = np.array([[o in different for o in others] for different in known], dtype=np.bool_)
    apart = apart.reshape(len(covisible), len(others))
    found[np.take_along_axis(apart, nearest, axis=1)] = np.inf
    slack = SLACK_M + SLACK_RAD * np.linalg.norm(mine - at, axis=1)[:, None]
    score = np.maximum(1.0 - found / slack, 0.0).sum(axis=0)
    for i in np.argsort(-score, kind="stable")[:TRIES].tolist():
        first = (name, others[possible[i]])
        z, Z = look.differences([first])
        if z[0] @ np.linalg.solve(Z, z[0]) <= chi2_gate(GATE, len(Z)):
            pairs, used = [first], {*first}
            for c in np.argsort(found[:, i], kind="stable").tolist():
                pair = covisible[c], others[nearest[c, i]]
                if found[c, i] <= slack[c, 0] and used.isdisjoint(pair):
                    pairs.append(pair)
                    used |= {*pair}
            yield pairs


def _others(look: _Reading, name: Id, at: Array, count: int) -> tuple[list[Id], list[int]]:
    """Return the landmarks nearest to one that is `at` (2 or 3,), and the numbers of those that it may be."""
    tracks, track = look.tracks, look.tracks.confirmed[name]
    sorts = tracks.sorts_of(frozenset({track.model.kind}), len(look.map.blocks))
    near = [tracks.names[slot] for slot in look.map.around(sorts, at, count).tolist()]
    others = [n for n in near if tracks.confirmed[n].covisible and n != name]
    by_id = not tracks.is_invented(name)  # two ids are two landmarks
    different = track.covisible
    return others, [l for l, o in enumerate(others) if o not in different and (not by_id or tracks.is_invented(o))]


def _covisible(look: _Reading, name: Id) -> list[Id]:
    """Return the landmarks that must have duplicates too: those recently observed, or once covisible with it."""
    tracks, confirmed = look.tracks, look.tracks.confirmed
    recently = name in tracks.recent
    others = [n for n in (tracks.recent if recently else sorted(confirmed[name].covisible, key=str)) if n != name]
    kind = confirmed[name].model.kind
    others = [n for n in others if n in confirmed and confirmed[n].covisible and confirmed[n].model.kind == kind]
    if recently or len(others) <= RECENT:
        return others
    far = np.linalg.norm(look.places(others) - look.places([name])[0], axis=1)
    return [others[i] for i in np.argsort(far, kind="stable")[:RECENT].tolist()]


def _reach(Z: Array) -> float:
    """Return within which distance a landmark may be another, Z (n, n) being that of the nearest that it may be."""
    return WIDE * math.sqrt(chi2_gate(GATE, len(Z)) * float(np.linalg.eigvalsh(Z)[-1]))


def _is_out_of_reach(look: _Reading, name: Id, others: Sequence[Id]) -> bool:
    """Return whether a landmark can be none of some others."""
    m, here = look.marginal([name, *others])
    l = m.means(here, look.d)
    far = np.linalg.norm(l[1:] - l[0], axis=1)
    i = int(np.argmin(far))
    P = m.covariance([here[0], here[1 + i]])
    n = len(P) // 2
    return bool(far[i] > _reach(P[:n, :n] + P[n:, n:] - P[:n, n:] - P[n:, :n] + look.slack_m**2 * np.eye(n)))
