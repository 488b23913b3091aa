"""Trials: a log filtered again as if something were not wrong with it, and how much likelier the same observations are.

An observation that a change leaves unused counts as one at the cap, as it does without the change: no change gains by
observations that it leaves out.  All that filters or solves the batch problem again has one budget of work: a search
that it cannot pay is left out whole, and named.
"""

from __future__ import annotations

import math
import shlex
from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from copy import deepcopy
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from kalmark.arrays import Array
from kalmark.config import build_slam
from kalmark.config.reading import config_of
from kalmark.config.tree import Plain, Tree, parse_value, put, robot_section, value_at
from kalmark.diagnosis.cause_texts import OR
from kalmark.diagnosis.mistakes import Mistake, Where, with_value
from kalmark.errors import KalmarkError, LogError
from kalmark.events import Event, Frame, Raw, Scan, sort_key
from kalmark.logs.log import Log
from kalmark.logs.log_corrections import correct_log
from kalmark.logs.progress import track
from kalmark.report import ALONE, Report
from kalmark.results.control_gaps import while_lost
from kalmark.results.history import History, Ints
from kalmark.results.record import Recorder
from kalmark.results.run import Run
from kalmark.results.warnings import left_out_by_attention
from kalmark.slam.held_readings import AGAIN

SCANS, OBSERVATIONS, EVENTS = 400, 3000, 10_000  # of the log are filtered again, whatever comes first
DETECTED = 7  # observations in a raw scan, or so
FEW_SCANS = 80  # of a log show no mistake
FEW_SKIPPED = 0.02  # of the events may be refused in a log that fits
MISFIT = 2.5  # mean of d2 per degree of freedom, above which a run is worth it
FITS = 2.0  # below which a log fits
LOST = 9.0  # what an observation without an id counts that is of no landmark in the map: as one at the gate
AT_ONCE = 20_000  # observations of a log that are filtered again, or solved for
SHARES = tuple(1.5**-k for k in range(7, -1, -1))  # of the events, after which changes are compared
CONTROL, SCAN, OBSERVATION, IMAGE = 3, 24, 1, 1000  # the work of filtering each, in observations with ids: 1/60 ms
HARDER = 4  # times as much work is a scan without ids, or of one number each, of which several start a landmark
PART = 500  # the work of building a filter, or of asking for its run so far
SOLVED = 10  # the work of a batch solution and the search in it, for each observation
BRIEF, SHARE = 600_000, 0.3  # the work of a verdict at the end of a run, 10 s: so much, or this share of the run's own
RACED = 0.5  # of the budget that is left, the most that a race takes
RACE = 4  # times a race filters all of its events, besides the first part of each change
THOROUGH, UNLIMITED = 50, 1e18  # times as much is that of a verdict that was asked for; that of a search alone
MOST = 25.0  # that one observation counts, and what counts one that was left out
ALIKE = 0.95  # of the gain of the likeliest change: the log does not distinguish them
SURELY = 50.0  # the gain of what is 10 sigma off
TINY = 1e-300
LOG_PEAK = 0.5 * math.log(2.0 * math.pi)  # of a Gaussian of variance 1


class Fit(NamedTuple):
    """Fit of observations (O,): d2 per degree of freedom, at most `MOST`, the degrees of freedom, log-likelihoods.

    The likelihood of an observation is that of its innovation over that at the peak of the noise that is stated.
    """

    values: Array
    dof: Array
    likelihoods: Array

    @property
    def mean(self) -> float:
        """Its mean over the observations; that of a log that the filter refuses, or that has none, is infinite."""
        return float(self.values.mean()) if len(self.values) else math.inf

    def first(self, number: int) -> Fit:
        """Return the fit of the first observations; those that are missing count `MOST`."""
        missing = np.zeros(max(0, number - len(self.values)))
        padded = zip(self, (MOST, 1.0, -0.5 * MOST), strict=True)
        return Fit(*(np.append(column, missing + one)[:number] for column, one in padded))


