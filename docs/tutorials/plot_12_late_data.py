"""
Late data
=========

Events are processed in the order of their times. A measurement that comes after a younger one is refused, and the map
stays as it was: it is never fused silently at the wrong time.
"""

# %%
# Refused events
# --------------
import heapq

import matplotlib.pyplot as plt

import kalmark as km
from kalmark.errors import EventError
from kalmark.events import sort_key

lidar = {"lidar": km.Mount(km.sensors.RangeBearing())}
slam = km.Slam(km.Robot("rover", km.motion.Unicycle(), sensors=lidar))
slam.process(km.Control(t_s=1.0, robot="rover", u=(0.5, 0.0)))
try:
    slam.process(km.Scan(t_s=0.9, robot="rover", sensor="lidar", y=[[4.0, 0.1]], ids=[7]))
except EventError as error:
    print(error)


# %%
# A buffer puts events in order
# -----------------------------
#
# In a robot's loop, hold events back for the longest delay of a sensor. The estimate is then so much older; what
# happened since is a prediction, which costs little.
class Buffer:
    def __init__(self, slam, delay_s):
        self.slam, self.delay_s, self.waiting, self.processed = slam, delay_s, [], []

    def add(self, event):
        heapq.heappush(self.waiting, (sort_key(event), id(event), event))
        now_ns = max(one[-1].t_ns for one in self.waiting)
        while self.waiting and now_ns - self.waiting[0][-1].t_ns >= self.delay_s * 1e9:
            self.slam.process(heapq.heappop(self.waiting)[-1])
        self.processed.append((now_ns / 1e9, event.t_ns / 1e9, self.slam.t_ns / 1e9))


buffer = Buffer(slam, delay_s=0.3)
for k in range(20):
    t = 1.1 + 0.1 * k
    buffer.add(km.Control(t_s=t, robot="rover", u=(0.5, 0.0)))
    if k >= 2:  # a camera whose images take 0.2 s
        buffer.add(km.Scan(t_s=t - 0.2, robot="rover", sensor="lidar", y=[[4.0 - 0.05 * k, 0.1]], ids=[7]))
print(f"processed up to {slam.t_ns / 1e9:.1f} s of {t:.1f} s, {len(buffer.waiting)} events wait")
now, stamps, until = zip(*buffer.processed, strict=True)
figure, ax = plt.subplots(figsize=(7, 3.5), layout="constrained")
ax.plot(now, stamps, ".", label="events, as they arrive")
ax.plot(now, until, label="processed up to here")
ax.set(xlabel="time [s]", ylabel="time of the event [s]")
ax.legend()
plt.show()

# %%
# A recorded log
# --------------
#
# A log that is read as a whole is sorted first (``km.open_log``, ``kalmark run``); increments of odometry that end
# after a scan are cut at it. A stamp that is wrong by a constant is a shift of its sensor: ``kalmark diagnose`` finds
# it, and the format's option puts it right (:doc:`/datasets`).
#
# A sensor that compares with an earlier pose (scan matching, a loop closure) needs no late event: an ``odometer``
# with ``keep`` clones the poses of its last scans (:doc:`/state_sensors`).

# %%
# Try changing
# ------------
#
# * A delay that is too short: ``delay_s=0.1``. The first late scan is refused: it comes after a control of a later
#   time.
# * A longer one: ``delay_s=1.0``. Nothing is refused, but the estimate is a second old, and 18 events wait in place
#   of 4.
