r"""
[S] 2.3.2: the robot moves
==========================

Only the robot moves, so the Jacobian of the motion is the identity for all landmarks, [S] (11) to (13). The rest
of the prediction [S] (9) and (10) are the sparse equations [S] (14) to (17):

.. math::

   P_{RR} \leftarrow F_R P_{RR} F_R^\top + F_n N F_n^\top, \qquad P_{RM} \leftarrow F_R P_{RM}, \qquad
   P_{MR} \leftarrow P_{RM}^\top

They cost :math:`O(n)`, because :math:`P_{MM}` is not touched.
"""

# %%
# Dense and sparse
# ----------------
#
# ``predict`` multiplies the full matrices of (10). The four lines below are (14) to (17).
import matplotlib.pyplot as plt
import numpy as np

import kalmark as km
from kalmark.filter.textbook import TextbookSlam

Q, R, u = np.diag([0.2, 0.1]) ** 2, np.diag([0.1, 0.02]) ** 2, [1.0, 0.3]
slam = TextbookSlam(start=[0, 0, 0.5], P=np.diag([0.1, 0.1, 0.05]) ** 2, Q=Q, R=R)
for y in ([3.0, 0.6], [4.0, -0.3], [2.5, -1.0]):
    slam.initialize(y)
x, P = slam.x.copy(), slam.P.copy()
r, F_R, F_n = km.geometry.move(x[:3], u, [0, 0])  # (14)
sparse = P.copy()
sparse[:3, 3:] = F_R @ P[:3, 3:]  # (16)
sparse[3:, :3] = sparse[:3, 3:].T  # (17)
sparse[:3, :3] = F_R @ P[:3, :3] @ F_R.T + F_n @ Q @ F_n.T  # (15)
slam.predict(u)
print("difference of (14)-(17) from (10):", np.abs(sparse - slam.P).max())

# %%
# Figure 3
# --------
#
# Left, as in the guide: the bar is :math:`x`, the square is :math:`P`. Dark is the robot's own part, pale its
# cross-covariances, white is not touched. Right: the change of each element as computed. The cross-covariances of
# :math:`\theta` do not change, because the third row of :math:`F_R` is (0, 0, 1).
robot = np.arange(9) < 3
touched = robot[:, None].astype(int) + robot[None, :]
figure, axes = plt.subplots(1, 3, figsize=(9, 4), layout="constrained", width_ratios=[1, 9, 9])
axes[0].imshow(2 * robot[:, None], cmap="Greys", vmax=3)
axes[1].imshow(touched, cmap="Greys", vmax=3)
axes[2].imshow(np.sqrt(np.abs(slam.P - P)), cmap="Greys")
labels = ["x", "y", "θ", "l₁", "", "l₂", "", "l₃", ""]
for ax, title in zip(axes, ("x", "P: touched", "P: size of the change"), strict=True):
    ax.set(title=title, yticks=range(9), yticklabels=labels)
    ax.set_xticks([] if title == "x" else range(9), [] if title == "x" else labels)
plt.show()

# %%
# Try changing
# ------------
#
# * The control: ``[0.0, 0.3]``, a turn on the spot. :math:`F_R` is the identity, so only :math:`P_{RR}` changes, by
#   the noise alone.
# * The noise: ``np.diag([0.2, 0.1]) ** 2`` to ``np.zeros((2, 2))``. P still changes: the uncertain heading makes the
#   new position uncertain.
