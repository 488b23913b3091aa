r"""
Your own sensor
===============

A sensor states what it measures of a point at :math:`v = (x, y)` in its own frame, [S] (2), with which noise, and, if
it can start a landmark, where the point is that it measures, [S] (3).
"""

# %%
# A function is enough
# --------------------
#
# ``km.pointwise`` makes a sensor of plain functions and takes the Jacobians by differences. This one measures the
# time of flight of an echo (ms) and the sine of its bearing.
import matplotlib.pyplot as plt
import numpy as np

import kalmark as km


def echo(v):
    distance = np.hypot(v[0], v[1])
    return np.array([2 * distance / 343.0 * 1e3, v[1] / distance])


def place(y):
    distance, bearing = y[0] * 343.0 / 2e3, np.arcsin(y[1])
    return distance * np.array([np.cos(bearing), np.sin(bearing)])


noise = np.diag([0.1, 0.02]) ** 2
sonar = km.pointwise(echo, noise=noise, inverse=place, columns=("flight_ms", "sine"))

# %%
# In the filter
# -------------
rover = km.Robot("rover", km.motion.Unicycle(), sensors={"sonar": km.Mount(sonar, at=(0.2, 0, 0))})
slam = km.Slam(rover)
slam.process(km.Control(t_s=0.0, robot="rover", u=(0.4, 0.0)))
for t in np.arange(0.0, 5.0, 0.5):
    seen = np.array([[3.0, 1.0], [4.0, -1.0]]) - [0.2 + 0.4 * t, 0.0]
    y = [echo(one) for one in seen]
    report = slam.process(km.Scan(t_s=t, robot="rover", sensor="sonar", y=y, ids=[1, 2]))
for row in slam.landmarks():
    print(row.id, row.mean.round(3), "m, sigmas", np.sqrt(np.diag(row.covariance)).round(3), "m")
km.draw(slam, report=report, labels=True).figure.legend(loc="outside lower center", ncols=2)
plt.show()

# %%
# With a name in the configuration
# --------------------------------
#
# A class with exact Jacobians is faster and has a name for ``kalmark run``. In a file ``my_sensors.py`` beside the
# configuration it is used by
#
# .. code-block:: yaml
#
#    log: {path: my_log}
#    plugins: [my_sensors.py]
#    robots: {each: {motion: {type: unicycle}, sensors: {tape: {type: tape, sigma_m: 0.1}}}}
#
# Its fields are its keys, with bounds, unit (the end of the name) and a line of help.
from typing import Annotated, ClassVar

import numpy as np

import kalmark as km
from kalmark.declare import Positive


@km.register("sensor", "tape")
class Tape:
    """Position of a point, with a noise in each coordinate."""

    sigma_m: Annotated[Positive, "Noise of each coordinate."] = 0.05
    columns: ClassVar = ("x_m", "y_m")
    angular: ClassVar = (False, False)
    world: ClassVar = "plane"

    def expect(self, v):
        return v[:, :2], np.tile(np.eye(2, v.shape[1]), (len(v), 1, 1))

    def noise(self, y):
        return np.tile(self.sigma_m**2 * np.eye(2), (len(y), 1, 1))

    def invert(self, y):
        return y, np.tile(np.eye(2), (len(y), 1, 1))


print(Tape(sigma_m=0.1))

# %%
# Check it
# --------
#
# ``kalmark check my_sensors.py:Tape`` compares the Jacobians with differences and ``invert`` with ``expect``. The
# same from Python:
from kalmark.models.model_check import check_model

for finding in check_model(Tape(), np.random.default_rng(0)):
    print(finding)

# %%
# Try changing
# ------------
#
# * A worse clock: ``np.diag([1.0, 0.02]) ** 2``. The sigmas of landmark 1 grow from 0.013 m and 0.025 m to 0.069 m
#   and 0.033 m.
# * A wrong inverse, in ``Tape.invert``: ``return 2 * y, ...``. The error of ``expect(invert(y)) = y`` and that of its
#   Jacobian ``V_y`` are not zero any more.
# * A bound of a field: ``Tape(sigma_m=-0.1)`` is refused with the name, the value and what is expected.
