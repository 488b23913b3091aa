r"""
[S] 2.1, 2.4: events, and the loop that chains them
===================================================

Four events can happen to a map, and each is one operation of the filter, [S] Table 1:

==============================  =======================  ==================
event                           in SLAM                  in the filter
==============================  =======================  ==================
robot moves                     robot motion             prediction
sensor detects new landmark     landmark initialization  state augmentation
sensor observes known landmark  map correction           correction
mapped landmark is corrupted    landmark deletion        state reduction
==============================  =======================  ==================

The pseudo-code of [S] 2.4 chains them in three loops: over robots, their sensors and the observations of each.
"""

# %%
# The pseudo-code as a program
# ----------------------------
#
# The map starts with the poses alone, known exactly, [S] (7). The outcome of each observation is *associated* if its
# landmark is in the map, which it corrects, or *new*. Each ten steps the oldest landmark is deleted.
import matplotlib.pyplot as plt
import numpy as np

import kalmark as km

rng, noise = np.random.default_rng(0), np.array([0.1, 0.02])
W = rng.uniform((-6, -2), (6, 10), (24, 2))
reach = {"sonar": 3.0, "lidar": 5.0}
R = {"A": np.array([0.0, 0.0, 0.0]), "B": np.array([0.0, 8.0, np.pi])}
mounts = dict.fromkeys(reach, km.Mount(km.sensors.RangeBearing()))
slam = km.Slam([km.Robot(n, km.motion.Odometry2D(), r, mounts) for n, r in R.items()])
events, changes = [], {"motion": 0, "associated": 0, "new": 2, "deletion": -2}
for time in range(50):
    for name, robot in slam.robots.items():
        R[name] = km.geometry.move(R[name], [0.2, 0.05], rng.normal(0, 0.02, 2))[0]
        slam.process(km.Control(t_s=time, robot=name, u=(0.2, 0, 0.05)))
        events.append("motion")
        for sensor in robot.sensors:
            y = km.geometry.observe(R[name], W)[0] + noise * rng.normal(size=(24, 2))
            ids = np.flatnonzero((y[:, 0] > 0) & (y[:, 0] < reach[sensor]))
            scan = km.Scan(t_s=time, robot=name, sensor=sensor, y=y[ids], ids=ids)
            events += [each.outcome for each in slam.process(scan).observations]
    if time % 10 == 9:
        slam.remove(slam.landmarks().ids[0])
        events.append("deletion")

# %%
# The size of the state
# ---------------------
#
# Two poses have three numbers each, a landmark two. Motions and corrections keep the size of :math:`x`; a new landmark
# appends two rows to :math:`x` and :math:`P`, a deletion takes two away. Their place is free for the next landmark.
numbers, kinds = 6 + np.cumsum([changes[event] for event in events]), np.array(events)
figure, ax = plt.subplots(figsize=(8, 4), layout="constrained")
for kind, mark in zip(changes, ("|", ".", "^", "v"), strict=True):
    at = np.flatnonzero(kinds == kind)
    ax.plot(at, numbers[at], mark, label=f"{kind}: {len(at)}")
ax.set(xlabel="event", ylabel="numbers in x")
ax.legend()
plt.show()

# %%
# Try changing
# ------------
#
# * One robot: remove ``"B"`` from ``R``. It finds landmarks as it goes round: 24 new ones, 44 numbers at the end.
# * Short ranges: ``reach = {"sonar": 3.0, "lidar": 2.0}``. A robot sees less far: 665 corrections in place of 1382, and
#   24 new landmarks in place of 28.
# * No deletion: ``if time % 10 == 10``. All 24 landmarks stay: 54 numbers at the end, in place of 52, and 24 starts in
#   place of 28, since a deleted landmark that is seen again starts again.
