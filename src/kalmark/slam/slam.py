"""EKF-SLAM: the page to read first.  Events come in by one door, `Slam.process`; [S] 2.4 is the loop it serves.

robot moves               -> moves        prediction          [S] (14)-(17)
known landmarks observed  -> correcting   correction          [S] (26)-(30)
new landmarks observed    -> starting     augmentation        [S] (32)-(38)
landmark is removed       -> State.remove reduction           [S] Table 1

`association` decides which landmark was observed, `management` what becomes of landmarks: both read a `ScanContext` and
return decisions and actions.  The modules of this package apply them, each one stage of the loop: they alone change a
`State`.  `locating` finds a robot that may be anywhere, `tentative` holds back what may be no landmark, `maintenance`
and `merging` follow the corrections, `state_corrections` are corrections by what is measured of the robot alone.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from kalmark.association import Association, ByIdentity
from kalmark.association.averaging import refuse_averaging
from kalmark.association.protocol import Decision
from kalmark.association.query import Query
from kalmark.association.ratio import defer_doubtful_pairs
from kalmark.errors import DivergedError, EventError, MapError, ModelError
from kalmark.events import (
    Control,
    Event,
    Fix,
    Id,
    Raw,
    Scan,
    checked_id,
    kind_of,
    label_of_event,
    list_names,
    seconds_text,
    unit_quaternion,
)
from kalmark.filter.estimators import CompilingEstimator, Estimator, Invariant
from kalmark.geometry.spaces import RHO, ROTATION
from kalmark.management import reparametrize as points
from kalmark.management.attention import reasons_against_start
from kalmark.management.upkeep import Upkeep
from kalmark.models.protocols import Landmark
from kalmark.report import Observation, Report, outcomes_of
from kalmark.slam import by_ids, locating, maintenance, moves, starting, state_corrections, tentative
from kalmark.slam.checks import (
    check_covariance,
    instance,
    measurements,
    refuse_bad_control,
    refuse_other_classes,
)
from kalmark.slam.checks import check_numbers as checked_numbers
from kalmark.slam.correcting import correct, correct_by_known
from kalmark.slam.estimate import Estimate
from kalmark.slam.factors import correct_by_blocks, correct_by_factor, factor_of
from kalmark.slam.held_readings import record_repeated_reading
from kalmark.slam.policy import Policy, refuse_other_world
from kalmark.slam.relocation_by_fixes import NEEDED
from kalmark.slam.robot import Robot, robots_given
from kalmark.slam.sources import BufferedScans, RawDetector, Source
from kalmark.slam.starting import SINGULAR
from kalmark.slam.state import CURE, Settings, State
from kalmark.tracks.scan import ScanContext
from kalmark.tracks.track import Track

IN_A_ROW = 10  # events that are all far ahead of the map: then it was a pause


class Slam(Estimate):
    """Robots (or one) and landmarks as one joint Gaussian, corrected event by event.

    `association` decides which landmark was observed, `estimator` how the map is corrected, `landmarks` (or a mount's
    own) what a landmark is.  A point of unknown depth becomes Euclidean where its linearity index falls below
    `reparametrize` (None: never).  `map` is "dense", "postponed" (the compressed map, docs/compressed.md), or "auto":
    dense while small; `numbers` ("float64", "float32") are those in which a compressed one keeps what is inactive.
    `upkeep` decides when an observation without an id becomes a landmark (docs/association.md).  Events must come in
    the order of their times, none more than `longest_pause_s` after the one before it: its stamp is wrong.  After 10
    such events in a row, none of them that far after the one before it, it was a pause.

    >>> rover = km.Robot("rover", km.motion.Unicycle(), sensors={"lidar": km.Mount(km.sensors.RangeBearing())})
    >>> slam = km.Slam(rover)
    >>> moved = slam.process(km.Control(t_s=0.0, robot="rover", u=(0.5, 0.02)))
    >>> report = slam.process(km.Scan(t_s=0.1, robot="rover", sensor="lidar", y=[[4.2, 0.3]], ids=[7]))
    >>> slam.mean("rover").round(3), slam.mean(7).round(2)
    (array([0.05 , 0.   , 0.002]), array([4.06, 1.25]))
    >>> slam.covariance("rover", 7).shape
    (5, 5)
    """

    from_config: ClassVar[Callable[[str | Path], Slam]]  # by `kalmark`: configuration stands above

    def __init__(
        self,
        robots: Iterable[Robot] | Robot,
        association: Association | None = None,
        estimator: Estimator | None = None,
        landmarks: Landmark | None = None,
        map: str = Settings.map,
        reparametrize: float | None = Settings.reparametrize,
        numbers: str = Settings.numbers,
        upkeep: Upkeep = Settings.upkeep,
        longest_pause_s: float = Settings.longest_pause_s,
    ) -> None:
        association = ByIdentity() if association is None else association
        estimator = Invariant() if estimator is None else estimator
        by_name: dict[str, Robot] = {}
        for robot in robots_given(robots):
            if robot.name in by_name:
                raise ModelError(f"robot {robot.name!r} is given twice, expected different names")
            by_name[robot.name] = robot
        chosen: Any = map, reparametrize, numbers, upkeep, longest_pause_s  # checked by `Settings`
        super().__init__(State(by_name, Settings(association, estimator, landmarks, *chosen)))
        self.before_scan: Callable[[str, str], object] | None = None  # called with robot and sensor, may call `expect`
        self._ahead: list[int] = []  # times of the events in a row that came too far ahead
        self._takes: dict[type, Any] = {Control: self._control, Scan: self._scan, Fix: self._fix}
        if isinstance(estimator, CompilingEstimator):
            kinds = [kind for channel in self.state.channels.values() for kind in channel.landmark.space.kinds]
            axes = max(robot.motion.space.axes for robot in by_name.values())
            estimator.compile_ahead(axes, RHO in kinds, self.state.map.dependent)

    def __repr__(self) -> str:
        state = self.state
        when_ = "before its first event" if state.t_ns is None else f"at t={seconds_text(state.t_ns)} s"
        size, said = len(state.tracks.confirmed) + len(state.tracks.known), type(state.estimator).__name__
        return (
            f"<Slam of {list_names(state.robots)} {when_}: {size} landmarks, {said}, {type(self.association).__name__}>"
        )

    # ------------------------------------------------------------------ events
    def process(self, event: Event) -> Report:
        """Take one event into the map and report what became of it; a bad event changes nothing.

        Raises EventError for an event that cannot be used, DivergedError when a robot is lost for good.
        """
        state, take = self.state, self._takes.get(type(event))
        if take is None and isinstance(event, Raw):
            take = self._raw
        if take is None:
            raise EventError(f"got {type(event).__name__}, expected a Control, a Scan, a Fix or raw data of a sensor")
        before = state.t_ns
        if before is not None and event.t_ns < before:
            raise EventError(f"{label_of_event(event)} comes after one at t={seconds_text(before)} s")
        if event.robot not in state.robots:
            names = sorted(state.robots)
            raise EventError(f"{label_of_event(event)}: robot is {event.robot!r}, expected one of {names}")
        if before is not None and event.t_ns - before > state.settings.longest_pause_s * 1e9:
            self._refuse_ahead(event, before)
        try:
            report: Report = take(event)
            if state.sources and take != self._raw:
                state.settle()
            if event.robot in state.standing:
                report.standing = state_corrections.correct_by_rest(state, event)
            if event.t_ns != before:
                self.state.taken, self._ahead = set(), []
            self.state.taken.add(kind_of(event))
            return report
        except EventError:
            state.t_ns = before
            raise
        except np.linalg.LinAlgError as error:
            state.refuse_lost(event)
            why = " ".join(str(error).split())
            raise DivergedError(f"{label_of_event(event)}: {why}; {CURE}") from error

    def _refuse_ahead(self, event: Event, before: int) -> None:
        """Refuse an event that comes longer after the last one than any pause lasts, but not the tenth in a row."""
        longest_s = self.state.settings.longest_pause_s
        if self._ahead and not 0 <= event.t_ns - self._ahead[-1] <= longest_s * 1e9:
            self._ahead = []
        self._ahead.append(event.t_ns)
        if len(self._ahead) < IN_A_ROW:
            raise EventError(
                f"{label_of_event(event)} comes {(event.t_ns - before) * 1e-9:.6g} s after one at "
                f"t={seconds_text(before)} s, expected at most {longest_s:g} s (longest_pause_s), "
                f"or {IN_A_ROW} such events in a row"
            )

    def has_taken(self, event: Event) -> bool:
        """Return whether an event of this kind, robot and sensor is in the map that is of the time of the map."""
        return event.t_ns == self.state.t_ns and kind_of(event) in self.state.taken

    def _control(self, event: Control) -> Report:
        state = self.state
        moving, report = state.moving[event.robot], Report(event)
        refuse_bad_control(event, moving.motion)
        state.t_ns = event.t_ns
        held = moving.held
        clock = held.snapshot()
        try:
            parts = held.accept(event)
            if len(parts) > 1:
                moves.refuse_nowhere(state, event.robot, parts)
            for part in parts:
                moves.move(state, event.robot, part)
        except EventError:
            held.put_back(clock)
            raise
        report.gaps = held.noticed()
        return report

    def _scan(self, event: Scan) -> Report:
        state = self.state
        key = event.robot, event.sensor
        policy = state.policies.get(key)
        if policy is not None and event.of is None:
            return self._found(event if policy.detector is None else policy.detector(event))
        if key in state.of_blocks:
            return correct_by_blocks(state, event, state.of_blocks[key])
        if event.of is not None:
            raise EventError(f"{label_of_event(event)}: of has names of blocks, expected those of a sensor of blocks")
        if key in state.readers:
            return state_corrections.correct_by_reading(state, event, state.readers[key])
        raise self._no_sensor(event)

    def _raw(self, event: Raw) -> Report:
        """Take what a detector, or the source of a sensor, finds in raw data."""
        policy = self.state.policies.get((event.robot, event.sensor))
        if policy is None:
            raise self._no_sensor(event)
        source, detector = self.state.sources.get((event.robot, event.sensor)), policy.detector
        if source is not None and isinstance(event, source.takes):
            return self._searched(event, source)
        if isinstance(detector, RawDetector) and isinstance(event, detector.takes):
            return self._found(detector.scan_of(event))
        kind = type(event).__name__.lower()
        raise EventError(f"{label_of_event(event)}: {event.sensor!r} has no detector for a {kind}, expected one")

    def _searched(self, event: Raw, source: Source) -> Report:
        """Search raw data for the landmarks that are expected in them.  [S] 2.4."""
        state, key = self.state, (event.robot, event.sensor)
        if source.waits and state.begins:
            return self._found(Scan(t_ns=event.t_ns, robot=event.robot, sensor=event.sensor))
        data = source.read(event)
        state.t_ns = event.t_ns
        gaps = moves.advance(state, event.robot)
        again = source.located(data, state.view(key))
        if again is not None:
            locating.relocate_robot(state, state.channels[key], event.robot, *again)
        scan, removed, drifted = source.found(event, data, state.view(key))
        if drifted is not None:
            locating.inflate_covariance(state, event.robot, *drifted)
        for name, _ in removed:
            state.remove(name)
        report = self._found(scan)
        report.gaps += gaps
        report.removed = (*removed, *report.removed)
        replay = source.update(report, state.view(key))
        if replay is not None:
            self._begin_again(source, replay)
        return report

    def _begin_again(self, source: Source, replay: BufferedScans) -> None:
        """Filter all scans of a source so far again, landmarks starting at the inverse distances that are known now."""
        again = Slam(self.robots.values(), **vars(self.state.settings))
        state, key, poses = again.state, (replay.scans[0][0].robot, replay.scans[0][0].sensor), []
        channel = state.channels[key]
        channel.rho = replay.rho
        for scan, removed in replay.scans:
            for name in removed:
                if name in state.tracks.confirmed:
                    state.remove(name)
            again._found(scan)
            poses.append(state.view(key).T)
        channel.rho = {}
        source.replace_poses(poses, state.tracks.confirmed.keys())
        state.sources = self.state.sources
        self.state = state

    def _no_sensor(self, event: Scan | Raw) -> EventError:
        """Return the error of an event whose robot has no such sensor of landmarks."""
        names = sorted(self.state.robots[event.robot].sensors)
        return EventError(f"{label_of_event(event)}: sensor is {event.sensor!r}, expected one of {names}")

    def _found(self, event: Scan) -> Report:
        """Take what was found of landmarks."""
        state = self.state
        key = event.robot, event.sensor
        channel, policy = state.channels[key], state.policies[key]
        if event.classes is not None and channel.classes is not None:
            refuse_other_classes(event, channel.classes)
        if (
            policy.by_ids
            and self.before_scan is None
            and (done := by_ids.correct_by_ids(state, event, channel, policy))
        ):
            return done
        if event.ids is not None and not state.inner.isdisjoint(event.ids):
            name = next(i for i in event.ids if i in state.inner)
            raise EventError(f"{label_of_event(event)}: id {name!r} names a robot's bias or mount, expected another")
        R = measurements(event, channel.sensor, channel.check)
        if policy.averages:
            refuse_averaging(state.map, state.estimator, event)
        state.t_ns = event.t_ns
        ids = event.ids or (None,) * len(event.y)
        seen = [i for i in ids if i in state.robots and i != event.robot] if len(state.robots) > 1 else []
        gaps = moves.advance(state, event.robot, *seen)
        moving, report = state.moving[event.robot], Report(event, event.y)
        report.gaps = gaps
        scan = ScanContext(
            state.map, state.tracks, state.clones, state.estimator, channel, moving.slot, event, ids, R, report
        )  # fmt: skip
        if len(event.y) and state.repeats(key, event.t_ns, event.y, event.ids):
            return record_repeated_reading(report, ids, channel.dof)
        why = state.look_back(key) if channel.sees_velocity or channel.lags else ""
        if self.before_scan is not None and not why:
            self.before_scan(event.robot, event.sensor)
        if why:
            report.blank(channel.dof)
            report.observations = tuple(Observation(k, i, "ignored", None, None, why) for k, i in enumerate(ids))
        elif len(event.y):
            self._fuse(scan, policy)
            if (gaps or moving.held.is_adrift) and any(o.outcome == "associated" for o in report.observations):
                moving.held.located(event.t_ns, locating.is_heading_known(scan))
        maintenance.maintain(state, scan, policy)
        if channel.counts:
            with suppress(MapError):  # it is full: the next scan is the first again
                state.clone(key, event.t_ns)
            state.release(key)
        return report

    def _fix(self, event: Fix) -> Report:
        return state_corrections.fix(self.state, event)

    # ------------------------------------------------------------------ scans
    def _fuse(self, scan: ScanContext, policy: Policy) -> None:
        """Correct by the known landmarks, then add the new ones.  [S] 2.4."""
        state = self.state
        query = Query(scan)
        located = locating.locate_in_known_map(state, scan, query)
        if located is not None and not located.is_placed:
            if not located.fates:
                scan.report.blank(scan.channel.dof)
            waits = [Observation(k, i, "deferred", None, None, located.why) for k, i in enumerate(scan.ids)]
            scan.report.observations = located.fates or waits
            return
        if located is None:
            decisions = locating.decide(state, scan, query, partial(self._decided, policy))
        else:
            query = Query(scan)
            decisions = self._decided(policy, query, located.decisions)
        state.tracks.count_reobserved(query.reobserved)
        names = [name for name, _ in decisions]
        groups = state.tracks.by_model(scan.channel, names, scan.event.robot)
        exact = correct_by_known(state, scan, policy, decisions) if state.tracks.known else []
        again = starting.take_open_rays(state, scan, groups, decisions) if policy.restarts else {}
        judged, found = correct(state, scan, policy, groups, decisions)
        judged = exact + judged
        if state.sums:
            locating.compare_hypotheses(state, scan, judged)
        if again:
            found = found + starting.restart(state, scan, again, decisions)
        if not found and not policy.reviews and sum(len(group.rows) for group in judged) == len(decisions):
            scan.report.judged = tuple(judged)
            return
        found += [o for group in judged for o in outcomes_of(group)]
        if policy.reviews:
            maintenance.review(state, scan, policy, found)
        if len(found) < len(decisions):
            seen = {o.index: o for o in found}
            used = [k for group in exact for k in group.rows] + [k for _, rows in groups for k in rows]
            self._initialize_landmarks(scan, policy, used, decisions, seen)
            found = list(seen.values())
        scan.report.observations = tuple(found)

    def _decided(self, policy: Policy, query: Query, given: list[Decision] | None = None) -> Sequence[Decision]:
        """Return the association's decisions, or those `given`; where its matrices are singular, only ids are used."""
        try:
            decisions = policy.association.associate(query) if given is None else given
            return defer_doubtful_pairs(query, decisions, policy.upkeep.odds) if policy.holds_back else decisions
        except np.linalg.LinAlgError:
            return [(None, SINGULAR) if i is None else (i, "") for i in query.ids]

    def _initialize_landmarks(
        self, scan: ScanContext, policy: Policy, known: list[int], decisions: Sequence[Decision],
        seen: dict[int, Observation],
    ) -> None:  # fmt: skip
        """Decide on the observations without a landmark: tentative, pending, new, or ignored."""
        state = self.state
        new = [k for k in range(len(decisions)) if k not in seen]
        confirmed = tentative.confirm_tentative(state, scan, policy, new, decisions, seen)
        left = [k for k in new if k not in seen and k not in confirmed]
        for o in starting.initialize_delayed(state, scan, policy, left, decisions):
            seen[o.index] = o
        if confirmed:
            by_name = [confirmed.get(k, (None, "")) for k in range(len(decisions))]
            groups = state.tracks.by_model(scan.channel, [name for name, _ in by_name], scan.event.robot)
            judged, found = correct(state, scan, policy, groups, by_name)
            for o in found + [o for group in judged for o in outcomes_of(group)]:
                seen[o.index] = o._replace(outcome="new", reason=by_name[o.index][1])
        new = [k for k in new if k not in seen]
        reasons = reasons_against_start(scan, policy.attention, policy.starts, new, known, decisions)
        for k in new:
            name, reason = (decisions[k][0], decisions[k][1]) if k not in reasons else (None, reasons[k])
            seen[k] = starting.initialize_landmark(state, scan, policy, k, name, reason)

    # ------------------------------------------------------------------ editing the map
    def prepare_for(self, events: Sequence[Event]) -> None:
        """Prepare for a log: reserve its ids, and note the scans that readings of an `odometer` with `keep` 0 refer to.

        No landmark without an id then gets one of these ids as its name, and only the clones of these scans are kept.
        """
        readers, scans = self.state.readers, [event for event in events if isinstance(event, Scan)]
        for key, reader in readers.items():
            reader.prepare_for(scan for scan in scans if (scan.robot, scan.sensor) == key)
        tracks, ids = self.tracks, (i for e in scans if (e.robot, e.sensor) not in readers for i in e.ids or ())
        tracks.reserve(i for i in ids if i not in tracks.confirmed and i not in tracks.tentative)

    def add_landmark(self, name: Id, mean: Any, cov: Any = None, landmark: Landmark | None = None) -> None:
        """Add a landmark known beforehand, by survey: exactly (`cov` None) or with a covariance.

        Without a `landmark` it is of the type that the first sensor starts, or a point where that has an unknown depth
        and where there is no sensor.  Landmarks known exactly stay outside the map: no step depends on how many there
        are (docs/localization.md).
        """
        state = self.state
        name = checked_id(name, "landmark")
        if landmark is not None:
            instance(landmark, Landmark, f"landmark {name!r}", "a landmark model")
        point = points.POINTS[next(iter(state.robots.values())).motion.space.world]
        default = next((channel.landmark for channel in state.channels.values()), point)
        model = landmark or points.surveyed_type(default, mean)
        refuse_other_world(state.robots, model.kind, model.space.world)
        if state.is_there(name) or name in state.inner:
            what = "names a robot's bias or mount" if name in state.inner else "is in the map already"
            raise MapError(f"landmark {name!r} {what}, expected a new id")
        mean = checked_numbers(mean, model.space.size, f"landmark {name!r}: mean", MapError)
        for kind, at, _ in model.space.atoms:
            if kind == ROTATION:
                mean[at : at + 4] = unit_quaternion(mean[at : at + 4], MapError, f"landmark {name!r}: ")
        if cov is not None:
            cov = check_covariance(cov, model.space.dof, f"landmark {name!r}: cov", definite=False, error=MapError)
        state.settle()
        for source in state.sources.values():
            source.survey(name)
        state.tracks.reserve([name])
        state.placed = NEEDED
        if cov is None and not any(policy.averages for policy in state.policies.values()):
            state.tracks.rename_tentative([name])
            state.tracks.known.add(name, model, mean)
            return
        slot = state.map.add(model.space, mean, cov)
        state.tracks.enter(Track(name, model, slot, entered=state.tracks.changes))
        state.surveys.trial[name] = 0
        state.let_grow()

    def fuse(
        self, names: Sequence[Id], expect: Callable[..., Any], y: Any, cov: Any, *, angular: Sequence[bool] = (),
        gate: float = 1.0,
    ) -> Observation:  # fmt: skip
        """Correct by a measurement y (p,) = h(x_1, ..., x_k) + v of any robots and landmarks.  docs/factors.md.

        `expect` is h: it takes the means of the blocks `names`, as `mean` returns them, and returns the expectation
        (p,).  Jacobians are taken by differences; a large correction is iterated.  `cov` (p, p) is the covariance of v,
        `angular` (p,) marks angles in rad.  Where d2 is beyond the `gate` of this probability nothing changes (1: no
        gate).  Raises EventError for numbers that are none, MapError for names that are not in the map.

        >>> rover = km.Robot("rover", km.motion.Unicycle(), sensors={"lidar": km.Mount(km.sensors.RangeBearing())})
        >>> slam = km.Slam(rover)
        >>> report = slam.process(km.Scan(0.0, "rover", "lidar", [[4.0, 0.3], [2.0, -1.0]], ids=["door", "mast"]))
        >>> slam.fuse(["door", "mast"], lambda a, b: np.linalg.norm(a - b), 3.95, 0.01**2).outcome  # a tape measure
        'associated'
        >>> float(np.linalg.norm(slam.mean("door") - slam.mean("mast")).round(2))
        3.95
        """
        done, _ = correct_by_factor(self.state, factor_of(names, expect, y, cov, angular), gate)
        self.state.settle()
        return done

    def remove(self, name: Id) -> None:
        """Remove a landmark; its place goes to the next new one."""
        self.state.remove(name)
        self.state.settle()

    # ------------------------------------------------------------------ before the first event
    def warm_up(self) -> None:
        """Compile and load all that the events of this Slam will need, so that none of them waits for it.

        Its state stays as it is: twins of it take made-up events, as `kalmark.slam.warm_up_events` has them.
        """
        from kalmark.slam.warm_up_events import process_made_up_events, warm_up_detectors, without_detectors

        warm_up_detectors(self.robots.values())
        robots, settings = without_detectors(self.robots.values()), self.state.settings
        kinds = ("dense", "postponed") if self.state.may_grow else (settings.map,)
        for kind in kinds:
            twin = Slam(robots, **vars(settings) | {"map": kind})
            surveyed = process_made_up_events(twin, twin.process, twin.add_landmark)
            if any(policy.restarts for policy in self.state.policies.values()):  # and once with rays that stay
                twin = Slam(robots, **vars(settings) | {"map": kind})
                twin.state.policies = {k: replace(of, restarts=False) for k, of in twin.state.policies.items()}
                process_made_up_events(twin, twin.process, twin.add_landmark)
        if self.tracks.known:
            twin = Slam(robots, **vars(settings) | {"map": kinds[0]})
            for name, mean, model in surveyed:
                twin.add_landmark(name, mean, None, model)
            process_made_up_events(twin, twin.process, twin.add_landmark)

    # ------------------------------------------------------------------ files
    def save(self, path: str | Path) -> None:
        """Write the whole state to a file; `load` resumes bit for bit."""
        from kalmark.slam import saving

        saving.save(Path(path), self)

    @staticmethod
    def load(
        path: str | Path,
        robots: Iterable[Robot] | None = None,
        association: Association | None = None,
        estimator: Estimator | None = None,
        landmarks: Landmark | None = None,
    ) -> Slam:
        """Read a state written by `save`; what is not kalmark's own (a user's models) must be given again."""
        from kalmark.slam import saving

        own = {"association": association, "estimator": estimator, "landmarks": landmarks}
        loaded: Slam = saving.load(Path(path), Slam, robots, **own)
        return loaded

    def __reduce__(self) -> tuple[Callable[..., Slam], tuple[Any, ...]]:
        """Return how a copy is made, by `copy` or `pickle`: made again, with the state that `save` writes."""
        from kalmark.slam import saving

        return _copied, ([*self.robots.values()], self.state.settings, saving.members_of(self.state, {}))


def _copied(robots: list[Robot], settings: Settings, members: dict[str, bytes]) -> Slam:
    """Make the copy that `Slam.__reduce__` describes."""
    from kalmark.slam import saving

    slam = Slam(robots, **vars(settings))
    saving.fill_state(slam.state, members)
    return slam
