"""
Several robots
==============

Robots share one map: each has a name, in every event, and the covariance has all of them.
"""

# %%
# Two robots and a post
# ---------------------
#
# Only the start of ``alpha`` is known. ``beta`` is somewhere within two metres.
import matplotlib.pyplot as plt
import numpy as np

import kalmark as km

lidar = {"lidar": km.Mount(km.sensors.RangeBearing(sigma_range_m=0.05, sigma_bearing_rad=0.01))}
unknown = np.diag([2.0, 2.0, 0.5]) ** 2
alpha = km.Robot("alpha", km.motion.Unicycle(), start=(0.0, 0.0, 0.0), sensors=lidar)
beta = km.Robot("beta", km.motion.Unicycle(), start=(5.5, 0.5, 3.0), cov=unknown, sensors=lidar)
slam = km.Slam([alpha, beta])


def scan(robot, pose, targets, ids):
    y, _, _ = km.geometry.observe(np.array(pose), np.array(targets))
    return slam.process(km.Scan(t_s=0.0, robot=robot, sensor="lidar", y=y, ids=ids))


def sigmas(name):
    return np.sqrt(np.diag(slam.covariance(name))).round(3)


def ellipse(name):
    return km.geometry.ellipse(slam.mean(name)[:2], slam.covariance(name)[:2, :2], sigmas=3, points=40).T


# %%
# A landmark that both see
# ------------------------
#
# ``alpha`` maps the post; ``beta``, truly at (6, 0, pi), sees the same post and is corrected by it.
figure, ax = plt.subplots(figsize=(7, 4), layout="constrained")
ax.plot(*ellipse("beta"), "0.6", label="beta at first")
print("beta at first:   ", sigmas("beta"))
scan("alpha", [0.0, 0.0, 0.0], [[3.0, 1.0]], ["post"])
scan("beta", [6.0, 0.0, np.pi], [[3.0, 1.0]], ["post"])
print("by the post:     ", sigmas("beta"))
ax.plot(*ellipse("beta"), "C3", label="beta by the post")
# sphinx_gallery_defer_figures

# %%
# Robots that see each other
# --------------------------
#
# The id of an observation may be the name of a robot. Then both are corrected, and all that is correlated with them.
report = scan("alpha", [0.0, 0.0, 0.0], [[6.0, 0.0]], ["beta"])
print("seen by alpha:   ", sigmas("beta"), "at", slam.mean("beta").round(2))
print("joint covariance of both robots and the post:", slam.covariance("alpha", "beta", "post").shape)
figure.legend(loc="outside right upper")
km.draw(slam, ax, report=report, labels=True)
ax.set(xlim=(-1, 12), ylim=(-6, 7))
plt.show()

# %%
# In a log
# --------
#
# The column ``robot`` of each table names it; ``robots: {alpha: ..., beta: ...}`` in the configuration has the models
# of each, ``robots: {each: ...}`` those of all. ``kalmark simulate two_robots --out log`` makes such a log.

# %%
# Try changing
# ------------
#
# A second landmark, in both scans: ``[[3.0, 1.0], [4.0, -1.0]]`` with ``["post", "tree"]``. Two points determine a
# pose: the sigmas of ``beta`` fall to 0.048 m, 0.112 m and 0.041 rad before the robots see each other.
