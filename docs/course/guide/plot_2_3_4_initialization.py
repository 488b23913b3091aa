r"""
[S] 2.3.4: a new landmark
=========================

The inverse observation model places a new landmark, [S] (31) and (32). Its Jacobians, [S] (33) and (34), give its
covariance and its cross-covariance with all that is in the map, [S] (35) and (36):

.. math::

   P_{LL} = G_R P_{RR} G_R^\top + G_y R\, G_y^\top, \qquad P_{Lx} = G_R P_{Rx}

They are appended to :math:`x` and :math:`P`, [S] (37) and (38); nothing that was there changes.
"""

# %%
# One more landmark
# -----------------
#
# The two terms of (35): what the pose leaves uncertain, and what the measurement leaves uncertain.
import matplotlib.pyplot as plt
import numpy as np

import kalmark as km
from kalmark.filter.textbook import TextbookSlam

R = np.diag([0.1, 0.02]) ** 2
slam = TextbookSlam(start=[0, 0, 0.3], P=np.diag([0.1, 0.05, 0.05]) ** 2, Q=np.eye(2), R=R)
slam.initialize([3.0, 0.6])
slam.initialize([4.0, -0.3])
y, P = [5.0, 0.2], slam.P.copy()
l, G_R, G_y = km.geometry.inv_observe(slam.x[:3], y)
terms = {"pose": G_R @ P[:3, :3] @ G_R.T, "measurement": G_y @ R @ G_y.T}
slam.initialize(y)
terms["both, (35)"] = slam.P[7:, 7:]
for name, cov in terms.items():
    (a, b), angle = km.geometry.ellipse_axes(cov)
    print(f"{name}: semi-axes {a:.3f} m and {b:.3f} m at {np.degrees(angle):.0f} degrees")

# %%
# Figure 5
# --------
#
# Left: dark is the landmark's own part, pale its cross-covariances, white is kept. Right: the ellipses of both terms
# and of their sum, at three sigmas.
new = np.arange(9) >= 7
figure, axes = plt.subplots(1, 3, figsize=(10, 3.8), layout="tight", width_ratios=[1, 9, 9])
axes[0].imshow(2 * new[:, None], cmap="Greys", vmax=3)
axes[1].imshow(new[:, None].astype(int) + new[None, :], cmap="Greys", vmax=3)
labels = ["x", "y", "θ", "l₁", "", "l₂", "", "l₃", ""]
axes[0].set(title="x", xticks=[], yticks=range(9), yticklabels=labels)
axes[1].set(title="P", xticks=range(9), xticklabels=labels, yticks=range(9), yticklabels=labels)
for name, cov in terms.items():
    axes[2].plot(*km.geometry.ellipse(l, cov, sigmas=3, points=60).T, label=name)
axes[2].set(aspect="equal", xlabel="x [m]", ylabel="y [m]")
axes[2].legend(loc="upper left", bbox_to_anchor=(1, 1))
plt.show()

# %%
# Try changing
# ------------
#
# * The pose: ``P=np.zeros((3, 3))``. The first term is zero, and the new landmark is independent of all others.
# * The heading: ``np.diag([0.1, 0.05, 0.3])``. The ellipse of the pose is nearly six times as long, across the line
#   of sight: an error of the heading moves a landmark the more, the farther it is.
