"""A robot that is elsewhere than its filter has it: found by evidence, placed where the log fits better.

A covariance does not show that a robot was carried away.  The log does (`evidence.py`).  From - `SURE` on a pose is
searched for at which the scan, and what was mapped since the onset, is that of old landmarks: by a tag, by points or
rays with ids, or by distances (`association/global_start.py`).  A second filter of the robot alone begins there, an
`PoseHypothesis`, on the old map as it is, with the same ratio.  Where both differ by log `ODDS` the robot is placed
there; what was mapped meanwhile goes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import compress
from typing import Any

import numpy as np

from kalmark.arrays import Array, Flags
from kalmark.association.global_start import (
    LOOSE,
    SURE,
    Proposal,
    locate_points,
    locate_ranges,
    locate_rays,
    locate_tags,
    rows_of,
)
from kalmark.association.relocalization import SAME_M
from kalmark.events import Id
from kalmark.filter.estimators import Correction, Estimator, Update
from kalmark.geometry.gaussian import gate
from kalmark.geometry.pose_frames import FRAMES, moved_with
from kalmark.geometry.spaces import Space
from kalmark.management import existence
from kalmark.management.reparametrize import POINTS
from kalmark.management.repeated_places import GROWN
from kalmark.models.protocols import Pointed, UnknownDepth
from kalmark.report import ELSEWHERE, Gap
from kalmark.slam.evidence import Evidence
from kalmark.slam.pose_hypothesis import PoseHypothesis, write_robot
from kalmark.slam.state import State
from kalmark.tracks.channel import EUCLIDEAN
from kalmark.tracks.known_landmarks import Known
from kalmark.tracks.scan import ScanContext
from kalmark.tracks.survey_checks import SURVEYED
from kalmark.tracks.track import Tracks

ODDS = 1e9  # by which a robot is where it is placed, and not where its filter has it
MOST = 48  # landmarks of a constellation
MEANWHILE = "mapped while its robot was elsewhere"


def limit_of(state: State, scan: ScanContext) -> float:
    """Return the d2 up to which an observation with an id is not far off; infinite where the gate is switched off."""
    limit = state.policies[scan.key].limit
    return limit if limit < math.inf and scan.event.ids is not None and scan.locates else math.inf


def misfits(state: State, scan: ScanContext, done: Correction) -> Flags:
    """Return which observations (K,) are left out, by a gate that is set or as far off."""
    if done.fused.all():
        return ~done.fused
    most = min(state.policies[scan.key].association.threshold(scan.channel.dof, math.inf), limit_of(state, scan))
    return np.asarray(~done.fused & (done.d2 > most))


def correct(
    state: State, scan: ScanContext, names: Sequence[Any], update: Update, estimator: Estimator | None = None
) -> Correction:
    """Correct the map; observations with ids beyond `limit_of`, or of what cannot be seen from here, are left out."""
    limit = limit_of(state, scan)
    done = state.correct(update._replace(gate=min(update.gate, limit)), scan.event, estimator)
    if limit < math.inf and not done.fused.all():
        weigh_far(state, scan, names, update, done)
    return done


def weigh_far(state: State, scan: ScanContext, names: Sequence[Any], update: Update, done: Correction) -> None:
    """Weigh the observations that a correction within `limit_of` left out."""
    far = _far(scan, update, done, limit_of(state, scan))
    if not far:
        return
    of, fits = state.evidence_of(scan.event.robot), np.flatnonzero(done.fused).tolist()
    of.miss((names[k] for k in far), [-SURE] * len(far), scan.event.t_ns, state.begun_ns)
    of.see((names[k] for k in fits), [SURE] * len(fits), scan.event.t_ns, state.begun_ns)
    of.weigh()


def _far(scan: ScanContext, update: Update, done: Correction, limit: float) -> list[int]:
    """Return the observations beyond a limit, and those of things that cannot be seen from here."""
    far = np.flatnonzero(~done.fused & ~(done.d2 <= limit)).tolist()
    if not far:
        return []
    y = np.ascontiguousarray(update.y[far, : scan.y.shape[1]])
    places = scan.channel.places(scan.map, scan.robot, y)
    is_seen = done.d2[far] > limit
    if places is not None:
        is_seen |= np.isfinite(places).all(axis=1)
    return [k for k, is_one in zip(far, is_seen.tolist(), strict=True) if is_one]


def _young(tracks: Tracks, robot: str, of: Evidence) -> list[Id]:
    """Return the landmarks of the map that a robot began since the onset."""
    begun = ((name, track.begun) for name, track in tracks.confirmed.items())
    return [name for name, (t_ns, by) in begun if by == robot and t_ns > of.since_ns]


def weigh(state: State, scan: ScanContext, look: existence.ObservedAndMissed | None) -> None:
    """Count the landmarks that a scan observed and missed, and place its robot where the odds suffice."""
    robot = scan.event.robot
    if look is not None:
        state.evidence_of(robot)
    of, all_named = state.evidence.get(robot), None not in scan.ids
    if of is None or not scan.report.observations:
        return
    _note(state, scan, of, look)
    if of.ratio >= 0.0 and all_named:
        del state.evidence[robot]
    is_unique = state.policies[scan.key].upkeep.repeats == "merge"  # then no two places are alike
    if of.ratio <= -SURE or is_unique:
        is_tried = robot in state.pose_hypotheses and bool(of.fitted)
        is_due = not is_tried if of.ratio <= -SURE else scan.tracks.changes - of.searched >= GROWN
        if is_due and (look is not None or all_named):
            _propose(state, scan, of)
        if of.fitted and robot in state.pose_hypotheses and (is_tried or all_named):
            _try(state, scan, of)
    elif of.fitted:
        state.pose_hypotheses.pop(robot, None)
        of.fitted = {}


def _note(state: State, scan: ScanContext, of: Evidence, look: existence.ObservedAndMissed | None) -> None:
    """Take note of the landmarks that a scan saw and missed."""
    made, t_ns = scan.report.observations, scan.event.t_ns
    if look is not None:
        log_miss = scan.tracks.looks[scan.key].log_miss
        of.miss(look.missed, [weight * log_miss for weight in look.missed.values()], t_ns, state.begun_ns)
    seen = [o for o in made if o.outcome == "associated" and (look is not None or o.id is not None)]
    if seen:
        d2 = np.nan_to_num(np.array([o.d2 for o in seen], dtype=np.float64))
        logs = _log_odds(scan, [o.index for o in seen], d2, look.density if look is not None else 0.0)
        logs = np.maximum(logs, 0.0)  # a noise that is stated too small is no evidence
        of.see((o.landmark for o in seen if o.landmark is not None), logs, t_ns, state.begun_ns)
    of.weigh()


def _log_odds(
    scan: ScanContext, rows: list[int], d2: Array, density: float, Z: Array | None = None, p: float = 0.0
) -> Array:  # fmt: skip
    """Return the log odds (M,) that observations are of their landmarks, and not of others that are there by chance.

    That is log N(z; 0, Z) - log rho of the innovations, of these d2 (M,), rho the density of landmarks.  By chance one
    is in the gate with at least the probability p; with an id none is.
    """
    named = np.array([scan.ids[k] is not None for k in rows], dtype=np.bool_)
    if named.all():
        return np.full(len(rows), SURE)
    V, least = scan.channel.calibrated(scan.map).invert(scan.y[rows])[1][:, :2], gate(SURVEYED, 2)
    C = V @ (scan.report.Z[rows] if Z is None else Z) @ V.swapaxes(1, 2)
    area = math.pi * least * np.sqrt(np.maximum(np.linalg.det(C), 0.0))
    chance = np.maximum(density * area, p) * 2.0 / least
    odds = -np.log(np.where(np.isfinite(chance), np.maximum(chance, math.exp(-SURE)), 1.0)) - 0.5 * d2
    return np.where(named, SURE, np.clip(odds, -SURE, SURE))


def older(state: State, scan: ScanContext, of: Evidence) -> Known:
    """Return the landmarks that were in the map before, as they are now; a ray as a point, if its depth is known."""
    tracks, young, channel = state.tracks, _young(state.tracks, scan.event.robot, of), scan.channel
    kind = channel.landmark.kind if channel.gives_places else EUCLIDEAN[scan.dimensions - 2]
    known, old = tracks.known.of_kind.get(kind), Known(channel.models[kind].landmark)
    for name in known.names if known is not None else ():
        old.add(name, tracks.known.mean(name))
    for name in tracks.confirmed:
        space, l, L = _block(state, name)
        P = L @ state.map.covariance([tracks.slots[name]]) @ L.T if len(L) < L.shape[1] else np.zeros((1, 1))
        if name not in young and space.kinds == old.model.space.kinds and np.linalg.norm(P, 2) < SAME_M**2:
            old.add(name, l)
    return old


def _constellation(state: State, scan: ScanContext, of: Evidence) -> tuple[list[Id | None], Array, Array, Array]:
    """Return the ids, places (K, 2 or 3) in the frame of the sensor and sigmas (K,) of what is seen, and was since.

    And where it was seen from (K, 2 or 3) in that frame: of a direction the place is at a distance of 1 from there.
    """
    d, T, of_world, tracks = scan.dimensions, scan.pose(), FRAMES[len(scan.channel.at)], state.tracks
    v, sigma = scan.places()
    shown = {o.landmark for o in scan.report.observations}
    rows = np.column_stack([of_world.from_frame(T, v)[0], np.tile(T[:d], (len(v), 1)), sigma]).tolist()
    usual = np.median(sigma)
    of.far |= {
        name: tuple(row)
        for name, row in zip(scan.ids, rows, strict=True)
        if name is not None and math.isfinite(row[-1])
    }
    more: list[Any] = [(name, row) for name, row in of.far.items() if name not in scan.ids]
    more += [
        (None, (*state.map.mean(tracks.slots[name])[:d], *T[:d], usual))
        for name in _young(tracks, scan.event.robot, of)
        if name not in shown and tracks.is_invented(name)
    ]
    ids, rows = [*scan.ids, *(name for name, _ in more)], np.array([*rows, *(row for _, row in more)])
    v, o = (of_world.to_frame(T, part)[0] for part in (rows[:, :d], rows[:, d:-1]))
    r = np.linalg.norm(v, axis=1)
    nearest = [k for k in np.argsort(r, kind="stable").tolist() if math.isfinite(r[k])][:MOST]
    return [ids[k] for k in nearest], v[nearest], rows[nearest, -1], o[nearest]


def locate(state: State, scan: ScanContext, of: Evidence, old: Known) -> Proposal | None:
    """Return where a constellation is one of old landmarks, if there is one such place."""
    if scan.channel.landmark.kind == "tag":
        v, V = scan.channel.calibrated(scan.map).invert(scan.y)
        found = locate_tags(old, scan.ids, v, V @ scan.R @ V.swapaxes(1, 2))
    elif scan.channel.gives_distances:
        found = locate_ranges(old, scan.ids, scan.pose(), *scan.distances())
    else:
        ids, v, sigma, o = _constellation(state, scan, of)
        is_rays = scan.channel.gives_rays
        found = locate_rays(old, ids, v - o, sigma, o) if is_rays else locate_points(old, ids, v, sigma)
    return None if isinstance(found, str) else found


def _propose(state: State, scan: ScanContext, of: Evidence) -> None:
    """Begin a second hypothesis where a constellation is one of old landmarks, and the robot is not.

    If nothing shows that the robot is elsewhere, that is one since it left the old place, or a likelier one than the
    last.
    """
    name, r, tracks, by_shape = scan.event.robot, state.map.mean(scan.robot), state.tracks, of.ratio > -SURE
    if by_shape:
        own = [t for t in tracks.confirmed.values() if t.begun[1] == name and tracks.is_invented(t.id)]
        onset_ns, of.searched = of.onset([state.begun_ns(t.id) for t in own], ODDS), tracks.changes
        if onset_ns is None:
            return
        of.since_ns = onset_ns
    old = older(state, scan, of)
    found = locate(state, scan, of, old)
    if found is None or (by_shape and found.gain < of.gain):
        return
    off = state.moving[name].motion.space.pose.minus(found.T, scan.pose())
    if off @ np.linalg.solve(found.cov, off) <= gate(SURVEYED, len(off)):  # there it is
        return
    other = state.pose_hypotheses[name] = PoseHypothesis.of(
        state.map, state.moving[name], state.blocks, scan.event.t_ns
    )
    write_robot(other.map, other.moving, moved_with(r[: len(found.T)], scan.pose(), found.T), found.cov)
    of.gain, of.fitted = found.gain, {old.names[row]: 0.0 for row in found.matched if row >= 0}
    of.p = found.p
    if by_shape:
        of.again = _mapped_again(state, scan, r, other.map.mean(scan.robot), found.cov)
        of.weigh()


def _pair(scan: ScanContext, places: Array | None, old: Known) -> dict[int, int]:
    """Return by the rows of old landmarks the observations at `places` (K, d) that may be of them, the nearest of each.

    With an id it is the landmark of that name, without one the nearest.
    """
    rows, gaps = rows_of(old, scan.ids), np.zeros(len(scan.ids))
    if places is not None and None in scan.ids:
        gaps, nearest = old.tree().query(places)
        rows = np.where([name is None for name in scan.ids], nearest, rows)
    return {int(rows[k]): int(k) for k in np.argsort(-gaps, kind="stable") if rows[k] >= 0}


def _try(state: State, scan: ScanContext, of: Evidence) -> None:
    """Correct a second hypothesis by a scan; place the robot there if it is certain, and forget it if it does not fit.

    Without ids the constellation still has to be one of old landmarks, in one place alone, most of which have fitted.
    """
    robot, channel, old = scan.event.robot, scan.channel, older(state, scan, of)
    other, model = state.pose_hypotheses[robot], channel.models[old.model.kind]
    view, places = replace(scan, map=other.map), channel.places(other.map, scan.robot, scan.y)
    pairs = _pair(scan, places, old) if len(old.names) else {}
    logs, fits = dict[Id, float](), list[Id]()
    if pairs:
        names, rows = [old.names[row] for row in pairs], [*pairs.values()]
        update = view.known_update(model, old.values[[*pairs]], rows)._replace(gate=gate(SURVEYED, channel.dof))
        done = state.estimator.for_fixes().correct(other.map, update._replace(R=LOOSE**2 * update.R))
        gains = np.where(done.fused, _log_odds(scan, rows, done.d2, old.density(), done.Z, of.p), -SURE)
        fits = [*compress(names, done.fused)]
        each = zip(names, rows, gains.tolist(), done.fused.tolist(), strict=True)
        logs = {name: gain for name, k, gain, is_one in each if is_one or scan.ids[k] is not None}
    if None in scan.ids:
        logs = existence.log_misses(view, old, state.policies[scan.key].upkeep) | logs
    of.count(logs)
    if of.gain - of.ratio >= math.log(ODDS) and fits:
        again = locate(state, scan, of, old) if None in scan.ids else None
        matched = {old.names[row] for row in again.matched if row >= 0} if again else set()
        if None not in scan.ids or 2 * len(matched & of.fitted.keys()) > len(matched):
            _place(state, scan, of, other, fits)
    elif of.gain <= -SURE:
        del state.pose_hypotheses[robot]
        of.fitted, of.gain, of.again = {}, 0.0, []


def _place(state: State, scan: ScanContext, of: Evidence, other: PoseHypothesis, fits: Sequence[Id]) -> None:
    """Move a robot to where its second hypothesis is, with its constants; what was mapped while it was elsewhere goes.

    Its error is that of the second hypothesis, and that of the map there, which the second hypothesis does not have: of
    the pose of which the landmarks l that it sees are least squares, d r = (sum A'A)^-1 sum A' d l, A = d l / d r.
    """
    robot, slot, tracks = scan.event.robot, scan.robot, state.tracks
    own = [slot, *(constant for constant, _, _ in other.moving.constants)]
    before, after, cov = state.map.mean(slot), other.map.mean(slot), other.map.covariance(own)
    d, dof = scan.dimensions, scan.channel.pose_dof
    A, mapped, parts = list[Array](), [name for name in fits if name not in tracks.known], dict[Id, Array]()
    for name in fits:
        space, l, parts[name] = _block(state, name)
        l[:d] -= after[:d]
        A.append(np.hstack([np.eye(space.dof, d), space.generator(l)]))
    ends = np.cumsum([0, *(len(part) for part in A)])
    G = np.split(np.linalg.pinv(np.concatenate(A)), ends[1:-1], axis=1)
    of_map = np.hstack([np.zeros((dof, 0)), *(G[fits.index(name)] @ parts[name] for name in mapped)])
    n = len(cov) + of_map.shape[1]
    F, Q = np.eye(n), np.zeros((n, n))
    F[: len(cov)], Q[: len(cov), : len(cov)] = 0.0, cov
    F[:dof, len(cov) :] = of_map
    of.again = _mapped_again(state, scan, before, after, cov)
    of.weigh()
    moved = [*own, *(tracks.slots[name] for name in mapped)]
    state.move_blocks(moved, F, Q, map(other.map.mean, own))
    for name in _young(tracks, robot, of):
        state.remove(name)
        scan.report.removed += ((name, MEANWHILE),)
    for track in [*tracks.tentative.values()]:
        state.map.remove(track.slot)
        del tracks.tentative[track.id]
    for track in tracks.confirmed.values():  # they were looked for from another place
        track.missed, track.beyond[:] = 0.0, 0.0
    state.clones.forget_current(robot)
    state.moving[robot].left_out.clear()
    report_found(state, scan, of.since_ns, before)


def report_found(state: State, scan: ScanContext, since_ns: int, before: Array) -> None:
    """Report that a robot, elsewhere since a time, has been moved from `before`; forget the evidence of that."""
    robot, after, d = scan.event.robot, state.map.mean(scan.robot), scan.dimensions
    for others in (state.pose_hypotheses, state.sums, state.evidence):
        others.pop(robot, None)
    pose = state.moving[robot].motion.space.pose
    off = pose.minus(after[: pose.size], before[: pose.size])
    moved, turned = (float(np.linalg.norm(part)) for part in (off[:d], off[d:]))
    scan.report.gaps += (Gap(robot, ELSEWHERE, since_ns, scan.event.t_ns, moved, turned),)


def _mapped_again(
    state: State, scan: ScanContext, before: Array, after: Array, cov: Array
) -> list[tuple[int, float]]:  # fmt: skip
    """Return when a robot's landmarks were begun, and the log odds that they are at older ones by chance, if they are.

    They are moved with their robot from where it was `before` to where it is `after`, with the covariance `cov`.
    """
    from scipy.spatial import cKDTree

    tracks, d, pose = state.tracks, scan.dimensions, len(scan.channel.at)
    frame, dof, kind = FRAMES[pose], scan.channel.pose_dof, scan.channel.landmark.kind
    names = [name for name, track in tracks.confirmed.items() if track.model.kind == kind]
    if kind not in EUCLIDEAN or len(names) < 2:
        return []
    places, begun = state.map.means(tracks.slots_of(names), d), np.array([*map(state.begun_ns, names)])
    tree = cKDTree(places)
    spacing, out = np.median(tree.query(places, 2)[0][:, 1]), list[tuple[int, float]]()
    for name, place, t_ns in zip(names, places, begun, strict=True):
        v, V_r, V_l = (part[0] for part in frame.to_frame(before[:pose], place[None]))
        p, P_r, P_v = (part[0] for part in frame.from_frame(after[:pose], v[None]))
        nearest = tree.query(p)[1]
        is_own = tracks.is_invented(name) and tracks.confirmed[name].begun[1] == scan.event.robot
        if not is_own or begun[nearest] >= t_ns:
            continue
        G = P_v @ np.hstack([V_r, V_l])
        P = state.map.covariance([scan.robot, tracks.slots[name]])
        rows = [*range(dof), *range(len(P) - d, len(P))]
        C = G @ P[np.ix_(rows, rows)] @ G.T + P_r @ cov[:dof, :dof] @ P_r.T
        # of the gate: that of the unit ball, pi or 4 pi / 3, is about 4
        volume = 4.0 * gate(SURVEYED, d) ** (d / 2) * math.sqrt(max(np.linalg.det(C), 0.0))
        z, chance = p - places[nearest], volume / spacing**d
        if z @ np.linalg.solve(C, z) <= gate(SURVEYED, d) and chance < 1.0:
            out.append((int(t_ns), math.log(max(chance, math.exp(-SURE)))))
    return out


def _block(state: State, name: Id) -> tuple[Space, Array, Array]:
    """Return the space and the numbers l of a landmark, of unknown depth as a point, and L (dof, .) in its block."""
    known, confirmed = state.tracks.known, state.tracks.confirmed
    if name in known:
        model, l = known.model(name), known.mean(name)
    else:
        model, l = confirmed[name].model, state.map.mean(confirmed[name].slot)
    if isinstance(model, UnknownDepth) and isinstance(model, Pointed):
        (p,), (L,) = model.to_point(l[None])
        return POINTS[model.space.world].space, p, L
    return model.space, l, np.eye(model.space.dof)
