r"""
Your own landmark
=================

A landmark is a list of atoms (a point, a heading, a scalar, ...) and two functions: how it looks from a sensor's pose
:math:`T`, and the landmark that looks so. The filter does not change.
"""

# %%
# A sign: a post with a direction
# -------------------------------
from typing import ClassVar

import matplotlib.pyplot as plt
import numpy as np

import kalmark as km
from kalmark.geometry import compose, inverse
from kalmark.geometry.spaces import HEADING, VECTOR, Space


@km.register("landmark", "post_with_arm")
class Sign:
    """A sign: the pose (x, y, theta) of its post, with the arm ahead."""

    kind: ClassVar = "post_with_arm"
    space: ClassVar = Space("sign", (VECTOR, HEADING))

    def seen_from(self, T, l):
        to, TO_T = inverse(T)
        v, V_to, V_l = map(np.array, zip(*(compose(to, each) for each in l), strict=True))
        return v, V_to @ TO_T, V_l

    def from_view(self, T, v):
        return tuple(map(np.array, zip(*(compose(T, each) for each in v), strict=True)))


# %%
# A sensor that sees it
# ---------------------
#
# It measures the post's range and bearing and the direction of the arm. The view :math:`v` has three numbers now.
def look(v):
    return np.array([np.hypot(v[0], v[1]), np.arctan2(v[1], v[0]), v[2]])


def where(y):
    return np.array([y[0] * np.cos(y[1]), y[0] * np.sin(y[1]), y[2]])


noise = np.diag([0.1, 0.02, 0.02]) ** 2
columns, angular = ("post_m", "post_rad", "arm_rad"), (False, True, True)
reader = km.pointwise(look, noise=noise, inverse=where, columns=columns, angular=angular)

# %%
# In the filter
# -------------
#
# One sign also fixes the robot's heading: a point does not. The black line is the arm,
# between its limits of 3 sigma.
rover = km.Robot("rover", km.motion.Unicycle(), sensors={"eye": km.Mount(reader)})
slam = km.Slam(rover, landmarks=Sign())
for t in range(4):
    slam.process(km.Control(t_s=float(t), robot="rover", u=(0.0, 0.0)))
    y = [look(np.array([3.0, 1.0, 2.0]))]
    slam.process(km.Scan(t_s=float(t), robot="rover", sensor="eye", y=y, ids=["exit"]))
sign, sigmas = slam.mean("exit"), np.sqrt(np.diag(slam.covariance("exit")))
print(sign.round(3), "sigmas", sigmas.round(3))
ax = km.draw(slam, labels=True)
for angle, style in zip(sign[2] + sigmas[2] * np.array([0, -3, 3]), ("k", "k:", "k:"), strict=True):
    ax.plot(sign[0] + np.array([0, np.cos(angle)]), sign[1] + np.array([0, np.sin(angle)]), style)
ax.autoscale()
plt.show()

# %%
# Try changing
# ------------
#
# A worse reading of the arm: ``np.diag([0.1, 0.02, 0.2]) ** 2``. The sigma of the sign's heading grows from 0.016 rad
# to 0.101 rad.
