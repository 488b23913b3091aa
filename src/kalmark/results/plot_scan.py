"""``scan_<t>.png``: one scan's observations in the map, the landmarks each was compared with, and what was decided."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from kalmark.results.explain import Compared, Explanation, Fate
from kalmark.results.history import Array
from kalmark.results.picture import INK, ellipses
from kalmark.results.words import figure as figure_of

if TYPE_CHECKING:
    from kalmark.results.run import Run

OUTCOME = {
    "associated": "#4a8f7b", "new": "#d2a23c", "rejected": "#c8553d", "ignored": "#8b929c",
    "deferred": "#5b67a8", "tentative": "#9a62ab",
}  # fmt: skip
FAINT, ROBOT = "#c4c8cf", "#1f5fa8"
PATH = 60  # steps of the path before the scan
LEAST_M = 1.0
FAR = 30.0  # d2 of a landmark that an observation cannot be of, by whatever gate: it is not drawn, but for the nearest
FARTHEST = 300.0  # d2 of the nearest that is not drawn either
SHORT = 0.12  # of the picture's width: a line on which no number fits
ON_LINE: dict[str, Any] = {"ha": "center", "va": "center", "bbox": {"fc": "white", "ec": "none", "pad": 0.8}}


def save_scan(run: Run, told: Explanation, path: str | Path) -> None:
    """Draw one scan of a run and write it as a PNG."""
    figure = draw_scan(run, told)
    FigureCanvasAgg(figure)
    figure.savefig(path, dpi=130, format="png", bbox_inches="tight", pad_inches=0.15)


def draw_scan(run: Run, told: Explanation) -> Figure:
    """Return the figure of one scan, from above: axes in metres, in the frame of the map.

    Crosses are the observations where they seem to come from before the scan, squares the landmarks they were compared
    with then, but for those too far off; a full line goes to the landmark that was decided on, whose d2 is at the
    cross, dotted ones to the others, each with its d2.  Where the id is known both are as seen from the pose after
    the scan.
    """
    figure = Figure(figsize=(9.5, 8.5), layout="constrained", facecolor="white")
    axes = figure.subplots()
    _robot(axes, run, told)
    low, high = _extent(told)
    _landmarks(axes, run, told, low, high)
    for fate in told.fates:
        colour = OUTCOME.get(fate.outcome, INK)
        if not np.isfinite(fate.seen_at[:2]).all():
            continue
        at = float(fate.seen_at[0]), float(fate.seen_at[1])
        axes.plot(*at, "x", color=colour, ms=9, mew=2, zorder=5)
        _beside(axes, at, (5, 5), _label(fate), color=colour, fontsize=9, zorder=6)
        for other in _near(fate):
            chosen, there = other.landmark == fate.landmark, (float(other.place[0]), float(other.place[1]))
            axes.plot(*zip(at, there, strict=True), "-" if chosen else ":", color=colour, lw=2 if chosen else 1)
            axes.plot(*there, "s", color=INK, mfc="none", ms=8, zorder=4)
            _beside(axes, there, (7, -12), other.landmark, fontsize=8, color=INK)
            if not chosen:
                off = _off(at, there) if np.hypot(*np.subtract(there, at)) < SHORT * (high[0] - low[0]) else (0.0, 0.0)
                _beside(axes, _between(at, there), off, figure_of(other.d2), fontsize=8, color=colour, **ON_LINE)
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    axes.set_aspect("equal", adjustable="box")
    axes.set_xlabel("x (m)")
    axes.set_ylabel("y (m)")
    axes.grid(color="#eceef1")
    lines = [*told.lines()]
    figure.suptitle(lines[0], x=0.02, ha="left", fontsize=12, fontweight="bold", color=INK)
    axes.set_title("\n".join(lines[1:3] if told.gates else lines[1:2]), loc="left", fontsize=9, color=INK)
    figure.legend(handles=_legend(told), loc="outside lower center", ncols=4, frameon=False, fontsize=9)
    return figure


def _near(fate: Fate) -> list[Compared]:
    """Return what an observation was compared with and may be of, the landmark decided on, and the nearest."""
    least = min((other.d2 for other in fate.compared if other.d2 <= FARTHEST), default=0.0)
    return [c for c in fate.compared if c.d2 <= max(FAR, least) or c.landmark == fate.landmark]


def _label(fate: Fate) -> str:
    """Return an observation's number, and the d2 of the landmark decided on."""
    d2 = next((c.d2 for c in fate.compared if c.landmark == fate.landmark), None)
    return str(fate.index) if d2 is None else f"{fate.index}: {figure_of(d2, 2)}"


