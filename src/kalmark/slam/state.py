"""The state of a Slam: its parts and their changes by events; blocks and clones that enter the map and leave it."""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np

from kalmark.arrays import Array, Index
from kalmark.association import Association
from kalmark.association.global_start import SURE
from kalmark.declare import Role, Within, check_parameters
from kalmark.errors import DivergedError, MapError, ModelError
from kalmark.events import Event, Id, label_of_event
from kalmark.filter.estimators import Correction, Estimator, Initializing, Selective, Update
from kalmark.filter.map import Map, StochasticMap
from kalmark.filter.maps import MOST, CostBalance, compress_map, new_map
from kalmark.geometry.pose_frames import ORIGIN
from kalmark.management.upkeep import CAREFUL, Upkeep
from kalmark.models.protocols import Landmark, OfState, measures_blocks, world_of
from kalmark.models.sensors import Gps2D, Gps3D
from kalmark.slam.checks import check_covariance, fault_of, instance, refuse_odd_association, require_methods
from kalmark.slam.evidence import NEVER_NS, RECENT, Evidence
from kalmark.slam.gaussian_sum import GaussianSum
from kalmark.slam.held_control import HeldInput, Moving, bias_block, bias_name
from kalmark.slam.held_readings import SELDOM, LastMeasurement
from kalmark.slam.past_motion import PastMotion
from kalmark.slam.policy import Policy, channel_of, kinds_of, landmark_of, policy_of, refuse_other_world
from kalmark.slam.pose_hypothesis import PoseHypothesis
from kalmark.slam.reader import LEAST_S, StateReader
from kalmark.slam.rests import rest_detector
from kalmark.slam.robot import Robot, mount_name
from kalmark.slam.sources import FilterView, SearchingDetector, Source
from kalmark.tracks.channel import Channel, Parts
from kalmark.tracks.clones import Clones
from kalmark.tracks.scan import Start
from kalmark.tracks.survey_checks import Surveys
from kalmark.tracks.track import ChannelKey, Tracks

ANTENNAS: dict[int, Any] = {2: Gps2D(), 3: Gps3D()}  # a fix is a reading of one
CURE = "start again from a pose that is less certain, or with larger sigmas of controls and sensors"


@dataclass(frozen=True, eq=False)
class Settings:
    """Arguments of a `Slam` beside its robots.  Raises ModelError for one that is not as declared."""

    association: Annotated[Association, Role("association"), "Data association: the landmark of each observation."]
    estimator: Annotated[Estimator, Role("estimator"), "Filter."]
    landmarks: Annotated[Landmark | None, Role("landmark"), "Landmark type; what fits each sensor if absent."] = None
    map: Annotated[
        Literal["auto", "dense", "postponed"],
        "`dense` corrects the whole covariance at once, `postponed` only what is in view, `auto` is dense while small.",
    ] = "auto"
    reparametrize: Annotated[
        float | None,
        Within(ge=0),
        "Inverse-depth and anchored points become Euclidean below this linearity index; or off.",
    ] = 0.03  # of [TB]; Civera, Davison and Montiel 2008
    numbers: Annotated[
        Literal["float64", "float32"],
        "In what a postponed map keeps what is at rest; `float32` takes half the memory.",
    ] = "float64"
    upkeep: Annotated[
        Upkeep, Role("upkeep"), "Confirmation of landmarks from observations without an id."
    ] = CAREFUL  # fmt: skip
    longest_pause_s: Annotated[
        float,
        Within(gt=0),
        "An event that comes later after the one before it has a wrong stamp and is refused; 10 such in a row are not.",
    ] = 12 * 3600.0

    def __post_init__(self) -> None:
        refuse_odd_association(self.association, "association")
        like = "an object like km.estimators.Ekf(), with predict, correct, for_fixes and pose_jacobian"
        require_methods(self.estimator, ("predict", "correct", "for_fixes", "pose_jacobian"), "estimator", like)
        if self.landmarks is not None:
            instance(self.landmarks, Landmark, "landmarks", "a landmark model")
        instance(self.upkeep, Upkeep, "upkeep", "an Upkeep")
        check_parameters(self, "")


