r"""
[S] 2: the state and its covariance
===================================

The map is one Gaussian of the robot and all landmarks, [S] (5) and (6):

.. math::

   x = \begin{bmatrix} \mathcal{R} \\ \mathcal{M} \end{bmatrix}, \qquad
   P = \begin{bmatrix} P_{RR} & P_{RM} \\ P_{MR} & P_{MM} \end{bmatrix}

A control changes the robot's rows and columns only, [S] (9) and (10). An observation of one landmark may change all of
:math:`P`, [S] (22) and (23).
"""

# %%
# One robot, three landmarks
# --------------------------
#
# ``TextbookSlam`` is the filter as the guide prints it. The robot sees three landmarks; each is added to the map.
import matplotlib.pyplot as plt
import numpy as np

from kalmark.filter.textbook import TextbookSlam

Q, R = np.diag([0.2, 0.1]) ** 2, np.diag([0.1, 0.02]) ** 2
slam = TextbookSlam(start=[0, 0, 0], P=np.diag([0.1, 0.1, 0.05]) ** 2, Q=Q, R=R)
for y in ([3.0, 0.6], [4.0, -0.3], [2.5, -1.0]):
    slam.initialize(y)
before = slam.P.copy()

# %%
# One control, one observation
# ----------------------------
#
# The robot drives 1 m and turns by 0.3 rad. Then it sees the first landmark 5 cm farther away than expected.
slam.predict([1.0, 0.3])
moved = slam.P.copy()
e, _ = slam.expect(0)
slam.correct(0, e + np.array([0.05, 0.0]))
corrected = slam.P.copy()

# %%
# P as a picture
# --------------
#
# The square root of each element's size; dark is zero. The landmarks are correlated, since one uncertain pose saw them
# all. The control changes only the first three rows and columns; the observation of one landmark makes the variances of
# the robot and of that landmark smaller. Those of the other two stay as they are here: what the observation corrects
# is the error of the last motion, which their variances do not have.
figure, axes = plt.subplots(1, 3, figsize=(10, 3.6), layout="constrained", sharey=True)
labels = ["x", "y", "θ", "l₁", "", "l₂", "", "l₃", ""]
titles = ["before", "after the control", "after l₁ is seen"]
for ax, P, title in zip(axes, (before, moved, corrected), titles, strict=True):
    ax.imshow(np.sqrt(np.abs(P)), cmap="viridis", vmin=0, vmax=np.sqrt(moved.max()))
    ax.set_title(title)
    ax.set_xticks(range(9), labels)
    ax.set_yticks(range(9), labels)
    sigmas = np.sqrt(np.diag(P)).round(3)
    print(f"{title}: sigmas of the robot {sigmas[:3]}, of l₃ {sigmas[7:]}")
plt.show()

# %%
# Try changing
# ------------
#
# * The noise of the turn: ``Q = np.diag([0.2, 0.3]) ** 2``. After the control the sigma of the heading is 0.304 rad in
#   place of 0.112; those of the position stay.
# * The landmark that is seen: ``slam.expect(2)`` and ``slam.correct(2, ...)``. The third landmark becomes more certain
#   (0.160 and 0.150 m to 0.158 and 0.137 m) in place of the first.
