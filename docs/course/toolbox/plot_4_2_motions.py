r"""
[TB] 4.2: motion models, chosen by their type
=============================================

The interface level of the toolbox looks at the type of an object, splits it into plain data, calls the function of
that type, and puts the result back: ``simMotion``, [TB] Figure 19, chooses ``constVel`` or ``odo3``, and stops at an
unknown motion. In kalmark a motion is a class that is registered under its type. A configuration names it, and the
filter calls its ``move``, whatever it is.
"""

# %%
# Both motions, and an unknown one
# --------------------------------
#
# With odometry each control is an increment of the pose. With constant velocity the state has six rates, and a control
# is an impulse; without one the robot coasts. Only the controls are processed here, not the frames of the camera.
import matplotlib.pyplot as plt
import numpy as np

import kalmark as km
from kalmark.config import build_slam
from kalmark.simulate import load_world, simulate

figure, ax = plt.subplots(figsize=(6, 5), layout="constrained")
worlds = {"odometry": "thick_cloister", "constant velocity": "thick_cloister_constant_velocity"}
for k, (name, file) in enumerate(worlds.items()):
    world = load_world(file, ["steps=150"])
    log = simulate(world, seed=1)
    slam, path = build_slam(world.config(), log), []
    controls = [event for event in log.events if isinstance(event, km.Control)]
    for step, event in enumerate(controls):
        slam.process(event)
        path.append(slam.mean("robot"))
        if step % 30 == 29:
            P = slam.covariance("robot")
            ax.plot(*km.geometry.ellipse(path[-1][:2], P[:2, :2], 3, 60).T, f"C{k}", lw=1)
    print(f"{name}: a state of {len(path[0])} numbers, {len(P)} of its error")
    ax.plot(*np.array(path)[:, :2].T, f"C{k}", label=name)
    ax.plot(*log.truth["robot"].poses[:, :2].T, f"C{k}:")
ax.set(aspect="equal", xlabel="x [m]", ylabel="y [m]")
ax.legend()
try:
    load_world("random_field", ["robots.rover.motion.type=hover"])
except km.KalmarkError as error:
    print(error)
plt.show()

# %%
# The picture
# -----------
#
# Dotted is the truth. Each control of the odometry adds its noise once, and the ellipses of 3 sigma grow slowly. The
# noise of an impulse stays in the velocity, so the error of the position grows ever faster. The last line printed is
# the answer to an unknown motion.

# %%
# Try changing
# ------------
#
# * The scans as well: ``controls = log.events``. The ellipses become small: of the odometry hardly to be seen, of the
#   constant velocity up to 1 m long.
# * A motion of your own: :doc:`/how/plot_02_own_motion`. It is registered by one line, and its name is then a type.
