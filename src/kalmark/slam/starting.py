"""New landmarks: at first sight, from several measurements of one id, or from cloned poses.  [S] (32)-(38), [T] 2."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, cast

import numpy as np

from kalmark.association.protocol import DEFERRED, NEW, REMAP, Answer, Decision, Mixture
from kalmark.errors import MapError
from kalmark.events import Id
from kalmark.management import ambiguous_tags, delayed, ray_restarts, wall_growth
from kalmark.management.pending import Initialization, Step
from kalmark.models.protocols import distances_alone
from kalmark.report import ALONE, Observation
from kalmark.slam.policy import Policy
from kalmark.slam.state import State
from kalmark.tracks.channel import ObservationModel
from kalmark.tracks.scan import ScanContext
from kalmark.tracks.track import Pending, Status, Track

UNEXPLAINED = "no landmark explains this measurement"
AGAIN = "started again: from where it was seen before its depth stays open"
SINGULAR = "what it may be cannot be computed: a matrix is singular"


def initialize_landmark(state: State, scan: ScanContext, policy: Policy, k: int, name: Any, reason: str) -> Observation:
    """Initialize a landmark by one measurement, or return the observation with the reason against it."""
    try:
        return _add_landmark(state, scan, policy, k, name, reason)
    except np.linalg.LinAlgError:
        return Observation(k, scan.ids[k], "ignored", None, None, SINGULAR)


def _add_landmark(state: State, scan: ScanContext, policy: Policy, k: int, name: Any, reason: str) -> Observation:
    """Add a landmark: L = g(R, S, y), P_LL = G_r P G_r' + G_y R G_y'.  [S] (32)-(38)."""
    channel, id_ = scan.channel, scan.ids[k]
    refusal = _refusal(state, scan, policy, k, name, reason)
    if refusal is not None:
        return refusal
    if policy.deferred is not None and not isinstance(name, Answer):
        return _defer_initialization(state, scan, policy.deferred, k, name)
    start, space = scan.start_of(k), channel.landmark.space
    if start.mean.shape != (space.size,):
        found = f"it finds {len(start.mean)} numbers, a {channel.landmark.kind} has {space.size}"
        return Observation(k, id_, "ignored", None, None, found)
    if not start.is_finite:
        return Observation(k, id_, "ignored", None, None, UNEXPLAINED)
    held = name is DEFERRED
    tentative = held or (name in (NEW, REMAP) and policy.upkeep.confirm > 1)
    name = state.tracks.new_name() if isinstance(name, Answer) else name
    try:
        slot, by = state.add_seen(start), (scan.event.t_ns, scan.event.robot)
        track = Track(name, channel.landmark, slot, size_m=scan.size_of(k), begun=by, last=by)
    except MapError as full:
        return Observation(k, id_, "ignored", None, None, str(full))
    if channel.joins:
        track.extent = wall_growth.first_extent(scan, track, k)
    if tentative:
        track.status, state.tracks.tentative[name] = Status.TENTATIVE, track
    else:
        state.tracks.confirm(track)
    scan.add_reports([name], [k], [True])
    if not tentative:
        return Observation(k, id_, "new", name, None, reason)
    if policy.upkeep.keep_poses:
        track.first = scan.event.t_ns, *scan.key, k
    if held:
        return Observation(k, None, "deferred", name, None, reason)
    why = f"first observation: {reason}" if reason else "first observation"
    return Observation(k, None, "tentative", name, None, why)


def take_open_rays(
    state: State, scan: ScanContext, groups: list[tuple[ObservationModel, list[int]]], decisions: Sequence[Decision]
) -> dict[int, float]:  # fmt: skip
    """Return the observations of rays whose depth stays open, and take them out of the groups to be fused.

    With each comes the way from its anchor if that is beyond the nearest landmark of its prior, 0 if it is not.
    """
    found = dict[int, float]()
    for model, rows in groups:
        slots = state.tracks.slots_of([decisions[k][0] for k in rows])
        is_open, ways = ray_restarts.bent_rays(scan, model, slots, rows)
        if scan.channel.mount >= 0:
            is_open |= ray_restarts.rays_without_baseline(scan, model, slots, rows)
        each = zip(rows, (is_open | (ways > 0.0)).tolist(), ways.tolist(), strict=True)
        found |= {k: way for k, is_one, way in each if is_one}
        rows[:] = [k for k in rows if k not in found]
    return found


def restart(
    state: State, scan: ScanContext, rows: Mapping[int, float], decisions: Sequence[Decision]
) -> list[Observation]:  # fmt: skip
    """Start the landmarks of these observations again: after a correction, for the camera is on their new anchors."""
    found, names = [], [cast("Id", decisions[k][0]) for k in rows]
    for (k, way), name in zip(rows.items(), names, strict=True):
        start, track = scan.start_of(k, way=way), state.tracks.confirmed[name]
        state.map.remove(track.slot)
        state.tracks.replace(track, state.add(start), track.model)
        found.append(Observation(k, scan.ids[k], "new", track.id, None, AGAIN))
    return found


def _refusal(state: State, scan: ScanContext, policy: Policy, k: int, name: Any, reason: str) -> Observation | None:
    """Return what becomes of an observation that can start no landmark, None of one that can."""
    id_, sensor = scan.ids[k], type(scan.channel.sensor).__name__
    if name is None or isinstance(name, Mixture):
        return Observation(k, id_, "ignored", None, None, reason)
    if name in (DEFERRED, REMAP) and name not in policy.starts:
        return Observation(k, id_, "deferred", None, None, reason)
    if name == scan.event.robot:
        return Observation(k, id_, "ignored", None, None, "a robot does not see itself")
    state.tracks.reserve([id_])
    if name in state.tracks.slots or name in state.tracks.known:
        return Observation(k, id_, "rejected", name, None, f"it is no {scan.channel.landmark.kind}")
    if policy.deferred is None and not scan.channel.starts_landmarks:
        several = "; several can, with initialization: trilateration" if distances_alone(scan.channel.sensor) else ""
        why = f"a {sensor} {ALONE}{several}"
        return Observation(k, id_, "ignored", None, None, why)
    if not isinstance(name, Answer) or policy.deferred is None:
        return None
    if not scan.channel.is_ambiguous:
        why = f"a {sensor} measurement without an id cannot start a landmark"
        return Observation(k, id_, "ignored", None, None, why)
    return (
        None
        if ambiguous_tags.is_clear(scan, k)
        else Observation(k, id_, "deferred", None, None, ambiguous_tags.MIRRORED)
    )


def _defer_initialization(state: State, scan: ScanContext, way: Initialization, k: int, name: Id) -> Observation:
    """Take a measurement that alone does not determine a landmark; start the landmark if all of them do."""
    track = state.tracks.pending.get(name)
    if track is None:
        pending, by = Pending(scan.key, name), (scan.event.t_ns, scan.event.robot)
        track = Track(name, scan.channel.landmark, status=Status.PENDING, pending=pending, begun=by)
    try:
        step = way.observe(scan, k, track.pending or Pending(scan.key, name))
        if step.start is not None and not step.start.is_finite:
            step = Step("ignored", UNEXPLAINED)
        _apply_step(state, scan, k, track, step)
        if not step.reason and step.start is None:
            assert track.pending is not None
            step = way.solve(scan, track.pending)
            _apply_step(state, scan, k, track, step)
    except MapError as full:
        return Observation(k, scan.ids[k], "ignored", None, None, str(full))
    return Observation(k, scan.ids[k], step.outcome, name if step.start else None, None, step.reason)


def _apply_step(state: State, scan: ScanContext, k: int, track: Track, step: Step) -> None:
    """Apply a step of an initialiser.  Raises MapError where the map is full."""
    pending = step.pending or track.pending
    assert pending is not None
    for correction in step.corrections:
        state.map.predict(state.rows(correction.parts), correction.F, correction.Q)
        state.map.set_predicted(correction.slot, correction.mean)
    if step.added:
        pending = replace(pending, hypotheses=tuple(state.add_all(step.added)))
    if step.keep:
        pending = replace(
            pending,
            measurements=(*pending.measurements, scan.measurement(k, state.clone(scan.key, scan.event.t_ns))),
        )
    if step.start is not None:
        track.slot, track.size_m = state.add(step.start), scan.size_of(k)
        track.pending = None
        state.tracks.pending.pop(track.id, None)
        state.tracks.confirm(track, step.measurements)
    elif step.outcome != "ignored":
        track.pending, state.tracks.pending[track.id] = pending, track
    for slot in step.removed:
        state.map.remove(slot)
    state.release(scan.key)


def initialize_delayed(
    state: State, scan: ScanContext, policy: Policy, new: list[int], decisions: Sequence[Decision]
) -> list[Observation]:
    """Keep measurements of no landmark as pending; start the landmarks that enough of them determine.  [T] 2."""
    way, key = policy.delayed, scan.key
    if way is None:
        return []
    ids: dict[int, Id | None] = {k: None if n is NEW else n for k in new  # type: ignore[misc]
        if (n := decisions[k][0]) is NEW or (isinstance(n, int | str) and not state.is_there(n))}  # fmt: skip
    if not ids:
        return []
    held = state.clones.of(key)
    if not delayed.has_moved(scan, held[-1] if held else None, way):
        return [Observation(k, i, "deferred", None, None, "until the robot has moved on") for k, i in ids.items()]
    try:
        clone = state.clone(scan.key, scan.event.t_ns)
    except MapError as full:
        return [Observation(k, i, "ignored", None, None, str(full)) for k, i in ids.items()]
    made = {k: scan.measurement(k, clone) for k in ids}
    try:
        candidates, best = delayed.extend_candidates(scan, way, state.tracks.candidates.get(key, []), made, ids)
    except np.linalg.LinAlgError:
        state.release(key)
        return [Observation(k, i, "ignored", None, None, SINGULAR) for k, i in ids.items()]
    found = []
    for k, i in ids.items():
        try:
            outcome, name = delayed.start_landmark(scan, way, candidates, best[k]), None
        except np.linalg.LinAlgError:
            found.append(Observation(k, i, "deferred", None, None, SINGULAR))
            continue
        candidates, reason = outcome.candidates, outcome.reason
        if outcome.start is not None and outcome.used is not None:
            try:
                slot = state.add(outcome.start)
            except MapError as full:
                reason = str(full)
            else:
                name = state.tracks.new_name() if best[k].name is None else best[k].name
                assert name is not None
                track = Track(
                    name, scan.channel.landmark, slot, begun=(outcome.used.measurements[0].t_ns, scan.event.robot)
                )
                state.tracks.confirm(track, len(outcome.used.measurements))
                candidates = delayed.drop_explained(scan, candidates, outcome.used, slot)
        found.append(Observation(k, i, "deferred" if name is None else "new", name, None, reason))
    for number in state.clones.of(key)[: -way.poses]:
        candidates = delayed.without_clone(scan, candidates, number)
    state.tracks.candidates[key] = candidates
    state.release(key)
    return found
