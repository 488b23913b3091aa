"""Mistakes after which no filter works: the beginning of the log is filtered again as if each had been made.

A mistake is named where the log fits the filter as it should once the mistake is taken out, and does not as it is.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import groupby
from typing import Any

import numpy as np

from kalmark.arrays import Array
from kalmark.config.tree import robot_section, value_at
from kalmark.diagnosis.mistakes import Mistake, late_scans, mistakes, with_value
from kalmark.diagnosis.single_ids import OUTLIERS, Filtered, find_wrong_ids, gated
from kalmark.diagnosis.trials import (
    FITS,
    MISFIT,
    MOST,
    RACE,
    RACED,
    SHARES,
    SURELY,
    Fit,
    Trials,
    first_events,
    first_of,
    fit_of_run,
    likelihood_gain,
    log_from,
)
from kalmark.events import Control, Event, Fix, Scan
from kalmark.geometry.frames3d import to_euler_pose
from kalmark.logs.log import Log
from kalmark.results.figure_texts import figure
from kalmark.results.history import RobotStart
from kalmark.results.measures import Rigid, level, level_sigmas, rmse
from kalmark.results.run import Run
from kalmark.results.wrong_starts import restarts

MISTAKES = "units, signs, columns, mounts and times"
LEAST_SCANS = 80  # and controls, that show by how much scans are late
MUCH = 3.0  # times better is the log without the mistake
LEAST_FIXES = 5  # in a row that do not fit: their robot is not where it should be
WINDOW = 30  # observations, over which is asked whether the log fits from there on
STEPS = (-4.0, -3.0, -2.0, -1.5, -1.0, -0.5, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0)  # by which scans may be late


def gross(run: Run, log: Log, trials: Trials, alarmed: bool = False) -> tuple[Mistake, Filtered | None] | None:
    """Return the mistake that explains most why a run does not fit, None if it does fit or if none explains it.

    It is looked for where something else is `alarmed`, too.  With it comes the log filtered without it, if that was.
    """
    if not run.config.get("robots"):
        return None
    found = find_wrong_starts(run, log, trials)
    if found is not None:
        return found, None
    now = fit_of_run(run)
    of_ids = find_wrong_ids(run, log, now, trials)
    outlying = of_ids is not None and of_ids[0].name == OUTLIERS  # which any mistake looks like
    explained = of_ids is not None and not outlying and fit_of_run(of_ids[1].run).mean < FITS
    first = None if explained else misfits_from(now)
    fits = now.mean < MISFIT and not run.stopped and first is None and not outlying
    about = first_misfit(run)
    alone = None if fits and not alarmed else likeliest(run, log, trials, about)
    if alone is not None and of_ids is not None and about is None:  # found in the first events, compared in all
        paid = trials.pays(f"{alone.name}, compared with {of_ids[0].name}", trials.work_of(log.events))
        alone = alone._replace(gain=likelihood_gain(now, trials.fit_with(log, log.events, alone)) if paid else 0.0)
    if alone is None or (of_ids is not None and alone.gain < of_ids[0].gain):
        return of_ids
    return alone, None


def likeliest(run: Run, log: Log, trials: Trials, first: int | None = None) -> Mistake | None:
    """Return the mistake without which a log is likeliest, None if it fits as it is or without none.

    The log is filtered from the observation `first` on, if it fits before it: then a sensor was turned, or a source
    exchanged.  None, too, if the log is likelier where what is far off is left out: no mistake is then why it is.
    """
    config, rest = (run.config, log) if first is None else log_from(run, log, first)
    beginning = first_events(run, rest.events)
    none, off = Mistake("", "", "", config), Mistake(OUTLIERS, "", "", gated(config))
    changes = [none, off, *changes_of(run, config, beginning)]
    filters, parts = RACE + SHARES[0] * len(changes), 2 * len(changes)
    events = trials.payable(MISTAKES, run, beginning, filters, parts, share=RACED)
    if not events:
        return None
    made = trials.race(rest, events, changes)
    least = max((one.gain for one in made if one.name == OUTLIERS), default=0.0)
    made = [one for one in made if one.gain > least]
    sizes = {(one.name, one.of): one for one in sorted(reversed(made), key=lambda one: one.gain)}  # the likeliest
    found = first_of([one for one in made if not one.of or one is sizes[one.name, one.of]])
    if found is None or first is None:
        return found
    same = (one for one in changes_of(run, run.config, beginning) if found.evidence.startswith(one.evidence))
    every = max(same, key=lambda one: len(one.evidence))  # of all robots alike, it begins as that of the first one
    before = [e for e in log.events if e.t_ns < events[0].t_ns]
    paid = trials.pays(f"{MISTAKES} before t={found.since_s:.1f} s", 2.0 * trials.work_of(before))
    both = (trials.fit_with(log, before, one) for one in (none._replace(config=run.config), every))
    if paid and likelihood_gain(next(both), next(both)) > -SURELY:
        return every._replace(evidence=found.evidence, gain=found.gain, since_s=log.events[0].t_s)
    return found._replace(evidence=f"from t={found.since_s:.1f} s on {found.evidence}", cure="", of=())


def changes_of(run: Run, config: Mapping[str, Any], events: list[Event]) -> list[Mistake]:
    """Return the mistakes that events may have, without ids those of time, too: else the residuals show these."""
    late = run.history.robots if (run.history.id == "").any() else ()
    return [*mistakes(config, run), *(one for robot in late for one in late_or_early(config, events, robot))]


def late_or_early(config: Mapping[str, Any], events: list[Event], robot: str) -> Iterator[Mistake]:
    """Yield that the scans of a robot are late or early, by multiples of the time of a control or of half a scan.

    Where ids are unknown, the scans that show it most are of no landmark, and no residual is left of them.
    """
    mine = [[e.t_ns for e in events if isinstance(e, kind) and e.robot == robot] for kind in (Control, Scan)]
    if min(map(len, mine)) >= LEAST_SCANS:
        control_s, scan_s = (float(np.median(np.diff(t_ns))) * 1e-9 for t_ns in mine)
        yield from (late_scans(config, robot, k * max(control_s, 0.5 * scan_s)) for k in STEPS)


def first_misfit(run: Run) -> int | None:
    """Return the first observation about which a run does not fit, that fitted before; in space, that never fits again.

    In the plane robots begin there where they were (`log_from`).
    """
    return misfits_from(fit_of_run(run), MISFIT if run.history.in_space else 0.0)


def misfits_from(now: Fit, least: float = MISFIT) -> int | None:
    """Return the observation from which on a run does not fit any more, that fitted before; None if there is none.

    From there on it fits no better than `least`, mean d2 per degree of freedom.
    """
    values = now.values
    if len(values) < 4 * WINDOW:
        return None
    bad = np.convolve(values, np.full(WINDOW, 1.0 / WINDOW), mode="valid") > MUCH * FITS
    first = int(np.argmax(bad)) + WINDOW if bad.any() else 0
    if not WINDOW < first < len(values) - WINDOW or values[: first - WINDOW].mean() > FITS:
        return None
    return first if values[first:].mean() > least else None


def find_wrong_starts(run: Run, log: Log, trials: Trials) -> Mistake | None:
    """Return that robots start elsewhere, or turned, if fixes in a row were rejected and then fit.

    The path of each robot without fixes and the others, moved about the vertical axis onto its fixes, has the start.
    """
    events, config, told, begin_s = first_events(run, log), run.config, [], math.inf
    again = restarts(run.history)  # of these the map was moved onto their fixes
    lost = [start for start in run.history.starts if start.robot not in again and _is_lost(run, start.robot)]
    if not trials.pays("other starts", (1 + len(lost)) * trials.work_of(events) if lost else 0):
        return None
    for start in lost:
        found = _onto_its_fixes(run, log, events, start, trials)
        if found is not None:
            config, *words = started_at(config, start, *found)
            told.append(words)
            begin_s = min(begin_s, start.t_ns * 1e-9)
    after = trials.filter(config, log, events) if told else None
    if after is None or fit_of_run(after).mean > FITS or any(_is_lost(after, start.robot) for start in lost):
        return None
    gain = likelihood_gain(_fit_of_fixes(run, len(after.history.fixes)), _fit_of_fixes(after))
    evidence, cure = (sep.join(parts) for sep, parts in zip(("; ", " "), zip(*told, strict=True), strict=True))
    return Mistake("start", evidence, cure, config, None, gain, begin_s)


def _onto_its_fixes(
    run: Run, log: Log, events: list[Event], start: RobotStart, trials: Trials
) -> tuple[Rigid, Array, float] | None:
    """Return what moves the path of a robot alone onto its fixes, these (N, d), and their variance, m^2.

    None if the path fits them nearly as well as it is: then it was another robot that started elsewhere.
    """
    path = trials.filter(run.config, log, list(_alone(events, start.robot, run.history.robots)))
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


def _is_lost(run: Run, robot: str) -> bool:
    """Return whether the filter left out so many of a robot's fixes in a row."""
    used = [fix.used for fix in run.history.fixes if fix.robot == robot]
    return max((len([*row]) for fits, row in groupby(used) if not fits), default=0) >= LEAST_FIXES


