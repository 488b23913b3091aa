"""Sliders: a page of a short log filtered with many noises of controls and sensors, chosen by two sliders.

Every sigma of the motions is multiplied by one factor, every sigma of the sensors by another.  The page has the path,
the ellipses, NEES, NIS and the likelihood of the innovations for each pair of factors, and needs no other file.
"""

from __future__ import annotations

import html
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import resources
from itertools import product
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from kalmark.arrays import Array
from kalmark.config import config_dict
from kalmark.config.schema import Config
from kalmark.diagnosis.tunable_keys import Keys, Values
from kalmark.diagnosis.tune import Score, ScoredRun, Task
from kalmark.errors import KalmarkError
from kalmark.events import Scan
from kalmark.files import write
from kalmark.logs.log import Log
from kalmark.logs.progress import track
from kalmark.results.history import History, Ints
from kalmark.results.measures import anees_interval, associated_nis, nees, nis_of_groups, pose_error
from kalmark.results.run import Run
from kalmark.results.run_page import round_significant

FACTORS = tuple(2.0**k for k in range(-4, 5))  # of the sigmas
LEAST_SCANS, MOST_SCANS, MOST_SEEN = 10, 400, 4000  # of the log; the most where no length is given
POINTS = 120  # of a curve
NOTHING: Mapping[str, Any] = MappingProxyType({})
KINDS = {"q": "motion", "r": "sensors"}  # by the place of a key: robots.NAME.motion, robots.NAME.sensors


@dataclass(frozen=True)
class Sliders:
    """The page, as the text of an HTML file.  In a notebook it is shown in a frame."""

    html: str

    def save(self, path: str | Path) -> None:
        """Write the page to a file."""
        write(Path(path), self.html)

    def _repr_html_(self) -> str:
        style = "width: 100%; height: 1000px; border: 0"
        return (
            f'<iframe title="noise of controls and sensors" style="{style}" srcdoc="{html.escape(self.html)}"></iframe>'
        )


