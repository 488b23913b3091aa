"""Pictures of one scan: ``scan_<robot>_<t>.png``, in the map, ``sensor_<robot>_<sensor>.png``, in a camera's images.

The first has the observations, the landmarks each was compared with, and what was decided; the second what a camera saw
on what the filter expected it to see.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from kalmark.arrays import Array
from kalmark.errors import RunError
from kalmark.geometry.gaussian import contours
from kalmark.picture_options import Picture
from kalmark.results.camera_log import images_of_cameras
from kalmark.results.explain import Explanation, Fate
from kalmark.results.figure_texts import figure as figure_of
from kalmark.results.history import Measuring
from kalmark.results.labels import name_points
from kalmark.results.plot_measured import add_title_and_legend, draw_measured, scan_title, sensors_with_picture
from kalmark.results.recording import Recording
from kalmark.results.scene import (
    INK,
    OUTCOME_COLOURS,
    Image,
    ImageObservation,
    Style,
    clip_line,
    colour_of,
    images,
    join_polylines,
    picture_of,
    steps_of,
)

FAINT, ROBOT = "#c4c8cf", "#1f5fa8"
PATH = 60  # steps of the path before the scan
LEAST_M = 1.0
ON_IMAGE = "#ffd400"  # of what was measured, over a picture
MOST_NAMES = 30  # of landmarks, over a picture
BESIDE = 6.0  # points of paper between the middle of a mark and its name
ALONG = 0.5  # of the line from an observation to a landmark, where their d2 is
MEASURED, SEGMENT, NAME = "#7d838d", "#3a68c8", "#1e4d2b"


def draw_scan(run: Recording, told: Explanation) -> Figure:
    """Return the figure of one scan, from above: axes in metres, in the frame of the map.

    Crosses are the observations where they seem to come from before the scan, squares the landmarks they were compared
    with then, but for those too far off; a full line goes to the landmark that was decided on, whose d2 is at the
    cross, dotted ones to the others, each with its d2.  Where the id is known both are as seen from the pose after
    the scan.
    """
    figure = Figure(figsize=(9.5, 8.5), layout="constrained", facecolor="white")
    axes = figure.subplots()
    mine = np.flatnonzero(run.history.robot[: told.step + 1] == told.robot)[-PATH:]
    axes.plot(*run.history.poses[mine, :2].T, color=ROBOT, lw=1)
    here = told.pose[None, :2]
    axes.plot(*contours(here, run.history.robot_shape(np.array([told.step]))[:, :2, :2])[0, 0].T, color=ROBOT, lw=1)
    axes.plot(*told.pose[:2], "o", color=ROBOT, ms=7)
    (low, high), kept = _extent(told), run.history.map_at(told.step)
    inside = ((kept.means[:, :2] > low) & (kept.means[:, :2] < high)).all(axis=1)
    means = kept.means[inside, :2]
    axes.plot(*means.T, ".", color=FAINT, ms=4, zorder=1)
    axes.plot(*join_polylines(contours(means, kept.shape[inside, :2, :2])[:, 0], 2).T, color=FAINT, lw=0.8)
    _observations(axes, told)
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    axes.set_aspect("equal", adjustable="box")
    axes.set_xlabel("x (m)")
    axes.set_ylabel("y (m)")
    axes.grid(color="#eceef1")
    title, *lines = told.lines()
    axes.set_title("\n".join(lines[: 2 if told.gates else 1]), loc="left", fontsize=9, color=INK)
    add_title_and_legend(figure, title, _legend(told))
    return figure


def _observations(axes: Axes, told: Explanation) -> None:
    """Draw the marks of observations and landmarks, the lines between, and their texts: numbers, names and d2."""
    fates = [fate for fate in told.fates if np.isfinite(fate.seen_at[:2]).all()]
    squares = {str(other.landmark): other.place[:2] for fate in fates for other in fate.near}
    for fate in fates:
        colour, at = OUTCOME_COLOURS.get(fate.outcome, INK), fate.seen_at[:2]
        axes.plot(*at, "x", color=colour, ms=9, mew=2, zorder=5)
        name_points(axes, [at], [_label(fate)], BESIDE, fontsize=9, color=colour, zorder=6)
    for name, place in squares.items():
        axes.plot(*place, "s", color=INK, mfc="none", ms=8, zorder=4)
        name_points(axes, [place], [name], BESIDE, fontsize=8, color=INK, zorder=6)
    for fate in fates:
        colour, at = OUTCOME_COLOURS.get(fate.outcome, INK), fate.seen_at[:2]
        for other in fate.near:
            chosen = other.landmark == fate.landmark
            style: Style = {"ls": "-", "lw": 2} if chosen else {"ls": ":", "lw": 1}
            axes.plot(*zip(at, other.place[:2], strict=True), color=colour, **style)
            if not chosen:
                on_line = at + ALONG * (other.place[:2] - at)
                name_points(axes, [on_line], [figure_of(other.d2)], 1.0, fontsize=8, color=colour, zorder=6)


def _label(fate: Fate) -> str:
    """Return an observation's number, and the d2 of the landmark decided on."""
    d2 = next((c.d2 for c in fate.compared if c.landmark == fate.landmark), None)
    return str(fate.index) if d2 is None else f"{fate.index}: {figure_of(d2, 2)}"


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
    mark: Style = {"ls": "", "marker": "x", "mew": 2}
    marks = [Line2D([], [], **mark, color=OUTCOME_COLOURS.get(o, INK), label=f"{o}{d2}") for o, d2 in outcomes.items()]
    return [
        Line2D([], [], color=ROBOT, marker="o", label="robot after the scan, 3 sigma of the shape"),
        Line2D([], [], ls="", marker="s", color=INK, mfc="none", label="landmark compared with, d2"),
        Line2D([], [], ls="", marker=".", color=FAINT, label="other landmarks, as kept last"),
        *marks,
    ]


