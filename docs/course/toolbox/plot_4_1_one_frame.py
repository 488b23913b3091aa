r"""
[TB] 4: one frame of the camera, from the expectation to the correction
=======================================================================

The loop of the toolbox, [TB] 4.1 and 4.2, does this with each frame: it moves the robot, projects every landmark into
the image, searches the best ones inside the ellipses of :math:`Z = E_x P E_x^\top + R`, corrects, and starts new
landmarks. Here the same frame is looked at three times: expected, measured, corrected.
"""

# %%
# Up to the frame
# ---------------
#
# ``process`` takes one event at a time, so that a run can be stopped before any frame. Only the robot has moved up to
# here.
import matplotlib.pyplot as plt
import numpy as np

import kalmark as km
from kalmark.config import build_slam
from kalmark.simulate import load_world, simulate

world = load_world("thick_cloister_pinhole", ["steps=16"])
log = simulate(world, seed=1)
slam = build_slam(world.config(), log)
for event in log.events[:-1]:
    slam.process(event)
expected = slam.expect("robot", "camera", in_view=True)

# %%
# The frame
# ---------
#
# ``report`` has, of each observation, the innovation :math:`z`, its covariance :math:`Z` and the outcome, as ``Obs`` in
# the toolbox: *associated* is ``updated``, *new* is a landmark that starts.
report = slam.process(log.events[-1])
corrected = slam.expect("robot", "camera", expected.names)
for kind in ("associated", "new", "rejected"):
    print(kind, sum(o.outcome == kind for o in report.observations))
print("sigma of the position:", np.sqrt(np.diag(slam.covariance("robot"))[:3]).round(4), "m")

# %%
# Expected, measured, corrected
# -----------------------------
#
# The ellipses of 3 sigma before the correction show where the camera searches. After it they are hardly larger than the
# noise of one pixel. The ellipses are enlarged five times.
figure, ax = plt.subplots(figsize=(7, 5.4), layout="constrained")
for seen, color in ((expected, "tab:blue"), (corrected, "tab:orange")):
    for e, Z in zip(seen.e, seen.Z, strict=True):
        ax.plot(*km.geometry.ellipse(e, Z, sigmas=15).T, color=color, lw=1)
ax.plot(*log.events[-1].y.T, "k+", ms=5)
ax.set(xlim=(0, 640), ylim=(480, 0), aspect="equal", xlabel="u [px]", ylabel="v [px]")
ax.set_title("expected (blue), corrected (orange), measured (+)")
plt.show()

# %%
# Try changing
# ------------
#
# * ``"steps=2"``: the landmarks have just started, and the ellipses are long towards where the depth is unknown.
# * ``"filter.landmarks.type=inverse_depth"`` beside ``steps``: another parametrisation of the same points.
# * Fewer updates: ``"robots.robot.sensors.camera.attention.updates=4"`` beside ``steps``. Four landmarks
#   correct, and the sigmas of the position are 0.019, 0.011 and 0.010 m in place of 0.019, 0.009 and 0.008 m.
