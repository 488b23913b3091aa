"""Recording: a log is processed by the filter, and its reports are kept step by step."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numba.core import event as numba_event

from kalmark.arrays import Array
from kalmark.declare import is_own, registered_name
from kalmark.errors import DivergedError, EventError, ImageError, LogError
from kalmark.events import Control, Event, Fix, Frame, Raw, Scan
from kalmark.logs.log import Log, begins_at
from kalmark.logs.progress import track
from kalmark.logs.source import spelling_hint
from kalmark.report import Report
from kalmark.results.control_gaps import merge_gaps
from kalmark.results.filter_description import (
    biases,
    calibrated_mounts,
    cameras,
    configuration,
    correlations_kept,
    not_described,
    residual_px,
    sensors,
    stated_noise,
)
from kalmark.results.history import (
    Controlled,
    History,
    LandmarkChange,
    MapSnapshot,
    Prior,
    RelocatedRobot,
    RobotStart,
    UsedFix,
    columns_of,
    floats,
    ints,
    pad_blocks,
    texts,
)
from kalmark.results.landmark_table import MapLandmarks
from kalmark.results.recording import LogReference
from kalmark.results.repeated_landmarks import repeat_rows
from kalmark.results.run import Run
from kalmark.results.truth import Truth
from kalmark.results.unmeasured import ExpectationRecorder
from kalmark.slam.description import plain_value
from kalmark.slam.held_control import HeldInput

if TYPE_CHECKING:
    from kalmark.report import Gap
    from kalmark.slam.robot import Robot
    from kalmark.slam.slam import Slam

SNAPSHOTS = 60
LATEST = 30  # images whose rate the bar shows
OF_TWO = math.log10(2.0) / 3.0  # a factor of two, as a power of 1000
SMALL = 5000  # landmarks in all snapshots, up to which the map is kept whenever it grows, too


def record(
    slam: Slam,
    log: Log | Iterable[Event],
    *,
    progress: bool = True,
    on_error: Literal["raise", "skip"] = "raise",
    config: Mapping[str, Any] | None = None,
    pictures: bool = True,
    observers: Iterable[Callable[[Event, Report], object]] = (),
) -> Run:
    """Process every event of a log (or of any iterable) and return the run, ready to evaluate and save.

    A bar on standard error appears after two seconds unless `progress` is False.  With `on_error` "skip" an event the
    filter refuses is left out and listed in `run.skipped`, as is always a frame whose image cannot be read.  A filter
    that diverges so far that it refuses to go on ends the run in either case: `run.stopped` is the reason and the
    summary has `diverged`.  `config` is what to save as the run's configuration; by default it is read off the filter's
    models.  Without `pictures` the maps on the way and what was in view are left out, which is faster; the verdict
    on such a run is without the map before a jump.  Each of the `observers` is called with each event and its report.
    Raises LogError if the log has other columns than the filter's motions and sensors, or two units of time.

    >>> rover = km.Robot("rover", km.motion.Unicycle())
    >>> drive = [km.Control(t_s=0.1 * k, robot="rover", u=(0.5, 0.02)) for k in range(4)]
    >>> km.record(km.Slam(rover), drive, progress=False)
    <Run '' of 'rover': 4 steps, 0 observations, 0 landmarks>
    """
    if on_error not in ("raise", "skip"):
        raise ValueError(f"on_error is {on_error!r}, expected 'raise' or 'skip'")
    log = log if isinstance(log, Log) else Log("", tuple(slam.robots), list(log), format="")
    recorder = Recorder(slam, log, pictures, config)
    begin = time.perf_counter()
    events = track(log.events, log.name or "log", len(log.events), show=progress, note=recorder.rate)
    recorder.take(events, on_error, tuple(observers))
    return recorder.run(time.perf_counter() - begin)


class _Compiler(numba_event.Listener):  # type: ignore[misc, unused-ignore]
    """Notes when an inner loop is being compiled or read from the disk, once in a process."""

    was_busy = False

    def on_start(self, event: Any) -> None:
        self.was_busy = True

    def on_end(self, event: Any) -> None:
        pass


class DeadReckoning:
    """A robot's state by its controls alone."""

    def __init__(self, robot: Robot) -> None:
        self.motion, self.held = robot.motion, HeldInput(robot.motion)
        self.state, self.started = np.array(robot.start), False

    def take(self, control: Control) -> None:
        """Move by a control, or by the one before it."""
        self.started = True
        for part in self.held.accept(control):
            self.state = self.motion.move(self.state, part.u, part.dt_s)[0]

    def at(self, t_ns: int) -> Array:
        """Return the state (n,) at a time, NaN before the first control."""
        part = self.held.advance(t_ns)
        if part is not None:
            self.state = self.motion.move(self.state, part.u, part.dt_s)[0]
        return self.state if self.started else np.full_like(self.state, np.nan)