def draw_sensor(run: Recording, robot: str, sensor: str, step: int | None = None, t_s: float | None = None) -> Figure:
    """Return the figure of a sensor's last scan, or of that at a step, or of the last up to a time.

    Of a camera in pixels, v downwards; measurements are grey crosses or thick lines, expectations 3-sigma ellipses of Z
    around e or thin lines.  Of another sensor in its measurement space (`kalmark.results.plot_measured`).  `t_s`, and
    the time in the title, are seconds since the first scan, as in the report.  Raises RunError if there is no such
    sensor or scan.
    """
    history = run.history
    sensors = {(s.robot, s.sensor): s for s in sensors_with_picture(history)}
    if (robot, sensor) not in sensors:
        names = ", ".join(map(".".join, sensors)) or "none"
        raise RunError(f"sensor {robot}.{sensor} has no picture in this run, expected one of: {names}")
    camera = sensors[robot, sensor]
    steps = steps_of(history, camera)
    if t_s is not None:
        steps = steps[history.t_ns[steps] - history.t_ns[0] <= round(t_s * 1e9)]
    if step is not None:
        steps = steps[steps <= step]
    if len(steps) == 0:
        raise RunError(f"sensor {robot}.{sensor} saw nothing until then, expected a scan with an observation")
    if isinstance(camera, Measuring):
        return draw_measured(history, camera, int(steps[-1]), picture_of(run))
    seen = images(history, camera, int(steps[-1]))
    shape = camera.size[1] / camera.size[0]
    width = 9.0 if len(seen) == 1 else 14.0
    figure = Figure(figsize=(width, (width - 1.0) / len(seen) * shape + 1.5), layout="constrained", facecolor="white")
    grid = figure.subplots(1, len(seen), squeeze=False)[0]
    pictures, options = images_of_cameras(run), picture_of(run)
    for axes, image in zip(grid, seen, strict=True):
        draw_image(axes, image, camera.size, options, pictures and pictures.at(camera, int(steps[-1]), image.side))
    title = scan_title(camera, history.t_s[steps[-1]], [s.outcome for s in seen[0].observations])
    add_title_and_legend(figure, title, legend(seen, options))
    return figure


