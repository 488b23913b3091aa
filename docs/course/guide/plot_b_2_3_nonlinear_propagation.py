r"""
[S] B.2.3: nonlinear propagation
================================

Of a nonlinear function the filter takes the first-order Taylor expansion at the mean, [S] (74) to (77):

.. math::

   y = f(x), \qquad \bar y \approx f(\bar x), \qquad Y \approx F_x P F_x^\top

It is good where :math:`f` is nearly linear within the ellipse of :math:`P`.
"""

# %%
# From polar to Cartesian
# -----------------------
#
# A point is 5 m away. Its range is known to 0.1 m, its bearing to 2, 15 or 45 degrees. ``propagate`` gives the red
# ellipse of [S] (76) and (77); ``expectation`` integrates the true mean and covariance, the black one.
import matplotlib.pyplot as plt
import numpy as np

import kalmark as km

rng = np.random.default_rng(0)
mean = np.array([5.0, 0.0])


def place(x):
    return km.geometry.inv_scan(x)[0]


figure, axes = plt.subplots(1, 3, figsize=(10, 4.4), layout="tight", sharex=True, sharey=True)
for ax, degrees in zip(axes, (2, 15, 45), strict=True):
    P = np.diag([0.1, np.radians(degrees)]) ** 2
    y, Y = km.geometry.propagate(km.geometry.inv_scan, mean, P)
    true = km.geometry.expectation(place, mean, P)
    cov = km.geometry.expectation(lambda x, m=true: np.outer(d := place(x) - m, d), mean, P)
    draws, _ = km.geometry.inv_scan(rng.multivariate_normal(mean, P, size=1000))
    ax.plot(*draws.T, ".", ms=3, alpha=0.3)
    for centre, C, style in ((true, cov, "k"), (y, Y, "C3")):
        ax.plot(*km.geometry.ellipse(centre, C, sigmas=2, points=60).T, style)
        ax.plot(*centre, style, marker="+", ms=12)
    ax.set(title=f"bearing ± {degrees}°", aspect="equal", xlabel="x [m]")
    print(f"{degrees:2d} degrees: mean of x {y[0]:.3f} m, in truth {true[0]:.3f} m")
axes[0].set_ylabel("y [m]")
plt.show()

# %%
# The pictures
# ------------
#
# At 2 degrees both ellipses are one. At 45 degrees the first-order mean lies on the arc, the true mean behind it, and
# the first-order ellipse claims a range that is known to 0.1 m on a straight line: it is overconfident. Such errors are
# one reason for the inconsistency of EKF-SLAM.

# %%
# Try changing
# ------------
#
# * The distance: ``np.array([50.0, 0.0])``. The mean of x is wrong by ten times as much, 13.3 m at 45 degrees: the
#   error is a fixed part of the distance.
# * The mean: ``np.array([5.0, 0.8])``. All turns by 0.8 rad; nothing else changes.
