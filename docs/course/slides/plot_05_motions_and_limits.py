r"""
[F] Motions and their limits
============================

A car moves along its heading and turns; it cannot move sideways (it is *non-holonomic*). With the speed :math:`v` and
the turn :math:`\Delta\theta` during :math:`\Delta t` it drives an arc of the radius
:math:`R = v\,\Delta t / \Delta\theta`:

.. math::

   \begin{bmatrix} x \\ y \\ \theta \end{bmatrix} \rightarrow \begin{bmatrix}
   x + R\,(\sin(\theta + \Delta\theta) - \sin\theta) \\
   y - R\,(\cos(\theta + \Delta\theta) - \cos\theta) \\ \theta + \Delta\theta \end{bmatrix}

The straight line (:math:`\Delta\theta \to 0`) and the turn on the spot (:math:`R \to 0`) are its limits. At the first
one the formula itself is infinity times zero.
"""

# %%
# The arc in kalmark
# ------------------
#
# ``km.geometry.V(a)`` is the mean rotation on the way from 0 to a; it is regular at 0. A step is then a pose that is
# composed with the robot's.
import matplotlib.pyplot as plt
import numpy as np

import kalmark as km


def arc(pose, s, turn):
    """Move the pose (3,) by s [m] along an arc that turns by `turn` [rad]."""
    return km.geometry.compose(pose, np.array([*(km.geometry.V(turn) @ [s, 0]), turn]))[0]


def printed(pose, s, turn):
    """Move as the slides print it."""
    R, theta, end = s / turn, pose[2], pose[2] + turn
    step = R * np.array([np.sin(end) - np.sin(theta), np.cos(theta) - np.cos(end), 0])
    return np.array([*pose[:2], end]) + step


# %%
# To the limits
# -------------
#
# Left: arcs of the same length with different turns, among them the straight line. Right: the difference between both
# forms against the turn. The printed form loses digits near the straight line, since it subtracts nearly equal numbers.
figure, (ax, error) = plt.subplots(1, 2, figsize=(10, 4.2), layout="constrained")
for turn in (-3.0, -1.5, -0.5, 0.0, 0.5, 1.5, 3.0):
    way = np.array([arc(np.zeros(3), 2.0 * k, turn * k) for k in np.linspace(0, 1, 40)])
    ax.plot(*way[:, :2].T, label=f"{turn:+.1f} rad")
ax.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
ax.legend(title="turn", loc="upper left", bbox_to_anchor=(1, 1))
turns, start = np.logspace(-14, 0, 120), np.array([0, 0, 1.0])
apart = [np.linalg.norm(arc(start, 2.0, each) - printed(start, 2.0, each)) for each in turns]
error.loglog(turns, np.maximum(apart, 1e-17), ".")
error.set(xlabel="turn [rad]", ylabel="difference of the end [m]")
plt.show()

# %%
# Try changing
# ------------
#
# * The turn on the spot: ``arc(np.zeros(3), 0.0, 1.0)`` gives (0, 0, 1).
# * ``printed(start, 2.0, 0.0)`` stops with a division by zero; ``arc`` drives straight.
# * ``km.motion.Unicycle()`` is this motion as a model of kalmark: its control is (speed, turn rate), held until the
#   next one.