def _steps(kinds: set[type]) -> tuple[str, Any]:
    """Return the events that end the steps of a log with these kinds of events: their name, and their kinds."""
    for name, some in (("scan", Scan | Raw), ("fix", Fix)):
        if any(issubclass(kind, some) for kind in kinds):
            return name, some
    return "control", Control


class Recorder:
    """Gathers one run; `process` is the hot path, everything is put in order by `run`, at the end or on the way.

    It is for the events of a log, in their order.  Raises LogError as `record` does.
    """

    def __init__(self, slam: Slam, log: Log, pictures: bool, config: Mapping[str, Any] | None) -> None:
        refuse_other_columns(slam, log)
        refuse_other_times(log)
        slam.prepare_for(log.events)
        self.slam, self.log, self.pictures = slam, log, pictures
        self.config = configuration(slam, log) if config is None else dict(config)
        self.notes = [*not_described(slam, log)] if config is None else []
        kinds = {type(event) for event in log.events}
        self.has_images = Frame in kinds
        self.stepped_by, self.stepped = _steps(kinds)
        scans = sum(isinstance(e, self.stepped) for e in log.events)
        self.snapshot_at = np.linspace(0, scans - 1, SNAPSHOTS if pictures else 0)
        self.expectations = ExpectationRecorder(
            slam, scans if pictures else 0, np.floor(self.snapshot_at).astype(int).tolist()
        )
        self.anchored = len(slam.landmarks()) > 0 or any(type(e) is Fix for e in log.events)
        begins = {name: begins_at(log.events, name, robot.motion.held) for name, robot in slam.robots.items()}
        self.starts = tuple(
            RobotStart(name, np.array(slam.mean(name)), np.array(slam.covariance(name)), t_ns)
            for name, t_ns in begins.items()
            if t_ns is not None
        )
        surveyed = slam.landmarks() if slam.t_ns is None else ()  # in a map that is resumed they are correlated
        self.priors = tuple(Prior(str(l.id), np.array(l.mean), np.array(l.covariance)) for l in surveyed)
        self.controls: dict[str, Controlled] = {}
        self.reckoned = {name: DeadReckoning(robot) for name, robot in slam.robots.items()}
        self.dead: list[Array] = []
        self.fixes: list[UsedFix] = []
        self.gaps: list[Gap] = []
        self.placed: list[RelocatedRobot] = []
        self.skipped: list[str] = []
        self.stopped = ""
        self.scans: list[Scan] = []
        self.reports: list[Report] = []
        self.states: list[tuple[Array, Array]] = []
        self.step_ns: list[float] = []
        self.kinds: list[str] = []
        self.left = [np.empty(0)]
        self.maps: list[MapSnapshot] = []
        self.due = self.kept = 0  # snapshots that were due, and landmarks in all of them
        self.compiler = _Compiler()
        self.spent_ns = 0

    def rate(self) -> str:
        """Return the rate of the latest images as a text; of a log with images."""
        latest = [ns for ns in self.step_ns[-LATEST:] if not math.isnan(ns)]
        return f"{1e9 * len(latest) / sum(latest):.0f} images/s" if self.has_images and latest else ""

    def take(
        self, events: Iterable[Event], on_error: str, observers: Sequence[Callable[[Event, Report], object]] = ()
    ) -> None:
        """Feed events, as `record` does, until the filter gives up: `stopped` is then the reason."""
        with numba_event.install_listener("numba:compiler_lock", self.compiler), self.expectations:
            for event in events:
                try:
                    report = self.process(event)
                    for observe in observers:
                        observe(event, report)
                except EventError as error:
                    if on_error == "raise" and not isinstance(error, ImageError):
                        raise
                    self.skipped.append(str(error))
                except DivergedError as error:
                    self.stopped = str(error)
                    break

    def process(self, event: Event) -> Report:
        """Feed one event, return its report, and keep the step that ends with it: with a scan, if the log has any.

        Of a log without scans with a fix, of one without either with a control.
        """
        start = time.perf_counter_ns()
        try:
            report = self.slam.process(event)
        finally:
            self.spent_ns += time.perf_counter_ns() - start - self.expectations.spent_ns()
        self.gaps += report.gaps
        if type(event) is Control:
            number, first_ns, _ = self.controls.get(event.robot, (0, event.t_ns, 0))
            self.controls[event.robot] = Controlled(number + event.share, first_ns, event.t_ns)
            self.reckoned[event.robot].take(event)
        elif type(event) is Fix and not any(o.outcome == "ignored" for o in report.observations):
            used = all(o.outcome == "associated" for o in report.observations)
            self.fixes.append(
                UsedFix(event.t_ns, event.robot, used, event.y, report.z[0], report.Z[0], report.replaced)
            )
        elif report.replaced and type(event) is Scan:
            of = zip(self.scans, self.reports, strict=True)
            mine = [each for scan, each in of if (scan.robot, scan.sensor) == (event.robot, event.sensor)]
            before = sum(o.outcome == "associated" for each in mine for o in each.observations)
            self.placed.append(RelocatedRobot(event.t_ns, event.robot, event.sensor, report.replaced, before))
        if isinstance(event, self.stepped):
            self._step(event, report)
        return report

    def _step(self, event: Event, report: Report) -> None:
        scan = report.event  # of raw data, what the detector found
        if not isinstance(scan, Scan):
            scan = Scan(t_ns=event.t_ns, robot=event.robot)
            report = Report(scan)  # a step without observations
        self.step_ns.append(math.nan if self.compiler.was_busy else self.spent_ns)
        self.spent_ns, self.compiler.was_busy = 0, False
        self.dead.append(self.reckoned[event.robot].at(event.t_ns))
        self.scans.append(scan)
        self.expectations.keep(len(self.reports), report)
        self.reports.append(report)
        self.states.append((self.slam.mean(event.robot), self.slam.covariance(event.robot)))
        models = [
            o.landmark if o.landmark is None else self.slam.landmark_model(o.landmark) for o in report.observations
        ]
        self.kinds += ["" if model is None else model.kind for model in models]
        if report.observations:
            self.left.append(residual_px(self.slam, scan, report))
        due = self.due < len(self.snapshot_at) and len(self.reports) > self.snapshot_at[self.due]
        grown = self.pictures and self.kept < SMALL and any(o.outcome == "new" for o in report.observations)
        if due or grown:
            self.maps.append(self._snapshot())
            self.due, self.kept = self.due + due, self.kept + len(self.maps[-1].ids)

    def _snapshot(self) -> MapSnapshot:
        whole = MapLandmarks.of(self.slam)
        landmarks, (shape, robots) = whole.split()[0], whole.shape(self.slam, [start.robot for start in self.starts])
        of_shape, kinds = shape.split()[0].places()[1], tuple(landmarks.kinds)
        when = len(self.reports) - 1, self.reports[-1].t_ns, tuple(landmarks.ids)
        correlations = correlations_kept(self.slam, when[-1])
        return MapSnapshot(*when, *landmarks.places(), kinds, of_shape, robots, correlations)

    def run(self, wall_s: float) -> Run:
        """Return the run made of what was gathered."""
        log, slam = self.log, self.slam
        if self.reports and (not self.maps or self.maps[-1].step < len(self.reports) - 1):
            self.maps.append(self._snapshot())
        history = self._history()
        return Run(
            history=history,
            config=self.config,
            notes=self.notes,
            landmarks=MapLandmarks.of(slam),
            truth=Truth.of(log, history, self.anchored),
            log=LogReference(log.name, log.format, None if log.path is None else str(log.path), tuple(log.robots)),
            coordinates=slam.estimator.coordinates,
            wall_s=wall_s,
            skipped=[*log.skipped, *self.skipped],
            stopped=self.stopped,
            slam=slam,
            source=log,
            reference=plain_value(log.reference),
        )

    def _history(self) -> History:
        reports = self.reports
        counts = [len(report.observations) for report in reports]
        m, p = (max((getattr(r, key).shape[1] for r in reports if r.observations), default=2) for key in "yz")
        spaces = [robot.motion.space for robot in self.slam.robots.values()]
        n, q = max(space.size for space in spaces), max(space.dof for space in spaces)
        ones = [1] * len(reports)
        return History(
            t_ns=ints([r.t_ns for r in reports]),
            robot=texts([r.robot for r in reports]),
            mean=pad_blocks([mean[None] for mean, _ in self.states], ones, n),
            covariance=pad_blocks([P[None] for _, P in self.states], ones, q, matrices=True),
            dead_reckoned=pad_blocks([r[None] for r in self.dead], ones, n),
            step_us=floats(self.step_ns) * 1e-3,
            y=pad_blocks([r.y for r in reports], counts, m),
            e=pad_blocks([r.e for r in reports], counts, m),
            z=pad_blocks([r.z for r in reports], counts, p),
            Z=pad_blocks([r.Z for r in reports], counts, p, matrices=True),
            kind=texts(self.kinds),
            left_px=np.concatenate(self.left),
            noise=pad_blocks([stated_noise(self.slam, r) for r in reports], counts, p),
            maps=tuple(self.maps),
            controls={name: of._replace(number=round(of.number)) for name, of in self.controls.items()},
            fixes=tuple(self.fixes),
            starts=self.starts,
            priors=self.priors,
            cameras=cameras(self.slam),
            sensors=sensors(self.slam),
            mounts=calibrated_mounts(self.slam),
            biases=biases(self.slam),
            placed=tuple(self.placed),
            gaps=merge_gaps(self.gaps),
            repeats=repeat_rows(self.slam),
            stepped=self.stepped_by,
            **self._observations(),
            **decisions(reports, 3 if any(space.world == "space" for space in spaces) else 2),
            **self.expectations.columns(m, p),
        )

    def _observations(self) -> dict[str, Any]:
        """Return fields of a history that have a value for each observation."""
        late = {one for report in self.reports for one in report.late}
        rows = []
        for step, (scan, report) in enumerate(zip(self.scans, self.reports, strict=True)):
            true = self.log.true_ids.get(scan, scan.ids)  # also those that the filter did not get
            for o in report.observations:
                ids = (None if of is None else of[o.index] for of in (scan.ids, true))
                was_late = (scan.t_ns, scan.robot, scan.sensor, o.index) in late
                rows.append((step, scan.sensor, o.index, *ids, o.outcome, o.landmark, o.d2, o.reason, was_late))
        return columns_of(
            rows, step=ints, sensor=texts, index=ints, id=texts, true_id=texts, outcome=texts, landmark=texts,
            d2=floats, reason=texts, late=partial(np.array, dtype=np.bool_),
        )  # fmt: skip


