r"""
[S] 1.3.2: which object owns which
==================================

[S] Figure 2 shows the classes of RTSLAM: the map owns robots and landmarks, a robot its sensors, a sensor its
observations; a *map manager* maintains the landmarks, a *data manager* the observations of a sensor. kalmark has the
same parts:

* ``Slam`` owns the map and the robots, and ``Upkeep`` decides which landmarks are confirmed, merged and deleted;
* a ``Robot`` owns its mounts, a ``Mount`` its sensor, and ``Attention`` decides which observations correct the map;
* an ``Observation`` belongs to the report of one scan, and is not kept.
"""

# %%
# A filter of two robots
# ----------------------
import matplotlib.pyplot as plt

import kalmark as km

lidar = km.sensors.RangeBearing(sigma_range_m=0.1, sigma_bearing_rad=0.02)
camera = km.Mount(km.sensors.Bearing(), attention=km.Attention(updates=5))
sensors = {"A": {"lidar": km.Mount(lidar), "camera": camera}, "B": {"lidar": km.Mount(lidar)}}
motion = km.motion.Odometry2D()
robots = [km.Robot(name, motion, sensors=mounts) for name, mounts in sensors.items()]
slam = km.Slam(robots, upkeep=km.Upkeep(confirm=3))
y = [[3.0, 0.1], [4.0, -0.3]]
report = slam.process(km.Scan(t_s=0, robot="A", sensor="lidar", y=y, ids=[1, 2]))

# %%
# Figure 2
# --------
#
# The tree is read from the objects themselves; the line of an object goes to its owner.
rows = [("Slam", 0), ("Upkeep", 1)]
for robot in slam.robots.values():
    rows.append((f"Robot {robot.name}", 1))
    for name, mount in robot.sensors.items():
        kind = type(mount.sensor).__name__
        rows.append((f"Mount {name}: {kind}", 2))
        rows.append((f"Attention, updates: {mount.attention.updates}", 3))
rows += [(f"landmark {name}", 1) for name in slam.landmarks().ids]
figure, ax = plt.subplots(figsize=(8, 5), layout="constrained")
owners = {}
for k, (text, depth) in enumerate(rows):
    owners[depth] = k
    box = {"boxstyle": "round", "fc": "w", "ec": f"C{depth}"}
    ax.text(depth, -k, text, va="center", bbox=box)
    if depth:
        up = owners[depth - 1]
        ax.plot([depth - 0.9, depth - 0.9, depth], [-up, -k, -k], "0.5", lw=1, zorder=0)
ax.set(xlim=(-0.2, 4.3), ylim=(-len(rows), 1))
ax.axis("off")
plt.show()

# %%
# Try changing
# ------------
#
# * One mount more: ``"B": {"lidar": km.Mount(lidar), "rear": camera}``. The tree has two rows more.
# * An observation without an id: ``ids=[1, None]`` and ``print(report.observations)``. It is *ignored*, with the reason
#   "no id in the log": an association that needs no ids is another argument of ``Slam``.
