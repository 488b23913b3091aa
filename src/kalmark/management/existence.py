"""Existence of landmarks: their log odds, by the looks of a sensor in which each was expected, and seen or not.

A look (`tracks/looks.py`) counts for the landmarks about the sensor that are surely within its field of view and range,
and that were seen from that direction, as far away.  Of a corner, or of what is behind a wall, other looks count less:
together those from one side count no more than that something hides it there, which is as likely as in the log.
Of each are kept how often it was `seen`, the misses until it was last seen, `absent`, and those since, `missed`.  The
detection probabilities of the landmarks of a map are spread by a Beta density (a, b), the likeliest one for these
counts beside a share of landmarks that never were there.  A thing that stands is compared with two that do not; these
are still seen with a probability f of density (1, 1 / p_false - 1).  One that is gone since it was last seen:

    log int Beta(p | a + seen, b + absent) (1 - p)^missed dp - log int Beta(f) (1 - f)^missed df,

and one that never was there:

    log int Beta(p | a, b) p^seen (1 - p)^(absent + missed) dp - log int Beta(f) f^seen (1 - f)^(absent + missed) df.

The lesser of them, from log `odds` on, are the log odds; at minus that the landmark is marked, or removed where
that is wanted.  Probabilities that are stated have narrow densities.  Thrun et al. 10; Montemerlo and Thrun; the
Beta-binomial: Gelman et al., Bayesian Data Analysis 5.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence, Set
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from scipy.special import betaln

from kalmark.arrays import Array, Flags, Index
from kalmark.events import Id
from kalmark.geometry.gaussian import gate
from kalmark.management.upkeep import Upkeep
from kalmark.tracks.channel import Channel, ObservationModel
from kalmark.tracks.known_landmarks import Known
from kalmark.tracks.looks import SIDE, Looks, cells_of, sectors_of
from kalmark.tracks.scan import ScanContext
from kalmark.tracks.survey_checks import SURVEYED
from kalmark.tracks.track import Track, Tracks

USED = ("associated", "new")
AROUND = 64  # landmarks nearest to the sensor that may be in view
MARGIN = 0.02  # of ranges and of the field of view, within which a landmark may be out of view after all
OCCLUDER_M = 0.3  # half the width of an object that hides others
LEAST, MOST = 2.0, 512  # looks at a landmark that has a share of its own; such landmarks that are compared
SURE = 1e6  # looks that a stated detection probability is worth
MEANS, WORTH = np.linspace(0.05, 0.98, 32)[None], np.geomspace(1.0, 256.0, 9)[:, None]  # of densities that are tried
SHARES = 1e-3, 1e-2, 3e-2, 0.1, 0.3, 0.5  # of landmarks that never were there
REFIT = 64  # looks until the detection probability is estimated again


class Detection(NamedTuple):
    """The Beta density (a, b) of the detection probabilities of landmarks."""

    a: Any = 0.5
    b: Any = 0.5


def concerns(scan: ScanContext, upkeep: Upkeep) -> bool:
    """Return whether a scan counts: by default if association decides what was seen, and where things are is seen."""
    ids = scan.event.ids
    hidden = upkeep.p_detect is not None or (scan.channel.gives_places and (ids is None or None in ids))
    return hidden and scan.channel.has_limits


class ObservedAndMissed(NamedTuple):
    """The landmarks that a scan was `seen` to show, and those it `missed`, with what each miss counts.

    `density` is that of the landmarks about the sensor, per m^2, and `usual` that most of what it observed is mapped.
    """

    seen: set[Id]
    missed: dict[Id, float]
    density: float
    usual: bool


def look(scan: ScanContext, upkeep: Upkeep) -> ObservedAndMissed | None:
    """Return what a scan saw of what was expected, and count it; None if it is no look of its own.

    A scan of which most is not mapped is not counted: its robot may be elsewhere, or its sensor covered.
    """
    tracks, pose = scan.tracks, scan.pose()
    looks, stated = tracks.looks.setdefault(scan.key, Looks()), upkeep.p_detect is not None
    if not looks.is_due(pose, tracks.changes) and not stated:
        return None
    made = scan.report.observations
    seen, left, fused = set[Id](), list[int](), 0
    for o in made:
        fused += o.outcome == "associated"
        if o.outcome not in USED:
            left.append(o.index)
        if o.landmark is not None and o.outcome != "new":
            seen.add(o.landmark)
    usual = stated or (fused > 0 and 2 * fused >= len(made))
    begun = {o.landmark for o in made if o.outcome == "new" and o.landmark is not None}
    far, missed, ranges = looks.scale_m, dict[Id, float](), [np.zeros(0)]
    for model, near, l in _nearest_landmarks(scan, begun):
        v = model.landmark.seen_from(pose, l)[0]
        ranges.append(np.sqrt((v[:, : scan.dimensions] ** 2).sum(axis=1)))
        sure = _surely(scan.channel, v)
        names, v, r = [near[i] for i in np.flatnonzero(sure).tolist()], v[sure], ranges[-1][sure]
        bearing, sectors = np.arctan2(v[:, 1], v[:, 0]), sectors_of(pose, v[:, : scan.dimensions])
        there, hidden = np.array([name in seen for name in names], dtype=np.bool_), _hidden(scan, r, bearing)
        in_reach, most = _reach(tracks, names, r, sectors, looks)
        clear = there | (~_unclear(scan, model, names, v, ~there, left) & (most > 0.0))
        weights, cells = _weights(looks, upkeep, r, bearing, hidden, in_reach)
        weights = np.minimum(weights, most)
        for i in np.flatnonzero(clear).tolist():
            if (track := tracks.confirmed.get(names[i])) is not None:
                track.reach[sectors[i]] = max(track.reach[sectors[i]], r[i] if there[i] else 0.0)
                track.beyond[sectors[i] // SIDE] += 0.0 if there[i] or in_reach[i] else weights[i]
        far = float(r[there].mean()) if there.any() else far
        if usual:
            before = [name not in tracks.confirmed or tracks.confirmed[name].seen > 0 for name in names]
            counts = clear & (there | np.array(before, dtype=np.bool_))  # of ghosts nothing is learnt
            looks.count(cells[counts], there[counts])
        missed |= {names[i]: float(weights[i]) for i in np.flatnonzero(clear & ~there & (weights > 0.0)).tolist()}
    if usual:
        looks.take(pose, tracks.changes, far)
    r = np.concatenate(ranges)
    return ObservedAndMissed(seen, missed, len(r) / (math.pi * max(float(r.max(initial=0.0)), far) ** 2), usual)


def count_misses(tracks: Tracks, look: ObservedAndMissed) -> list[Track]:
    """Count the observations and the misses of the landmarks of a look; return those that it missed."""
    missed = [tracks.confirmed[name] for name in look.missed if name in tracks.confirmed]
    for track in missed:
        track.missed += look.missed[track.id]
    for name in look.seen:
        if name in tracks.confirmed:
            track = tracks.confirmed[name]
            track.seen, track.absent, track.missed = track.seen + 1, track.absent + track.missed, 0.0
    tracks.looked += 1
    return missed


def absent_landmarks(tracks: Tracks, upkeep: Upkeep, missed: Sequence[Track]) -> list[Track]:
    """Return those of the `missed` landmarks that are gone, or never were there."""
    if not upkeep.removes:
        return []
    if upkeep.p_detect is None and tracks.looked % REFIT == 0:
        tracks.detection = detection([*tracks.confirmed.values()], upkeep)
    if not missed:
        return []
    density = _stated(upkeep) or Detection(*tracks.detection)
    sure = log_odds(missed, density, upkeep) <= -math.log(upkeep.odds)
    return [track for track, yes in zip(missed, sure.tolist(), strict=True) if yes]


def _stated(upkeep: Upkeep) -> Detection | None:
    """Return the detection probability that is stated, as a density; None if the log has it."""
    p = upkeep.p_detect
    return None if p is None else Detection(SURE * p, SURE * (1.0 - p))


def detection(tracks: Sequence[Track], upkeep: Upkeep) -> Detection:
    """Return the density of the detection probabilities of the landmarks that are there; narrow if that is stated.

    It is the likeliest one with a share of landmarks that never were there.
    """
    given = _stated(upkeep)
    if given is not None:
        return given
    seen, absent, missed = _counts(tracks[:: len(tracks) // MOST + 1])
    out = absent + missed
    some = seen + out >= LEAST
    seen, out = seen[some], out[some]
    a, b = (each.ravel()[:, None] for each in (WORTH * MEANS, WORTH * (1.0 - MEANS)))
    there = _likely(Detection(a, b), seen, out)
    never = _likely(_false(upkeep), seen, out)
    likely = [np.logaddexp(math.log1p(-p) + there, math.log(p) + never).sum(axis=1) for p in SHARES]
    best = int(np.argmax(np.max(likely, axis=0)))
    return Detection(float(a[best, 0]), float(b[best, 0]))


def log_odds(tracks: Sequence[Track], density: Detection, upkeep: Upkeep) -> Array:
    """Return the log odds (K,) that landmarks exist, at most log `odds`."""
    (seen, absent, missed), (a, b), false = _counts(tracks), density, _false(upkeep)
    later = _likely(Detection(a + seen, b + absent), 0.0, missed) - _likely(false, 0.0, missed)
    ever = _likely(density, seen, absent + missed) - _likely(false, seen, absent + missed)
    found: Array = math.log(upkeep.odds) + np.minimum(np.minimum(later, ever), 0.0)
    return found


def _likely(density: Detection, seen: Array | float, out: Array | float) -> Array:
    """Return the log likelihood (K,) of counts of observations and misses."""
    a, b = density
    return np.asarray(betaln(a + seen, b + out) - betaln(a, b))


def _false(upkeep: Upkeep) -> Detection:
    """Return the density of the probability that something else is taken for a landmark that is not there."""
    worth = 1.0 / upkeep.p_false if upkeep.p_detect is None else SURE
    return Detection(worth * upkeep.p_false, worth * (1.0 - upkeep.p_false))


def unseen_landmarks(odds: Mapping[Id, float], upkeep: Upkeep) -> frozenset[Id]:
    """Return the landmarks with such log odds that are not seen again where they should be."""
    return frozenset(name for name, value in odds.items() if value <= -math.log(upkeep.odds))


def log_odds_of_map(tracks: Tracks, upkeep: Upkeep) -> dict[Id, float]:
    """Return the log odds of the landmarks of a map that were looked at since they began."""
    mapped = [*tracks.confirmed.values()]
    judged = [track for track in mapped if track.seen or track.missed > 0.0]
    odds = log_odds(judged, detection(mapped, upkeep), upkeep) if judged else np.empty(0)
    return dict(zip([track.id for track in judged], odds.tolist(), strict=True))


def _counts(tracks: Sequence[Track]) -> tuple[Array, Array, Array]:
    """Return observations, misses before the last one and misses since then, each (K,)."""
    found = np.array([(track.seen, track.absent, track.missed) for track in tracks], dtype=np.float64).reshape(-1, 3)
    return found[:, 0], found[:, 1], found[:, 2]


def _nearest_landmarks(scan: ScanContext, begun: Set[Id]) -> list[tuple[ObservationModel, list[Id], Array]]:
    """Return the landmarks nearest to the sensor, those of one kind together, that are points, and their means (K, n).

    Those that have `begun` with this scan are left out.
    """
    tracks, channel, known = scan.tracks, scan.channel, list[Id]()
    if channel.gives_places:
        sorts, place = tracks.sorts_of(channel.points, len(scan.map.blocks)), scan.pose()[: scan.dimensions]
        around = (tracks.names[slot] for slot in scan.map.around(sorts, place, AROUND).tolist())
        names = [name for name in around if name not in begun]
        known = tracks.known.near(channel.models, place[None], AROUND)
    else:
        names = [name for name in tracks.observable(channel) if tracks.confirmed[name].model.kind in channel.points]
    mapped = [(model, [names[i] for i in rows]) for model, rows in tracks.by_model(channel, names)] if names else []
    exact = [(model, [known[i] for i in rows]) for model, rows in tracks.known_by_model(channel, known)]
    return [
        *((model, of, scan.map.means(tracks.slots_of(of), model.d)) for model, of in mapped),
        *((model, of, tracks.known.means(of, model.d)) for model, of in exact),
    ]


def log_misses(scan: ScanContext, of: Known, upkeep: Upkeep) -> dict[Id, float]:
    """Return those of landmarks of one kind that are surely in view, with the log probability that a scan misses each.

    It is that of the filter's own looks; without them nothing is known of it.
    """
    looks, pose = scan.tracks.looks.get(scan.key), scan.pose()
    if looks is None:
        return {}
    rows = of.nearest(pose[None, : scan.dimensions], AROUND)
    v = of.model.seen_from(pose, of.values[rows])[0]
    sure = _surely(scan.channel, v)
    v, names = v[sure, : scan.dimensions], [of.names[row] for row in rows[sure].tolist()]
    r, bearing = np.sqrt((v**2).sum(axis=1)), np.arctan2(v[:, 1], v[:, 0])
    in_reach, most = _reach(scan.tracks, names, r, sectors_of(pose, v), looks)
    weights = _weights(looks, upkeep, r, bearing, _hidden(scan, r, bearing), in_reach)[0]
    return dict(zip(names, (looks.log_miss * np.minimum(weights, most)).tolist(), strict=True))


def _reach(
    tracks: Tracks, names: Sequence[Id], r: Array, sectors: Index, looks: Looks
) -> tuple[Flags, Array]:  # fmt: skip
    """Return which landmarks at ranges r (K,) were seen from as far away in these directions (K,): nothing hides them.

    And how much a miss counts at most (K,): what hides one from there hides it in later looks, too.  One that was
    given, or is known exactly, is in reach.
    """
    in_reach, most = np.ones(len(names), dtype=np.bool_), np.full(len(names), math.inf)
    for i, name in enumerate(names):
        track = tracks.confirmed.get(name)
        if track is not None and track.begun[1] and r[i] > track.reach[sectors[i]]:
            in_reach[i], most[i] = False, looks.most - track.beyond[sectors[i] // SIDE]
    return in_reach, np.maximum(most, 0.0)


def _weights(
    looks: Looks, upkeep: Upkeep, r: Array, bearing: Array, hidden: Flags, in_reach: Flags
) -> tuple[Array, Index]:
    """Return what misses at ranges r and bearings (K,) count (K,), 1 where most is seen, and their cells (K, 3)."""
    cells = cells_of(r, bearing, hidden, in_reach)
    return np.where(hidden, 0.0, 1.0) if upkeep.p_detect is not None else looks.weights(cells), cells


def _unclear(
    scan: ScanContext, model: ObservationModel, names: list[Id], v: Array, missed: Flags, left: list[int]
) -> Flags:  # fmt: skip
    """Return which of the `missed` landmarks v (K, d) one of the observations `left`, of no landmark, may be of."""
    out = np.zeros(len(names), dtype=np.bool_)
    if not left or not missed.any() or names[0] in scan.tracks.known:
        return out
    if not scan.channel.gives_places:
        near = {c.landmark for c in scan.report.candidates if c.d2 <= scan.channel.gate}
        return np.array([name in near for name in names], dtype=np.bool_)
    some = np.flatnonzero(missed)
    places = scan.channel.sensor.invert(scan.y[left])[0][:, : scan.dimensions]
    k = np.argmin(np.linalg.norm(v[some, None, : scan.dimensions] - places, axis=2), axis=1)
    d2 = scan.predict(model, scan.tracks.slots_of([names[i] for i in some]), [left[i] for i in k.tolist()])[1]
    out[some] = ~(d2 > min(scan.channel.gate, gate(SURVEYED, scan.channel.dof)))
    return out


def _surely(channel: Channel, v: Array) -> Flags:
    """Return which landmarks v (K, d) in the sensor frame are well inside what a sensor observes."""
    changed = np.matmul(v, _changes(channel.fov_rad, v.shape[1]))
    sure: Flags = channel.sensor.sees(changed.reshape(-1, v.shape[1])).reshape(len(changed), -1).all(axis=0)
    return sure


@lru_cache
def _changes(fov: float, size: int) -> Array:
    """Return the matrices (N, size, size) of nothing, and of small changes of the range and of the bearing."""
    out, limited = [np.eye(size)], fov < 2 * math.pi
    if size in (2, 3):
        scaled = np.arange(size) < (2 if limited else 3)
        out += [np.diag(np.where(scaled, 1.0 + change, 1.0)) for change in (-MARGIN, MARGIN)]
    for turn in (-MARGIN * fov / 2, MARGIN * fov / 2) if limited else ():
        out.append(np.eye(size))
        out[-1][:2, :2] = [[math.cos(turn), math.sin(turn)], [-math.sin(turn), math.cos(turn)]]
    return np.array(out)


def _hidden(scan: ScanContext, far: Array, bearing: Array) -> Flags:
    """Return which landmarks of the plane, at ranges and bearings (K,), are behind what was observed nearer."""
    if scan.dimensions == 3 or not len(scan.y) or not scan.channel.gives_places:
        return np.zeros(len(far), dtype=np.bool_)
    p: Array = scan.channel.sensor.invert(scan.y)[0][:, :2]
    near = np.sqrt((p**2).sum(axis=1))
    apart = np.abs(bearing[:, None] - np.arctan2(p[:, 1], p[:, 0]))
    apart = np.minimum(apart, 2 * math.pi - apart)
    behind = far[:, None] > near + 2 * OCCLUDER_M
    hidden: Flags = (behind & (apart < np.arctan(OCCLUDER_M / np.maximum(near, OCCLUDER_M)))).any(axis=1)
    return hidden
