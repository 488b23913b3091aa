"""Tentative landmarks: compared with what no landmark explains, confirmed with what was kept of them, or dropped."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from kalmark.association.protocol import REMAP, Decision
from kalmark.errors import MapError
from kalmark.events import Id
from kalmark.filter.estimators import Update
from kalmark.management import confirm, merge, walls
from kalmark.report import Observation
from kalmark.slam.policy import Policy
from kalmark.slam.starting import SINGULAR
from kalmark.slam.state import State
from kalmark.tracks.scan import ScanContext
from kalmark.tracks.track import Late, Track


def compare(state: State, scan: ScanContext, policy: Policy, new: list[int], decisions: Sequence[Decision],
    seen: dict[int, Observation],
) -> dict[int, tuple[Id, str]]:  # fmt: skip
    """Count the observations of tentative landmarks; return those that confirm one, which is one from here on."""
    state.tracks.rename_tentative(scan.event.ids or ())
    rows = [k for k in new if decisions[k][0] in policy.starts]
    lost = np.array([decisions[k][0] is REMAP for k in rows], dtype=np.bool_)
    try:
        matches, others = confirm.matched(scan, policy.association, rows, lost)
    except np.linalg.LinAlgError:
        seen |= {k: Observation(k, None, "ignored", None, None, SINGULAR) for k in rows}
        return {}
    seen |= {o.index: o for o in others}
    confirmed: dict[int, tuple[Id, str]] = {}
    waiting: dict[int, Track] = {}
    for match in matches:
        track, u = state.tracks.tentative[match.name], policy.upkeep
        track.hits, track.chances, track.unseen = track.hits + 1, track.chances + 1, -1
        if scan.channel.joins:
            track.extent = walls.grown(scan, [track], [match.k])[0]
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

    What each expects less what it measured, e - y, becomes a block of the map, which is observed to be zero.
    """
    del state.tracks.tentative[track.id]
    state.tracks.confirm(track)
    late: list[Late] = [] if track.first is None else [track.first]
    for m in track.measurements:
        channel, clone = state.channels[m.robot, m.sensor], state.clones[m.clone]
        try:
            start, R = confirm.residual(state.map, state.estimator, channel, clone, track, m)
            slot = state.add(start)
        except np.linalg.LinAlgError:
            continue
        except MapError:  # it is full
            break
        p, gate = len(R), scan.channel.gate
        model = merge.ZeroDifference(scan.channel.at, p)
        update = Update(model, scan.robot, -1, np.array([slot]), p, np.zeros((1, p)), R[None], gate)
        done = state.corrected(update, scan.event)
        state.map.remove(slot)
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


def drop(state: State, scan: ScanContext, policy: Policy) -> None:
    """Count the tentative landmarks in view that this scan did not show; drop those that cannot be confirmed."""
    tentative, u = state.tracks.tentative, policy.upkeep
    mine = [name for name, track in tentative.items() if track.model.kind in scan.channel.models]
    for name in mine:
        tentative[name].unseen += 1
    missed = [name for name in mine if tentative[name].unseen]
    for name in confirm.in_view(scan, missed):
        tentative[name].chances += 1
    for name in missed:
        track = tentative[name]
        if u.hopeless(track.hits, track.chances) or track.unseen > confirm.OUT_OF_VIEW * u.within:
            why = f"tentative: seen in {track.hits} of {track.chances} scans"
            scan.report.removed += ((name, why),)
            state.map.remove(track.slot)
            del tentative[name]
