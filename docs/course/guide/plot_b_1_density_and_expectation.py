r"""
[S] B.1: density and expectation
================================

A density is the limit of a probability by the length of its interval, [S] (65). The expectation of a function is its
average, weighed by the density, [S] (66):

.. math::

   p(x) = \lim_{dx \to 0} \frac{P(x \le X < x + dx)}{dx}, \qquad
   \mathbb{E}[f(x)] = \int f(x)\, p(x)\, dx

Mean and covariance are two examples, [S] (67) and (68). The density of a Gaussian is [S] (69).
"""

# %%
# Two expectations
# ----------------
#
# ``expectation`` integrates over a Gaussian; the average of many draws comes near it.
import matplotlib.pyplot as plt
import numpy as np

import kalmark as km

rng = np.random.default_rng(0)
mean, P = np.array([1.0]), np.array([[0.5]])
draws = rng.multivariate_normal(mean, P, size=5000)
functions = {
    "x": lambda x: x[0],
    "(x - mean)²": lambda x: (x[0] - mean[0]) ** 2,
    "cos x": lambda x: np.cos(x[0]),
}

# %%
# The limit, and the average
# --------------------------
#
# Left: histograms of the same draws with intervals :math:`dx` of three lengths, divided by :math:`dx`, and the
# density. Right: averages of the first :math:`k` draws; the dashed lines are the expectations.
figure, (left, right) = plt.subplots(1, 2, figsize=(10, 3.8), layout="constrained")
for dx, colour in ((1.0, "0.85"), (0.5, "0.7"), (0.1, "C0")):
    edges = np.arange(-2, 4 + dx, dx)
    left.hist(draws[:, 0], edges, density=True, histtype="step", color=colour, label=f"{dx = }")
x = np.linspace(-2, 4, 200)
left.plot(x, km.geometry.density(x[:, None], mean, P), "k", label="density (69)")
left.set(xlabel="x", ylabel="p(x)")
left.legend()
for k, (name, f) in enumerate(functions.items()):
    exact = float(km.geometry.expectation(f, mean, P))
    running = np.cumsum([f(one) for one in draws]) / np.arange(1, 5001)
    right.semilogx(np.arange(1, 5001), running, f"C{k}", label=f"E[{name}] = {exact:.3f}")
    right.axhline(exact, color=f"C{k}", ls="--", lw=1)
    print(f"E[{name}]: integral {exact:.4f}, average of 5000 draws {running[-1]:.4f}")
right.set(xlabel="number of draws", ylabel="average")
right.legend()
plt.show()

# %%
# Try changing
# ------------
#
# * The variance: ``np.array([[2.0]])``. E[cos x] falls from 0.421 to 0.199: it is :math:`e^{-P/2} \cos \bar x`, a
#   wide Gaussian averages the cosine away.
# * The function: ``np.cos(x[0])`` to ``x[0] ** 3``. Under the old name it is :math:`\bar x^3 + 3 \bar x P` = 2.5, not
#   :math:`\bar x^3` = 1: the expectation of a function is not the function of the expectation.