class State:
    """The map, the tracks and the clones of some robots, with the channels and readers of their sensors.

    `inner` are the names of blocks that are neither robot nor landmark; `may_grow`: a dense map may be compressed;
    `standing` are, of robots with detection of rest, the names of the sensors that do; `antennas` are the readers of
    fixes; `pose_hypotheses` are, of robots whose readings do not fit, the other explanations of these; `sums` are, of
    robots that may be in several places, their poses; `evidence` is that robots are elsewhere; `taken` are the events
    of this very time: the kind, the robot and the sensor of each; `given` is what each sensor gave last; `balance`
    decides whether a dense map is compressed.
    Raises ModelError if robots, sensors and landmarks do not fit together.
    """

    t_ns: int | None
    taken: set[tuple[str, str, str]]
    map: Map
    balance: CostBalance
    tracks: Tracks
    clones: Clones
    surveys: Surveys
    given: dict[ChannelKey, LastMeasurement]
    placed: int  # fixes that have determined where the map is in the world; a survey counts as many
    moving: dict[str, Moving]
    pose_hypotheses: dict[str, PoseHypothesis]
    sums: dict[str, GaussianSum]
    evidence: dict[str, Evidence]
    sources: dict[ChannelKey, Source]
    readers: dict[ChannelKey, StateReader]

    def __init__(self, robots: dict[str, Robot], settings: Settings) -> None:
        self.settings, self.robots, self.t_ns, self.taken, self.placed = settings, robots, None, set(), 0
        self.estimator: Estimator = settings.estimator
        self.map, self.balance, self.tracks = new_map(settings.map, settings.numbers), CostBalance(), Tracks(robots)
        self.clones, self.surveys, self.given, self.pose_hypotheses, self.sums = Clones(), Surveys(), {}, {}, {}
        self.evidence = {}
        self.moving, self.sources, self.readers = {}, {}, {}
        self.of_blocks: dict[ChannelKey, Any] = {}
        self.antennas: dict[str, StateReader] = {}
        self.channels: dict[ChannelKey, Channel] = {}
        self.policies: dict[ChannelKey, Policy] = {}
        self.standing: dict[str, str] = {}
        self.inner = {bias_name(name) for name in robots}
        self.inner |= {mount_name(name, key) for name, robot in robots.items() for key in robot.sensors}
        kinds = kinds_of(robots, settings.landmarks)
        for robot in robots.values():
            self._place(robot, kinds)
        self.blocks = len(self.tracks.slots)  # the first of the map: they stay
        first = [source for source in self.sources.values() if not source.waits]
        if len(robots) > 1 or len(first) > 1 or len(self.sources) < len(next(iter(robots.values())).sensors):
            self.settle()
        if isinstance(self.estimator, Selective):
            self.estimator.refuse_misfits(robots, self.channels, self.policies)
        self.may_grow = settings.map == "auto" and not any(policy.averages for policy in self.policies.values())

    @property
    def begins(self) -> bool:
        """True if a source still keeps its first scans, which alone are to move the map."""
        return any(source.begins for source in self.sources.values())

    def _place(self, robot: Robot, kinds: list[Landmark]) -> None:
        """Enter a robot, the bias of its controls and its mounts into the map.  Raises ModelError."""
        settings = self.settings
        if robot.name in self.inner:
            raise ModelError(f"robot {robot.name!r} has the name of another's bias or mount, expected different names")
        refuse_other_world(self.robots, f"robot {robot.name!r}", robot.motion.space.world)
        slot = self.map.add(robot.motion.space, robot.start, robot.cov)
        self.tracks.enter_block(robot.name, slot, robot=True)
        bias = bias_block(robot.motion)
        bias_slot = None if bias is None else self.map.add(*bias)
        if bias_slot is not None:
            self.tracks.enter_block(bias_name(robot.name), bias_slot)
        held = HeldInput(robot.motion, robot.watch(), robot.rests_until_ns)
        moving = self.moving[robot.name] = Moving(robot.motion, slot, bias_slot, held)
        if bias is not None and bias_slot is not None:
            moving.constants.append((bias_slot, *bias[1:]))
        space = robot.motion.space
        reader = StateReader(ANTENNAS[space.d], robot.motion, ORIGIN[space.pose.size], -1)
        reader.gate = settings.association.threshold(space.d, reader.gate)
        self.antennas[robot.name] = reader
        for name, mount in robot.sensors.items():
            mount_slot, block = -1, mount.block(name)
            if block is not None:  # the mount calibrates itself
                mount_slot = self.map.add(*block)
                self.tracks.enter_block(mount_name(robot.name, name), mount_slot)
                moving.constants.append((mount_slot, *block[1:]))
            if isinstance(mount.sensor, OfState):
                refuse_other_world(self.robots, type(mount.sensor).__name__, world_of(mount.sensor))
                if measures_blocks(mount.sensor):
                    self.of_blocks[robot.name, name] = mount.sensor
                    continue
                standing = rest_detector(mount.sensor, robot)
                if standing is not None:
                    self.standing[robot.name] = name
                self.readers[robot.name, name] = StateReader(mount.sensor, robot.motion, mount.at, mount_slot, standing)
                continue
            association = mount.association or settings.association
            landmark = landmark_of(mount, settings.landmarks)
            channel = channel_of(
                self.robots, robot, mount, mount_slot, landmark, kinds, association, self.estimator
            )  # fmt: skip
            self.channels[robot.name, name] = channel
            if channel.lags:
                moving.past = moving.past or PastMotion(channel.pose_dof)
            if isinstance(mount.detector, SearchingDetector):
                self.sources[robot.name, name] = mount.detector.source(mount.sensor)
            upkeep = mount.upkeep or settings.upkeep
            self.policies[robot.name, name] = policy_of(mount, channel, association, upkeep, settings.reparametrize)

    def pose(self, name: str) -> Array:
        """Return the pose (3,) or (7,) of a robot."""
        return self.map.mean(self.moving[name].slot)[: self.robots[name].motion.space.pose.size]

    def view(self, key: ChannelKey) -> FilterView:
        """Return what the source of a channel reads."""
        return FilterView(self.map, self.tracks, self.channels[key], key[0])

    def rows(self, parts: Parts) -> Index:
        """Return the rows of some blocks, of each the first so many."""
        for slot, _ in parts[:-1]:
            self.map.index(slot)  # to activate a block may move those that are active
        return np.concatenate([self.map.index(slot)[:count] for slot, count in parts])

    def move_blocks(self, slots: Sequence[int], F: Array, Q: Array, means: Iterable[Array] = ()) -> None:
        """Move blocks, the first of them to new means: of all their rows together P <- F P F' + Q."""
        self.map.predict(self.rows(tuple((slot, len(self.map.rows(slot))) for slot in slots)), F, Q)
        for slot, mean in zip(slots, means, strict=False):
            self.map.set_predicted(slot, mean)

    def add(self, start: Start) -> int:
        """Add a block computed from others; return its slot.  Raises MapError where the map is full.  [S] (35)-(38)."""
        return self.map.augment(start.space, start.mean, self.rows(start.parts), start.G, start.Q)

    def add_seen(self, start: Start) -> int:
        """Add a landmark that a robot sees, as `add`; the estimator does if it can."""
        if not isinstance(self.estimator, Initializing):
            return self.add(start)
        return self.estimator.initialize(self.map, start.parts[0][0], start.space, start.mean, start.G, start.Q)

    def add_all(self, starts: Iterable[Start]) -> list[int]:
        """Add blocks, all or none of them; return their slots.  Raises MapError where the map is full."""
        slots: list[int] = []
        try:
            for start in starts:
                slots.append(self.add(start))
        except MapError:
            for slot in slots:
                self.map.remove(slot)
            raise
        return slots

    def corrected_by(self, starts: Sequence[Start], update: Update) -> Correction:
        """Add blocks, correct by an `update` of these, remove them again.  Raises MapError where the map is full."""
        slots = self.add_all(starts)
        done = self.estimator.correct(self.map, update._replace(slots=np.array(slots)))
        for slot in slots:
            self.map.remove(slot)
        return done

    def clone(self, key: ChannelKey, t_ns: int) -> int:
        """Clone the pose of a channel's robot; return the clone's number.  Raises MapError where the map is full."""
        number = self.clones.now(key[0], t_ns)
        if number is None:
            robot, space = self.moving[key[0]].slot, self.robots[key[0]].motion.space.pose
            mean, index, dof = self.map.mean(robot)[: space.size], self.map.index(robot)[: space.dof], space.dof
            slot = self.map.augment(space, mean, index, np.eye(dof), np.zeros((dof, dof)))
            number = self.clones.enter(slot, key[0], t_ns)
        self.clones.clones[number].users.add(key)
        return number

    def look_back(self, key: ChannelKey) -> str:
        """Let a channel have its velocity, from its last scan if it counts from there; return what it lacks, or "".

        One that lags has where its robot was when its sensor saw what it shows now.
        """
        channel, held = self.channels[key], self.clones.of(key)
        if channel.lags and (past := self.moving[key[0]].past) is not None:
            if not len(past.seconds):
                return "its lag is in the map, and no motion of its robot is known yet"
            channel.past[:] = past.look_back(key[1], float(self.map.mean(channel.mount)[len(channel.at)]))
            return ""
        if not channel.counts:
            channel.since[1:] = self.moving[key[0]].held.in_force[: len(channel.since) - 1]
            return ""
        channel.clone = self.clones[held[-1]] if held else -1
        if not held or self.t_ns is None:
            return "the first scan: none to count the velocity from"
        channel.since[0] = (self.t_ns - self.clones.clones[held[-1]].t_ns) * 1e-9
        return "" if channel.since[0] >= LEAST_S else "at the time of the last scan: none to count the velocity from"

    def release(self, key: ChannelKey) -> None:
        """Remove the clones that no measurement of a channel needs any more; a delayed start needs the last one."""
        used = {m.clone for track in self.tracks.tentative.values() for m in track.measurements
                if (m.robot, m.sensor) == key}  # fmt: skip
        used |= {m.clone for pending in self.tracks.waiting() if pending.channel == key for m in pending.measurements}
        if key in self.readers:
            used.update(self.clones.of(key))
        elif self.channels[key].counts or self.policies[key].delayed is not None:
            used.update(self.clones.of(key)[-1:])
        for slot in self.clones.refer(key, used):
            self.map.remove(slot)

    def repeats(self, key: ChannelKey, t_ns: int, y: Array, ids: tuple[Id | None, ...] | None = None) -> bool:
        """Take note of what a sensor measured, y (K, m); return whether it is what it gave before (`held_readings`)."""
        given = self.given.get(key)
        if given is None or given.y.shape[1] != y.shape[1]:
            self.given[key] = LastMeasurement.of(y, ids)
            return False
        if not given.take(y, ids) or given.chance() >= SELDOM:
            return False
        moving = self.moving[key[0]]
        pose = moving.motion.space.pose
        dof, v = pose.dof, self.map.mean(moving.slot)[pose.size : pose.size + pose.dof]
        d = min(len(v), 3)
        if not given.has_moved(v[:d], self.map.covariance([moving.slot])[dof : dof + d, dof : dof + d]):
            return False
        given.repeats, given.since_ns = given.repeats + 1, given.since_ns if given.repeats else t_ns
        return True

    def set_covariance(self, cov: Any) -> None:
        """Give all that is in the map, in the order of its names, a joint covariance (n, n).  Raises MapError."""
        slots = [*self.tracks.slots.values()]
        P = self.map.covariance(slots)
        cov = check_covariance(cov, len(P), "cov of all that is in the map", definite=False, error=MapError)
        self.move_blocks(slots, np.eye(len(P)), cov - P)

    def is_surveyed(self, name: Id) -> bool:
        """Return whether a landmark was given, and not mapped from here."""
        return name in self.tracks.known or name in self.surveys.trial or name in self.surveys.trusted

    def begun_ns(self, name: Id) -> int:
        """Return the time of the observation that began a landmark; `NEVER_NS` of one that is surveyed, 0 of others."""
        if self.is_surveyed(name):
            return NEVER_NS
        return self.tracks.confirmed[name].begun[0] if name in self.tracks.confirmed else 0

    def evidence_of(self, robot: str) -> Evidence:
        """Return the evidence of a robot; new, it has the landmarks with ids as the robot saw them last."""
        if robot not in self.evidence:
            tracks = self.tracks.confirmed.values()
            named = (track for track in tracks if track.last[1] == robot and not self.tracks.is_invented(track.id))
            last = reversed(heapq.nlargest(RECENT, named, key=lambda track: track.last))
            self.evidence[robot] = Evidence({t.id: (self.begun_ns(t.id), t.last[0], SURE) for t in last})
        return self.evidence[robot]

    def settle(self) -> None:
        """Notify sources that something else than their scans changes the map."""
        for source in self.sources.values():
            source.settle()

    def remove(self, name: Id) -> None:
        """Remove a landmark; its place goes to the next new one."""
        if name in self.tracks.known:
            self.tracks.known.remove(name)
        else:
            slot = self.tracks.slot(name)
            if name not in self.tracks.confirmed:
                what = "robot" if name in self.robots else "sensor's mount or a control's bias"
                raise MapError(f"{name!r} is a {what}, expected a landmark")
            self.map.remove(slot)
            self.tracks.remove(name)
        self.surveys.forget(name)

    def let_grow(self) -> None:
        """Compress the map as soon as that pays; not where matchings are averaged."""
        if self.may_grow and (self.balance.pays or len(self.tracks.confirmed) > MOST):
            spaces = (track.model.space for track in self.tracks.confirmed.values())
            self.map, self.balance.pays = compress_map(self.map, spaces, self.settings.numbers), False

    def is_there(self, name: Id) -> bool:
        """Return whether a name is that of a block, or of a landmark known exactly."""
        return name in self.tracks.slots or name in self.tracks.known

    def correct(self, update: Update, event: Event, estimator: Estimator | None = None) -> Correction:
        """Correct the map.  Raises DivergedError if the robot is lost for good."""
        done = (estimator or self.estimator).correct(self.map, update)
        if self.may_grow and isinstance(self.map, StochasticMap):
            self.balance.add_correction(update.slots, update.d, done.z.size, self.map.n)
        if not done.valid:
            self.refuse_lost(event)
        return done

    def refuse_lost(self, event: Event) -> None:
        """Raise DivergedError if the covariance of an event's robot is none: no measurement can bring it back."""
        fault = fault_of(self.map.covariance([self.moving[event.robot].slot]))
        if fault:
            raise DivergedError(f"{label_of_event(event)}: the covariance of {event.robot!r} {fault}; {CURE}")
