"""Made once at construction: the channel of each mounted sensor, and the policy for its scans."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from kalmark.association.gated import ByIdentity
from kalmark.association.protocol import DEFERRED, NEW, REMAP, Answer, Association, averages, weighs
from kalmark.errors import ModelError
from kalmark.events import Scan
from kalmark.filter.estimators import Estimator
from kalmark.geometry.gaussian import gate
from kalmark.management.ambiguous_tags import Mirrored
from kalmark.management.attention import EVERYTHING, Attention
from kalmark.management.delayed import Delayed
from kalmark.management.hypotheses import Hypotheses
from kalmark.management.pending import Initialization
from kalmark.management.trilateration import Trilateration
from kalmark.management.upkeep import Upkeep
from kalmark.models.landmarks import AsPoint
from kalmark.models.protocols import (
    Ambiguous,
    Intersecting,
    Landmark,
    OfState,
    Ranging,
    Reparametrizable,
    Segmented,
    distances_alone,
    world_of,
)
from kalmark.slam.robot import Mount, Robot
from kalmark.tracks.channel import Channel, default_landmark
from kalmark.tracks.survey_checks import SURVEYED

WIDER = 3.0  # times its sigmas by which an overconfident filter may be off


@dataclass(frozen=True, eq=False)
class Policy:
    """Settings for the scans of a channel.

    `deferred` starts landmarks with ids from several measurements, `delayed` any landmark from cloned poses (None: at
    first sight).  `starts` are the answers to an observation without an id that start one.  `averages`: the association
    may answer with mixtures; `holds_back`: its pairs are tested against chance; `reviews`: landmarks may change after a
    scan, points of unknown depth become Euclidean where their linearity index falls below `linear`; the last
    `keep_poses` clones are kept for tentative landmarks.  `restarts`: rays may have to be started again
    (`ray_restarts.py`).  `contests`: where a landmark with an id was begun is weighed against observations that do not
    fit (`tentative.py`), which are left out or count less.  `limit`: the d2 up to which an observation with an id is no
    misfit, infinite where the gate is switched off or the sensor never determines where its robot is.  `by_ids`:
    nothing is to be decided of a scan whose ids are of landmarks of one type in the map.
    """

    association: Association
    upkeep: Upkeep
    attention: Attention
    detector: Callable[[Scan], Scan] | None
    deferred: Initialization | None
    delayed: Delayed | None
    starts: tuple[Answer, ...]
    averages: bool
    holds_back: bool
    reviews: bool
    linear: float
    keep_poses: int
    restarts: bool
    contests: bool
    limit: float
    by_ids: bool


def policy_of(
    mount: Mount, channel: Channel, association: Association, upkeep: Upkeep, linear: float | None
) -> Policy:  # fmt: skip
    """Return the policy for the scans of a mount.

    Raises ModelError if its initialisation does not fit its sensor.
    """
    delayed = mount.initialization if isinstance(mount.initialization, Delayed) else None
    if delayed is not None and not (isinstance(mount.sensor, Intersecting) and channel.landmark.kind == "point"):
        what = f"a {type(mount.sensor).__name__} does not start a {channel.landmark.kind} late"
        raise ModelError(f"{what}: expected one that has meet(), and points of the plane")
    deferred = _deferred(mount, channel.landmark)
    if channel.lags and (delayed is not None or (deferred is not None and not channel.is_ambiguous)):
        what = f"a {type(mount.sensor).__name__} whose lag is in the map starts landmarks at first sight"
        raise ModelError(f"{what}: expected one that can, or no lag")
    seen = [model.landmark for model in channel.models.values()]
    kinds = [kind.ray if isinstance(kind, AsPoint) else kind for kind in seen]
    reviews = mount.attention.delete or any(isinstance(kind, Reparametrizable | Segmented) for kind in kinds)
    looks_back = channel.sees_velocity or channel.lags
    return Policy(
        association, upkeep, mount.attention, mount.detector, deferred, delayed,
        _starts(association, upkeep), averages(association), upkeep.hold_back and not weighs(association), reviews,
        0.0 if channel.joins else linear or 0.0,
        upkeep.keep_poses if delayed is None and not (channel.sees_velocity or channel.lags) else 0,
        not channel.finds_depth and any(isinstance(kind, Reparametrizable) for kind in seen),
        (channel.robust is not None or association.threshold(channel.dof, 0.0) < math.inf)
        and delayed is None and (deferred is None or channel.is_ambiguous) and channel.starts_landmarks,
        WIDER**2 * gate(SURVEYED, channel.dof)
        if channel.locates_by_ids and association.threshold(1, 0.0) < math.inf else math.inf,
        type(association) is ByIdentity and mount.attention == EVERYTHING and upkeep.p_detect is None
        and not (reviews or channel.robust is not None or looks_back or channel.approaches),
    )  # fmt: skip


def _deferred(mount: Mount, landmark: Landmark) -> Initialization | None:
    """Return how a mounted sensor starts landmarks from several measurements, None if one is enough for it."""
    sensor, way = mount.sensor, mount.initialization
    if way is None:
        if distances_alone(sensor) and isinstance(sensor, Ranging):
            return Trilateration() if landmark.kind == "point" else None
        return Mirrored() if isinstance(sensor, Ambiguous) else None
    if isinstance(way, Delayed):
        return None
    if not distances_alone(sensor) or (isinstance(way, Hypotheses) and not isinstance(sensor, Ranging)):
        what = f"{type(sensor).__name__} does not measure ranges alone"
        raise ModelError(f"Mount: initialization is {way!r}, but its {what}")
    if landmark.kind != "point":
        raise ModelError(f"Mount: initialization is {way!r}, but its landmarks are {landmark.kind}, expected point")
    return way


def _starts(association: Association, upkeep: Upkeep) -> tuple[Answer, ...]:
    """Return the answers to an observation without an id that start a landmark.

    An association that weighs matchings defers what may be one of several landmarks: that is none to be mapped again.
    """
    if not upkeep.hold_back:
        return (NEW,)
    return (NEW, REMAP) if weighs(association) else (NEW, REMAP, DEFERRED)


def landmark_of(mount: Mount, landmarks: Landmark | None) -> Landmark:
    """Return the type of landmark that a mounted sensor starts; `landmarks` is that of the Slam, if it has one."""
    late = mount.initialization is not None
    return mount.landmark or landmarks or default_landmark(mount.sensor, mount.at, mount.cov is not None, late)


def kinds_of(robots: Mapping[str, Robot], landmarks: Landmark | None) -> list[Landmark]:
    """Return the types of landmarks that the sensors of all robots start, one of each kind."""
    mounts = (m for robot in robots.values() for m in robot.sensors.values() if not isinstance(m.sensor, OfState))
    return list({kind.kind: kind for kind in (landmark_of(m, landmarks) for m in mounts)}.values())


def channel_of(
    robots: Mapping[str, Robot], robot: Robot, mount: Mount, slot: int, landmark: Landmark, others: list[Landmark],
    association: Association, estimator: Estimator,
) -> Channel:  # fmt: skip
    """Return the channel of a robot's mount whose block is on a slot (-1: none), of the landmarks that all start.

    Raises ModelError if sensor or landmark are of another world than the robots, or do not fit each other.
    """
    refuse_other_world(robots, type(mount.sensor).__name__, world_of(mount.sensor))
    refuse_other_world(robots, landmark.kind, landmark.space.world)

    def threshold(dof: int) -> float:
        return association.threshold(dof, estimator.default_gate)

    return Channel(mount.sensor, mount.at, slot, landmark, threshold, others, robot.motion, mount.robust, mount.lags,
        mount.classes,
    )  # fmt: skip


def refuse_other_world(robots: Mapping[str, Robot], what: str, world: str) -> None:
    """Refuse models of the plane among robots that move in space, and models of space among those of the plane."""
    here = next(iter(robots.values())).motion.space.world
    if world and world != here:
        raise ModelError(f"{what} is of the {world}, expected one of the {here}, where the first robot moves")
