r"""
Your own data association
=========================

An association answers, for each observation of a scan, with a landmark's name, ``NEW`` or None (leave it alone), and
a reason. It asks a query for the landmarks near by, and for the squared Mahalanobis distance :math:`z^\top Z^{-1} z`
of a pair.
"""

# %%
# Trust the ids but for one
# -------------------------
#
# The log has the id -1 for what its reader could not identify. ``associate`` returns (answer, reason) for each
# observation; ``threshold`` returns the gate, by default that of the estimator.
from typing import Annotated

import matplotlib.pyplot as plt
import numpy as np

import kalmark as km


@km.register("association", "readable_ids")
class ReadableIds:
    """The ids of the log, but for one that stands for none."""

    unread: Annotated[int, "The id of what could not be identified."] = -1

    def threshold(self, m, default):
        return default

    def associate(self, query):
        return [(None, "not identified") if i == self.unread else (i, "") for i in query.ids]


# %%
# In the filter
# -------------
lidar = {"lidar": km.Mount(km.sensors.RangeBearing())}
slam = km.Slam(km.Robot("rover", km.motion.Unicycle(), sensors=lidar), ReadableIds())
y = np.array([[4.0, 0.1], [3.0, -0.5]])
report = slam.process(km.Scan(t_s=0.0, robot="rover", sensor="lidar", y=y, ids=[7, -1]))
for one in report.observations:
    print(one.id, one.outcome, one.landmark, one.reason)
km.draw(slam, report=report, labels=True).figure.legend(loc="outside lower center", ncols=2)
plt.show()

# %%
# Try changing
# ------------
#
# * ``association: {type: readable_ids, unread: 0}``, with this file among the ``plugins`` of a configuration.
# * Without ids: kalmark's own associations (:doc:`/association`) weigh the landmarks near by; that of
#   ``association/gated.py`` is the shortest to start from.
