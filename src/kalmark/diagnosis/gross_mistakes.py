"""Mistakes after which no filter works: the beginning of the log is filtered again as if each had been made.

A mistake is named where the log fits the filter as it should once the mistake is taken out, and does not as it is.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from copy import deepcopy
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from kalmark.arrays import Array, Flags
from kalmark.config import build_slam
from kalmark.config.reading import config_of
from kalmark.config.tree import Tree
from kalmark.diagnosis.cause_texts import UNKNOWN_IDS
from kalmark.diagnosis.mistakes import Mistake, late_scans, mistakes, robot_section, with_value
from kalmark.errors import KalmarkError
from kalmark.events import Control, Event, Fix, Scan, sort_key
from kalmark.geometry.frames3d import to_euler_pose
from kalmark.logs.log import Log
from kalmark.logs.progress import track
from kalmark.report import ALONE
from kalmark.results.control_gaps import while_lost
from kalmark.results.figure_texts import figure
from kalmark.results.history import RobotStart
from kalmark.results.measures import Rigid, level, level_sigmas, rigid, rigid_robust, rmse
from kalmark.results.record import record
from kalmark.results.run import Run
from kalmark.results.warnings import left_out_by_attention
from kalmark.slam.held_readings import AGAIN

SCANS, OBSERVATIONS, EVENTS = 400, 3000, 10_000  # of the log are filtered again, whatever comes first
DETECTED = 7  # observations in a raw scan, or so
FEW_SCANS = 80  # of them at first: a log that does not fit shows it soon
FEW_SKIPPED = 0.02  # of the events may be refused in a log that fits
MISFIT = 2.5  # mean of d2 per degree of freedom, above which a run is worth it
FITS = 2.0  # below which a log fits
MUCH = 3.0  # times better is the log without the mistake
ALIKE = 0.95  # of the gain of the likeliest mistake: the log does not distinguish them
BETTER = 1.5  # times better it fits without the mistake
FEWER = 2.0  # times fewer observations without an id fit nothing: the others are clutter
LOST = 9.0  # what an observation without an id counts that is of no landmark in the map: as one at the gate
MOST = 25.0  # that one observation counts, and what counts one that was left out
REJECTED = 0.5  # of the fixes, from which on their robot is not where it should be
LEAST_FIXES = 5
WINDOW = 30  # observations, over which is asked whether the log fits from there on
IN_A_ROW = 8  # sightings of a landmark that do not fit: its id may mean another one from there on
SAME = 0.25  # of the distance to the next landmark, within which two places are one
DOUBLED, SHORTER = 3, 0.25  # steps to the time by which scans are late, and the shortest, of the time of a control
COMMON = 4  # landmarks, of which most are where they were
MOVED = "moving_landmark"  # also one that was moved once


class Fit(NamedTuple):
    """Fit of observations (O,): d2 per degree of freedom, at most `MOST`, and the degrees of freedom of each."""

    values: Array
    dof: Array

    @property
    def mean(self) -> float:
        """Its mean over the observations; that of a log that the filter refuses, or that has none, is infinite."""
        return float(self.values.mean()) if len(self.values) else math.inf

    @property
    def chi2(self) -> float:
        """The sum of the d2."""
        return float(self.values @ self.dof)

    @property
    def share(self) -> float:
        """The share of the observations that fit a landmark."""
        return float(np.mean(self.values < LOST)) if len(self.values) else 0.0

    def fits(self, most: float, before: Fit) -> bool:
        """Return whether the mean is below `most`, or that of all with a landmark, which are far more than before."""
        lost, were = self.values == LOST, before.values == LOST
        some = FEWER * lost.sum() * len(were) < were.sum() * len(lost)
        return self.mean < most or bool(some and self.values[~lost].mean() < most)

    def of(self, rows: slice) -> Fit:
        """Return that of some observations."""
        return Fit(self.values[rows], self.dof[rows])


REFUSED = Fit(np.zeros(0), np.zeros(0))


def fit_of_run(run: Run) -> Fit:
    """Return the fit of the observations of a run: one without a landmark counts `MOST`.

    What has no id counts `LOST` where it is of no landmark in the map: a filter that is lost makes new ones all the
    time, and clutter fits none either.  What is deferred after a gap, until the robot is known again, contradicts
    nothing, nor does what is of a landmark that no sensor has started, what was given before, or what an attention
    leaves out.
    """
    history = run.history
    dof = np.maximum(np.isfinite(history.z).sum(axis=1), 1)
    d2 = np.minimum(np.nan_to_num(history.d2, nan=0.0) / dof, MOST)
    d2 = np.where(np.isin(history.outcome, ("rejected", "ignored")), MOST, d2)
    d2 = np.where((history.id == "") & (history.outcome != "associated"), LOST, d2)
    early = (np.char.find(history.reason, ALONE) >= 0) | left_out_by_attention(history)
    early |= (history.outcome == "deferred") & while_lost(history)[history.step]
    early |= history.reason == AGAIN
    return Fit(np.where(early, 1.0, d2), dof)


def explained_chi2(before: Fit, after: Fit) -> float:
    """Return half of the chi-square that is less after than before; what a filter refused fitted nothing."""
    refused = MOST * float(after.dof.sum())
    return 0.5 * ((before.chi2 if len(before.values) else refused) - after.chi2)


def gross(run: Run, log: Log, progress: bool = False) -> Mistake | None:
    """Return the mistake that explains why a run does not fit, None if it does fit or if none explains it."""
    if not run.config.get("robots"):
        return None
    found = find_wrong_starts(run, log)
    if found is not None:
        return found
    now = fit_of_run(run)
    first = misfits_from(now)
    if now.mean < MISFIT and not run.stopped:
        found = find_exchanged_ids(run, log, now)
    else:
        found = likeliest(run, log, first_events(run, log), run.config, progress) or find_exchanged_ids(run, log, now)
        found = found or (None if first is None else find_kidnap(run, log, now, first))
    return found or (None if first is None else find_later_mistake(run, log, first))


def likeliest(
    run: Run, log: Log, events: list[Event], config: Mapping[str, Any], progress: bool = False
) -> Mistake | None:
    """Return the mistake without which events fit best, None if they fit as they are or without none."""
    as_it_is = fit_of_events(config, log, events)
    if as_it_is.mean < MISFIT:
        return None
    few, made = first_events(run, events, FEW_SCANS), []
    few_as_they_are = fit_of_events(config, log, few)
    for mistake in track([*mistakes(config, run)], "mistakes, one after the other", show=progress):
        if not fit_without(mistake, log, few).fits(MISFIT, few_as_they_are):
            continue
        after = fit_without(mistake, log, events)
        if fits_better(after, as_it_is):
            gain = explained_chi2(as_it_is, after) - as_it_is.share * shrinkage(mistake, events)
            made += [mistake._replace(gain=gain, since_s=events[0].t_s)] if gain > 0.0 else []
    if not made and (run.history.id == "").any():
        made = [found for name in run.history.robots if (found := find_delay(run, log, events, config, name, as_it_is))]
    if not made:
        return None
    most = max(mistake.gain for mistake in made)
    first, *alike = [mistake for mistake in made if mistake.gain > ALIKE * most]
    others = "; or: ".join(mistake.evidence for mistake in alike)
    told = f"; the log cannot tell this from: {others}" if others else ""
    return first._replace(evidence=f"{first.evidence}{told}")


def fits_better(after: Fit, before: Fit) -> bool:
    """Return whether a log fits without a mistake, and far better than with it."""
    return after.fits(FITS, before) and BETTER * after.mean < before.mean


def find_delay(
    run: Run, log: Log, events: list[Event], config: Mapping[str, Any], robot: str, as_it_is: Fit
) -> Mistake | None:
    """Return that the scans of a robot are late or early, if the events fit then.

    Where ids are unknown, the scans that show it most are of no landmark, and no residual is left of them.  Steps from
    as long as a control lasts, each twice as long, go to where the events fit best, then shorter ones: increments do
    not show less than their interval.
    """
    mine = [[e.t_ns for e in events if isinstance(e, kind) and e.robot == robot] for kind in (Control, Scan)]
    if min(map(len, mine)) < FEW_SCANS:
        return None
    control_s, scan_s = (float(np.median(np.diff(t_ns))) * 1e-9 for t_ns in mine)
    tried = {0.0: as_it_is}

    def near(step_s: float) -> float:
        """Return the best of a time and those a step before and after it."""
        some = [round(best + k * step_s, 6) for k in (0, -1, 1)]
        for by_s in some:
            if by_s not in tried:
                tried[by_s] = fit_without(late_scans(config, robot, by_s), log, events)
        return min(some, key=lambda by_s: tried[by_s].mean)

    best, step, least = 0.0, max(control_s, 0.5 * scan_s), control_s
    for _ in range(DOUBLED):
        last, best = best, near(step)
        if best == last:
            break
        step *= 2.0
    if run.final_slam().robots[robot].motion.held:
        least *= SHORTER
    while best != 0.0 and step > 1.5 * least:
        step *= 0.5
        best = near(step)
    if not fits_better(tried[best], as_it_is):
        return None
    gain = explained_chi2(as_it_is, tried[best])
    return late_scans(config, robot, best)._replace(gain=gain, since_s=events[0].t_s, share=0.0)


def shrinkage(mistake: Mistake, events: list[Event]) -> float:
    """Return the logarithm of by how much all measurements of events are smaller without a mistake.

    The density of y is that of f y times f: values scaled to below the noise fit, but have little information.
    It counts for the share that fits as it is; what fits nothing counts a constant instead of its density.
    """
    return sum(len(e.y) * mistake.shrunk.get((e.robot, e.sensor), 0.0) for e in events if isinstance(e, Scan))


def find_later_mistake(run: Run, log: Log, first: int) -> Mistake | None:
    """Return the mistake from the observation `first` on: a sensor that was turned, a source that was exchanged.

    The log is filtered again from there, from the robots' poses.
    """
    t_ns, _, rest = _from(run, log, first)
    config = run.config
    for robot in run.history.robots if not run.history.in_space else ():
        before = np.flatnonzero((run.history.robot == robot) & (run.history.t_ns < t_ns))
        if len(before):
            x, y, theta = run.history.poses[before[-1]].tolist()
            path = ("robots", robot_section(config, robot))
            section = {**config["robots"][path[1]], "start": {"x_m": x, "y_m": y, "theta_rad": theta}}
            config = with_value(config, ("robots", robot), section)
    found = likeliest(run, log, rest, config)
    if found is None:
        return None
    evidence = f"from t={t_ns * 1e-9:.1f} s on {found.evidence}"
    return found._replace(evidence=evidence, cure="")


def misfits_from(now: Fit) -> int | None:
    """Return the observation from which on a run does not fit any more, that fitted before; None if there is none."""
    values = now.values
    if len(values) < 4 * WINDOW:
        return None
    bad = np.convolve(values, np.full(WINDOW, 1.0 / WINDOW), mode="valid") > MUCH * FITS
    first = int(np.argmax(bad)) + WINDOW if bad.any() else 0
    if not WINDOW < first < len(values) - WINDOW or values[: first - WINDOW].mean() > FITS:
        return None
    return first if values[first:].mean() > MISFIT else None


def find_wrong_starts(run: Run, log: Log) -> Mistake | None:
    """Return that robots start elsewhere, or turned, if most of their fixes were rejected and then fit.

    The path of each robot without fixes and the others, moved about the vertical axis onto its fixes, has the start.
    """
    events, config, told, begin_s = first_events(run, log), run.config, [], math.inf
    lost = [start for start in run.history.starts if _used(run, start.robot) <= 1.0 - REJECTED]
    for start in lost:
        found = _onto_its_fixes(run, log, events, start)
        if found is not None:
            config, *words = started_at(config, start, *found)
            told.append(words)
            begin_s = min(begin_s, start.t_ns * 1e-9)
    after = filter_events(config, log, events) if told else None
    if after is None or fit_of_run(after).mean > FITS or any(_used(after, start.robot) <= REJECTED for start in lost):
        return None
    gain = explained_chi2(_fit_of_fixes(run, len(after.history.fixes)), _fit_of_fixes(after))
    evidence, cure = (sep.join(parts) for sep, parts in zip(("; ", " "), zip(*told, strict=True), strict=True))
    return Mistake("start", evidence, cure, config, None, gain, begin_s)


def _onto_its_fixes(run: Run, log: Log, events: list[Event], start: RobotStart) -> tuple[Rigid, Array, float] | None:
    """Return what moves the path of a robot alone onto its fixes, these (N, d), and their variance, m^2.

    None if the path fits them nearly as well as it is: then it was another robot that started elsewhere.
    """
    path = filter_events(run.config, log, list(_alone(events, start.robot, run.history.robots)))
    mine = np.zeros(0, np.bool_) if path is None else path.history.robot == start.robot
    if path is None or not mine.any():
        return None
    t_ns, p = path.history.t_ns[mine], path.history.poses[mine, : run.history.d]
    seen = [e for e in events if isinstance(e, Fix) and e.robot == start.robot and t_ns[0] <= e.t_ns <= t_ns[-1]]
    if len(seen) < LEAST_FIXES:
        return None
    at = np.column_stack([np.interp([e.t_ns for e in seen], t_ns, x) for x in p.T])
    y = np.array([e.y for e in seen])
    onto = level(at, y)
    if rmse(at - y) < MUCH * rmse(onto(at) - y):
        return None
    return onto, y, float(np.mean([np.diag(e.cov) for e in seen]))


def _used(run: Run, robot: str) -> float:
    """Return the share of a robot's fixes that the filter used; all of few."""
    used = [fix.used for fix in run.history.fixes if fix.robot == robot]
    return float(np.mean(used)) if len(used) >= LEAST_FIXES else 1.0


