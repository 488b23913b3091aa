"""`kalmark tune`: noise and calibration of a configuration by the first part of a log, judged by the rest.

Rounds of filter, batch solution and estimates, until nothing changes by 3 %: calibrations by the score of what is left
of the data (`kalmark.diagnosis.linear`), each beside all that a log may have instead, then the variance components
(`kalmark.diagnosis.components`).  A parameter that the first part does not determine, or that does not make the
innovations of the rest likelier, stays as it was.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import chi2, norm

from kalmark.arrays import Array, Flags
from kalmark.batch.batch_state import LANDMARKS, Ints
from kalmark.batch.data import BatchInput, replay_events
from kalmark.batch.solver import optimum
from kalmark.config import build_slam, config_dict, open_run
from kalmark.config.reading import config_of, resolve_config
from kalmark.config.tree import Configuration, KeyPath, Plain, Tree, read_tree
from kalmark.diagnosis import causes
from kalmark.diagnosis.batch_search import NEAR, apply_calibration, sensors_of
from kalmark.diagnosis.calibrations import ALPHA, calibrations
from kalmark.diagnosis.causes import LEAST_GAIN, Finding
from kalmark.diagnosis.components import Components, Noise, NoiseEstimate
from kalmark.diagnosis.linear import Linear
from kalmark.diagnosis.tunable_keys import Keys, Values
from kalmark.errors import KalmarkError
from kalmark.logs.log import Log
from kalmark.logs.progress import track
from kalmark.results.batch import batch_input
from kalmark.results.measures import nis
from kalmark.results.record import record
from kalmark.results.run import Run
from kalmark.results.warnings import Window, nis_windows

ROUNDS, SAME = 6, 0.03  # of filter and estimates, until no value changes by more
WIDER = (1e-4, 1e-5, 1e-7, 1e-9, 1e-12, 1e-15)  # shares of right observations that a gate may leave out
LEAST_SCANS = 30  # in each part
INNOVATIONS, MAP = AIMS = ("innovations", "map")
GATE = ("association", "gate")


class Change(NamedTuple):
    """A key that was looked at: its value before and after, the share that it is known to, and why it is as it is.

    `gain` is by how much the log-likelihood of the second part's innovations is larger for it, None if it was not
    tried.
    """

    path: KeyPath
    before: Any
    after: Any
    sigma: float
    why: str
    gain: float | None = None

    @property
    def key(self) -> str:
        """The key as an override names it."""
        return ".".join(self.path)

    @property
    def changed(self) -> bool:
        """True if the value is another one."""
        return bool(self.before != self.after)


class Score(NamedTuple):
    """A configuration's NIS per degree of freedom, log-likelihood and share left out on a part of a log."""

    nis: float
    likelihood: float
    left_out: float


@dataclass(frozen=True, eq=False)
class Tuning:
    """Changed keys, kept keys, and the fit of both parts of the log before and after.

    `correlations` are those of the errors of successive observations by sensor and column, `sigma_factor` is what the
    sigmas of the map are to be multiplied by for them.  `split_s` is the time between both parts since the first scan,
    `windows` are the NIS over time, before and after.
    """

    changes: tuple[Change, ...]
    before: tuple[Score, Score]
    after: tuple[Score, Score]
    split_s: float
    aim: str
    correlations: dict[str, float] = field(default_factory=dict)
    sigma_factor: float = 1.0
    windows: tuple[list[Window], list[Window]] = ((), ())  # type: ignore[assignment]

    @property
    def values(self) -> Values:
        """The new values by the paths of their keys."""
        return {change.path: change.after for change in self.changes if change.changed}


def tune(
    config: str | Path,
    log_path: str | Path | None = None,
    overrides: Sequence[str] = (),
    *,
    share: float = 0.5,
    aim: str = INNOVATIONS,
    keep: Collection[str] = (),
    progress: bool = False,
) -> Tuning:
    """Estimate the noise and the calibrations of a configuration by the first `share` of its log.

    `aim` is a noise by which the innovations are as large as expected, or one by which the map is as good as it claims
    to be, where errors last from observation to observation.  The keys to `keep` are not touched.  Raises KalmarkError.
    """
    if not 0.0 < share < 1.0 or aim not in AIMS:
        raise KalmarkError(f"tune: got share {share!r} and aim {aim!r}, expected a share in (0, 1) and one of {AIMS}")
    made, log = open_run(config, log_path, overrides)
    return Task(config_dict(made), log, share, {*keep}, written_robots(config, overrides), progress).tuned(aim)