REFUSED = Fit(np.zeros(0), np.zeros(0), np.zeros(0))
UNUSED = Fit(
    *np.outer((MOST, 1.0, -0.5 * MOST), np.ones(OBSERVATIONS))
)  # a log that is refused, as another one with a change


def fit_of_run(run: Run, shrunk: Mapping[tuple[str, str], float] | None = None) -> Fit:
    """Return the fit of the observations of a run: one without a landmark counts `MOST`.

    An observation without an id counts `LOST` where it is of no landmark in the map: a filter that is lost makes new
    ones all the time, and clutter fits none either.  One that is deferred after a gap, until the robot's pose is known
    again, contradicts nothing, nor does one of a landmark that no sensor has started, one that was given before, or one
    that an attention leaves out.  `shrunk` has by how much the logarithm of what a sensor measures is smaller than in
    the log: so much smaller is its density there.
    """
    history = run.history
    known = np.isfinite(history.z)
    dof = np.maximum(known.sum(axis=1), 1)
    d2 = np.minimum(np.nan_to_num(history.d2, nan=0.0) / dof, MOST)
    d2 = np.where(np.isin(history.outcome, ("rejected", "ignored")), MOST, d2)
    d2 = np.where((history.id == "") & (history.outcome != "associated"), LOST, d2)
    early = (np.char.find(history.reason, ALONE) >= 0) | left_out_by_attention(history)
    early |= (history.outcome == "deferred") & while_lost(history)[history.step]
    early |= history.reason == AGAIN
    values = np.where(early, 1.0, d2)
    return Fit(values, dof, np.where(early, 0.0, _likelihoods(history, dof, shrunk or {})))


def _likelihoods(h: History, dof: Ints, shrunk: Mapping[tuple[str, str], float]) -> Array:
    """Return the log-likelihoods (O,) of observations, but for a constant.

    One that is of nothing in the map, or is left out, may be anywhere among what its sensor measures; so may any other.
    """
    stated = np.isfinite(h.noise).sum(axis=1)
    judged = np.isfinite(h.d2) & ((h.outcome == "associated") | h.of_own) & ((stated == 0) | (stated == dof))
    fits, anywhere = np.where(judged, -0.5 * h.d2, -np.inf), -0.5 * MOST * dof
    for key, m in sorted({*zip(h.sensor_keys(), stated.tolist(), strict=True)}):
        rows = np.flatnonzero(h.made_by(*key) & (stated == m))
        by, sigma = shrunk.get(key, 0.0), np.log(np.maximum(h.noise[rows, :m], TINY))
        if m and h.y.shape[1] >= m:
            span = np.log(np.maximum(np.ptp(np.nan_to_num(h.y[rows, :m]), axis=0), TINY)) - LOG_PEAK
            anywhere[rows] = -np.maximum(span, sigma + 1.0).sum(axis=1) - by
            rows = rows[judged[rows]]
            fits[rows] -= 0.5 * np.linalg.slogdet(h.Z[rows][:, :m, :m])[1] + by
    return np.maximum(fits, anywhere)


