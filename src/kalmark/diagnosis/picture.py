"""``diagnosis.png``: what the causes do to the map, how much each explains, and the innovations over time."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from kalmark.batch.batch_state import LANDMARKS, POSES
from kalmark.diagnosis.verdict import Verdict
from kalmark.results.measures import rigid
from kalmark.results.plot import ALARM_COLOUR, EUCLIDEAN_COLOUR, LANDMARK_COLOUR, SOFT
from kalmark.results.run import Run
from kalmark.results.verdict_text import verdict_lines
from kalmark.results.warnings import autocorrelations, nis_windows

BARS = 8


def draw_diagnosis(run: Run, verdict: Verdict) -> Figure:
    """Return the picture of a verdict."""
    figure = Figure(figsize=(11, 8.2), facecolor="white", layout="constrained")
    first = next(verdict_lines(verdict.as_dict(), shown=0))
    figure.suptitle(f"{run.log.name or 'run'}: {first}", x=0.01, ha="left", fontweight="bold")
    axes = figure.subplot_mosaic([["map", "causes"], ["map", "nis"], ["map", "white"]], width_ratios=(1.2, 1))
    _map(axes["map"], run, verdict)
    _causes(axes["causes"], verdict)
    _windows(axes["nis"], "NIS per degree of freedom", nis_windows(run.history), 1.0)
    _windows(axes["white"], "correlation of successive innovations", autocorrelations(run.history), 0.0)
    axes["white"].set_xlabel("t (s) since the first scan")
    return figure


def _map(axes: Axes, run: Run, verdict: Verdict) -> None:
    """Draw the path and the map, and with arrows where the landmarks would be without the causes."""
    axes.set_aspect("equal", adjustable="datalim")
    for name in run.history.robots:
        path = run.history.poses[run.history.robot == name]
        axes.plot(path[:, 0], path[:, 1], color=EUCLIDEAN_COLOUR, lw=0.8, alpha=0.6)
    search = verdict.search
    if search is None:
        places = np.array([mean[:2] for mean in run.landmarks.means]).reshape(-1, 2)
        axes.plot(*places.T, ".", color=LANDMARK_COLOUR)
        axes.set_title("map", loc="left")
        return
    before, after = (state.groups[LANDMARKS][:, :2] for state in (search.first.state, search.linear.moved()))
    shift = rigid(after, before)(after) - before
    axes.plot(*before.T, ".", color=LANDMARK_COLOUR)
    extent = float(np.ptp(search.first.state.groups[POSES][:, :2], axis=0).max())
    largest = float(np.linalg.norm(shift, axis=1).max(initial=0.0))
    times = 10.0 ** np.floor(np.log10(0.2 * extent / largest)) if largest > 0 else 1.0
    axes.quiver(*before.T, *(times * shift).T, angles="xy", scale_units="xy", scale=1, width=0.004, color=ALARM_COLOUR)
    axes.set_title(f"map; arrows: its shape without the causes, {times:g} times as large", loc="left", fontsize=10)
    axes.set_xlabel("x (m)")
    axes.set_ylabel("y (m)")


def _causes(axes: Axes, verdict: Verdict) -> None:
    some = verdict.causes[:BARS][::-1]
    colours = [SOFT if cause.harmless else ALARM_COLOUR for cause in some]
    axes.barh([f"{k}  {c.name}" for k, c in zip(range(len(some), 0, -1), some, strict=True)],
              [max(c.score, 1.0) for c in some], color=colours)  # fmt: skip
    if some:
        axes.set_xscale("log")
    axes.set_title(
        "causes: log-likelihood ratio (grey: harmless)" if some else "no cause found", loc="left", fontsize=10
    )


def _windows(axes: Axes, title: str, windows: list, usual: float) -> None:  # type: ignore[type-arg]
    for window in windows:
        axes.plot([window.start_s, window.end_s], [window.value] * 2, color=EUCLIDEAN_COLOUR, lw=1.2)
    axes.axhline(usual, color=SOFT, lw=0.8, ls="--")
    axes.set_title(title, loc="left", fontsize=10)