def decisions(reports: list[Report], d: int) -> dict[str, Any]:
    """Return fields of a history: the landmarks that observations were compared with, and what became of landmarks."""
    counts = [len(report.observations) for report in reports]
    first = np.cumsum([0, *counts]).tolist()
    told = list(zip(first, reports, strict=False))
    compared = [(start + c.index, c.landmark, c.d2, c.place) for start, report in told for c in report.candidates]
    shares = [
        (start + k, name, weight)
        for start, report in told
        for k, o in enumerate(report.observations)
        for name, weight in o.shares
    ]
    changes = [
        change
        for step, report in enumerate(reports)
        for change in (
            *(LandmarkChange(step, str(gone), "merged", str(kept), why) for gone, kept, why in report.merged),
            *(LandmarkChange(step, str(gone), "removed", "", why) for gone, why in report.removed),
        )
    ]
    named = columns_of(
        compared, candidate_row=ints, candidate_landmark=texts, candidate_d2=floats,
        candidate_place=lambda places: floats(places).reshape(-1, d),
    )  # fmt: skip
    named |= columns_of(shares, share_row=ints, share_landmark=texts, share_weight=floats)
    return named | {
        "seen_at": pad_blocks([report.seen_at for report in reports], counts, d),
        "changes": tuple(changes),
    }


