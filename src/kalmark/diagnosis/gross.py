"""Mistakes after which no filter works: the beginning of the log is filtered again as if each had been made.

A mistake is named where the log fits the filter as it should once the mistake is taken out, and does not as it is.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from copy import deepcopy
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from kalmark.arrays import Array
from kalmark.config import build_slam
from kalmark.config.reading import config_of
from kalmark.config.tree import Tree
from kalmark.errors import KalmarkError
from kalmark.events import Control, Event, Scan
from kalmark.logs.log import Log
from kalmark.results.record import record
from kalmark.results.run import Run

SCANS, OBSERVATIONS = 400, 3000  # of the log are filtered again
MISFIT = 2.5  # mean of d2 per degree of freedom, above which a run is worth it
FITS = 2.0  # below which a log fits
MUCH = 3.0  # times better is the log without the mistake
MOST = 25.0  # that one observation counts, and what counts one that was left out
TURNS_DEG = (180, 90, -90)
HEADINGS_DEG = tuple(range(30, 360, 30))
WINDOW = 30  # observations, over which is asked whether the log fits from there on

Change = Callable[[Event], Event]


class Mistake(NamedTuple):
    """What may have been done wrongly: its name, what it is, its cure, and the configuration and log without it.

    `gain` is by how much the log fits better without it, and `since_s` since when it counts, in s of the log.
    """

    name: str
    evidence: str
    cure: str
    config: Mapping[str, Any]
    change: Change | None = None
    gain: float = 0.0
    since_s: float = 0.0


def misfits(run: Run) -> Array:
    """Return d2 per degree of freedom of each observation (O,), at most `MOST`; `MOST` if it fits nothing."""
    history = run.history
    dof = np.maximum(np.isfinite(history.z).sum(axis=1), 1)
    d2 = np.minimum(np.nan_to_num(history.d2, nan=0.0) / dof, MOST)
    return np.where(np.isin(history.outcome, ("rejected", "ignored")), MOST, d2)


def misfit(run: Run) -> float:
    """Return the mean of `misfits`; that of a log that the filter refuses, or that has none, is infinite."""
    return math.inf if run.stopped or not len(run.history.d2) else float(misfits(run).mean())


def gross(run: Run, log: Log) -> Mistake | None:
    """Return the mistake that explains why a run does not fit, None if it does fit or if none explains it."""
    if misfit(run) < MISFIT or not run.config.get("robots"):
        return None
    events = beginning(log)
    as_it_is = misfit_of(run.config, log, events)
    found = []
    for mistake in mistakes(run.config, log) if as_it_is >= MISFIT else ():
        after = misfit_of(mistake.config, log, [*map(mistake.change, events)] if mistake.change else events)
        if after < FITS and MUCH * after < as_it_is:
            gain = (min(as_it_is, MOST) - after) * sum(len(e.y) for e in events if isinstance(e, Scan))
            found.append(mistake._replace(gain=gain, since_s=events[0].t_s))
    return max(found, key=lambda f: f.gain, default=None) or kidnapped(run, log)


def kidnapped(run: Run, log: Log) -> Mistake | None:
    """Return that the robot was moved, if the run fits before some time, does not after it, and a new one would."""
    values, history = misfits(run), run.history
    if len(values) < 4 * WINDOW:
        return None
    bad = np.convolve(values, np.full(WINDOW, 1.0 / WINDOW), mode="valid") > MUCH * FITS
    first = int(np.argmax(bad)) + WINDOW if bad.any() else 0
    if not WINDOW < first < len(values) - WINDOW or values[: first - WINDOW].mean() > FITS:
        return None
    step = int(history.step[first])
    t_ns, robot = int(history.t_ns[step]), str(history.robot[step])
    rest = [e for e in log.events if e.t_ns >= t_ns]
    after, before = misfit_of(run.config, log, beginning(rest)), float(values[first:].mean())
    if after > FITS or MUCH * after > before:
        return None
    evidence = (
        f"{robot} was elsewhere from t={t_ns * 1e-9:.1f} s on: the log before and after it fits, but not together"
    )
    gain = (before - after) * (len(values) - first)
    return Mistake("kidnapped", evidence, "", run.config, None, gain, t_ns * 1e-9)


def beginning(events: Log | list[Event]) -> list[Event]:
    """Return the first events with so many scans and observations."""
    scans = observations = 0
    for n, event in enumerate(events):
        if isinstance(event, Scan):
            scans, observations = scans + 1, observations + len(event.y)
            if scans >= SCANS or observations >= OBSERVATIONS:
                return list(events)[: n + 1]
    return list(events)


def misfit_of(config: Mapping[str, Any], log: Log, events: list[Event]) -> float:
    """Return the misfit of events under a configuration, infinite if they are refused."""
    try:
        made = config_of(Tree(deepcopy(dict(config))), None)
        part = replace(log, events=events)
        return misfit(record(build_slam(made, part), part, progress=False, on_error="skip"))
    except (KalmarkError, np.linalg.LinAlgError):
        return math.inf


# ------------------------------------------------------------------ what may have been done wrongly
def mistakes(config: Mapping[str, Any], log: Log) -> Iterator[Mistake]:
    """Yield the mistakes that a log of such columns may have."""
    sensors = {
        (name, sensor): section
        for name, robot in config["robots"].items()
        for sensor, section in (robot.get("sensors") or {}).items()
        if not section.get("detector")
    }
    kinds = {str(section.get("type")) for section in sensors.values()}
    angles = any("bearing" in kind for kind in kinds)
    if angles:
        column = -1 if kinds <= {"range_bearing", "bearing"} else 1
        yield Mistake("bearing_sign", "bearings fit only with their sign changed: the sensor counts them clockwise",
                      "multiply bearing_rad by -1", config, _scan(lambda y: _times(y, column, -1.0)))  # fmt: skip
        yield Mistake("units", "bearings fit only if they are degrees", "multiply bearing_rad by pi / 180",
                      config, _scan(lambda y: _times(y, column, math.pi / 180)))  # fmt: skip
        yield Mistake("units", "turns of the controls fit only if they are degrees", "multiply them by pi / 180",
                      config, _control(lambda u: _times(u, -1, math.pi / 180)))  # fmt: skip
    if kinds == {"range_bearing"}:
        yield Mistake("swapped_columns", "range and bearing are swapped", "swap the columns range_m and bearing_rad",
                      config, _scan(lambda y: y[:, ::-1]))  # fmt: skip
    yield Mistake("units", "ranges fit only if they are millimetres", "multiply range_m by .001",
                  config, _scan(lambda y: _times(y, 0, 1e-3)))  # fmt: skip
    for (robot, sensor), section in sensors.items() if angles else ():
        theta = float((section.get("mount") or {}).get("theta_rad", 0.0))
        for turn in TURNS_DEG:
            evidence = f"the sensor {robot}.{sensor} looks {turn} deg away from where its mount says"
            angle = math.remainder(theta + math.radians(turn), 2 * math.pi)
            key = f"robots.{robot}.sensors.{sensor}.mount.theta_rad"
            changed = _with(config, ("robots", robot, "sensors", sensor, "mount", "theta_rad"), angle)
            yield Mistake("mount", evidence, f"--set {key}={angle:.4f}", changed)
    if any(not isinstance(event, Control | Scan) for event in log.events):
        for name, robot in config["robots"].items():
            theta = float((robot.get("start") or {}).get("theta_rad", 0.0))
            for turn in HEADINGS_DEG:
                angle = math.remainder(theta + math.radians(turn), 2 * math.pi)
                evidence = (
                    f"{name} starts with a heading of {math.degrees(angle):.0f} deg, not {math.degrees(theta):.0f}"
                )
                changed = _with(config, ("robots", name, "start", "theta_rad"), angle)
                yield Mistake("start", evidence, f"--set robots.{name}.start.theta_rad={angle:.2f}", changed)


def _with(config: Mapping[str, Any], path: tuple[str, ...], value: Any) -> dict[str, Any]:
    changed = deepcopy(dict(config))
    section: Any = changed
    for key in path[:-1]:
        if section.get(key) is None:
            section[key] = {}
        section = section[key]
    section[path[-1]] = value
    return changed


def _times(y: Array, column: int, factor: float) -> Array:
    y = np.array(y)
    y[..., column] *= factor
    return y


def _scan(change: Callable[[Array], Array]) -> Change:
    def changed(e: Event) -> Event:
        if not isinstance(e, Scan) or not len(e.y):
            return e
        return Scan(t_ns=e.t_ns, robot=e.robot, sensor=e.sensor, y=change(e.y), ids=e.ids, cov=e.cov)

    return changed


def _control(change: Callable[[Array], Array]) -> Change:
    def changed(e: Event) -> Event:
        return Control(t_ns=e.t_ns, robot=e.robot, u=change(e.u), cov=e.cov) if isinstance(e, Control) else e

    return changed
