"""Map management after the corrections of a scan: what landmarks become, and which of them go.  [TB] 4.4."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress

import numpy as np

from kalmark.errors import MapError
from kalmark.events import Id
from kalmark.management import existence, reparametrize, wall_growth
from kalmark.management import repeated_places as of_map
from kalmark.models.protocols import Reparametrizable, Segmented
from kalmark.report import Observation
from kalmark.slam import elsewhere, merging, surveyed_corrections, tentative
from kalmark.slam.policy import Policy
from kalmark.slam.state import State
from kalmark.tracks.scan import ScanContext


def review(state: State, scan: ScanContext, policy: Policy, seen: Sequence[Observation]) -> None:
    """Simplify and extend the landmarks of a scan, and remove those that are expected and not found.  [TB] 4.4."""
    fused = [(o, state.tracks.confirmed[o.landmark]) for o in seen
             if o.outcome == "associated" and o.landmark in state.tracks.confirmed]  # fmt: skip
    models = {id(track.model): track.model for _, track in fused}  # few: a test of each track takes long
    simpler = {key for key, model in models.items() if policy.linear and isinstance(model, Reparametrizable)}
    for _, track in fused if simpler else ():
        if id(track.model) not in simpler:
            continue
        point = None
        with suppress(np.linalg.LinAlgError):
            point = reparametrize.point_if_linear(scan, track, policy.linear)
        if point is not None:
            try:
                slot = state.add(point.start)
            except MapError:  # it is full: they stay what they are
                break
            old = track.slot
            state.tracks.replace(track, slot, point.model)
            state.map.remove(old)
    if scan.channel.joins:
        mine = [track for _, track in fused]
        for track, extent in zip(
            mine, wall_growth.extend_extents(scan, mine, [o.index for o, _ in fused]), strict=True
        ):
            track.extent = extent
    for o, track in fused if not scan.channel.joins else ():
        if track.extent is not None and isinstance(track.model, Segmented) and track.model.extend:
            with suppress(np.linalg.LinAlgError):
                track.extent = reparametrize.extent(scan, track, scan.y[o.index])
    if policy.attention.delete:
        _give_up(state, scan, policy, {o.landmark: o.outcome for o in seen})


def _give_up(state: State, scan: ScanContext, policy: Policy, found: dict[Id | None, str]) -> None:
    """Count the landmarks in view and those observed; remove the ones too seldom found, each with its reason."""
    names = state.tracks.observable(scan.channel)
    for model, rows in state.tracks.by_model(scan.channel, names):
        tracks = [state.tracks.confirmed[names[i]] for i in rows]
        slots, extents = [track.slot for track in tracks], [track.extent for track in tracks]
        for i in scan.channel.in_view(state.map, scan.robot, model, slots, extents).tolist():
            track = tracks[i]
            if found.get(track.id) == "ignored":
                continue
            track.searched, track.found = track.searched + 1, track.found + (track.id in found)
            reason = policy.attention.removal_reason(track.searched, track.found, track.observations)
            if reason:
                state.remove(track.id)
                scan.report.removed += ((track.id, reason),)


def maintain(state: State, scan: ScanContext, policy: Policy) -> None:
    """Map management after a scan: removal of landmarks that are gone, merging, deletion of tentative ones."""
    report, ids = scan.report, scan.event.ids
    for name in state.surveys.wrong() if state.surveys.misfits and not state.sums else ():  # else it may be the robot
        state.remove(name)
        report.removed += ((name, surveyed_corrections.ELSEWHERE),)
    look = existence.look(scan, policy.upkeep) if existence.concerns(scan, policy.upkeep) else None
    if look is not None and look.usual:
        for track in existence.absent_landmarks(
            state.tracks, policy.upkeep, existence.count_misses(state.tracks, look)
        ):
            state.remove(track.id)
            report.removed += ((track.id, f"should be in view and was not seen, {round(track.missed)} scans in a row"),)
    if scan.locates and not scan.adrift:
        elsewhere.weigh(state, scan, look)
    if ids is None or None in ids:
        merging.merge_seen(state, scan, policy)
        if policy.upkeep.repeats != "off" and of_map.is_due(state.tracks):
            merging.search_repeats(state, scan, policy)
    if state.tracks.tentative:
        tentative.drop(state, scan, policy)
    for key in state.clones.users() if state.clones.clones else ():
        state.release(key)
    state.let_grow()
