r"""
[TB] 3.3: the figures of the map and of the sensors
===================================================

The toolbox draws one ``MapFig``, the world in 3D with the simulated and the estimated robots, sensors and landmarks,
and one ``SenFig`` for each sensor, in its measurement space. In kalmark ``kalmark report RUN`` writes both, and
``kalmark view RUN`` shows them step by step. Here they are drawn from the filter itself, while it runs.
"""

# %%
# A run up to its last frame
# --------------------------
import matplotlib.pyplot as plt

import kalmark as km
from kalmark.config import build_slam
from kalmark.results.labels import name_points
from kalmark.simulate import load_world, simulate

world = load_world("thick_cloister_pinhole", ["steps=60"])
log = simulate(world, seed=1)
slam = build_slam(world.config(), log)
for event in log.events:
    report = slam.process(event)
seen = slam.expect("robot", "camera", in_view=True)

# %%
# SenFig
# ------
#
# Measurements are crosses. Blue are the predicted places of the mapped landmarks, after the correction, with their
# ellipses of 3 sigma, made four times as large to be seen; names are beside them.
figure, image = plt.subplots(figsize=(7, 5.2), layout="constrained")
image.plot(*log.events[-1].y.T, "k+")
for e, Z in zip(seen.e, seen.Z, strict=True):
    image.plot(*km.geometry.ellipse(e, Z, sigmas=12, points=30).T, "C0", lw=1)
name_points(image, seen.e, seen.names, gap=10, color="C0", size="small")
image.set(xlim=(0, 640), ylim=(480, 0), aspect="equal", xlabel="u [px]", ylabel="v [px]")

# %%
# MapFig
# ------
#
# ``km.draw`` draws the robot with its path, the true robot, the landmarks with their ellipsoids of 3 sigma, and the
# last scan with its associations.
figure, ax = plt.subplots(figsize=(9, 6), layout="constrained")
km.draw(slam, ax, truth=log, report=report)
plt.show()

# %%
# Try changing
# ------------
#
# * An earlier frame: ``"steps=10"``. The ellipsoids are long towards the landmarks: their depth is hardly known.
# * The whole run of the world: ``"steps=400"``. All ellipsoids are small, and the landmarks of the start are seen
#   again.
