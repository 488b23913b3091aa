"""The picture of a campaign: average NEES over time with its 95 % band, a row a quantity, a line an estimator."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from kalmark.campaign.statistics import Anees, kinds
from kalmark.results.picture import COLOURS

if TYPE_CHECKING:
    from kalmark.campaign.campaign import Campaign

POINTS = 400  # of a curve, at most
COARSE, FINE = (1.0, 2.0, 5.0), (1.0, 1.2, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0)  # ticks in a decade


def draw(campaign: Campaign, path: Path) -> None:
    """Write the picture to a PNG file.  NEES in the estimator's coordinates, robots averaged, logarithmic."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    scores = [s for runs in campaign.scores.values() for s in runs]
    rows = kinds(scores)
    figure = Figure(figsize=(9, 2.5 * len(rows)), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(len(rows), 1, sharex=True)
    for axis, name in zip(axes, rows, strict=True):
        _draw_row(axis, campaign, name)
    axes[-1].set_xlabel("time (s)")
    each = _each(len(campaign.t_s))
    means = f"; curves: means over {each} steps" if each > 1 else ""
    figure.suptitle(f"{campaign.world}: average NEES of {campaign.runs} runs, seed {campaign.seed}{means}")
    figure.savefig(path, dpi=110)


def _each(steps: int) -> int:
    """Return how many steps to draw as one."""
    return -(-steps // POINTS)


def _thinned(values: Any) -> Any:
    """Return the means of so many values (N,), masked ones left out, that a curve of them can be read."""
    values, each = np.ma.masked_invalid(values), _each(len(values))
    means = np.ma.array(np.zeros(-(-len(values) // each)), mask=True)
    for i in range(len(means)):
        means[i] = values[i * each : (i + 1) * each].mean()
    return means


def _draw_row(axis: Any, campaign: Campaign, name: str) -> None:
    from matplotlib.ticker import LogLocator, NullFormatter

    t_s = _thinned(np.array(campaign.t_s) - (campaign.t_s[0] if campaign.kind == "config" else 0.0))  # logs have clocks
    for i, (estimator, scores) in enumerate(campaign.scores.items()):
        anees = Anees(name, scores, campaign.skip)
        rows = (np.nanmean(np.ma.masked_invalid(a), axis=0) for a in (anees.mean, anees.low, anees.high))
        value, low, high = map(_thinned, rows)
        some = ~np.ma.getmaskarray(value)
        label = f"{estimator} ({anees.average:.3g}; {100 * anees.inside:.0f} % inside)"
        if i == 0:
            axis.fill_between(t_s[some], low[some], high[some], color="0.85", linewidth=0, label="95 % band")
        axis.plot(t_s[some], value[some], color=COLOURS[i % len(COLOURS)], linewidth=0.9, label=label)
    axis.axhline(campaign.ideal(name), color="0.4", linewidth=0.6)
    axis.set_yscale("log")
    bottom, top = axis.get_ylim()
    axis.yaxis.set_major_locator(LogLocator(subs=COARSE if top > 5.0 * bottom else FINE))
    axis.yaxis.set_major_formatter("{x:g}")
    axis.yaxis.set_minor_formatter(NullFormatter())
    axis.set_ylabel(campaign.label(name))
    axis.grid(visible=True, which="both", linewidth=0.3)
    axis.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=4, fontsize="small", frameon=False, borderpad=0.1)
