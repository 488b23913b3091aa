"""Configuration of where robots start, and of what every sensor has: where it sits, and its own way through a scan."""

from __future__ import annotations

from typing import Annotated, ClassVar

from pydantic import Field

from kalmark.config.landmarks import Landmark
from kalmark.config.sections import NotNegative, Number, Reserved, Section

Count = Annotated[int, Field(ge=1)]

_SPACE_FOR_PLANE = "a key of space for a robot of the plane"
_PLANE_FOR_SPACE = "a key of the plane for a robot of space"
VELOCITY = ("vx_mps", "vy_mps", "vz_mps", "wx_radps", "wy_radps", "wz_radps", "sigma_v_mps", "sigma_w_radps")
POSE_OF_SPACE = ("z_m", "roll_deg", "pitch_deg", "yaw_deg", "sigma_position_m", "sigma_rotation_deg")


class MountConfig(Section):
    """Where a sensor sits, in the robot's frame."""

    elsewhere: ClassVar[dict[str, str]] = dict.fromkeys(POSE_OF_SPACE, _SPACE_FOR_PLANE)

    x_m: Number = 0.0
    """Forward of the robot's origin."""
    y_m: Number = 0.0
    """To the left of the robot's origin."""
    theta_rad: Number = 0.0
    """Turned to the left."""


class SpaceMountConfig(Section):
    """Where a sensor sits, in the robot's frame; turned by roll, then pitch, then yaw about the robot's axes.

    A camera looks along its own z axis, x to the right in its image and y down: one that looks ahead has roll -90 and
    yaw -90 deg.  If either sigma is above 0 the mount is in the map, and the filter calibrates it.
    """

    elsewhere: ClassVar[dict[str, str]] = {"theta_rad": _PLANE_FOR_SPACE}

    x_m: Number = 0.0
    """Forward of the robot's origin."""
    y_m: Number = 0.0
    """To the left of the robot's origin."""
    z_m: Number = 0.0
    """Above the robot's origin."""
    roll_deg: Number = 0.0
    """Turned about x."""
    pitch_deg: Number = 0.0
    """Turned about y."""
    yaw_deg: Number = 0.0
    """Turned about z."""
    sigma_position_m: NotNegative = 0.0
    """Standard deviation of each coordinate."""
    sigma_rotation_deg: NotNegative = 0.0
    """Standard deviation of the rotation about each axis."""


class StartConfig(Section):
    """Where a robot of the plane starts, and how surely."""

    elsewhere: ClassVar[dict[str, str]] = dict.fromkeys((*POSE_OF_SPACE, *VELOCITY), _SPACE_FOR_PLANE)

    x_m: Number = 0.0
    """Position."""
    y_m: Number = 0.0
    """Position."""
    theta_rad: Number = 0.0
    """Heading."""
    sigma_xy_m: NotNegative = 0.0
    """Standard deviation of each coordinate."""
    sigma_theta_rad: NotNegative = 0.0
    """Standard deviation of the heading."""


class SpaceStartConfig(Section):
    """Where a robot of space starts, and how surely; turned by roll, then pitch, then yaw about the world's axes."""

    elsewhere: ClassVar[dict[str, str]] = dict.fromkeys(
        ("theta_rad", "sigma_xy_m", "sigma_theta_rad"), _PLANE_FOR_SPACE
    )

    x_m: Number = 0.0
    """Position."""
    y_m: Number = 0.0
    """Position."""
    z_m: Number = 0.0
    """Position."""
    roll_deg: Number = 0.0
    """Turned about x."""
    pitch_deg: Number = 0.0
    """Turned about y."""
    yaw_deg: Number = 0.0
    """Turned about z."""
    sigma_position_m: NotNegative = 0.0
    """Standard deviation of each coordinate."""
    sigma_rotation_deg: NotNegative = 0.0
    """Standard deviation of the rotation about each axis."""
    vx_mps: Number = 0.0
    """constant_velocity_3d: velocity in the world."""
    vy_mps: Number = 0.0
    """constant_velocity_3d: velocity in the world."""
    vz_mps: Number = 0.0
    """constant_velocity_3d: velocity in the world."""
    wx_radps: Number = 0.0
    """constant_velocity_3d: rate about the robot's own x."""
    wy_radps: Number = 0.0
    """constant_velocity_3d: rate about the robot's own y."""
    wz_radps: Number = 0.0
    """constant_velocity_3d: rate about the robot's own z."""
    sigma_v_mps: NotNegative = 0.0
    """constant_velocity_3d: standard deviation of each velocity."""
    sigma_w_radps: NotNegative = 0.0
    """constant_velocity_3d: standard deviation of each rate."""


class Mounted(Section):
    """What every sensor has, whatever its type; and a `mount`, see below."""

    landmark: Landmark | None = None
    """Landmark type of this sensor; `landmarks` if absent."""
    association: Reserved = None
    """Reserved: an association of this sensor's own."""
    attention: Reserved = None
    """Reserved: which landmarks of a scan to take."""
    detector: Reserved = None
    """Reserved: how landmarks are found in raw data."""


class PlaneMounted(Mounted):
    """What every sensor of the plane has."""

    mount: MountConfig = MountConfig()
    """Where the sensor sits on the robot."""


class SpaceMounted(Mounted):
    """What every sensor of space has."""

    mount: SpaceMountConfig = SpaceMountConfig()
    """Where the sensor sits on the robot."""
