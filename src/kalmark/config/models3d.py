"""Configuration of motion and sensors of space: the fields of `kalmark.models`, by the same names."""

from __future__ import annotations

import math
from typing import Annotated, Literal

from pydantic import Field, Tag

from kalmark.config.mounting import Ranging, SpaceMounted
from kalmark.config.sections import NotNegative, Number, Positive, Section
from kalmark.models.sensors_camera import FISHEYE, FISHEYE_BACK

Numbers = Annotated[tuple[Number, ...], Field(strict=False)]


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


class Velocity3DMotion(Section):
    """Velocity and turn rate in the robot's frame, each held until the next control."""

    type: Literal["velocity_3d"] = "velocity_3d"
    sigma_vx_mps: NotNegative = 0.1
    """Error of the velocity held over its interval, forward."""
    sigma_vy_mps: NotNegative = 0.1
    """Error of the velocity held over its interval, to the left."""
    sigma_vz_mps: NotNegative = 0.1
    """Error of the velocity held over its interval, upwards."""
    sigma_wx_radps: NotNegative = 0.05
    """Error of the turn rate held over its interval, about x."""
    sigma_wy_radps: NotNegative = 0.05
    """Error of the turn rate held over its interval, about y."""
    sigma_wz_radps: NotNegative = 0.05
    """Error of the turn rate held over its interval, about z."""
    sigma_v_bias_mps: NotNegative = 0.0
    """Constant part of the speed's error on each axis; above 0 it is in the map and is estimated."""
    sigma_w_bias_radps: NotNegative = 0.0
    """Constant part of the turn rate's error about each axis; above 0 it is in the map and is estimated."""


class ConstantVelocity3DMotion(Section):
    """Velocity and turn rate are in the state: it goes on as it goes, controls are changes of both, and needs none."""

    type: Literal["constant_velocity_3d"] = "constant_velocity_3d"
    sigma_v_mps: NotNegative = 0.01
    """Error of the change of velocity that a control is."""
    sigma_w_radps: NotNegative = 0.002
    """Error of the change of turn rate that a control is."""
    sigma_v_mps_per_sqrt_s: NotNegative = 0.0
    """Random walk of the velocity, all the time."""
    sigma_w_radps_per_sqrt_s: NotNegative = 0.0
    """Random walk of the turn rate, all the time."""


SpaceMotions = (
    Annotated[Odometry3DMotion, Tag("odometry_3d")]
    | Annotated[Velocity3DMotion, Tag("velocity_3d")]
    | Annotated[ConstantVelocity3DMotion, Tag("constant_velocity_3d")]
)


class _Cone(Ranging, SpaceMounted):
    fov_rad: Positive = 2 * math.pi
    """Field of view, a cone about the sensor's x axis."""


class RangeBearing3DSensor(_Cone):
    """Distance, azimuth and elevation of a landmark; x is forward, z up."""

    type: Literal["range_bearing_3d"] = "range_bearing_3d"
    sigma_range_m: NotNegative = 0.1
    """Noise of the range."""
    sigma_azimuth_rad: NotNegative = 0.02
    """Noise of the azimuth."""
    sigma_elevation_rad: NotNegative = 0.02
    """Noise of the elevation."""


class Position3DSensor(_Cone):
    """Position of a landmark in the sensor's frame; x is forward, z up."""

    type: Literal["position_3d"] = "position_3d"
    sigma_x_m: NotNegative = 0.1
    """Noise, along x."""
    sigma_y_m: NotNegative = 0.1
    """Noise, along y."""
    sigma_z_m: NotNegative = 0.1
    """Noise, along z."""


class _Camera(SpaceMounted):
    fx_px: Positive = 320.0
    """Focal length, across."""
    fy_px: Positive = 320.0
    """Focal length, down."""
    cx_px: Number = 320.0
    """Principal point, from the left."""
    cy_px: Number = 240.0
    """Principal point, from above."""
    width_px: Positive = 640
    """Width of the image."""
    height_px: Positive = 480
    """Height of the image."""


class _Lens(_Camera):
    lens: Literal["radial", "radtan", "equidistant"] = "radial"
    """What `distortion` means: `radial` d1 r^2 + d2 r^4 + ..., `radtan` k1 k2 p1 p2 k3, `equidistant` k1 to k4."""
    distortion: Numbers = ()
    """Coefficients of the lens; none for an ideal one."""
    sigma_px: NotNegative = 1.0
    """Noise of each pixel coordinate."""


class PinHoleSensor(_Lens):
    """A camera that sees points: pixels u, v."""

    type: Literal["pinhole"] = "pinhole"


class OmnidirectionalSensor(SpaceMounted):
    """Scaramuzza's camera with a wide view that sees points: pixels u, v."""

    type: Literal["omnidirectional"] = "omnidirectional"
    cx_px: Number = 640.0
    """Centre of the image, from the left."""
    cy_px: Number = 400.0
    """Centre of the image, from above."""
    c: Number = 1.0
    """Affine correction [c d; e 1] of the image."""
    d: Number = 0.0
    """Affine correction."""
    e: Number = 0.0
    """Affine correction."""
    projection: Numbers = FISHEYE
    """Polynomial from the ray's elevation to the distance from the centre, lowest power first."""
    back_projection: Numbers = FISHEYE_BACK
    """Polynomial from the distance from the centre to the ray's height, lowest power first."""
    width_px: Positive = 1280
    """Width of the image."""
    height_px: Positive = 800
    """Height of the image."""
    sigma_px: NotNegative = 1.0
    """Noise of each pixel coordinate."""


class StereoSensor(_Camera):
    """A rectified pair of cameras that sees points: u, v in the left image and u, v in the right one."""

    type: Literal["stereo"] = "stereo"
    baseline_m: Positive = 0.2
    """Distance of the right camera from the left one, whose frame is the sensor's."""
    sigma_ul_px: NotNegative = 1.0
    """Noise of the left u."""
    sigma_vl_px: NotNegative = 1.0
    """Noise of the left v."""
    sigma_ur_px: NotNegative = 1.0
    """Noise of the right u."""
    sigma_vr_px: NotNegative = 1.0
    """Noise of the right v."""


class SegmentsSensor(_Camera):
    """A camera that sees line segments: pixels of both ends, which lie anywhere on the line."""

    type: Literal["segments"] = "segments"
    sigma_px: NotNegative = 1.0
    """Noise of each pixel coordinate of an end."""
    min_length_px: NotNegative = 20.0
    """Shortest segment that counts as seen."""


class TagPoseSensor(SpaceMounted):
    """The poses of square tags in the sensor's frame."""

    type: Literal["tag_pose"] = "tag_pose"
    sigma_position_m: NotNegative = 0.02
    """Noise of each coordinate."""
    sigma_rotation_rad: NotNegative = 0.02
    """Noise of the rotation about each axis."""


class TagCornersSensor(_Lens):
    """A camera that sees square tags of known size: pixels of their four corners."""

    type: Literal["tag_corners"] = "tag_corners"


SpaceSensors = (
    Annotated[RangeBearing3DSensor, Tag("range_bearing_3d")]
    | Annotated[Position3DSensor, Tag("position_3d")]
    | Annotated[PinHoleSensor, Tag("pinhole")]
    | Annotated[OmnidirectionalSensor, Tag("omnidirectional")]
    | Annotated[StereoSensor, Tag("stereo")]
    | Annotated[SegmentsSensor, Tag("segments")]
    | Annotated[TagPoseSensor, Tag("tag_pose")]
    | Annotated[TagCornersSensor, Tag("tag_corners")]
)
