r"""
[T] 3: both filters along one drive
===================================

[T] concludes that a filter with all landmarks in its state from the start, with
:math:`\Sigma_0 = \operatorname{diag}(0, C, \dots, C)`, equals one that begins with the pose alone and augments its
state. On the way there are two statements:

* A landmark :math:`k` that is not observed yet keeps its mean and its rows and columns of :math:`\Sigma`: its
  cross-covariances are zero, and :math:`F_{x,j}^\top` has zero rows there.
* At its first observation the gain is :math:`B^{-1}`, with the innovation's covariance inverted as a series,
  :math:`\Psi^{-1} = (B B^\top)^{-1} (\frac1C I - \frac1{C^2} N)`; the mean stays where the measurement placed it, (4).
"""

# %%
# The same controls and observations for both
# -------------------------------------------
#
# ``all_at_once`` has six landmarks of covariance :math:`C I` in its state; at the first observation it sets the mean to
# the inverse observation, as Thrun's algorithm does in its line 9. ``augmented`` is the guide's filter.
import matplotlib.pyplot as plt
import numpy as np

import kalmark as km

Q, R, C = np.diag([0.05, 0.02]) ** 2, np.diag([0.1, 0.02]) ** 2, 1e7
W = np.array([[2.0, 2.0], [4.0, -1.0], [6.0, 2.0], [8.0, 0.0], [7.0, 4.0], [4.0, 5.0]])
augmented, all_at_once = (km.textbook.TextbookSlam([0, 0, 0], Q, R) for _ in range(2))
all_at_once.x, all_at_once.P = np.zeros(15), np.diag([0.0] * 3 + [C] * 12)
rng, true, numbers, off, pictures = np.random.default_rng(0), np.zeros(3), {}, [], {}
for step in range(40):
    true = km.geometry.move(true, [0.25, 0.04], [0, 0])[0]
    u = rng.multivariate_normal([0.25, 0.04], Q)
    augmented.predict(u)
    all_at_once.predict(u)
    for j in np.flatnonzero(np.hypot(*(W - true[:2]).T) < 3):
        y = km.geometry.observe(true, W[j])[0] + rng.multivariate_normal([0, 0], R)
        if j in numbers:
            augmented.correct(numbers[j], y, gate=np.inf)
        else:
            numbers[j], l = augmented.initialize(y), slice(3 + 2 * j, 5 + 2 * j)
            all_at_once.x[l] = km.geometry.inv_observe(all_at_once.x[:3], y)[0]
        all_at_once.correct(j, y, gate=np.inf)
    pictures[step] = np.abs(all_at_once.P)
    off.append(np.abs(augmented.x[:3] - all_at_once.x[:3]).max())

# %%
# Untouched until seen, equal afterwards
# --------------------------------------
#
# Left: :math:`\Sigma` of ``all_at_once``. Black is a variance that is still C; no other number in its row and column is
# other than zero. Right: the difference of both poses. It is not zero, because C is not infinite and numbers have 16
# digits; the augmented filter needs no C.
figure, axes = plt.subplots(1, 4, figsize=(11, 3), layout="constrained")
for ax, step in zip(axes, (0, 12, 39), strict=False):
    ax.imshow(np.minimum(pictures[step], 0.2) ** 0.5, cmap="Greys")
    ax.set(title=f"step {step + 1}", xticks=[1, *range(3, 15, 2)], yticks=[])
    ax.set_xticklabels(["r", 0, 1, 2, 3, 4, 5])
axes[3].semilogy(off)
axes[3].set(xlabel="step", title="difference of the poses")
plt.show()

# %%
# Try changing
# ------------
#
# * The constant: ``1e2``, ``1e4``, ``1e10``, ``1e13`` in place of ``1e7``. The poses differ by 2e-4, 2e-6, 6e-5 and
#   0.08 (m or rad): a small C is a wrong prior, a large one loses digits.
# * A sensor that reaches farther: ``< 20``. All landmarks are seen at the first step, and the filters are equal from
#   there on, to 7e-8.
