r"""
[TB] 3.4: frames in space
=========================

A frame of the toolbox has a position :math:`t` and a quaternion :math:`q` as its state of seven numbers, and keeps what
follows from them: :math:`R`, :math:`R^\top`, the inverse, and the matrices :math:`\Pi` of the quaternion's derivatives.
In kalmark a pose is the same seven numbers, with the real part of :math:`q` last, and functions return the rest. Its
error has six numbers: a shift and a rotation vector. So there is no derivative by four numbers of unit length, and no
:math:`\Pi`: with :math:`p^W = R\,p^F + t`, a turn by the small rotation vector :math:`\varphi` moves the point by
:math:`\varphi \times (p^W - t)` if it is about the world's axes.
"""

# %%
# From a frame and to a frame, in space
# -------------------------------------
#
# A camera on a robot: its z axis looks ahead, its x axis to the right. ``compose`` chains the two poses.
import matplotlib.pyplot as plt
import numpy as np

import kalmark as km
from kalmark.results.labels import name_points

frames, rotations = km.geometry.frames3d, km.geometry.rotations
robot, _ = frames.from_euler_pose(np.array([2.0, 1.0, 0.0, 0.0, 0.0, np.pi / 6]))
mount, _ = frames.from_euler_pose(np.array([0.3, 0.0, 0.6, -np.pi / 2, 0.0, -np.pi / 2]))
camera, _, _ = frames.compose(robot, mount)
p_camera = np.array([0.5, -0.2, 2.0])
p_world, PW_f, PW_p = frames.from_frame(camera, p_camera)
back, _, _ = frames.to_frame(camera, p_world)
t, q, R = camera[:3], camera[3:], rotations.matrix(camera[3:])
inverse, _ = frames.inverse(camera)
print("t", t.round(3), " q", q.round(3), " it", inverse[:3].round(3), " iq", inverse[3:].round(3))
print("roll, pitch, yaw", np.degrees(frames.to_euler_pose(camera)[0][3:]).round(1), "degrees")
print("p in the world", p_world.round(3), " and back", back.round(3))
d = 1e-6 * np.array([0, 0, 0, 0, 0, 1.0])
rate = (frames.from_frame(frames.plus(camera, d), p_camera)[0] - p_world) / 1e-6
print("column of PW_f", PW_f[:, 5].round(4), " by differences", rate.round(4))

# %%
# The three frames
# ----------------
#
# Axes x, y, z are red, green, blue, drawn 0.6 m long. The columns of :math:`R` are the axes of the camera in the world.
ax = plt.figure(figsize=(8, 5.5)).add_subplot(projection="3d")
for pose in (np.eye(7)[6], robot, camera):
    for axis, colour in zip(rotations.matrix(pose[3:]).T, ("C3", "C2", "C0"), strict=True):
        ax.quiver(*pose[:3], *axis, color=colour, length=0.6)
ax.plot(*np.array([camera[:3], p_world]).T, "k:o", ms=3)
name_points(ax, [np.zeros(3), robot[:3], camera[:3], p_world], ["W", "robot", "camera", "p"], gap=8)
ax.set(xlim=(0, 5), ylim=(-0.5, 3), zlim=(0, 1.8), zticks=[0, 1], xlabel="x [m]", ylabel="y [m]")
ax.set(aspect="equal")
ax.view_init(40, -75)
plt.show()

# %%
# Try changing
# ------------
#
# * No turn of the mount: ``np.array([0.3, 0.0, 0.6, 0.0, 0.0, 0.0])``. The axes of the camera are those of the robot;
#   p is above it, at (2.793, 1.227, 2.6).
# * Another turn of the robot: ``np.pi / 6`` to ``-np.pi / 2``. Camera and p turn about the robot; p comes to (1.5,
#   -1.3, 0.8).
