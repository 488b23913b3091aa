"""Correction by a scan whose ids all name landmarks of one type in the map: no association, no new landmark.

It leaves out the stages of `Slam._fuse` and `maintain` that have no effect on such a scan.
"""

from __future__ import annotations

import math
from typing import cast

import numpy as np

from kalmark.events import Id, Scan
from kalmark.filter.estimators import Update
from kalmark.report import JudgedScan, Report
from kalmark.slam import elsewhere, moves, tentative
from kalmark.slam.checks import measurements
from kalmark.slam.held_readings import record_repeated_reading
from kalmark.slam.policy import Policy
from kalmark.slam.state import State
from kalmark.slam.surveyed_corrections import is_tried
from kalmark.tracks.channel import Channel
from kalmark.tracks.scan import ScanContext


def correct_by_ids(state: State, event: Scan, channel: Channel, policy: Policy) -> Report | None:
    """Correct the map by a scan whose policy is `by_ids`; None of a scan of which something is to be decided."""
    tracks, name, ids = state.tracks, event.robot, cast("tuple[Id, ...]", event.ids)
    moving = state.moving[name]
    waiting = tracks.tentative or state.clones.clones or state.surveys.misfits or state.sums or state.evidence
    if not ids or moving.held.is_adrift or waiting:
        return None
    seen, kinds = [track for track in map(tracks.confirmed.get, ids) if track], set(map(tracks.sorts.get, ids))
    alike = len(seen) == len(ids) and len(kinds) == 1 and not tracks.known
    model = channel.models.get(kinds.pop() or "") if alike else None
    if model is None or (is_tried(state, name, ids) and policy.association.threshold(channel.dof, 0.0) < math.inf):
        return None
    R, report = measurements(event, channel.sensor, channel.check), Report(event, event.y)
    state.t_ns = event.t_ns
    report.gaps, slots = moves.advance(state, name), tracks.slots_of(ids)
    if state.repeats((name, event.sensor), event.t_ns, event.y, event.ids):
        return record_repeated_reading(report, ids, channel.dof)
    scan = ScanContext(state.map, tracks, state.clones, state.estimator, channel, moving.slot, event, ids, R, report)
    R = channel.noise(state.map, moving.slot, model, slots, R, event.cov is not None)
    update = Update(
        model.model, moving.slot, channel.mount, slots, model.d, event.y, R, channel.gate, not channel.finds_depth
    )
    done = elsewhere.correct(state, scan, ids, update)
    report.e, report.z, report.Z, _, fused, _ = done
    for track, used in zip(seen, fused.tolist(), strict=True):
        track.observations += used
    if event.classes is not None:
        scan.add_reports(ids, range(len(ids)), fused.tolist())
    if policy.contests and np.count_nonzero(fused) < len(fused):
        group = JudgedScan(range(len(ids)), ids, ids, done, channel.gate)
        tentative.contest(state, scan, model, group, elsewhere.misfits(state, scan, done), policy.upkeep.odds)
    if report.gaps and fused.any():
        moving.held.located(event.t_ns)
    report.judged = (JudgedScan(range(len(ids)), ids, ids, done, channel.gate),)
    if state.evidence:
        elsewhere.weigh(state, scan, None)
    state.let_grow()
    return report
