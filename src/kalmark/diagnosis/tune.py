"""`kalmark tune`: noise and calibration of a configuration by the first part of a log, judged by the rest.

Rounds of filter, batch solution and estimates, until nothing changes by 3 %: calibrations by the score of what is left
of the data (`kalmark.diagnosis.linear`), each beside all that a log may have instead, then the variance components
(`kalmark.diagnosis.components`).  What the first part does not determine, and what does not make the innovations of
the rest likelier, is left as it was.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import chi2, norm

from kalmark.arrays import Array, Flags
from kalmark.batch.data import Given, replayed
from kalmark.batch.problem import sightings
from kalmark.batch.solver import optimum
from kalmark.batch.state import LANDMARKS, Ints
from kalmark.config import build_slam, config_dict, open_run
from kalmark.config.opening import EACH
from kalmark.config.reading import config_of, resolve_config
from kalmark.config.tree import Tree, read_tree
from kalmark.diagnosis import causes
from kalmark.diagnosis.causes import MOST_SCALE, Column, Finding
from kalmark.diagnosis.components import Components, Estimate, Noise
from kalmark.diagnosis.linear import Linear
from kalmark.diagnosis.search import LEAST_GAIN
from kalmark.diagnosis.verdict import NEAR, calibrated, sensors_of
from kalmark.errors import KalmarkError
from kalmark.logs.log import Log
from kalmark.models.observe import view_of
from kalmark.results.batch import given_by
from kalmark.results.measures import nis
from kalmark.results.progress import track
from kalmark.results.record import record
from kalmark.results.run import Run
from kalmark.results.warnings import Window, nis_windows

ROUNDS, SAME = 6, 0.03  # of filter and estimates, until no value changes by more
ALPHA = 0.01  # of right configurations of which anything is changed
WIDER = (1e-4, 1e-5, 1e-7, 1e-9, 1e-12, 1e-15)  # shares of right observations that a gate may leave out
KNOWN_TO = {"": MOST_SCALE, "m": 0.1}  # scales and places of mounts beforehand: what is more is no error
MOUNT = "mount"  # the systematic error that is its place
MOVED_M = 1e-5  # of a mount, for its derivative
LEAST_SCANS = 30  # in each part
INNOVATIONS, MAP = AIMS = ("innovations", "map")
CALIBRATIONS = {"range_scale": ("scale",), "range_offset": ("bias_m",), "bearing_offset": ("mount", "theta_rad")}
GATE = ("association", "gate")

Path_ = tuple[str, ...]
Values = dict[Path_, Any]


class Change(NamedTuple):
    """A key that was looked at: its value before and after, the share that it is known to, and why it is as it is.

    `gain` is by how much the log-likelihood of the second part's innovations is larger for it, None if it was not
    tried.
    """

    path: Path_
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
        """Whether the value is another one."""
        return bool(self.before != self.after)


class Score(NamedTuple):
    """A configuration's NIS per degree of freedom, log-likelihood and share left out on a part of a log."""

    nis: float
    likelihood: float
    left_out: float


