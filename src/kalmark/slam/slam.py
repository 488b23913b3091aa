"""EKF-SLAM: the page to read first.  Events come in by one door, `Slam.process`; [S] 2.4 is the loop it serves.

robot moves               -> _move         prediction          [S] (14)-(17)
known landmarks observed  -> _correct      correction          [S] (26)-(30)
new landmarks observed    -> _initialize   augmentation        [S] (32)-(38)
landmark is removed       -> remove        reduction           [S] Table 1

`association` decides which landmark was observed, `management` what becomes of landmarks: both read a `ScanContext` and
return decisions and actions.  This page alone changes the map, the tracks and the clones.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack, suppress
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from kalmark.arrays import Array, Index
from kalmark.association import Association, ByIdentity
from kalmark.association.averaging import average, outcomes, refuse_averaging
from kalmark.association.global_start import Located, is_lost, located
from kalmark.association.protocol import DEFERRED, NEW, REMAP, Answer, Decision, Mixture
from kalmark.association.query import Query
from kalmark.association.ratio import accepted
from kalmark.association.relocalization import relocalized
from kalmark.errors import DivergedError, EventError, MapError, ModelError
from kalmark.events import LONGEST_PAUSE_NS, Control, Event, Fix, Id, Scan, checked_id, seconds, when
from kalmark.filter.compressed.map import CompressedMap
from kalmark.filter.estimators import Averaging, Compiling, Correction, Estimator, Invariant, Update
from kalmark.filter.map import Map
from kalmark.filter.maps import DENSE, grown, new_map
from kalmark.geometry.frames import compose, inverse
from kalmark.geometry.spaces import RHO, SE2, SE3, Rn
from kalmark.management import confirm, delayed, existence, merge, reparametrize, tags, walls
from kalmark.management import repeats as of_map
from kalmark.management.attention import chosen, left_out
from kalmark.management.pending import Initialization, Step
from kalmark.management.upkeep import CAREFUL, Upkeep
from kalmark.models.landmarks import Point2D
from kalmark.models.observe import fix_view
from kalmark.models.protocols import Joining, Landmark, OfState, Reparametrizable, Segmented, place_of, world_of
from kalmark.report import (
    INDEFINITE,
    Expectations,
    Gap,
    Judged,
    LandmarkTable,
    Observation,
    Repeat,
    Report,
    outcomes_of,
)
from kalmark.slam import replacing
from kalmark.slam.checks import (
    covariance,
    fault_of,
    instance,
    measurements,
    numbers,
    refuse_bad_control,
    refuse_bad_fix,
    refuse_odd_parts,
)
from kalmark.slam.motion import HeldInput, Moving, Part, bias_block, bias_name
from kalmark.slam.policy import Policy, channel_of, policy_of, refuse_other_world
from kalmark.slam.reader import Reader
from kalmark.slam.robot import Robot, mount_name, robots_given
from kalmark.tracks.channel import Channel, ObservationModel, Parts
from kalmark.tracks.clones import Clones
from kalmark.tracks.expecting import expectations
from kalmark.tracks.scan import ScanContext, Start
from kalmark.tracks.track import ChannelKey, Late, Pending, Status, Track, Tracks

ORIGIN = {3: np.zeros(3), 7: np.array([0.0, 0, 0, 0, 0, 0, 1])}
UNEXPLAINED = "no landmark explains this measurement"
SINGULAR = "what it may be cannot be computed: a matrix is singular"
CURE = "start anew from a pose that is less certain, or with larger sigmas of controls and sensors"
HEADING_RAD = 0.3  # a sigma above which a correction is not linearised at the prediction
FIX_GATES = {2: 18.42, 3: 21.11}  # squared distances that .9999 of good fixes stay within
LINEAR = 0.03  # the linearity index of [TB]; Civera, Davison and Montiel 2008


class Slam:
    """Robots (or one) and landmarks as one joint Gaussian, corrected event by event.

    `association` decides which landmark was observed, `estimator` how the map is corrected, `landmarks` (or a mount's
    own) what a landmark is.  A point of unknown depth becomes Euclidean where its linearity index falls below
    `reparametrize` (None: never).  `map` is "dense", "postponed" (the compressed map, docs/compressed.md), or "auto":
    dense while small; `numbers` ("float64", "float32") are those in which a compressed one keeps what is inactive.
    `upkeep` says when an observation without an id becomes a landmark (docs/association.md).  Events must come in the
    order of their times.
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
        self.association: Association = ByIdentity() if association is None else association
        self.estimator: Estimator = Invariant() if estimator is None else estimator
        refuse_odd_parts(self.association, self.estimator, landmarks, upkeep, reparametrize)
        self.t_ns: int | None = None
        self.map_type, self.numbers = map, numbers
        self.map: Map = new_map(map, numbers)
        self.landmark_type, self.upkeep = landmarks, upkeep
        self.reparametrize = reparametrize
        self.robots: dict[str, Robot] = {}
        for robot in robots_given(robots):
            if robot.name in self.robots:
                raise ModelError(f"robot {robot.name!r} is given twice, expected different names")
            self.robots[robot.name] = robot
        self.tracks, self.clones = Tracks(self.robots), Clones()
        self.before_scan: Callable[[str, str], object] | None = None  # called with robot and sensor, may ask `expect`
        self._moving: dict[str, Moving] = {}
        self._channels: dict[ChannelKey, Channel] = {}
        self._policies: dict[ChannelKey, Policy] = {}
        self._readers: dict[ChannelKey, Reader] = {}
        self._takes: dict[type, Any] = {Control: self._control, Scan: self._scan, Fix: self._fix}
        self._inner = {bias_name(name) for name in self.robots}
        self._inner |= {mount_name(name, key) for name, robot in self.robots.items() for key in robot.sensors}
        for robot in self.robots.values():
            self._place(robot)
        if isinstance(self.estimator, Compiling):
            kinds = [kind for channel in self._channels.values() for kind in channel.landmark.space.kinds]
            axes = max(robot.motion.space.axes for robot in self.robots.values())
            self.estimator.compile_ahead(axes, RHO in kinds)
        self._may_grow = map == "auto" and not any(policy.averages for policy in self._policies.values())

    def _place(self, robot: Robot) -> None:
        """Enter a robot, the bias of its controls and its mounts into the map."""
        if robot.name in self._inner:
            raise ModelError(f"robot {robot.name!r} has the name of another's bias or mount, expected different names")
        refuse_other_world(self.robots, f"robot {robot.name!r}", robot.motion.space.world)
        slot = self.map.add(robot.motion.space, robot.start, robot.cov)
        self.tracks.enter_block(robot.name, slot, robot=True)
        bias = bias_block(robot.motion)
        bias_slot = None if bias is None else self.map.add(*bias)
        if bias_slot is not None:
            self.tracks.enter_block(bias_name(robot.name), bias_slot)
        self._moving[robot.name] = Moving(robot.motion, slot, bias_slot, HeldInput(robot.motion, robot.watch()))
        for name, mount in robot.sensors.items():
            mount_slot, block = -1, mount.block(name)
            if block is not None:  # the mount calibrates itself
                mount_slot = self.map.add(*block)
                self.tracks.enter_block(mount_name(robot.name, name), mount_slot)
            if isinstance(mount.sensor, OfState):
                refuse_other_world(self.robots, type(mount.sensor).__name__, world_of(mount.sensor))
                self._readers[robot.name, name] = Reader(mount.sensor, robot.motion, mount.at, mount_slot)
                continue
            association = mount.association or self.association
            channel = channel_of(self.robots, mount, mount_slot, self.landmark_type, association, self.estimator)
            self._channels[robot.name, name] = channel
            self._policies[robot.name, name] = policy_of(mount, channel, association, mount.upkeep or self.upkeep)

    # ------------------------------------------------------------------ events
    def process(self, event: Event) -> Report:
        """Take one event into the map and report what became of it; a bad event changes nothing.

        Raises EventError for an event that cannot be used, DivergedError when a robot is lost for good.
        """
        take = self._takes.get(type(event))
        if take is None:
            raise EventError(f"got {type(event).__name__}, expected a Control, a Scan or a Fix")
        before = self.t_ns
        if before is not None and event.t_ns < before:
            raise EventError(f"{when(event)} comes after one at t={seconds(before)} s")
        if before is not None and event.t_ns - before > LONGEST_PAUSE_NS:
            raise EventError(
                f"{when(event)} comes more than a year after one at t={seconds(before)} s, expected it sooner"
            )
        if event.robot not in self.robots:
            names = sorted(self.robots)
            raise EventError(f"{when(event)}: robot is {event.robot!r}, expected one of {names}")
        try:
            return take(event)
        except EventError:
            self.t_ns = before
            raise
        except np.linalg.LinAlgError as error:
            self._refuse_lost(event)
            why = " ".join(str(error).split())
            raise DivergedError(f"{when(event)}: {why}; {CURE}") from error

    def _control(self, event: Control) -> Report:
        moving, report = self._moving[event.robot], Report(event)
        refuse_bad_control(event, moving.motion.columns)
        self.t_ns = event.t_ns
        with moving.held as held:
            parts = held.accept(event)
            if len(parts) > 1:
                self._refuse_nowhere(event.robot, parts)
            for part in parts:
                self._move(event.robot, part)
        if moving.error is not None:  # of a control that is no longer held
            self.map.remove(moving.error)
            moving.error = None
        report.gaps = moving.held.noticed()
        return report

    def _scan(self, event: Scan) -> Report:
        key = event.robot, event.sensor
        if key in self._readers:
            return self._read(event, self._readers[key])
        if key not in self._channels:
            names = sorted(self.robots[event.robot].sensors)
            raise EventError(f"{when(event)}: sensor is {event.sensor!r}, expected one of {names}")
        if event.ids is not None and not self._inner.isdisjoint(event.ids):
            name = next(i for i in event.ids if i in self._inner)
            raise EventError(f"{when(event)}: id {name!r} names a robot's bias or mount, expected another")
        channel, policy = self._channels[key], self._policies[key]
        event = event if policy.detector is None else policy.detector(event)
        R = measurements(event, channel.sensor, channel.check)
        if policy.averages:
            refuse_averaging(self.map, self.estimator, event)
        self.t_ns = event.t_ns
        ids = event.ids or (None,) * len(event.y)
        seen = [i for i in ids if i in self.robots and i != event.robot] if len(self.robots) > 1 else []
        gaps = self._advance(event.robot, *seen)
        robot, report = self._moving[event.robot].slot, Report(event, event.y)
        report.gaps = gaps
        scan = ScanContext(
            self.map, self.tracks, self.clones, self.estimator, channel, robot, event, ids, R, report
        )  # fmt: skip
        if self.before_scan is not None:
            self.before_scan(event.robot, event.sensor)
        if len(event.y):
            self._fuse(scan, policy)
            if gaps and any(o.outcome == "associated" for o in report.observations):
                self._moving[event.robot].held.located(event.t_ns)
        self._maintain(scan, policy)
        return report

    def _read(self, event: Scan, reader: Reader) -> Report:
        """Correct by what a sensor measures of its own robot; leave a clone where its next reading counts from here."""
        key, robot, since_s = (event.robot, event.sensor), self._moving[event.robot].slot, reader.since_s(event)
        R, report = reader.noise(event), Report(event, event.y)
        self.t_ns = event.t_ns
        report.gaps = self._advance(event.robot)
        if not len(event.y):
            return report
        reader.drift(self.map, since_s)
        reader.t_ns, held = event.t_ns, self.clones.of(key)
        if reader.counts and not held:
            report.blank(R.shape[1])
            report.observations = (
                Observation(0, None, "ignored", None, None, "the first reading: none to count from"),
            )
        else:
            update = reader.update(self.map, robot, self.clones[held[-1]] if held else -1, event, R, since_s)
            done = self._corrected(update, event, reader.estimator(self.estimator))
            done = done._replace(e=done.e[:, : event.width])
            report.e, report.z, report.Z = done.e, done.z, done.Z
            report.judged = (Judged([0], [None], [event.robot], done, reader.gate),)
        if reader.counts:
            with suppress(MapError):  # it is full: the next reading is the first again
                self._clone(key, event.t_ns)
            for slot in self.clones.refer(key, set(self.clones.of(key)) - set(held)):
                self.map.remove(slot)
        return report

    def _fix(self, event: Fix) -> Report:
        pose, size = (3, 2) if self.robots[event.robot].motion.space.axes == 1 else (7, 3)
        refuse_bad_fix(event, size)
        self.t_ns = event.t_ns
        gaps = self._advance(event.robot)
        slot, report = self._moving[event.robot].slot, Report(event, event.y.reshape(1, size))
        report.gaps = gaps
        gate, R = self.association.threshold(size, FIX_GATES[size]), event.cov.reshape(1, size, size)
        update = Update(fix_view(ORIGIN[pose]), slot, -1, np.array([slot]), 0, report.y, R, gate)
        done = self._corrected(update, event, self.estimator.for_fixes())
        report.e, report.z, report.Z = done.e, done.z, done.Z
        report.judged = (Judged([0], [event.robot], [event.robot], done, gate),)
        left_out = self._moving[event.robot].left_out
        if done.fused[0]:
            left_out.clear()
        else:
            del left_out[: len(left_out) + 1 - replacing.KEPT]
            left_out.append(replacing.LeftOut(event.y, event.cov, done.e[0]))
            report.replaced = self._replace(event.robot)
        return report

    def _replace(self, name: str) -> float:
        """Move a robot to where its fixes place it, if they agree; return how far, m, 0 where they do not."""
        moving = self._moving[name]
        space = moving.motion.space
        size, dof = (3, 3) if space.axes == 1 else (7, 6)
        mean, index = self.map.mean(moving.slot), self.map.index(moving.slot)
        found = replacing.replaced(mean[:size], self.map.covariance([moving.slot])[:dof, :dof], moving.left_out)
        if found is None:
            return 0.0
        self.map.predict(index[:dof], np.zeros((dof, dof)), found.cov)
        self.map.set_predicted(moving.slot, np.concatenate([found.pose, mean[size:]]))
        self.clones.moved(name)
        moving.left_out.clear()
        return float(np.linalg.norm(found.pose[: dof // 2] - mean[: dof // 2]))

    # ------------------------------------------------------------------ motion
    def _advance(self, *names: str) -> tuple[Gap, ...]:
        """Move robots up to now by the controls they hold, all or none of them; return gaps in their controls."""
        assert self.t_ns is not None
        with ExitStack() as clocks:
            helds = [clocks.enter_context(self._moving[name].held) for name in names]
            moves = [(name, held.advance(self.t_ns)) for name, held in zip(names, helds, strict=True)]
            for name, part in moves if len(moves) > 1 else ():
                self._refuse_nowhere(name, [] if part is None else [part])
            for name, part in moves:
                if part is not None:
                    self._move(name, part)
            return tuple(gap for held in helds for gap in held.noticed())

    def _refuse_nowhere(self, name: str, parts: Sequence[Part]) -> None:
        """Refuse, before anything has moved, parts of a robot's controls that lead nowhere."""
        if not self._moving[name].leads_somewhere(self.map, parts):
            raise self._nowhere(name, parts[-1])

    def _nowhere(self, name: str, part: Part) -> EventError:
        what = f"{name!r} at t={seconds(self.t_ns or 0)} s"
        return EventError(f"{what}: u is {part.u.tolist()}, expected a control that moves it somewhere finite")

    def _move(self, name: str, part: Part) -> None:
        """Move a robot by one part of its control: R <- f(R, u), P <- F P F' + Q.  [S] (14)-(17)."""
        moving = self._moving[name]
        if not isinstance(moving.model, tuple):  # a user's: nothing is known of it
            self._refuse_nowhere(name, [part])
        shared = moving.error is None and not (part.first and part.last) and part.N.any()
        if shared and moving.leads_somewhere(self.map, [part]):
            with suppress(MapError):  # it is full: each part has an error of its own
                moving.error = self.map.add(Rn(len(part.u)), np.zeros(len(part.u)), part.N)
        if not self.estimator.predict(self.map, moving.movement(self.map, part)):
            raise self._nowhere(name, part)
        self.clones.moved(name)

    # ------------------------------------------------------------------ scans
    def _fuse(self, scan: ScanContext, policy: Policy) -> None:
        """Correct by the known landmarks, then add the new ones.  [S] 2.4."""
        query = Query(scan)
        located = self._started(scan, query)
        if located is not None and located.T is None:
            scan.report.blank(scan.channel.dof)
            fate = [Observation(k, i, "deferred", None, None, located.why) for k, i in enumerate(scan.ids)]
            scan.report.observations = fate
            return
        query = self._relocalized(scan, query) if located is None else Query(scan)
        decisions = self._decided(policy, query, located.decisions if located is not None else None)
        self.tracks.learn(*query.learned)
        names = [name for name, _ in decisions]
        groups = self.tracks.by_model(scan.channel, names, scan.event.robot)
        exact = self._correct_by_known(scan, policy, decisions) if self.tracks.known else []
        judged, found = self._correct(scan, policy, groups, decisions)
        judged = exact + judged
        if not found and not policy.reviews and sum(len(group.rows) for group in judged) == len(decisions):
            scan.report.judged = tuple(judged)
            return
        found += [o for group in judged for o in outcomes_of(group)]
        if policy.reviews:
            self._review(scan, policy, found)
        if len(found) < len(decisions):
            seen = {o.index: o for o in found}
            used = [k for group in exact for k in group.rows] + [k for _, rows in groups for k in rows]
            self._start(scan, policy, used, decisions, seen)
            found = list(seen.values())
        scan.report.observations = tuple(found)

    def _decided(self, policy: Policy, query: Query, told: list[Decision] | None) -> Sequence[Decision]:
        """Ask the association, unless it has `told`; where its numbers are singular, only ids say what was observed."""
        try:
            decisions = policy.association.associate(query) if told is None else told
            return accepted(query, decisions, policy.upkeep.odds) if policy.holds_back else decisions
        except np.linalg.LinAlgError:
            return [(None, SINGULAR) if i is None else (i, "") for i in query.ids]

    def _started(self, scan: ScanContext, query: Query) -> Located | None:
        """Move a robot that may be anywhere in a known map to where its scan fits; None of a robot that may not."""
        if not self.tracks.known:
            return None
        pose, dof = self.map.mean(scan.robot)[: len(scan.channel.at)], scan.channel.pose_dof
        if not is_lost(pose, self.map.covariance([scan.robot])[:dof, :dof], self.tracks):
            return None
        found = located(query)
        if found.T is not None:
            self._put(scan, found.T)
        return found

    def _relocalized(self, scan: ScanContext, query: Query) -> Query:
        """Move a robot whose heading a gap has left unknown to where its scan fits; return what to ask then."""
        held = self._moving[scan.event.robot].held
        if not held.is_adrift:
            return query
        if len(scan.pose()) != 3 or self.map.covariance([scan.robot])[2, 2] < HEADING_RAD**2:
            held.recovered()
            return query
        T = None
        with suppress(np.linalg.LinAlgError):
            T = relocalized(query)
        if T is None:
            return query
        self._put(scan, T)
        return Query(scan)

    def _put(self, scan: ScanContext, T: Array) -> None:
        """Move a robot of the plane so that the sensor of a scan is at T (3,).

        Its mean alone: the covariance says that it may be there.
        """
        r = self.map.mean(scan.robot)
        pose = compose(T, compose(inverse(scan.pose())[0], r[:3])[0])[0]
        self.map.set_predicted(scan.robot, np.append(pose, r[3:]))

    def _correct(
        self, scan: ScanContext, policy: Policy, groups: list[tuple[ObservationModel, list[int]]],
        decisions: Sequence[Decision],
    ) -> tuple[list[Judged], list[Observation]]:  # fmt: skip
        """Fuse observations of landmarks in the map, the groups of those of one type at once.  [S] (26)-(30)."""
        report, found, most = scan.report, list[Observation](), policy.attention.updates
        judged: list[Judged] = []
        if most is not None and sum(len(rows) for _, rows in groups) > most:
            groups, out = chosen(scan, policy.attention, groups, decisions)
            why = f"not among the {most} of most information"
            found += [Observation(k, scan.ids[k], "ignored", decisions[k][0], None, why) for k in out]  # type: ignore[arg-type]
        if policy.attention.sequential:
            groups = [(model, [k]) for model, rows in groups for k in rows]
        if not len(report.e) and (len(groups) != 1 or len(groups[0][1]) < len(scan.y)):
            report.blank(scan.channel.dof)
        for model, rows in groups:
            if not rows:
                continue
            names: list[Any] = [decisions[k][0] for k in rows]
            slots = self.tracks.slots_of(names)
            if scan.channel.far is not None and (near := tags.approach(scan, model, slots, rows)) is not None:
                self.estimator.correct(self.map, near)
            done = self._corrected(scan.update(model, slots, rows), scan.event)
            report.fill(rows, done)
            self.tracks.count(names, done.fused.tolist())
            judged.append(Judged(rows, scan.ids, names, done, scan.channel.gate))
        return judged, found + self._average(scan, decisions) if policy.averages else found

    def _correct_by_known(
        self, scan: ScanContext, policy: Policy, decisions: Sequence[Decision]
    ) -> list[Judged]:  # fmt: skip
        """Correct by observations of landmarks known exactly, as by fixes.  docs/localization.md."""
        report, known, m = scan.report, self.tracks.known, scan.y.shape[1]
        groups = self.tracks.known_by_model(scan.channel, [name for name, _ in decisions])
        if policy.attention.sequential:
            groups = [(model, [k]) for model, rows in groups for k in rows]
        if groups and len(groups[0][1]) < len(scan.y):
            report.blank(scan.channel.dof)
        judged = []
        for model, rows in groups:
            names: list[Any] = [decisions[k][0] for k in rows]
            l, estimator = known.means(names), self.estimator.for_fixes()
            if scan.channel.far is not None:
                slots = np.full(len(rows), scan.robot)
                if (near := tags.approach(scan, model.exactly, slots, rows, l)) is not None:
                    estimator.correct(self.map, near)
            done = self._corrected(scan.known_update(model, l, rows), scan.event, estimator)
            done = done._replace(e=done.e[:, :m])
            report.fill(rows, done)
            known.count(names, done.fused.tolist())
            judged.append(Judged(rows, scan.ids, names, done, scan.channel.gate))
        return judged

    def _average(self, scan: ScanContext, decisions: Sequence[Decision]) -> list[Observation]:
        """Correct by the mean over the matchings among the decisions.  [F]."""
        found = average(scan, decisions)
        if found is None:
            return []
        assert isinstance(self.estimator, Averaging)
        d2, valid = self.estimator.average(self.map, found.update, found.pairs, found.weights)
        if not valid:
            self._refuse_lost(scan.event)
            rows = [k for k in found.rows.tolist() if isinstance(decisions[k][0], Mixture)]
            return [Observation(k, None, "rejected", None, None, INDEFINITE) for k in rows]
        of_these = outcomes(found, decisions, d2)
        self.tracks.count([o.landmark for o in of_these], [o.outcome == "associated" for o in of_these])
        return of_these

    def _corrected(self, update: Update, event: Event, estimator: Estimator | None = None) -> Correction:
        """Correct the map.  Raises DivergedError if the robot is lost for good."""
        done = (estimator or self.estimator).correct(self.map, update)
        if not done.valid:
            self._refuse_lost(event)
        return done

    def _refuse_lost(self, event: Event) -> None:
        """Raise DivergedError if the covariance of an event's robot is none: no measurement can bring it back."""
        fault = fault_of(self.map.covariance([self._moving[event.robot].slot]))
        if fault:
            raise DivergedError(f"{when(event)}: the covariance of {event.robot!r} {fault}; {CURE}")

    # ------------------------------------------------------------------ new landmarks
    def _start(
        self, scan: ScanContext, policy: Policy, known: list[int], decisions: Sequence[Decision],
        seen: dict[int, Observation],
    ) -> None:  # fmt: skip
        """Decide what becomes of the observations of no landmark: tentative, pending, new, or left alone."""
        new = [k for k in range(len(decisions)) if k not in seen]
        confirmed = self._compare_tentative(scan, policy, new, decisions, seen)
        left = [k for k in new if k not in seen and k not in confirmed]
        for o in self._start_delayed(scan, policy, left, decisions):
            seen[o.index] = o
        if confirmed:
            by_name = [confirmed.get(k, (None, "")) for k in range(len(decisions))]
            groups = self.tracks.by_model(scan.channel, [name for name, _ in by_name], scan.event.robot)
            judged, found = self._correct(scan, policy, groups, by_name)
            for o in found + [o for group in judged for o in outcomes_of(group)]:
                seen[o.index] = o._replace(outcome="new", reason=by_name[o.index][1])
        new = [k for k in new if k not in seen]
        reasons = left_out(scan, policy.attention, policy.starts, new, known, decisions)
        for k in new:
            name, reason = (decisions[k][0], decisions[k][1]) if k not in reasons else (None, reasons[k])
            seen[k] = self._initialize(scan, policy, k, name, reason)

    def _initialize(self, scan: ScanContext, policy: Policy, k: int, name: Any, reason: str) -> Observation:
        """Add a landmark, if its measurement determines it."""
        try:
            return self._initialized(scan, policy, k, name, reason)
        except np.linalg.LinAlgError:
            return Observation(k, scan.ids[k], "ignored", None, None, SINGULAR)

    def _initialized(self, scan: ScanContext, policy: Policy, k: int, name: Any, reason: str) -> Observation:
        """Add a landmark: L = g(R, S, y), P_LL = G_r P G_r' + G_y R G_y'.  [S] (32)-(38)."""
        channel, id_ = scan.channel, scan.ids[k]
        refusal = self._refusal(scan, policy, k, name, reason)
        if refusal is not None:
            return refusal
        if policy.deferred is not None and not isinstance(name, Answer):
            return self._defer(scan, policy.deferred, k, name)
        start, space = scan.start_of(k), channel.landmark.space
        if start.mean.shape != (space.size,):
            found = f"it finds {len(start.mean)} numbers, a {channel.landmark.kind} has {space.size}"
            return Observation(k, id_, "ignored", None, None, found)
        if not start.is_finite:
            return Observation(k, id_, "ignored", None, None, UNEXPLAINED)
        held = name is DEFERRED
        tentative = held or (name in (NEW, REMAP) and policy.upkeep.confirm > 1)
        name = self.tracks.new_name() if isinstance(name, Answer) else name
        try:
            track = Track(name, channel.landmark, self._add(start), size_m=scan.size_of(k))
        except MapError as full:
            return Observation(k, id_, "ignored", None, None, str(full))
        if channel.joins:
            track.extent = walls.first_extent(scan, track, k)
        if not tentative:
            self.tracks.confirm(track)
            return Observation(k, id_, "new", name, None, reason)
        track.status, self.tracks.tentative[name] = Status.TENTATIVE, track
        if policy.upkeep.keep_poses:
            track.first = scan.event.t_ns, *scan.key, k
        if held:
            return Observation(k, None, "deferred", name, None, reason)
        why = f"first sighting: {reason}" if reason else "first sighting"
        return Observation(k, None, "tentative", name, None, why)

    def _refusal(self, scan: ScanContext, policy: Policy, k: int, name: Any, reason: str) -> Observation | None:
        """Return what becomes of an observation that can start no landmark, None of one that can."""
        id_, sensor = scan.ids[k], type(scan.channel.sensor).__name__
        if name is None or isinstance(name, Mixture):
            return Observation(k, id_, "ignored", None, None, reason)
        if name in (DEFERRED, REMAP) and name not in policy.starts:
            return Observation(k, id_, "deferred", None, None, reason)
        if name == scan.event.robot:
            return Observation(k, id_, "ignored", None, None, "a robot does not see itself")
        self.tracks.reserve([id_])
        if name in self.tracks.slots or name in self.tracks.known:
            return Observation(k, id_, "rejected", name, None, f"it is no {scan.channel.landmark.kind}")
        if policy.deferred is None and not scan.channel.starts_landmarks:
            return Observation(k, id_, "ignored", None, None, f"a {sensor} measurement alone cannot start a landmark")
        if not isinstance(name, Answer) or policy.deferred is None:
            return None
        if not scan.channel.is_ambiguous:
            why = f"a {sensor} measurement without an id cannot start a landmark"
            return Observation(k, id_, "ignored", None, None, why)
        return None if tags.is_clear(scan, k) else Observation(k, id_, "deferred", None, None, tags.MIRRORED)

    # ------------------------------------------------------------------ pending landmarks
    def _defer(self, scan: ScanContext, way: Initialization, k: int, name: Id) -> Observation:
        """Take a measurement that alone does not determine a landmark; start the landmark if all of them do."""
        track = self.tracks.pending.get(name)
        track = track or Track(name, scan.channel.landmark, status=Status.PENDING, pending=Pending(scan.key, name))
        try:
            step = way.observe(scan, k, track.pending or Pending(scan.key, name))
            if step.start is not None and not step.start.is_finite:
                step = Step("ignored", UNEXPLAINED)
            self._take(scan, k, track, step)
            if not step.reason and step.start is None:
                assert track.pending is not None
                step = way.solve(scan, track.pending)
                self._take(scan, k, track, step)
        except MapError as full:
            return Observation(k, scan.ids[k], "ignored", None, None, str(full))
        return Observation(k, scan.ids[k], step.outcome, name if step.start else None, None, step.reason)

    def _take(self, scan: ScanContext, k: int, track: Track, step: Step) -> None:
        """Do what a step of an initialiser asks for.  Raises MapError where the map is full."""
        pending = step.pending or track.pending
        assert pending is not None
        for correction in step.corrections:
            self.map.predict(self._rows(correction.parts), correction.F, correction.Q)
            self.map.set_predicted(correction.slot, correction.mean)
        if step.added:
            pending = replace(pending, hypotheses=tuple(self._add_all(step.added)))
        if step.keep:
            pending = replace(
                pending,
                measurements=(*pending.measurements, scan.measurement(k, self._clone(scan.key, scan.event.t_ns))),
            )
        if step.start is not None:
            track.slot, track.size_m = self._add(step.start), scan.size_of(k)
            track.pending = None
            self.tracks.pending.pop(track.id, None)
            self.tracks.confirm(track, step.measurements)
        elif step.outcome != "ignored":
            track.pending, self.tracks.pending[track.id] = pending, track
        for slot in step.removed:
            self.map.remove(slot)
        self._release(scan.key)

    def _start_delayed(
        self, scan: ScanContext, policy: Policy, new: list[int], decisions: Sequence[Decision]
    ) -> list[Observation]:
        """Keep measurements of no landmark as pending; start the landmarks that enough of them determine.  [T] 2."""
        names = {k: decisions[k][0] for k in new}
        ids: dict[int, Id | None] = {k: None for k, n in names.items() if n is NEW}
        ids |= {k: n for k, n in names.items() if isinstance(n, int | str) and not self._is_there(n)}
        ids, way, key = {k: ids[k] for k in new if k in ids}, policy.delayed, scan.key
        if way is None or not ids:
            return []
        held = self.clones.of(key)
        if not delayed.has_moved(scan, held[-1] if held else None, way):
            return [Observation(k, i, "deferred", None, None, "until the robot has moved on") for k, i in ids.items()]
        try:
            clone = self._clone(scan.key, scan.event.t_ns)
        except MapError as full:
            return [Observation(k, i, "ignored", None, None, str(full)) for k, i in ids.items()]
        made = {k: scan.measurement(k, clone) for k in ids}
        try:
            candidates, best = delayed.joined(scan, way, self.tracks.candidates.get(key, []), made, ids)
        except np.linalg.LinAlgError:
            self._release(key)
            return [Observation(k, i, "ignored", None, None, SINGULAR) for k, i in ids.items()]
        found = []
        for k, i in ids.items():
            try:
                outcome, name = delayed.started(scan, way, candidates, best[k]), None
            except np.linalg.LinAlgError:
                found.append(Observation(k, i, "deferred", None, None, SINGULAR))
                continue
            candidates, reason = outcome.candidates, outcome.reason
            if outcome.start is not None and outcome.used is not None:
                try:
                    slot = self._add(outcome.start)
                except MapError as full:
                    reason = str(full)
                else:
                    name = self.tracks.new_name() if best[k].name is None else best[k].name
                    assert name is not None
                    self.tracks.confirm(Track(name, scan.channel.landmark, slot), len(outcome.used.measurements))
                    candidates = delayed.unexplained(scan, candidates, outcome.used, slot)
            found.append(Observation(k, i, "deferred" if name is None else "new", name, None, reason))
        for number in self.clones.of(key)[: -way.poses]:
            candidates = delayed.without_clone(scan, candidates, number)
        self.tracks.candidates[key] = candidates
        self._release(key)
        return found

    # ------------------------------------------------------------------ tentative landmarks
    def _compare_tentative(
        self, scan: ScanContext, policy: Policy, new: list[int], decisions: Sequence[Decision],
        seen: dict[int, Observation],
    ) -> dict[int, tuple[Id, str]]:  # fmt: skip
        """Count the observations of tentative landmarks; return those that confirm one, which is one from here on."""
        self.tracks.rename_tentative(scan.event.ids or ())
        rows = [k for k in new if decisions[k][0] in policy.starts]
        lost = np.array([decisions[k][0] is REMAP for k in rows], dtype=np.bool_)
        try:
            matches, others = confirm.matched(scan, policy.association, rows, lost)
        except np.linalg.LinAlgError:
            seen |= {k: Observation(k, None, "ignored", None, None, SINGULAR) for k in rows}
            return {}
        seen |= {o.index: o for o in others}
        confirmed: dict[int, tuple[Id, str]] = {}
        waiting: dict[int, Track] = {}
        for match in matches:
            track, u = self.tracks.tentative[match.name], policy.upkeep
            track.hits, track.chances, track.unseen = track.hits + 1, track.chances + 1, -1
            if scan.channel.joins:
                track.extent = walls.grown(scan, [track], [match.k])[0]
            if u.confirms(track.hits):
                confirmed[match.k] = match.name, f"confirmed: seen in {track.hits} of {track.chances} scans"
                self._confirm(scan, track)
                continue
            why = f"seen in {track.hits} of {track.chances} scans, {u.confirm} of {u.within} make a landmark"
            seen[match.k] = Observation(match.k, None, "tentative", match.name, match.d2, why)
            waiting[match.k] = track
        if waiting and policy.keep_poses:
            self._keep(scan, policy.keep_poses, waiting)
        return confirmed

    def _confirm(self, scan: ScanContext, track: Track) -> None:
        """Make a landmark of a tentative track, and fuse the measurements that were kept of it from their clones.

        What each expects less what it measured, e - y, becomes a block of the map, which is observed to be zero.
        """
        del self.tracks.tentative[track.id]
        self.tracks.confirm(track)
        late: list[Late] = [] if track.first is None else [track.first]
        for m in track.measurements:
            channel, clone = self._channels[m.robot, m.sensor], self.clones[m.clone]
            try:
                start, R = confirm.residual(self.map, self.estimator, channel, clone, track, m)
                slot = self._add(start)
            except np.linalg.LinAlgError:
                continue
            except MapError:  # it is full
                break
            p, gate = len(R), scan.channel.gate
            model = merge.ZeroDifference(scan.channel.at, p)
            update = Update(model, scan.robot, -1, np.array([slot]), p, np.zeros((1, p)), R[None], gate)
            done = self._corrected(update, scan.event)
            self.map.remove(slot)
            if done.fused[0]:
                track.observations += 1
                late.append(m.late)
        track.measurements = []
        scan.report.late += tuple(late)

    def _keep(self, scan: ScanContext, most: int, waiting: dict[int, Track]) -> None:
        """Keep observations of tentative tracks with a clone of the pose, of this channel the last `most`."""
        held = self.clones.of(scan.key)
        gone = set(held[: max(len(held) - most + 1, 0)])
        for track in self.tracks.tentative.values() if gone else ():
            mine = [m for m in track.measurements if m.clone not in gone or (m.robot, m.sensor) != scan.key]
            track.measurements = mine
        self._release(scan.key)
        try:
            clone = self._clone(scan.key, scan.event.t_ns)
        except MapError:  # it is full: these measurements are lost
            return
        for k, track in waiting.items():
            track.measurements.append(scan.measurement(k, clone))

    def _drop_tentative(self, scan: ScanContext, policy: Policy) -> None:
        """Count the tentative landmarks in view that this scan did not show; drop those that cannot be confirmed."""
        tentative, u = self.tracks.tentative, policy.upkeep
        mine = [name for name, track in tentative.items() if track.model.kind in scan.channel.models]
        for name in mine:
            tentative[name].unseen += 1
        missed = [name for name in mine if tentative[name].unseen]
        for name in confirm.in_view(scan, missed):
            tentative[name].chances += 1
        for name in missed:
            track = tentative[name]
            if u.hopeless(track.hits, track.chances) or track.unseen > confirm.OUT_OF_VIEW * u.within:
                why = f"tentative: seen in {track.hits} of {track.chances} scans"
                scan.report.removed += ((name, why),)
                self.map.remove(track.slot)
                del tentative[name]

    # ------------------------------------------------------------------ blocks and clones
    def _rows(self, parts: Parts) -> Index:
        """Return the rows of some blocks, of each the first so many."""
        for slot, _ in parts[:-1]:
            self.map.index(slot)  # to activate a block may move those that are active
        return np.concatenate([self.map.index(slot)[:count] for slot, count in parts])

    def _add(self, start: Start) -> int:
        """Add a block computed from others; return its slot.  Raises MapError where the map is full.  [S] (35)-(38)."""
        return self.map.augment(start.space, start.mean, self._rows(start.parts), start.G, start.Q)

    def _add_all(self, starts: Iterable[Start]) -> list[int]:
        """Add blocks, all or none of them; return their slots.  Raises MapError where the map is full."""
        slots: list[int] = []
        try:
            for start in starts:
                slots.append(self._add(start))
        except MapError:
            for slot in slots:
                self.map.remove(slot)
            raise
        return slots

    def _clone(self, key: ChannelKey, t_ns: int) -> int:
        """Clone the pose of a channel's robot; return the clone's number.  Raises MapError where the map is full."""
        number = self.clones.now(key[0], t_ns)
        if number is None:
            robot, space = self._moving[key[0]].slot, SE2 if self.robots[key[0]].motion.space.axes == 1 else SE3
            mean, index, dof = self.map.mean(robot)[: space.size], self.map.index(robot)[: space.dof], space.dof
            slot = self.map.augment(space, mean, index, np.eye(dof), np.zeros((dof, dof)))
            number = self.clones.enter(slot, key[0], t_ns)
        self.clones.clones[number].users.add(key)
        return number

    def _release(self, key: ChannelKey) -> None:
        """Remove the clones that no measurement of a channel needs any more; a delayed start needs the last one."""
        used = {m.clone for track in self.tracks.tentative.values() for m in track.measurements
                if (m.robot, m.sensor) == key}  # fmt: skip
        used |= {m.clone for pending in self.tracks.waiting() if pending.channel == key for m in pending.measurements}
        if key in self._readers or self._policies[key].delayed is not None:
            used.update(self.clones.of(key)[-1:])
        for slot in self.clones.refer(key, used):
            self.map.remove(slot)

    # ------------------------------------------------------------------ map management
    def _review(self, scan: ScanContext, policy: Policy, seen: Sequence[Observation]) -> None:
        """Simplify and extend the landmarks of a scan, and give up those that are expected and not found.  [TB] 4.4."""
        fused = [(o, self.tracks.confirmed[o.landmark]) for o in seen
                 if o.outcome == "associated" and o.landmark in self.tracks.confirmed]  # fmt: skip
        simplifies = self.reparametrize is not None and not scan.channel.joins
        for _, track in fused if simplifies else ():
            point = None
            with suppress(np.linalg.LinAlgError):
                point = reparametrize.simplified(scan, track, self.reparametrize)  # type: ignore[arg-type]
            if point is not None:
                try:
                    slot = self._add(point.start)
                except MapError:  # it is full: they stay what they are
                    break
                old = track.slot
                self.tracks.replace(track, slot, point.model)
                self.map.remove(old)
        if scan.channel.joins:
            mine = [track for _, track in fused]
            for track, extent in zip(mine, walls.grown(scan, mine, [o.index for o, _ in fused]), strict=True):
                track.extent = extent
        for o, track in fused if not scan.channel.joins else ():
            if track.extent is not None and isinstance(track.model, Segmented) and track.model.extend:
                with suppress(np.linalg.LinAlgError):
                    track.extent = reparametrize.extent(scan, track, scan.y[o.index])
        if policy.attention.delete:
            self._give_up(scan, policy, {o.landmark: o.outcome for o in seen})

    def _give_up(self, scan: ScanContext, policy: Policy, found: dict[Id | None, str]) -> None:
        """Count the landmarks in view and those observed; remove the ones too seldom found, each with its reason."""
        names = self.tracks.observable(scan.channel)
        for model, rows in self.tracks.by_model(scan.channel, names):
            tracks = [self.tracks.confirmed[names[i]] for i in rows]
            slots, extents = [track.slot for track in tracks], [track.extent for track in tracks]
            for i in scan.channel.in_view(self.map, scan.robot, model, slots, extents).tolist():
                track = tracks[i]
                if found.get(track.id) == "ignored":
                    continue
                track.searched, track.found = track.searched + 1, track.found + (track.id in found)
                reason = policy.attention.hopeless(track.searched, track.found, track.observations)
                if reason:
                    self.remove(track.id)
                    scan.report.removed += ((track.id, reason),)

    def _maintain(self, scan: ScanContext, policy: Policy) -> None:
        """Map management after a scan: landmarks that are gone, that are one, tentative ones without hope."""
        report, ids = scan.report, scan.event.ids
        for judgement in existence.judged(scan, policy.upkeep) if policy.upkeep.p_detect is not None else ():
            track = self.tracks.confirmed[judgement.name]
            track.log_odds, track.missed = judgement.log_odds, judgement.missed
            if judgement.gone:
                self.remove(track.id)
                why = f"should be in view and was not seen, {judgement.missed} scans in a row"
                report.removed += ((track.id, why),)
        if ids is None or None in ids:
            self._merge(scan, policy)
            if policy.upkeep.repeats != "off" and of_map.is_due(self.tracks):
                self._search_repeats(scan, policy)
        if self.tracks.tentative:
            self._drop_tentative(scan, policy)
        for key in self.clones.users() if self.clones.clones else ():
            self._release(key)
        self._let_grow()

    def _merge(self, scan: ScanContext, policy: Policy) -> None:
        """Merge landmarks that are one; report each that is gone, the one it is now, and why."""
        seen: list[Any] = [o.landmark for o in scan.report.observations if o.outcome in ("associated", "new")]
        names = [name for name in seen if name in self.tracks.confirmed]
        self.tracks.note_scan(names)
        if not policy.upkeep.merge:
            return
        unnamed: list[Any] = [o.landmark for o in scan.report.observations if o.id is None]
        search = merge.Search(self.tracks, [name for name in unnamed if name in names])
        while (name := search.next()) is not None:
            track = self.tracks.confirmed[name]
            if search.is_first_pass:
                track.compared = track.observations, self.tracks.changes
            found = None
            with suppress(np.linalg.LinAlgError):
                found = merge.proposal(self.map, self.tracks, name, scan.robot, scan.pose(), policy.upkeep.odds)
            for gone, kept, why in self._merge_pairs(scan, found) if found else ():
                search.was_merged(kept)
                scan.report.merged += ((gone, kept, why),)
        if scan.channel.joins:
            self._join(scan, names, policy.upkeep.odds)

    def _join(self, scan: ScanContext, names: Sequence[Id], odds: float) -> None:
        """Merge walls of which segments join, of those observed and others."""
        while (found := walls.agreeing(self.map, self.tracks, scan.channel, names, odds)) is not None:
            merged = self._merge_pairs(scan, found)
            scan.report.merged += tuple(merged)
            if not merged:  # the map is full
                break

    def _merge_pairs(self, scan: ScanContext, found: merge.Merge) -> list[tuple[Id, Id, str]]:
        """Constrain pairs of landmarks to be equal, through the estimator, and remove one of each.

        In a full map nothing is merged, nor where their difference has no covariance.
        """
        try:
            starts = [self._difference(pair) for pair in found.pairs]
            slots = self._add_all(starts)
        except MapError:
            return []
        n, count = starts[0].space.size, len(slots)
        model, R = merge.ZeroDifference(scan.channel.at, n), np.tile(merge.EQUAL_M**2 * np.eye(n), (count, 1, 1))
        update = Update(model, scan.robot, scan.channel.mount, np.array(slots), n, np.zeros((count, n)), R)
        done, merged = self.estimator.correct(self.map, update), []
        others = f", with {count - 1} others" if count > 1 else ""
        ordered = merge.order(self.tracks, found.pairs)
        for slot, (kept, gone), d2, fused in zip(slots, ordered, done.d2.tolist(), done.fused.tolist(), strict=True):
            self.map.remove(slot)
            if not fused:
                continue
            one, other = self.tracks.confirmed[kept], self.tracks.confirmed[gone]
            if isinstance(one.model, Joining):
                one.extent = walls.united(self.map, one, other)
            self.tracks.merge(one, other)
            self.remove(gone)
            why = f"merged into {kept!r}: d2 {d2:.1f}, e^{found.ratio:.0f} times likelier than chance{others}"
            merged.append((gone, kept, why))
        return merged

    def _difference(self, pair: tuple[Id, Id]) -> Start:
        """Return the difference of two landmarks as a block, to be observed as zero."""
        of_walls = isinstance(self.tracks.confirmed[pair[0]].model, Joining)
        return (walls if of_walls else merge).difference(self.map, self.tracks, pair)

    def _search_repeats(self, scan: ScanContext, policy: Policy) -> None:
        """Search the map for parts that are one; merge those beyond doubt, where that is wanted, and report the others.

        One is merged at a time: it changes the map.
        """
        self.tracks.searched = self.tracks.changes
        found: list[Repeat] = []
        with suppress(np.linalg.LinAlgError):
            found = of_map.repeats(self.map, self.tracks)
        for repeat in found:
            if policy.upkeep.repeats == "merge" and repeat.sure and (repeat.agrees or self._displace(scan, repeat)):
                merged = self._merge_pairs(scan, merge.Merge(repeat.pairs, repeat.score))
                scan.report.merged += tuple((gone, kept, f"{why}, {of_map.IN_A_REPEAT}") for gone, kept, why in merged)
                found = [other for other in found if other is not repeat]
                break
        scan.report.repeats = tuple(found)

    def _displace(self, scan: ScanContext, repeat: Repeat) -> bool:
        """Move the newer part of a repeat, of an error that is unknown until now, onto the older one.

        It has the robot and all that it has not finished if it is there.  Not with several robots, nor where blocks
        of the map may belong to either part.
        """
        inside = of_map.is_in(repeat.newer, self.tracks)
        if len(self.robots) > 1 or inside is None or self.tracks.pending:
            return False
        slots = [self.tracks.slot(name) for name in repeat.newer]
        if inside:
            slots += [scan.robot, *(track.slot for track in self.tracks.tentative.values())]
            slots += [clone.slot for clone in self.clones.clones.values()]
        try:
            moved = of_map.displacement(self.map, slots, repeat)
        except np.linalg.LinAlgError:
            return False
        rows = self._rows(tuple((slot, len(self.map.rows(slot))) for slot in slots))
        self.map.predict(rows, moved.F, moved.Q)
        for slot, mean in zip(moved.slots, moved.means, strict=True):
            self.map.set_predicted(slot, mean)
        return True

    def _let_grow(self) -> None:
        """Compress the map from so many landmarks on that it pays; not where matchings are averaged."""
        if self._may_grow and len(self.tracks.confirmed) > DENSE:
            self.map = grown(self.map, (track.model.space for track in self.tracks.confirmed.values()), self.numbers)

    # ------------------------------------------------------------------ reading and editing the map
    def _is_there(self, name: Id) -> bool:
        """Return whether a name is that of a block, or of a landmark known exactly."""
        return name in self.tracks.slots or name in self.tracks.known

    def is_known(self, name: Id) -> bool:
        """Return whether a landmark is known exactly: it is outside the map, and no scan moves it."""
        return name in self.tracks.known

    def mean(self, name: Id) -> Array:
        """Return the mean (size,) of a landmark or robot: x, y, heading in m and rad, or x, y, z, qx, qy, qz, qw."""
        known = self.tracks.known
        return known.mean(name) if name in known else self.map.mean(self.slot(name))

    def covariance(self, *names: Id) -> Array:
        """Return the joint covariance (n, n) of robots and landmarks, in the given order, in standard coordinates."""
        if not names:
            raise MapError("covariance of nothing was asked for, expected names of robots or landmarks")
        known = self.tracks.known
        slots = [self.slot(name) for name in names if name not in known]
        P = self.map.covariance(slots) if slots else np.zeros((0, 0))
        if len(slots) == len(names):
            return P
        dofs = [known.model(name).space.dof if name in known else -1 for name in names]
        sizes = [len(self.map.rows(self.slot(name))) if d < 0 else d for name, d in zip(names, dofs, strict=True)]
        rows = np.flatnonzero(np.repeat(np.array(dofs) < 0, sizes))
        out = np.zeros((sum(sizes), sum(sizes)))
        out[np.ix_(rows, rows)] = P
        return out

    def landmarks(self, *, exactly_known: bool = True) -> LandmarkTable:
        """Return ids, kinds, means, covariances and numbers of observations of all landmarks.

        Those known exactly, outside the map, come last and have the covariance 0; or without them.
        """
        tracks = self.tracks.confirmed.values()
        kinds, counts = [track.model.kind for track in tracks], [track.observations for track in tracks]
        means, covs = [self.mean(track.id) for track in tracks], [self.covariance(track.id) for track in tracks]
        names, known = [track.id for track in tracks], self.tracks.known
        for name in known if exactly_known else ():
            space = known.model(name).space
            names.append(name)
            kinds.append(known.model(name).kind)
            means.append(known.mean(name))
            covs.append(np.zeros((space.dof, space.dof)))
            counts.append(known.observations(name))
        return LandmarkTable(names, kinds, means, covs, counts)

    def expect(
        self, robot: str, sensor: str, names: Iterable[Id] | None = None, *, in_view: bool = False
    ) -> Expectations:  # fmt: skip
        """Return what a sensor should measure of landmarks, by default of all, from where its robot is.

        In view or not and why, expectations, their covariances and Jacobians, as a correction would have them; with
        `in_view` of those in view alone.  Robots may be among the `names`.  A robot that lags is where it was (`lags`).
        Nothing changes.  Raises MapError.
        """
        if (robot, sensor) in self._readers:
            raise MapError(f"sensor {sensor!r} of {robot!r} measures its robot, expected one of landmarks")
        if (robot, sensor) not in self._channels:
            known = ", ".join(f"{r!r} {s!r}" for r, s in self._channels) or "none"
            raise MapError(f"robot {robot!r} has no sensor {sensor!r}, expected one of: {known}")
        chosen = None if names is None else [*names]
        for name in chosen or ():
            if not self.is_known(name):
                self.slot(name)
            if self.tracks.sort(name) is None:
                raise MapError(f"{name!r} is a sensor's mount or a control's bias, expected a landmark or a robot")
        return expectations(self.map, self.tracks, self._channels[robot, sensor], robot, sensor, chosen, in_view)

    def slot(self, name: Id) -> int:
        """Return the slot of a robot or landmark in `map`."""
        return self.tracks.slot(name)

    def reserve(self, ids: Iterable[Id | None]) -> None:
        """Keep in mind ids that a log will use, so that no landmark without an id is named like one of them."""
        tracks = self.tracks
        tracks.reserve(i for i in ids if i not in tracks.confirmed and i not in tracks.tentative)

    def place(self, name: Id) -> tuple[Array, Array]:
        """Return where a robot or a landmark is: mean (2 or 3,) and covariance, m and m^2, in the map's frame.

        A landmark's model says where it is (`Placed`); of a line it is its point nearest to the anchor or the origin.
        Raises MapError for a landmark whose model does not say where it is.
        """
        mean, P, model = self.mean(name), self.covariance(name), self.landmark_model(name)
        if model is None:
            d = 2 if next(iter(self.robots.values())).motion.space.axes == 1 else 3
            return mean[:d], P[:d, :d]
        placed = place_of(model, mean[None])
        if placed is None:
            raise MapError(f"{name!r} is a {model.kind}, which does not say where it is, expected a model with place()")
        (p,), (P_l,) = placed
        return p, P_l @ P @ P_l.T

    def lags(self, robot: str) -> bool:
        """Return whether a robot is still where it was before the last event: nothing has asked for it yet."""
        return self._moving[robot].held.lags(self.t_ns or 0)

    def landmark_model(self, name: Id) -> Landmark | None:
        """Return the model of a landmark, None of what is no landmark of the map."""
        track = self.tracks.confirmed.get(name)
        if track is None and name in self.tracks.known:
            return self.tracks.known.model(name)
        return None if track is None else track.model

    def segment(self, name: Id) -> tuple[Array, Array]:
        """Return the ends (2, 3) of the segment observed of a line so far, and their covariances (2, 3, 3)."""
        model, extent = self.landmark_model(name), self.segment_ends(name)
        if extent is None or not isinstance(model, Segmented):
            raise MapError(f"{name!r} is no line of the map, expected one with ends")
        p, P_l = model.endpoints(self.mean(name)[None], extent[None])
        return p[0], P_l[0] @ self.covariance(name) @ P_l[0].swapaxes(1, 2)

    def segment_ends(self, name: Id) -> Array | None:
        """Return the extent of the segment observed so far as abscissas (2,) on its line; None of what is no line."""
        track = self.tracks.confirmed.get(name)
        if track is None and name in self.tracks.known:
            return self.tracks.known.extent(name)
        return None if track is None else track.extent

    def add_landmark(self, name: Id, mean: Any, cov: Any = None, landmark: Landmark | None = None) -> None:
        """Add a landmark known beforehand, by survey: exactly (`cov` None) or with a covariance.

        What is known exactly stays outside the map: no step depends on how many there are (docs/localization.md).
        """
        name = checked_id(name, "landmark")
        if landmark is not None:
            instance(landmark, Landmark, f"landmark {name!r}", "a landmark model")
        default = next((channel.landmark for channel in self._channels.values()), Point2D())
        model = landmark or reparametrize.surveyed(default, mean)
        refuse_other_world(self.robots, model.kind, model.space.world)
        if self._is_there(name) or name in self._inner:
            what = "names a robot's bias or mount" if name in self._inner else "is in the map already"
            raise MapError(f"landmark {name!r} {what}, expected a new id")
        mean = numbers(mean, model.space.size, f"landmark {name!r}: mean", MapError)
        if cov is not None:
            cov = covariance(cov, model.space.dof, f"landmark {name!r}: cov", definite=False, error=MapError)
        self.tracks.reserve([name])
        if cov is None and not any(policy.averages for policy in self._policies.values()):
            self.tracks.rename_tentative([name])
            self.tracks.known.add(name, model, mean)
            return
        self.tracks.enter(Track(name, model, self.map.add(model.space, mean, cov)))
        self._let_grow()

    def remove(self, name: Id) -> None:
        """Remove a landmark; its place goes to the next new one."""
        if name in self.tracks.known:
            self.tracks.known.remove(name)
            return
        slot = self.slot(name)
        if name not in self.tracks.confirmed:
            what = "robot" if name in self.robots else "sensor's mount or a control's bias"
            raise MapError(f"{name!r} is a {what}, expected a landmark")
        self.map.remove(slot)
        self.tracks.remove(name)

    # ------------------------------------------------------------------ before the first event
    def warm_up(self) -> None:
        """Compile and load all that the events of this Slam will need, so that none of them waits for it.

        Its state stays as it is: twins of it take made-up events, as `kalmark.slam.rehearsal` has them.
        """
        from kalmark.slam.rehearsal import rehearsal

        robots = [
            replace(robot, sensors={name: replace(mount, detector=None) for name, mount in robot.sensors.items()})
            for robot in self.robots.values()
        ]
        kinds = ("dense", "postponed") if self._may_grow else (self.map_type,)
        surveyed: list[tuple[Any, ...]] = []
        for kind, in_known_map in [*((kind, False) for kind in kinds), *[(kinds[0], True)] * bool(self.tracks.known)]:
            twin = Slam(
                robots, self.association, self.estimator, self.landmark_type, kind, self.reparametrize, self.numbers,
                self.upkeep,
            )  # fmt: skip
            for landmark in surveyed if in_known_map else ():
                twin.add_landmark(*landmark)
            for event in rehearsal(robots, twin._sensor_pose):
                with suppress(Exception):  # it only tries; what is wrong shows when it is done in earnest
                    twin.process(event)
            twin.covariance(*twin.robots, *twin.tracks.confirmed)
            surveyed = [(track.id, twin.mean(track.id), None, track.model) for track in twin.tracks.confirmed.values()]
            for track in twin.tracks.confirmed.values():
                if isinstance(track.model, Reparametrizable):
                    track.model.to_point(twin.mean(track.id)[None])
            for track in [*twin.tracks.confirmed.values()]:
                twin.map.remove(track.slot)
            if isinstance(twin.map, CompressedMap):
                twin.map.finish()

    def _sensor_pose(self, robot: str, sensor: str) -> Array:
        channel, slot = self._channels.get((robot, sensor)), self._moving[robot].slot
        return self.map.mean(slot) if channel is None else channel.pose(self.map, slot)

    # ------------------------------------------------------------------ files
    def save(self, path: str | Path) -> None:
        """Write the whole state to a file; `load` resumes bit for bit."""
        from kalmark.slam import state

        settings = state.settings(
            self.robots, self.association, self.estimator, self.landmark_type, self.upkeep, self.reparametrize,
            self.map_type, self.numbers,
        )  # fmt: skip
        events = state.State(self.t_ns, self.map, self.tracks, self.clones, self._moving, self._readers)
        state.save(Path(path), settings, events)

    @staticmethod
    def load(
        path: str | Path,
        robots: Iterable[Robot] | None = None,
        association: Association | None = None,
        estimator: Estimator | None = None,
        landmarks: Landmark | None = None,
    ) -> Slam:
        """Read a state written by `save`; what is not kalmark's own (a user's models) must be given again."""
        from kalmark.slam import state

        saved = state.load(Path(path), robots, association, estimator, landmarks)
        with saved.errors():
            slam = Slam(**saved.settings)
            of_channels = [channel.landmark for channel in slam._channels.values()]
            found = saved.state(slam.robots, slam._moving, slam._readers, of_channels)
        slam.t_ns, slam.map, slam.tracks, slam.clones = found.t_ns, found.map, found.tracks, found.clones
        carried: dict[ChannelKey, Channel | Reader] = {**slam._channels, **slam._readers}
        for key, channel in carried.items():
            channel.mount = slam.tracks.slots.get(mount_name(*key), -1)
        return slam

    @staticmethod
    def from_config(path: str | Path) -> Slam:
        """Build the Slam that a configuration (a path or a shipped name) describes."""
        return import_module("kalmark.config").slam_from_config(path)  # by name: configuration stands above
