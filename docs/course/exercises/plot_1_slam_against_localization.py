r"""
[T] 1: the cost of SLAM and of localization
===========================================

With :math:`N` landmarks, [T]'s state has :math:`d = 3N + 3` numbers. The prediction as it is printed multiplies
matrices of that size, :math:`F P F^\top`: :math:`O(d^3)`, in theory :math:`O(d^{2.37})`. A localization in a known
map corrects a pose of three numbers :math:`N` times: :math:`O(N)`.

*Remark:* :math:`F` differs from the identity in the rows of the robot only, [S] (13). With blocks, [S] (14)-(16), the
prediction is :math:`O(N)` too; the correction by one landmark, [S] (23), is :math:`O(N^2)`.
"""

# %%
# Three programs
# --------------
#
# ``TextbookSlam.predict`` multiplies full matrices, ``by_blocks`` changes the rows and columns of the robot alone,
# ``localize`` corrects the pose by N landmarks, taken as exactly known. Landmarks are points here, so d = 2N + 3.
import time
import timeit

import matplotlib.pyplot as plt
import numpy as np
from threadpoolctl import threadpool_limits

import kalmark as km

Q, R, u = np.diag([0.1, 0.05]) ** 2, np.diag([0.1, 0.02]) ** 2, np.array([0.1, 0.02])


def by_blocks(slam, u):
    r, F_r, F_n = km.geometry.move(slam.x[:3], u, np.zeros(2))
    P_rm = F_r @ slam.P[:3, 3:]  # [S] (16)
    slam.P[:3, :3] = F_r @ slam.P[:3, :3] @ F_r.T + F_n @ Q @ F_n.T  # [S] (15)
    slam.x[:3], slam.P[:3, 3:], slam.P[3:, :3] = r, P_rm, P_rm.T


def localize(slam, _):
    P = slam.P[:3, :3]
    for l in slam.x[3:].reshape(-1, 2):
        _, H, _ = km.geometry.observe(slam.x[:3], l)
        P = P - P @ H.T @ np.linalg.inv(H @ P @ H.T + R) @ H @ P  # [S] (23)


threadpool_limits(1)  # several threads would hide how a product of matrices grows
sizes, times = [10, 20, 40, 80, 160, 320, 640], {"predict": [], "by_blocks": [], "localize": []}
for N in sizes:
    slam = km.textbook.TextbookSlam([0, 0, 0], Q, R)
    slam.x, slam.P = np.arange(3.0 + 2 * N), np.eye(3 + 2 * N)
    for way in (km.textbook.TextbookSlam.predict, by_blocks, localize):
        took = timeit.repeat("way(slam, u)", timer=time.process_time, number=1, globals=globals())
        times[way.__name__].append(min(took))

# %%
# The time against N
# ------------------
#
# Both axes are logarithmic: a line of slope 1 is O(N), one of slope 3 is O(N^3). Of few landmarks, the cost of the
# calls hides the growth. The time is that of the processor, which other programs do not change.
figure, ax = plt.subplots(figsize=(7, 4), layout="constrained")
for name, seconds in times.items():
    ax.loglog(sizes, np.array(seconds) * 1e3, "o-", label=name)
ax.set(xlabel="landmarks N", ylabel="time of the processor [ms]")
ax.legend()
plt.show()

# %%
# Try changing
# ------------
#
# * Larger maps: ``[100, 200, 400, 800]``. The slope of ``predict`` comes near to 3; ``by_blocks`` stays below
#   ``localize``.
# * ``benchmarks/ways.py`` in the repository measures a whole step of SLAM in several ways, that of ``km.Slam`` among
#   them.