class Trials:
    """The filter of the changed logs of a verdict, and the budget of their work.

    `work` is a count, the same on every machine: of events, observations (`work_of`) and filters, as a robot that may
    be in several places has one for each.  `left_out` has the searches that were not paid, in words, and after how many
    scans those end that were paid in part, "" of one that was not made.
    """

    def __init__(
        self, work: float = UNLIMITED, progress: bool = False, detecting: Collection[Where] = frozenset()
    ) -> None:
        self.work, self.progress, self.detecting, self.left_out = work, progress, detecting, dict[str, str]()

    @classmethod
    def of(cls, log: Log, brief: bool, progress: bool, detecting: Collection[Where] = frozenset()) -> Trials:
        """Return the trials of a verdict on the run of a log: `brief` at its end, else as it was asked for."""
        work = max(BRIEF, SHARE * work_of(log.events, detecting))
        return cls(work if brief else THOROUGH * work, progress, detecting)

    def work_of(self, events: Iterable[Event]) -> int:
        """Return the work of filtering events."""
        return work_of(events, self.detecting)

    def pays(self, what: str, work: float) -> bool:
        """Return whether a search of so much work is in the budget; name it if it is not."""
        if work > self.work:
            self.left_out[what] = ""
        return work <= self.work

    def spend(self, work: float) -> None:
        """Take work that was done off the budget."""
        self.work -= work

    def filter(self, config: Mapping[str, Any], log: Log, events: Iterable[Event], shown: bool = True) -> Run | None:
        """Return the run of events under a configuration, None if they are refused."""
        return Trial(self, log, events, Mistake("", "", "", config)).run(shown=shown and self.progress)

    def fit_with(self, log: Log, events: Iterable[Event], change: Mistake) -> Fit:
        """Return the fit of some events of a log with a change."""
        trial = Trial(self, log, events, change)
        trial.run(shown=self.progress)
        return trial.fit

    def payable(
        self, what: str, run: Run, events: list[Event], filters: float, parts: int, *, share: float = 1.0,
    ) -> list[Event]:  # fmt: skip
        """Return the first of some events, those that a share of the budget pays to filter so often in so many parts.

        None of them if these have few scans.  The search is named with the number that it has.
        """
        paid = share * self.work / max(filters * self.work_of(events) + PART * parts, 1.0)
        if paid >= 1.0:
            return events
        scans = round(paid * sum(isinstance(event, Scan | Raw) for event in events))
        self.left_out[what] = f" after {scans} scans" if scans >= FEW_SCANS else ""
        return first_events(run, events, scans) if scans >= FEW_SCANS else []

    def race(self, log: Log, events: list[Event], changes: Sequence[Mistake]) -> list[Mistake]:
        """Return the changes with which events fit, and are surely likelier than with the first, with their gains.

        All are filtered at once, in growing parts of the events; what cannot win any more is dropped (`_in_race`), and
        of the rest go on, at least one, the likeliest that the budget pays.
        """
        end = (1.0 - RACED) * self.work
        none, *left = (Trial(self, log, events, change) for change in changes)
        now, whole, before = UNUSED if none.run() is None else none.fit, self.work_of(events), 0.0
        left = left if _misfit(now) > SURELY else []
        for k, share in enumerate(SHARES):  # each part has as much of the budget
            paid = (self.work - end) / (len(SHARES) - k) / (whole * (share - before) + PART)
            gains = sorted(likelihood_gain(now, one.fit) for one in left)
            # ties go on, as all do before the first part
            left = [one for one in left if likelihood_gain(now, one.fit) >= gains[-max(1, int(paid)) :][0]]
            for one in track(left, f"mistakes in {share:.0%} of the first events", show=self.progress):
                one.run(share)
            left = [one for one in left if len(one.fit.values)]
            left = [left[i] for i in _in_race(now, [one.fit for one in left], 1.0 / share - 1.0)]
            before = share
        made = [(one.change, likelihood_gain(now, one.fit)) for one in left]
        return [change._replace(gain=gain, since_s=events[0].t_s) for change, gain in made]


def work_of(events: Iterable[Event], detecting: Collection[Where] = frozenset()) -> int:
    """Return the work of filtering events; sensors that are `detecting` find few landmarks in the rays of a scan."""
    return sum(_work(event, detecting) for event in events)


def _work(event: Event, detecting: Collection[Where]) -> int:
    if isinstance(event, Scan) and (event.robot, event.sensor) not in detecting:
        easy = event.ids is not None and None not in event.ids and event.y.shape[1] > 1
        return (SCAN + OBSERVATION * len(event.y)) * (1 if easy else HARDER)
    if isinstance(event, Frame):
        return IMAGE
    return (SCAN + OBSERVATION * DETECTED) * HARDER if isinstance(event, Scan | Raw) else CONTROL