def _alone(events: list[Event], robot: str, robots: Sequence[str]) -> Iterator[Event]:
    """Yield the events of a robot without its fixes and its sightings of others."""
    for e in events:
        if e.robot != robot or isinstance(e, Fix):
            continue
        if not isinstance(e, Scan) or e.ids is None or not {*robots}.intersection(e.ids):
            yield e
            continue
        yield _rows_of(e, [k for k, name in enumerate(e.ids) if name not in robots])


def started_at(
    config: Mapping[str, Any], start: RobotStart, onto: Rigid, fixes: Array, variance: float
) -> tuple[dict[str, Any], str, str]:
    """Return a configuration with a start that is moved, and that in words and as a line that makes it.

    It is as uncertain as `fixes` (N, d) of a variance leave it.
    """
    before = start.mean[: 3 if len(onto.shift) == 2 else 7]
    robots = config.get("robots") or {}
    moved = onto.poses(before[None])[0]
    sigma_m, sigma_rad = level_sigmas(fixes, variance, moved[: len(onto.shift)])
    if len(onto.shift) == 2:
        sigmas: dict[str, Any] = {"sigma_xy_m": sigma_m, "sigma_theta_rad": sigma_rad}
    else:
        sigmas = {"sigma_position_m": sigma_m, "sigma_rotation_deg": [0.0, 0.0, math.degrees(sigma_rad)]}
    was, now = _as_stated(before), _as_stated(moved)
    section = robots.get(start.robot, robots.get("each")) or {}
    stated = {**(section.get("start") or {}), **now, **sigmas}
    changed = with_value(config, ("robots", start.robot), {**section, "start": stated})
    evidence = f"{start.robot} starts {_at(now)}, not {_at(was)}: then its path fits its fixes"
    said = ", ".join(f"{name}: {_said(value)}" for name, value in (now | sigmas).items())
    return changed, evidence, f"--set 'robots.{start.robot}.start={{{said}}}'"


