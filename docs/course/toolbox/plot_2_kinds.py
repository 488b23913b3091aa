r"""
[TB] 2: robots, sensors and landmarks of different kinds
========================================================

A SLAM problem may have several robots of different kinds, each with its sensors, and landmarks of several kinds: [TB]
Figure 1. The toolbox handles them by the same code, and so does kalmark: all are blocks of one map.
"""

# %%
# Two robots
# ----------
#
# ``alpha`` drives on a circle and measures range and two angles. ``beta`` flies up and down with a camera, whose
# place on its robot is known to 5 cm and 1.5 degrees only; so it is in the map, as ``Sen.frame`` of the toolbox with
# ``frameInMap``.
import matplotlib.pyplot as plt
import numpy as np

from kalmark.config import build_slam
from kalmark.simulate import load_world, simulate

world = load_world("self_calibration", ["steps=150"])
log = simulate(world, seed=1)
slam = build_slam(world.config(), log)
sigmas, counted = [], {}
for event in log.events:
    slam.process(event)
    sigmas.append((event.t_ns / 1e9, *np.sqrt(np.diag(slam.covariance("beta.camera")))))
    for kind in (kinds := slam.landmarks().kinds):
        counted.setdefault(kind, []).append((event.t_ns / 1e9, kinds.count(kind)))
P = slam.covariance("alpha", "beta", "beta.camera")
print("alpha, beta and the camera of beta:", P.shape)

# %%
# Two paths, two kinds of landmarks, one mount
# --------------------------------------------
#
# A range begins a Euclidean point, a pixel one with an unknown depth. The camera corrects both kinds, and a
# landmark whose depth has become known is made Euclidean. The mount is found on the way: what ``alpha`` has measured
# to centimetres determines where the camera of ``beta`` is.
figure = plt.figure(figsize=(11, 4.2), layout="constrained")
ax = figure.add_subplot(1, 3, 1, projection="3d")
kinds, mount = figure.add_subplot(1, 3, 2), figure.add_subplot(1, 3, 3)
ax.plot(*np.array(list(log.landmarks.values())).T, "k+", ms=4)
for name, trajectory in log.truth.items():
    ax.plot(*trajectory.poses[:, :3].T, label=name)
ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.05), ncols=2)
for kind, counts in counted.items():
    kinds.plot(*np.array(counts).T, drawstyle="steps-post", label=kind)
t, *rows = np.array(sigmas).T
mount.semilogy(t, np.transpose(rows), label=[*"xyz", *(f"about {axis}" for axis in "xyz")])
for ax, title in (kinds, "landmarks of each kind"), (mount, "sigmas of the mount [m], [rad]"):
    ax.set(xlabel="t [s]", title=title)
    ax.legend()
plt.show()

# %%
# Try changing
# ------------
#
# * A shorter range of ``alpha``: ``"robots.alpha.sensors.lidar.range_max_m=2"`` beside ``steps``. 53 points start with
#   an unknown depth in place of 4, and 41 are still so at the end.
