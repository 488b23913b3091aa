"""What the tests of the logs of space share: opened logs, their events, and points in the frame of a sensor."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from kalmark.events import Control, Scan
from kalmark.logs import Log, open_log

Data = Callable[[str], Path]


@cache
def opened(path: Path, **options: object) -> Log:
    """Open a log once for all tests here, which only read it."""
    return open_log(path, **options)


def controls(log: Log) -> list[Control]:
    return [event for event in log if isinstance(event, Control)]


def scans(log: Log, sensor: str | None = None) -> list[Scan]:
    return [event for event in log if isinstance(event, Scan) and sensor in (None, event.sensor)]


def pose_of(section: dict[str, Any]) -> tuple[Rotation, np.ndarray]:
    """Return rotation and position of a mount or start as configurations give them."""
    angles = [section[name] for name in ("yaw_deg", "pitch_deg", "roll_deg")]
    return Rotation.from_euler("ZYX", angles, degrees=True), np.array([section[n] for n in ("x_m", "y_m", "z_m")])


def in_sensor(points: np.ndarray, pose: np.ndarray, mount: dict[str, Any]) -> np.ndarray:
    """Return world points (K, 3) in the frame of a sensor mounted on a robot at this pose (7,)."""
    turn, place = pose_of(mount)
    return turn.inv().apply(Rotation.from_quat(pose[3:]).inv().apply(points - pose[:3]) - place)
