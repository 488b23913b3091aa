r"""
[S] A.3: motion of a body in the plane
======================================

A robot with the pose :math:`\mathcal R = (t, \theta)` is given increments in its own frame, [S] (57) and (58). The
new position is a *from frame* transformation, and the angles are added, [S] (59) and (60):

.. math::

   t \leftarrow R\, \delta t + t, \qquad \theta \leftarrow \theta + \delta\theta

The program of the guide has :math:`\delta y = 0`: its control is a step forward and a turn, with noise on both.
"""

# %%
# The same control, sixty times
# -----------------------------
#
# ``move(r, u, n)`` adds the noise :math:`n` to the control. Each of 200 robots has its own noise. The filter predicts
# one Gaussian for all of them, [S] (9) and (10).
import matplotlib.pyplot as plt
import numpy as np

import kalmark as km
from kalmark.filter.textbook import TextbookSlam

rng = np.random.default_rng(0)
u, sigmas = np.array([0.1, 0.03]), np.array([0.02, 0.05])
slam = TextbookSlam(start=[0, 0, 0], Q=np.diag(sigmas) ** 2, R=np.eye(2))
robots = np.zeros((200, 3))
figure, ax = plt.subplots(figsize=(6, 4.8), layout="constrained")
path = [slam.x.copy()]
for step in range(1, 61):
    robots = np.array([km.geometry.move(r, u, sigmas * rng.normal(size=2))[0] for r in robots])
    slam.predict(u)
    path.append(slam.x.copy())
    if step % 20 == 0:
        ax.plot(*robots[:, :2].T, f"C{step // 20}.", alpha=0.4, label=f"after {step} steps")
        ax.plot(*km.geometry.ellipse(slam.x[:2], slam.P[:2, :2], sigmas=2, points=60).T, "k")
# sphinx_gallery_defer_figures

# %%
# Where they are
# --------------
#
# The black ellipses have two sigmas. While the heading is well known they fit; later the true cloud bends around the
# start like a banana, and no ellipse can do that. Only measurements keep the heading well known.
ax.plot(*np.array(path)[:, :2].T, "k--", lw=1, label="without noise")
ax.set(aspect="equal", xlabel="x [m]", ylabel="y [m]")
figure.legend(loc="outside right center")
inside = [km.geometry.mahalanobis(r[:2], slam.x[:2], slam.P[:2, :2]) < 2 for r in robots]
print(f"inside two sigmas at the end: {np.mean(inside):.0%}; of a Gaussian: 86%")
plt.show()

# %%
# Try changing
# ------------
#
# * The noise of the turn: ``np.array([0.02, 0.1])``. The last cloud is bent so much that 61 % of the robots are
#   inside its ellipse, not 86 %.
# * The noise of the step: ``np.array([0.1, 0.005])``. The clouds are nearly Gaussian, and 90 % of the robots are
#   inside.
# * The turn: ``np.array([0.1, 0.105])`` in place of ``np.array([0.1, 0.03])``. The path is a full circle. An error of
#   the heading on one side is partly undone on the other: the last ellipse is 2 m long, not 5 m.
