"""The cameras of a run: where they sit on their robots and what their images are; and what else calibrates itself."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np

from kalmark.errors import MapError
from kalmark.results.columns import Array
from kalmark.results.history import Biased, Camera, Mounted
from kalmark.slam.motion import bias_name

if TYPE_CHECKING:
    from kalmark.slam.slam import Slam


@runtime_checkable
class Imaging(Protocol):
    """A sensor whose pixels are of an image of known size."""

    width_px: float
    height_px: float


@runtime_checkable
class Focal(Protocol):
    """A camera with focal lengths and a principal point, in pixels."""

    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float


HALF_VIEW = 0.8  # tangent of half the angle that is drawn of a camera that has no focal length


def cameras(slam: Slam) -> tuple[Camera, ...]:
    """Return the sensors of a filter that measure pixels of an image of known size; mounts in the map as estimated."""
    return tuple(
        Camera(
            robot.name,
            name,
            mount_now(slam, robot.name, name, mount.at),
            _size(mount.sensor),
            columns,
            _corners(mount.sensor),
        )
        for robot in slam.robots.values()
        for name, mount in robot.sensors.items()
        if (columns := tuple(mount.sensor.columns))[0].endswith("_px") and isinstance(mount.sensor, Imaging)
    )


def mounts(slam: Slam) -> tuple[Mounted, ...]:
    """Return the mounts of the sensors that calibrate themselves, as estimated and as given."""
    found = []
    for robot in slam.robots.values():
        for sensor, mount in robot.sensors.items():
            name, block = f"{robot.name}.{sensor}", mount.block(sensor)
            if block is not None and _in_map(slam, name):
                found.append(Mounted(name, slam.mean(name), slam.covariance(name), block[2]))
    return tuple(found)


def biases(slam: Slam) -> tuple[Biased, ...]:
    """Return the biases of the robots' controls that are in the map, as estimated."""
    return tuple(
        Biased(robot.name, tuple(robot.motion.columns), slam.mean(name), slam.covariance(name))
        for robot in slam.robots.values()
        if _in_map(slam, name := bias_name(robot.name))
    )


def _in_map(slam: Slam, name: str) -> bool:
    try:
        slam.mean(name)
    except MapError:
        return False
    return True


def mount_now(slam: Slam, robot: str, sensor: str, at: Any) -> Array:
    """Return where a sensor sits on its robot: as given, or as estimated so far if its mount is in the map."""
    name = f"{robot}.{sensor}"
    return np.array(slam.mean(name)[: len(at)] if _in_map(slam, name) else at, dtype=np.float64)


def _size(sensor: Imaging) -> tuple[float, float]:
    return float(sensor.width_px), float(sensor.height_px)


def _corners(sensor: Imaging) -> Array:
    """Return the rays (4, 3), z = 1, to the corners of the image of a camera without distortion."""
    width, height = _size(sensor)
    u, v = np.array([0.0, width, width, 0.0]), np.array([0.0, 0.0, height, height])
    if not isinstance(sensor, Focal):
        across, down = u / width - 0.5, v / height - 0.5
        return np.column_stack([2 * HALF_VIEW * across, 2 * HALF_VIEW * down * height / width, np.ones(4)])
    return np.column_stack([(u - sensor.cx_px) / sensor.fx_px, (v - sensor.cy_px) / sensor.fy_px, np.ones(4)])
