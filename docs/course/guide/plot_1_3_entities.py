r"""
[S] 1: the entities of SLAM
===========================

A map has robots and landmarks, robots have sensors, and each pair of a sensor and a landmark makes an observation:
[S] Figures 1 and 2. Three models connect them, [S] (1) to (3): motion, direct observation and inverse observation,

.. math::

   \mathcal R \leftarrow f(\mathcal R, u, n), \qquad y_i = h(\mathcal R, \mathcal S, \mathcal L_i), \qquad
   \mathcal L_j = g(\mathcal R, \mathcal S, y_j)
"""

# %%
# Two robots, three sensors
# -------------------------
#
# In kalmark ``Slam`` has the map, a ``Robot`` its motion and its sensors, a ``Mount`` the place of a sensor on its
# robot, which is constant and no part of the map. The first observation of a landmark starts it with :math:`g`; each
# further one corrects the map with :math:`h`.
import matplotlib.pyplot as plt
import numpy as np

import kalmark as km

lidar = km.sensors.RangeBearing(sigma_range_m=0.2, sigma_bearing_rad=0.03)
front, rear = km.Mount(lidar, at=(0.3, 0, 0)), km.Mount(lidar, at=(-0.3, 0, np.pi))
motion, P = km.motion.Odometry2D(), np.diag([0.1, 0.1, 0.02]) ** 2
robots = [
    km.Robot("A", motion, start=(0, 0, 0.5), cov=P, sensors={"front": front, "rear": rear}),
    km.Robot("B", motion, start=(6, 0, 2.2), cov=P, sensors={"front": front}),
]
slam, world = km.Slam(robots), np.array([[3.0, 2.5], [4.0, 3.5], [-2.0, -0.5], [2.5, 1.0]])
figure, ax = plt.subplots(figsize=(8, 5), layout="constrained")
for robot in robots:
    for name, mount in robot.sensors.items():
        at, _, _ = km.geometry.compose(np.array(robot.start), np.array(mount.at, float))
        y, _, _ = km.geometry.observe(at, world)
        ids = np.flatnonzero(np.abs(y[:, 1]) < 0.8)  # in the field of view
        scan = km.Scan(t_s=0.0, robot=robot.name, sensor=name, y=y[ids], ids=ids)
        seen = [(o.landmark, o.outcome) for o in slam.process(scan).observations]
        print(f"robot {robot.name}, sensor {name}: {seen}")
        ax.plot(*at[:2], "ks", ms=5)
        ax.plot(*np.swapaxes([at[:2] + 0 * world[ids], world[ids]], 0, 2).swapaxes(1, 2), "C7:")
# sphinx_gallery_defer_figures

# %%
# Figure 1
# --------
#
# Squares are sensors, dotted lines observations, numbers landmarks; the ellipses have three sigmas. Landmarks 0, 1 and
# 3, which both robots see, connect them: their corrections make the poses of A and B correlated.
for row in slam.landmarks():
    ax.plot(*km.geometry.ellipse(row.mean, row.covariance, sigmas=3, points=60).T, "C2")
    ax.annotate(row.id, row.mean, ha="center", va="center", bbox={"boxstyle": "circle", "fc": "w", "ec": "none"})
for robot in robots:
    r, P = slam.mean(robot.name), slam.covariance(robot.name)
    ax.plot(*r[:2], "k", marker=f"${robot.name}$", ms=10)
    ax.plot(*km.geometry.ellipse(r[:2], P[:2, :2], sigmas=3, points=60).T, "k", lw=1)
ax.set(aspect="equal", xlabel="x [m]", ylabel="y [m]")
plt.show()

# %%
# Try changing
# ------------
#
# * The sensors of A: ``sensors={"front": front}``. Nobody sees landmark 2, and it is not in the map.
# * The noise: ``sigma_bearing_rad=0.2``. The ellipse of landmark 2, which one sensor sees, becomes long across its
#   line of sight.
