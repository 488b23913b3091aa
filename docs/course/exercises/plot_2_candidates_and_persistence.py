r"""
[T] 2: candidates, the merged estimate, persistence
===================================================

Bearings from several poses intersect where landmarks may be. Each intersection is a candidate: a Gaussian, in which the
uncertain poses and the noise of the bearings are compounded. Candidates that are near to each other, by the distance of
Bhattacharyya, are merged, and the *persistence* of the merged one is counted. A landmark is started at some count; an
intersection of bearings of two different landmarks is not seen again.
"""

# %%
# Four poses, two landmarks, unknown ids
# --------------------------------------
#
# From each pose both landmarks are seen by bearing only. Every bearing is intersected with all of the pose before.
from itertools import pairwise, product

import matplotlib.pyplot as plt
import numpy as np

import kalmark as km

rng, sigma, landmarks = np.random.default_rng(1), 0.02, np.array([[4.0, 3.0], [7.0, 4.0]])
poses, candidates, found = np.outer(range(4), [1.5, 0.0, 0.0]), [], []
ray_cov = np.diag([0.03, 0.03, np.hypot(0.01, sigma)]) ** 2  # pose and bearing, compounded
bearings = [km.geometry.observe(r, landmarks)[0][:, 1] + sigma * rng.normal(size=2) for r in poses]
rays = [[np.array([*r[:2], b]) for b in bs] for r, bs in zip(poses, bearings, strict=True)]
for a, b in [pair for before, now in pairwise(rays) for pair in product(before, now)]:
    p, P_a, P_b = km.geometry.intersection(a, b)
    C = P_a @ ray_cov @ P_a.T + P_b @ ray_cov @ P_b.T
    found += [(p, C)] if np.isfinite(p).all() else []  # if the rays meet
for p, C in found:
    near = [c for c in candidates if km.geometry.bhattacharyya(c[0], c[1], p, C) < 1.0]
    if near:
        near[0][:] = [*km.geometry.merge(near[0][0], near[0][1], p, C), near[0][2] + 1]
    else:
        candidates.append([p, C, 1])

# %%
# Intersections of the bearings of two poses
# ------------------------------------------
#
# Figure 2: the candidates after two poses, where three of the four pairs of bearings meet. One pair is of the same
# landmark. Ellipses are of 2 sigma.


def draw(some, poses=poses):
    ax = plt.figure(layout="constrained").add_subplot(aspect="equal", xlim=(-1, 12), ylim=(-1, 8))
    for p, C, *persistence in some:
        ax.plot(*km.geometry.ellipse(p, C, 2, 40).T, color="tab:blue" if persistence else "tab:red", lw=1)
        ax.text(*(p - [0, 0.7]), *map(str, persistence or [""]))
    ax.plot(*landmarks.T, "k+", *poses[:, :2].T, "b^", ms=10)
    ax.set(xlabel="x [m]", ylabel="y [m]")


draw(found[:3], poses[:2])

# %%
# Two estimates are merged
# ------------------------
#
# Figure 3: candidates near to each other (red), and the merged one (blue) with its persistence.
best = max(candidates, key=lambda c: c[2])
draw([*((p, C) for p, C in found if km.geometry.bhattacharyya(best[0], best[1], p, C) < 1.0), best])

# %%
# Persistence
# -----------
#
# Figure 4: all candidates after four poses, with their persistence.
draw(candidates)
plt.show()

# %%
# Try changing
# ------------
#
# * A smaller distance: ``km.geometry.bhattacharyya(...) < 0.1``. Nothing is merged. With 3.0, the intersection of two
#   different landmarks at (2.9, 1.7) takes one of the first landmark's, and has a persistence of 2: the count must be
#   higher.
# * A better sensor: ``sigma`` = 0.005. Both landmarks reach the persistence 3, with sigmas below 0.2 m.
# * ``km.Mount(km.sensors.Bearing(), initialization=km.Delayed())`` starts the landmarks of kalmark so.
