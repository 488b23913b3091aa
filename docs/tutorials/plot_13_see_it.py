"""
See it while it runs
====================

``km.draw`` draws a filter as it is now: the robot and the true one, the path, landmarks with the ellipses of their
covariances, and the last scan in the colours of its outcomes. On the same axes it replaces what it drew before.
"""

# %%
# A loop with a picture
# ---------------------
import matplotlib.pyplot as plt
import numpy as np

import kalmark as km

rng = np.random.default_rng(3)
posts = {1: (4.0, 1.0), 2: (2.0, 3.0), 3: (-1.0, 2.0), 4: (0.0, -2.0), 5: (5.0, 4.0)}
lidar = km.Mount(km.sensors.RangeBearing(sigma_range_m=0.15, sigma_bearing_rad=0.03))
motion = km.motion.Unicycle(sigma_v_mps=0.1, sigma_w_radps=0.1)
slam = km.Slam(km.Robot("rover", motion, sensors={"lidar": lidar}), estimator=km.estimators.Ekf())
truth, path, true_path = np.zeros(3), [], []
fig, axes = plt.subplots(1, 2, figsize=(10, 5), layout="constrained", sharex=True, sharey=True)
for k in range(60):
    t_s, u = 0.2 * k, np.array([0.5, 0.3])
    slam.process(km.Control(t_s=t_s, robot="rover", u=u))
    truth = motion.move(truth, u + 0.1 * rng.normal(size=2), 0.2)[0]
    seen = km.geometry.observe(truth, np.array([*posts.values()]))[0]
    y = seen + rng.normal(size=seen.shape) * [0.15, 0.03]
    y[0, 0] += 2.0 * (k == 59)  # the last range of landmark 1 is 2 m too long
    report = slam.process(km.Scan(t_s=t_s + 0.2, robot="rover", sensor="lidar", y=y, ids=[*posts]))
    path.append(slam.mean("rover"))
    true_path.append(truth)
    known = {"rover": true_path, **posts}
    km.draw(slam, axes[k // 30], truth=known, report=report, path=path, labels=True)  # here: after 30 and 60 scans
fig.legend(*axes[1].get_legend_handles_labels(), loc="outside lower center", ncols=4)
plt.show()

# %%
# In a notebook ``fig.canvas.draw()``, or ``plt.pause(0.01)`` in a window, after ``km.draw`` shows each step;
# :class:`matplotlib.animation.FuncAnimation` makes a film of a function that processes the next event and draws. The
# options are those of ``picture`` in a configuration (:doc:`/configuration`): ``view="side"`` of robots in space,
# ``limits_m``, ``ellipses``, ``colours``. The ellipses are here those of the covariance itself; ``ellipses="shape"``
# leaves out what all errors have in common (:doc:`/evaluation`).
#
# Try changing
# ------------
#
# * ``sigma_bearing_rad`` to 0.1: the ellipses are longer across the line of sight.
# * ``+= 2.0`` to 0.2: the observation passes the gate, and is drawn as ``associated``.
# * ``labels=True`` to ``sigmas=1``: smaller ellipses, without names.
