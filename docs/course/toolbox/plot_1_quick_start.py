r"""
[TB] 1, 4.1: the whole simulation
=================================

``universalSlam`` of the toolbox reads ``userData``, simulates motion and measurements, estimates, and draws. Here the
settings are a *world*, a file of text. On the command line the four steps are

.. code-block:: console

   kalmark worlds thick_cloister_pinhole > cloister.yaml
   kalmark simulate cloister.yaml --out log
   kalmark run log/config.yaml --out out/cloister
   kalmark view out/cloister

All lessons of this chapter use the same simulation: the toolbox's cloister of two storeys, a robot on a circle, a
camera."""

# %%
# The settings
# ------------
#
# ``load_world`` takes changes in the notation of ``--set``. Every field of ``userData`` is in the table
# :doc:`/toolbox`.
import matplotlib.pyplot as plt
import numpy as np

import kalmark as km
from kalmark.config import build_slam
from kalmark.simulate import load_world, simulate

world = load_world("thick_cloister_pinhole", ["steps=200"])
print(*world.to_yaml().splitlines()[:12], sep="\n")

# %%
# Simulation, estimation
# ----------------------
#
# ``simulate`` makes the log with its truth, ``world.config()`` the filter that fits it, ``record`` takes the log
# through the filter and keeps every step.
log = simulate(world, seed=1)
run = km.record(build_slam(world.config(), log), log, progress=False)
print(run)

# %%
# The estimate and its error
# --------------------------
#
# Left: the path from above, as estimated and as it was. Right: the error of the position; the thin lines are 3
# sigma. The camera measures no distance, but the odometry does, so the map has its scale. ``kalmark view`` shows the
# map in 3D, to be turned with the mouse.
mean, truth = run.history.mean[:, :3], log.truth["robot"].poses[1:, :3]
sigma = np.sqrt(np.diagonal(run.history.covariance, axis1=1, axis2=2)[:, :3])
figure, (ax, error) = plt.subplots(1, 2, figsize=(10, 4.4), layout="constrained")
ax.plot(*np.array(list(log.landmarks.values()))[:, :2].T, "k+", label="landmarks")
ax.plot(*truth[:, :2].T, "C2", lw=3, alpha=0.5, label="true path")
ax.plot(*mean[:, :2].T, "C0", label="estimate")
ax.set(aspect="equal", xlabel="x [m]", ylabel="y [m]")
ax.legend()
for k, axis in enumerate("xyz"):
    error.plot(run.history.t_s, mean[:, k] - truth[:, k], f"C{k}", label=axis)
    error.plot(run.history.t_s, 3 * sigma[:, [k, k]] * [1, -1], f"C{k}", lw=0.5)
error.set(xlabel="t [s]", ylabel="error of the position [m]")
error.legend()
plt.show()

# %%
# Try changing
# ------------
#
# * More noise of the camera: ``"robots.robot.sensors.camera.sigma_px=5"`` beside ``steps``. The largest 3 sigma grow
#   from 0.10, 0.14 and 0.06 m to 0.14, 0.17 and 0.13 m.
# * A whole round: ``"steps=400"``. The robot sees the first landmarks again, and the bands are narrow at the end.
