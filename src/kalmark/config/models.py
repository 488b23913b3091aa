"""Configuration of motion and sensors: the fields of `kalmark.models`, by the same names; those of the plane here."""

from __future__ import annotations

import math
from dataclasses import fields
from typing import Annotated, Any, Literal

from pydantic import Discriminator, Tag, model_validator

from kalmark.config.detectors import Detector
from kalmark.config.models3d import SpaceMotions, SpaceSensors
from kalmark.config.mounting import PlaneMounted, Ranging
from kalmark.config.sections import NotNegative, Number, Positive, Section, expected, type_or, types


class _Diffusion(Section):
    sigma_along_m_per_sqrt_s: NotNegative = 0.0
    """Random walk along the heading, while it moves."""
    sigma_across_m_per_sqrt_s: NotNegative = 0.0
    """Random walk across the heading, while it moves."""
    sigma_theta_rad_per_sqrt_s: NotNegative = 0.0
    """Random walk of the heading, while it moves."""


class UnicycleMotion(_Diffusion):
    """Speed and turn rate, each held until the next control."""

    type: Literal["unicycle"] = "unicycle"
    sigma_v_mps: NotNegative = 0.1
    """Error of the speed held over its interval."""
    sigma_w_radps: NotNegative = 0.05
    """Error of the turn rate held over its interval."""
    sigma_v_bias_mps: NotNegative = 0.0
    """Constant part of the speed's error; above 0 it is in the map and is estimated."""
    sigma_w_bias_radps: NotNegative = 0.0
    """Constant part of the turn rate's error; above 0 it is in the map and is estimated."""


class Odometry2DMotion(_Diffusion):
    """Increments dx, dy, dtheta in the robot's frame."""

    type: Literal["odometry_2d"] = "odometry_2d"
    sigma_x_m: NotNegative = 0.01
    """Error of one increment, forward."""
    sigma_y_m: NotNegative = 0.0
    """Error of one increment, to the left."""
    sigma_theta_rad: NotNegative = 0.02
    """Error of one increment, heading."""


class AckermannMotion(_Diffusion):
    """A car: wheel speed and steering angle, each held until the next control."""

    type: Literal["ackermann"] = "ackermann"
    wheelbase_m: Positive = 2.83
    """Distance between the axles."""
    encoder_offset_m: NotNegative = 0.76
    """Wheel encoder, left of the middle of the rear axle."""
    sigma_v_mps: NotNegative = 0.1
    """Error of the wheel speed held over its interval."""
    sigma_steering_rad: NotNegative = 0.02
    """Error of the steering angle held over its interval."""
    sigma_v_bias_mps: NotNegative = 0.0
    """Constant part of the wheel speed's error; above 0 it is in the map and is estimated."""
    sigma_steering_bias_rad: NotNegative = 0.0
    """Constant part of the steering angle's error; above 0 it is in the map and is estimated."""


PlaneMotions = (
    Annotated[UnicycleMotion, Tag("unicycle")]
    | Annotated[Odometry2DMotion, Tag("odometry_2d")]
    | Annotated[AckermannMotion, Tag("ackermann")]
)
Motion = Annotated[PlaneMotions | SpaceMotions, Discriminator(type_or())]
_IN_SPACE = set(types(Motion)).difference(types(Annotated[PlaneMotions, None]))
_UNITS = {"range": "m", "bearing": "rad"}


class _Sector(Ranging, PlaneMounted):
    fov_rad: Positive = 2 * math.pi
    """Field of view, centred forward."""
    preset: Literal["laser", "sonar", "camera", "rgbd", "arva", "rfid"] | None = None
    """Take what is not given from a documented sensor: camera for bearing, arva for range, others for range_bearing."""

    @model_validator(mode="before")
    @classmethod
    def _take_from_preset(cls, value: Any) -> Any:
        from kalmark import presets

        if not isinstance(value, dict) or str(value.get("preset")) not in presets.ALL:
            return value
        sensor = presets.ALL[value["preset"]].sensor
        own = {f.name: getattr(sensor, f.name) for f in fields(sensor)}
        measured = [part for part in ("range", "bearing") if f"{part}_{_UNITS[part]}" in sensor.columns]
        fits = all((f"sigma_{part}_{unit}" in cls.model_fields) == (part in measured) for part, unit in _UNITS.items())
        if not fits:
            raise expected(f"a preset of this type of sensor: {value['preset']} is a {'_'.join(measured)}", "preset")
        return own | value


class _Range(_Sector):
    sigma_range_m: NotNegative = 0.1
    """Constant part a of the range noise sqrt(a^2 + (b r)^2)."""
    sigma_range_rel: NotNegative = 0.0
    """Part b of the range noise, growing with range."""
    scale: Positive = 1.0
    """Measured range per metre of distance."""
    bias_m: Number = 0.0
    """Added to every range."""
    sigma_scale: NotNegative = 0.0
    """Standard deviation of the scale; above 0 it is in the map and is estimated."""
    sigma_bias_m: NotNegative = 0.0
    """Standard deviation of the bias; above 0 it is in the map and is estimated."""


class RangeSensor(_Range):
    """Distance to a landmark."""

    type: Literal["range"] = "range"


class RangeBearingSensor(_Range):
    """Distance and direction of a landmark."""

    type: Literal["range_bearing"] = "range_bearing"
    detector: Detector | None = None
    sigma_bearing_rad: NotNegative = 0.02
    """Noise of the bearing."""


class RangeBearingSignatureSensor(_Range):
    """Distance, direction and signature of a landmark."""

    type: Literal["range_bearing_signature"] = "range_bearing_signature"
    detector: Detector | None = None
    sigma_bearing_rad: NotNegative = 0.02
    """Noise of the bearing."""
    sigma_signature: NotNegative = 0.1
    """Noise of the signature."""


class BearingSensor(_Sector):
    """Direction of a landmark."""

    type: Literal["bearing"] = "bearing"
    sigma_bearing_rad: NotNegative = 0.02
    """Noise of the bearing."""


class PositionSensor(_Sector):
    """Position of a landmark in the sensor's frame."""

    type: Literal["position"] = "position"
    sigma_x_m: NotNegative = 0.1
    """Noise, forward."""
    sigma_y_m: NotNegative = 0.1
    """Noise, to the left."""


PlaneSensors = (
    Annotated[RangeBearingSensor, Tag("range_bearing")]
    | Annotated[BearingSensor, Tag("bearing")]
    | Annotated[RangeSensor, Tag("range")]
    | Annotated[PositionSensor, Tag("position")]
    | Annotated[RangeBearingSignatureSensor, Tag("range_bearing_signature")]
)
PlaneSensor = Annotated[PlaneSensors, Discriminator(type_or())]
SpaceSensor = Annotated[SpaceSensors, Discriminator(type_or())]
Sensor = Annotated[PlaneSensors | SpaceSensors, Discriminator(type_or())]


def world_of(robot: Any) -> str:
    """Return where a robot (a section, or the mapping it is made from) moves by its motion: "(plane)" or "(space)"."""
    motion = robot.get("motion") if isinstance(robot, dict) else getattr(robot, "motion", None)
    kind = motion.get("type") if isinstance(motion, dict) else getattr(motion, "type", None)
    return "(space)" if isinstance(kind, str) and kind in _IN_SPACE else "(plane)"
