r"""
[S] 2.3.5: partial measurements and linearity
=============================================

A camera measures no distance. The inverse observation model then has a prior :math:`s` with covariance :math:`S` for
it, [S] (39) to (45), which adds a third term to the covariance of the landmark, [S] (44):

.. math::

   P_{LL} = G_R P_{RR} G_R^\top + G_y R\, G_y^\top + G_s S\, G_s^\top

The prior of a distance is wide, and the filter is good only where functions are nearly linear within the region in
which the probability is concentrated. The guide's Figure 6 shows that as a question of the function *and* of the
region.
"""

# %%
# Figure 6, with the example of a camera
# --------------------------------------
#
# A camera has moved 1 m to the side; :math:`\arctan(1 / d)` is the parallax of a landmark that was straight ahead at
# the distance :math:`d`. First a linear function, then the parallax with a narrow and a wide prior.
import matplotlib.pyplot as plt
import numpy as np

import kalmark as km


def line(d):
    return 0.6 - 0.1 * d, np.full((1, 1), -0.1)


def parallax(d):
    return np.arctan(1 / d), np.array([[-1 / (1 + d[0] ** 2)]])


figure, axes = plt.subplots(1, 3, figsize=(10, 4), layout="constrained", sharey=True)
mean, d, rng = 2.0, np.linspace(0.05, 5, 200), np.random.default_rng(0)
for ax, (f, sigma) in zip(axes, ((line, 0.7), (parallax, 0.2), (parallax, 0.7)), strict=True):
    y, Y = km.geometry.propagate(f, [mean], [[sigma**2]])
    draws = np.array([f(one)[0] for one in rng.normal(mean, sigma, (5000, 1))])
    values = np.linspace(0, 1.2, 200)
    ax.plot(d, f(d[None])[0][0], "k")
    ax.plot(d, y + f(np.array([mean]))[1][0] * (d - mean), "C3--", lw=1)
    ax.axvspan(mean - 2 * sigma, mean + 2 * sigma, color="C0", alpha=0.15)
    other = ax.twiny()
    other.hist(draws, values[::4], orientation="horizontal", density=True, alpha=0.4)
    other.plot(km.geometry.density(values[:, None], y, Y), values, "C3")
    ax.set(title=f"{f.__name__}, sigma {sigma} m", xlabel="d [m]", xlim=(0, 5), ylim=(0, 1.2))
    other.set_xticks([])
    print(f"{f.__name__} {sigma}: mean {draws.mean():.3f}, first-order {y[0]:.3f}")
axes[0].set_ylabel("f(d) [rad]")
plt.show()

# %%
# The pictures
# ------------
#
# Blue is what the function makes of the prior (the band is two sigmas), red what the filter takes for it: the same
# line, nearly the same, and something else. The red curve is Gaussian; the true one is not.

# %%
# Try changing
# ------------
#
# * The narrow prior: ``(parallax, 0.2)`` to ``(parallax, 0.05)``. Function and tangent are one within the band.
# * The mean: ``mean, d, rng = 4.0, ...``. Farther away the function is flatter: with the same 0.7 m the first-order
#   mean is wrong by 0.007 rad, at 2 m by 0.033. Linearity depends on sigma relative to the distance.
