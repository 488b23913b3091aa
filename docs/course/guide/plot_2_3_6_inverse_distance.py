r"""
[S] 2.3.6: the inverse of the distance
======================================

The distance of a new landmark lies between :math:`d_{min}` and infinity; its inverse :math:`\rho = 1/d` between 0 and
:math:`1/d_{min}`, [S] (46) and (47). The landmark has an anchor, a direction and :math:`\rho`, [S] (48) and (49).
From a new position :math:`t` its line of sight, with an arbitrary length, is linear in :math:`\rho`, [S] (51); the
measurement is its bearing, [S] (52):

.. math::

   v \propto \rho\, (p_0 - t) + \begin{bmatrix} \cos\alpha \\ \sin\alpha \end{bmatrix}, \qquad
   y = \operatorname{atan2}(v_2, v_1) - \theta

Equation (52) is printed with the arctangent of a quotient, which loses the side of a landmark behind the sensor.
"""

# %%
# A filter of the distance and one of its inverse
# -----------------------------------------------
#
# The pose of the robot is known; it drives 2 m to the side in 40 steps. At each it measures the bearing of a landmark
# ahead with 1 degree of noise. The prior of :math:`\rho` is that of (47) with 1 m, both ends at two sigmas; the one
# of :math:`d` covers 0 to 20 m. Each of 200 runs has its own noise; the corrections are [S] (26) to (30) with one
# number as the state.
import matplotlib.pyplot as plt
import numpy as np

rng = np.random.default_rng(0)
baselines, noise = np.linspace(0.05, 2, 40), np.radians(1)
filters = {"1/d [1/m]": (0.5, 0.25, lambda s: s), "d [m]": (10.0, 5.0, lambda d: 1 / d)}


def bearing(rho, b):
    return np.arctan2(1, -b * rho)  # (51), (52): sensor at (b, 0), alpha = 90 degrees


figure, axes = plt.subplots(2, 3, figsize=(10, 5.6), layout="tight", sharex=True)
for row, (name, (mean, sigma, to_rho)) in zip(axes, filters.items(), strict=True):
    for ax, distance in zip(row, (3, 10, 40), strict=True):
        x, P, path = np.full(200, mean), np.full(200, sigma**2), []
        for b in baselines:
            z = bearing(1 / distance, b) + noise * rng.normal(size=200) - bearing(to_rho(x), b)
            H = (bearing(to_rho(x + 1e-5), b) - bearing(to_rho(x - 1e-5), b)) / 2e-5
            K = P * H / (H * P * H + noise**2)  # (27), (28)
            x, P = x + K * z, P - K * H * P  # (29), (30)
            path.append([x[0], 2 * np.sqrt(P[0])])
        truth, (estimate, band) = to_rho(1 / distance), np.array(path).T
        ax.plot(baselines, estimate)
        ax.fill_between(baselines, estimate - band, estimate + band, alpha=0.3)
        ax.axhline(truth, color="C2", ls="--")
        near = np.mean(np.abs(x - truth) < 3 * np.sqrt(P))
        ax.set(title=f"{distance} m: {near:.0%} within 3σ", ylabel=name)
figure.supxlabel("baseline [m]")
plt.show()

# %%
# The pictures
# ------------
#
# The band is two sigmas of the first run, the dashed line the truth; the title gives the share of the runs that end
# within three sigmas. The filter of :math:`\rho` is right at all three distances. The filter of :math:`d` is right
# only at 10 m, where its prior happens to be centred; at 40 m it has a small sigma of a wrong distance.
#
# Try changing
# ------------
#
# * The prior of d: ``(10.0, 5.0, ...)`` to ``(20.0, 20.0, ...)``. It covers all three landmarks now, but is too wide
#   for the tangent: 24, 70 and 82 % of the runs end within three sigmas.
# * The baselines: ``np.linspace(2, 2, 1)``, a single measurement from 2 m aside. Even the filter of :math:`\rho`
#   fails at 10 m and 40 m (no run is within three sigmas): (51) is linear, its bearing (52) is so only for a small
#   parallax.
