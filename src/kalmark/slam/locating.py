"""A robot that may be anywhere: put where its scan fits the map, at a global start and after a gap, or a Gaussian sum.

A sensor that finds places determines a pose by one scan of known landmarks (`association/global_start.py`).  A weaker
measurement, a range, a strength or a bearing with an id, corrects a Gaussian sum of poses, from the first one whose
linearisation does not hold over the robot's covariance until it holds over that of the sum.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from kalmark.arrays import Array, Flags
from kalmark.association.global_start import FEWEST, FEWEST_NAMED, locate_points, locate_rays, rows_of
from kalmark.association.protocol import DEFERRED, NEW, Decision
from kalmark.association.query import Query
from kalmark.events import Id
from kalmark.filter.estimators import Update
from kalmark.filter.map import Map
from kalmark.geometry.gaussian import gate
from kalmark.geometry.pose_frames import moved_with
from kalmark.models.observe import linearize
from kalmark.models.protocols import distances_alone, place_of
from kalmark.report import JudgedScan, Observation
from kalmark.slam import elsewhere
from kalmark.slam.evidence import Evidence
from kalmark.slam.gaussian_sum import (
    IN_A_ROW,
    NOWHERE,
    GaussianSum,
    KnownObservation,
    log_likelihood,
)
from kalmark.slam.pose_hypothesis import write_robot
from kalmark.slam.state import State
from kalmark.tracks.channel import Channel
from kalmark.tracks.linearity import bends, turn_holds
from kalmark.tracks.scan import ScanContext
from kalmark.tracks.survey_checks import SURVEYED

UNNAMED = "the pose of its robot is not known yet, and it has no id of a known landmark"
ONE = "from an unknown place it takes two known landmarks, expected a second one or a start with a smaller sigma_xy_m"
DIRECTION = (
    "it determines no distance from an unknown place, expected three bearings of known landmarks in a scan, ranges too "
    "or a start with a smaller sigma_xy_m"
)


class Located(NamedTuple):
    """The decisions of a scan whose robot was placed by it, or why its pose is not known yet.

    `fates` (K,) are those of observations that have corrected what is known of the pose, and do not determine it.
    """

    why: str
    is_placed: bool = False
    decisions: list[Decision] | None = None
    fates: Sequence[Observation] = ()


def locate_in_known_map(state: State, scan: ScanContext, query: Query) -> Located | None:
    """Move a robot that may be anywhere in a known map to where its scan fits; None of a robot that may not.

    A scan that does not determine the pose corrects a Gaussian sum of poses, or waits with the reason.
    """
    if not (state.tracks.known or state.surveys.trial) or scan.dimensions != 2:
        return None
    name = scan.event.robot
    sum_ = state.sums.get(name)
    shown = sum_ is not None and sum_.shows
    if scan.channel.gives_places:
        if len(state.tracks.known) < FEWEST or (not shown and is_heading_known(scan)):
            return None
        return _locate(state, query)
    if not can_be_summed(scan.channel):
        return None
    if sum_ is None or not shown:
        is_turn, bent = is_heading_known(scan), _nonlinear_axes(state, scan)
        if bent is None:
            return None if is_turn or len(state.tracks.known) < FEWEST else Located(UNNAMED)
        is_distance = distances_alone(scan.channel.sensor)
        if is_turn and not (bent[1:].any() and is_distance):
            return None
        if not is_turn and bent[1:].any() and not is_distance:
            found = _locate(state, query) if scan.channel.gives_rays else None
            return found if found and found.is_placed else Located(DIRECTION)
        if not is_turn and bent[1:].any() and len(state.tracks.known) + len(state.surveys.trial) < 2:
            return Located(ONE)
        moving = state.moving[name]
        sum_ = state.sums[name] = GaussianSum.of(state.map, moving, state.blocks, scan.event.t_ns, _gate(scan))
    return _summed(state, scan, sum_)


def _locate(state: State, query: Query) -> Located:
    """Move a robot to where its sensor is in the known map, if its scan determines that."""
    scan, ids = query.scan, query.ids
    find = locate_rays if scan.channel.gives_rays else locate_points
    of = next((known for kind, known in scan.tracks.known.of_kind.items() if kind in scan.channel.models), None)
    if of is None:
        return Located("its sensor does not find the places of known landmarks")
    found = find(of, ids, *scan.places())
    if isinstance(found, str):
        return Located(found)
    _put(state, scan, found.T)
    state.sums.pop(scan.event.robot, None)
    if (rows_of(of, ids) >= 0).sum() >= FEWEST_NAMED[2]:
        return Located("", True)
    why = f"found in the known map: {(found.matched >= 0).sum()} of {ids.count(None)} observations agree"
    missed: Decision = NEW, "not of the known map from where the others are"
    decisions: list[Decision] = [
        (i, "") if i is not None else (of.names[row], why) if row >= 0 else missed
        for i, row in zip(ids, found.matched.tolist(), strict=True)
    ]
    return Located("", True, decisions)


def _nonlinear_axes(state: State, scan: ScanContext) -> Flags | None:
    """Return along which axes (3,) of the pose no linearisation describes what is seen of known landmarks.

    None where nothing is.
    """
    tracks, found = state.tracks, []
    names: list[Any] = [name if name in tracks.known or name in state.surveys.trial else None for name in scan.ids]
    for model, rows in tracks.any_by_model(scan.channel, names):
        l = np.array([_place(state, names[k])[: model.d] for k in rows])
        found.append(_bent_axes(state.map, scan, scan.known_update(model, l, rows)))
    return np.any(found, axis=0) if found else None


def _bent_axes(map_: Map, scan: ScanContext, update: Update) -> Flags:
    """Return along which axes (3,) of the pose no linearisation describes some observations."""
    head, P = scan.channel.head(map_, scan.robot), map_.covariance([scan.robot])[:3, :3]
    return np.asarray(bends(update.model, head[None], P[None], update.y, update.R).any(axis=0))


def _place(state: State, name: Any) -> Array:
    """Return the numbers of a landmark that is known exactly, or of a survey in the map."""
    known = state.tracks.known
    return known.mean(name) if name in known else state.map.mean(state.tracks.slot(name))


def compare_hypotheses(state: State, scan: ScanContext, judged: Sequence[JudgedScan]) -> None:
    """Compare the filter of a robot with the sum of where else it may be, by what both expected of a scan."""
    sum_ = state.sums.get(scan.event.robot)
    if sum_ is None or not can_be_summed(scan.channel) or not judged:
        return
    done = {k: (group.done.d2[i], group.done.Z[i]) for group in judged for i, k in enumerate(group.rows)}
    gain = 0.0
    for k, one in _seen(state, scan, sum_.prior.map):
        gain += log_likelihood(*done[k], one) if k in done else 0.0
        gain -= sum_.observe(state.estimator.for_fixes(), one)[1]
    most = 0.5 * _gate(scan)
    sum_.lead += min(max(gain, -most), most)  # what is wrong in a scan may be so together
    if sum_.lead > (IN_A_ROW + 2) * most:
        del state.sums[scan.event.robot]
    elif sum_.lead <= 0.0 and sum_.is_found:
        sum_.lead = -math.inf
        _show(state, scan, sum_)


def can_be_summed(channel: Channel) -> bool:
    """Return whether what a sensor observes corrects a Gaussian sum where no linearisation holds."""
    return channel.dimensions == 2 and not channel.gives_places and not channel.sees_velocity


def is_doubted(state: State, scan: ScanContext) -> bool:
    """Start a Gaussian sum for a robot whose ranges do not fit its pose.  Return whether it has one."""
    name = scan.event.robot
    if not (can_be_summed(scan.channel) and distances_alone(scan.channel.sensor)):
        return False
    if name not in state.sums:
        moving = state.moving[name]
        state.sums[name] = GaussianSum.anywhere(state.map, moving, state.blocks, scan.event.t_ns, _gate(scan))
    return True


def _gate(scan: ScanContext) -> float:
    return gate(SURVEYED, scan.channel.dof)


def _seen(state: State, scan: ScanContext, map_: Map) -> list[tuple[int, KnownObservation]]:
    """Return the observations of landmarks that are known, with their numbers, as those of a robot in a map alone.

    The covariance of a survey is noise: the survey is not corrected.
    """
    tracks, channel, out = state.tracks, scan.channel, list[tuple[int, KnownObservation]]()
    for k, name in enumerate(scan.ids):
        kind = tracks.sort(name) if name in tracks.known or name in state.surveys.trial else None
        model = channel.models.get(kind or "")
        if model is None or name is None:
            continue
        l = _place(state, name)[: model.d]
        update = replace(scan, map=map_).known_update(model, l[None], [k])._replace(gate=_gate(scan))
        if name not in tracks.known:
            E_l = linearize(model.model, channel.head(map_, scan.robot), l[None], scan.y[k : k + 1])[3][0]
            P_l = state.map.covariance([tracks.slot(name)])[: model.d, : model.d]
            update = update._replace(R=update.R + E_l @ P_l @ E_l.T)
        place = place_of(model.landmark, l[None]) if distances_alone(channel.sensor) else None
        where = NOWHERE if place is None else place[0][0, :2]
        out.append((k, KnownObservation(update, _gate(scan), where, channel.at)))
    return out


def _summed(state: State, scan: ScanContext, sum_: GaussianSum) -> Located:
    """Correct a sum by a scan; return what becomes of the observations."""
    robot, report, m = scan.event.robot, scan.report, scan.y.shape[1]
    seen = _seen(state, scan, state.map)
    report.blank(scan.channel.dof)
    fates = [Observation(k, i, "deferred", None, None, UNNAMED) for k, i in enumerate(scan.ids)]
    for k, one in seen:
        done, _ = sum_.observe(state.estimator.for_fixes(), one)
        d2, is_used = None, True
        if done is not None:
            report.fill([k], done._replace(e=done.e[:, :m]))
            d2, is_used = float(done.d2[0]) if np.isfinite(done.d2[0]) else None, bool(done.fused[0])
        why = "" if is_used else f"outside the gate of {one.gate:.2f}"
        fates[k] = Observation(k, scan.ids[k], "associated" if is_used else "rejected", scan.ids[k], d2, why)
        if is_used and (name := scan.ids[k]) in state.tracks.known and name is not None:
            state.tracks.known.count([name], [True])
    _show(state, scan, sum_)
    for _, one in seen:
        holds = is_heading_known(scan) and not _bent_axes(state.map, scan, one.update).any()
        sum_.linear = sum_.linear + 1 if holds else 0
    if sum_.linear >= IN_A_ROW:
        del state.sums[robot]
    return Located("", fates=fates)


def _show(state: State, scan: ScanContext, sum_: GaussianSum) -> None:
    """Write the moments of a sum to the map: of the robot, of the constants of its controls and of its mounts."""
    name = scan.event.robot
    moving = state.moving[name]
    mounts = [channel.mount for (robot, _), channel in [*state.channels.items()] if robot == name]
    mounts += [reader.mount for (robot, _), reader in state.readers.items() if robot == name]
    slots = [moving.slot, *(slot for slot in (moving.bias, *mounts) if slot is not None and slot >= 0)]
    means, cov = sum_.moments(slots)
    state.move_blocks(slots, np.zeros_like(cov), cov, means)
    state.clones.forget_current(name)


def decide(
    state: State, scan: ScanContext, query: Query, associate: Callable[[Query], Sequence[Decision]]
) -> Sequence[Decision]:
    """Return the decisions on a scan; a robot of unknown heading is first moved to where its scan fits.

    That is by the landmarks that are recognised, or by distances.  It stays there if a landmark is recognised from
    there; what is recognised from elsewhere is deferred: no correction can be linearised there.
    """
    scan.adrift = state.moving[scan.event.robot].held.is_adrift and not is_heading_known(scan)
    if not (scan.adrift and scan.locates):
        return associate(query)
    alone, before, decisions = Evidence(since_ns=scan.event.t_ns), state.map.mean(scan.robot), associate(query)
    ids: tuple[Any, ...] = tuple(name if state.tracks.sort(name) else None for name, _ in decisions)
    if found := elsewhere.locate(state, replace(scan, ids=ids), alone, elsewhere.older(state, scan, alone)):
        _put(state, scan, found.T)
        moved = associate(query)
        if any(state.tracks.sort(name) for name, _ in moved):
            return moved
        state.map.set_predicted(scan.robot, before)
    return [(DEFERRED, UNNAMED)] * len(decisions) if {*ids} != {None} else decisions


def is_heading_known(scan: ScanContext) -> bool:
    """Return whether a correction may be linearised at the heading of a scan's robot; of a robot of space it is."""
    return len(scan.pose()) != 3 or turn_holds(scan.map.covariance([scan.robot])[:3, :3])


def relocate_robot(state: State, channel: Channel, name: str, T: Array, cov: Array) -> None:
    """Put a robot of space where its sensor is at T (7,), with the covariance (6, 6), wherever it was."""
    moving = state.moving[name]
    r = state.map.mean(moving.slot)[:7]
    write_robot(state.map, moving, moved_with(r, channel.pose(state.map, moving.slot), T), cov)
    state.clones.forget_current(name)


def inflate_covariance(state: State, name: str, landmarks: Sequence[Id], factor: float) -> None:
    """Multiply the joint covariance of a robot and of landmarks by a factor: their drift is larger than that."""
    slots = [state.moving[name].slot, *state.tracks.slots_of(landmarks).tolist()]
    n = sum(len(state.map.rows(slot)) for slot in slots)
    state.move_blocks(slots, math.sqrt(factor) * np.eye(n), np.zeros((n, n)))


def _put(state: State, scan: ScanContext, T: Array) -> None:
    """Move a robot of the plane so that the sensor of a scan is at T (3,).

    Its mean alone: its covariance includes that pose.
    """
    r = state.map.mean(scan.robot)
    state.map.set_predicted(scan.robot, np.append(moved_with(r[:3], scan.pose(), T), r[3:]))