class Trial:
    """Events of a log that are filtered with a change, part by part, and the fit of their observations so far."""

    def __init__(self, trials: Trials, log: Log, events: Iterable[Event], change: Mistake) -> None:
        self.trials, self.change, self.taken, self.fit = trials, change, 0, REFUSED
        self.events = sorted(map(change.change, events), key=sort_key) if change.change else [*events]
        self.recorder: Recorder | None = None
        with suppress(KalmarkError, np.linalg.LinAlgError):
            part = replace(log, events=self.events)
            slam = build_slam(config_of(Tree(deepcopy(dict(change.config))), None), part)
            self.recorder = Recorder(slam, part, False, None)

    def run(self, share: float = 1.0, shown: bool = False) -> Run | None:
        """Return the run of a share of the events, None if they are refused: then nothing fits.

        With `shown`, standard error shows a bar.
        """
        begin, self.taken, self.fit = self.taken, round(share * len(self.events)), REFUSED
        self.trials.spend(PART)
        with suppress(KalmarkError, np.linalg.LinAlgError):
            if self.recorder is not None:
                part = self.events[begin : self.taken]
                bar = track(part, "the log, filtered again", len(part), show=shown)
                self.recorder.take(bar, "skip", [self._spend])
                run = self.recorder.run(0.0)
                if not run.stopped and len(run.skipped) <= FEW_SKIPPED * len(self.events):
                    self.fit = fit_of_run(run, self.change.shrunk)
                    return run
        self.recorder = None
        return None

    def _spend(self, event: Event, report: Report) -> None:
        if self.recorder is not None:
            parts = sum(len(of.parts.log_weights) for of in self.recorder.slam.state.sums.values())
            self.trials.spend(self.trials.work_of([event]) * (1 + parts))


