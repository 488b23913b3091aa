r"""
[S] B.3: an ellipse and its axes
================================

The points of equal density of a Gaussian form an ellipsoid, [S] (78):

.. math::

   (x - \bar x)^\top P^{-1} (x - \bar x) = 1

In its own axes :math:`(u, v)` it is :math:`u^2/a^2 + v^2/b^2 = 1`, [S] (79). A rotation :math:`R` and a translation
:math:`\bar x` bring it to its place, [S] (80) and (81). So :math:`P` has the singular value decomposition, [S] (82),

.. math::

   P = R D R^\top, \qquad D = \operatorname{diag}(a^2, b^2)
"""

# %%
# From P to axes and angle
# ------------------------
#
# ``ellipse_axes`` returns the semi-axes :math:`a \ge b` and the angle of the major axis. The columns of :math:`R` are
# the directions of the axes.
import matplotlib.pyplot as plt
import numpy as np

import kalmark as km

mean, P = np.array([3.0, 2.0]), np.array([[2.2, 1.1], [1.1, 1.0]])
(a, b), angle = km.geometry.ellipse_axes(P)
R = km.geometry.rotation(angle)
print(f"a = {a:.3f}, b = {b:.3f}, angle = {np.degrees(angle):.1f} degrees")
print("R D R' - P:", np.abs(R @ np.diag([a**2, b**2]) @ R.T - P).max().round(12))

# %%
# The construction, step by step
# ------------------------------
#
# The unit circle of [S] (86) is stretched by the semi-axes, turned by :math:`R` and moved to the mean, [S] (87). In
# (86) the letter n is the number of points, in (87) the number of sigmas; here the second is 1. The last picture is
# [S] Figure 8. The ellipse is as wide as one :math:`\sigma_x` on each side of the mean, the dashed box.
alpha = np.linspace(0, 2 * np.pi, 65)
circle = np.array([np.cos(alpha), np.sin(alpha)])
stretched = np.diag([a, b]) @ circle
steps = [circle, stretched, R @ stretched, (R @ stretched).T + mean]
figure, axes = plt.subplots(1, 4, figsize=(11, 2.7), layout="tight", sharex=True, sharey=True)
titles = ["unit circle", "times √D", "times R", "plus the mean"]
for k, (ax, points, title) in enumerate(zip(axes, steps, titles, strict=True)):
    x, y = points.T if k == 3 else points
    ax.plot(x, y)
    centre, turned = (mean if k == 3 else np.zeros(2)), (R if k >= 2 else np.eye(2))
    for axis, length, name, colour in ((0, a, "a", "C3"), (1, b, "b", "C2")):
        end = centre + turned[:, axis] * (length if k else 1)
        ax.annotate("", end, centre, arrowprops={"arrowstyle": "->", "color": colour})
        ax.text(*(end + 0.1), name if k else "1", color=colour)
    ax.set(title=title, aspect="equal", xlim=(-2, 5.2))
half = np.sqrt(np.diag(P))
axes[3].add_patch(plt.Rectangle(mean - half, *(2 * half), fill=False, ls="--", ec="0.5"))
plt.show()

# %%
# Try changing
# ------------
#
# * The correlation: ``1.1`` to ``0.0``, twice. The ellipse lies along the axes, and the box touches it at their ends.
# * The correlation: ``1.1`` to ``1.48``, twice. P is nearly singular: b is 0.055, the ellipse nearly a line.
# * Its sign: ``1.1`` to ``-1.1``. The angle changes its sign, a and b stay.
