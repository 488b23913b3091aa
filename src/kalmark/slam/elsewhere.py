"""A robot that is elsewhere than its filter has it: found by evidence, placed where the log fits better.

A covariance does not show that a robot was carried away.  The log does (`evidence.py`).  At - log `ODDS` a pose is
looked for at which the scan, and what was mapped since the onset, is that of old landmarks
(`association/global_start.py`).  A second filter of the robot alone begins there, an `Alternative`, on the old map as
it is, with the same ratio.  Where that reaches log `ODDS` the robot is placed there; what was mapped meanwhile goes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from kalmark.arrays import Array
from kalmark.association.global_start import FEWEST_NAMED, GlobalPose, by_chance, search
from kalmark.association.relocalization import align_points, is_same_pose
from kalmark.events import Id
from kalmark.filter.estimators import Correction, Estimator, Update
from kalmark.geometry.angles import wrap
from kalmark.geometry.frames import compose, from_frame, inverse, to_frame
from kalmark.geometry.gaussian import gate
from kalmark.management import existence
from kalmark.report import ELSEWHERE, Gap
from kalmark.slam.alternative import Alternative, write_robot
from kalmark.slam.evidence import SURE, Evidence
from kalmark.slam.state import State
from kalmark.tracks.known_landmarks import Known
from kalmark.tracks.scan import ScanContext
from kalmark.tracks.surveys import SURVEYED

ODDS = 1e6  # by which a robot is elsewhere, and is where it is placed
WIDER = 3.0  # times its sigmas by which a filter that is too sure may be off
LOOSE = 2.0  # sigmas of an observation, for what is uncertain between landmarks of the map
HELD = 2  # scans of several landmarks that are held back without an alternative
MOST = 48  # landmarks of a constellation
MEANWHILE = "mapped while its robot was elsewhere"


def concerns(scan: ScanContext) -> bool:
    """Return whether a scan determines where its robot is: it finds the places of points in the plane."""
    channel = scan.channel
    return channel.gives_places and scan.dimensions == 2 and not channel.joins and channel.landmark.kind == "point"


def correct(
    state: State, scan: ScanContext, names: Sequence[Any], update: Update, estimator: Estimator | None = None
) -> Correction:
    """Correct the map; observations with ids that are far off are used if others fit and their gate lets them.

    A filter that is too sure may be off by `WIDER` times its sigmas: only what is farther is far off.  Where the gate is
    switched off all are used.
    """
    is_off = state.policies[scan.key].association.threshold(1, 0.0) == math.inf
    if scan.event.ids is None or is_off or not concerns(scan):
        return state.corrected(update, scan.event, estimator)
    limit = WIDER**2 * gate(SURVEYED, scan.channel.dof)
    done = state.corrected(update._replace(gate=min(update.gate, limit)), scan.event, estimator)
    far = np.flatnonzero(~done.fused & (done.d2 > limit)).tolist()
    if not far:
        return done
    of = state.evidence.setdefault(scan.event.robot, Evidence())
    fits = np.flatnonzero(done.fused).tolist()
    of.miss((names[k] for k in far), [-SURE] * len(far), scan.event.t_ns)
    of.see((names[k] for k in fits), [SURE] * len(fits), scan.event.t_ns)
    of.weigh()
    out = [k for k in far if done.d2[k] <= update.gate]
    of.held += len(of.missed) >= FEWEST_NAMED and not of.fitted
    if (of.ratio < 0.0 and of.held <= HELD) or not out:
        return done
    rest = update._replace(slots=update.slots[out], y=update.y[out], R=update.R[out])
    fused = done.fused.copy()
    fused[out] = state.corrected(rest, scan.event, estimator).fused
    return done._replace(fused=fused)


def weigh(state: State, scan: ScanContext, look: existence.Look | None) -> None:
    """Take note of the landmarks that a scan saw and missed, and place its robot where that is beyond doubt."""
    robot = scan.event.robot
    if look is not None or scan.adrift:
        state.evidence.setdefault(robot, Evidence())
    of, all_named = state.evidence.get(robot), None not in scan.ids
    if of is None or not scan.report.observations:
        return
    _note(scan, of, look)
    if scan.adrift:
        of.ratio, of.since_ns = -math.inf, state.moving[robot].held.adrift_since_ns
    if of.ratio >= 0.0 and all_named:
        del state.evidence[robot]
    if of.ratio > -math.log(ODDS):
        if of.fitted:
            state.alternatives.pop(robot, None)
            of.fitted = set()
    elif of.fitted and robot in state.alternatives:
        _try(state, scan, of, _old(state, scan, of))
    elif look is not None or scan.adrift or all_named:
        _propose(state, scan, of, _old(state, scan, of))


def _note(scan: ScanContext, of: Evidence, look: existence.Look | None) -> None:
    """Take note of the landmarks that a scan saw, missed and began."""
    made, t_ns = scan.report.observations, scan.event.t_ns
    if look is not None:
        log_miss = scan.tracks.looks[scan.key].log_miss()
        of.miss(look.missed, [weight * log_miss for weight in look.missed.values()], t_ns)
    seen = [o for o in made if o.outcome == "associated" and (look is not None or o.id is not None)]
    if seen:
        logs = _log_chance(scan, [o.index for o in seen], look.density if look is not None else 0.0)
        of.see((o.landmark for o in seen if o.landmark is not None), -logs, t_ns)
    of.begin((o.landmark for o in made if o.outcome == "new" and o.landmark is not None), t_ns)
    of.weigh()


def _log_chance(scan: ScanContext, rows: list[int], density: float, Z: Array | None = None) -> Array:
    """Return the log probability (M,) that observations have a landmark of a density in their gates by chance."""
    V = scan.channel.calibrated(scan.map).invert(scan.y[rows])[1][:, :2]
    C = V @ (scan.report.Z[rows] if Z is None else Z) @ V.swapaxes(1, 2)
    area = math.pi * gate(SURVEYED, 2) * np.sqrt(np.maximum(np.linalg.det(C), 0.0))
    named = np.array([scan.ids[k] is not None for k in rows], dtype=np.bool_)
    chance = np.where(named, math.exp(-SURE), np.minimum(density * area, 1.0))
    return np.log(np.maximum(np.where(np.isfinite(chance), chance, 1.0), math.exp(-SURE)))


def _old(state: State, scan: ScanContext, of: Evidence) -> Known:
    """Return the landmarks that were in the map before, as they are now."""
    tracks, kind, young = state.tracks, scan.channel.landmark.kind, of.young
    known, old = tracks.known.of_kind.get(kind), Known(scan.channel.landmark)
    for name in known.names if known is not None else ():
        old.add(name, _mean(state, name))
    for name, track in tracks.confirmed.items():
        if track.model.kind == kind and name not in young:
            old.add(name, _mean(state, name))
    return old


def _constellation(state: State, scan: ScanContext, of: Evidence) -> tuple[list[Id | None], Array, Array]:
    """Return the ids, places (K, 2) in the frame of the sensor and sigmas (K,) of what is seen, and was since."""
    v, V = scan.channel.calibrated(scan.map).invert(scan.y)
    sigma = np.sqrt(np.trace(V[:, :2] @ scan.R @ V[:, :2].swapaxes(1, 2), axis1=1, axis2=2) / 2)
    T, ids, tracks = scan.pose(), list(scan.ids), state.tracks
    shown = {o.landmark for o in scan.report.observations}
    for k, name in enumerate(ids):
        if name is not None:
            x, y = from_frame(T, v[k : k + 1, :2])[0][0]
            of.far[name] = float(x), float(y), float(sigma[k])
    more: list[tuple[Id | None, tuple[float, float], float]] = [
        (name, (x, y), s) for name, (x, y, s) in of.far.items() if name not in ids
    ]
    more += [
        (None, tuple(state.map.mean(tracks.slots[name])[:2].tolist()), float(np.median(sigma)))
        for name in of.young
        if name in tracks.confirmed and name not in shown and tracks.is_invented(name)
    ]
    if more:
        places = to_frame(T, np.array([p for _, p, _ in more]))[0]
        ids, v = [*ids, *(name for name, _, _ in more)], np.concatenate([v[:, :2], places])
        sigma = np.append(sigma, [s for _, _, s in more])
    nearest = np.argsort(np.linalg.norm(v[:, :2], axis=1), kind="stable")[:MOST]
    return [ids[k] for k in nearest.tolist()], v[nearest, :2], sigma[nearest]


class _Found(NamedTuple):
    """A pose T (3,) of the sensor with its covariance (3, 3), the log odds against chance, and the rows it is by."""

    T: Array
    cov: Array
    gain: float
    rows: list[int]


def _locate(state: State, scan: ScanContext, of: Evidence, old: Known) -> _Found | None:
    """Return where a constellation is one of old landmarks, if there is one such place."""
    ids, v, sigma = _constellation(state, scan, of)
    at = {name: row for row, name in enumerate(old.names)}
    named = [k for k, name in enumerate(ids) if name in at]
    unnamed = np.array([k for k, name in enumerate(ids) if name is None], dtype=np.int64)
    if len(named) >= FEWEST_NAMED:
        rows, some = [at[ids[k]] for k in named], np.array(named)  # type: ignore[index]
        T, gain = align_points(v[some], old.places()[rows], sigma[some] ** -2), SURE * (len(some) - FEWEST_NAMED)
        off = (from_frame(T, v[some])[0] - old.places()[rows]) / (LOOSE * sigma[some, None])
        if np.sum(off**2) > gate(SURVEYED, 2 * len(some) - 3):
            return None
    else:
        found = search(old, v[unnamed], sigma[unnamed])
        if not isinstance(found, GlobalPose):
            return None
        T, some, rows = found.T, unnamed[found.matched >= 0], found.matched[found.matched >= 0].tolist()
        gain = -math.log(max(by_chance(old, v[unnamed], sigma[unnamed], found.pairs, len(old.names) ** 2), 1.0 / ODDS))
    return _Found(T, _pose_cov(T, v[some], sigma[some]), gain, rows)


def _propose(state: State, scan: ScanContext, of: Evidence, old: Known) -> None:
    """Begin an alternative where a constellation is one of old landmarks."""
    found, name, r = _locate(state, scan, of, old), scan.event.robot, state.map.mean(scan.robot)
    if found is None:
        return
    other = state.alternatives[name] = Alternative.of(state.map, state.moving[name], state.blocks, scan.event.t_ns)
    pose = compose(found.T, compose(inverse(scan.pose())[0], r[:3])[0])[0]
    write_robot(other.map, scan.robot, pose, found.cov)
    of.gain, of.fitted = found.gain, {old.names[row] for row in found.rows}


def _pose_cov(T: Array, v: Array, sigma: Array) -> Array:
    """Return the covariance (3, 3) of a pose by the places v (K, 2) of landmarks with these sigmas (K,)."""
    J = from_frame(T, v)[1]
    W = (LOOSE * sigma) ** -2.0
    cov: Array = np.linalg.inv(np.einsum("kai,k,kaj->ij", J, W, J))
    return cov


def _pair(scan: ScanContext, places: Array, old: Known) -> dict[int, int]:
    """Return by the rows of old landmarks the observations at `places` (K, 2) that may be of them, the nearest of each.

    With an id it is the landmark of that name, without one the nearest.
    """
    gaps, nearest = old.tree().query(places)
    at = {name: row for row, name in enumerate(old.names)}
    pairs = [(at.get(name) if name is not None else int(nearest[k]), k) for k, name in enumerate(scan.ids)]
    return {row: k for row, k in sorted(pairs, key=lambda pair: -gaps[pair[1]]) if row is not None}


def _try(state: State, scan: ScanContext, of: Evidence, old: Known) -> None:
    """Correct an alternative by a scan; place the robot there if it is certain, and forget it if it does not fit.

    The constellation has to be one of old landmarks there, and nowhere else, still.
    """
    robot, channel = scan.event.robot, scan.channel
    other, model = state.alternatives[robot], channel.models[channel.landmark.kind]
    view, places = replace(scan, map=other.map), channel.places(other.map, scan.robot, scan.y)
    pairs = {} if places is None or not len(old.names) else _pair(scan, places, old)
    logs, fits = dict[Id, float](), dict[Id, int]()
    if pairs:
        names, rows = [old.names[row] for row in pairs], [*pairs.values()]
        update = view.known_update(model, old.values[[*pairs]], rows)._replace(gate=gate(SURVEYED, channel.dof))
        done = state.estimator.for_fixes().correct(other.map, update._replace(R=LOOSE**2 * update.R))
        gains = np.where(done.fused, -_log_chance(scan, rows, old.density(), done.Z), -SURE)
        fits = {name: k for name, k, fits in zip(names, rows, done.fused.tolist(), strict=True) if fits}
        counts = [name in fits or scan.ids[k] is not None for name, k in zip(names, rows, strict=True)]
        logs = {name: gain for name, gain, yes in zip(names, gains.tolist(), counts, strict=True) if yes}
    if (looks := scan.tracks.looks.get(scan.key)) is not None and None in scan.ids:
        logs = dict.fromkeys(existence.expected(view, old), looks.log_miss()) | logs
    of.gain += sum(log for name, log in logs.items() if name not in of.fitted)
    of.fitted |= logs.keys()
    if of.gain >= math.log(ODDS) and fits:
        again = _locate(state, scan, of, old)
        if again is not None and is_same_pose(again.T, channel.pose(other.map, scan.robot)):
            _place(state, scan, of, other, [*fits])
    elif of.gain <= -SURE:
        del state.alternatives[robot]
        of.fitted, of.gain = set(), 0.0


def _place(state: State, scan: ScanContext, of: Evidence, other: Alternative, fits: Sequence[Id]) -> None:
    """Move a robot to where its alternative is; what was mapped while it was elsewhere goes.

    Its error is that of the alternative, and that of the map there, which the alternative does not have: of the pose of
    which the landmarks l that it sees are least squares, d r = (sum A'A)^-1 sum A' d l, A = d l / d r.
    """
    robot, slot, tracks = scan.event.robot, scan.robot, state.tracks
    before, after, cov = state.map.mean(slot), other.map.mean(slot), other.map.covariance([slot])
    places = np.array([_mean(state, name)[:2] for name in fits]) - after[:2]
    A = np.zeros((len(fits), 2, 3))
    A[:, :, :2], A[:, 0, 2], A[:, 1, 2] = np.eye(2), -places[:, 1], places[:, 0]
    G = np.linalg.pinv(A.reshape(-1, 3)).reshape(3, -1, 2)
    mapped = [k for k, name in enumerate(fits) if name not in tracks.known]
    parts = ((slot, len(cov)), *((tracks.slots[fits[k]], 2) for k in mapped))
    rows, own = state.rows(parts), slice(0, len(cov))
    F, Q = np.eye(len(rows)), np.zeros((len(rows), len(rows)))
    F[own], Q[own, own] = 0.0, cov
    F[:3, len(cov) :] = G[:, mapped].reshape(3, -1)
    state.map.predict(rows, F, Q)
    state.map.set_predicted(slot, after)
    for name in [name for name in of.young if name in tracks.confirmed]:
        state.remove(name)
        scan.report.removed += ((name, MEANWHILE),)
    for track in [*tracks.tentative.values()]:
        state.map.remove(track.slot)
        del tracks.tentative[track.id]
    state.clones.forget_current(robot)
    state.moving[robot].left_out.clear()
    for others in (state.alternatives, state.sums, state.evidence):
        others.pop(robot, None)
    if not scan.adrift:  # else the gap since which it is has been reported
        turned, moved = abs(float(wrap(after[2] - before[2]))), math.dist(after[:2], before[:2])
        scan.report.gaps += (Gap(robot, ELSEWHERE, of.since_ns, scan.event.t_ns, moved, turned),)


def _mean(state: State, name: Id) -> Array:
    """Return the numbers of a landmark, in the map or known exactly."""
    known = state.tracks.known
    return known.mean(name) if name in known else state.map.mean(state.tracks.slots[name])