def _as_stated(pose: Array) -> dict[str, float]:
    """Return a pose (3,) or (7,) by the keys of a configuration."""
    if len(pose) == 3:
        return {"x_m": float(pose[0]), "y_m": float(pose[1]), "theta_rad": math.remainder(pose[2], 2 * math.pi)}
    position, angles = pose[:3].tolist(), np.degrees(to_euler_pose(pose)[0][3:]).tolist()
    return dict(zip(("x_m", "y_m", "z_m", "roll_deg", "pitch_deg", "yaw_deg"), (*position, *angles), strict=True))


def _said(value: float | list[float]) -> str:
    return f"[{', '.join(map(figure, value))}]" if isinstance(value, list) else figure(value)


def _at(stated: Mapping[str, float]) -> str:
    """Return a pose in words."""
    position = ", ".join(figure(stated[key]) for key in ("x_m", "y_m", "z_m") if key in stated)
    heading = stated["yaw_deg"] if "yaw_deg" in stated else math.degrees(stated["theta_rad"])
    return f"at ({position}) m with a heading of {heading:.0f} deg"


def _fit_of_fixes(run: Run, number: int | None = None) -> Fit:
    """Return the fit of the first fixes of a run."""
    fixes = run.history.fixes[:number]
    d2 = [float(f.z @ np.linalg.solve(f.Z, f.z)) / len(f.z) for f in fixes]
    return Fit(np.minimum(d2, MOST), np.array([len(f.z) for f in fixes]))


