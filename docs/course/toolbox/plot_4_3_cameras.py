r"""
[TB] 3.1, 4.3: cameras and their lenses
=======================================

The toolbox has two kinds of camera, ``pinHole`` with a distortion and ``omniCam``. Its sensors have the parameters
``k`` (intrinsic), ``d`` (distortion), ``c`` (correction) and the size of the image. A radial distortion moves a point
at the distance :math:`r` from the axis, at unit depth, to

.. math::

   r_d = r\, (1 + d_1 r^2 + d_2 r^4 + \dots)

The correction is the inverse of that polynomial, which the toolbox fits; kalmark computes it.
"""

# %%
# One wall, four cameras
# ----------------------
#
# ``expect`` projects points of the camera's frame to pixels, ``invert`` gives the viewing rays of pixels back. The wall
# is 2 m in front of the camera, 8 m wide and 4 m high.
import matplotlib.pyplot as plt
import numpy as np

import kalmark as km

wall = np.array([[x, y, 2.0] for y in np.linspace(-2, 2, 9) for x in np.linspace(-4, 4, 41)])
cameras = {
    "ideal": km.sensors.PinHole(),
    "radial": km.sensors.PinHole(distortion=(-0.15, 0.02)),
    "equidistant": km.sensors.PinHole(lens="equidistant", fx_px=220, fy_px=220),
    "omnidirectional": km.sensors.Omnidirectional(),
}
figure, axes = plt.subplots(2, 2, figsize=(9, 7), layout="constrained")
for ax, (name, camera) in zip(axes.flat, cameras.items(), strict=True):
    seen = wall[camera.sees(wall)]
    e, E_v = camera.expect(seen)
    rays = camera.rays(e)
    away = np.abs(rays - seen / np.linalg.norm(seen, axis=1)[:, None]).max()
    print(f"{name}: {len(seen)} of {len(wall)} points, there and back {away:.0e}")
    ax.plot(*e.T, ".", ms=3)
    width, height = camera.image
    ax.set(xlim=(0, width), ylim=(height, 0), aspect="equal", title=name)
plt.show()

# %%
# The pictures
# ------------
#
# The ideal camera keeps lines straight and sees 147 of the 369 points. A distortion with :math:`d_1 < 0` bends lines
# outwards and sees 183. The lens ``equidistant`` and the omnidirectional camera see the whole wall; the latter sees
# behind itself, too.

# %%
# Try changing
# ------------
#
# * The sign of the distortion: ``(0.15, 0.02)``. Lines bend inwards, and 85 points are seen.
# * A wall that is near: ``[x, y, 1.0]``. The ideal camera sees 33 points, the lens ``equidistant`` 359, the
#   omnidirectional camera all.
# * A calibration file of OpenCV, Kalibr or ROS in place of the numbers: :doc:`/cameras`.
