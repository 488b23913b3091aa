r"""
[T] 2: compounding and merging
==============================

An *approximate transformation* is a frame that is known with an uncertainty: a mean :math:`(x, y, \theta)` and a
covariance. Two operations combine them. *Compounding* chains A in the world with B in A: the uncertainties add up, as
in two predictions. *Merging* combines two estimates of the same frame: the result is better than each, as a prediction
followed by a correction. With the Jacobians :math:`J_A, J_B` of the composition of poses

.. math::

   C_{AB} = J_A C_A J_A^\top + J_B C_B J_B^\top, \qquad C_{merged} = (C_1^{-1} + C_2^{-1})^{-1}

This is the law of resistances in series, :math:`R_1 + R_2`, and in parallel, :math:`(1/R_1 + 1/R_2)^{-1}`.
"""

# %%
# Two ways to one place
# ---------------------
#
# One way has four short steps, the other two long ones that keep the direction across better. ``compound`` chains the
# steps of a way, ``merge`` combines the ends of both.
import matplotlib.pyplot as plt
import numpy as np

import kalmark as km

ways = {
    "four steps": ([(2.0, 0.5, 0.0)] * 4, np.diag([0.1, 0.1, 0.06]) ** 2),
    "two steps": ([(4.0, 2.2, -0.3), (3.2, 1.1, 0.3)], np.diag([0.4, 0.1, 0.05]) ** 2),
}
ends = []
figure, (ax, bars) = plt.subplots(2, 1, figsize=(7, 6), height_ratios=[3, 1])
for name, (steps, noise) in ways.items():
    a, A = np.zeros(3), np.zeros((3, 3))
    for step in steps:
        a, A = km.geometry.compound(a, A, step, noise)
        ax.plot(*km.geometry.ellipse(a[:2], A[:2, :2], 2, 60).T, f"C{len(ends)}")
        ax.plot(*a[:2], f"C{len(ends)}", marker=(3, 0, np.degrees(a[2]) - 90), ms=8)
    ends.append((a, A))
    print(f"{name}: {a.round(2)}, sigmas {np.sqrt(np.diag(A)).round(3)}")
m, M = km.geometry.merge(*ends[0], *ends[1])
print(f"merged: {m.round(2)}, sigmas {np.sqrt(np.diag(M)).round(3)}")
ax.plot(*km.geometry.ellipse(m[:2], M[:2, :2], 2, 60).T, "k", lw=2)
ax.set(aspect="equal", xlabel="x [m]", ylabel="y [m]")
# sphinx_gallery_defer_figures

# %%
# As resistances
# --------------
#
# Above: the ellipses of 2 sigma grow with each step; the black one of the merged end is smaller than both. Below: the
# variances of the heading. In series they add up exactly, since headings do; in parallel the merged one is a little
# smaller than that of the heading alone, because the positions, which are correlated with it, are merged as well.
variances = [A[2, 2] for _, A in ends]
parallel = 1 / (1 / variances[0] + 1 / variances[1])
names, values = [*ways, "parallel", "merged"], [*variances, parallel, M[2, 2]]
bars.barh(names, values, color=["C0", "C1", "C7", "k"])
bars.set(xlabel="variance of the heading [rad²]")
figure.set_layout_engine("constrained")
plt.show()

# %%
# Try changing
# ------------
#
# * A second way that is ten times worse: ``np.diag([4.0, 1.0, 0.5]) ** 2``. The merged end is hardly better than the
#   first way alone (0.228 m and 0.482 m in place of 0.229 m and 0.492 m): the current takes the smaller resistance.
# * Eight steps of half the length with the same noise each: ``[(1.0, 0.25, 0.0)] * 8``. The variance of the heading
#   doubles, from 0.0144 to 0.0288 rad².
