"""The sensors of [S] Table 2, each in a small world of its own: their accuracy, and the consistency of the filter.

    python examples/05_table2.py [RUNS [PICTURE]]

The worlds `laser`, `sonar`, `camera`, `rgbd`, `arva` and `rfid` take noise, field of view, rate and dropouts from
`km.presets`; `kalmark campaign sonar --runs 50` runs one of them.  Printed: the average NEES of the pose over runs and
steps (3 is consistent) with its standard error over runs, the 95 % band of the average over runs at one step and the
share of steps inside, and the error of the position.
"""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
from matplotlib.figure import Figure

import kalmark as km
from kalmark.campaign import run_campaign
from kalmark.campaign.campaign import Anees

RUNS = int(sys.argv[1]) if len(sys.argv) > 1 else 2


def draw(axis: Any, name: str, t_s: tuple[float, ...], anees: Anees) -> None:
    """Draw the ANEES of a sensor over time with its band."""
    some = np.isfinite(anees.mean[0])  # a slow sensor does not measure at every step
    t = np.array(t_s)[some]
    axis.fill_between(t, anees.low[0][some], anees.high[0][some], color="0.85", linewidth=0)
    axis.plot(t, anees.mean[0][some], linewidth=0.9)
    axis.set(title=f"{name}: {anees.average:.2f}, {100 * anees.inside:.0f} % inside", yscale="log", ylim=(0.5, 30))
    axis.grid(visible=True, which="both", linewidth=0.3)


figure = Figure(figsize=(10, 5), layout="constrained")
axes = figure.subplots(2, 3, sharey=True)
print("sensor   ANEES (3)            band   inside   position, m")
for axis, name in zip(axes.flat, km.presets.TABLE_2, strict=True):
    campaign = run_campaign(name, RUNS, progress=False)
    scores = next(iter(campaign.scores.values()))
    anees = Anees("pose", scores)
    each = np.array([np.nanmean(score.series["pose"]) for score in scores])
    error = each.std(ddof=1) / np.sqrt(RUNS) if RUNS > 1 else np.nan
    band = f"{np.nanmedian(anees.low):.2f} to {np.nanmedian(anees.high):.2f}"
    metres = np.sqrt(np.nanmean([score.series["position_m"] ** 2 for score in scores]))
    print(f"{name:8s} {anees.average:5.2f} +- {error:4.2f} {band:>15s} {100 * anees.inside:6.0f} % {metres:12.3f}")
    draw(axis, name, campaign.t_s, anees)
figure.supxlabel("time (s)")
figure.supylabel(f"average NEES of the pose over {RUNS} runs (3)")
if len(sys.argv) > 2:
    figure.savefig(sys.argv[2], dpi=110)