@dataclass(frozen=True, eq=False)
class Tuning:
    """What was changed and what was left, and how both parts of the log fit before and after.

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
    written = read_tree(resolve_config(config), overrides).values.get("robots")
    task = _Task(config_dict(made), log, share, {*keep}, written if isinstance(written, dict) else {}, progress)
    return task.tuned(aim)


class _Judged(NamedTuple):
    """A run over the whole log: which observations (O,) were used, their d2, degrees of freedom and log-likelihood."""

    run: Run
    used: Flags
    d2: Array
    dof: Ints
    likelihood: Array


class _Fit(NamedTuple):
    """The estimates of a round and what they were made of."""

    noises: dict[Noise, Estimate]
    found: list[Finding]
    components: Components
    run: Run
    alike: dict[Path_, str]


class _Task:
    """A configuration and a log in two parts."""

    def __init__(
        self, config: dict[str, Any], log: Log, share: float, keep: set[str], written: Mapping[str, Any], progress: bool
    ) -> None:
        self.config, self.log, self.keep, self.written, self.progress = config, log, keep, written, progress
        times = [event.t_ns for event in log.events] or [0]
        self.split_ns = times[0] + int(share * (times[-1] - times[0]))
        self.first = replace(log, events=[event for event in log.events if event.t_ns <= self.split_ns])

    # ------------------------------------------------------------------ runs
    def run(self, values: Values, log: Log) -> Run:
        """Return the run with other values of some keys."""
        content = deepcopy(self.config)
        for path, value in values.items():
            node = content
            for owner in self._owners(path):
                node = content
                for key in owner[:-1]:
                    node = node.setdefault(key, {})
                node[owner[-1]] = value
        made = config_of(Tree(content), None)
        return record(build_slam(made, log), log, progress=False, config=config_dict(made))

    def _owners(self, path: Path_) -> list[Path_]:
        """Return the paths in the configuration in force of a key in the file."""
        robots = self.config["robots"]
        if path[0] != "robots" or path[1] in robots:
            return [path]
        return [("robots", name, *path[2:]) for name in robots if self.section(name) == path[1]]

    def section(self, name: str) -> str:
        """Return the name of the section of the file that a robot, or section, of the configuration in force is in."""
        return EACH if name not in self.written and EACH in self.written else name

    def judged(self, values: Values) -> _Judged:
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
        return _Judged(run, h.outcome == "associated", d2, dof, likelihood)

    def scores(self, judged: _Judged, before: _Judged) -> tuple[Score, Score]:
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
        association = self.config.get("association") or {}
        value = association.get("gate")
        return value if association.get("type") == "identity" and isinstance(value, float) else None

    # ------------------------------------------------------------------ keys
    def noises(self, run: Run) -> list[Noise]:
        """Return the noises of the configuration that may be estimated."""
        found: dict[Path_, Noise] = {}
        for path, names, value in self._keys(run):
            if not path[-1].startswith("sigma_") or "_bias_" in path[-1] or path[-1] == "sigma_scale":
                continue
            scale = value or self._begin(run, path)
            if scale > 0 and ".".join(path) not in self.keep:
                robots = (*(found[path].robots if path in found else ()), *names)
                found[path] = Noise(path, robots, float(value), scale)
        return [*found.values()]

    def _keys(self, run: Run) -> Iterator[tuple[Path_, tuple[str, ...], float]]:
        """Yield the numbers of the models: path in the file, robots, value."""
        robots: Mapping[str, Any] = self.config["robots"]
        for name, robot in robots.items():
            names = tuple(n for n in run.final_slam().robots if n == name or (name == EACH and n not in robots))
            here = ("robots", self.section(name))
            parts: list[tuple[Path_, Any]] = [((*here, "motion"), robot["motion"])]
            parts += [((*here, "sensors", s), section) for s, section in robot["sensors"].items()]
            for path, section in parts if names else ():
                for key, value in section.items():
                    if isinstance(value, float | int) and not isinstance(value, bool):
                        yield (*path, key), names, value

    def _begin(self, run: Run, path: Path_) -> float:
        """Return the value that a noise which is not stated is looked for from: that of a range may grow with it."""
        if path[-1] != "sigma_range_rel":
            return 0.0
        h = run.history
        mine = (h.sensor == path[3]) & np.isfinite(h.y[:, 0])
        sigma = run.section(str(h.robot[h.step[mine][0]]), path[3]).get("sigma_range_m", 0.0) if mine.any() else 0.0
        return float(sigma / max(np.median(h.y[mine, 0]), 1e-3)) if mine.any() else 0.0

    def calibration(self, run: Run, column: Column) -> Path_ | None:
        """Return the path of the key of a systematic error, None if it has none, or is in the map."""
        if column.name not in CALIBRATIONS:
            return None
        robot, sensor, _ = column.of
        path: Path_ = ("robots", self.section(robot if robot in self.config["robots"] else EACH), "sensors", sensor)
        section = run.section(robot, sensor)
        mount = section.get("mount") or {}
        in_map = any(section.get(key) for key in ("sigma_scale", "sigma_bias_m"))
        in_map |= any(value for key, value in mount.items() if key.startswith("sigma_"))
        path = (*path, *CALIBRATIONS[column.name])
        known = CALIBRATIONS[column.name][0] in section
        return path if known and not in_map and ".".join(path) not in self.keep else None

    def stated(self, path: Path_) -> Any:
        """Return the value of a key as it is in force."""
        node: Any = self.config
        for key in self._owners(path)[0]:
            node = node.get(key) if isinstance(node, Mapping) else None
        return node

    # ------------------------------------------------------------------ estimates
    def fit(self, run: Run, values: Values, sure: set[Path_]) -> _Fit:
        """Return the estimates from a run over the first part, with these values."""
        given = calibrated(run, given_by(run))
        problem = replayed(given, self.first)
        if not problem.factors:
            raise KalmarkError("tune: no observation of the first part was of a landmark in the map")
        linear = Linear.of(problem, optimum(problem, tolerance=NEAR).state)
        found, alike = self._calibrations(run, linear, given, sure)
        for finding in found:
            path, value = finding.of, finding.value
            values[path] = _calibrated(path, self.stated(path) if path not in values else values[path], value)
        again = self.run(values, self.first) if found else run
        if found:
            given = calibrated(again, given_by(again))
            problem = replayed(given, self.first)
            linear = Linear.of(problem, optimum(problem, tolerance=NEAR).state)
        components = Components(given, self.first, linear.state, self.noises(run))
        now = {n: values.get(n.path, n.stated) for n in components.noises}
        return _Fit(components.fit(now), found, components, again, alike)

    def _calibrations(
        self, run: Run, linear: Linear, given: Given, sure: set[Path_]
    ) -> tuple[list[Finding], dict[Path_, str]]:
        """Return the calibrations that are off, and of those that the log cannot tell from another error, from which.

        All systematic errors are estimated together, so that one that the log does not determine has a large sigma.
        Those that it determines are estimated again without scales and places of mounts, which are not linear.
        """
        columns = causes.columns_of(linear, sensors_of(run), causes.rates_of(linear, given.robot, given.t_ns))
        columns += _mounts(linear, given)
        paths = [self.calibration(run, column) for column in columns]
        joined: dict[Any, Column] = {}
        for column, path in zip(columns, paths, strict=True):
            key = path or (column.name, *column.of)
            old = joined.get(key)
            joined[key] = column if old is None else column._replace(Z=old.Z + column.Z, W=old.W + column.W)
        keys, columns = [*joined], [*joined.values()]
        if not columns:
            return [], {}
        s, sigma, alone = _together(linear, columns)
        level = float(norm.isf(ALPHA / 2 / max(sum(path is not None for path in {*paths}), 1)))
        chosen, alike = [], {}
        for k, (key, column) in enumerate(zip(keys, columns, strict=True)):
            if key not in paths:
                continue
            if key in sure or (_shows(s[k], sigma[k], level) and (column.unit or abs(s[k]) < MOST_SCALE)):
                chosen.append(k)
            elif _shows(*alone[k], level):
                alike[key] = f"the log does not tell it from other systematic errors (alone {alone[k][0]:+.3g})"
        beside = [k for k, c in enumerate(columns) if keys[k] not in paths and c.unit and c.name != MOUNT]
        s, sigma, _ = _together(linear, [columns[k] for k in chosen + beside]) if chosen else (s, sigma, alone)
        found = [
            Finding(columns[k].name, keys[k], 0.0, 0.0, float(s[n]), float(sigma[n]), columns[k].unit)
            for n, k in enumerate(chosen)
        ]
        return found, alike

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
        changes += self._gate_change(values)
        last = self.judged({c.path: c.after for c in changes if c.changed})
        windows = nis_windows(before.run.history), nis_windows(last.run.history)
        split_s = (self.split_ns - int(h.t_ns[0])) * 1e-9
        return Tuning(tuple(changes), base, self.scores(last, before), split_s, aim, rhos, factor, windows)

    def _rounds(self) -> tuple[Values, _Fit, dict[Path_, float]]:
        """Return the values after rounds of filter and estimates, the last estimates and the sigmas of calibrations."""
        values: Values = {}
        offsets: dict[Path_, float] = {}
        for _ in track(range(ROUNDS), "filter and estimates", ROUNDS, show=self.progress):
            run = self.run(values | self._opened(values), self.first)
            fit = self.fit(run, values, {*offsets})
            offsets |= {finding.of: finding.sigma for finding in fit.found}
            new = {noise.path: estimate.value for noise, estimate in fit.noises.items()}
            moved = [
                abs(math.log(max(v, 1e-12) / max(values.get(p, self.stated(p) or v), 1e-12))) for p, v in new.items()
            ]
            moved += [abs(f.value) / max(f.sigma, 1e-12) * SAME for f in fit.found]
            values |= new
            if max(moved, default=0.0) < SAME:
                break
        return values, fit, offsets

    def _opened(self, values: Values) -> Values:
        """Return the gate that is as wide as it was, in units of the measurements, if sigmas of sensors are smaller."""
        shrunk = [
            v / self.stated(p)
            for p, v in values.items()
            if p[2] == "sensors" and p[-1].startswith("sigma_") and self.stated(p)
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

    def _changes(self, values: Values, fit: _Fit, offsets: dict[Path_, float]) -> list[Change]:
        """Return of each key what it becomes: those that the first part does not determine stay as they are."""
        level = float(norm.isf(ALPHA / 2 / max(len(fit.noises), 1)))
        same = {
            noise
            for noise, e in fit.noises.items()
            if noise.stated and e.determined and not e.bound and abs(math.log(e.value / noise.stated)) < level * e.sigma
        }
        again = fit.components.fit(values_of(fit.noises), same) if same else fit.noises
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
            stated = self.stated(path)
            changes.append(Change(path, stated, _short(values[path]), sigma, ""))
        changes += [
            Change(p, self.stated(p), self.stated(p), 0.0, why) for p, why in fit.alike.items() if p not in offsets
        ]
        return changes

    def _held_out(self, values: Values, changes: list[Change], before: _Judged) -> tuple[Values, list[Change]]:
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

    def _gate_change(self, values: Values) -> list[Change]:
        if GATE not in values:
            return []
        why = "as many observations are left out as before, with the smaller noise"
        return [Change(GATE, self.gate, values[GATE], 0.0, why)]

    def _correlated(self, fit: _Fit, values: Values) -> tuple[dict[str, float], float, dict[Path_, float]]:
        """Return the correlations of errors, the factor of the map's sigmas by them, and those of the noises."""
        components = fit.components
        linear = components.linear(components.t_of({n: values.get(n.path, n.stated) for n in components.noises}))
        sensors, t_s = sensors_of(fit.run), np.zeros(len(linear.problem.robots))
        given = components.given
        t_s[linear.problem.nodes] = (given.t_ns - given.t_ns[:1].sum()) * 1e-9
        found = causes.correlations(linear, linear.simulated(causes.SETS), sensors, t_s)
        found = [f for f in found if f.p * len(found) < ALPHA and f.gain > LEAST_GAIN and f.value > 0]
        wide: dict[Path_, float] = {}
        honest = linear
        for finding in found:
            honest = honest.scaled(finding.noise, None)
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


