"""
[S] C.3: the program of 102 lines
=================================

The guide ends with a program of 102 lines: a simulator, the filter and a picture that moves. Here it is in thirty;
the functions of its files ``move``, ``observe``, ``invObserve`` and ``cov2elli`` are those of ``km.geometry``.

As in the guide, the simulated robot drives on an exact circle and the noise is added to the control of the filter. At
each step all known landmarks correct the map and one new landmark, at random, is started.
"""

# %%
# Simulator and filter
# --------------------
#
# Capital letters are the simulated variables. Two lines of the printed program need a correction:
# ``lids = find(landmarks(1,:)==0)`` is missing at the start of its part d, and the gain has ``Z^-l`` (the letter) in
# place of ``Z^-1``.
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.animation import FuncAnimation

import kalmark as km
from kalmark.simulate.layouts import Cloister

rng, W = np.random.default_rng(1), Cloister(n=7).floor()
R, U = np.array([0.0, -2.0, 0.0]), np.array([0.1, 0.05])
q, s, order = np.array([0.01, 0.02]), np.array([0.1, np.radians(1)]), rng.permutation(36)
slam, known, history = km.textbook.TextbookSlam(start=R, Q=np.diag(q**2), R=np.diag(s**2)), {}, []
for step in range(200):
    R, _, _ = km.geometry.move(R, U, [0, 0])
    Y = km.geometry.observe(R, W)[0] + s * rng.normal(size=W.shape)
    slam.predict(U + q * rng.normal(size=2))
    for i, number in known.items():
        slam.correct(number, Y[i])  # with the gate of three sigmas, (83)
    known |= {i: slam.initialize(Y[i]) for i in order[step : step + 1]}
    history.append((R, slam.x.copy(), slam.P.copy()))
print(f"error of the pose {(slam.x[:3] - R).round(3)}, its sigmas {np.sqrt(np.diag(slam.P)[:3]).round(3)}")

# %%
# The picture that moves
# ----------------------
#
# Red is the simulated world and robot, blue the estimated robot with its ellipse in magenta, green are the ellipses
# of the landmarks, all at three sigmas, with 16 points each as in ``cov2elli``. Landmarks far from the start have
# long ellipses: the error of the heading moves them.
figure, ax = plt.subplots(figsize=(5, 5))


def draw(step):
    ax.clear()
    ax.plot(*W.T, "r+")
    R, x, P = history[step]
    for pose, colour in ((R, "r"), (x, "b")):
        ax.plot(*pose[:2], colour, marker=(3, 0, np.degrees(pose[2]) - 90), ms=12, mfc="none")
    for at in [slice(k, k + 2) for k in (0, *range(3, len(x), 2))]:
        ax.plot(*km.geometry.ellipse(x[at], P[at, at], 3).T, "g" if at.start else "m")
    ax.set(xlim=(-6, 6), ylim=(-6, 6), title=f"step {step + 1}")


animation = FuncAnimation(figure, draw, frames=range(3, 200, 8), interval=240)
plt.show()

# %%
# Try changing
# ------------
#
# * The noise of the turn: ``np.array([0.01, 0.2])``. The sigma of the heading at the end, as printed, is nearly as
#   before: every step is corrected by all landmarks.
# * The corrections: ``if number in (0, 1): slam.correct(number, Y[i])``. Two landmarks of 36 are enough to keep
#   the error of the position small; its sigma in x grows by a half, as printed.
# * The filter: ``estimator: textbook`` runs it in ``kalmark run``, on any log, with equations that you change
#   (:doc:`/textbook`). Two sliders choose its noise in :doc:`/how/plot_10_choosing_noise`.
