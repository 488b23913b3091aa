"""Log-likelihood-ratio test of a pairing against clutter and against the next best pairing.

A pair of an observation and a landmark, or of two landmarks that may be one, has the innovation z with the likelihood
N(z; 0, Z).  If they are not the same, something stands there by chance, with the density of landmarks in the map.  The
logarithm of the quotient is the log ratio of the pair; of pairs that depend on each other, given those before.  A first
pair with a landmark not observed for long has a small ratio, because the pose is uncertain against it; a second one
beside it a large one, because it must agree with the first.  So the pairs that close a loop are decided together, and
deferred until their joint ratio suffices.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from kalmark.arrays import Array
from kalmark.association.protocol import DEFERRED, Decision
from kalmark.association.query import Query
from kalmark.events import Id
from kalmark.filter.map import Map
from kalmark.geometry.landmark_density import NEIGHBOURS, log_density, log_volume_change
from kalmark.tracks.track import Tracks

LOOSE = math.log(10.0)  # above it the place of a pair is so small against the landmarks' spacing that it needs no other


def log_density_about(map_: Map, tracks: Tracks, names: Sequence[Id], sensor: Array) -> float:
    """Return the logarithm of how many landmarks there are per m^2 or m^3 about some of them.

    `sensor` is a pose, (3,) or (7,).
    Only covisible landmarks count: they are certainly others.  One that was always alone has all the space to itself
    from which it was observed.
    """
    d, found = 2 if len(sensor) == 3 else 3, []
    for name in names:
        if name in tracks.known:
            of = tracks.known.of_kind[str(tracks.known.kind(name))]
            at = tracks.known.mean(name)[:d]
            gaps = of.gaps(at, NEIGHBOURS)
        else:
            others = [n for n in tracks.confirmed[name].covisible if n != name and n in tracks.confirmed]
            at, *p = map_.means(tracks.slots_of([name, *others]), d)
            gaps = np.sort([np.linalg.norm(other - at) for other in p])
        found.append(log_density(gaps[None], float(np.linalg.norm(at - sensor[:d])), d)[0])
    return float(np.median(found))


class LogRatios(NamedTuple):
    """An order of M pairs and the log ratio of each in it (M,), given those before; `bound` is it for d2 = 0."""

    order: list[int]
    ratio: Array
    bound: Array


def log_ratios(z: Array, Z: Array, chance: Array, given: int = 0) -> LogRatios:
    """Return the log ratios of M pairs, innovations z (M, p) with covariance Z (M p, M p), the largest first.

    `chance` (M,) is the logarithm of the density of landmarks in the coordinates of z.  The first `given` are taken as
    they are.
    """
    count, p = z.shape
    place = chance + 0.5 * p * math.log(2 * math.pi)
    S, v = Z.copy(), z.copy()
    order: list[int] = []
    ratios, bounds, left = [], [], list(range(count))
    while left:
        some = left if len(order) >= given else left[:1]
        blocks = np.array([S[i * p : (i + 1) * p, i * p : (i + 1) * p] for i in some])
        d2 = np.einsum("ka,ka->k", v[some], np.linalg.solve(blocks, v[some][..., None])[..., 0])
        ratio = -0.5 * d2 - 0.5 * np.linalg.slogdet(blocks)[1] - place[some]
        best = int(np.argmax(ratio))
        bounds.append(float(ratio[best] + 0.5 * d2[best]))
        i = some[best]
        order.append(i)
        ratios.append(float(ratio[best]))
        left.remove(i)
        K = np.linalg.solve(blocks[best], S[i * p : (i + 1) * p]).T
        v -= (K @ v[i]).reshape(count, p)
        S -= K @ S[i * p : (i + 1) * p]
    return LogRatios(order, np.array(ratios), np.array(bounds))


def doubtful_pairs(found: LogRatios, given: int, odds: float) -> list[int]:
    """Return the pairs that are not accepted at these odds.

    A pair whose place could hold other landmarks begins a group, which ends before the next such pair.  A group is
    accepted if its joint ratio reaches the odds, and if it has more pairs than contradict it.
    """
    out: list[int] = []
    starts = [i for i in range(given, len(found.order)) if min(found.bound[i], found.ratio[i] + LOOSE) < LOOSE]
    for start, end in reversed(list(pairwise([*starts, len(found.order)]))):
        if found.ratio[start:end].sum() < math.log(odds) or end - start <= len(out):
            out += found.order[start:end]
    return out


def defer_doubtful_pairs(query: Query, decisions: list[Decision], odds: float) -> list[Decision]:
    """Return the decisions, of pairs that are not accepted at these odds that they are deferred.

    Observations with ids are accepted.
    """
    scan, tracks, ids = query.scan, query.scan.tracks, query.ids
    mapped = [name in tracks.confirmed or name in tracks.known for name, _ in decisions]
    mine = [k for k, there in enumerate(mapped) if ids[k] is None and there]
    if not mine or not scan.channel.gives_places:
        return decisions
    sure = [k for k, there in enumerate(mapped) if ids[k] is not None and there]
    rows = np.array([*sure, *mine])
    names: list[Any] = [decisions[k][0] for k in rows]
    z, Z = query.jointly(rows, names)
    V_y = scan.channel.sensor.invert(scan.y[rows])[1][:, : scan.dimensions]
    change = log_volume_change(V_y @ scan.R[rows] @ V_y.swapaxes(1, 2), scan.R[rows])
    chance = log_density_about(scan.map, tracks, names, scan.pose()) + change
    of_pairs, of_new = scan.class_distances(names)
    chance += 0.5 * (of_pairs[rows, np.arange(len(rows))] - of_new[rows])
    found = log_ratios(z, Z, chance, len(sure))
    out, at = list(decisions), dict(zip(found.order, found.ratio.tolist(), strict=True))
    for i in doubtful_pairs(found, len(sure), odds):
        out[rows[i]] = (DEFERRED, f"{names[i]!r} or a new landmark: the odds are {math.exp(min(at[i], 50.0)):.2g} to 1")
    return out