def written_robots(config: str | Path, overrides: Sequence[str]) -> Configuration:
    """Return the section of robots as it stands in the file of a configuration, {} if it has none."""
    written = read_tree(resolve_config(config), overrides).values.get("robots")
    return written if isinstance(written, dict) else {}


class ScoredRun(NamedTuple):
    """A run over the whole log: which observations (O,) were used, their d2, degrees of freedom and log-likelihood."""

    run: Run
    used: Flags
    d2: Array
    dof: Ints
    likelihood: Array


class _Fit(NamedTuple):
    """The estimates of a round and what they were made of."""

    noises: dict[Noise, NoiseEstimate]
    found: list[Finding]
    components: Components
    run: Run
    alike: dict[KeyPath, str]


class Task:
    """A configuration and a log in two parts."""

    def __init__(
        self, config: Plain, log: Log, share: float, keep: set[str], written: Configuration, progress: bool
    ) -> None:
        self.keys, self.log, self.progress = Keys(config, written, keep), log, progress
        times = [event.t_ns for event in log.events] or [0]
        self.split_ns = times[0] + int(share * (times[-1] - times[0]))
        self.first = replace(log, events=[event for event in log.events if event.t_ns <= self.split_ns])

    # ------------------------------------------------------------------ runs
    def run(self, values: Values, log: Log) -> Run:
        """Return the run with other values of some keys."""
        made = config_of(Tree(self.keys.changed(values)), None)
        return record(build_slam(made, log), log, progress=False, config=config_dict(made), pictures=False)

    def judged(self, values: Values) -> ScoredRun:
        """Return the whole log filtered with some values."""
        run = self.run(values, self.log)
        h = run.history
        rows = np.flatnonzero(np.isfinite(h.z).any(axis=1) & np.isin(h.outcome, ("associated", "rejected")))
        likelihood, d2, dof = np.full(len(h.z), np.nan), np.full(len(h.z), np.nan), np.zeros(len(h.z), dtype=np.int64)
        d2[rows], dof[rows] = nis(h.z[rows], h.Z[rows])
        for m in np.unique(dof[dof > 0]):
            mine = np.flatnonzero(dof == m)
            logdet = np.linalg.slogdet(h.Z[mine, :m, :m])[1]
            likelihood[mine] = -0.5 * (d2[mine] + logdet + m * math.log(2 * math.pi))
        return ScoredRun(run, h.outcome == "associated", d2, dof, likelihood)

    def scores(self, judged: ScoredRun, before: ScoredRun) -> tuple[Score, Score]:
        """Return the scores of both parts.

        An observation that was left out is as likely as at the edge of the gate before: no noise gains by leaving out.
        """
        h = judged.run.history
        late = h.t_ns[h.step] > self.split_ns
        at_edge = (
            before.likelihood + 0.5 * before.d2 - 0.5 * chi2.ppf(self.gate or 1 - WIDER[0], np.maximum(before.dof, 1))
        )
        values = np.where(judged.used, judged.likelihood, at_edge)
        counts = np.isfinite(values) & np.isfinite(before.likelihood)
        out = []
        for part in (~late, late):
            used = part & judged.used & np.isfinite(judged.d2)
            number = max(int(judged.dof[used].sum()), 1)
            left_out = (part & (h.outcome == "rejected")).sum() / max(part.sum(), 1)
            out.append(
                Score(float(judged.d2[used].sum()) / number, float(values[part & counts].sum()), float(left_out))
            )
        return out[0], out[1]

    @property
    def gate(self) -> float | None:
        """The gate of the configuration, if it has one that may be opened: with known ids."""
        association = self.keys.config.get("association") or {}
        value = association.get("gate")
        return value if association.get("type") == "identity" and isinstance(value, float) else None

    # ------------------------------------------------------------------ estimates
    def fit(self, run: Run, values: Values, sure: set[KeyPath]) -> _Fit:
        """Return the estimates from a run over the first part, with these values."""
        noises = self.keys.noises(run)
        given, linear = self._problem(run)
        found, alike = calibrations(run, linear, given, self.keys, sure)
        for finding in found:
            path, value = finding.of, finding.value
            values[path] = _remove_systematic_error(
                path, self.keys.stated(path) if path not in values else values[path], value
            )
        if found:
            run = self.run(values, self.first)
            given, linear = self._problem(run)
        components = Components(given, self.first, linear.state, noises)
        now = {n: values.get(n.path, n.stated) for n in components.noises}
        return _Fit(components.fit(now), found, components, run, alike)

    def _problem(self, run: Run) -> tuple[BatchInput, Linear]:
        """Return the data of a run over the first part, and their problem linear about its optimum."""
        given = apply_calibration(run, batch_input(run))
        problem = replay_events(given, self.first)
        if not problem.factors:
            raise KalmarkError("tune: no observation of the first part was of a landmark in the map")
        return given, Linear.of(problem, optimum(problem, tolerance=NEAR).state)

    # ------------------------------------------------------------------ the whole
    def tuned(self, aim: str) -> Tuning:
        """Return the tuning."""
        before = self.judged({})
        h = before.run.history
        parts = [int((h.t_ns <= self.split_ns).sum()), int((h.t_ns > self.split_ns).sum())]
        if min(parts) < LEAST_SCANS:
            raise KalmarkError(
                f"tune: the parts of the log have {parts[0]} and {parts[1]} scans, expected {LEAST_SCANS}"
            )
        values, fit, offsets = self._rounds()
        changes = self._changes(values, fit, offsets)
        values = {c.path: c.after for c in changes if c.changed}
        base = self.scores(before, before)
        values |= self._gate(values, base[0].left_out)
        values, changes = self._held_out(values, changes, before)
        rhos, factor, wide = self._correlated(fit, values)
        if aim == MAP:
            changes = [_widened(change, wide) for change in changes]
            values |= {path: change.after for change in changes if (path := change.path) in wide}
        if GATE in values:
            why = "as many observations are left out as before, with the smaller noise"
            changes.append(Change(GATE, self.gate, values[GATE], 0.0, why))
        last = self.judged({c.path: c.after for c in changes if c.changed})
        windows = nis_windows(before.run.history), nis_windows(last.run.history)
        split_s = (self.split_ns - int(h.t_ns[0])) * 1e-9
        return Tuning(tuple(changes), base, self.scores(last, before), split_s, aim, rhos, factor, windows)

    def _rounds(self) -> tuple[Values, _Fit, dict[KeyPath, float]]:
        """Return the values after rounds of filter and estimates, the last estimates and the sigmas of calibrations."""
        values: Values = {}
        offsets: dict[KeyPath, float] = {}
        for _ in track(range(ROUNDS), "filter and estimates", ROUNDS, show=self.progress):
            run = self.run(values | self._opened(values), self.first)
            fit = self.fit(run, values, {*offsets})
            offsets |= {finding.of: finding.sigma for finding in fit.found}
            new = {noise.path: estimate.value for noise, estimate in fit.noises.items()}
            old = {path: values.get(path, self.keys.stated(path) or value) for path, value in new.items()}
            moved = [abs(math.log(max(value, 1e-12) / max(old[path], 1e-12))) for path, value in new.items()]
            moved += [abs(f.value) / max(f.sigma, 1e-12) * SAME for f in fit.found]
            values |= new
            if max(moved, default=0.0) < SAME:
                break
        return values, fit, offsets

    def _opened(self, values: Values) -> Values:
        """Return the gate that is as wide as it was, in units of the measurements, if sigmas of sensors are smaller."""
        shrunk = [
            v / self.keys.stated(p)
            for p, v in values.items()
            if p[2] == "sensors" and p[-1].startswith("sigma_") and self.keys.stated(p)
        ]
        if self.gate is None or min(shrunk, default=1.0) >= 1.0:
            return {}
        edge = chi2.ppf(self.gate, 2) / max(min(shrunk), 0.05) ** 2
        return {GATE: 1.0 - max(float(chi2.sf(edge, 2)), WIDER[-1])}

    def _gate(self, values: Values, left_out: float) -> Values:
        """Return the narrowest gate that leaves out no more of the first part than before, if that one does."""
        widest = self._opened(values).get(GATE)
        if widest is None:
            return {}
        for one_of in (1.0 - self.gate, *WIDER) if self.gate is not None else ():
            value = 1.0 - one_of
            run = self.run(values | {GATE: value}, self.first)
            share = float((run.history.outcome == "rejected").mean())
            if share <= left_out or value >= widest:
                break
        return {GATE: value} if value != self.gate else {}

    def _changes(self, values: Values, fit: _Fit, offsets: dict[KeyPath, float]) -> list[Change]:
        """Return of each key what it becomes: those that the first part does not determine stay as they are."""
        level = float(norm.isf(ALPHA / 2 / max(len(fit.noises), 1)))
        same = {
            noise
            for noise, e in fit.noises.items()
            if noise.stated and e.determined and not e.bound and abs(math.log(e.value / noise.stated)) < level * e.sigma
        }
        again = fit.components.fit({noise: e.value for noise, e in fit.noises.items()}, same) if same else fit.noises
        changes = []
        for noise, old in fit.noises.items():
            e = old if noise in same else again[noise]
            if noise in same:
                changes.append(Change(noise.path, noise.stated, noise.stated, e.sigma, "agrees with the log"))
            elif not e.determined:
                if noise.stated:
                    changes.append(Change(noise.path, noise.stated, noise.stated, 0.0, "the log does not determine it"))
            else:
                why = "at most" if e.bound and e.value < noise.scale else "at least" if e.bound else ""
                changes.append(Change(noise.path, noise.stated, _short(e.value), e.sigma, why))
        for path, sigma in offsets.items():
            stated = self.keys.stated(path)
            changes.append(Change(path, stated, _short(values[path]), sigma, ""))
        changes += [
            Change(p, self.keys.stated(p), self.keys.stated(p), 0.0, why)
            for p, why in fit.alike.items()
            if p not in offsets
        ]
        return changes

    def _held_out(self, values: Values, changes: list[Change], before: ScoredRun) -> tuple[Values, list[Change]]:
        """Return the values without those that do not make the second part's innovations likelier, and why."""
        whole = self.scores(self.judged(values), before)[1].likelihood
        base = self.scores(before, before)[1].likelihood
        tried = []
        for change in track(changes, "each key on the second part", len(changes), show=self.progress):
            if not change.changed:
                tried.append(change)
                continue
            others = {path: value for path, value in values.items() if path != change.path}
            gain = whole - self.scores(self.judged(others), before)[1].likelihood
            if gain > 0:
                tried.append(change._replace(gain=gain))
            else:
                why = f"{_text(change.after)} is less likely on the second part"
                tried.append(change._replace(after=change.before, gain=gain, why=why))
        kept = {c.path: c.after for c in tried if c.changed} | {p: v for p, v in values.items() if p == GATE}
        if self.scores(self.judged(kept), before)[1].likelihood <= base:
            why = "all changes together are less likely on the second part"
            return {}, [c._replace(after=c.before, why=why) if c.changed else c for c in tried]
        return kept, tried

    def _correlated(self, fit: _Fit, values: Values) -> tuple[dict[str, float], float, dict[KeyPath, float]]:
        """Return the correlations of errors, the factor of the map's sigmas by them, and those of the noises."""
        components = fit.components
        linear = components.linear(components.t_of({n: values.get(n.path, n.stated) for n in components.noises}))
        sensors, t_s = sensors_of(fit.run), np.zeros(len(linear.problem.robots))
        given = components.given
        t_s[linear.problem.nodes] = (given.t_ns - given.t_ns[:1].sum()) * 1e-9
        found = causes.correlations(linear, linear.simulated(causes.SETS), sensors, t_s)
        found = [f for f in found if f.p * len(found) < ALPHA and f.gain > LEAST_GAIN and f.value > 0]
        wide: dict[KeyPath, float] = {}
        honest = linear
        for finding in found:
            honest = honest.scaled(finding.noise, 1.0)
            robot, sensor, column = finding.of
            stem, unit = column.rsplit("_", 1)
            for noise in components.noises:
                if (
                    robot in noise.robots
                    and noise.path[3:4] == (sensor,)
                    and noise.path[-1] in (f"sigma_{stem}_{unit}", f"sigma_{stem}_rel")
                ):
                    wide[noise.path] = max(
                        wide.get(noise.path, 1.0), math.sqrt((1 + finding.value) / (1 - finding.value))
                    )
        rhos = {".".join(finding.of): finding.value for finding in found}
        if not found or not len(linear.state.groups[LANDMARKS]):
            return rhos, 1.0, wide
        one, two = (
            np.trace(x.reduced.covariances()[:, : linear.state.d, : linear.state.d], axis1=1, axis2=2)
            for x in (linear, honest)
        )
        some = one > 0
        return rhos, float(np.median(np.sqrt(two[some] / one[some]))) if some.any() else 1.0, wide


def _remove_systematic_error(path: KeyPath, value: float, s: float) -> float:
    """Return a calibration with the systematic error s taken out."""
    kind = path[-1]
    return value * (1.0 + s) if kind == "scale" else value + s if kind == "bias_m" else value - s


def _widened(change: Change, wide: Mapping[KeyPath, float]) -> Change:
    """Return the white noise with the information of the correlated one."""
    factor = wide.get(change.path)
    if factor is None or not change.after:
        return change
    why = f"{_text(change.after)} by the innovations, times {factor:.3g} for errors that last"
    return change._replace(after=_short(change.after * factor), why=why)


def _short(value: float) -> float:
    return float(f"{value:.3g}")


def _text(value: Any) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)