def values_of(noises: Mapping[Noise, Estimate]) -> dict[Noise, float]:
    """Return the values of some estimates."""
    return {noise: estimate.value for noise, estimate in noises.items()}


def _mounts(linear: Linear, given: Given) -> Iterator[Column]:
    """Yield what a sensor that sits elsewhere adds to the data, by each coordinate of its place, in 1/m."""
    none, d = np.zeros(len(linear.at.w)), linear.state.d
    for f, factor in enumerate(linear.problem.factors):
        robot, sensor = factor.sensor
        mount = given.robots[robot].sensors[sensor] if sensor else None
        if mount is None or (robot, sensor) in given.mounts or factor.term.blocks[-1].group != LANDMARKS:
            continue
        z, _ = factor.term.at(linear.state)
        for axis in range(d):
            at = np.array(mount.at, dtype=np.float64)
            at[axis] += MOVED_M
            view = view_of(mount.sensor, given.landmark, at)
            moved, _ = sightings(view, factor.term.blocks, factor.y, factor.R, np.inf, factor.sensor).term.at(
                linear.state
            )
            parts = [np.zeros(other.R.shape[:2]) for other in linear.problem.factors]
            parts[f] += (z - moved) / MOVED_M
            yield Column(MOUNT, (robot, sensor, "xyz"[axis]), "m", linear.whitened(parts), none)


