"""Robots and the mounts of their sensors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from kalmark.errors import ModelError
from kalmark.geometry.spaces import SE2
from kalmark.models.protocols import Landmark, Motion, Sensor
from kalmark.slam.checks import covariance, instance
from kalmark.slam.events import finite, shown

Array = npt.NDArray[np.float64]


def _pose(value: Any, what: str) -> Array:
    try:
        pose = finite(value, what, ModelError)
    except ModelError:
        pose = np.empty(0)
    if pose.shape != (3,):
        raise ModelError(f"{what} is {shown(value)}, expected three finite numbers: x and y in m, heading in rad")
    pose.flags.writeable = False
    return pose


@dataclass(frozen=True, eq=False)
class Mount:
    """A sensor and where it sits: `at` = (x, y, heading) in the robot's frame, m and rad.

    `landmark` is the type of landmark this sensor starts, if not the slam's.
    """

    sensor: Sensor
    at: Any = (0.0, 0.0, 0.0)
    landmark: Landmark | None = None

    def __post_init__(self) -> None:
        instance(self.sensor, Sensor, "Mount: sensor", "columns, angular, expect and noise")
        if self.landmark is not None:
            instance(self.landmark, Landmark, "Mount: landmark", "a landmark model")
        object.__setattr__(self, "at", _pose(self.at, "Mount: at"))


@dataclass(frozen=True, eq=False)
class Robot:
    """A robot: its motion model, its start (x, y, heading) with covariance `cov` (None: known exactly), its sensors."""

    name: str
    motion: Motion
    start: Any = (0.0, 0.0, 0.0)
    sensors: Mapping[str, Mount] = field(default_factory=dict)
    cov: Any = None

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not self.name:
            raise ModelError(f"Robot: name is {shown(self.name)}, expected a text that is not empty")
        what = f"robot {self.name!r}"
        instance(self.motion, Motion, f"{what}: motion", "a motion model")
        if self.motion.space != SE2:
            space = getattr(self.motion.space, "name", shown(self.motion.space))
            raise ModelError(f"{what}: motion is in {space}, expected SE2: other spaces are not available yet")
        object.__setattr__(self, "start", _pose(self.start, f"{what}: start"))
        object.__setattr__(self, "sensors", _mounts(self.sensors, what))
        if self.cov is not None:
            cov = covariance(self.cov, 3, f"{what}: cov", definite=False, error=ModelError)
            object.__setattr__(self, "cov", cov)


def _mounts(sensors: Any, what: str) -> dict[str, Mount]:
    """Return a copy of a robot's sensors, by name."""
    if not isinstance(sensors, Mapping):
        raise ModelError(f"{what}: sensors is {shown(sensors)}, expected a mapping of names to Mounts")
    for name, mount in sensors.items():
        if not isinstance(name, str) or not name:
            raise ModelError(f"{what}: the name of a sensor is {shown(name)}, expected a text that is not empty")
        if not isinstance(mount, Mount):
            raise ModelError(
                f"{what}: sensor {name!r} is {shown(mount)}, expected a Mount: Mount(sensor, at=(x, y, heading))"
            )
    return dict(sensors)
