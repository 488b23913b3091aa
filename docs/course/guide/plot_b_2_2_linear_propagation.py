r"""
[S] B.2.2: linear propagation
=============================

A linear function of a Gaussian is a Gaussian, with [S] (71) to (73):

.. math::

   y = F x, \qquad \bar y = F \bar x, \qquad Y = F P F^\top

This is exact for every :math:`P`, however large. The prediction and the correction of a Kalman filter consist of it.
"""

# %%
# Three matrices
# --------------
#
# ``propagate`` takes a function that returns its value and its Jacobian: of a linear one the matrix itself. The
# points are 1000 draws, moved one by one with the same matrix.
import matplotlib.pyplot as plt
import numpy as np

import kalmark as km

rng = np.random.default_rng(0)
mean, P = np.array([2.0, 1.0]), np.array([[0.8, 0.3], [0.3, 0.3]])
draws = rng.multivariate_normal(mean, P, size=1000)
matrices = {
    "before": np.eye(2),
    "rotation by 90°": km.geometry.rotation(np.pi / 2),
    "shear": np.array([[1.0, 1.0], [0.0, 1.0]]),
    "projection": np.array([[0.8, 0.4], [0.4, 0.2]]),
}
figure, axes = plt.subplots(1, 4, figsize=(12, 2.8), layout="tight", sharex=True, sharey=True)
for ax, (name, F) in zip(axes, matrices.items(), strict=True):
    y, Y = km.geometry.propagate(lambda x, F=F: (F @ x, F), mean, P)
    moved = draws @ F.T
    print(f"{name}: difference from the draws {np.abs(np.cov(moved.T) - Y).max():.3f}")
    ax.plot(*moved.T, ".", ms=3, alpha=0.3)
    for sigmas in (1, 2, 3):
        ax.plot(*km.geometry.ellipse(y, Y, sigmas, points=60).T, "C3", lw=1)
    ax.plot(*y, "k+", ms=10)
    ax.set(title=name, aspect="equal", xlabel="y₁")
axes[0].set_ylabel("y₂")
plt.show()

# %%
# The pictures
# ------------
#
# Blue are the draws, red the ellipses of 1, 2 and 3 sigma of :math:`Y`. The rotation keeps the semi-axes, the shear
# mixes the two numbers, and the projection makes the ellipse a line: then :math:`Y` has no inverse, although :math:`P`
# has one.

# %%
# Try changing
# ------------
#
# * P: ``np.array([[80.0, 30.0], [30.0, 30.0]])``. The ellipses are ten times larger and have the same forms: a linear
#   function is exact at any size.
# * The projection: ``[0.4, 0.2]`` to ``[0.4, 0.3]``. The line opens to an ellipse, since the matrix has an inverse.
