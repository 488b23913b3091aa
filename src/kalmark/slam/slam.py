"""EKF-SLAM: the page to read first.  Events come in by one door, `Slam.process`; [S] 2.4 is the loop it serves.

robot moves             -> predict       prediction          [S] (14)-(17)
sensor sees known ones  -> _correct      correction          [S] (26)-(30)
sensor sees new ones    -> _initialize   augmentation        [S] (32)-(38)
landmark is removed     -> remove        reduction           [S] Table 1

`association` says which landmark was seen, `members` who is in the map, `lifecycle` what becomes of landmarks later.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from kalmark.association import ByIdentity, ambiguity
from kalmark.association.averaging import average, refuse_postponed
from kalmark.association.index import Nearby
from kalmark.association.protocol import ANEW, DEFERRED, NEW, Association, Decision
from kalmark.errors import DivergedError, EventError, MapError, ModelError
from kalmark.events import Control, Event, Fix, Id, Scan, checked_id, seconds, when
from kalmark.filter.estimators import Estimator, Invariant, Map
from kalmark.management import budget, delayed, lifecycle, tentative
from kalmark.management.approach import approach
from kalmark.management.doubts import MIRRORED
from kalmark.management.upkeep import CAREFUL, Upkeep
from kalmark.models.landmarks import Point2D
from kalmark.models.observe import fix_view
from kalmark.models.protocols import Landmark
from kalmark.report import LandmarkTable, Observation, Report, judged
from kalmark.slam.motion import Drive
from kalmark.slam.prediction import forget_error, place_bias, predict
from kalmark.tracks.checks import (
    covariance,
    instance,
    measurements,
    numbers,
    refuse_bad_control,
    refuse_bad_fix,
    refuse_odd_parts,
)
from kalmark.tracks.members import Members
from kalmark.tracks.robot import Robot, mount_name, robots_given
from kalmark.tracks.scene import Scene, View

Array = npt.NDArray[np.float64]

ORIGIN = {3: np.zeros(3), 7: np.array([0.0, 0, 0, 0, 0, 0, 1])}
LINEAR = 0.03  # the linearity index of [TB]; Civera, Davison and Montiel 2008


class Slam:
    """Robots (or one) and landmarks as one joint Gaussian, corrected event by event.

    `association` decides which landmark was seen, `estimator` how the map is corrected, `landmarks` (or a mount's own)
    what a landmark is.  A point of unknown depth becomes Euclidean where its linearity index falls below
    `reparametrize` (None: never).  `map` is "dense", "postponed" (docs/postponed.md), or "auto": dense while small;
    `numbers` ("float64", "float32") are those in which a postponed one keeps what is at rest.  `upkeep` says when a
    sighting without an id becomes a landmark (docs/association.md).  Events must come in the order of their times.
    """

    def __init__(
        self,
        robots: Iterable[Robot] | Robot,
        association: Association | None = None,
        estimator: Estimator | None = None,
        landmarks: Landmark | None = None,
        map: str = "auto",
        reparametrize: float | None = LINEAR,
        numbers: str = "float64",
        upkeep: Upkeep = CAREFUL,
    ) -> None:
        self.robots: dict[str, Robot] = {}
        self.association: Association = ByIdentity() if association is None else association
        self.estimator: Estimator = Invariant() if estimator is None else estimator
        refuse_odd_parts(self.association, self.estimator, landmarks, upkeep, reparametrize)
        self.t_ns: int | None = None
        self.map_type, self.numbers = map, numbers
        self.map: Map = lifecycle.new_map(map, numbers)
        self.landmark_type, self.upkeep = landmarks, upkeep
        self.reparametrize = reparametrize
        self.members, self.nearby = Members(self.robots), Nearby()
        self._drives: dict[str, Drive] = {}
        self._errors: dict[str, int] = {}  # the block of a held control's error, while a scan has split its interval
        self._views: dict[tuple[str, str], View] = {}
        self._takes: dict[type, Any] = {Control: self._control, Scan: self._scan, Fix: self._fix}
        for robot in robots_given(robots):
            if robot.name in self.robots:
                raise ModelError(f"robot {robot.name!r} is given twice, expected different names")
            self.robots[robot.name] = robot
        for robot in self.robots.values():
            self._place(robot, landmarks)

    def _place(self, robot: Robot, landmarks: Landmark | None) -> None:
        if robot.name in self.members.slots:
            raise ModelError(f"robot {robot.name!r} has the name of another's bias or mount, expected different names")
        self.refuse_other_world(f"robot {robot.name!r}", robot.motion.space.world)
        self.members.place_robot(robot.name, self.map.add(robot.motion.space, robot.start, robot.cov))
        self._drives[robot.name] = Drive(robot.motion)
        place_bias(self, robot.name)
        for name, mount in robot.sensors.items():
            slot, block = -1, mount.block(name)
            if block is not None:  # the mount calibrates itself
                slot = self.map.add(*block)
                self.members.slots[mount_name(robot.name, name)] = slot
            self._views[robot.name, name] = View(mount, landmarks, self, slot)

    # ------------------------------------------------------------------ events
    def process(self, event: Event) -> Report:
        """Take one event into the map and report what became of it; a bad event changes nothing.

        Raises EventError for an event that cannot be used, DivergedError when the filter cannot go on.
        """
        take = self._takes.get(type(event))
        if take is None:
            raise EventError(f"got {type(event).__name__}, expected a Control, a Scan or a Fix")
        before = self.t_ns
        if before is not None and event.t_ns < before:
            raise EventError(f"{when(event)} comes after one at t={seconds(before)} s")
        if event.robot not in self.robots:
            names = sorted(self.robots)
            raise EventError(f"{when(event)}: robot is {event.robot!r}, expected one of {names}")
        try:
            return take(event)
        except EventError:
            self.t_ns = before
            raise

    def _control(self, event: Control) -> Report:
        drive = self._drives[event.robot]
        refuse_bad_control(event, drive.motion.columns)
        self.t_ns = event.t_ns
        with drive:
            for part in drive.accept(event):
                predict(self, event.robot, part)
        forget_error(self, event.robot)
        return Report(event)

    def _scan(self, event: Scan) -> Report:
        view = self._views.get((event.robot, event.sensor))
        if view is None:
            names = sorted(self.robots[event.robot].sensors)
            raise EventError(f"{when(event)}: sensor is {event.sensor!r}, expected one of {names}")
        event = event if view.detector is None else view.detector(event)
        R = measurements(event, view.sensor)
        if view.averages:
            refuse_postponed(self.map, event)
        self.t_ns = event.t_ns
        self._advance(event.robot)
        if len(event.y) == 0:
            return lifecycle.tidied(self, view, event, Report(event))
        ids = event.ids or (None,) * len(event.y)
        for i in ids if len(self.robots) > 1 else ():
            if i in self.robots:
                self._advance(i)
        scene = Scene(self, view, event, ids, R)
        return self._fuse(event, view, scene, ambiguity.associate(self, view, scene), R)

    def _fix(self, event: Fix) -> Report:
        pose, size = (3, 2) if self.robots[event.robot].motion.space.axes == 1 else (7, 3)
        refuse_bad_fix(event, size)
        self.t_ns = event.t_ns
        self._advance(event.robot)
        slot, report = self.members.slots[event.robot], Report(event, event.y.reshape(1, size))
        gate = self.association.threshold(size, self.estimator.default_gate)
        view, estimator, R = fix_view(ORIGIN[pose]), self.estimator.for_fixes(), event.cov.reshape(1, size, size)
        done = estimator.correct(self.map, view, slot, -1, np.array([slot]), 0, report.y, R, gate)
        self.refuse_sick(done.healthy, event)
        report.e, report.z, report.Z = done.e, done.z, done.Z
        report.observations = tuple(judged([0], [event.robot], [event.robot], done, gate))
        return report

    # ------------------------------------------------------------------ motion
    def _advance(self, name: str) -> None:
        """Move a robot up to now by the control it holds."""
        assert self.t_ns is not None
        with self._drives[name] as drive:
            part = drive.advance(self.t_ns)
            if part is not None:
                predict(self, name, part)

    # ------------------------------------------------------------------ scans
    def _fuse(self, event: Scan, view: View, scene: Scene, decisions: Sequence[Decision], R: Array) -> Report:
        """Correct by the known landmarks, then add the new ones.  [S] 2.4."""
        report, ids = scene.report(), scene.ids
        known = self.members.known_to(view, event.robot, [name for name, _ in decisions])
        outcomes: list[Observation | None] = [None] * len(decisions)
        for seen in self._correct(event, report, view, known, ids, decisions, R):
            outcomes[seen.index] = seen
        if view.changes:
            report.removed = lifecycle.review(self, view, event, [o for o in outcomes if o is not None])
        if len(known) < len(decisions):
            new = [k for k, outcome in enumerate(outcomes) if outcome is None]
            for k, seen in self._sight(event, report, view, new, ids, decisions, R):
                outcomes[k] = seen
            new = [k for k in new if outcomes[k] is None]
            reasons = budget.starts(self, view, new, known, event.y, decisions)
            for k in new:
                name, reason = (decisions[k][0], decisions[k][1]) if k not in reasons else (None, reasons[k])
                outcomes[k] = self._initialize(event, view, k, ids[k], name, reason, R)
            lifecycle.let_grow(self)
        report.observations = tuple(outcomes)  # type: ignore[arg-type]
        return lifecycle.tidied(self, view, event, report)

    def _sight(
        self, event: Scan, report: Report, view: View, new: list[int], ids: tuple[Id | None, ...],
        decisions: Sequence[Decision], R: Array,
    ) -> Iterator[tuple[int, Observation]]:  # fmt: skip
        """Count the sightings of tentative landmarks; fuse those that confirm one."""
        seen, confirmed = tentative.sightings(self, view, event, report, new, decisions, R)
        yield from seen.items()
        left = [k for k in new if k not in seen and k not in confirmed]
        yield from delayed.sightings(self, view, event, left, decisions, R)
        told = [confirmed.get(k, (None, "")) for k in range(len(decisions))]
        for done in self._correct(event, report, view, list(confirmed), ids, told, R) if confirmed else ():
            yield done.index, done._replace(outcome="new", reason=told[done.index][1])

    def _correct(
        self, event: Scan, report: Report, view: View, known: list[int], ids: tuple[Id | None, ...],
        decisions: Sequence[Decision], R: Array,
    ) -> Iterator[Observation]:  # fmt: skip
        """Fuse the observations `known` of landmarks in the map, those of one type at once.  [S] (26)-(30)."""
        names: list[Any] = [decisions[k][0] for k in known]
        robot = self.members.slots[event.robot]
        groups = [(look, [known[i] for i in rows]) for look, rows in self.members.by_look(view, names)]
        if view.attention.updates is not None and len(known) > view.attention.updates:
            for k in budget.least(self, event, view, groups, decisions, R):
                reason = f"not among the {view.attention.updates} that tell most"
                yield Observation(k, ids[k], "ignored", decisions[k][0], None, reason)  # type: ignore[arg-type]
        if view.attention.sequential:
            groups = [(look, [k]) for look, rows in groups for k in rows]
        if not len(report.e) and (len(groups) != 1 or len(groups[0][1]) < len(report.y)):
            report.blank(view.dof)
        for look, rows in [group for group in groups if group[1]]:
            if len(rows) < len(event.y):
                y, noise, names = event.y[rows], R[rows], [decisions[k][0] for k in rows]
            else:  # all, in their order
                y, noise = event.y, R
            slots = self.members.slots_of(names)
            approach(self, view, robot, look, slots, y, noise)
            noise = view.noise(self.map, robot, look, slots, noise, event)
            done = self.estimator.correct(self.map, look.view, robot, view.mount, slots, look.d, y, noise, view.gate)
            self.refuse_sick(done.healthy, event)
            report.fill(rows, done)
            outcomes = judged(rows, ids, names, done, view.gate)
            self.members.count(seen.landmark for seen in outcomes if seen.outcome == "associated")
            yield from outcomes
        if view.averages:
            yield from average(self, event, view, decisions, R)

    def _initialize(
        self, event: Scan, view: View, k: int, id_: Id | None, name: Any, reason: str, R: Array
    ) -> Observation:
        """Add a landmark: L = g(R, S, y), P_LL = G_r P G_r' + G_y R G_y'.  [S] (32)-(38)."""
        if name is None or (name in (DEFERRED, ANEW) and name not in view.starts):
            return Observation(k, id_, "ignored" if name is None else "deferred", None, None, reason)
        if name == event.robot:
            return Observation(k, id_, "ignored", None, None, "a robot does not see itself")
        self.members.reserve([id_])
        if name in self.members.slots:
            return Observation(k, id_, "rejected", name, None, f"it is no {view.landmark.kind}")
        if view.initialization is not None:
            return view.initialization.observe(self, view, event, k, id_, name, R[k])
        robot = self.members.slots[event.robot]
        which = self.members.doubts.which(view, self.map, robot, name, event.y[k], event.t_ns)
        if which is None:
            return Observation(k, id_, "deferred", None, None, MIRRORED)
        l, L_h, Q = view.explain(self.map, robot, event, k, R[k], which)
        if l.shape != (view.landmark.space.size,):
            found = f"it finds {len(l)} numbers, a {view.landmark.kind} has {view.landmark.space.size}"
            return Observation(k, id_, "ignored", None, None, found)
        if not (np.isfinite(l).all() and np.isfinite(L_h).all() and np.isfinite(Q).all()):
            return Observation(k, id_, "ignored", None, None, "no landmark explains this measurement")
        held, unproven = name is DEFERRED, name is DEFERRED or (name in (NEW, ANEW) and view.upkeep.confirm > 1)
        name = self.members.new_name() if name in (NEW, ANEW, DEFERRED) else name
        G, index = self.estimator.pose_jacobian(self.map, robot, L_h), view.head_index(self.map, robot)
        try:
            slot = self.map.augment(view.landmark.space, l, index, G, Q)
        except MapError as full:
            return Observation(k, id_, "ignored", None, None, str(full))
        if unproven:
            return tentative.started(self, view, event, k, name, slot, reason, held)
        self.members.start(name, slot, view.landmark)
        return Observation(k, id_, "new", name, None, reason)

    def refuse_sick(self, healthy: bool, event: Event) -> None:
        """Raise DivergedError where the filter cannot go on."""
        if not healthy:
            raise DivergedError(f"{when(event)}: the innovation's covariance is not positive definite")

    # ------------------------------------------------------------------ reading and editing the map
    def mean(self, name: Id) -> Array:
        """Return the mean of a landmark or of a robot: (x, y, heading) in m and rad, or (x, y, z, qx, qy, qz, qw)."""
        return self.map.mean(self.slot(name))

    def covariance(self, *names: Id) -> Array:
        """Return the joint covariance of robots and landmarks, in the order given, in standard coordinates."""
        if not names:
            raise MapError("covariance of nothing was asked for, expected names of robots or landmarks")
        return self.map.covariance([self.slot(name) for name in names])

    def landmarks(self) -> LandmarkTable:
        """Return ids, kinds, means, covariances and numbers of observations of all landmarks."""
        return LandmarkTable.of(self)

    def refuse_other_world(self, what: str, world: str) -> None:
        """Refuse what lives in the plane among robots that move in space, and the other way round."""
        here = next(iter(self.robots.values())).motion.space.world
        if world and world != here:
            raise ModelError(f"{what} is of the {world}, expected one of the {here}, where the first robot moves")

    def landmark_model(self, name: Id) -> Landmark | None:
        """Return what a landmark is, None for what is no landmark of the map."""
        return self.members.kinds.get(name)

    def segment(self, name: Id) -> tuple[Array, Array]:
        """Return the ends (2, 3) of the segment seen of a line so far, and their covariances (2, 3, 3)."""
        kind: Any = self.landmark_model(name)
        ends = self.segment_ends(name)
        if ends is None:
            raise MapError(f"{name!r} is no line of the map, expected one with ends")
        p, P_l = kind.endpoints(self.mean(name)[None], ends[None])
        return p[0], P_l[0] @ self.covariance(name) @ P_l[0].swapaxes(1, 2)

    def segment_ends(self, name: Id) -> Array | None:
        """Return where on its line the segment seen so far ends, as abscissas (2,); None for what is no line."""
        return self.members.ends.get(name)

    def add_landmark(self, name: Id, mean: Any, cov: Any = None, landmark: Landmark | None = None) -> None:
        """Add a landmark known beforehand, by survey: exactly (`cov` None) or with a covariance."""
        name = checked_id(name, "landmark")
        if landmark is not None:
            instance(landmark, Landmark, f"landmark {name!r}", "a landmark model")
        kind = landmark or lifecycle.surveyed(next((v.landmark for v in self._views.values()), Point2D()), mean)
        self.refuse_other_world(kind.kind, kind.space.world)
        if name in self.members.slots:
            raise MapError(f"landmark {name!r} is in the map already, expected a new id")
        mean = numbers(mean, kind.space.size, f"landmark {name!r}: mean", MapError)
        if cov is not None:
            cov = covariance(cov, kind.space.dof, f"landmark {name!r}: cov", definite=False, error=MapError)
        self.members.place(name, self.map.add(kind.space, mean, cov), kind)
        self.members.reserve([name])
        lifecycle.let_grow(self)

    def remove(self, name: Id) -> None:
        """Remove a landmark; its place goes to the next new one."""
        slot = self.slot(name)
        if name not in self.members.kinds:
            what = "robot" if name in self.robots else "sensor's mount or a control's bias"
            raise MapError(f"{name!r} is a {what}, expected a landmark")
        self.map.remove(slot)
        self.members.forget(name)

    def slot(self, name: Id) -> int:
        """Return the slot of a robot or landmark in `map`."""
        return self.members.slot(name)

    # ------------------------------------------------------------------ files
    def save(self, path: str | Path) -> None:
        """Write the whole state to a file; `load` resumes bit for bit."""
        from kalmark.slam.store import save

        save(self, Path(path))

    @staticmethod
    def load(
        path: str | Path,
        robots: Iterable[Robot] | None = None,
        association: Association | None = None,
        estimator: Estimator | None = None,
        landmarks: Landmark | None = None,
    ) -> Slam:
        """Read a state written by `save`; what is not kalmark's own (a user's models) must be given again."""
        from kalmark.slam.store import load

        return load(Path(path), robots, association, estimator, landmarks)

    @staticmethod
    def from_config(path: str | Path) -> Slam:
        """Build the Slam that a configuration (a path or a shipped name) describes."""
        from kalmark.config import slam_from_config

        return slam_from_config(path)