def sliders(
    config: Config,
    log: Log,
    *,
    seconds: float | None = None,
    factors: Sequence[float] = FACTORS,
    written: Mapping[str, Any] = NOTHING,
    progress: bool = False,
) -> Sliders:
    """Return the page of a configuration and the first `seconds` of a log; by default 400 scans of it.

    The log is filtered len(factors)^2 times.  Its truth, if it has one, is drawn and scored, and nothing else.
    `written` is the section of robots of the configuration's file, whose keys the page names.  Raises KalmarkError
    where the configuration states no sigma of a motion or of a sensor.
    """
    log = _beginning(log, seconds)
    task = Task(config_dict(config), log, 1.0, set(), written, progress)
    before = task.judged({})
    stated = {kind: _stated(task.keys, before.run, section) for kind, section in KINDS.items()}
    cells = []
    for pair in track(product(factors, factors), "filter with each noise", len(factors) ** 2, show=progress):
        values = {
            path: factor * value
            for factor, paths in zip(pair, stated.values(), strict=True)
            for path, value in paths.items()
        }
        judged = task.judged(values)
        cells.append(_drawn(judged.run) | _fit(task, judged, before))
    data = _common(before.run, log) | {
        "factors": list(factors),
        "keys": {kind: {".".join(path): value for path, value in paths.items()} for kind, paths in stated.items()},
        "cells": cells,
    }
    text = json.dumps(data, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    page = (resources.files("kalmark.diagnosis") / "page" / "sliders.html").read_text(encoding="utf-8")
    title = html.escape(f"{log.name}: noise of controls and sensors")
    return Sliders(page.replace("{title}", title).replace("{data}", text))


def _beginning(log: Log, seconds: float | None) -> Log:
    """Return the first seconds of a log, or the first scans of it, with the events before them."""
    times = [event.t_ns for event in log.events]
    if seconds is not None:
        end_ns = times[0] + round(seconds * 1e9) if times else 0
    else:
        scans = [event for event in log.events if isinstance(event, Scan)]
        count = min(MOST_SCANS, int(np.searchsorted(np.cumsum([len(scan.y) for scan in scans]), MOST_SEEN)) + 1)
        end_ns = scans[:count][-1].t_ns if scans else 0
    events = [event for event in log.events if event.t_ns <= end_ns]
    count = sum(isinstance(event, Scan) for event in events)
    if count < LEAST_SCANS:
        raise KalmarkError(f"tune --page: this part of the log has {count} scans, expected at least {LEAST_SCANS}")
    return replace(log, events=events)


def _stated(keys: Keys, run: Run, section: str) -> Values:
    """Return the sigmas that are stated of motions or of sensors, by their paths.  Raises KalmarkError."""
    found = {noise.path: noise.stated for noise in keys.noises(run) if noise.path[2] == section and noise.stated > 0}
    if not found:
        raise KalmarkError(f"tune --page: no sigma above 0 of any robot's {section}, expected one to be multiplied")
    return found


def _common(run: Run, log: Log) -> dict[str, Any]:
    """Return what is the same with all noises: times, the truth in the frame of the map, and bounds of the NEES."""
    h, dof = run.history, run.history.pose_covariances.shape[1]
    true = run.truth.poses_in_map()
    places = [place[:2] for place in run.truth.landmarks_in_map().values()]
    return {
        "log": f"the first {h.t_s[-1]:.4g} s of {log.name}: {len(h.t_ns)} scans, {len(h.outcome)} observations",
        "robots": [
            {"name": name, "t": round_significant(h.t_s[rows], 6), "truth": _numbers(true[rows, :2])}
            for name, rows in _rows(run).items()
        ],
        "trueLandmarks": _numbers(np.array(places).reshape(-1, 2)),
        "dof": dof,
        "neesBounds": anees_interval(dof),
    }


def _rows(run: Run) -> dict[str, Ints]:
    """Return the steps of each robot that are drawn."""
    found = {name: np.flatnonzero(run.history.robot == name) for name in run.history.robots}
    return {name: rows[:: max(1, len(rows) // POINTS)] for name, rows in found.items() if len(rows)}


def _drawn(run: Run) -> dict[str, Any]:
    """Return what is drawn of a run: paths, ellipses, NEES of each robot, NIS over time, and their means."""
    h, (means, covariances) = run.history, run.landmarks.positions()
    value = nees(pose_error(h.poses, run.truth.poses_in_map(), run.coordinates), h.pose_covariances)
    known = value[np.isfinite(value)]
    ellipses = np.column_stack([means[:, :2], covariances[:, 0, 0], covariances[:, 0, 1], covariances[:, 1, 1]])
    return {
        "paths": [_numbers(h.poses[rows, :2]) for rows in _rows(run).values()],
        "ellipses": _numbers(ellipses),
        "nees": [round_significant(value[rows], 3) for rows in _rows(run).values()],
        "meanNees": float(f"{known.mean():.4g}") if len(known) else None,
        **_nis_over_time(h),
    }


def _nis_over_time(h: History) -> dict[str, Any]:
    """Return the NIS per degree of freedom of stretches of scans, when these are, and the 95 % bounds of each."""
    value, dof, step = associated_nis(h)
    stretch = step * POINTS // max(len(h.t_ns), POINTS)
    at, per_dof, bounds = nis_of_groups(value, dof, stretch)
    return {
        "nisT": round_significant(np.bincount(stretch, h.t_s[step])[at] / np.bincount(stretch)[at], 4),
        "nis": round_significant(per_dof, 3),
        "nisBounds": [round_significant(each, 3) for each in bounds],
    }


def _fit(task: Task, judged: ScoredRun, before: ScoredRun) -> dict[str, float | None]:
    """Return NIS per degree of freedom, log-likelihood and share left out; None where the filter gave up."""
    score = task.scores(judged, before)[0] if len(judged.d2) == len(before.d2) else Score(np.nan, np.nan, np.nan)
    return dict(zip(("meanNis", "likelihood", "leftOut"), round_significant(np.array(score), 7), strict=True))


def _numbers(values: Array) -> list[list[float | None]]:
    """Return rows of numbers (N, k), each to six significant digits."""
    return [round_significant(row, 6) for row in values]
