"""``map.png``: paths, landmarks with their 3-sigma ellipses, and the truth behind them."""

from __future__ import annotations

from os import PathLike
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.markers import MarkerStyle
from matplotlib.path import Path
from matplotlib.transforms import Affine2D

from kalmark.results import plot_space
from kalmark.results.history import Array, Ints
from kalmark.results.picture import (
    FIX_COLOUR,
    INK,
    LANDMARK_COLOUR,
    TRUTH_COLOUR,
    Picture,
    broken,
    ellipses,
    headline,
)
from kalmark.results.plot_sensor import draw_sensor

if TYPE_CHECKING:
    from kalmark.results.run import Run

LONG = 3000  # a path of more steps than this is drawn thinner
REACH = 0.2  # an ellipse widens the picture by at most this part of it
CROWD = 100  # with more landmarks than this, everything about them is drawn thinner


def save_map(run: Run, path: str | PathLike[str]) -> None:
    """Draw the map of a run and write it as a PNG."""
    figure = draw_map(run)
    FigureCanvasAgg(figure)
    figure.savefig(path, dpi=130, format="png", bbox_inches="tight", pad_inches=0.15)


def save_sensor(run: Run, robot: str, sensor: str, path: str | PathLike[str], step: int | None = None) -> None:
    """Draw a camera's last scan, or that at a step, and write it as a PNG."""
    figure = draw_sensor(run, robot, sensor, step)
    FigureCanvasAgg(figure)
    figure.savefig(path, dpi=110, format="png")


def draw_map(run: Run) -> Figure:
    """Return the figure of a run's map: axes in metres, in the frame of the map; in space a view and a plan."""
    if run.history.in_space:
        return plot_space.draw_map(run)
    low, high = extent(run)
    figure = Figure(figsize=_size(high - low), layout=ConstrainedLayoutEngine(h_pad=0.09), facecolor="white")
    axes = figure.subplots()
    draw_plane(axes, run, low, high)
    title, figures = headline(run)
    _head(axes, title, _lines(figures, width=int(12 * figure.get_figwidth())))
    entries = _legend(Picture.of(run), len(run.landmarks))
    figure.legend(handles=entries, loc="outside lower center", ncols=4, frameon=False, fontsize=9)
    return figure


def draw_plane(axes: Axes, run: Run, low: Array, high: Array, step: int | None = None) -> None:
    """Draw the map of a run in the plane after a step, by default the last, between two corners (2,)."""
    picture, history = Picture.of(run), run.history
    means, covariances = run.landmarks.positions() if step is None else history.map_at(step)[3:5]
    until = slice(None) if step is None else slice(step + 1)
    _style(axes)
    _draw_truth(axes, picture, crowded=len(means) > CROWD)
    _draw_landmarks(axes, means, covariances)
    for robot in picture.paths:
        mine = history.robot[until] == robot
        path, P = history.mean[until][mine], history.covariance[until][mine]
        _draw_robot(axes, picture.colour(robot), path, P, picture.stretches[robot])
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    axes.set_aspect("equal", adjustable="box")


def _head(axes: Axes, title: str, lines: list[str]) -> None:
    at: dict[str, Any] = {
        "xy": (0, 1),
        "xycoords": "axes fraction",
        "textcoords": "offset points",
        "annotation_clip": False,
    }
    above = 8 + 12.5 * len(lines)
    axes.annotate("\n".join(lines), xytext=(0, 8), va="bottom", fontsize=9, color="#555b66", linespacing=1.35, **at)
    axes.annotate(title, xytext=(0, above + 3), va="bottom", fontsize=13, fontweight="bold", color=INK, **at)


def _lines(figures: list[str], width: int) -> list[str]:
    """Return the key figures joined to lines of at most `width` characters, none of them broken."""
    lines: list[str] = []
    for figure in figures:
        if lines and len(lines[-1]) + len(figure) + 3 <= width:
            lines[-1] += f" · {figure}"
        else:
            lines.append(figure)
    return lines


def _style(axes: Axes) -> None:
    axes.set_xlabel("x (m)", color=INK)
    axes.set_ylabel("y (m)", color=INK)
    axes.grid(True, color="#e6e8ec", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.tick_params(colors="#555b66", labelsize=9)
    for side in axes.spines.values():
        side.set_color("#c4c8cf")


def extent(run: Run) -> tuple[Array, Array]:
    """Return the corners of what is to be seen of a map; huge ellipses and stray fixes may reach out of it."""
    picture = Picture.of(run)
    landmarks, covariances = run.landmarks.positions()
    parts = [
        landmarks,
        *(path[:, :2] for path in picture.paths.values()),
        *picture.truth.values(),
        *picture.used.values(),
    ]
    points = np.concatenate([*parts, np.array(list(picture.landmarks.values())).reshape(-1, 2)])
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) == 0:
        return np.array([-1.0, -1.0]), np.array([1.0, 1.0])
    low, high = points.min(axis=0), points.max(axis=0)
    if len(landmarks):
        reach = 3.0 * np.sqrt(np.maximum(np.einsum("kii->ki", covariances), 0.0))
        reach = np.minimum(reach, max(REACH * (high - low).max(), 0.5))
        low, high = np.minimum(low, (landmarks - reach).min(axis=0)), np.maximum(high, (landmarks + reach).max(axis=0))
    middle, half = (low + high) / 2, (high - low) / 2
    half = np.maximum(half * 1.06, max(0.15 * half.max(), 0.5))
    return middle - half, middle + half


