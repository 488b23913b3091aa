"""Configuration of where robots start, and of what every sensor has: where it sits, and its own way through a scan."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal

import numpy as np
import numpy.typing as npt
from pydantic import Field, model_validator

from kalmark.config.choices import BASES, Choice, ModelSection, section_of
from kalmark.config.sections import NotNegative, Number, Section, Sigmas, expected
from kalmark.declare import register
from kalmark.geometry.rotations import from_euler

Array = npt.NDArray[np.float64]

Landmark = Annotated[Any, Choice("landmark", default="point")]
Association = Annotated[Any, Choice("association", default="identity")]
Initialization = Annotated[Any, Choice("initialization", default="immediate")]
Detector = Annotated[Any, Choice("detector")]
Attention = Annotated[Any, Choice("attention", typed=False)]
Upkeep = Annotated[Any, Choice("upkeep", typed=False)]

Plugins = Annotated[tuple[str, ...], Field(strict=False)]

_UNITS = {"range": "m", "bearing": "rad"}
_SPACE_FOR_PLANE = "a key of space for a robot of the plane"
_PLANE_FOR_SPACE = "a key of the plane for a robot of space"
VELOCITY = ("vx_mps", "vy_mps", "vz_mps", "wx_radps", "wy_radps", "wz_radps", "sigma_v_mps", "sigma_w_radps")
POSE_OF_PLANE = ("theta_rad", "sigma_xy_m", "sigma_theta_rad")
POSE_OF_SPACE = ("z_m", "roll_deg", "pitch_deg", "yaw_deg", "sigma_position_m", "sigma_rotation_deg")


class PlanePose(Section):
    """A pose in the plane, and how sure it is."""

    x_m: Number = 0.0
    """Position along x: forward."""
    y_m: Number = 0.0
    """Position along y: to the left."""
    theta_rad: Number = 0.0
    """Turned to the left, from x."""
    sigma_xy_m: NotNegative = 0.0
    """Standard deviation of each coordinate."""
    sigma_theta_rad: NotNegative = 0.0
    """Standard deviation of the angle."""


class SpacePose(Section):
    """A pose in space, and how sure it is; turned by roll, then pitch, then yaw about the fixed axes."""

    elsewhere: ClassVar[dict[str, str]] = dict.fromkeys(POSE_OF_PLANE, _PLANE_FOR_SPACE)

    x_m: Number = 0.0
    """Position along x: forward."""
    y_m: Number = 0.0
    """Position along y: to the left."""
    z_m: Number = 0.0
    """Position along z: upwards."""
    roll_deg: Number = 0.0
    """Turned about x."""
    pitch_deg: Number = 0.0
    """Turned about y."""
    yaw_deg: Number = 0.0
    """Turned about z."""
    sigma_position_m: Sigmas = 0.0
    """Standard deviation of each coordinate; or a list of three."""
    sigma_rotation_deg: Sigmas = 0.0
    """Standard deviation of the rotation about each axis; or a list of three."""


class MountConfig(PlanePose):
    """Where a sensor sits, in the robot's frame.  If either sigma is above 0, the mount is calibrated as below."""

    elsewhere: ClassVar[dict[str, str]] = dict.fromkeys(POSE_OF_SPACE, _SPACE_FOR_PLANE)


class SpaceMountConfig(SpacePose):
    """Where a sensor sits, in the robot's frame; turned by roll, then pitch, then yaw about the robot's axes.

    A camera looks along its own z axis, x to the right in its image and y down: one that looks ahead has roll -90 and
    yaw -90 deg.  If either sigma is above 0 the mount is in the map, and the filter calibrates it.
    """


class StartConfig(PlanePose):
    """Where a robot of the plane starts, and how surely."""

    elsewhere: ClassVar[dict[str, str]] = dict.fromkeys((*POSE_OF_SPACE, *VELOCITY), _SPACE_FOR_PLANE)


class SpaceStartConfig(SpacePose):
    """Where a robot of space starts, and how surely; turned by roll, then pitch, then yaw about the world's axes."""

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
    sigma_v_mps: Sigmas = 0.0
    """constant_velocity_3d: standard deviation of each velocity; or a list of three."""
    sigma_w_radps: Sigmas = 0.0
    """constant_velocity_3d: standard deviation of each rate; or a list of three."""


