"""Landmarks that are one, and parts of the map that are one: constrained to be equal, and one of each removed."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from typing import Any

import numpy as np

from kalmark.errors import MapError
from kalmark.events import Id
from kalmark.filter.estimators import Correction
from kalmark.management import merge, wall_growth
from kalmark.management import repeated_places as of_map
from kalmark.models.protocols import Joining
from kalmark.report import Repeat
from kalmark.slam.factors import update_by_blocks
from kalmark.slam.policy import Policy
from kalmark.slam.state import State
from kalmark.tracks.channel import Channel
from kalmark.tracks.scan import ScanContext, Start


def merge_seen(state: State, scan: ScanContext, policy: Policy) -> None:
    """Merge landmarks that are one; report each that is gone, the one it is now, and why."""
    confirmed, taken = state.tracks.confirmed, ("associated", "new")
    seen = [o for o in scan.report.observations if o.outcome in taken and o.landmark in confirmed]
    names: list[Any] = [o.landmark for o in seen]
    state.tracks.note_scan(names)
    if not policy.upkeep.merge:
        return
    search = merge.MergeSearch(state.tracks, [name for name, o in zip(names, seen, strict=True) if o.id is None])
    while (name := search.next()) is not None:
        track = state.tracks.confirmed[name]
        if search.is_first_pass:
            track.compared = track.observations, state.tracks.changes
        found = None
        with suppress(np.linalg.LinAlgError):
            found = merge.proposal(state.map, state.tracks, name, scan.robot, scan.pose(), policy.upkeep.odds)
        for gone, kept, why in _merge_pairs(state, scan, found) if found else ():
            search.was_merged(kept)
            scan.report.merged += ((gone, kept, why),)
    if scan.channel.joins:
        _join(state, scan, names, policy.upkeep.odds)


def _join(state: State, scan: ScanContext, names: Sequence[Id], odds: float) -> None:
    """Merge walls of which segments join, of those observed and others."""
    while (found := wall_growth.find_coincident_wall(state.map, state.tracks, scan.channel, names, odds)) is not None:
        merged = _merge_pairs(state, scan, found)
        scan.report.merged += tuple(merged)
        if not merged:  # the map is full
            break


def _merge_pairs(state: State, scan: ScanContext, found: merge.Merge) -> list[tuple[Id, Id, str]]:
    """Constrain pairs of landmarks to be equal, through the estimator, and remove one of each.

    In a full map nothing is merged, nor where their difference has no covariance.
    """
    try:
        done, merged = make_equal(state, scan.channel, scan.robot, found.pairs), list[tuple[Id, Id, str]]()
    except MapError:
        return []
    others = f", with {len(found.pairs) - 1} others" if len(found.pairs) > 1 else ""
    ordered = merge.order_pairs(state.tracks, found.pairs)
    for (kept, gone), d2, fused in zip(ordered, done.d2.tolist(), done.fused.tolist(), strict=True):
        if not fused:
            continue
        one, other = state.tracks.confirmed[kept], state.tracks.confirmed[gone]
        if isinstance(one.model, Joining):
            one.extent = wall_growth.united_extent(state.map, one, other)
        state.tracks.merge(one, other)
        state.remove(gone)
        why = f"merged into {kept!r}: d2 {d2:.1f}, e^{found.ratio:.0f} times likelier than chance{others}"
        merged.append((gone, kept, why))
    return merged


def make_equal(state: State, channel: Channel, robot: int, pairs: Sequence[tuple[Id, Id]]) -> Correction:
    """Observe that the difference of each pair of landmarks is zero, by a sensor of the robot on a slot.

    Raises MapError where the map is full.
    """
    starts = [_difference(state, pair) for pair in pairs]
    n, count = starts[0].space.size, len(starts)
    R = np.tile(merge.EQUAL_M**2 * np.eye(n), (count, 1, 1))
    return state.corrected_by(starts, update_by_blocks(robot, channel.mount, channel.at, np.zeros((count, n)), R))


def _difference(state: State, pair: tuple[Id, Id]) -> Start:
    """Return the difference of two landmarks as a block, to be observed as zero."""
    of_walls = isinstance(state.tracks.confirmed[pair[0]].model, Joining)
    return (wall_growth if of_walls else merge).difference(state.map, state.tracks, pair)


def search_repeats(state: State, scan: ScanContext, policy: Policy) -> None:
    """Search the map for parts that are one; merge those that are accepted, if the policy merges; report the others.

    One is merged at a time: it changes the map.
    """
    since, state.tracks.searched = state.tracks.searched, state.tracks.changes
    found: list[Repeat] = []
    with suppress(np.linalg.LinAlgError):
        found = of_map.find_repeats(state.map, state.tracks, since)
    for repeat in found:
        if policy.upkeep.repeats == "merge" and repeat.sure and repeat.agrees:
            merged = _merge_pairs(state, scan, merge.Merge(repeat.pairs, repeat.score))
            scan.report.merged += tuple((gone, kept, f"{why}, {of_map.IN_A_REPEAT}") for gone, kept, why in merged)
            found = [other for other in found if other is not repeat]
            break
    scan.report.repeats = tuple(found)
