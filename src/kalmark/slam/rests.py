"""Zero-velocity updates: detection of a standing robot from its controls and the readings of its sensors.

Windows of `window_s` follow each other.  In each the controls and the readings of gyroscopes, speeds, second odometries
and accelerometers are compared with those of a robot that stands:

* the deviations from their own means are noise: their sum of squares is a chi-square, below that of `pass_share`;
* the mean of each is zero but for sigma, its noise and the uncertainty of its bias: |mean| <= q sigma, q of that share;
* the most accurate one of a speed, and of a turn rate, refutes the slowest motion that counts: |mean| <= slowest - z
  sigma, so that a robot which moves or turns that fast all the time is taken to stand in at most `false_alarm` of the
  windows (z is the quantile of 1 - `false_alarm`).

The last is the test of equivalence of Schuirmann 1987; the first is the part of the detector of Skog, Handel, Nilsson
and Rantakokko 2010 (SHOE) that needs no orientation.  docs/state_sensors.md.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from statistics import NormalDist
from typing import Any, ClassVar, NamedTuple

import numpy as np

from kalmark.arrays import Array
from kalmark.errors import ModelError
from kalmark.events import Control, Event, Raw, Scan
from kalmark.geometry.gaussian import gate
from kalmark.models.protocols import CHANGE, POSE, TWIST, OfState, TimedNoise, coasts, measures_blocks
from kalmark.models.state_sensors import ZeroVelocity2D, ZeroVelocity3D
from kalmark.slam.held_control import control_covariance
from kalmark.slam.robot import Robot

ZERO = ZeroVelocity2D | ZeroVelocity3D
CONTROLS = ""  # the name of the source that a robot's controls are
CLOCK = 1e-6  # of a window, which stamps may be short of
ALONG = {"v_mps", "vx_mps", "speed_mps", "dx_m"}  # columns of a speed ahead, or of a way in that direction
ASIDE = {"vy_mps", "vz_mps", "dy_m", "dz_m"}
TURNS = {"w_radps", "wx_radps", "wy_radps", "wz_radps", "dtheta_rad", "rx_rad", "ry_rad", "rz_rad"}
SHAKEN = {"ax_mps2", "ay_mps2", "az_mps2"}  # their mean is gravity, in a direction that is not known
TINY = 1e-300  # a variance that is none
Constants = Callable[..., tuple[Array, Array] | None]  # of robot and sensor: its constants in the map, covariance


class WindowMean(NamedTuple):
    """Of a column in a window: mean, its sigma, squared deviations in sigmas, and how many of them are independent."""

    column: str
    mean: float
    sigma: float
    deviations: float
    free: int


@dataclass
class WatchedSensor:
    """The controls (`sensor` is None) or the readings of a sensor by `name`, of which the columns `at` are watched.

    `still` (1, 3 or 6) is the twist of a robot that stands.  With `per_s` columns are ways, to be divided by their
    times.  `readings` are those of this window: rates (c,) and their variances (c,).
    """

    name: str
    sensor: Any
    columns: tuple[str, ...]
    at: list[int]
    still: Array
    per_s: bool
    t_ns: int | None = None
    readings: list[tuple[Array, Array]] = field(default_factory=list)
    SAVED: ClassVar = ("t_ns", "readings")

    def take(self, t_ns: int, y: Array, R: Array | None) -> None:
        """Keep a control or reading y (m,) with the noise R (m, m), None for that of the sensor."""
        dt_s = 0.0 if self.t_ns is None else (t_ns - self.t_ns) * 1e-9
        self.t_ns = t_ns
        if self.per_s and dt_s <= 0.0:
            return
        if R is None:
            timed = isinstance(self.sensor, TimedNoise) and dt_s > 0.0
            R = self.sensor.noise_since(dt_s)[0] if timed else self.sensor.noise(y[None])[0]
        scale = 1.0 / dt_s if self.per_s else 1.0
        self.readings.append((y[self.at] * scale, np.diagonal(R)[self.at] * scale**2))

    def means(self, constants: Constants) -> list[WindowMean]:
        """Return the means of the readings of this window, less those expected of a robot that stands."""
        z, s2 = (np.array(column) for column in zip(*self.readings, strict=True))
        bias, variance = self._expected(constants)
        w = 1.0 / np.maximum(s2, TINY)
        mean, sigma2 = (w * z).sum(axis=0) / w.sum(axis=0), 1.0 / w.sum(axis=0)
        deviations, free = (w * (z - mean) ** 2).sum(axis=0), len(z) - 1
        rows = zip(self.columns, mean - bias, np.sqrt(sigma2 + variance), deviations, strict=True)
        return [WindowMean(column, float(m), float(s), float(d), free) for column, m, s, d in rows]

    def _expected(self, constants: Constants) -> tuple[Array, Array]:
        """Return what a robot that stands is expected to read (c,), by the sensor's constants, and the variances (c,).

        The expected reading of an accelerometer is not known then.
        """
        nothing, sensor = np.zeros(len(self.at)), self.sensor
        if sensor is None or sensor.views != TWIST:
            return nothing, nothing
        own = constants(self.name)
        if own is None:
            return sensor.expect(self.still)[0][0, self.at], nothing
        sensor = sensor.with_parameters(own[0])
        E_p = sensor.parameters_jacobian(self.still)[0][self.at]
        return sensor.expect(self.still)[0][0, self.at], np.einsum("ij,jk,ik->i", E_p, own[1], E_p)


def rest_detector(sensor: Any, robot: Robot) -> Standing | None:
    """Return the detector of rest of a `zero_velocity` sensor, None if it is another sensor.

    Raises ModelError if the robot has no input to it, or two such sensors.
    """
    if not isinstance(sensor, ZERO):
        return None
    if sum(isinstance(mount.sensor, ZERO) for mount in robot.sensors.values()) > 1:
        raise ModelError(f"robot {robot.name!r} has two {type(sensor).__name__}, expected one")
    return Standing(sensor, robot)


class Standing:
    """Detector of a robot that stands, window by window; `sensor` has the thresholds."""

    began_ns: int | None
    sources: dict[str, WatchedSensor]

    def __init__(self, sensor: Any, robot: Robot) -> None:
        self.sensor, self.robot, self.motion = sensor, robot.name, robot.motion
        self.sources = {source.name: source for source in sources_of(robot)}
        watched = {column for source in self.sources.values() for column in source.columns}
        if not (watched & ALONG and watched & TURNS):
            raise ModelError(
                f"robot {robot.name!r}: {type(sensor).__name__} has no input of speed and turn rate, expected controls "
                "or sensors, such as speed and gyro, with these"
            )
        self.began_ns = None
        normal = NormalDist()
        self._sure = normal.inv_cdf(1.0 - sensor.false_alarm)
        self._many = normal.inv_cdf(0.5 * (1.0 + sensor.pass_share))

    def take(self, event: Event, constants: Constants) -> bool | None:
        """Take an event of the robot; return whether it stood in the window that ends with it, None within one."""
        name = event.sensor if isinstance(event, Scan) else CONTROLS
        source = self.sources.get(name)
        if source is None or isinstance(event, Raw) or (isinstance(event, Scan) and not len(event.y)):
            return None
        if isinstance(event, Control):
            source.take(event.t_ns, event.u, control_covariance(self.motion, event))
        elif isinstance(event, Scan):
            plain = [k for k, name in enumerate(event.ids or (None,)) if name in (None, event.robot)]
            for k in plain:  # not what counts from an earlier scan
                cov = event.cov if event.cov is None or event.cov.ndim == 2 else event.cov[k]
                source.take(event.t_ns, event.y[k], cov)
        if self.began_ns is None:
            self.began_ns = event.t_ns
        if (event.t_ns - self.began_ns) * 1e-9 < self.sensor.window_s * (1.0 - CLOCK):
            return None
        stood = self.stood(constants)
        self.began_ns = event.t_ns
        for each in self.sources.values():
            each.readings = []
        return stood

    def stood(self, constants: Constants) -> bool:
        """Return whether the robot stood in this window; False if a source gave no reading."""
        if not all(source.readings for source in self.sources.values()):
            return False
        of = [source.means(partial(constants, self.robot)) for source in self.sources.values()]
        means = [mean for each in of for mean in each]
        deviations, free = sum(m.deviations for m in means), sum(m.free for m in means)
        if free and deviations > gate(self.sensor.pass_share, free):
            return False
        rates = [m for m in means if m.column not in SHAKEN]
        if any(abs(m.mean) > self._many * m.sigma for m in rates):
            return False
        turns = [[m for m in each if m.column in TURNS] for each in of]
        best = min((each for each in turns if each), key=lambda each: max(m.sigma for m in each))
        speed = min((m for m in rates if m.column in ALONG), key=lambda m: m.sigma)
        return self._refutes(speed, self.sensor.slowest_mps) and all(
            self._refutes(m, self.sensor.slowest_radps) for m in best
        )

    def _refutes(self, m: WindowMean, slowest: float) -> bool:
        """Return whether a mean refutes the slowest motion that counts."""
        return abs(m.mean) <= slowest - self._sure * m.sigma


def sources_of(robot: Robot) -> list[WatchedSensor]:
    """Return the inputs that show whether a robot stands: its controls, unless impulses, and its own sensors."""
    motion, plane = robot.motion, robot.motion.space.world == "plane"
    still, found = np.zeros((1, 3 if plane else 6)), list[tuple[str, Any, tuple[str, ...], bool]]()
    if not coasts(motion):
        found.append((CONTROLS, None, tuple(motion.columns), not motion.held))
    for name, mount in robot.sensors.items():
        own = mount.sensor
        if isinstance(own, OfState) and not isinstance(own, ZERO) and not measures_blocks(own):
            found.append((name, own, tuple(own.columns), own.views == CHANGE))
    sources = []
    for name, sensor, columns, per_s in found:
        used = SHAKEN if sensor is not None and sensor.views == POSE else ALONG | ASIDE | TURNS
        at = [i for i, column in enumerate(columns) if column in used]
        if at:
            sources.append(WatchedSensor(name, sensor, tuple(columns[i] for i in at), at, still, per_s))
    return sources