def refuse_other_columns(slam: Slam, log: Log) -> None:
    """Refuse a log whose columns are others than those of kalmark's own motions and sensors.

    Columns that are not known come last, in the file's order: a misspelt one would be taken for another number.
    Raises LogError.
    """
    taken: list[tuple[str, str, Any]] = [
        (robot, "", slam.robots[robot].motion) for robot in log.control_columns if robot in slam.robots
    ]
    for robot, sensor in log.sensor_columns:
        mount = slam.robots[robot].sensors.get(sensor) if robot in slam.robots else None
        if mount is not None and mount.detector is None:
            taken.append((robot, sensor, mount.sensor))
    for robot, sensor, model in taken:
        if is_own(type(model)) and registered_name(type(model)):
            log.refuse_columns(robot, sensor, tuple(model.columns), f"its {type(model).__name__}", spelling_hint)


def refuse_other_times(log: Log) -> None:
    """Refuse a log whose controls and scans are in other units of time.  Raises LogError.

    Then the times that they span, and their usual intervals, have a ratio of 1000 or a power of it, to a factor of two.
    """
    for robot in log.robots:
        times = [
            np.unique([event.t_ns for event in log.events if event.robot == robot and isinstance(event, kind)])
            for kind in (Control, Scan)
        ]
        if min(map(len, times)) < 2:
            continue
        spans, usual = (np.array([of(np.diff(t)) for t in times]) * 1e-9 for of in (np.sum, np.median))
        powers = np.log10([spans[1] / spans[0], usual[1] / usual[0]]) / 3.0
        if round(powers[0]) and (np.abs(powers - round(powers[0])) < OF_TWO).all():
            told = f"controls of {robot} span {spans[0]:.4g} s, its scans {spans[1]:.4g} s"
            raise LogError(f"{log.path or log.name}: {told}, expected one unit of time: t_s, t_ms, t_us or t_ns")
