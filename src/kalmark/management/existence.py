"""Does a landmark still exist?  Log-odds of being seen where it should be, and of not being seen.

Each scan in which a landmark should be in view adds log p_detect / p_false if it was seen, and
log (1 - p_detect) / (1 - p_false) if not.  A landmark is removed when these odds have fallen to 1 in `odds`; they never
rise above that, so that what has been there for long can go as well.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from kalmark.events import Id, Scan
from kalmark.report import Report

if TYPE_CHECKING:
    from kalmark.slam.slam import Slam
    from kalmark.tracks.scene import Look, View

Array = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

AROUND = 64  # landmarks nearest to the sensor that may be in view
MARGIN = 0.1  # of ranges and of the field of view, within which a landmark may be out of view after all
SHADOW_M = 0.3  # half the width of what hides things behind it


def gone(slam: Slam, view: View, event: Scan, report: Report) -> Iterator[tuple[Id, str]]:
    """Remove the landmarks that should have been seen and were not, again and again; each with its reason."""
    upkeep, members = view.upkeep, slam.members
    if upkeep.p_detect is None or not hasattr(view.sensor, "sees"):
        return
    hit = math.log(upkeep.p_detect / upkeep.p_false)
    miss = math.log((1 - upkeep.p_detect) / (1 - upkeep.p_false))
    most = math.log(upkeep.odds)
    seen = {o.landmark for o in report.observations if o.landmark is not None}
    unclear = {c.landmark for c in report.candidates if c.d2 <= view.gate} - seen
    for name in _expected(slam, view, event, report):
        if name in unclear:
            continue
        before, missed = members.existence.get(name, (most, 0))
        told = min(before + (hit if name in seen else miss), most)
        members.existence[name] = told, 0 if name in seen else missed + 1
        if told < -most:
            slam.remove(name)
            yield name, f"should be in view and was not seen, {missed + 1} scans in a row"


def _expected(slam: Slam, view: View, event: Scan, report: Report) -> list[Id]:
    """Return the landmarks near the sensor that it should surely see."""
    members, robot, found = slam.members, slam.members.slots[event.robot], list[Id]()
    for look, names in _around(slam, view, robot):
        T, l = view.pose(slam.map, robot), slam.map.means(members.slots_of(names), look.d)
        v = look.landmark.seen_from(T, l)[0]
        sure = _surely(view.sensor, v) & ~_hidden(view, event, v)
        found += [name for name, yes in zip(names, sure.tolist(), strict=True) if yes]
    return found


def _around(slam: Slam, view: View, robot: int) -> list[tuple[Look, list[Id]]]:
    """Return the landmarks nearest to the sensor, those of one kind together, that are points."""
    members = slam.members
    kinds = frozenset(k for k, look in view.looks.items() if not hasattr(look.landmark, "endpoints"))
    d = 2 if len(view.at) == 3 else 3
    if view.tells_places:
        at = view.pose(slam.map, robot)[None, :d]
        found = slam.nearby.pairs(slam, kinds, (robot, view.mount), at, AROUND, math.inf).slots
        names = [members.names[slot] for slot in found.tolist()]
    else:
        names = [name for name in members.in_reach(view) if members.kinds[name].kind in kinds]
    return [(look, [names[i] for i in rows]) for look, rows in members.by_look(view, names)]


def _surely(sensor: Any, v: Array) -> Flags:
    """Return which views are well inside what a sensor sees."""
    sure: Flags = sensor.sees(v)
    if v.shape[1] in (2, 3) and hasattr(sensor, "range_max_m"):
        d = min(v.shape[1], 3) if not hasattr(sensor, "fov_rad") else 2
        for scale in (1 - MARGIN, 1 + MARGIN):
            sure &= sensor.sees(np.hstack([scale * v[:, :d], v[:, d:]]))
    fov = getattr(sensor, "fov_rad", 2 * math.pi)
    for turn in (-MARGIN * fov / 2, MARGIN * fov / 2) if fov < 2 * math.pi else ():
        c, s = math.cos(turn), math.sin(turn)
        sure &= sensor.sees(np.hstack([v[:, :2] @ np.array([[c, s], [-s, c]]), v[:, 2:]]))
    return sure


def _hidden(view: View, event: Scan, v: Array) -> Flags:
    """Return which views of the plane lie behind something that was seen nearer."""
    if len(view.at) != 3 or not len(event.y) or not view.tells_places:
        return np.zeros(len(v), dtype=np.bool_)
    sensor: Any = view.sensor
    p: Array = sensor.invert(event.y)[0][:, :2]
    near, far = np.linalg.norm(p, axis=1), np.linalg.norm(v[:, :2], axis=1)
    apart = np.abs(np.angle(np.exp(1j * (np.arctan2(v[:, 1], v[:, 0])[:, None] - np.arctan2(p[:, 1], p[:, 0])))))
    behind = far[:, None] > near + 2 * SHADOW_M
    hidden: Flags = (behind & (apart < np.arctan(SHADOW_M / np.maximum(near, SHADOW_M)))).any(axis=1)
    return hidden
