"""Runs side by side: their figures, what differs in their configurations, their maps and errors in one picture."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from kalmark.arrays import Array
from kalmark.errors import RunError
from kalmark.events import short_text
from kalmark.results.evaluate import summary_of
from kalmark.results.figure_texts import BATCH, MORE, ROBOT, TOTALS, Figures, TextRow, column_header, figure, flatten
from kalmark.results.history import Ints
from kalmark.results.measures import rigid, rmse
from kalmark.results.plot import draw_plan, legend
from kalmark.results.recording import Recording
from kalmark.results.scene import COLOURS, INK, Scene

DRAWN = 6  # maps in the picture at most; the curves are of all runs
PANEL, CURVES = 5.0, 2.6  # inches: a map, the curves
OF_ITS_OWN = ("version", "seed")  # keys of a configuration that are not of the filter


@dataclass(frozen=True, eq=False)
class Comparison:
    """Runs by their names; `figures` of each, and the keys in which their configurations differ."""

    runs: Mapping[str, Recording]
    figures: dict[str, Figures]
    differing: dict[str, list[str]]

    @property
    def names(self) -> list[str]:
        """The names of the runs."""
        return [*self.runs]

    def tables(self) -> Iterator[tuple[str, list[TextRow]]]:
        """Yield the tables: their titles and rows, a label and what each run has."""
        words = {key: column_header(label, unit) for key, label, unit in (*MORE, *BATCH, *TOTALS, *ROBOT)}
        words["path_difference_m"] = "path off the first run's, aligned (m)"
        for part in dict.fromkeys(part for told in self.figures.values() for part in told):
            mine = [told.get(part, {}) for told in self.figures.values()]
            keys = dict.fromkeys(key for each in mine for key in each)
            rows = [(words.get(key, key), *(_said(each.get(key)) for each in mine)) for key in keys]
            if rows:
                yield part, rows
        if self.differing:
            yield "configurations differ in", [(key, *values) for key, values in self.differing.items()]


def compare(runs: Mapping[str, Recording]) -> Comparison:
    """Return runs side by side, the first one being what the others' paths are compared with.

    Raises RunError for fewer than two, and for robots of the plane beside those of space.
    """
    if len(runs) < 2:
        raise RunError(f"{len(runs)} run, expected two or more different ones to compare")
    worlds = {name: run.history.in_space for name, run in runs.items()}
    if len({*worlds.values()}) > 1:
        space = next(name for name, in_space in worlds.items() if in_space)
        plane = next(name for name, in_space in worlds.items() if not in_space)
        raise RunError(f"{space} is a run in space and {plane} one in the plane, expected runs of one kind")
    first = next(iter(runs.values()))
    return Comparison(runs, {name: _figures(run, first) for name, run in runs.items()}, _differing(runs))


def _figures(run: Recording, first: Recording) -> dict[str, Figures]:
    """Return the figures of a run, by the part that they are of: the log, then each robot."""
    summary = summary_of(run)
    keys = ("events", *(key for key, _, _ in TOTALS))
    out = {"run": {key: summary[key] for key in keys if summary.get(key) is not None}}
    out["run"] |= {"warnings": len(summary.get("warnings", ())), "diverged": bool(summary.get("diverged"))}
    if "verdict" in summary:
        out["run"]["verdict"] = summary["verdict"]["map"]
    for robot, told in summary.get("robots", {}).items():
        mine = {key: told[key] for key, _, _ in ROBOT if told.get(key) is not None}
        if run is not first and (off := path_difference(run, first, robot)) is not None:
            mine["path_difference_m"] = off
        out[robot] = mine
    return out


def path_difference(run: Recording, other: Recording, robot: str) -> float | None:
    """Return the RMS distance (m) between two runs' paths of a robot at the times that both have, rigidly aligned.

    None where they have fewer than three times in common.
    """
    t, p = zip(*(_path(each, robot) for each in (run, other)), strict=True)
    _, a, b = np.intersect1d(*t, return_indices=True)
    if len(a) < 3:
        return None
    fit = rigid(p[0][a], p[1][b])
    return rmse(fit(p[0][a]) - p[1][b])


def _path(run: Recording, robot: str) -> tuple[Ints, Array]:
    """Return times (N,) ns and positions (N, d) of a robot, the last of each time."""
    history = run.history
    mine = np.flatnonzero(history.robot == robot)
    t_ns, last = np.unique(history.t_ns[mine][::-1], return_index=True)
    return t_ns, history.poses[mine[::-1][last], : history.d]


def _differing(runs: Mapping[str, Recording]) -> dict[str, list[str]]:
    """Return the keys in which configurations differ, and what each has."""
    flat = [dict(flatten(run.config)) for run in runs.values()]
    keys = dict.fromkeys(key for each in flat for key in each)
    values = {key: [short_text(each[key]) if key in each else "-" for each in flat] for key in keys}
    return {k: v for k, v in values.items() if k not in OF_ITS_OWN and any(a != b for a, b in pairwise(v))}


def _said(value: Any) -> str:
    if value is None:
        return "-"
    if isinstance(value, bool | str | int):
        return {True: "yes", False: "no"}[value] if isinstance(value, bool) else str(value)
    return figure(value, 4)


def draw_comparison(told: Comparison) -> Figure:
    """Return the figure: the maps side by side, drawn alike; below, over time, position errors and 3 sigma.

    Without truth the sigmas alone: the root of the trace of the position's covariance.
    """
    drawn = list(told.runs.items())[:DRAWN]
    figure_ = Figure(figsize=(max(PANEL * len(drawn), 8.0), PANEL + CURVES), facecolor="white", layout="constrained")
    grid = figure_.add_gridspec(2, len(drawn), height_ratios=(PANEL, CURVES))
    scenes = [Scene.of(run) for _, run in drawn]
    low, high = np.min([s.low for s in scenes], axis=0), np.max([s.high for s in scenes], axis=0)
    for k, ((name, _), scene) in enumerate(zip(drawn, scenes, strict=True)):
        axes = figure_.add_subplot(grid[0, k])
        draw_plan(axes, scene)
        axes.set_xlim(low[0], high[0])
        axes.set_ylim(low[1], high[1])
        axes.set_title(name, fontsize=10, color=INK, loc="left")
    _curves(figure_.add_subplot(grid[1, :]), told)
    entries = {handle.get_label(): handle for scene in scenes for handle in legend(scene)}
    columns = max(1, int(figure_.get_figwidth() / 1.9))
    figure_.legend(handles=[*entries.values()], loc="outside lower center", ncols=columns, frameon=False, fontsize=9)
    return figure_


def _curves(axes: Axes, told: Comparison) -> None:
    """Draw the position errors of all runs and robots, and three of their sigmas."""
    scored = False
    for k, (name, run) in enumerate(told.runs.items()):
        history, colour = run.history, COLOURS[k % len(COLOURS)]
        d, begin = history.d, int(history.t_ns.min(initial=2**62))
        sigma = 3.0 * np.sqrt(np.trace(history.pose_covariances[:, :d, :d], axis1=1, axis2=2))
        error = np.linalg.norm(run.truth.poses_in_map()[:, :d] - history.poses[:, :d], axis=1)
        for robot in history.robots:
            mine = history.robot == robot
            t_s, label = (history.t_ns[mine] - begin) * 1e-9, f"{name} {robot}" if len(history.robots) > 1 else name
            axes.plot(t_s, sigma[mine], color=colour, linewidth=0.8, linestyle=":")
            axes.plot(t_s, error[mine], color=colour, linewidth=1.0)
            axes.plot([], [], color=colour, label=label)
            scored = scored or bool(np.isfinite(error[mine]).any())
    axes.set_xlabel("time (s)", color=INK)
    axes.set_ylabel("position error, 3σ dotted (m)" if scored else "3σ of the position (m)", color=INK)
    axes.grid(True, color="#e6e8ec", linewidth=0.6)
    axes.set_ylim(bottom=0.0)
    axes.legend(frameon=False, fontsize=8, ncols=4, loc="upper left")
