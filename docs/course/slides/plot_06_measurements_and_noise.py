r"""
[F] Two kinds of measurement, linearization and noise
=====================================================

The slides have two measurements of a landmark :math:`(u, v)` by a vehicle :math:`(x, y, \theta)`: distance and
heading, or its position in the vehicle's frame, by the rotation matrix of :math:`-\theta`:

.. math::

   \begin{bmatrix} d \\ \phi \end{bmatrix} = \begin{bmatrix} \sqrt{(u - x)^2 + (v - y)^2} \\
   \operatorname{atan2}(v - y, u - x) - \theta \end{bmatrix}, \qquad
   \begin{bmatrix} x_v \\ y_v \end{bmatrix} = R_{-\theta} \begin{bmatrix} u - x \\ v - y \end{bmatrix}

Neither is linear in the vehicle's state. With noise :math:`n \sim N(0, \Sigma)` in its argument, a function is
approximated by its Jacobian :math:`J`:

.. math::

   f(x + n) \sim N(f(x),\, J_x \Sigma J_x^\top), \qquad f(x, n) \sim N(f(x, 0),\, J_n \Sigma J_n^\top)
"""

# %%
# Noise through three functions
# -----------------------------
#
# ``propagate`` takes a function that returns its value and its Jacobian. In the first two the pose is uncertain, and
# the landmark is known. In the third the pose is known, and the noise is that of the control, inside the motion.
import matplotlib.pyplot as plt
import numpy as np

import kalmark as km

rng, landmark = np.random.default_rng(0), np.array([6.0, 2.0])
r, sigmas = np.array([0.0, 0.0, 0.2]), np.array([0.1, 0.1, 0.3])


def distance_heading(r):
    return km.geometry.observe(r, landmark)[:2]


def place_in_frame(r):
    return km.geometry.to_frame(r, landmark)[:2]


def motion(n):
    end, _, R_n = km.geometry.move(r, [3.0, 0.5], n)
    return end[[0, 2]], R_n[[0, 2]]


# %%
# Draws and ellipses
# ------------------
#
# The red ellipse of 2 sigma is the approximation; 86 % of the draws would be inside, if it were exact. Distance and
# heading are nearly linear in the pose, so it fits. The position in the frame is not: an uncertain heading bends the
# cloud, and the ellipse does not. The end of the motion (x and heading) is linear in its noise.
figure, axes = plt.subplots(1, 3, figsize=(11, 4), layout="constrained")
cases = (
    (distance_heading, r, "d [m]", "φ [rad]"),
    (place_in_frame, r, "$x_v$ [m]", "$y_v$ [m]"),
    (motion, np.zeros(2), "x [m]", "θ [rad]"),
)
for ax, (f, mean, first, second) in zip(axes, cases, strict=True):
    s = sigmas[-len(mean) :]
    y, Y = km.geometry.propagate(f, mean, np.diag(s**2))
    draws = np.array([f(mean + s * n)[0] for n in rng.normal(size=(2000, len(s)))])
    inside = [km.geometry.mahalanobis(one, y, Y) < 2 for one in draws]
    ax.plot(*draws.T, ".", ms=3, alpha=0.3)
    ax.plot(*km.geometry.ellipse(y, Y, sigmas=2, points=60).T, "tab:red")
    ax.set(title=f"{f.__name__}: {np.mean(inside):.0%} inside", xlabel=first, ylabel=second)
plt.show()

# %%
# Try changing
# ------------
#
# * A better heading: ``np.array([0.1, 0.1, 0.03])``. The cloud of the position is hardly bent: 86 % are inside, not
#   54 %.
# * A landmark that is near: ``np.array([0.3, 0.1])``. 86 % are inside, although the heading is as uncertain as before:
#   the nearer the landmark, the less its position depends on the heading.