def _in_race(none: Fit, fits: Sequence[Fit], rest: float) -> Ints:
    """Return the changes, by number, that may still fit and be about as likely as the likeliest, and surely than none.

    The fits of changes are known so far, that of none to the end.  In the rest, which is `rest` times as long, a change
    may fit, and be as likely as the likeliest of each half so far, where the likeliest of all goes on as it did.  It
    gains no more than none misfits there, and of that no larger share than the best one did in the second half.
    """
    number = max((len(of.values) for of in fits), default=0)
    if number < 2:
        return np.arange(len(fits))
    halves, firsts = [0, number // 2], [of.first(number) for of in (none, *fits)]
    likely = np.add.reduceat([of.likelihoods for of in firsts], halves, axis=1)
    mean, total = np.array([of.mean for of in firsts[1:]]), likely.sum(axis=1)
    gain, won = (total - total[0])[1:], (likely - likely[0]).max(axis=0)[1]
    least = ALIKE * gain.max() - rest * (likely.max(axis=0).sum() - total.max()) - (SURELY if rest else 0.0)
    before, more = _misfit(none, number // 2, number), max(0.0, _misfit(none, number))
    more *= min(1.0, won / before) if before > SURELY else 1.0
    sure = gain + more > SURELY * np.clip(mean, 1.0, FITS)
    return np.flatnonzero((mean + rest < MISFIT * (1.0 + rest)) & (gain >= least) & sure)


def _misfit(of: Fit, begin: int = 0, end: int | None = None) -> float:
    """Return by how much some observations are less likely than such that fit."""
    return 0.5 * float(((of.values - 1.0) * of.dof)[begin:end].sum())


def first_of(made: Sequence[Mistake]) -> Mistake | None:
    """Return the change with the largest gain, the first one of several.  Its evidence names those of nearly that."""
    if not made:
        return None
    first = max(made, key=lambda one: round(one.gain))
    alike = "; or: ".join(one.evidence for one in made if one is not first and one.gain >= ALIKE * first.gain)
    if not alike:
        return first
    return first._replace(evidence=f"{first.evidence}; the log does not distinguish this from: {alike}")


def likelihood_gain(before: Fit, after: Fit, but: Ints | None = None) -> float:
    """Return the logarithm of the likelihood ratio of the same observations, `but` of some.

    Those that are missing count `MOST`.
    """
    first, second = (one.likelihoods if but is None else np.delete(one.likelihoods, but) for one in (before, after))
    return float(second.sum() - first.sum()) - 0.5 * MOST * (len(first) - len(second))


def detecting(run: Run) -> set[Where]:
    """Return the sensors of a run whose landmarks are found by a detector."""
    robots = run.final_slam().robots.values()
    return {(r.name, name) for r in robots for name, m in r.sensors.items() if m.detector is not None}


def first_events(run: Run, events: Iterable[Event], most: int = SCANS) -> list[Event]:
    """Return the first events, with so many scans and observations; in a raw scan are few, however many its beams."""
    detected = detecting(run)
    found, scans, observations = list[Event](), 0, 0
    for n, event in enumerate(events):
        found.append(event)
        if isinstance(event, Scan):
            number = DETECTED if (event.robot, event.sensor) in detected else len(event.y)
            scans, observations = scans + 1, observations + number
            if scans >= most or observations >= OBSERVATIONS or n >= EVENTS:
                break
    return found


def log_from(run: Run, log: Log, row: int) -> tuple[dict[str, Any], Log]:
    """Return the log from the scan of an observation on, and a configuration for it.

    In the plane robots start where they were before it.
    """
    t_ns, config = run.history.t_ns[run.history.step[row]], dict(run.config)
    for robot in run.history.robots if not run.history.in_space else ():
        before = np.flatnonzero((run.history.robot == robot) & (run.history.t_ns < t_ns))
        if len(before):
            x, y, theta = run.history.poses[before[-1]].tolist()
            section = config["robots"][robot_section(config, robot)]
            section = {**section, "start": {"x_m": x, "y_m": y, "theta_rad": theta}}
            config = with_value(config, ("robots", robot), section)
    return config, replace(log, events=[e for e in log.events if e.t_ns >= t_ns])


def with_cure(config: Mapping[str, Any], log: Log, cure: str) -> tuple[dict[str, Any], Log, list[Event]] | None:
    """Return a configuration, its log and the events of that with the lines of a cure; None if that is in words.

    None, too, if the log has nothing that a line names.
    """
    changed, read, options = dict(config), log, options_of(cure)
    if not options:
        return None
    for option in options:
        path, _, text = option.partition("=")
        names, value = tuple(path.split(".")), parse_value(text, "cure")
        if names[0] == "log":
            is_factor, now = names[1] == "factors", value_at(config, names)
            by: Plain = {}
            put(by, names[2:], value / (now or 1.0) if is_factor else value - (now or 0.0))
            try:
                read = correct_log(read, *((by, None) if is_factor else (None, by)))
            except LogError:
                return None
        else:
            if names[0] == "robots" and names[1] not in changed["robots"]:
                changed = with_value(changed, names[:2], changed["robots"]["each"])
            changed = with_value(changed, names, value)
    return changed, read, list(read.events)


def options_of(cure: str) -> list[str]:
    """Return the options KEY=VALUE of a cure, of the first where it has alternatives; none of one in words.

    >>> options_of("--set robots.car.sensors.lidar.scale=0.99; or: --set robots.car.motion.sigma_v_scale=0.01")
    ['robots.car.sensors.lidar.scale=0.99']
    """
    words = shlex.split(cure.split(OR, maxsplit=1)[0]) if cure.startswith("--set ") else []
    return words[1::2] if {*words[::2]} <= {"--set"} else []


def is_configured(config: Mapping[str, Any], cure: str) -> bool:
    """Return whether a configuration has the values that a cure sets: it cures nothing."""
    options = [option.partition("=") for option in options_of(cure)]
    paths = [path.split(".") for path, _, _ in options]
    at = [(names[0], robot_section(config, names[1]), *names[2:]) if names[0] == "robots" else names for names in paths]
    now = [value_at(config, names) for names in at]
    return bool(now) and now == [parse_value(text, "cure") for _, _, text in options]
