r"""
[S] A.1, A.2: frames of the plane
=================================

A frame :math:`\mathcal{F} = (t, \theta)` has its origin at :math:`t` and is turned by :math:`\theta` in the world
:math:`\mathcal{W}`. Its rotation matrix is [S] (54); a point goes from the frame to the world and back by [S] (55),
(56):

.. math::

   p^{\mathcal W} = R\, p^{\mathcal F} + t, \qquad p^{\mathcal F} = R^\top (p^{\mathcal W} - t)
"""

# %%
# From a frame and to a frame
# ---------------------------
#
# Each function returns its value first, then the Jacobians with respect to its arguments.
import matplotlib.pyplot as plt
import numpy as np

import kalmark as km

F = np.array([2.0, 1.0, np.radians(30)])
p_F = np.array([2.0, 1.5])
p_W, PW_f, PW_p = km.geometry.from_frame(F, p_F)
back, PF_f, PF_p = km.geometry.to_frame(F, p_W)
print("p in the world:", p_W.round(3), " and back in F:", back.round(3))
print("Jacobian of p in the world with respect to F:", PW_f.round(3), sep="\n")

# %%
# Figure 7
# --------
#
# The blue arrows are the two columns of :math:`R`, the axes of :math:`\mathcal F`. The dashed lines are the two
# coordinates of the same point in each frame.
R, t, style = km.geometry.rotation(F[2]), F[:2], {"arrowstyle": "-|>"}
figure, ax = plt.subplots(figsize=(5.6, 4.4), layout="constrained")
for origin, axes, coordinates, name, colour in (
    (np.zeros(2), np.eye(2), p_W, "W", "k"),
    (t, R, p_F, "F", "C0"),
):
    for k in range(2):
        ax.annotate("", origin + axes[:, k], origin, arrowprops=style | {"color": colour})
    corner = origin + axes[:, 0] * coordinates[0]
    ax.plot(*np.array([origin, corner, p_W]).T, "--", color=colour, lw=1)
    ax.annotate(name, origin + np.array([0.05, -0.4]), color=colour, size=14)
ax.annotate("", t, (0, 0), arrowprops=style | {"color": "C3"})
ax.annotate("t", t / 2 + np.array([-0.1, 0.15]), color="C3", size=14)
ax.plot(*p_W, "o", color="C2")
ax.annotate("p", p_W + 0.1, color="C2", size=14)
ax.set(aspect="equal", xlim=(-0.8, 4), ylim=(-0.6, 4), xlabel="x [m]", ylabel="y [m]")
plt.show()

# %%
# Try changing
# ------------
#
# * The angle: ``np.radians(120)``. The point turns about the origin of :math:`\mathcal F`; its coordinates in
#   :math:`\mathcal F` stay (2, 1.5), those in the world become (-0.299, 1.982).
# * The point: ``p_F = np.array([0.0, 0.0])``. It is at :math:`t`, and the third column of the Jacobian is zero: the
#   angle does not move it.
