"""The picture of a campaign: average NEES over time with its 95 % band, a row a quantity, a line an estimator."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from kalmark.campaign.statistics import Anees
from kalmark.results.columns import Array
from kalmark.results.scene import COLOURS, grouped

POINTS = 400  # of a curve, at most
COARSE, FINE = (1.0, 2.0, 5.0), (1.0, 1.2, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0)  # ticks in a decade


class Panel(NamedTuple):
    """One quantity: its label, its ANEES for a consistent filter, and the ANEES of each estimator."""

    label: str
    ideal: float
    anees: dict[str, Anees]


def draw(path: Path, title: str, t_s: Array, panels: Sequence[Panel]) -> None:
    """Write the picture to a PNG file.  NEES in the estimator's coordinates, robots averaged, logarithmic."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 2.5 * len(panels)), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(len(panels), 1, sharex=True)
    for axis, panel in zip(axes, panels, strict=True):
        _draw_panel(axis, t_s, panel)
    axes[-1].set_xlabel("time (s)")
    each = _each(len(t_s))
    figure.suptitle(title + (f"; curves: means over {each} steps" if each > 1 else ""))
    figure.savefig(path, dpi=110)


def _each(steps: int) -> int:
    """Return how many steps to draw as one."""
    return -(-steps // POINTS)


def curves(t_s: Array, value: Array, *others: Array) -> Array:
    """Return curves (K, M), the first over time (N,), that can be read: means over steps that have a value (N,).

    NaN stands where a gap in time is, so that no line is drawn across it.
    """
    steps = np.flatnonzero(np.isfinite(value))
    groups, gaps = grouped(steps, (t_s[steps] * 1e9).astype(np.int64), _each(len(t_s)))
    size = np.bincount(groups)
    return np.insert([np.bincount(groups, row[steps]) / size for row in (t_s, value, *others)], gaps, np.nan, axis=1)


def _draw_panel(axis: Any, t_s: Array, panel: Panel) -> None:
    from matplotlib.ticker import LogLocator, NullFormatter

    for i, (estimator, anees) in enumerate(panel.anees.items()):
        rows = (np.ma.masked_invalid(a).mean(axis=0).filled(np.nan) for a in (anees.mean, anees.low, anees.high))
        t, value, low, high = curves(t_s, *rows)
        label = f"{estimator} ({anees.average:.3g}; {100 * anees.inside:.0f} % inside)"
        if i == 0:
            axis.fill_between(t, low, high, color="0.85", linewidth=0, label="95 % band")
        axis.plot(t, value, color=COLOURS[i % len(COLOURS)], linewidth=0.9, label=label)
    axis.axhline(panel.ideal, color="0.4", linewidth=0.6)
    axis.set_yscale("log")
    bottom, top = axis.get_ylim()
    axis.yaxis.set_major_locator(LogLocator(subs=COARSE if top > 5.0 * bottom else FINE))
    axis.yaxis.set_major_formatter("{x:g}")
    axis.yaxis.set_minor_formatter(NullFormatter())
    axis.set_ylabel(panel.label)
    axis.grid(visible=True, which="both", linewidth=0.3)
    axis.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=4, fontsize="small", frameon=False, borderpad=0.1)
