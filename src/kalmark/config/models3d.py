"""Configuration of motion and sensors of space: the fields of `kalmark.models`, by the same names."""

from __future__ import annotations

import math
from typing import Annotated, Literal

from pydantic import Tag

from kalmark.config.mounting import SpaceMounted
from kalmark.config.sections import Limit, NotNegative, Positive, Section


class Odometry3DMotion(Section):
    """Increments dx, dy, dz and a rotation vector rx, ry, rz, in the robot's frame."""

    type: Literal["odometry_3d"] = "odometry_3d"
    sigma_x_m: NotNegative = 0.01
    """Error of one increment, forward."""
    sigma_y_m: NotNegative = 0.01
    """Error of one increment, to the left."""
    sigma_z_m: NotNegative = 0.01
    """Error of one increment, upwards."""
    sigma_rotation_rad: NotNegative = 0.005
    """Error of one increment, rotation about each axis."""


SpaceMotions = Annotated[Odometry3DMotion, Tag("odometry_3d")]


class _Ranging(SpaceMounted):
    range_min_m: NotNegative = 0.0
    """Nearest landmark the sensor sees."""
    range_max_m: Limit = math.inf
    """Farthest landmark the sensor sees."""
    fov_rad: Positive = 2 * math.pi
    """Field of view, a cone about the sensor's x axis."""


class RangeBearing3DSensor(_Ranging):
    """Distance, azimuth and elevation of a landmark."""

    type: Literal["range_bearing_3d"] = "range_bearing_3d"
    sigma_range_m: NotNegative = 0.1
    """Noise of the range."""
    sigma_azimuth_rad: NotNegative = 0.02
    """Noise of the azimuth."""
    sigma_elevation_rad: NotNegative = 0.02
    """Noise of the elevation."""


class Position3DSensor(_Ranging):
    """Position of a landmark in the sensor's frame."""

    type: Literal["position_3d"] = "position_3d"
    sigma_x_m: NotNegative = 0.1
    """Noise, along x."""
    sigma_y_m: NotNegative = 0.1
    """Noise, along y."""
    sigma_z_m: NotNegative = 0.1
    """Noise, along z."""


SpaceSensors = (
    Annotated[RangeBearing3DSensor, Tag("range_bearing_3d")] | Annotated[Position3DSensor, Tag("position_3d")]
)
