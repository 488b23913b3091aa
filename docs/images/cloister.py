"""Draw the README's picture from what two commands leave behind.

kalmark demo
kalmark campaign cloister --runs 50 --estimator invariant --estimator ekf --out out/cloister
python docs/images/cloister.py [out/demo out/cloister]
"""

import csv
import sys
from pathlib import Path

from matplotlib.figure import Figure

import kalmark as km
from kalmark.results.run import Run

RUN, CAMPAIGN = (Path(p) for p in (sys.argv[1:] or ["out/demo", "out/cloister"]))
INK, COLOURS = "#20303c", {"invariant": "#1f5fa8", "ekf": "#c4543a"}

run, slam = Run.load(RUN), km.Slam.load(RUN / "map.kmk")
rows = list(csv.DictReader((CAMPAIGN / "anees.csv").open()))

figure = Figure(figsize=(11, 4.6), layout="constrained", facecolor="white")
world, nees = figure.subplots(1, 2, width_ratios=[1, 1.25])

path = run.history.mean
world.plot(path[:, 0], path[:, 1], color=COLOURS["invariant"], lw=0.8)
for row in slam.landmarks():
    world.plot(*km.geometry.ellipse(row.mean, row.covariance, 3, 40).T, color="#d06a1c", lw=1)
    world.plot(*row.mean, ".", color="#d06a1c", ms=3)
world.set_aspect("equal")
world.set_xlabel("x (m)")
world.set_ylabel("y (m)")

for estimator, colour in COLOURS.items():
    mine = [r for r in rows if r["estimator"] == estimator and r["pose_anees"]]
    t = [float(r["t_s"]) for r in mine]
    nees.semilogy(t, [float(r["pose_anees"]) for r in mine], color=colour, lw=1, label=estimator)
low, high = float(mine[0]["pose_low"]), float(mine[0]["pose_high"])
nees.axhspan(low, high, color="0.85", label="where a consistent filter stays, 95 %")
nees.axhline(3, color=INK, lw=0.8)
nees.set_yticks([3, 5, 10], ["3", "5", "10"])
nees.minorticks_off()
nees.set_xlabel("time (s)")
nees.set_ylabel("average NEES of the pose, 50 runs")
nees.legend(frameon=False, loc="upper left")
for axes in (world, nees):
    axes.spines[["top", "right"]].set_visible(False)

figure.savefig(Path(__file__).with_suffix(".png"), dpi=110)
