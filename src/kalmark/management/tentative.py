"""Tentative landmarks: what was seen too seldom to be believed.

Each is a block of the map, started as any landmark is, so that its covariance with the pose is right however long it
takes; but no observation of it corrects anything until it is confirmed.  The observation that confirms it is the first
one fused.  No association looks at them: an observation is compared with them when it belongs to no landmark.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from scipy.optimize import linear_sum_assignment

from kalmark.association.gated import FORBIDDEN
from kalmark.association.posterior import JUST_SEEN, room
from kalmark.association.protocol import ANEW, Decision
from kalmark.events import Id, Scan
from kalmark.geometry.gaussian import gate as chi2_gate
from kalmark.management import kept
from kalmark.models.protocols import Landmark
from kalmark.report import Late, Observation, Report

if TYPE_CHECKING:
    from kalmark.slam.slam import Slam
    from kalmark.tracks.scene import View

Array = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

NEAREST = 4  # tentative landmarks an observation is compared with
OUT_OF_VIEW = 20  # times `within` scans without a sighting, in view or not: dropped


@dataclass
class Tentative:
    """A block that may become a landmark: in how many scans it was in view, in how many of those seen.

    `unseen` counts the scans since it was last seen, in view or not.
    """

    slot: int
    kind: Landmark
    hits: int = 1
    chances: int = 1
    unseen: int = 0
    kept: list[kept.Kept] = field(default_factory=list)
    first: Late | None = None  # the observation that has started it, if its sightings are kept


Sightings = tuple[dict[int, Observation], dict[int, Decision]]


def sightings(
    slam: Slam, view: View, event: Scan, report: Report, new: Sequence[int], decisions: Sequence[Decision], R: Array
) -> Sightings:
    """Compare the observations that belong to no landmark with the tentative ones.

    Return those that are still tentative or left alone, and the decisions about those that confirm a landmark, which is
    one from here on.
    """
    _give_way(slam, event)
    rows = [k for k in new if decisions[k][0] in view.starts]
    names = [name for name, t in slam.members.tentative.items() if t.kind.kind in view.looks]
    seen: dict[int, Observation] = {}
    confirmed: dict[int, Decision] = {}
    waiting: dict[int, Id] = {}
    if not rows or not names:
        return seen, confirmed
    lost = np.array([decisions[k][0] is ANEW for k in rows])
    d2 = _distances(slam, view, event, rows, names, R, lost)
    gate, far = _gates(view)
    cost = np.full((len(rows), len(names) + len(rows)), gate)
    cost[:, : len(names)] = np.where(d2 <= gate, d2, FORBIDDEN * gate)
    for i, (k, column) in enumerate(zip(rows, linear_sum_assignment(cost)[1].tolist(), strict=True)):
        least = int(np.argmin(d2[i]))
        if column < len(names):
            name = names[column]
            told = _sighted(slam, view, report, name)
            if told:
                confirmed[k] = (name, told)
            else:
                t, u = slam.members.tentative[name], view.upkeep
                why = f"seen in {t.hits} of {t.chances} scans, {u.confirm} of {u.within} make a landmark"
                seen[k] = Observation(k, None, "tentative", name, float(d2[i, column]), why)
                waiting[k] = name
        elif d2[i, least] <= gate:
            why = f"its nearest tentative landmark {names[least]!r} is another observation's"
            seen[k] = Observation(k, None, "ignored", None, float(d2[i, least]), why)
        elif d2[i, least] <= far:
            why = f"between {names[least]!r}, which is tentative, and a new one: d2 {d2[i, least]:.1f}"
            seen[k] = Observation(k, None, "ignored", None, float(d2[i, least]), why)
    kept.keep(slam, view, event, waiting, R)
    return seen, confirmed


def _give_way(slam: Slam, event: Scan) -> None:
    """Give other names to tentative landmarks that are called what the log, or a survey, calls another one."""
    members, ids = slam.members, event.ids or ()
    for name in [name for name in members.tentative if name in members.slots or name in ids]:
        members.tentative[members.new_name()] = members.tentative.pop(name)


def _sighted(slam: Slam, view: View, report: Report, name: Id) -> str:
    """Count a sighting; make a landmark of a tentative one that was seen often enough and say why."""
    members = slam.members
    t = members.tentative[name]
    t.hits, t.chances, t.unseen = t.hits + 1, t.chances + 1, -1
    if not view.upkeep.confirms(t.hits):
        return ""
    del members.tentative[name]
    members.start(name, t.slot, t.kind)
    report.late += (*(() if t.first is None else (t.first,)), *kept.fuse(slam, view, report.robot, t, name))
    return f"confirmed: seen in {t.hits} of {t.chances} scans"


def started(slam: Slam, view: View, event: Scan, k: int, name: Id, slot: int, reason: str, held: bool) -> Observation:
    """Enter the block that observation k has started as a tentative landmark; one that was `held` back is deferred."""
    t = slam.members.tentative[name] = Tentative(slot, view.landmark, unseen=-1)
    if view.upkeep.keep_poses:
        t.first = event.t_ns, event.robot, event.sensor, k
    if held:
        return Observation(k, None, "deferred", name, None, reason)
    return Observation(k, None, "tentative", name, None, f"first sighting: {reason}" if reason else "first sighting")


def dropped(slam: Slam, view: View, event: Scan, report: Report) -> Report:
    """Count the tentative landmarks in view that this scan did not show; remove those without hope, with the reason."""
    members, gone = slam.members, []
    mine = [name for name, t in members.tentative.items() if t.kind.kind in view.looks]
    for name in mine:
        members.tentative[name].unseen += 1
    missed = [name for name in mine if members.tentative[name].unseen]
    for name in _in_sight(slam, view, event, missed):
        members.tentative[name].chances += 1
    for name in missed:
        t, u = members.tentative[name], view.upkeep
        if u.hopeless(t.hits, t.chances) or t.unseen > OUT_OF_VIEW * u.within:
            gone.append((name, f"tentative: seen in {t.hits} of {t.chances} scans"))
            slam.map.remove(t.slot)
            del members.tentative[name]
    report.removed += tuple(gone)
    return report


def _in_sight(slam: Slam, view: View, event: Scan, names: Sequence[Id]) -> list[Id]:
    """Return which of the tentative landmarks the sensor should see; all if it does not say."""
    if not hasattr(view.sensor, "sees"):
        return list(names)
    robot, found = slam.members.slots[event.robot], []
    tentative = slam.members.tentative
    for kind in dict.fromkeys(tentative[name].kind.kind for name in names):
        mine = [name for name in names if tentative[name].kind.kind == kind]
        slots, ends = [tentative[name].slot for name in mine], [slam.members.ends.get(name) for name in mine]
        found += [mine[i] for i in view.in_sight(slam.map, robot, view.looks[kind], slots, ends).tolist()]
    return found


def _gates(view: View) -> tuple[float, float]:
    """Return the d2 up to which an observation is of a tentative landmark, and that from which on it is of another."""
    new_gate = getattr(view.association, "new_gate", 0.99999)
    gate = view.gate if np.isfinite(view.gate) else chi2_gate(0.99, view.dof)
    return gate, max(gate, chi2_gate(new_gate, view.dof))


def _distances(
    slam: Slam, view: View, event: Scan, rows: Sequence[int], names: Sequence[Id], R: Array, lost: Flags
) -> Array:  # fmt: skip
    """Return d2 (K, L) of observations from tentative landmarks, inf where they are not among the nearest.

    Those of a robot that is `lost` are of none whose place it does not know.
    """
    map_, robot = slam.map, slam.members.slots[event.robot]
    tentative = [slam.members.tentative[name] for name in names]
    near = np.ones((len(rows), len(names)), dtype=np.bool_)
    if len(names) > NEAREST and (places := view.places(map_, robot, event.y[list(rows)])) is not None:
        here = map_.means(np.array([t.slot for t in tentative]), places.shape[1])
        gaps = np.linalg.norm(places[:, None] - here, axis=2)
        near = gaps <= np.partition(gaps, NEAREST - 1, axis=1)[:, NEAREST - 1 : NEAREST]
    d2 = np.full(near.shape, np.inf)
    for kind in dict.fromkeys(t.kind.kind for t in tentative):
        i, j = np.nonzero(near & np.array([t.kind.kind == kind for t in tentative]))
        if len(i):
            k, slots, look = np.asarray(rows)[i], np.array([tentative[n].slot for n in j.tolist()]), view.looks[kind]
            noise = view.noise(map_, robot, look, slots, R[k], event)
            Z, d2[i, j] = view.predict(map_, robot, look, slots, event.y[k], noise)
            d2[i, j] = np.where(lost[i] & (room(Z, noise) > JUST_SEEN), np.inf, d2[i, j])
    d2[np.isnan(d2)] = np.inf
    return d2