def find_kidnap(run: Run, log: Log, now: Fit, first: int) -> Mistake | None:
    """Return that the robot was moved, if the run does not fit from the observation `first` on, and a new one would.

    Or that landmarks were, if the log before and after it fits together without these.
    """
    t_ns, robot, rest = _from(run, log, first)
    again, before = filter_events(run.config, log, rest), now.of(slice(first, None))
    after = REFUSED if again is None else fit_of_run(again)
    if again is None or after.mean > FITS or MUCH * after.mean > before.mean:
        return None
    gain = explained_chi2(before.of(slice(len(after.values))), after)
    found = find_moved_landmarks(run, log, first, again)
    if found:
        return found._replace(gain=gain)
    evidence = (
        f"{robot} was elsewhere from t={t_ns * 1e-9:.1f} s on: the log before and after it fits, but not together"
    )
    return Mistake("kidnapped", evidence, "", run.config, None, gain, t_ns * 1e-9)


def find_moved_landmarks(run: Run, log: Log, first: int, again: Run) -> Mistake | None:
    """Return that landmarks were moved, if most are where they were in a run `again` from an observation on.

    Where a robot is moved all of them are, and the log before and after it does not fit together without a few.
    """
    t_ns, _, rest = _from(run, log, first)
    old, new = run.history.map_at(int(run.history.step[first - WINDOW]) - 1), again.landmarks
    both = align_maps(_places(old.ids, old.means[:, : run.history.d]), _places(new.ids, new.positions()[0]))
    names = [] if both is None else [str(both.names[k]) for k in np.flatnonzero(~both.still)]
    around = [_without(e, {*names}) for e in log.events if abs(e.t_ns - t_ns) <= rest[-1].t_ns - t_ns]
    if not names or fit_of_events(run.config, log, around).mean > FITS:
        return None
    told = ", ".join(names)
    what = f"landmark {told} was" if len(names) == 1 else f"landmarks {told} were"
    evidence = f"{what} moved by t={t_ns * 1e-9:.1f} s: without sightings of them the log before and after it fits"
    return Mistake(MOVED, evidence, f"leave out {told}", run.config, None, 0.0, t_ns * 1e-9, 0.0)


