"""``sensor_<robot>_<sensor>.png``: what a camera saw in one scan, on what the filter expected it to see."""

from __future__ import annotations

from collections import Counter
from os import PathLike
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from kalmark.errors import RunError
from kalmark.results.history import Camera
from kalmark.results.images import Image, Sighting, colour_of, images, steps_of, trimmed
from kalmark.results.recording import Recording
from kalmark.results.scene import INK, contours

MEASURED, NAME = "#7d838d", "#1e4d2b"


def save_sensor(run: Recording, robot: str, sensor: str, path: str | PathLike[str], step: int | None = None) -> None:
    """Draw a camera's last scan, or that at a step, and write it as a PNG."""
    figure = draw_sensor(run, robot, sensor, step)
    FigureCanvasAgg(figure)
    figure.savefig(path, dpi=110, format="png")


def draw_sensor(run: Recording, robot: str, sensor: str, step: int | None = None, t_s: float | None = None) -> Figure:
    """Return the figure of a camera's last scan, or of that at a step, or of the last up to a time.

    Pixels, v downwards; measurements are grey crosses or thick lines, expectations 3-sigma ellipses of Z around e or
    thin lines.  `t_s`, and the time in the title, are seconds since the first scan, as in the report.  Raises RunError
    if there is no such camera or scan.
    """
    camera, at = find(run, robot, sensor), chosen(run, robot, sensor, step, t_s)
    seen = images(run.history, camera, at)
    shape = camera.size[1] / camera.size[0]
    width = 9.0 if len(seen) == 1 else 14.0
    figure = Figure(figsize=(width, (width - 1.0) / len(seen) * shape + 1.5), layout="constrained", facecolor="white")
    grid = figure.subplots(1, len(seen), squeeze=False)[0]
    for axes, image in zip(grid, seen, strict=True):
        draw_image(axes, image, camera.size)
    t, outcomes = (run.history.t_ns[at] - run.history.t_ns[0]) * 1e-9, Counter(s.outcome for s in seen[0].sightings)
    said = ", ".join(f"{number} {outcome}" for outcome, number in outcomes.items())
    figure.suptitle(
        f"{robot} · {sensor} · t = {t:.3f} s · {said}", x=0.02, ha="left", fontsize=12, fontweight="bold", color=INK
    )
    figure.legend(handles=legend(seen), loc="outside lower center", ncols=4, frameon=False, fontsize=9)
    return figure


def find(run: Recording, robot: str, sensor: str) -> Camera:
    """Return a camera of a run by its name.  Raises RunError if there is none of that name."""
    for camera in run.history.cameras:
        if (camera.robot, camera.sensor) == (robot, sensor):
            return camera
    names = ", ".join(f"{c.robot}.{c.sensor}" for c in run.history.cameras) or "none"
    raise RunError(f"camera {robot}.{sensor} is not in this run, expected one of: {names}")


def chosen(run: Recording, robot: str, sensor: str, step: int | None = None, t_s: float | None = None) -> int:
    """Return the step of a camera's scan: the last of all, of those up to a step, or of those up to a time."""
    steps = steps_of(run.history, find(run, robot, sensor))
    if t_s is not None:
        steps = steps[run.history.t_ns[steps] - run.history.t_ns[0] <= round(t_s * 1e9)]
    if step is not None:
        steps = steps[steps <= step]
    if len(steps) == 0:
        raise RunError(f"camera {robot}.{sensor} saw nothing until then, expected a scan with an observation")
    return int(steps[-1])


def draw_image(axes: Axes, image: Image, size: tuple[float, float]) -> None:
    """Draw what one image of a camera shows of a scan: u to the right, v down."""
    axes.set_xlim(0, size[0])
    axes.set_ylim(size[1], 0)
    axes.set_aspect("equal", adjustable="box")
    axes.set_xlabel("u (px)", color=INK)
    axes.set_ylabel("v (px)", color=INK)
    axes.tick_params(colors="#555b66", labelsize=8)
    if image.side:
        axes.set_title(f"{image.side} image", fontsize=10, color="#555b66")
    for sighting in image.sightings:
        _draw(axes, sighting, size)


def _draw(axes: Axes, s: Sighting, size: tuple[float, float]) -> None:
    colour, _ = colour_of(s)
    expected, single = np.isfinite(s.expected).all(), len(s.measured) == 1
    closed = np.vstack([s.measured, s.measured[:1]]) if len(s.measured) > 2 else s.measured
    rejected, new = s.outcome == "rejected", s.outcome == "new"
    if single:
        axes.plot(*s.measured.T, "+", color=MEASURED, markersize=8, markeredgewidth=1.1, zorder=3)
    else:
        axes.plot(*closed.T, "-", color="#3a68c8" if not new else MEASURED, linewidth=3.0, alpha=0.55, zorder=2)
    if new:
        axes.plot(*s.measured.T, "s", markerfacecolor="none", color=NAME, markersize=9, markeredgewidth=0.9, zorder=3)
    if rejected:
        axes.plot(*s.measured.T, "x", color=INK, markersize=8, markeredgewidth=1.4, zorder=6)
    if expected:
        _draw_expected(axes, s, size, colour, rejected)
    if s.outcome != "ignored" and s.name:
        at = s.expected.mean(axis=0) if expected and single else s.measured.mean(axis=0)
        text: dict[str, Any] = {"ha": "center", "va": "bottom", "fontsize": 7, "color": NAME, "clip_on": True}
        axes.text(at[0], at[1] - 15.0, s.name, zorder=7, **text)


def _draw_expected(axes: Axes, s: Sighting, size: tuple[float, float], colour: str, rejected: bool) -> None:
    style: dict[str, Any] = {"color": colour, "linewidth": 1.1, "linestyle": "--" if rejected else "-", "zorder": 5}
    if len(s.expected) == 1:
        axes.plot(*s.expected.T, ".", color=colour, markersize=3, zorder=5)
        if np.isfinite(s.Z).all():
            axes.plot(*contours(s.expected, s.Z[None])[0, 0].T, **style)
        if rejected:
            axes.plot(*np.vstack([s.measured, s.expected]).T, ":", color=INK, linewidth=0.8, zorder=4)
    elif len(s.expected) == 2:
        line = trimmed(s.expected[0], s.expected[1], size)
        if line is not None:
            axes.plot(*line.T, **style)
    else:
        axes.plot(*np.vstack([s.expected, s.expected[:1]]).T, **style)


def legend(seen: list[Image]) -> list[Line2D]:
    """Return the entries of the legend: only what there is."""
    sightings = [s for image in seen for s in image.sightings]
    out = [Line2D([], [], color=MEASURED, marker="+", linestyle="", label="measured")]
    if any(len(s.measured) > 1 for s in sightings):
        out = [Line2D([], [], color="#3a68c8", linewidth=3, alpha=0.55, label="measured")]
    found = dict.fromkeys(colour_of(s) for s in sightings if np.isfinite(s.expected).all())
    lines = any(len(s.measured) > 1 for s in sightings)
    out += [Line2D([], [], color=c, label=label if lines else rf"{label}, $3\sigma$") for c, label in sorted(found)]
    if any(s.outcome == "new" for s in sightings):
        square: dict[str, Any] = {"marker": "s", "markerfacecolor": "none", "linestyle": ""}
        out.append(Line2D([], [], color=NAME, label="new landmark", **square))
    if any(s.outcome == "rejected" for s in sightings):
        out.append(Line2D([], [], color=INK, marker="x", linestyle="", label="rejected"))
    return out
