"""Robots and the mounts of their sensors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from kalmark.errors import ModelError
from kalmark.geometry.spaces import SE2, SE3
from kalmark.models.protocols import Landmark, Motion, Sensor
from kalmark.slam.checks import covariance, instance
from kalmark.slam.events import finite, shown

Array = npt.NDArray[np.float64]


IDENTITY = {3: (0.0, 0.0, 0.0), 7: (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)}
WANTED = {
    3: "three finite numbers: x and y in m, heading in rad",
    7: "seven finite numbers: x, y, z in m and a unit quaternion qx, qy, qz, qw",
}


def _pose(value: Any, what: str, sizes: tuple[int, ...]) -> Array:
    """Return a pose of one of the sizes 3 (plane) and 7 (space), its quaternion normalised."""
    try:
        pose = finite(value, what, ModelError)
    except ModelError:
        pose = np.empty(0)
    unit = pose.shape == (7,) and abs(np.linalg.norm(pose[3:]) - 1) < 1e-6
    if pose.ndim != 1 or len(pose) not in sizes or (len(pose) == 7 and not unit):
        raise ModelError(f"{what} is {shown(value)}, expected {' or '.join(WANTED[n] for n in sizes)}")
    if unit:
        pose[3:] /= np.linalg.norm(pose[3:])
    pose.flags.writeable = False
    return pose


@dataclass(frozen=True, eq=False)
class Mount:
    """A sensor and where it sits in the robot's frame: `at` = (x, y, heading), m and rad, or (x, y, z, qx, qy, qz, qw).

    `landmark` is the type of landmark this sensor starts, if not the slam's.
    """

    sensor: Sensor
    at: Any = (0.0, 0.0, 0.0)
    landmark: Landmark | None = None

    def __post_init__(self) -> None:
        instance(self.sensor, Sensor, "Mount: sensor", "columns, angular, expect and noise")
        if self.landmark is not None:
            instance(self.landmark, Landmark, "Mount: landmark", "a landmark model")
        object.__setattr__(self, "at", _pose(self.at, "Mount: at", (3, 7)))


@dataclass(frozen=True, eq=False)
class Robot:
    """A robot: its motion model, its start with covariance `cov` (None: known exactly), its sensors.

    `start` is (x, y, heading) in the plane and (x, y, z, qx, qy, qz, qw) in space, by default the origin.
    """

    name: str
    motion: Motion
    start: Any = None
    sensors: Mapping[str, Mount] = field(default_factory=dict)
    cov: Any = None

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not self.name:
            raise ModelError(f"Robot: name is {shown(self.name)}, expected a text that is not empty")
        what = f"robot {self.name!r}"
        instance(self.motion, Motion, f"{what}: motion", "a motion model")
        if self.motion.space not in (SE2, SE3):
            space = getattr(self.motion.space, "name", shown(self.motion.space))
            raise ModelError(f"{what}: motion is in {space}, expected SE2 or SE3: other spaces are not available yet")
        size, dof = self.motion.space.size, self.motion.space.dof
        start = IDENTITY[size] if self.start is None else self.start
        object.__setattr__(self, "start", _pose(start, f"{what}: start", (size,)))
        object.__setattr__(self, "sensors", _mounts(self.sensors, what, size))
        if self.cov is not None:
            cov = covariance(self.cov, dof, f"{what}: cov", definite=False, error=ModelError)
            object.__setattr__(self, "cov", cov)


def _mounts(sensors: Any, what: str, size: int) -> dict[str, Mount]:
    """Return a copy of a robot's sensors, by name; one at the robot's own origin is there in space too."""
    if not isinstance(sensors, Mapping):
        raise ModelError(f"{what}: sensors is {shown(sensors)}, expected a mapping of names to Mounts")
    for name, mount in sensors.items():
        if not isinstance(name, str) or not name:
            raise ModelError(f"{what}: the name of a sensor is {shown(name)}, expected a text that is not empty")
        if not isinstance(mount, Mount):
            raise ModelError(
                f"{what}: sensor {name!r} is {shown(mount)}, expected a Mount: Mount(sensor, at=(x, y, heading))"
            )
    mounts = {}
    for name, mount in sensors.items():
        if len(mount.at) != size and not mount.at.any():
            mount = replace(mount, at=IDENTITY[size])  # noqa: PLW2901
        if len(mount.at) != size:
            at = f"{what}: sensor {name!r} sits at {mount.at.tolist()}"
            raise ModelError(f"{at}, expected {WANTED[size]}")
        mounts[name] = mount
    return mounts