def _without(e: Event, names: set[str]) -> Event:
    """Return an event without the sightings of landmarks."""
    if not isinstance(e, Scan) or e.ids is None or names.isdisjoint(map(str, e.ids)):
        return e
    return _rows_of(e, [k for k, name in enumerate(e.ids) if str(name) not in names])


def _rows_of(e: Scan, rows: list[int]) -> Scan:
    """Return a scan with some of its observations."""
    cov = e.cov[rows] if e.cov is not None and e.cov.ndim == 3 else e.cov
    ids = None if e.ids is None else tuple(e.ids[k] for k in rows)
    return replace(e, y=e.y[rows], ids=ids, cov=cov)


def find_exchanged_ids(run: Run, log: Log, now: Fit) -> Mistake | None:
    """Return that ids mean other landmarks from some time on: those whose sightings do not fit any more.

    The log is filtered again from there.  Most landmarks are where they were, after a rigid alignment, but some where
    another one was.
    """
    first = _misfit_in_a_row(run, now)
    if first is None:
        return None
    t_ns, _, rest = _from(run, log, first)
    after = filter_events(run.config, log, rest)
    if after is None or fit_of_run(after).mean > FITS:
        return None
    old = run.history.map_at(int(run.history.step[first]) - 1)
    new = after.landmarks
    others = displaced_landmarks(_places(old.ids, old.means[:, : run.history.d]), _places(new.ids, new.positions()[0]))
    if not others:
        return None
    ids = "; ".join(f"what is called {a} is where {b} was" for a, b in others.items())
    gain = explained_chi2(now.of(slice(first, first + len(after.history.d2))), fit_of_run(after))
    evidence = f"ids mean other landmarks from t={t_ns * 1e-9:.1f} s on: {ids}"
    return Mistake("wrong_ids", evidence, UNKNOWN_IDS, run.config, None, gain, t_ns * 1e-9, len(others) / len(old.ids))