def _alone(events: list[Event], robot: str, robots: Sequence[str]) -> Iterator[Event]:
    """Yield the events of a robot without its fixes and its observations of others."""
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
    moved = onto.poses(before[None])[0]
    sigma_m, sigma_rad = level_sigmas(fixes, variance, moved[: len(onto.shift)])
    if len(onto.shift) == 2:
        sigmas: dict[str, Any] = {"sigma_xy_m": sigma_m, "sigma_theta_rad": sigma_rad}
    else:
        sigmas = {"sigma_position_m": sigma_m, "sigma_rotation_deg": [0.0, 0.0, math.degrees(sigma_rad)]}
    was, now = _as_stated(before), _as_stated(moved)
    section = value_at(config, ("robots", robot_section(config, start.robot))) or {}
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
    d2 = [f.d2 / len(f.z) for f in fixes]
    values, dof = np.minimum(d2, MOST), np.array([len(f.z) for f in fixes])
    return Fit(values, dof, -0.5 * values * dof)


def _rows_of(e: Scan, rows: list[int]) -> Scan:
    """Return a scan with some of its observations."""
    cov = e.cov[rows] if e.cov is not None and e.cov.ndim == 3 else e.cov
    ids = None if e.ids is None else tuple(e.ids[k] for k in rows)
    return replace(e, y=e.y[rows], ids=ids, cov=cov)
