"""Feed a log to the filter and keep what it said, step by step."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import numpy.typing as npt
from numba.core import event as numba_event

from kalmark.errors import DivergedError, EventError
from kalmark.events import Control, Event, Fix, Id, Scan
from kalmark.logs.log import Log, begins_at
from kalmark.results.advice import stated_noise
from kalmark.results.cameras import biases, cameras, mounts
from kalmark.results.columns import Array, Texts, padded, texts
from kalmark.results.corners import left_px
from kalmark.results.decisions import Decisions
from kalmark.results.describe import describe, plain
from kalmark.results.fitting import refuse_other_columns
from kalmark.results.history import History, MapSnapshot, Start
from kalmark.results.inputs import Controlled, Inputs, UsedFix
from kalmark.results.landmarks import MapLandmarks
from kalmark.results.progress import track
from kalmark.results.recording import LogReference
from kalmark.results.run import Run
from kalmark.results.truth import Truth

if TYPE_CHECKING:
    from kalmark.report import Observation, Report
    from kalmark.slam.slam import Slam

SNAPSHOTS = 60


def record(
    slam: Slam,
    log: Log | Iterable[Event],
    *,
    progress: bool = True,
    on_error: Literal["raise", "skip"] = "raise",
    config: Mapping[str, Any] | None = None,
) -> Run:
    """Process every event of a log (or of any iterable) and return the run, ready to evaluate and save.

    A bar on standard error appears after two seconds unless `progress` is False.  With `on_error` "skip" an event the
    filter refuses is left out and listed in `run.skipped`.  A filter that diverges so far that it refuses to go on ends
    the run in either case: `run.stopped` says why and the summary has `diverged`.  `config` is what to save as the
    run's configuration; by default it is read off the filter's models.  Raises LogError if the log has other columns
    than the filter's motions and sensors.
    """
    if on_error not in ("raise", "skip"):
        raise ValueError(f"on_error is {on_error!r}, expected 'raise' or 'skip'")
    log = log if isinstance(log, Log) else Log("", tuple(slam.robots), list(log), format="")
    refuse_other_columns(slam, log)
    events = log.events
    slam.reserve(name for event in events if type(event) is Scan for name in event.ids or ())
    recorder = _Recorder(slam, np.linspace(0, sum(type(e) is Scan for e in events) - 1, SNAPSHOTS))
    recorder.anchored = len(slam.landmarks()) > 0 or any(type(e) is Fix for e in events)
    recorder.starts = _starts(slam, events)
    begin = time.perf_counter()
    with numba_event.install_listener("numba:compiler_lock", recorder.compiler):
        for event in track(events, log.name or "log", len(events), show=progress):
            try:
                recorder.process(event)
            except EventError as error:
                if on_error == "raise":
                    raise
                recorder.skipped.append(str(error))
            except DivergedError as error:
                recorder.stopped = str(error)
                break
    wall_s = time.perf_counter() - begin
    return recorder.run(log, config, wall_s)


def _starts(slam: Slam, events: list[Event]) -> tuple[Start, ...]:
    begins = {name: begins_at(events, name, robot.motion.held) for name, robot in slam.robots.items()}
    return tuple(
        Start(name, np.array(slam.mean(name)), np.array(slam.covariance(name)), t_ns)
        for name, t_ns in begins.items()
        if t_ns is not None
    )


class _Compiler(numba_event.Listener):  # type: ignore[misc, unused-ignore]
    """Notes when an inner loop is being compiled or read from the disk, once in a process."""

    was_busy = False

    def on_start(self, event: Any) -> None:
        self.was_busy = True

    def on_end(self, event: Any) -> None:
        pass


@dataclass
class _Recorder:
    """Gathers one run; `process` is the hot path, everything is put in order afterwards by `run`."""

    slam: Slam
    snapshot_at: npt.NDArray[np.float64]
    anchored: bool = False
    starts: tuple[Start, ...] = ()
    controls: dict[str, Controlled] = field(default_factory=dict)
    fixes: list[UsedFix] = field(default_factory=list)
    skipped: list[str] = field(default_factory=list)
    stopped: str = ""
    reports: list[Report] = field(default_factory=list)
    scans: list[Scan] = field(default_factory=list)
    means: list[Array] = field(default_factory=list)
    covariances: list[Array] = field(default_factory=list)
    step_ns: list[float] = field(default_factory=list)
    kinds: list[str] = field(default_factory=list)
    left: list[Array] = field(default_factory=list)
    maps: list[MapSnapshot] = field(default_factory=list)
    compiler: _Compiler = field(default_factory=_Compiler)
    _spent_ns: int = 0

    def process(self, event: Event) -> None:
        """Feed one event and, if it is a scan, keep the step that ends with it."""
        start = time.perf_counter_ns()
        try:
            report = self.slam.process(event)
        finally:
            self._spent_ns += time.perf_counter_ns() - start
        if type(event) is not Scan:
            if type(event) is Control:
                before = self.controls.get(event.robot) or Controlled(0, event.t_ns, event.t_ns)
                self.controls[event.robot] = Controlled(before.number + 1, before.first_ns, event.t_ns)
            elif type(event) is Fix:
                used = all(o.outcome == "associated" for o in report.observations)
                self.fixes.append(UsedFix(event.t_ns, event.robot, used, event.y, report.z[0], report.Z[0]))
            return
        self.step_ns.append(math.nan if self.compiler.was_busy else self._spent_ns)
        self._spent_ns, self.compiler.was_busy = 0, False
        self.scans.append(event)
        self.reports.append(report)
        self.means.append(self.slam.mean(event.robot))
        self.covariances.append(self.slam.covariance(event.robot))
        self.kinds += [self._kind(o.landmark) for o in report.observations]
        self.left.append(left_px(self.slam, event, report))
        if len(self.maps) < len(self.snapshot_at) and len(self.reports) > self.snapshot_at[len(self.maps)]:
            self.maps.append(self._snapshot())

    def _kind(self, name: Id | None) -> str:
        model = self.slam.landmark_model(name) if name is not None else None
        return "" if model is None else model.kind

    def _snapshot(self) -> MapSnapshot:
        landmarks = MapLandmarks.of(self.slam)
        ids, kinds = tuple(landmarks.ids), tuple(landmarks.kinds)
        return MapSnapshot(len(self.reports) - 1, self.reports[-1].t_ns, ids, *landmarks.places(), kinds)

    def run(self, log: Log, config: Mapping[str, Any] | None, wall_s: float) -> Run:
        """Return the run made of what was gathered."""
        if self.reports and (not self.maps or self.maps[-1].step < len(self.reports) - 1):
            self.maps.append(self._snapshot())
        history = self._history(log)
        return Run(
            history=history,
            config=dict(config) if config is not None else describe(self.slam, log),
            landmarks=MapLandmarks.of(self.slam),
            truth=Truth.of(log, history, self.anchored),
            log=LogReference(log.name, log.format, None if log.path is None else str(log.path), tuple(log.robots)),
            coordinates=self.slam.estimator.coordinates,
            controls=sum(c.number for c in self.controls.values()),
            fixes=len(self.fixes),
            fixes_rejected=sum(not fix.used for fix in self.fixes),
            wall_s=wall_s,
            skipped=[*log.skipped, *self.skipped],
            stopped=self.stopped,
            slam=self.slam,
            source=log,
            reference=plain(log.reference),
        )

    def _true_ids(self, log: Log) -> Texts:
        """Return the id the log has of each observation, whether the filter was told or not; "" where it has none."""
        told = [log.true_ids.get(scan, scan.ids) for scan in self.scans]
        pairs = zip(told, self.reports, strict=True)
        return texts([None if ids is None else ids[o.index] for ids, report in pairs for o in report.observations])

    def _late(self, seen: list[tuple[int, Scan, Observation]]) -> npt.NDArray[np.bool_]:
        """Return which observations were fused after their scan."""
        told = {one for report in self.reports for one in report.late}
        return np.array([(scan.t_ns, scan.robot, scan.sensor, o.index) in told for _, scan, o in seen], dtype=np.bool_)

    def _history(self, log: Log) -> History:
        steps = self.reports
        seen = [
            (s, scan, o)
            for s, (scan, report) in enumerate(zip(self.scans, steps, strict=True))
            for o in report.observations
        ]
        counts = [len(report.observations) for report in steps]
        widths = [max((getattr(r, key).shape[1] for r in steps if r.observations), default=2) for key in "yz"]
        spaces = [robot.motion.space for robot in self.slam.robots.values()]
        n, q = max(space.size for space in spaces), max(space.dof for space in spaces)
        return History(
            t_ns=np.array([r.t_ns for r in steps], dtype=np.int64),
            robot=texts([r.robot for r in steps]),
            mean=padded([m[None] for m in self.means], [1] * len(steps), n),
            covariance=padded([P[None] for P in self.covariances], [1] * len(steps), q, matrices=True),
            step_us=np.array(self.step_ns, dtype=np.float64) * 1e-3,
            step=np.array([s for s, _, _ in seen], dtype=np.int64),
            sensor=texts([scan.sensor for _, scan, _ in seen]),
            index=np.array([o.index for _, _, o in seen], dtype=np.int64),
            id=texts([None if scan.ids is None else scan.ids[o.index] for _, scan, o in seen]),
            outcome=texts([o.outcome for _, _, o in seen]),
            landmark=texts([o.landmark for _, _, o in seen]),
            d2=np.array([np.nan if o.d2 is None else o.d2 for _, _, o in seen], dtype=np.float64),
            reason=texts([o.reason for _, _, o in seen]),
            y=padded([r.y for r in steps], counts, widths[0]),
            e=padded([r.e for r in steps], counts, widths[0]),
            z=padded([r.z for r in steps], counts, widths[1]),
            Z=padded([r.Z for r in steps], counts, widths[1], matrices=True),
            maps=tuple(self.maps),
            starts=self.starts,
            inputs=Inputs(self.controls, tuple(self.fixes)),
            kind=texts(list(self.kinds)),
            late=self._late(seen),
            noise=padded([stated_noise(self.slam, r) for r in steps], counts, widths[1]),
            left_px=np.concatenate([np.empty(0), *self.left]),
            cameras=cameras(self.slam),
            mounts=mounts(self.slam),
            biases=biases(self.slam),
            true_id=self._true_ids(log),
            decisions=Decisions.of(steps, 3 if n > 3 else 2),
        )
