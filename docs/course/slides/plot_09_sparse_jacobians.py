r"""
[F] In principle now easy: the Jacobians of EKF-SLAM
====================================================

EKF-SLAM is this filter with one state of the robot and N landmarks. Its Jacobians are simpler than they look: landmarks
do not move and have no noise, so :math:`F_x` and :math:`F_n` differ from identity and zero in the robot's rows only; a
measurement is of one landmark, so each row of :math:`G_x` has two blocks; its noise is additive, so
:math:`G_n \Sigma_m G_n^\top` is block diagonal:

.. math::

   F_x = \begin{bmatrix} \partial f_R / \partial R & 0 \\ 0 & I \end{bmatrix}, \qquad
   F_n = \begin{bmatrix} \partial f_R / \partial n \\ 0 \end{bmatrix}, \qquad
   G_x = \begin{bmatrix} \partial g / \partial R & \partial g / \partial L_1 & 0 \\
   \partial g / \partial R & 0 & \partial g / \partial L_2 \end{bmatrix}
"""

# %%
# EKF-SLAM by the filter of any state
# -----------------------------------
#
# ``f`` and ``g`` take the whole state; their Jacobians are found by differences, all zeros included. Five landmarks are
# in the map, four are observed: the third gives no measurement, and it needs no rows.
import matplotlib.pyplot as plt
import numpy as np

import kalmark as km


def f(x, n, u):
    return np.concatenate([km.geometry.move(x[:3], u, n)[0], x[3:]])


def g(x, n, j):
    return km.geometry.observe(x[:3], x[3 + 2 * j : 5 + 2 * j])[0] + n


W = np.array([[2.0, 2.0], [4.0, 1.0], [5.0, -1.0], [3.0, -2.0], [1.0, -2.5]])
noise = {"Sigma_n": np.diag([0.1, 0.05]) ** 2, "Sigma_m": np.diag([0.1, 0.02]) ** 2}
x, Sigma = np.array([0, 0, 0.2, *W.ravel()]), np.diag([0] * 3 + [0.3**2] * 10)
given = {**noise, "x": x, "Sigma": Sigma, "angles": [2], "angles_y": [1]}
u, seen = np.array([1.0, 0.3]), [0, 1, 3, 4]
ys = km.geometry.observe(km.geometry.move(x[:3], u, [0.1, 0.03])[0], W[seen])[0]
for groups in ([[0, 1, 2, 3]], [[0], [1], [2], [3]], [[3], [2], [1], [0]]):
    ekf = km.textbook.ExtendedKalmanFilter(f, g, **given)
    ekf.predict(u)
    for group in groups:
        ekf.correct_stacked(ys[group], [(seen[k],) for k in group])
    print(groups, ekf.x[:3].round(5), np.sqrt(np.diag(ekf.Sigma)[:3]).round(5))

# %%
# Where the Jacobians are not zero
# --------------------------------
#
# White is zero. Of :math:`F_x` the upper left corner is not the identity; :math:`G_x` has the columns of the robot in
# each row, and two others; its noise is one block for each landmark. Corrections by one landmark after the other give
# nearly what the stacked one gives; the small difference is that later ones are linearized at a better estimate.


def jacobian(f, x):
    return np.array([(f(x + d) - f(x - d)) / 2e-6 for d in 1e-6 * np.eye(len(x))]).T


pictures = {"$F_x$": jacobian(lambda x: f(x, np.zeros(2), u), x)}
pictures["$F_n$"] = jacobian(lambda n: f(x, n, u), np.zeros(2))
pictures["$G_x$"] = np.vstack([jacobian(lambda x, j=j: g(x, 0, j), x) for j in seen])
pictures["noise of y"] = np.kron(np.eye(4), np.sqrt(noise["Sigma_m"]))
figure, axes = plt.subplots(1, 4, figsize=(10, 3.4), width_ratios=[13, 2, 13, 8])
for ax, (name, J) in zip(axes, pictures.items(), strict=True):
    ax.imshow(np.abs(J) ** 0.3, cmap="Greys")
    ax.set(title=name, xticks=[], yticks=[])
plt.show()

# %%
# Try changing
# ------------
#
# * A landmark that is not observed: ``seen`` = [0, 1, 3] and groups without 3. Its columns of :math:`G_x` are empty,
#   and its mean stays; it is not updated, as in the slides.
# * A worse pose: ``np.diag([0.5, 0.5]) ** 2`` as ``Sigma_n``. The order counts more, since the first correction
#   moves the point at which the next is linearized by more: the sigmas of the heading differ by 0.0007 rad, not 0.0001.
