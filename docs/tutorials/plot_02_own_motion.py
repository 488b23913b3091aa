r"""
Your own motion
===============

A motion moves the robot's state by a control, [S] (1), and returns both Jacobians: :math:`r' = f(r, u)`, :math:`R_r =
\partial r' / \partial r`, :math:`R_u = \partial r' / \partial u`.
"""

# %%
# A robot on two tracks
# ---------------------
#
# The control is the speed of each track, held until the next one (``held``). Its motion is that of a unicycle whose
# speeds are linear in those of the tracks, so the chain rule gives the Jacobian.
from typing import Annotated, ClassVar

import matplotlib.pyplot as plt
import numpy as np

import kalmark as km
from kalmark.declare import NotNegative, Positive


@km.register("motion", "two_tracks")
class TwoTracks:
    """A robot on two tracks."""

    gauge_m: Annotated[Positive, "Distance of the tracks."] = 0.5
    sigma_mps: Annotated[NotNegative, "Noise of the speed of a track."] = 0.05
    space: ClassVar = km.geometry.SE2
    columns: ClassVar = ("left_mps", "right_mps")
    held: ClassVar = True

    def move(self, r, u, dt_s):
        V_u = np.array([[0.5, 0.5], [-1 / self.gauge_m, 1 / self.gauge_m]])
        r, R_r, R_v = km.motion.Unicycle().move(r, V_u @ u, dt_s)
        return r, R_r, R_v @ V_u

    def control_noise(self, u):
        return self.sigma_mps**2 * np.eye(2)

    def diffusion(self, u, dt_s):
        return None


# %%
# Its uncertainty without a map
# -----------------------------
#
# A turn to the left, without any observation: the covariance grows. The ellipses have three sigmas.
slam = km.Slam(km.Robot("crawler", TwoTracks(gauge_m=0.4)))
figure, ax = plt.subplots(figsize=(6, 4), layout="constrained")
for k in range(41):
    slam.process(km.Control(t_s=0.5 * k, robot="crawler", u=(0.4, 0.45)))
    if k % 8 == 0:
        mean, P = slam.mean("crawler"), slam.covariance("crawler")
        ax.plot(*mean[:2], "k.")
        ax.plot(*km.geometry.ellipse(mean[:2], P[:2, :2], sigmas=3, points=40).T, label=f"after {0.5 * k:g} s")
figure.legend(loc="outside right center")
ax.set(aspect="equal", xlabel="x [m]", ylabel="y [m]")

# %%
# Check it
# --------
#
# ``kalmark check my_motions.py:TwoTracks`` compares both Jacobians with differences; in a configuration it is
# ``motion: {type: two_tracks, gauge_m: 0.4}``, with the file among the ``plugins``.
from kalmark.models.model_check import check_model

for finding in check_model(TwoTracks(), np.random.default_rng(0)):
    print(finding)
plt.show()

# %%
# Try changing
# ------------
#
# A wrong Jacobian: ``return r, R_r, R_v``. The check shows an error of 0.9 of ``R_u``, and where: in its state, its
# control and its interval.
