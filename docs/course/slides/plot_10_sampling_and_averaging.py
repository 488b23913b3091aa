r"""
[F] Sampling and averaging over matchings
=========================================

If several matchings fit, the slides name two ways beside the best one: draw a matching by its probability, or average
over all of them. The average over matchings :math:`h` of the probability :math:`w_h` is again a Gaussian:

.. math::

   x = \sum_h w_h x_h, \qquad P = \sum_h w_h \left( P_h + (x_h - x)(x_h - x)^\top \right)
"""

# %%
# One observation, two landmarks
# ------------------------------
#
# Two known landmarks stand 1 m apart. The position of the robot is uncertain; its heading is known, so all is linear.
# It observes one landmark at (1.5, 0.1) from itself. Each matching has a filter of its own. The weight of each is the
# density of its innovation, :math:`w_h \propto N(y; M x^- + l_h, Z)`.
import matplotlib.pyplot as plt
import numpy as np

import kalmark as km

landmarks, y = np.array([[1.5, 0.5], [1.5, -0.5]]), np.array([1.5, 0.1])
prior, noise = np.diag([0.3, 0.4]) ** 2, 0.1**2 * np.eye(2)
each, weights = [], []
for landmark in landmarks:
    kf = km.textbook.KalmanFilter(np.eye(2), -np.eye(2), 0 * prior, noise, [0, 0], prior)
    weights.append(np.exp(-(km.geometry.mahalanobis(y, landmark, prior + noise) ** 2) / 2))
    kf.correct(y - landmark)
    each.append(kf)
weights = np.array(weights) / sum(weights)
x = sum(w * kf.x for w, kf in zip(weights, each, strict=True))
apart = [np.outer(kf.x - x, kf.x - x) for kf in each]
P = sum(w * (kf.Sigma + d) for w, kf, d in zip(weights, each, apart, strict=True))
drawn = np.random.default_rng(2).choice(2, size=1000, p=weights)
print("weights", weights.round(3), "average", x.round(3), "drawn:", np.bincount(drawn))

# %%
# Results of the three ways
# -------------------------
#
# Dotted is the position before, red after, at 2 sigma; crosses are the landmarks. The best matching has a small
# covariance, and is wrong with the probability 0.36. A drawn one has too; the width of the lines is its probability.
# The covariance of the average holds both places, though its mean is at neither.
figure, axes = plt.subplots(1, 3, figsize=(11, 3.8), layout="constrained", sharey=True)
ways = list(zip(each, weights, strict=True))
shown = {"the best": [(each[weights.argmax()], 1)], "drawn": ways, "the average": []}
for ax, (title, some) in zip(axes, shown.items(), strict=True):
    for kf, w in some:
        ax.plot(*km.geometry.ellipse(kf.x, kf.Sigma, 2, 40).T, "tab:red", lw=4 * w)
    ax.plot(*landmarks.T, "k+", *km.geometry.ellipse([0, 0], prior, 2, 40).T, "k:", ms=12)
    ax.set(title=title, aspect="equal", xlabel="x [m]", xlim=(-0.8, 1.7))
axes[2].plot(*km.geometry.ellipse(x, P, 2, 40).T, "tab:red")
plt.show()

# %%
# Try changing
# ------------
#
# * An observation in the middle: ``y = np.array([1.5, 0.0])``. Both weights are 0.5. With 0.4 they are 0.91 and 0.09.
# * A narrower prior: ``np.diag([0.3, 0.1]) ** 2``. One matching has the weight 0.99; the three ways agree.
# * A scan of kalmark is answered so by ``km.Slam([robot], km.association.Averaged())`` and
#   ``km.association.Sampled()``.
