r"""
[F] Counting matchings
======================

Without ids, a matching decides for each of :math:`m` observations which of :math:`n` landmarks it is of, or that it is
of none. With each landmark used at most once, there are

.. math::

   \sum_{k=0}^{\min(m, n)} \binom{m}{k} \binom{n}{k}\, k!

matchings: choose :math:`k` observations and :math:`k` landmarks, and pair them. The slides give only
:math:`\binom{n}{m}` as a lower bound: it chooses the landmarks, but does not pair them.
"""

# %%
# All matchings, and those inside the gates
# -----------------------------------------
#
# ``count`` adds the observations one after the other: each takes one of its landmarks that is still free, or none. With
# the gates of a filter, an observation has few landmarks to take.
from math import comb, factorial

import matplotlib.pyplot as plt
import numpy as np

import kalmark as km


def count(fits, used=0):
    """Return the number of matchings of observations with landmarks that fits (m, n) allows."""
    if not len(fits):
        return 1
    free = [j for j in np.flatnonzero(fits[0]).tolist() if not used >> j & 1]
    return count(fits[1:], used) + sum(count(fits[1:], used | 1 << j) for j in free)


rng, sigma, sizes = np.random.default_rng(1), 0.4, range(1, 13)
landmarks = rng.uniform(0, 10, size=(12, 2))
observed = landmarks + sigma * rng.normal(size=(12, 2))
gate = km.geometry.gate(0.99, dof=2)
cov = sigma**2 * np.eye(2)
d = np.array([[km.geometry.mahalanobis(o, l, cov) for l in landmarks] for o in observed])
fits = d**2 < gate
gated = [count(fits[:n, :n]) for n in sizes]
every = [sum(comb(n, k) ** 2 * factorial(k) for k in range(n + 1)) for n in sizes]

# %%
# How fast they grow
# ------------------
#
# For 3 observations of 3 landmarks the formula and the count agree. Twelve and twelve have more matchings than can be
# tried; the gates, [S] (83), leave few of them.
print("3 with 3:", every[2], count(np.ones((3, 3), dtype=bool)))
print(f"12 with 12: {every[-1]:.1e}, inside the gates {gated[-1]}")
figure, ax = plt.subplots(figsize=(7, 4), layout="constrained")
ax.semilogy(sizes, every, "o-", label="all")
ax.semilogy(sizes, gated, "o-", label="inside the gates of 99 %")
ax.set(xlabel="observations = landmarks", ylabel="matchings", xticks=sizes[1::2])
ax.legend()
plt.show()

# %%
# Try changing
# ------------
#
# * A better sensor: ``sigma`` = 0.1. 2560 matchings remain: each observation has hardly more than one landmark, but may
#   always be of none.
# * A smaller gate: ``km.geometry.gate(0.5, dof=2)``. 336 remain, but the right one is seldom among them.