def _size(span: Array) -> tuple[float, float]:
    """Return the size of the figure in inches for an area of this width and height."""
    shape = float(np.clip(span[1] / span[0], 0.35, 1.6))
    width = 9.0 if shape <= 1 else 9.0 / shape**0.6
    return width, (width - 0.7) * shape + 1.9


def _draw_truth(axes: Axes, picture: Picture, crowded: bool) -> None:
    for fixes in picture.fixes.values():
        axes.plot(fixes[:, 0], fixes[:, 1], ".", color=TRUTH_COLOUR, markersize=1.8, zorder=1)
    for fixes in picture.used.values():
        axes.plot(fixes[:, 0], fixes[:, 1], "x", color=FIX_COLOUR, markersize=3.5, markeredgewidth=0.7, zorder=3)
    for robot, path in picture.truth.items():
        line = broken(path, picture.stretches[robot])
        axes.plot(line[:, 0], line[:, 1], "-", color=TRUTH_COLOUR, linewidth=2.2, alpha=0.6, zorder=2)
    if picture.landmarks:
        points = np.array(list(picture.landmarks.values()))
        size, width = (4, 0.6) if crowded else (8, 1.0)
        axes.plot(points[:, 0], points[:, 1], "+", color=INK, markersize=size, markeredgewidth=width, zorder=6)


def _draw_landmarks(axes: Axes, means: Array, covariances: Array) -> None:
    if len(means) == 0:
        return
    crowded = len(means) > CROWD
    contours = LineCollection(
        list(ellipses(means, covariances)), colors=LANDMARK_COLOUR, linewidths=0.5 if crowded else 0.9, zorder=5
    )
    axes.add_collection(contours, autolim=False)
    axes.plot(means[:, 0], means[:, 1], ".", color=LANDMARK_COLOUR, markersize=1.8 if crowded else 3.5, zorder=5)


def _draw_robot(axes: Axes, colour: str, path: Array, P: Array, stretches: Ints) -> None:
    if len(path) == 0:
        return
    width = 0.8 if len(path) > LONG else 1.1
    line = broken(path[:, :2], stretches)
    axes.plot(line[:, 0], line[:, 1], "-", color=colour, linewidth=width, alpha=0.9, zorder=4)
    axes.plot(*path[0, :2], "o", markerfacecolor="white", markeredgecolor=colour, markersize=7, zorder=7)
    arrow = _arrow(float(path[-1, 2]))
    axes.plot(*path[-1, :2], marker=arrow, color=colour, markeredgecolor="white", markersize=15, zorder=8)
    contour = ellipses(path[-1:, :2], P[-1:, :2, :2])[0]
    axes.plot(contour[:, 0], contour[:, 1], "-", color=colour, linewidth=0.9, zorder=7)


def _arrow(heading: float) -> MarkerStyle:
    """Return a dart that points along a heading, about the robot's place."""
    dart = Path([(0.62, 0.0), (-0.38, 0.36), (-0.16, 0.0), (-0.38, -0.36), (0.62, 0.0)], closed=True)
    return MarkerStyle(dart, transform=Affine2D().rotate(heading))


def _legend(picture: Picture, landmarks: int) -> list[Line2D]:
    several = len(picture.paths) > 1
    gaps = " (gaps: no scans)" if any(s[-1:].any() for s in picture.stretches.values()) else ""
    handles = [
        Line2D([], [], color=picture.colour(robot), label=robot if several else f"estimated path{gaps}")
        for robot in picture.paths
    ]
    if picture.truth:
        handles.append(
            Line2D([], [], color=TRUTH_COLOUR, linewidth=2.2, alpha=0.6, label="true paths" if several else "true path")
        )
    if picture.fixes:
        handles.append(
            Line2D([], [], color=TRUTH_COLOUR, marker=".", linestyle="", label="position fixes (aligned, not used)")
        )
    if picture.used:
        handles.append(Line2D([], [], color=FIX_COLOUR, marker="x", markersize=5, linestyle="", label="fixes used"))
    if picture.landmarks:
        handles.append(Line2D([], [], color=INK, marker="+", linestyle="", label="true landmarks"))
    if landmarks:
        handles.append(Line2D([], [], color=LANDMARK_COLOUR, marker=".", label=r"estimated landmarks, $3\sigma$"))
    if any(len(path) for path in picture.paths.values()):
        open_dot: dict[str, Any] = {"marker": "o", "markerfacecolor": "white", "linestyle": ""}
        handles.append(Line2D([], [], color=INK, label="start", **open_dot))
        handles.append(Line2D([], [], color=INK, marker=_arrow(0.0), linestyle="", label="end", markersize=11))
    return handles
