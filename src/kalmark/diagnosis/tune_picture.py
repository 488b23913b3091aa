"""The picture of a tuning: the NIS over time before and after, and by how much each noise was changed."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from kalmark.diagnosis.tune import Tuning
from kalmark.results.plot import ALARM_COLOUR, EUCLIDEAN_COLOUR, SOFT


def draw_tuning(tuning: Tuning, name: str) -> Figure:
    """Return the picture of the tuning of a configuration of that name."""
    figure = Figure(figsize=(11, 4.2), facecolor="white", layout="constrained")
    (_, before), (_, after) = tuning.before, tuning.after
    title = f"{name}: NIS per degree of freedom {before.nis:.3g} before, {after.nis:.3g} after, on the second part"
    figure.suptitle(title, x=0.01, ha="left", fontweight="bold")
    left, right = figure.subplots(1, 2, width_ratios=(1.4, 1))
    _nis(left, tuning)
    _factors(right, tuning)
    return figure


def _nis(axes: Axes, tuning: Tuning) -> None:
    for windows, colour, label in zip(tuning.windows, (SOFT, EUCLIDEAN_COLOUR), ("before", "after"), strict=True):
        for k, window in enumerate(windows):
            axes.plot(
                [window.start_s, window.end_s], [window.value] * 2, color=colour, lw=1.6, label=label if not k else None
            )
    axes.axhline(1.0, color=SOFT, lw=0.8, ls="--")
    axes.axvline(tuning.split_s, color=ALARM_COLOUR, lw=0.8)
    axes.set_yscale("log")
    axes.set_title("NIS per degree of freedom; the part right of the line judges", loc="left", fontsize=10)
    axes.set_xlabel("t (s) since the first scan")
    axes.legend(frameon=False)


def _factors(axes: Axes, tuning: Tuning) -> None:
    noises = [c for c in tuning.changes if c.path[-1].startswith("sigma_") and c.before][::-1]
    for k, change in enumerate(noises):
        factor, width = change.after / change.before, np.exp(2.0 * min(change.sigma, 3.0))
        colour = EUCLIDEAN_COLOUR if change.changed else SOFT
        axes.plot([factor / width, factor * width], [k, k], color=colour, lw=1.6)
        axes.plot(factor, k, "o", color=colour)
    axes.set_yticks(range(len(noises)), [".".join(c.path[3:] or c.path) for c in noises])
    axes.axvline(1.0, color=SOFT, lw=0.8, ls="--")
    axes.set_xscale("log")
    axes.set_title("times the noise stated, 2 sigma", loc="left", fontsize=10)
