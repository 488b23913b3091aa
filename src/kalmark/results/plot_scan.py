"""``scan_<t>.png``: one scan's observations in the map, the landmarks each was compared with, and what was decided."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from kalmark.results.columns import Array
from kalmark.results.explain import Explanation, Fate
from kalmark.results.recording import Recording
from kalmark.results.scene import INK, contours, joined
from kalmark.results.words import figure as figure_of

OUTCOME = {
    "associated": "#4a8f7b", "new": "#d2a23c", "rejected": "#c8553d", "ignored": "#8b929c",
    "deferred": "#5b67a8", "tentative": "#9a62ab",
}  # fmt: skip
FAINT, ROBOT = "#c4c8cf", "#1f5fa8"
PATH = 60  # steps of the path before the scan
LEAST_M = 1.0
PAPER = 490.0  # width of the axes in points, about
MARK = 6.0  # half a cross or a square, in points
ON_LINE: dict[str, Any] = {"bbox": {"fc": "white", "ec": "none", "pad": 0.8}}


def save_scan(run: Recording, told: Explanation, path: str | Path) -> None:
    """Draw one scan of a run and write it as a PNG."""
    figure = draw_scan(run, told)
    FigureCanvasAgg(figure)
    figure.savefig(path, dpi=130, format="png", bbox_inches="tight", pad_inches=0.15)


def draw_scan(run: Recording, told: Explanation) -> Figure:
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
    _observations(axes, told, low, high)
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


def _observations(axes: Axes, told: Explanation, low: Array, high: Array) -> None:
    """Draw the marks of observations and landmarks, and the lines between; then their texts, each where it has room."""
    fates = [fate for fate in told.fates if np.isfinite(fate.seen_at[:2]).all()]
    squares = {other.landmark: other.place[:2] for fate in fates for other in fate.near}
    labels = _Labels(axes, low, high, [*squares.values(), *(fate.seen_at[:2] for fate in fates)])
    for place in squares.values():
        axes.plot(*place, "s", color=INK, mfc="none", ms=8, zorder=4)
    for fate in fates:
        colour, at = OUTCOME.get(fate.outcome, INK), fate.seen_at[:2]
        axes.plot(*at, "x", color=colour, ms=9, mew=2, zorder=5)
        labels.beside(at, _label(fate), fontsize=9, color=colour)
        for other in fate.near:
            chosen = other.landmark == fate.landmark
            style: dict[str, Any] = {"ls": "-", "lw": 2} if chosen else {"ls": ":", "lw": 1}
            axes.plot(*zip(at, other.place[:2], strict=True), color=colour, **style)
    for name, place in squares.items():
        labels.beside(place, name, fontsize=8, color=INK)
    for fate in fates:
        for other in fate.near:
            if other.landmark != fate.landmark:
                style = {"fontsize": 8, "color": OUTCOME.get(fate.outcome, INK), **ON_LINE}
                labels.along(fate.seen_at[:2], other.place[:2], figure_of(other.d2), **style)


class _Labels:
    """Texts in the axes from `low` to `high` (2,), each at that of several places where it covers the least.

    Boxes are in points of the paper, left, bottom, right, top; those of the marks (2,) are taken from the start.
    """

    def __init__(self, axes: Axes, low: Array, high: Array, marks: list[Array]) -> None:
        self.axes, self.low, self.scale = axes, low, PAPER / float(high[0] - low[0])
        centres = np.array([self.paper(mark) for mark in marks]).reshape(-1, 2)
        self.taken = np.hstack([centres - MARK, centres + MARK])

    def paper(self, at: Array) -> Array:
        """Return where a place (2,) of the map is on paper."""
        out: Array = (at - self.low) * self.scale
        return out

    def beside(self, at: Array, text: str, **style: Any) -> None:
        """Put a text at a side of a mark, or at a corner."""
        sides = np.array([[1, 0], [-1, 0], [0, 1], [0, -1], [1, 1], [1, -1], [-1, 1], [-1, -1]], dtype=np.float64)
        off = np.where(sides.all(axis=1, keepdims=True), [3.0, MARK], MARK + 2.0) + _half(text, style["fontsize"])
        self._put(self.paper(at) + sides * off, text, style)

    def along(self, one: Array, other: Array, text: str, **style: Any) -> None:
        """Put a text on the line from one place to another, nearer to the first, or beside the line."""
        begin, way = self.paper(one), self.paper(other) - self.paper(one)
        across = np.array([-way[1], way[0]]) / max(float(np.hypot(*way)), 1e-9)
        off = float(np.abs(across) @ _half(text, style["fontsize"])) + 2.0
        parts = np.array([0.35, 0.5, 0.25, 0.65, 0.8])[:, None]
        places = [begin + parts * way + side * off * across for side in (0.0, 1.0, -1.0)]
        self._put(np.concatenate(places), text, style)

    def _put(self, centres: Array, text: str, style: dict[str, Any]) -> None:
        half = _half(text, style["fontsize"])
        boxes = np.hstack([centres - half, centres + half])[:, None]
        sides = np.minimum(boxes[..., 2:], self.taken[:, 2:]) - np.maximum(boxes[..., :2], self.taken[:, :2])
        best = int(np.argmin(np.prod(np.maximum(sides, 0.0), axis=2).sum(axis=1)))
        self.taken = np.vstack([self.taken, boxes[best]])
        at = self.low + centres[best] / self.scale
        self.axes.text(at[0], at[1], text, ha="center", va="center", clip_on=True, zorder=6, **style)


def _half(text: str, size: float) -> Array:
    """Return half the width and height (2,) of a text, in points, about."""
    return np.array([0.31 * size * len(text), 0.55 * size])


def _label(fate: Fate) -> str:
    """Return an observation's number, and the d2 of the landmark decided on."""
    d2 = next((c.d2 for c in fate.compared if c.landmark == fate.landmark), None)
    return str(fate.index) if d2 is None else f"{fate.index}: {figure_of(d2, 2)}"


def _robot(axes: Axes, run: Recording, told: Explanation) -> None:
    history = run.history
    mine = np.flatnonzero(history.robot[: told.step + 1] == told.robot)[-PATH:]
    axes.plot(*history.poses[mine, :2].T, color=ROBOT, lw=1)
    axes.plot(*contours(told.pose[None, :2], told.covariance[None, :2, :2])[0, 0].T, color=ROBOT, lw=1)
    axes.plot(*told.pose[:2], "o", color=ROBOT, ms=7)


def _landmarks(axes: Axes, run: Recording, told: Explanation, low: Array, high: Array) -> None:
    """Draw the map as it was kept last before the scan, and later if it was not kept before."""
    kept = run.history.map_at(told.step)
    inside = ((kept.means[:, :2] > low) & (kept.means[:, :2] < high)).all(axis=1)
    means, covariances = kept.means[inside, :2], kept.covariances[inside, :2, :2]
    axes.plot(*means.T, ".", color=FAINT, ms=4, zorder=1)
    axes.plot(*joined(contours(means, covariances)[:, 0], 2).T, color=FAINT, lw=0.8)


def _extent(told: Explanation) -> tuple[Array, Array]:
    """Return the corners (2,) of what is drawn."""
    points = [told.pose[:2], *(f.seen_at[:2] for f in told.fates)]
    points += [c.place[:2] for f in told.fates for c in f.near]
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
