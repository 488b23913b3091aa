"""Configuration of where robots start, and of what every sensor has: where it sits, and its own way through a scan."""

from __future__ import annotations

import math
from typing import Annotated, ClassVar, Literal

from pydantic import Discriminator, Field, Tag, model_validator

from kalmark.config.landmarks import Association, HypothesesConfig, Landmark, TrilaterationConfig
from kalmark.config.sections import (
    Limit,
    NotNegative,
    Number,
    Positive,
    Probability,
    Reserved,
    Section,
    Sigmas,
    expected,
    type_or,
)

Most = Annotated[int, Field(ge=0)] | None
Count = Annotated[int, Field(ge=1)]

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


class AttentionConfig(Section):
    """Which landmarks of a scan are corrected, where new ones are taken, and when one is given up."""

    updates: Most = None
    """At most so many landmarks corrected a scan, those of most expected information first; all if absent."""
    sequential: bool = False
    """Correct one landmark after the other, not all of a scan jointly."""
    starts: Most = None
    """At most so many new landmarks a scan; all if absent."""
    first_starts: Most = None
    """The same while the map is empty; `starts` if absent."""
    grid: Annotated[tuple[Count, Count], Field(strict=False)] = (1, 1)
    """New landmarks are spread over so many columns and rows of the image."""
    margin_px: NotNegative = 0.0
    """No new landmark nearer to the image's border than this."""
    searches: Annotated[int, Field(ge=0)] = 10
    """With `delete`: how often a landmark was expected before it may be given up."""
    match_ratio: Annotated[float, Field(ge=0, le=1)] = 0.1
    """With `delete`: give it up if it was found in less than this share of them."""
    inlier_ratio: Annotated[float, Field(ge=0, le=1)] = 0.5
    """With `delete`: give it up if less than this share of what was found passed the gate."""
    delete: bool = False
    """Give up landmarks that are not found again."""


class UpkeepConfig(Section):
    """What makes a landmark of sightings without an id: docs/association.md."""

    confirm: Count = 3
    """A tentative landmark becomes one when it was seen so often; 1: at its first sighting."""
    within: Count = 10
    """It is dropped if that did not happen in so many scans in which it was in view."""
    keep_poses: Annotated[int, Field(ge=0)] = 0
    """Its sightings are kept with so many past poses, and fused when it is one; 0: they are not used."""
    merge: bool = True
    """Merge landmarks that turn out to be one."""
    hold_back: bool = False
    """Hold back what is not beyond doubt (`nearest`, `global`, `jcbb`) or of a lost robot (`auto`); map it anew."""
    odds: Annotated[float, Field(ge=1, allow_inf_nan=False)] = 100.0
    """So many times likelier than chance is beyond doubt."""
    p_detect: Probability | None = None
    """How often one in view is seen; with it, those that are not seen again and again are removed."""
    p_false: Probability = 0.05
    """How often something else is taken for a landmark that is gone."""

    @model_validator(mode="after")
    def _can_be(self) -> UpkeepConfig:
        if self.within < self.confirm:
            raise expected(f"at least confirm, {self.confirm}", "within")
        if self.p_detect is not None and self.p_detect <= self.p_false:
            raise expected(f"more than p_false, {self.p_false}", "p_detect")
        return self


class Mounted(Section):
    """What every sensor has, whatever its type; and a `mount`, see below."""

    landmark: Landmark | None = None
    """Landmark type of this sensor; `landmarks` if absent.  A camera whose mount is calibrated wants anchored ones."""
    association: Association | None = None
    """Association of this sensor; the configuration's `association` if absent."""
    attention: AttentionConfig | None = None
    """Which landmarks of a scan to take; all if absent."""
    upkeep: UpkeepConfig | None = None
    """What makes a landmark; the configuration's `upkeep` if absent."""
    detector: Reserved = None
    """How landmarks are found in raw scans: for `range_bearing` and `range_bearing_signature`, else reserved."""


class ImmediateInitialization(Section):
    """Start landmarks at first sight; of bearings alone with an unknown depth, `landmark: {type: inverse_depth}`.

    Ranges alone, which cannot, start them by `trilateration`.
    """

    type: Literal["immediate"] = "immediate"


class DelayedInitialization(Section):
    """Start landmarks when intersections of past measurements have persisted: docs/bearing_only.md."""

    type: Literal["delayed"] = "delayed"
    persistence: Count = 4
    """Intersections that must have been merged into one."""
    distance: Positive = 3.0
    """Bhattacharyya distance up to which two Gaussians are of one landmark."""
    spacing_m: Positive = 0.5
    """Poses are kept every so many m of the way."""
    poses: Annotated[int, Field(ge=3)] = 20
    """So many of them, the last ones."""
    precision: Positive = 0.1
    """A landmark starts when its sigma is below this part of its distance."""
    patience: Count = 3
    """A candidate is dropped when it was in view and not seen at so many kept poses in a row."""
    candidates: Count = 200
    """At most so many candidates, the most persistent ones."""


Initialization = Annotated[
    Annotated[ImmediateInitialization, Tag("immediate")]
    | Annotated[DelayedInitialization, Tag("delayed")]
    | Annotated[TrilaterationConfig, Tag("trilateration")]
    | Annotated[HypothesesConfig, Tag("hypotheses")],
    Discriminator(type_or("immediate")),
]


class PlaneMounted(Mounted):
    """What every sensor of the plane has."""

    initialization: Initialization = ImmediateInitialization()
    """Start landmarks at first sight, or late; late ones are points."""

    mount: MountConfig = MountConfig()
    """Where the sensor sits on the robot."""


class SpaceMounted(Mounted):
    """What every sensor of space has."""

    mount: SpaceMountConfig = SpaceMountConfig()
    """Where the sensor sits on the robot."""


class Ranging(Section):
    """How far a sensor sees, in the plane and in space."""

    range_min_m: NotNegative = 0.0
    """Nearest landmark the sensor sees."""
    range_max_m: Limit = math.inf
    """Farthest landmark the sensor sees."""
