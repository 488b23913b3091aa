r"""
[F] A map ruined by one wrong association
=========================================

A filter never takes back what it has fused. One observation that is fused with a wrong landmark moves the robot and,
through :math:`P`, all landmarks that are correlated with it, [S] (22). Afterwards the covariance is small and the error
is not, and the gate, [S] (83), refuses the right observations.
"""

# %%
# The same run, with and without one mistake
# ------------------------------------------
#
# A robot drives one and a quarter rounds of a circle and observes the landmarks within 4 m; their ids are known. In the
# second run, one observation has a wrong id: the first one of landmark 0 after the round is fused with landmark 1.
import matplotlib.pyplot as plt
import numpy as np

import kalmark as km

angles = 2 * np.pi * np.arange(16) / 16
landmarks = 9 * np.stack([np.sin(angles), 10 / 9 - np.cos(angles)], axis=1)
Q, R = np.diag([0.05, 0.02]) ** 2, np.diag([0.1, 0.02]) ** 2


def drive(gets, gate=9.0, mistaken=np.inf):
    """Return the filter and its numbers of the landmarks; landmark 0 gets a wrong id once."""
    rng, true, waiting = np.random.default_rng(5), np.zeros(3), True
    slam, numbers = km.textbook.TextbookSlam(true, Q, R, P=np.diag([0.01] * 3) ** 2), {}
    for step in range(196):
        true = km.geometry.move(true, [0.4, 0.04], rng.multivariate_normal([0, 0], Q))[0]
        slam.predict([0.4, 0.04])
        for j in np.flatnonzero(np.hypot(*(landmarks - true[:2]).T) < 4).tolist():
            y = km.geometry.observe(true, landmarks[j])[0] + rng.multivariate_normal([0, 0], R)
            if j not in numbers:
                numbers[j] = slam.initialize(y)
            elif step > 100 and j == 0 and waiting:
                waiting = not slam.correct(numbers[gets], y, mistaken)
            else:
                slam.correct(numbers[j], y, gate)
    return slam, numbers


# %%
# The map after it
# ----------------
#
# Ellipses are of 3 sigma. The mistake pulls the end of the round to the wrong place; the ellipses there do not hold the
# landmarks any more. The largest error of a landmark grows from 1.6 m to 3.6 m.
figure, axes = plt.subplots(1, 2, figsize=(10, 5), layout="constrained", sharey=True)
for ax, gets, title in zip(axes, (0, 1), ("no mistake", "one mistake"), strict=True):
    slam, numbers = drive(gets)
    for at in (slice(3 + 2 * i, 5 + 2 * i) for i in numbers.values()):
        ax.plot(*km.geometry.ellipse(slam.x[at], slam.P[at, at], sigmas=3).T, "tab:red")
    ax.plot(*landmarks.T, "k+", ms=10)
    ax.set(title=title, aspect="equal", xlabel="x [m]", ylabel="y [m]")
plt.show()

# %%
# Try changing
# ------------
#
# * No gate afterwards: ``gate=np.inf``. All the right observations that follow are fused, and do not mend the map: the
#   largest error is 4.2 m.
# * A gate for the mistake too: ``mistaken=9.0``. The wrong pair is refused, and the map is right: 1.6 m.
