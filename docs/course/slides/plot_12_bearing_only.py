r"""
[F] Bearing only: a prior that should be infinite
=================================================

A bearing places a landmark on a line. A prior of the distance makes a start possible, and then all is as with a full
observation. But the true prior has an infinite covariance, and the linearization may fail, since it must hold in the
whole region of the prior. The start has the prior :math:`s \sim N(\bar s, \sigma_s^2)` as a part of its noise:

.. math::

   \begin{bmatrix} u \\ v \end{bmatrix} = \begin{bmatrix} x + (\bar s + \sigma) \cos(\phi + \zeta + \theta) \\
   y + (\bar s + \sigma) \sin(\phi + \zeta + \theta) \end{bmatrix}
"""

# %%
# Three priors of the distance
# ----------------------------
#
# The landmark is 6 m ahead of the start. The robot drives past it to the side, and its pose is known. Each bearing has
# a noise of 1 degree. ``augment`` starts the landmark with the prior, ``correct`` takes the bearings.
import matplotlib.pyplot as plt
import numpy as np

import kalmark as km

landmark, sigma = np.array([6.0, 0.0]), np.radians(1)


def h(x, n, bearing, distance):
    return km.geometry.inv_scan(np.array([distance + n[1], bearing + n[0]]))[0]


def g(x, n, place):
    return km.geometry.observe(place, x[3:])[0][1:] + n


known = {"x": np.zeros(3), "Sigma": np.zeros((3, 3)), "Sigma_n": [[0]], "angles_y": [0]}
known["Sigma_m"] = [[sigma**2]]
rng = np.random.default_rng(0)
figure, axes = plt.subplots(1, 3, figsize=(11, 4), sharex=True, sharey=True)
axes[0].set(xlim=(-5, 30), ylim=(-6, 6), ylabel="y [m]")
priors = {"6 m ± 1 m": (6, 1), "6 m ± 4 m": (6, 4), "20 m ± 20 m": (20, 20)}
for ax, (name, (distance, spread)) in zip(axes, priors.items(), strict=True):
    near = []
    for _ in range(50):
        ekf = km.textbook.ExtendedKalmanFilter(None, g, **known)
        ekf.augment(h, np.diag([sigma, spread]) ** 2, sigma * rng.normal(), distance)
        first = km.geometry.ellipse(ekf.x[3:], ekf.Sigma[3:, 3:], 2, 60)
        for y in 0.5 * np.arange(1, 7):
            place = np.array([0.0, y, 0.0])
            ekf.correct(g(landmark, sigma * rng.normal(size=1), place), place)
        near.append(km.geometry.mahalanobis(landmark, ekf.x[3:], ekf.Sigma[3:, 3:]) < 3)
        ax.plot(*ekf.x[3:], "C0.", ms=3)
    last = km.geometry.ellipse(ekf.x[3:], ekf.Sigma[3:, 3:], 2, 60)
    ax.plot(*first.T, "C1", *last.T, "C0")
    ax.plot(*landmark, "k+", ms=12)
    ax.set(title=f"{name}: {np.mean(near):.0%} within 3σ", xlabel="x [m]")
plt.show()

# %%
# The pictures
# ------------
#
# Orange is the ellipse of the start, at 2 sigma, blue the fifty estimates after six bearings; the title has the share
# that is within 3 sigma of the truth. The narrower the prior, the better the filter; the wide one, which is nearer to
# what is known, fails. The inverse of the distance mends that: :doc:`/lessons/guide/plot_2_3_6_inverse_distance`.

# %%
# Try changing
# ------------
#
# * A better sensor: ``np.radians(0.1)``. With the wide prior no run is within 3 sigma, in place of 20 %: the smaller
#   the noise, the larger the error of the linearization is in sigmas.
# * Another distance: ``np.array([12.0, 0.0])``. The narrow prior is wrong now: 0 %, 54 % and 64 %.
# * More bearings, nearer to each other: ``0.1 * np.arange(1, 31)``. The wide prior is right in 70 % of the runs, since
#   each correction changes the estimate by less.
