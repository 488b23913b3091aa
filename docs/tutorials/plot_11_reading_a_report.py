"""
Reading a report
================

``slam.process(event)`` returns what became of the event: of each observation its outcome, its landmark, its distance
and the reason.
"""

# %%
# Three outcomes
# --------------
import matplotlib.pyplot as plt
import numpy as np

import kalmark as km

lidar = {"lidar": km.Mount(km.sensors.RangeBearing(sigma_range_m=0.1, sigma_bearing_rad=0.02))}
slam = km.Slam(km.Robot("rover", km.motion.Unicycle(), sensors=lidar), estimator=km.estimators.Ekf())


def scan(t_s, y, ids):
    return slam.process(km.Scan(t_s=t_s, robot="rover", sensor="lidar", y=y, ids=ids))


scan(0.0, [[4.0, 0.3], [2.0, -0.5]], [7, 8])
report = scan(0.1, [[4.1, 0.31], [3.5, -0.5], [6.0, 0.0]], [7, 8, 9])
for one in report.observations:
    print(f"{one.index}: {one.outcome} to {one.landmark}, d2 {one.d2}, {one.reason}")
km.draw(slam, report=report, labels=True).figure.legend(loc="outside lower center", ncols=2)
plt.show()

# %%
# ``associated``: it corrected the map. ``rejected``: it is outside the gate, here the second one, 1.5 m off. ``new``:
# it began a landmark. ``ignored``, ``deferred`` and ``tentative`` are of observations without an id
# (:doc:`/association`).
#
# The numbers
# -----------
#
# The measurement ``y``, what was expected ``e``, the innovation ``z`` and its covariance ``Z``, one row an
# observation, NaN where it was compared with nothing.
print("z", report.z.round(3).tolist())
print("sigmas of z", np.sqrt(np.diagonal(report.Z, axis1=1, axis2=2)).round(3).tolist())

# %%
# The map after it
# ----------------
#
# Mean and covariance of anything, jointly; every landmark; what a sensor would see now.
print(slam.mean("rover").round(3), slam.covariance("rover", 7).shape)
for row in slam.landmarks():
    print(row.id, row.kind, row.mean.round(2), "from", row.observations, "observations")
print("expected of 7:", slam.expect("rover", "lidar", names=[7]).e.round(3))

# %%
# Of a whole run
# --------------
#
# ``associations.csv`` in a run folder has a row for each observation of the log, ``kalmark explain RUN`` draws any
# scan with its candidates (:doc:`/evaluation`).

# %%
# Try changing
# ------------
#
# * A right measurement: ``[2.2, -0.5]`` in place of ``[3.5, -0.5]``. It is 0.2 m off, its d2 is 2, and it is
#   associated.
# * No ids in the second scan: ``[None] * 3``, with ``association=km.association.NearestNeighbour()`` in ``Slam``. The
#   other two observations are *tentative*, each with its reason.
