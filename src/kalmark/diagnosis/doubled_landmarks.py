"""Faults that the order of observations shows: duplicated landmarks, landmarks not observed again, a moved robot.

A residual shows none of them: each landmark fits its own observations.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import chdtr

from kalmark.arrays import Array, Flags
from kalmark.batch.batch_state import Ints
from kalmark.diagnosis.single_ids import SAME, SECOND
from kalmark.geometry.angles import wrap
from kalmark.results.run import Run

NEIGHBOURS = 3  # of a landmark that may be the same thing
NEAR_SCANS = 5  # within which both of two landmarks in view would be seen
SELDOM = 1e-4  # the probability, over all pairs, that two things are never seen together by chance
LEAST_SEEN = 4  # landmarks that are seen until a robot is moved
EDGES = 0.05, 0.95  # of the bearings and ranges of all observations: what is beyond them may be out of view
TINY = 1e-300
LATER, FEW_BACK, MOSTLY = 20, 0.25, 0.5  # scans after it, in which few of them are seen, and most landmarks are new


class Moment(NamedTuple):
    """The scan `step`, at `t_s` of the log, at which a robot lost sight of so many landmarks at once.

    `score` is the logarithm of how seldom chance does that in a run; 0 if they are soon seen again, or nothing new is.
    """

    step: int
    t_s: float
    robot: str
    number: int
    score: float


class Pair(NamedTuple):
    """A landmark and another one that are one thing; `score` is the logarithm of how seldom chance does that."""

    name: str
    other: str
    score: float


def find_split_landmarks(run: Run) -> list[Pair]:
    """Return pairs of near landmarks that are one thing.

    They are observed in turn by one sensor, within a few of its scans, but never together.  Of two things, each is seen
    in a share p of the scans between others in which it is, so both are in p^2 of them.
    """
    h, where, found = run.history, _places(run), dict[tuple[str, str], Pair]()
    for key in sorted({*h.sensor_keys()}):
        seen = _observed_in(run, h.made_by(*key))
        names = [name for name in seen if name in where and not name.endswith(SECOND)]
        if len(names) < 2:
            continue
        places = np.array([where[name] for name in names])
        never, least = -np.log1p(-(_regularity(seen.values()) ** 2)), np.log(len(names) * NEIGHBOURS / SELDOM)
        near = cKDTree(places).query(places, k=range(2, 2 + min(NEIGHBOURS, len(names) - 1)))[1]
        for a, b in sorted({(min(k, j), max(k, j)) for k, others in enumerate(near.tolist()) for j in others}):
            pair = Pair(names[a], names[b], float(never * _in_turn(seen[names[a]], seen[names[b]])))
            if pair.score > least:
                found[pair[:2]] = pair
    return [*found.values()]


class Revisits(NamedTuple):
    """Counts of landmarks that came into view again, of those not observed then, and their first time, s of the log.

    `score` is the logarithm of how seldom chance misses so many.
    """

    number: int
    unseen: int
    since_s: float
    score: float


def unseen_counts(run: Run) -> Revisits | None:
    """Return counts of landmarks that were not observed where they were before; None if that is rare, or by chance.

    A thing that stands is seen again from where it was seen, within a share `SAME` of its distance: nothing new hides
    it there.  It is missed by chance in (1 - p)^n of the visits of n scans, p the share of scans in which it is seen on
    the others.  One that is in the map twice, or begun where nothing is, is missed.
    """
    visits = [visit for robot in run.history.robots if not run.history.in_space for visit in _visits(run, robot)]
    scans, seen, t_s = np.array(visits).reshape(-1, 3).T
    missed = seen == 0
    p = seen.sum() / max(scans[~missed].sum(), 1.0)
    chance = float(chdtr(2.0 * missed.sum(), 2.0 * float(np.sum((1.0 - p) ** scans)))) if missed.any() else 1.0
    if chance > SELDOM or missed.mean() <= FEW_BACK:
        return None
    return Revisits(len(missed), int(missed.sum()), float(t_s[missed].min()), -math.log(max(chance, TINY)))


def _visits(run: Run, robot: str) -> Iterator[tuple[int, int, float]]:
    """Yield of each time a landmark came into view again the scans in which it was, those that saw it, and the time."""
    h, where = run.history, _places(run)
    used = (h.observers == robot) & h.fused & np.isin(h.landmark, [*where])
    if not used.any():
        return
    steps = np.unique(h.step[(h.observers == robot) & ~h.of_own])
    poses, scan = h.poses[steps], np.searchsorted(steps, h.step[used])
    far, bearing = _view(poses[scan], np.array([where[name] for name in h.landmark[used].tolist()]))
    (low, high), most = np.quantile(bearing, EDGES), np.quantile(far, EDGES[1])
    for name, place in where.items():
        mine = np.unique(scan[h.landmark[used] == name])
        if len(mine) < LEAST_SEEN:
            continue
        apart, k = cKDTree(poses[mine, :2]).query(poses[:, :2])
        r, b = _view(poses, place)
        inside = (apart < SAME * r[mine[k]]) & (b > low) & (b < high) & (r < most)
        inside[: mine[0]] = False
        there = np.union1d(mine, np.flatnonzero(inside))
        for visit in np.split(there, np.flatnonzero(np.diff(there) > LATER) + 1)[1:]:
            seen = int(np.isin(visit, mine).sum())
            if seen or len(visit) >= LEAST_SEEN:
                yield len(visit), seen, h.at_s(steps[visit[0]])


def _view(poses: Array, places: Array) -> tuple[Array, Array]:
    """Return ranges and bearings (K,) of places (K, 2), or of one, from poses (K, 3)."""
    v = places - poses[:, :2]
    return np.linalg.norm(v, axis=1), np.asarray(wrap(np.arctan2(v[:, 1], v[:, 0]) - poses[:, 2]))


def landmark_spacing(run: Run) -> float:
    """Return the median distance of a landmark to the next one, m."""
    places = np.array([*_places(run).values()])
    return float(np.median(cKDTree(places).query(places, k=[2])[0])) if len(places) > 1 else 0.0


def _places(run: Run) -> dict[str, Array]:
    """Return the positions (2,) or (3,) of the landmarks that have one."""
    d, marks = 3 if run.landmarks.in_space else 2, run.landmarks
    where = {str(id_): mean[:d] for id_, mean in zip(marks.ids, marks.means, strict=True)}
    return {name: place for name, place in where.items() if np.isfinite(place).all()}


def _observed_in(run: Run, mine: Flags) -> dict[str, Ints]:
    """Return the scans (k,) of two landmarks or more in which each landmark was observed, by `mine` (O,) of all.

    They are numbered as those of that sensor.
    """
    h = run.history
    used = mine & (h.outcome == "associated")
    used &= np.bincount(h.step[used], minlength=len(h.t_ns))[h.step] > 1
    if not used.any():
        return {}
    order = np.argsort(h.landmark[used], kind="stable")
    names, first = np.unique(h.landmark[used][order], return_index=True)
    scans = np.searchsorted(np.unique(h.step[mine]), h.step[used][order])
    return dict(zip(names.tolist(), np.split(scans, first[1:]), strict=True))


def _regularity(all_scans: Iterable[Ints]) -> float:
    """Return the share of scans in which a landmark is seen, of those between two in which it is."""
    gaps = np.concatenate([np.diff(scans) for scans in all_scans])
    there, left_out = float((gaps == 1).sum()), float((gaps == 2).sum())
    return there / (there + left_out + 1.0)


def _in_turn(a: Ints, b: Ints) -> int:
    """Return how many observations of two landmarks alternate, 0 if they were ever seen together."""
    scans, of = np.concatenate([a, b]), np.repeat([0, 1], [len(a), len(b)])
    order = np.argsort(scans, kind="stable")
    gaps, changes = np.diff(scans[order]), np.diff(of[order]) != 0
    return 0 if (gaps == 0).any() else int((changes & (gaps <= NEAR_SCANS)).sum())


def vanished_landmarks(run: Run) -> list[Moment]:
    """Return the time after which a robot observes none of its earlier landmarks any more, without ids.

    Those of the last scans are compared with those of the next ones.  Of such landmarks a share p is seen again, so by
    chance (1 - p)^n of n vanish together.
    """
    h, found = run.history, list[Moment]()
    used = (h.id == "") & np.isin(h.outcome, ("associated", "new"))
    names, first = np.unique(h.landmark[used], return_index=True)
    begun = dict(zip(names.tolist(), h.step[used][first].tolist(), strict=True))
    for robot in dict.fromkeys(h.observers[used].tolist()):
        steps, mine = np.flatnonzero(h.robot == robot), used & (h.observers == robot)
        seen: list[set[str]] = [set() for _ in steps]
        for k, name in zip(np.searchsorted(steps, h.step[mine]).tolist(), h.landmark[mine].tolist(), strict=True):
            seen[k].add(name)
        moments, total, again = list[tuple[int, set[str]]](), 1, 0
        for k in range(1, len(steps)):
            before, after = set().union(*seen[max(k - NEAR_SCANS, 0) : k]), set().union(*seen[k : k + NEAR_SCANS])
            if len(before) >= LEAST_SEEN:
                total, again = total + len(before), again + len(before & after)
                if after and not before & after:
                    moments.append((k, before))
        for k, before in moments:
            later = set().union(*seen[k : k + LATER])
            anew = sum(begun[name] >= steps[k] for name in later)
            gone = len(before & later) <= FEW_BACK * len(before) and anew >= max(LEAST_SEEN, MOSTLY * len(later))
            score = -len(before) * np.log1p(-again / total) - np.log(len(steps) / SELDOM)
            found.append(Moment(int(steps[k]), h.at_s(steps[k]), robot, len(before), float(score) if gone else 0.0))
    return found
