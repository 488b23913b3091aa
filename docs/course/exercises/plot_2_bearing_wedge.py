r"""
[T] 2: one bearing, a wedge
===========================

One bearing does not determine where a landmark is. With the noise :math:`\sigma` of the bearing :math:`\phi`, the
density of the place is constant along each ray from the sensor:

.. math::

   p(x, y) \propto \exp\left( -\frac{(\operatorname{atan2}(y, x) - \phi)^2}{2 \sigma^2} \right)

It has no mean and no covariance: its integral is infinite, so no Gaussian stands for it. Two bearings from different
places have a density that can be approximated by one.
"""

# %%
# One wedge, and two
# ------------------
#
# The density is scaled to 1 at its largest, with the values of [T]'s figure 1: :math:`\phi = \pi/3`, :math:`\sigma^2 =
# 0.01`. On the right, it is multiplied by that of a second bearing. Triangles are the sensors. The ellipse of 2 sigma
# is that of the intersection, propagated by its Jacobians.
import matplotlib.pyplot as plt
import numpy as np

import kalmark as km

phi, sigma, second = np.pi / 3, 0.1, np.array([4.0, 0.0, 2 * np.pi / 3])
x, y = np.meshgrid(np.linspace(-3, 8, 300), np.linspace(-1, 12, 300))


def density(ray):
    """Return the scaled density of the landmark on the grid, of a bearing along a ray (3,)."""
    z = km.geometry.wrap(np.arctan2(y - ray[1], x - ray[0]) - ray[2])
    return np.exp(-(z**2) / (2 * sigma**2))


first = np.array([0.0, 0.0, phi])
p, P_a, P_b = km.geometry.intersection(first, second)
turned = np.stack([P_a[:, 2], P_b[:, 2]], axis=1)
C = sigma**2 * turned @ turned.T
figure, axes = plt.subplots(1, 2, figsize=(10, 5), layout="constrained", sharey=True)
for ax, shown in zip(axes, (density(first), density(first) * density(second)), strict=True):
    image = ax.pcolormesh(x, y, shown, vmin=0, vmax=1, rasterized=True)
    ax.plot(0, 0, "w^")
    ax.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
axes[1].plot(*second[:2], "w^")
axes[1].plot(*km.geometry.ellipse(p, C, sigmas=2, points=60).T, "r")
figure.colorbar(image, ax=axes, label="scaled density")
print("intersection", p.round(2), "sigmas", np.sqrt(np.linalg.eigvalsh(C)).round(2), "m")
plt.show()

# %%
# Try changing
# ------------
#
# * A better sensor: ``phi, sigma, second = np.pi / 3, 0.02, ...``. The sigmas of the intersection fall from 0.33 m and
#   0.57 m to 0.07 m and 0.11 m.
# * A second pose that is near: ``second = np.array([0.5, 0.0, np.pi / 3 + 0.12])``. The long sigma is 4.4 m, at a
#   distance of 3.8 m: the ellipse reaches behind the sensor, and the density is not like it. A start must wait for
#   more parallax.
