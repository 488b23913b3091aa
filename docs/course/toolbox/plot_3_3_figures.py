r"""
[TB] 3.3: the figures of the map and of the sensors
===================================================

The toolbox draws one ``MapFig``, the world in 3D with the simulated and the estimated robots, sensors and landmarks,
and one ``SenFig`` for each sensor, in its measurement space. In kalmark ``kalmark report RUN`` writes both, and
``kalmark view RUN`` shows them step by step. Here they are made by hand, from the filter itself.
"""

# %%
# A run up to its last frame
# --------------------------
import matplotlib.pyplot as plt
import numpy as np

import kalmark as km
from kalmark.config import build_slam
from kalmark.results.landmark_table import MapLandmarks
from kalmark.simulate import load_world, simulate

world = load_world("thick_cloister_pinhole", ["steps=60"])
log = simulate(world, seed=1)
slam = build_slam(world.config(), log)
for event in log.events:
    report = slam.process(event)
seen = slam.expect("robot", "camera", in_view=True)

# %%
# Both figures
# ------------
#
# ``SenFig``: measurements are crosses, with the predicted places of the mapped landmarks and their ellipses of 3 sigma,
# made four times as large to be seen. ``MapFig``: true landmarks are crosses, those of the map have ellipsoids. An
# ellipsoid of 3 sigma is a sphere times the square root of the covariance, [S] (87) in space.
figure = plt.figure(figsize=(11, 5), layout="constrained")
image, ax = figure.add_subplot(1, 2, 1), figure.add_subplot(1, 2, 2, projection="3d")
image.plot(*log.events[-1].y.T, "k+")
for name, e, Z in zip(seen.names, seen.e, seen.Z, strict=True):
    image.plot(*km.geometry.ellipse(e, Z, sigmas=12, points=30).T, "C0", lw=1)
    image.annotate(name, e + 6, color="C0", size="small")
image.set(xlim=(0, 640), ylim=(480, 0), aspect="equal", xlabel="u [px]")
turns, tilts = np.mgrid[0 : 2 * np.pi : 13j, 0 : np.pi : 7j]
ring = np.sin(tilts)
sphere = np.array([ring * np.cos(turns), ring * np.sin(turns), np.cos(tilts)])
places, covariances = MapLandmarks.of(slam).positions()
for place, P in zip(places, covariances, strict=True):
    ellipsoid = np.tensordot(3 * np.linalg.cholesky(P), sphere, axes=1)
    ax.plot_wireframe(*(ellipsoid + place[:, None, None]), color="C0", lw=0.4)
ax.plot(*np.array(list(log.landmarks.values())).T, "k+", ms=4)
ax.plot(*log.truth["robot"].poses[:, :3].T, "C2")
ax.set(aspect="equal", xlabel="x [m]", ylabel="y [m]", xlim=(-6, 9), ylim=(-8, 7))

# %%
# Try changing
# ------------
#
# * An earlier frame: ``"steps=10"``. The ellipsoids are long towards the landmarks: their depth is hardly known.
# * The whole run of the world: ``"steps=400"``. All ellipsoids are small, and the landmarks of the start are seen
#   again.
