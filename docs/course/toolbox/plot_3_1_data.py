r"""
[TB] 3.1: robots, sensors, landmarks, map and observations
==========================================================

The toolbox keeps a SLAM problem in structures, [TB] table 1: ``Rob``, ``Sen``, ``Lmk``, ``Map``, ``Obs`` and ``Tim``,
and the truth in ``SimRob``, ``SimSen`` and ``SimLmk``. kalmark has the same parts. The truth is in a *world* alone; the
filter gets a log of events.
"""

# %%
# The world is the truth, the configuration the filter
# ----------------------------------------------------
#
# This is the toolbox's thick cloister: a robot on a circle, by odometry, with a camera that looks ahead. ``simulate``
# makes the log. ``build_slam`` makes the filter of the configuration that belongs to the world.
import matplotlib.pyplot as plt

from kalmark.config import build_slam
from kalmark.results.landmark_table import MapLandmarks
from kalmark.simulate import load_world, simulate

world = load_world("thick_cloister_pinhole", ["steps=120"])
log = simulate(world, seed=1)
slam = build_slam(world.config(), log)
for event in log.events:
    report = slam.process(event)

# %%
# Content of the structures
# -------------------------
#
# ``Rob.frame.x`` and ``.P`` are the robot's mean and covariance, ``Lmk.state`` those of a landmark, ``Map`` all of them
# together. ``Obs`` is what ``expect`` returns: ``exp.e``, ``inn.Z`` and the Jacobians ``E_r``, ``E_s`` and ``E_l``.
table, seen = slam.landmarks(), slam.expect("robot", "camera", in_view=True)
print("Rob.frame.x   ", slam.mean("robot").round(2))
print("Map           ", slam.covariance("robot", *table.ids).shape, "of the robot and", len(table), "landmarks")
print("Lmk(1)        ", table.ids[0], table.kinds[0], table.means[0].round(2))
print("Obs.exp.e     ", seen.e[0].round(1), "px of", seen.names[0])
print("Obs.inn.Z     ", seen.Z[0].round(1).tolist())
print("Obs.Jac.E_r   ", seen.E_r[0].shape, " E_l", seen.E_l[0].shape)

# %%
# The map figure
# --------------
#
# From above: true landmarks are circles, those of the map points. The camera has seen half of the cloister so far.
figure, ax = plt.subplots(figsize=(5.5, 5.5), layout="constrained")
ax.plot(*zip(*[place[:2] for place in log.landmarks.values()], strict=True), "o", mfc="none", label="SimLmk: truth")
ax.plot(*MapLandmarks.of(slam).positions()[0][:, :2].T, ".", label="Lmk: the map")
ax.plot(*log.truth["robot"].poses[:, :2].T, label="SimRob: the true path")
ax.set(aspect="equal", xlabel="x [m]", ylabel="y [m]", xlim=(-8, 8), ylim=(-8, 8))
ax.legend()
plt.show()

# %%
# Try changing
# ------------
#
# * ``"thick_cloister_stereo"`` and the sensor ``"stereo"``: a pair measures depth, and landmarks are points at once.
# * ``"steps=400"``: the robot closes its circle, and all covariances become smaller.
# * Every field of the toolbox's user data is in the table :doc:`/toolbox`.