def _beside(axes: Axes, at: tuple[float, float], off: tuple[float, float], text: str, **style: Any) -> None:
    axes.annotate(text, at, off, textcoords="offset points", clip_on=True, **style)


def _off(one: tuple[float, float], other: tuple[float, float]) -> tuple[float, float]:
    """Return how far a number is put off a short line, in points, across it."""
    x, y = other[0] - one[0], other[1] - one[1]
    size = float(np.hypot(x, y)) or 1.0
    return -14.0 * abs(y) / size, -11.0 * abs(x) / size


def _between(one: tuple[float, float], other: tuple[float, float]) -> tuple[float, float]:
    """Return a place on the line from an observation to a landmark, nearer to the observation."""
    return one[0] + 0.35 * (other[0] - one[0]), one[1] + 0.35 * (other[1] - one[1])


def _robot(axes: Axes, run: Run, told: Explanation) -> None:
    history = run.history
    mine = np.flatnonzero(history.robot[: told.step + 1] == told.robot)[-PATH:]
    axes.plot(*history.poses[mine, :2].T, color=ROBOT, lw=1)
    axes.plot(*ellipses(told.pose[None, :2], told.covariance[None, :2, :2])[0].T, color=ROBOT, lw=1)
    axes.plot(*told.pose[:2], "o", color=ROBOT, ms=7)


def _landmarks(axes: Axes, run: Run, told: Explanation, low: Array, high: Array) -> None:
    """Draw the map as it was kept last before the scan, and later if it was not kept before."""
    kept = run.history.map_at(told.step)
    inside = ((kept.means[:, :2] > low) & (kept.means[:, :2] < high)).all(axis=1)
    for i in np.flatnonzero(inside).tolist():
        axes.plot(*kept.means[i, :2], ".", color=FAINT, ms=4, zorder=1)
        if np.isfinite(kept.covariances[i, :2, :2]).all():
            axes.plot(
                *ellipses(kept.means[i : i + 1, :2], kept.covariances[i : i + 1, :2, :2])[0].T, color=FAINT, lw=0.8
            )


def _extent(told: Explanation) -> tuple[Array, Array]:
    """Return the corners (2,) of what is drawn."""
    points = [told.pose[:2], *(f.seen_at[:2] for f in told.fates)]
    points += [c.place[:2] for f in told.fates for c in _near(f)]
    shown = np.array([p for p in points if np.isfinite(p).all()])
    low, high = shown.min(axis=0), shown.max(axis=0)
    middle, half = (low + high) / 2, 0.62 * max(float((high - low).max()), LEAST_M)
    return middle - half, middle + half


def _legend(told: Explanation) -> list[Line2D]:
    outcomes = {f.outcome: ": d2" if ":" in _label(f) else "" for f in told.fates}
    mark: dict[str, Any] = {"ls": "", "marker": "x", "mew": 2}
    marks = [Line2D([], [], **mark, color=OUTCOME.get(o, INK), label=f"{o}{d2}") for o, d2 in outcomes.items()]
    return [
        Line2D([], [], color=ROBOT, marker="o", label="robot after the scan, 3 sigma"),
        Line2D([], [], ls="", marker="s", color=INK, mfc="none", label="landmark compared with, d2"),
        Line2D([], [], ls="", marker=".", color=FAINT, label="other landmarks, as kept last"),
        *marks,
    ]
