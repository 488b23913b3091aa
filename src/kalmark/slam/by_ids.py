"""Correction by a scan whose ids all name landmarks of one type in the map: no association, no new landmark.

It leaves out the stages of `Slam._fuse` and `maintain` that have no effect on such a scan.
"""

from __future__ import annotations

import math
from typing import cast

from kalmark.events import Id, Scan
from kalmark.filter.estimators import Update
from kalmark.report import JudgedScan, Report
from kalmark.slam import elsewhere, moves, tentative
from kalmark.slam.checks import measurements
from kalmark.slam.held_readings import record_repeated_reading
from kalmark.slam.policy import Policy
from kalmark.slam.state import State
from kalmark.slam.surveyed_corrections import is_tried
from kalmark.tracks.channel import ROBOT, Channel
from kalmark.tracks.scan import ScanContext


def correct_by_ids(state: State, event: Scan, channel: Channel, policy: Policy) -> Report | None:
    """Correct the map by a scan whose policy is `by_ids`; None of a scan of which something is to be decided."""
    tracks, name, ids = state.tracks, event.robot, cast("tuple[Id, ...]", event.ids)
    moving = state.moving[name]
    waiting = tracks.tentative or state.clones.clones or state.surveys.misfits or state.sums or state.evidence
    if not ids or moving.held.is_adrift or waiting or tracks.known:
        return None
    kinds = set(map(tracks.sorts.get, ids))
    kind = kinds.pop() if len(kinds) == 1 else None
    model = None if kind in (None, ROBOT) else channel.models.get(kind)
    if model is None or (is_tried(state, name, ids) and policy.association.threshold(channel.dof, 0.0) < math.inf):
        return None
    R, report = measurements(event, channel.sensor, channel.check), Report(event, event.y)
    state.t_ns = event.t_ns
    report.gaps, slots = moves.advance(state, name), tracks.slots_of(ids)
    if state.repeats((name, event.sensor), event.t_ns, event.y, ids):
        return record_repeated_reading(report, ids, channel.dof)
    noise, gate = channel.noise(state.map, moving.slot, model, slots, R, event.cov is not None), channel.gate
    update = Update(
        model.model, moving.slot, channel.mount, slots, model.d, event.y, noise, min(gate, policy.limit),
        not channel.finds_depth,
    )  # fmt: skip
    done, scan = state.correct(update, event), None
    used = done.fused.tolist()
    if event.classes is not None or not all(used):
        scan = ScanContext(
            state.map, tracks, state.clones, state.estimator, channel, moving.slot, event, ids, R, report
        )  # fmt: skip
        if policy.limit < math.inf:
            elsewhere.weigh_far(state, scan, ids, update, done)
    report.e, report.z, report.Z = done[:3]
    judged = JudgedScan(range(len(ids)), ids, ids, done, gate)
    report.judged = (judged,)
    tracks.count(ids, used, (event.t_ns, name))
    if report.gaps and any(used):
        moving.held.located(event.t_ns, False)
    if scan is not None:
        scan.add_reports(ids, judged.rows, used)
        if policy.contests:
            tentative.contest(state, scan, model, judged, elsewhere.misfits(state, scan, done), policy.upkeep.odds)
        if state.evidence:
            elsewhere.weigh(state, scan, None)
    state.let_grow()
    return report