@register("initialization", "immediate")
class Immediate:
    """Start landmarks at first sight; of bearings alone with an unknown depth, `landmark: {type: inverse_depth}`.

    Ranges alone, which cannot, start them by `trilateration`.
    """


class Mounted(ModelSection):
    """What every sensor has, whatever its type; and a `mount`, see below."""

    landmark: Landmark | None = None
    """Landmark type of this sensor; `landmarks` if absent.  A camera whose mount is calibrated wants anchored ones."""
    association: Association | None = None
    """Association of this sensor; the configuration's `association` if absent."""
    attention: Attention | None = None
    """Which landmarks of a scan to take; all if absent."""
    upkeep: Upkeep | None = None
    """What makes a landmark; the configuration's `upkeep` if absent."""
    detector: Detector | None = None
    """How landmarks are found in raw scans: one that finds what the sensor measures."""


class PlaneMounted(Mounted):
    """What every sensor of the plane has."""

    initialization: Initialization = section_of("initialization", "immediate")()
    """Start landmarks at first sight, or late; late ones are points."""
    mount: MountConfig = MountConfig()
    """Where the sensor sits on the robot."""
    preset: Literal["laser", "sonar", "camera", "rgbd", "arva", "rfid"] | None = None
    """Take what is not given from a documented sensor: camera for bearing, arva for range, others for range_bearing."""

    @model_validator(mode="before")
    @classmethod
    def _take_from_preset(cls, value: Any) -> Any:
        from kalmark import presets

        if not isinstance(value, dict) or str(value.get("preset")) not in presets.ALL:
            return value
        sensor = presets.ALL[value["preset"]].sensor
        measured = [part for part, unit in _UNITS.items() if f"{part}_{unit}" in sensor.columns]
        fits = all((f"sigma_{part}_{unit}" in cls.model_fields) == (part in measured) for part, unit in _UNITS.items())
        if not fits:
            raise expected(f"a preset of this type of sensor: {value['preset']} is a {'_'.join(measured)}", "preset")
        return vars(sensor) | value


class SpaceMounted(Mounted):
    """What every sensor of space has."""

    mount: SpaceMountConfig = SpaceMountConfig()
    """Where the sensor sits on the robot."""


BASES |= {("sensor", "plane"): PlaneMounted, ("sensor", "space"): SpaceMounted}
PlaneSensor = Annotated[Any, Choice("sensor", "plane")]
SpaceSensor = Annotated[Any, Choice("sensor", "space")]


def pose_of(section: PlanePose | SpacePose) -> Array:
    """Return the pose that a mount or a start describes: (3,) in the plane, (7,) in space."""
    if isinstance(section, PlanePose):
        return np.array([section.x_m, section.y_m, section.theta_rad])
    q, _ = from_euler(np.radians([section.roll_deg, section.pitch_deg, section.yaw_deg]))
    return np.array([section.x_m, section.y_m, section.z_m, *q])


def velocity_of(section: SpaceStartConfig) -> Array:
    """Return the velocity in the world and the body rate (6,) at a start."""
    s = section
    return np.array([s.vx_mps, s.vy_mps, s.vz_mps, s.wx_radps, s.wy_radps, s.wz_radps])


def covariance_of(section: PlanePose | SpacePose, dof: int) -> Array | None:
    """Return the covariance (dof, dof) of a mount or a start, None if it is known exactly."""
    if isinstance(section, PlanePose):
        sigmas = [section.sigma_xy_m, section.sigma_xy_m, section.sigma_theta_rad]
    else:
        sigmas = [*_three(section.sigma_position_m), *np.radians(_three(section.sigma_rotation_deg))]
    if isinstance(section, SpaceStartConfig):
        sigmas += [*_three(section.sigma_v_mps), *_three(section.sigma_w_radps)]
    return np.diag(np.square(sigmas[:dof])) if any(sigmas[:dof]) else None


def _three(sigma: float | tuple[float, ...]) -> Array:
    return np.broadcast_to(np.asarray(sigma, dtype=np.float64), 3)