def draw_image(axes: Axes, image: Image, size: tuple[float, float], options: Picture, picture: Any = None) -> None:
    """Draw what one image of a camera shows of a scan, over its `picture` (H, W) if there is one: u right, v down."""
    if picture is not None:
        height, width = picture.shape
        extent = (-0.5, width - 0.5, height - 0.5, -0.5)
        axes.imshow(picture, cmap="gray", vmin=0, vmax=255, extent=extent, zorder=0)
    axes.set_xlim(0, size[0])
    axes.set_ylim(size[1], 0)
    axes.set_aspect("equal", adjustable="box")
    axes.set_xlabel("u (px)", color=INK)
    axes.set_ylabel("v (px)", color=INK)
    axes.tick_params(colors="#555b66", labelsize=8)
    if image.side:
        axes.set_title(f"{image.side} image", fontsize=10, color="#555b66")
    named = picture is None or len(image.observations) <= MOST_NAMES
    measured = MEASURED if picture is None else ON_IMAGE
    for observation in image.observations:
        _draw(axes, observation, size, named, options, measured)


def _draw(
    axes: Axes, s: ImageObservation, size: tuple[float, float], named: bool, options: Picture, point: str
) -> None:
    colour, _ = colour_of(s, options)
    expected, single = np.isfinite(s.expected).all(), len(s.expected) == 1
    closed = np.vstack([s.measured, s.measured[:1]]) if len(s.measured) > 2 else s.measured
    rejected, new = s.outcome == "rejected", s.outcome == "new"
    if single:
        cross = options.colour("measured", point)
        axes.plot(*s.measured.T, "+", color=cross, markersize=8, markeredgewidth=1.1, zorder=3)
    else:
        thick = options.colour("measured", MEASURED if new else SEGMENT)
        axes.plot(*closed.T, "-", color=thick, linewidth=3.0, alpha=0.55, zorder=2)
    if new:
        axes.plot(*s.measured.T, "s", markerfacecolor="none", color=NAME, markersize=9, markeredgewidth=0.9, zorder=3)
    if rejected:
        axes.plot(*s.measured.T, "x", color=INK, markersize=8, markeredgewidth=1.4, zorder=6)
    if expected:
        _draw_expected(axes, s, size, colour, rejected)
    if named and s.outcome != "ignored" and s.name:
        at = s.expected.mean(axis=0) if expected and (single or not len(s.measured)) else s.measured.mean(axis=0)
        name_points(axes, at[None], [s.name], zorder=7, fontsize=7, color=NAME)


def _draw_expected(axes: Axes, s: ImageObservation, size: tuple[float, float], colour: str, rejected: bool) -> None:
    style: Style = {"color": colour, "linewidth": 1.1, "linestyle": "--" if rejected else "-", "zorder": 5}
    if len(s.expected) == 1:
        axes.plot(*s.expected.T, ".", color=colour, markersize=3, zorder=5)
        if np.isfinite(s.Z).all():
            axes.plot(*contours(s.expected, s.Z[None])[0, 0].T, **style)
        if rejected:
            axes.plot(*np.vstack([s.measured, s.expected]).T, ":", color=INK, linewidth=0.8, zorder=4)
    elif len(s.expected) == 2:
        line = clip_line(s.expected[0], s.expected[1], size)
        if line is not None:
            axes.plot(*line.T, **style)
    else:
        axes.plot(*np.vstack([s.expected, s.expected[:1]]).T, **style)


def legend(seen: list[Image], options: Picture) -> list[Line2D]:
    """Return the entries of the legend: only what there is."""
    observations = [s for image in seen for s in image.observations]
    lines = any(len(s.measured) > 1 for s in observations)
    mark: Style = {"linewidth": 3, "alpha": 0.55} if lines else {"marker": "+", "linestyle": ""}
    colour = options.colour("measured", SEGMENT if lines else MEASURED)
    out = [Line2D([], [], color=colour, label="measured", **mark)]
    found = dict.fromkeys(colour_of(s, options) for s in observations if np.isfinite(s.expected).all())
    out += [Line2D([], [], color=c, label=label if lines else f"{label}, 3σ") for c, label in sorted(found)]
    if any(s.outcome == "new" for s in observations):
        square: Style = {"marker": "s", "markerfacecolor": "none", "linestyle": ""}
        out.append(Line2D([], [], color=NAME, label="new landmark", **square))
    if any(s.outcome == "rejected" for s in observations):
        out.append(Line2D([], [], color=INK, marker="x", linestyle="", label="rejected"))
    return out
