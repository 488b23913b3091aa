"""Tentative landmarks: compared with what no landmark explains, confirmed with what was kept of them, or dropped.

A tentative landmark may also be a second hypothesis for the place of a landmark with an id.  An observation that does
not fit the first place starts it, because the first observation may have been the outlier.  Each further observation
fits one of both places and is an outlier of the other.  The second place replaces the first at sufficient odds.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress

import numpy as np

from kalmark.arrays import Flags
from kalmark.association.protocol import REMAP, Decision
from kalmark.errors import MapError
from kalmark.events import Id
from kalmark.geometry.gaussian import gate as chi2_gate
from kalmark.management import ambiguous_tags, confirm, wall_growth
from kalmark.report import JudgedScan, Observation
from kalmark.slam.factors import update_by_blocks
from kalmark.slam.policy import Policy
from kalmark.slam.starting import SINGULAR
from kalmark.slam.state import State
from kalmark.tracks.channel import ObservationModel
from kalmark.tracks.scan import ScanContext
from kalmark.tracks.track import Late, Status, Track

OUTLIER = math.log(0.95 / 0.05)  # the log odds that one observation with an id is right
WITHIN = 0.9999  # of right observations fit
ELSEWHERE = "its first observations are outliers: moved to the place of the later ones"


def confirm_tentative(state: State, scan: ScanContext, policy: Policy, new: list[int], decisions: Sequence[Decision],
    seen: dict[int, Observation],
) -> dict[int, tuple[Id, str]]:  # fmt: skip
    """Count the observations of tentative landmarks; return those that confirm one, which is one from here on."""
    if not state.tracks.tentative:
        return {}
    state.tracks.rename_tentative(scan.event.ids or ())
    rows = [k for k in new if decisions[k][0] in policy.starts]
    lost = np.array([decisions[k][0] is REMAP for k in rows], dtype=np.bool_)
    try:
        matches, others = confirm.match_tentative(scan, policy.association, rows, lost)
    except np.linalg.LinAlgError:
        seen |= {k: Observation(k, None, "ignored", None, None, SINGULAR) for k in rows}
        return {}
    seen |= {o.index: o for o in others}
    confirmed: dict[int, tuple[Id, str]] = {}
    waiting: dict[int, Track] = {}
    for match in matches:
        track, u = state.tracks.tentative[match.name], policy.upkeep
        track.hits, track.chances, track.unseen = track.hits + 1, track.chances + 1, -1
        if not u.confirms(track.hits):
            scan.add_reports([match.name], [match.k], [True])
        if scan.channel.joins:
            track.extent = wall_growth.extend_extents(scan, [track], [match.k])[0]
        if u.confirms(track.hits):
            confirmed[match.k] = match.name, f"confirmed: seen in {track.hits} of {track.chances} scans"
            _confirm(state, scan, track)
            continue
        why = f"seen in {track.hits} of {track.chances} scans, {u.confirm} of {u.within} make a landmark"
        seen[match.k] = Observation(match.k, None, "tentative", match.name, match.d2, why)
        waiting[match.k] = track
    if waiting and policy.keep_poses:
        _keep(state, scan, policy.keep_poses, waiting)
    return confirmed


def _confirm(state: State, scan: ScanContext, track: Track) -> None:
    """Make a landmark of a tentative track, and fuse the measurements that were kept of it from their clones.

    The difference of expectation and measurement of each, e - y, becomes a block of the map, which is observed to be
    zero.
    """
    del state.tracks.tentative[track.id]
    state.tracks.confirm(track)
    late: list[Late] = [] if track.first is None else [track.first]
    here = scan.channel
    for m in track.measurements:
        channel, clone = state.channels[m.robot, m.sensor], state.clones[m.clone]
        try:
            start, R = confirm.measurement_difference(state.map, state.estimator, channel, clone, track, m)
            update = update_by_blocks(scan.robot, -1, here.at, np.zeros((1, len(R))), R[None], here.gate)
            done = state.corrected_by([start], update)
        except np.linalg.LinAlgError:
            continue
        except MapError:  # it is full
            break
        if not done.valid:
            state.refuse_lost(scan.event)
        if done.fused[0]:
            track.observations += 1
            late.append(m.late)
    track.measurements = []
    scan.report.late += tuple(late)


def _keep(state: State, scan: ScanContext, most: int, waiting: dict[int, Track]) -> None:
    """Keep observations of tentative tracks with a clone of the pose, of this channel the last `most`."""
    held = state.clones.of(scan.key)
    gone = set(held[: max(len(held) - most + 1, 0)])
    for track in state.tracks.tentative.values() if gone else ():
        mine = [m for m in track.measurements if m.clone not in gone or (m.robot, m.sensor) != scan.key]
        track.measurements = mine
    state.release(scan.key)
    try:
        clone = state.clone(scan.key, scan.event.t_ns)
    except MapError:  # it is full: these measurements are lost
        return
    for k, track in waiting.items():
        track.measurements.append(scan.measurement(k, clone))


def contest(state: State, scan: ScanContext, model: ObservationModel, group: JudgedScan, misfits: Flags, odds: float
) -> None:  # fmt: skip
    """Weigh where the `misfits` (K,) of a group of observations with ids have their landmarks against where these are.

    A landmark is begun again there if that is `odds` times likelier, and if no fewer landmarks that were in the map
    before fit meanwhile than do not: else the robot may be elsewhere.
    """
    tracks, rivals = state.tracks, {t.of: t for t in state.tracks.tentative.values() if t.of is not None}
    if not rivals and not misfits.any():
        return
    mine = [i for i, name in enumerate(group.names) if name in tracks.confirmed and name not in state.surveys.trial]
    fitting = {group.names[i]: tracks.confirmed[group.names[i]].entered for i in mine if not misfits[i]}
    for i in mine:
        name, k = group.names[i], group.rows[i]
        rival = rivals.get(name)
        if not misfits[i] and rival is not None:
            rival.log_odds = (rival.log_odds or 0.0) - OUTLIER
            if rival.hits == 1 or rival.log_odds < -math.log(odds):
                _forget(state, rival)
        elif misfits[i] and scan.ids[k] is not None:
            if rival is None or not _agrees(scan, model, rival, k):
                _begin(state, scan, name, k, rival)
                continue
            rival.hits, rival.log_odds = rival.hits + 1, (rival.log_odds or 0.0) + OUTLIER
    rivals = {t.of: t for t in tracks.tentative.values() if t.of is not None}
    contested = sum(rival.hits > 1 for rival in rivals.values())
    for name, rival in rivals.items():
        rival.covisible |= {other for other, entered in fitting.items() if entered < rival.entered} - {name}
        if (rival.log_odds or 0.0) >= math.log(odds) and len(rival.covisible) >= contested and name in tracks.confirmed:
            state.remove(name)
            del tracks.tentative[rival.id]
            rival.id, rival.of, rival.log_odds, rival.covisible = name, None, None, set()
            tracks.confirm(rival)
            scan.report.removed += ((name, ELSEWHERE),)


def _agrees(scan: ScanContext, model: ObservationModel, rival: Track, k: int) -> bool:
    """Return whether the k-th observation fits a tentative landmark."""
    model = scan.channel.models.get(rival.model.kind, model)
    d2 = scan.predict(model, np.array([rival.slot]), [k])[1]
    return bool(d2[0] <= chi2_gate(WITHIN, scan.channel.dof))


def _begin(state: State, scan: ScanContext, name: Id, k: int, before: Track | None) -> None:
    """Begin the other place of a landmark at the k-th observation, in the place of one `before` that was seen once."""
    if (before is not None and before.hits > 1) or (scan.channel.is_ambiguous and not ambiguous_tags.is_clear(scan, k)):
        return
    with suppress(np.linalg.LinAlgError, MapError):  # it is full
        start = scan.start_of(k)
        if not start.is_finite:
            return
        track = Track(
            f"other place of {name}",
            scan.channel.landmark,
            state.add(start),
            size_m=scan.size_of(k),
            begun=(scan.event.t_ns, scan.event.robot),
        )
        against, track.entered = state.tracks.confirmed[name].observations - 1, state.tracks.changes
        track.status, track.of, track.log_odds = Status.TENTATIVE, name, -OUTLIER * against
        if before is not None:
            track.log_odds, track.covisible = before.log_odds, before.covisible
            _forget(state, before)
        state.tracks.tentative[track.id] = track


def _forget(state: State, track: Track) -> None:
    """Remove a tentative landmark."""
    state.map.remove(track.slot)
    del state.tracks.tentative[track.id]


def drop(state: State, scan: ScanContext, policy: Policy) -> None:
    """Count the tentative landmarks in view that this scan did not show; drop those that cannot be confirmed."""
    tentative, u = state.tracks.tentative, policy.upkeep
    for track in [t for t in tentative.values() if t.of is not None and t.of not in state.tracks.confirmed]:
        _forget(state, track)
    kinds = scan.channel.models
    mine = [name for name, track in tentative.items() if track.model.kind in kinds and track.of is None]
    for name in mine:
        tentative[name].unseen += 1
    missed = [name for name in mine if tentative[name].unseen]
    for name in confirm.tentative_in_view(scan, missed):
        tentative[name].chances += 1
    for name in missed:
        track = tentative[name]
        if u.deletes(track.hits, track.chances) or track.unseen > confirm.OUT_OF_VIEW * u.within:
            why = f"tentative: seen in {track.hits} of {track.chances} scans"
            scan.report.removed += ((name, why),)
            _forget(state, track)
