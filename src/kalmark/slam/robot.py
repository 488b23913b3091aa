"""Robots and the mounts of their sensors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from kalmark.errors import ModelError
from kalmark.models.protocols import Landmark, Motion, Sensor
from kalmark.slam.checks import covariance

Array = npt.NDArray[np.float64]


def _pose(value: Any, what: str) -> Array:
    try:
        pose = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        pose = np.empty(0)
    if pose.shape != (3,) or not np.isfinite(pose).all():
        raise ModelError(f"{what} is {value!r}, expected three finite numbers: x and y in m, heading in rad")
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
        if not isinstance(self.sensor, Sensor):
            raise ModelError(f"Mount: sensor is {self.sensor!r}, expected columns, angular, expect and noise")
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
            raise ModelError(f"Robot: name is {self.name!r}, expected a text that is not empty")
        if not isinstance(self.motion, Motion):
            raise ModelError(f"robot {self.name!r}: motion is {self.motion!r}, expected a motion model")
        object.__setattr__(self, "start", _pose(self.start, f"robot {self.name!r}: start"))
        if self.cov is not None:
            cov = covariance(self.cov, 3, f"robot {self.name!r}: cov", definite=False)
            object.__setattr__(self, "cov", cov)
