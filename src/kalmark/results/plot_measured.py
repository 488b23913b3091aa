"""The picture of one scan by a sensor that is no camera, in its measurement space: ``sensor_<robot>_<sensor>.png``.

Two of its numbers are drawn: bearing and range, or two coordinates, those of a sensor of its own robot as in the map.
Crosses are the measurements, ellipses of Z around e are what the filter expected, of landmarks in view that were not
measured, too.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from kalmark.arrays import Array
from kalmark.geometry.gaussian import ellipses
from kalmark.picture_options import Picture
from kalmark.results.history import Camera, History, Measuring
from kalmark.results.labels import name_points
from kalmark.results.scene import IN_VIEW, INK

ACROSS = ("bearing_rad", "azimuth_rad", "y_m")  # columns to be drawn from right to left, the first that there is,
AHEAD = ("range_m", "x_m")  # and upwards
USED, UNUSED, UNMEASURED = "#0aa5b5", "#c8553d", "#1f3fd0"
DEGREES = 180.0 / np.pi


def axes_of(sensor: Measuring) -> list[str]:
    """Return the columns that are drawn to the right and upwards, [] if no two of the measurements can be."""
    found = [next((name for name in names if name in sensor.columns), "") for names in (ACROSS, AHEAD)]
    return found if all(found) else []


def sensors_with_picture(history: History) -> list[Camera | Measuring]:
    """Return the sensors of a run that have a picture: its cameras, and others that have `axes_of`."""
    return [*history.cameras, *filter(axes_of, history.sensors)]


def draw_measured(history: History, sensor: Measuring, step: int, options: Picture) -> Figure:
    """Return the figure of a scan by a sensor that has `axes_of`."""
    mark, used_colour = options.colour("measured", INK), options.colour("landmarks_used", USED)
    unused, unmeasured = (options.colour("landmarks_predicted", usual) for usual in (UNUSED, UNMEASURED))
    rows = np.flatnonzero(history.step == step)
    in_map = bool(history.of_own[rows].any())  # of the robot's own position: x to the right, y upwards, as in the map
    drawn = axes_of(sensor)[:: -1 if in_map else 1]
    columns = [sensor.columns.index(name) for name in drawn]
    scale = np.array([DEGREES if name.endswith("_rad") else 1.0 for name in drawn])
    figure = Figure(figsize=(9.5, 7.0), layout="constrained", facecolor="white")
    axes = figure.subplots()
    y, e, Z = history.y[rows][:, columns] * scale, *_expected(history.e[rows], history.Z[rows], columns, scale)
    for k in np.flatnonzero(scale == DEGREES):  # across 180 degrees, too, an expectation is beside its measurement
        y[:, k] = wrap_deg(y[:, k])
        e[:, k] = np.where(np.isfinite(y[:, k]), y[:, k] + wrap_deg(e[:, k] - y[:, k]), e[:, k])
    used = np.isin(history.outcome[rows], ("associated", "new"))
    missed = np.flatnonzero((history.unmeasured_step == step) & (history.unmeasured_sensor == sensor.sensor))
    e_m, Z_m = _expected(history.unmeasured_e[missed], history.unmeasured_Z[missed], columns, scale)
    axes.plot(*y.T, "+", color=mark, ms=9, mew=1.4, zorder=4)
    handles = [Line2D([], [], color=mark, ls="", marker="+", mew=1.4, label="measured")]
    groups = (
        ("used", e[used], Z[used], used_colour, "-"),
        ("not used", e[~used], Z[~used], unused, "--"),
        (IN_VIEW, e_m, Z_m, unmeasured, ":"),
    )
    for what, means, covariances, colour, style in groups:
        axes.plot(*means.T, ".", color=colour, ms=3, zorder=5)
        for contour in ellipses(means, covariances, 3.0, 60):
            axes.plot(*contour.T, style, color=colour, lw=1.2, zorder=5)
        if np.isfinite(means).all(axis=1).any():
            handles.append(Line2D([], [], color=colour, ls=style, label=f"expected, $3\\sigma$, {what}"))
    names = [*history.landmark[rows].tolist(), *history.unmeasured_landmark[missed].tolist()]
    name_points(axes, np.vstack([y, e_m]), names, fontsize=8, color=INK)
    axes.set_xlabel(_label(drawn[0]))
    axes.set_ylabel(_label(drawn[1]))
    if not in_map:
        axes.invert_xaxis()  # what is on the left has positive bearings
    axes.grid(color="#eceef1")
    axes.margins(0.08)
    title = scan_title(sensor, history.t_s[step], [*history.outcome[rows].tolist(), *[IN_VIEW] * len(missed)])
    add_title_and_legend(figure, title, handles)
    return figure


def _label(column: str) -> str:
    """Return a column with its unit, angles in degrees."""
    quantity, _, unit = column.rpartition("_")
    return f"{quantity} ({'deg' if unit == 'rad' else unit})"


def scan_title(sensor: Camera | Measuring, t_s: float, outcomes: Iterable[str]) -> str:
    """Return the title of a sensor's scan: when it was, and how many observations became what."""
    said = ", ".join(f"{number} {outcome}" for outcome, number in Counter(outcomes).items())
    return f"{sensor.robot} · {sensor.sensor} · t = {t_s:.3f} s · {said}"


def add_title_and_legend(figure: Figure, title: str, handles: list[Line2D]) -> None:
    """Write the title above a figure of a scan, and its legend below."""
    figure.suptitle(title, x=0.02, ha="left", fontsize=12, fontweight="bold", color=INK)
    figure.legend(handles=handles, loc="outside lower center", ncols=4, frameon=False, fontsize=9)


def wrap_deg(angle: Array) -> Array:
    """Return angles (N,) in [-180, 180) degrees."""
    return np.asarray((angle + 180.0) % 360.0 - 180.0)


def _expected(e: Array, Z: Array, columns: list[int], scale: Array) -> tuple[Array, Array]:
    """Return e (K, 2) and Z (K, 2, 2) of two columns in the units of the axes."""
    return e[:, columns] * scale, Z[:, columns][:, :, columns] * np.outer(scale, scale)
