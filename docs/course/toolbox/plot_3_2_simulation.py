r"""
[TB] 3.2: robots, sensors and landmarks of the simulation
=========================================================

``SimRob``, ``SimSen``, ``SimLmk`` and ``SimObs`` are the toolbox's simulated robots, sensors, landmarks and raw data.
They have no uncertainty, and the filter does not need them: with real data they are absent. In kalmark a *world* has
the first three; the fourth is the log, which is all that the filter gets.
"""

# %%
# Worlds of landmarks
# -------------------
#
# A layout has points, or segments as two ends in a row: the thick cloister, the house, or points and segments of your
# own, ``world: {type: list, points_m: ...}``.
import matplotlib.pyplot as plt
import numpy as np

from kalmark.simulate import load_world, simulate

worlds = {name: load_world(name, ["steps=120"]) for name in ("thick_cloister_pinhole", "house")}
figure = plt.figure(figsize=(10, 8), layout="constrained")
for k, (name, world) in enumerate(worlds.items()):
    log = simulate(world, seed=1)
    robot = world.robots["robot"]
    mount = next(iter(robot.sensors.values())).mount
    print(f"{name}: motion {robot.motion.type}, {robot.route.u[0]} m a step")
    print(f"  camera {mount.z_m} m above the robot, {len(log.landmarks)} landmarks")
    ax = figure.add_subplot(2, 2, k + 1, projection="3d")
    for landmark in log.landmarks.values():
        ax.plot(*landmark.reshape(-1, 3).T, "k.-", ms=3, lw=1)
    ax.plot(*log.truth["robot"].poses[:, :3].T, "C0")
    ax.set(xlabel="x [m]", ylabel="y [m]", title=name, aspect="equal")
    ax.locator_params(axis="z", nbins=1)
    image = figure.add_subplot(2, 2, k + 3, aspect="equal")
    raw = log.events[-1].y
    image.plot(*np.reshape(raw, (len(raw), -1, 2)).T, "C3.-", ms=4, lw=1)
    image.set(xlim=(0, 640), ylim=(480, 0), xlabel="u [px]", ylabel="v [px]")
plt.show()

# %%
# The pictures
# ------------
#
# Above: ``SimLmk``, and the path of ``SimRob``. Below: ``SimObs``, the last frame of the camera, with a noise of one
# pixel: points of the cloister, line segments of the house.

# %%
# Try changing
# ------------
#
# * Noise of the camera: ``"robots.robot.sensors.camera.sigma_px=20"`` beside ``steps``. The segments of
#   the house do not meet any more: the ends of each have noise of their own.
# * A layout of your own: :doc:`/how/plot_07_own_world`.