def _misfit_in_a_row(run: Run, now: Fit) -> int | None:
    """Return the first observation of those of an id that misfit in a row, None if there are none."""
    starts, landmark = [], np.where(run.history.id != "", run.history.landmark, "")
    for name in np.unique(landmark[landmark != ""]):
        mine = np.flatnonzero(landmark == name)
        if len(mine) < 2 * IN_A_ROW:
            continue
        bad = np.convolve(now.values[mine] > MUCH * FITS, np.ones(IN_A_ROW), mode="valid") > IN_A_ROW - 0.5
        if bad.any():
            starts.append(mine[int(np.argmax(bad)) + 1])  # the first of them may be one that is off by chance
    return int(min(starts)) if starts else None


class Aligned(NamedTuple):
    """Landmarks by `names` (N,) that two maps have, at the places `new` (N, d) of the later one, aligned by most.

    Those that are where they were are `still` (N,): within `near`, m, a share of the distance to the next one.
    """

    names: list[Any]
    new: Array
    still: Flags
    near: float


def align_maps(before: Mapping[Any, Array], after: Mapping[Any, Array]) -> Aligned | None:
    """Return the landmarks of two maps, None if they are few or if most are elsewhere."""
    common = [name for name in after if name in before]
    if len(common) < COMMON:
        return None
    old, new = (np.array([places[name] for name in common]) for places in (before, after))
    every = np.array([*before.values()])
    near = SAME * float(np.median(cKDTree(every).query(every, k=2)[0][:, 1]))
    onto = rigid_robust(new, old, near)
    still = np.linalg.norm(onto(new) - old, axis=1) < near
    if 2 * still.sum() <= len(common):
        return None
    return Aligned(common, rigid(new[still], old[still])(new), still, near)


def displaced_landmarks(before: Mapping[Any, Array], after: Mapping[Any, Array]) -> dict[Any, Any]:
    """Return the landmarks that are now where another one was, and which: after the alignment of most of all."""
    both = align_maps(before, after)
    if both is None:
        return {}
    names = list(before)
    away, which = cKDTree(np.array([*before.values()])).query(both.new)
    others = np.flatnonzero(~both.still & (away < both.near)).tolist()
    return {both.names[k]: names[which[k]] for k in others if names[which[k]] != both.names[k]}


def _places(ids: Sequence[Any], means: Array) -> dict[Any, Array]:
    """Return the positions of landmarks by their ids."""
    return {id_: mean for id_, mean in zip(ids, means, strict=True) if np.isfinite(mean).all()}


def _from(run: Run, log: Log, row: int) -> tuple[int, str, list[Event]]:
    """Return the time and robot of an observation, and the events of the log from there."""
    step = int(run.history.step[row])
    t_ns = int(run.history.t_ns[step])
    return t_ns, str(run.history.robot[step]), first_events(run, [e for e in log.events if e.t_ns >= t_ns])


def first_events(run: Run, events: Log | list[Event], most: int = SCANS) -> list[Event]:
    """Return the first events, with so many scans and observations; in a raw scan are few, however many its beams."""
    robots = run.final_slam().robots.values()
    detected = {(r.name, name) for r in robots for name, m in r.sensors.items() if m.detector is not None}
    scans = observations = 0
    for n, event in enumerate(events):
        if isinstance(event, Scan):
            number = DETECTED if (event.robot, event.sensor) in detected else len(event.y)
            scans, observations = scans + 1, observations + number
            if scans >= most or observations >= OBSERVATIONS or n >= EVENTS:
                return list(events)[: n + 1]
    return list(events)


def fit_without(mistake: Mistake, log: Log, events: list[Event]) -> Fit:
    """Return the fit of events without a mistake."""
    return fit_of_events(
        mistake.config, log, sorted(map(mistake.change, events), key=sort_key) if mistake.change else events
    )


def fit_of_events(config: Mapping[str, Any], log: Log, events: list[Event]) -> Fit:
    """Return the fit of events under a configuration."""
    run = filter_events(config, log, events)
    return REFUSED if run is None else fit_of_run(run)


def filter_events(config: Mapping[str, Any], log: Log, events: list[Event]) -> Run | None:
    """Return the run of events under a configuration, None if they are refused."""
    try:
        made = config_of(Tree(deepcopy(dict(config))), None)
        part = replace(log, events=events)
        run = record(build_slam(made, part), part, progress=False, on_error="skip", pictures=False)
    except (KalmarkError, np.linalg.LinAlgError):
        return None
    return None if run.stopped or len(run.skipped) > FEW_SKIPPED * len(events) else run
