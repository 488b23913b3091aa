"""Does a landmark still exist?  Its log odds, from scans in which it should be in view.

Each such scan adds log p_detect / p_false if it was observed, and log (1 - p_detect) / (1 - p_false) if not.  A
landmark is removed when its odds have fallen to 1 in `odds`; they never rise above that, so that a landmark that has
stood for long can be removed as well.  Thrun et al. 10; Montemerlo and Thrun.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from kalmark.arrays import Array, Flags
from kalmark.events import Id
from kalmark.management.upkeep import Upkeep
from kalmark.models.protocols import Segmented, Visible, field_of_view
from kalmark.tracks.channel import ObservationModel
from kalmark.tracks.scan import ScanContext

AROUND = 64  # landmarks nearest to the sensor that may be in view
MARGIN = 0.1  # of ranges and of the field of view, within which a landmark may be out of view after all
OCCLUDER_M = 0.3  # half the width of an object that hides others


class Judgement(NamedTuple):
    """The log odds of a landmark after a scan, and the scans in a row in which it was missed."""

    name: Id
    log_odds: float
    missed: int
    gone: bool


def judged(scan: ScanContext, upkeep: Upkeep) -> list[Judgement]:
    """Return the log odds of the landmarks that should be in view, of those whose odds this scan decides."""
    if upkeep.p_detect is None or not isinstance(scan.channel.sensor, Visible):
        return []
    hit = math.log(upkeep.p_detect / upkeep.p_false)
    miss = math.log((1 - upkeep.p_detect) / (1 - upkeep.p_false))
    most = math.log(upkeep.odds)
    seen = {o.landmark for o in scan.report.observations if o.landmark is not None}
    unclear = {c.landmark for c in scan.report.candidates if c.d2 <= scan.channel.gate} - seen
    found = []
    for name in _expected(scan):
        if name not in unclear:
            track = scan.tracks.confirmed[name]
            before = most if track.log_odds is None else track.log_odds
            odds = min(before + (hit if name in seen else miss), most)
            found.append(Judgement(name, odds, 0 if name in seen else track.missed + 1, odds < -most))
    return found


def _expected(scan: ScanContext) -> list[Id]:
    """Return the landmarks near the sensor that it should surely observe."""
    found, channel = list[Id](), scan.channel
    for model, names in _around(scan):
        l = scan.map.means(scan.tracks.slots_of(names), model.d)
        v = model.landmark.seen_from(scan.pose(), l)[0]
        sure = _surely(channel.sensor, v) & ~_hidden(scan, v)
        found += [name for name, yes in zip(names, sure.tolist(), strict=True) if yes]
    return found


def _around(scan: ScanContext) -> list[tuple[ObservationModel, list[Id]]]:
    """Return the landmarks nearest to the sensor, those of one kind together, that are points."""
    tracks, channel = scan.tracks, scan.channel
    kinds = frozenset(k for k, model in channel.models.items() if not isinstance(model.landmark, Segmented))
    if channel.gives_places:
        at = scan.pose()[None, : scan.dimensions]
        sorts = tracks.sorts_of(kinds, len(scan.map.blocks))
        found = scan.map.pairs(sorts, scan.robot, channel.mount, at, AROUND, math.inf).slots
        names = [tracks.names[slot] for slot in found.tolist()]
    else:
        names = [name for name in tracks.observable(channel) if tracks.confirmed[name].model.kind in kinds]
    return [(model, [names[i] for i in rows]) for model, rows in tracks.by_model(channel, names)] if names else []


def _surely(sensor: Any, v: Array) -> Flags:
    """Return which landmarks v (K, d) in the sensor frame are well inside what a sensor observes."""
    sure: Flags = sensor.sees(v)
    fov = field_of_view(sensor)
    if v.shape[1] in (2, 3):
        d = 2 if v.shape[1] == 2 or fov < 2 * math.pi else 3
        for scale in (1 - MARGIN, 1 + MARGIN):
            sure &= sensor.sees(np.hstack([scale * v[:, :d], v[:, d:]]))
    for turn in (-MARGIN * fov / 2, MARGIN * fov / 2) if fov < 2 * math.pi else ():
        c, s = math.cos(turn), math.sin(turn)
        sure &= sensor.sees(np.hstack([v[:, :2] @ np.array([[c, s], [-s, c]]), v[:, 2:]]))
    return sure


def _hidden(scan: ScanContext, v: Array) -> Flags:
    """Return which landmarks v (K, d) of the plane lie behind something that was observed nearer."""
    if scan.dimensions == 3 or not len(scan.y) or not scan.channel.gives_places:
        return np.zeros(len(v), dtype=np.bool_)
    p: Array = scan.channel.sensor.invert(scan.y)[0][:, :2]
    near, far = np.linalg.norm(p, axis=1), np.linalg.norm(v[:, :2], axis=1)
    apart = np.abs(np.angle(np.exp(1j * (np.arctan2(v[:, 1], v[:, 0])[:, None] - np.arctan2(p[:, 1], p[:, 0])))))
    behind = far[:, None] > near + 2 * OCCLUDER_M
    hidden: Flags = (behind & (apart < np.arctan(OCCLUDER_M / np.maximum(near, OCCLUDER_M)))).any(axis=1)
    return hidden
