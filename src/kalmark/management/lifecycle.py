"""What becomes of a landmark once it is in the map: it is simplified, extended or given up.  [TB] 4.4."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from kalmark.errors import MapError, ModelError
from kalmark.events import Id, Scan
from kalmark.filter.estimators import Map
from kalmark.filter.map import StochasticMap
from kalmark.filter.postponed import PostponedMap
from kalmark.filter.storage import Triangle
from kalmark.geometry.spaces import RHO
from kalmark.management import existence, kept, merging, tentative
from kalmark.management.ends import extended_ends
from kalmark.models.landmarks import Point2D, Point3D
from kalmark.models.protocols import Landmark
from kalmark.report import Observation, Report
from kalmark.tracks.scene import View

if TYPE_CHECKING:
    from kalmark.slam.slam import Slam

Array = npt.NDArray[np.float64]

DENSE = 80  # landmarks up to which the dense map is faster
MAPS = ("auto", "dense", "postponed")
NUMBERS: dict[str, Any] = {"float64": np.float64, "float32": np.float32}


def new_map(type_: str, numbers: str) -> Map:
    """Return an empty map of a type; `numbers` are those in which a postponed one keeps what is at rest."""
    for what, value, known in (("map", type_, MAPS), ("numbers", numbers, NUMBERS)):
        if value not in known:
            raise ModelError(f"{what} is {value!r}, expected one of {', '.join(known)}")
    return PostponedMap(Triangle(NUMBERS[numbers])) if type_ == "postponed" else StochasticMap()


def surveyed(kind: Landmark, mean: Any) -> Landmark:
    """Return what a landmark of that mean is: a point, also where a sensor would start one of unknown depth."""
    size = np.size(mean)
    if not hasattr(kind, "prior_rho_per_m") or size == kind.space.size:
        return kind
    return Point2D() if kind.space.world == "plane" else Point3D()


def let_grow(slam: Slam) -> None:
    """Postpone corrections from so many landmarks on that it pays; but not of inverse distances, nor averages."""
    kinds = slam.members.kinds
    if any(view.averages for view in slam._views.values()):
        return
    if slam.map_type != "auto" or not isinstance(slam.map, StochasticMap) or len(kinds) <= DENSE:
        return
    if sum(RHO not in kind.space.kinds for kind in kinds.values()) > DENSE:
        slam.map = PostponedMap.from_dense(slam.map, Triangle(NUMBERS[slam.numbers]))


def review(slam: Slam, view: View, event: Scan, outcomes: Sequence[Observation]) -> tuple[tuple[Id, str], ...]:
    """Simplify and extend what a scan has told of, and return what has been given up, each with the reason."""
    simplify(slam, view, event.robot, [o.landmark for o in outcomes if o.outcome == "associated"])
    extend(slam, view, event, outcomes)
    return tuple(give_up(slam, view, event, outcomes)) if view.attention.delete else ()


def tidied(slam: Slam, view: View, event: Scan, report: Report) -> Report:
    """Tidy up after a scan: landmarks that are gone, that are one, tentative ones without hope; return its report."""
    if view.upkeep.p_detect is not None:
        report.removed += tuple(existence.gone(slam, view, event, report))
    if event.ids is None or None in event.ids:
        report.merged = tuple(merging.merge(slam, view, event.robot, report.observations))
    if slam.members.tentative:
        report = tentative.dropped(slam, view, event, report)
    if view.waiting.poses:
        kept.forget(slam)
    return report


def simplify(slam: Slam, view: View, robot: str, names: Sequence[Id | None]) -> None:
    """Make Euclidean points of those whose depth or direction has become clear: p, P_pp = P_l P_ll P_l'.  [TB] 4.4.

    Where the map has no room for another block, they stay what they are.
    """
    map_, members = slam.map, slam.members
    for name in names if slam.reparametrize is not None else ():
        kind: Any = members.kinds.get(name)  # type: ignore[arg-type]
        if name is None or not hasattr(kind, "linearity"):
            continue
        slot = members.slots[name]
        l, index = map_.mean(slot)[None], map_.index(slot)
        sigmas = np.sqrt(np.maximum(np.diag(map_.covariance([slot])), 0.0))[None]
        T = view.pose(map_, members.slots[robot])
        if l[0, -1] > 0 and kind.linearity(T, l, sigmas)[0] < slam.reparametrize:
            p, P_l = kind.to_point(l)
            point: Landmark = Point2D() if len(p[0]) == 2 else Point3D()
            try:
                place = map_.augment(point.space, p[0], index, P_l[0], np.zeros((len(p[0]),) * 2))
            except MapError:
                return
            members.place(name, place, point)
            map_.remove(slot)


def extend(slam: Slam, view: View, event: Scan, outcomes: Sequence[Observation]) -> None:
    """Let the segments seen of lines grow by what was seen of them."""
    members = slam.members
    for seen in outcomes:
        name = seen.landmark if seen.outcome == "associated" else None
        kind: Any = members.kinds.get(name)  # type: ignore[arg-type]
        if name in members.ends and kind.extend:
            T, l, P = view.pose(slam.map, members.slots[event.robot]), slam.mean(name), slam.covariance(name)
            members.ends[name] = extended_ends(view.sensor, kind, T, l, P, members.ends[name], event.y[seen.index])


def give_up(slam: Slam, view: View, event: Scan, outcomes: Sequence[Observation]) -> Iterator[tuple[Id, str]]:
    """Count what should have been seen and what was; remove the landmarks that are hopeless, each with its reason."""
    members = slam.members
    found = {o.landmark: o.outcome for o in outcomes}
    names = members.in_reach(view)
    robot = members.slots[event.robot]
    for look, rows in members.by_look(view, names):
        slots, ends = [members.slots[names[i]] for i in rows], [members.ends.get(names[i]) for i in rows]
        for i in view.in_sight(slam.map, robot, look, slots, ends).tolist():
            name = names[rows[i]]
            if found.get(name) == "ignored":
                continue
            counts = members.searched.setdefault(name, [1, 1])
            counts[0] += 1
            counts[1] += name in found
            reason = view.attention.hopeless(counts[0], counts[1], members.seen.get(name, 0))
            if reason:
                slam.remove(name)
                yield name, reason
