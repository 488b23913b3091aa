"""Draw docs/images/localization.png: a robot started anywhere in a hall whose pillars are known, and what it expects.

python docs/images/localization.py
"""

import math
import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import kalmark as km

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
from hall import MOTIONS, REACH_M, SIGMA_BEARING_RAD, SIGMA_RANGE_M, hall

SEED, FIRST_S, LASTS_S = 5, 30.0, 40.0

log = hall(SEED, bad_wheel=False)
places = np.array(list(log.landmarks.values()))
cov = np.diag([24.0**2 / 12, 16.0**2 / 12, math.pi**2 / 3])
laser = km.Mount(km.sensors.RangeBearing(SIGMA_RANGE_M, SIGMA_BEARING_RAD, range_max_m=REACH_M))
rover = km.Robot("rover", MOTIONS[False], (0.0, 0.0, 0.0), {"laser": laser}, cov=cov)
slam = km.Slam([rover], km.association.Automatic())
for name, place in log.landmarks.items():
    slam.add_landmark(name, place)
events = [e for e in log.events if FIRST_S <= e.t_ns * 1e-9 <= FIRST_S + LASTS_S]
path, last, expected = [slam.mean("rover")], events[-1], None  # the start, then what is known of the pose
for event in events:
    if isinstance(event, km.Scan):
        expected, last = slam.expect("rover", "laser"), event
    slam.process(event)
    if slam.covariance("rover")[2, 2] < 1.0:
        path.append(slam.mean("rover"))
estimated, truth = np.array(path), log.truth["rover"]
true = truth.poses[(truth.t_ns * 1e-9 >= FIRST_S) & (truth.t_ns * 1e-9 <= FIRST_S + LASTS_S)]

figure, (plan, seen) = plt.subplots(1, 2, figsize=(12, 4.6), width_ratios=(1.25, 1.0), layout="constrained")
plan.plot(*places.T, "^", color="#2f7d4f", mfc="none", label="pillars, known exactly")
plan.plot(*true[:, :2].T, color="#8b929c", lw=3, alpha=0.6, label="true path")
plan.plot(*estimated[1:, :2].T, color="#1f5fa8", lw=1.2, label="estimated path")
plan.plot(*estimated[0, :2], "o", color="#c8553d", label="start as given, $1\\sigma$")
plan.plot(*km.geometry.ellipse(estimated[0, :2], cov[:2, :2], 1.0, 60).T, ":", color="#c8553d")
plan.set_aspect("equal")
plan.set_xlabel("x (m)")
plan.set_ylabel("y (m)")
plan.legend(loc="upper center", bbox_to_anchor=(0.5, -0.12), ncols=4, fontsize=8, frameon=False)
assert expected is not None
y = np.asarray(last.y)
seen.plot(np.degrees(y[:, 1]), y[:, 0], "+", color="#2b2f36", ms=9, label="measured")
for k, contour in enumerate(expected.ellipses(3.0)):
    if expected.in_view[k]:
        label = "expected, $3\\sigma$" if k == np.argmax(expected.in_view) else None
        seen.plot(np.degrees(contour[:, 1]), contour[:, 0], color="#0aa5b5", lw=1.2, label=label)
        at = np.degrees(expected.e[k, 1]), expected.e[k, 0]
        seen.annotate(str(expected.names[k]), at, (5, 5), textcoords="offset points", fontsize=8)
seen.invert_xaxis()
seen.set_xlabel("bearing (deg)")
seen.set_ylabel("range (m)")
seen.legend(loc="upper center", bbox_to_anchor=(0.5, -0.12), ncols=2, fontsize=8, frameon=False)
figure.savefig(Path(__file__).with_suffix(".png"), dpi=100)
