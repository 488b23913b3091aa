r"""
[F] Range and bearing, and the misprints
========================================

Three formulas of the slides cannot be programmed as they are printed. With the robot at :math:`(x, y, \theta)` and the
landmark at :math:`(u, v)` the right ones are, [S] (61)-(64):

.. math::

   \begin{bmatrix} d \\ \phi \end{bmatrix} &= \begin{bmatrix} \sqrt{(u - x)^2 + (v - y)^2} \\
   \operatorname{atan2}(v - y, u - x) - \theta \end{bmatrix} &
   \begin{bmatrix} u \\ v \end{bmatrix} &= \begin{bmatrix} x + d \cos(\phi + \theta) \\
   y + d \sin(\phi + \theta) \end{bmatrix}

* The range and bearing: the slides mix the coordinates, :math:`(x - u)^2 + (y - v)^2` beside
  :math:`\operatorname{atan2}(y - u, x - v)`, and have the sign of the direction reversed.
* The start of a landmark: the slides have sine and cosine exchanged.
* The distribution of :math:`y_i` is printed with :math:`f(x_i, 0)` as its mean; it is :math:`g(x_i, 0)`.

Two more are in Algorithm 11.3: a missing transpose (:doc:`/lessons/slides/plot_07_kalman_filter`), and an
:math:`M_i` in the place of :math:`G_x` (:doc:`/lessons/slides/plot_08_extended_kalman_filter`).
"""

# %%
# A start must undo the observation
# ---------------------------------
#
# Each landmark is observed without noise and placed again by both forms. A test of this kind finds such misprints.
import matplotlib.pyplot as plt
import numpy as np

import kalmark as km

pose = np.array([1.0, 0.5, 0.4])
landmarks = np.array([[4.0, 1.0], [3.0, 4.0], [-1.0, 3.0], [2.0, -2.0]])
d, phi = km.geometry.observe(pose, landmarks)[0].T
right = km.geometry.inv_observe(pose, np.stack([d, phi], axis=1))[0]
printed = pose[:2] + np.stack([d * np.sin(phi + pose[2]), d * np.cos(phi + pose[2])], axis=1)
for name, places in (("right", right), ("printed", printed)):
    print(f"{name}: largest error {np.abs(places - landmarks).max():.2f} m")

# %%
# The printed places
# ------------------
#
# The printed form reflects each direction in the diagonal through the robot.
figure, ax = plt.subplots(figsize=(7, 4.5), layout="constrained")
ax.axline(pose[:2], slope=1, ls=":", color="0.6")
ax.plot(*landmarks.T, "k+", ms=14, label="landmarks")
ax.plot(*right.T, "o", mfc="none", color="tab:green", label="placed")
ax.plot(*printed.T, "x", color="tab:red", label="as printed")
ax.plot(*pose[:2], "b^", label="robot")
ax.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
ax.legend(loc="upper left", bbox_to_anchor=(1, 1))
plt.show()

# %%
# Try changing
# ------------
#
# * A landmark on the diagonal: ``[3.0, 2.5]`` in place of ``[3.0, 4.0]``. Both forms agree there, as the figure shows,
#   so one example would not find the misprint. The largest error that is printed is of the other landmarks, 4.50 m.