def _together(linear: Linear, columns: list[Column]) -> tuple[Array, Array, list[tuple[float, float]]]:
    """Return the systematic errors s (K,), all estimated at once, and their sigmas (K,); and each as if alone.

    The sigmas are by stretches of the run where these vary more than the noise says (`causes.systematic`).
    """
    Z, W = np.stack([c.Z for c in columns], axis=1), np.stack([c.W for c in columns], axis=1)
    have, left = linear.residuals, linear.left(Z, W)
    g, I = Z.T @ have.r + W.T @ have.m, Z.T @ left.r + W.T @ left.m
    prior = [KNOWN_TO.get(column.unit, np.inf) if column.name != "range_offset" else np.inf for column in columns]
    I = I + np.diag(np.array(prior) ** -2.0)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(I), 1e-300))
    C = scale[:, None] * np.linalg.pinv(I * np.outer(scale, scale), rcond=1e-12, hermitian=True) * scale
    s = C @ g
    P = causes.stretches(linear, left, s)
    sigma = np.sqrt(np.maximum(np.diag(C), np.diag(C @ P @ P.T @ C)))
    alone = {(f.name, *f.of): (f.value, f.sigma) for f in causes.systematic(linear, columns)}
    return s, sigma, [alone.get((c.name, *c.of), (0.0, math.inf)) for c in columns]


def _shows(s: float, sigma: float, level: float) -> bool:
    """Return whether a systematic error is other than zero."""
    return abs(s) > level * sigma and 0.5 * (s / sigma) ** 2 > LEAST_GAIN


def _calibrated(path: Path_, value: float, s: float) -> float:
    """Return a calibration with the systematic error s taken out."""
    kind = path[-1]
    return value * (1.0 + s) if kind == "scale" else value + s if kind == "bias_m" else value - s


def _widened(change: Change, wide: Mapping[Path_, float]) -> Change:
    """Return a noise as large as says as little as the correlated one."""
    factor = wide.get(change.path)
    if factor is None or not change.after:
        return change
    why = f"{_text(change.after)} by the innovations, times {factor:.3g} for errors that last"
    return change._replace(after=_short(change.after * factor), why=why)


def _short(value: float) -> float:
    return float(f"{value:.3g}")


def _text(value: Any) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)
