r"""
[S] 2.3.3: a mapped landmark is observed
========================================

A measurement depends on the robot and on one landmark only, so its Jacobian has two blocks that are not zero, [S]
(24), (25). The innovation needs only their part of :math:`P`, [S] (26) and (27); the gain, [S] (28), reaches every
state, and so does the correction, [S] (29) and (30):

.. math::

   Z = \begin{bmatrix} H_R & H_L \end{bmatrix}
   \begin{bmatrix} P_{RR} & P_{RL} \\ P_{LR} & P_{LL} \end{bmatrix}
   \begin{bmatrix} H_R^\top \\ H_L^\top \end{bmatrix} + R, \qquad
   K = \begin{bmatrix} P_{RR} & P_{RL} \\ P_{MR} & P_{ML} \end{bmatrix}
   \begin{bmatrix} H_R^\top \\ H_L^\top \end{bmatrix} Z^{-1}
"""

# %%
# The first of three landmarks is seen again
# -------------------------------------------
#
# The robot has seen it before it drove, the other two after it. ``rl`` are the states of the robot and of the first
# landmark.
import matplotlib.pyplot as plt
import numpy as np

from kalmark.filter.textbook import TextbookSlam

Q, R = np.diag([0.2, 0.1]) ** 2, np.diag([0.1, 0.02]) ** 2
slam = TextbookSlam(start=[0, 0, 0.5], Q=Q, R=R)
slam.initialize([3.0, 0.6])
slam.predict([1.0, 0.3])
slam.initialize([3.0, -0.3])
slam.initialize([2.5, -1.0])
i, P = 0, slam.P.copy()
rl = [0, 1, 2, 3 + 2 * i, 4 + 2 * i]
e, H = slam.expect(i)
Z = H[:, rl] @ P[np.ix_(rl, rl)] @ H[:, rl].T + R  # (27)
K = P[:, rl] @ H[:, rl].T @ np.linalg.inv(Z)  # (28)
slam.correct(i, e + np.array([0.1, 0.02]))
print("difference of (27)-(30) from (20)-(23):", np.abs(P - K @ Z @ K.T - slam.P).max())
print("sigmas before:", np.sqrt(np.diag(P)).round(3))
print("sigmas after: ", np.sqrt(np.diag(slam.P)).round(3))

# %%
# Figure 4
# --------
#
# The gain has no zero row, so that all of P changes. The computation of the innovation reads only the gray part of
# the last picture. Landmarks that were not seen become better known, too: their errors are correlated with the
# robot's.
used = np.isin(np.arange(9), rl)
robot = np.arange(9) < 3
read = np.outer(used, used) * np.where(robot[:, None] == robot, 2, 1)
pictures = {"K": np.abs(K / K.max(axis=0)), "P: size of the change": np.abs(slam.P - P)}
pictures["P: read for Z"] = read**2
figure, axes = plt.subplots(1, 3, figsize=(9, 4), layout="constrained", width_ratios=[2, 9, 9])
labels = ["x", "y", "θ", "l₁", "", "l₂", "", "l₃", ""]
for ax, (title, picture) in zip(axes, pictures.items(), strict=True):
    ax.imshow(np.sqrt(picture), cmap="Greys", vmin=0, vmax=1.4 * np.sqrt(picture.max()))
    ax.set(title=title, yticks=range(9), yticklabels=labels)
    ax.set_xticks(range(len(picture.T)), ["r", "b"] if title == "K" else labels)
plt.show()

# %%
# Try changing
# ------------
#
# * The landmark: ``i, P = 1, slam.P.copy()``. The second landmark was started from this very pose, so its measurement
#   has no information about the robot: only the landmark's own rows of K and P are not zero.
# * The motion: remove ``slam.predict([1.0, 0.3])``. The robot is known exactly and no landmark is correlated with
#   another: again only the landmark's own part changes.
