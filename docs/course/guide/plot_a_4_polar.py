r"""
[S] A.4, A.5: range and bearing
===============================

The polar coordinates of a point and their inverse are [S] (61) and (62). With a frame transformation before or after,
they are the two observation models of the course, [S] (63) and (64):

.. math::

   y = \operatorname{polar}(\operatorname{toFrame}(\mathcal F, p)), \qquad
   p = \operatorname{fromFrame}(\mathcal F, \operatorname{rectangular}(y))

Equation (64) is printed with the superscript :math:`\mathcal R` on the polar point, which has to be :math:`\mathcal F`.
"""

# %%
# There and back
# --------------
import matplotlib.pyplot as plt
import numpy as np

import kalmark as km

rng = np.random.default_rng(0)
r, p = np.array([1.0, 0.5, np.radians(40)]), np.array([3.0, 4.0])
y, Y_r, Y_p = km.geometry.observe(r, p)  # (63)
back, P_r, P_y = km.geometry.inv_observe(r, y)  # (64)
print(f"range {y[0]:.3f} m, bearing {np.degrees(y[1]):.1f} degrees; back at {back.round(3)}")
print("the Jacobians are inverse:", (P_y @ Y_p).round(12) + 0.0, sep="\n")

# %%
# Three sensors of Table 2
# ------------------------
#
# A laser measures both numbers well, a sonar the bearing poorly, a camera no range. Measurements with their noise are
# drawn as points of the plane. The ellipses are :math:`P_y\, \operatorname{diag}(\sigma^2)\, P_y^\top` at two sigmas.
sensors = {"laser": (0.05, 0.01), "sonar": (0.05, 0.25), "camera": (1.5, 0.01)}
figure, axes = plt.subplots(1, 3, figsize=(10, 4.4), layout="constrained", sharex=True, sharey=True)
for ax, (name, sigmas) in zip(axes, sensors.items(), strict=True):
    draws, _, _ = km.geometry.inv_observe(r, y + sigmas * rng.normal(size=(500, 2)))
    ax.plot(*draws.T, ".", ms=3, alpha=0.4)
    P = P_y @ np.diag(sigmas) ** 2 @ P_y.T
    ax.plot(*km.geometry.ellipse(p, P, sigmas=2, points=60).T, "C3")
    ax.plot(*np.array([r[:2], p]).T, "k:")
    ax.plot(*r[:2], "k", marker=(3, 0, np.degrees(r[2]) - 90), ms=14)
    ax.set(title=name, aspect="equal", xlabel="x [m]", xlim=(0, 6), ylim=(0, 7))
axes[0].set_ylabel("y [m]")
plt.show()

# %%
# Try changing
# ------------
#
# * The bearing of the sonar: ``(0.05, 0.25)`` to ``(0.05, 0.8)``. The cloud is an arc, and the ellipse leaves it.
# * The range of the camera: ``(1.5, 0.01)`` to ``(4.0, 0.01)``. A seventh of the cloud is behind the camera, where
#   the range is negative: a distance that is not measured is no Gaussian. [S] 2.3.6 has its inverse in the state.
