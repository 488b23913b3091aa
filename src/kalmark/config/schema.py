"""`Config`: everything that decides a run, each key with its default, in one frozen model."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from pydantic import ConfigDict, Discriminator, Field, PrivateAttr, Tag, create_model, model_validator

from kalmark.config.sections import (
    BASES,
    Choice,
    LandmarkId,
    ModelSection,
    Numbers,
    RobotName,
    Section,
    Sigmas,
    annotation,
    model_of,
    options_section,
    unexpected_value,
    unknown_key,
)
from kalmark.config.tree import OVERRIDE, KeyPath, name_of, place_around
from kalmark.declare import NotNegative, Number, classes, declared_options, register, registered_name
from kalmark.errors import ConfigError
from kalmark.geometry.named_poses import world_of
from kalmark.logs import known_formats
from kalmark.logs.formats import OPTIONS
from kalmark.logs.source import Format
from kalmark.models.protocols import state_columns
from kalmark.picture_options import Picture as PictureOptions
from kalmark.slam.description import STATES, sigma_of, state_names
from kalmark.slam.robot import Mount, Robot
from kalmark.slam.state import Settings

Picture = Annotated[Any, Choice(registered_name(PictureOptions) or "")]  # it is registered by its import

Plugins = Annotated[KeyPath, Field(strict=False)]
Covariance = Annotated[tuple[Numbers, ...], Field(strict=False)]

_SPACE_FOR_PLANE = "a key of space for a robot of the plane"
_PLANE_FOR_SPACE = "a key of the plane for a robot of space"
POSE_OF_PLANE = ("theta_rad", "sigma_xy_m", "sigma_theta_rad")
POSE_OF_SPACE = ("z_m", "roll_deg", "pitch_deg", "yaw_deg", "sigma_position_m", "sigma_rotation_deg", "quaternion")


class _Place(Section):
    x_m: Number = 0.0
    """Position along x: forward."""
    y_m: Number = 0.0
    """Position along y: to the left."""
    cov: Covariance | None = None
    """The covariance, row by row, where it is more than sigmas: position, rotation, what a state has behind them."""


class PlanePose(_Place):
    """A pose in the plane, and its uncertainty."""

    theta_rad: Number = 0.0
    """Turned to the left, from x."""
    sigma_xy_m: NotNegative = 0.0
    """Standard deviation of each coordinate."""
    sigma_theta_rad: NotNegative = 0.0
    """Standard deviation of the angle."""


class SpacePose(_Place):
    """A pose in space, and its uncertainty; turned by roll, then pitch, then yaw about the fixed axes."""

    elsewhere: ClassVar[dict[str, str]] = dict.fromkeys(POSE_OF_PLANE, _PLANE_FOR_SPACE)

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
    quaternion: Numbers | None = None
    """The rotation to the last digit: [qx, qy, qz, qw]."""


class MountConfig(PlanePose):
    """Pose of a sensor in the robot's frame.  If either sigma is above 0, the mount is calibrated as below."""

    elsewhere: ClassVar[dict[str, str]] = dict.fromkeys(POSE_OF_SPACE[1:], _SPACE_FOR_PLANE)

    z_m: Number = 0.0
    """Height above the plane of the map, of what measures distances: range, signal_strength, range_difference."""


class SpaceMountConfig(SpacePose):
    """Pose of a sensor in the robot's frame; turned by roll, then pitch, then yaw about the robot's axes.

    The optical axis of a camera is its z axis, x to the right in its image and y down: one pointing ahead has roll -90
    and yaw -90 deg.  If either sigma is above 0 the mount is in the map, and the filter calibrates it.
    """


def _with_state(base: type[Section], world: str, sigma: Any, each: str) -> Any:
    """Return a section with the keys of what a state has behind its pose; `sigma` and `each` are of their sigmas."""
    keys, sigmas = dict[str, Any](), dict[str, Any]()
    for name, text in STATES[world].items():
        keys[name] = Number, Field(0.0, description=text)
        sigmas[sigma_of(name)[0]] = sigma, Field(0.0, description=each)
    text = "Components of the state after its pose, of a motion of your own with other names than these."
    return create_model("Start", __base__=base, **keys, **sigmas, state=(Numbers | None, Field(None, description=text)))


OF_PLANE: Any = _with_state(PlanePose, "plane", NotNegative, "Standard deviation of each such component.")
OF_SPACE: Any = _with_state(
    SpacePose, "space", Sigmas, "Standard deviation of each such component; or a list of three."
)


class StartConfig(OF_PLANE):  # type: ignore[misc]
    """Start of a robot of the plane, and its sigmas."""

    elsewhere: ClassVar[dict[str, str]] = dict.fromkeys((*POSE_OF_SPACE, *[*STATES["space"]][2:]), _SPACE_FOR_PLANE)


class SpaceStartConfig(OF_SPACE):  # type: ignore[misc]
    """Start of a robot of space, and its sigmas; turned by roll, then pitch, then yaw about the world's axes."""

    at_rest: bool = False
    """inertial: roll, pitch (or the gravity) and the bias of the rate are found from the log, which begins at rest."""


@register("initialization", "immediate")
class Immediate:
    """Start landmarks at first sight; of bearings alone with an unknown depth, `landmark: {type: inverse_depth}`.

    Ranges alone, which cannot, start them by `trilateration`.
    """


Preset = Literal[
    "laser", "sonar", "camera", "rgbd", "arva", "rfid", "laser_scanner", "mems_imu", "rtk_receiver", "wheel_encoder"
]


OF_SENSOR: Any = options_section(declared_options(Mount), ModelSection, attention=None, initialization="immediate")


class Mounted(OF_SENSOR):  # type: ignore[misc]
    """Keys of every sensor of any type; and a `mount`, see below."""

    preset: Preset | None = None
    """Take what is not given from a documented sensor of this type: docs/presets.md."""

    @model_validator(mode="before")
    @classmethod
    def _take_from_preset(cls, value: Any) -> Any:
        from kalmark import presets

        if not isinstance(value, dict) or str(value.get("preset")) not in presets.ALL:
            return value
        preset = presets.ALL[value["preset"]]
        if cls.of_name != (name := registered_name(type(preset.sensor))):
            raise unexpected_value(f"a preset of this type of sensor: {value['preset']} is a {name}", "preset")
        sensor = preset.in_space or preset.sensor
        of_it = {key: getattr(sensor, key) for key in preset.sources if key in cls.model_fields}
        return of_it | value


class PlaneMounted(Mounted):
    """Keys of every sensor of the plane."""

    mount: MountConfig = MountConfig()
    """Pose of the sensor in the robot frame."""

    @property
    def height_m(self) -> float:
        """That of the mount, the parameter `height_m` of a sensor of distances."""
        return self.mount.z_m


class SpaceMounted(Mounted):
    """Keys of every sensor of space."""

    mount: SpaceMountConfig = SpaceMountConfig()
    """Pose of the sensor in the robot frame."""


BASES |= {("sensor", "plane"): PlaneMounted, ("sensor", "space"): SpaceMounted}
PlaneSensor = Annotated[Any, Choice("sensor", "plane")]
SpaceSensor = Annotated[Any, Choice("sensor", "space")]


def refuse_odd_start(motion: Any, start: StartConfig | SpaceStartConfig) -> None:
    """Refuse values of a start for a state that its motion does not have.  Raises ValueError."""
    world = world_of(vars(start))
    states, has = STATES[world], state_names(state_columns(model_of(motion)), world)
    allowed = {*has, *(sigma_of(name)[0] for name in has)}
    if isinstance(start, SpaceStartConfig) and start.at_rest:
        if "bias_ax_mps2" not in has:
            raise unexpected_value(f"false: {motion.type} has no inertial unit", "start", "at_rest")
        if not np.all(start.sigma_bias_a_mps2):
            what = "a positive number: at rest a bias is taken for a tilt"
            raise unexpected_value(what, "start", "sigma_bias_a_mps2")
    for key in dict.fromkeys((*states, *(sigma_of(name)[0] for name in states))):
        if key not in allowed and np.any(getattr(start, key)):
            what = next((word for word in ("slip", "bias", "gravity") if word in key), "velocity like this")
            raise unexpected_value(f"0: {motion.type} has no {what} in its state", "start", key)


BySensor = dict[str, Number | dict[str, Number | dict[str, Number]]]


Files = str | dict[str, str] | None
OF_LOG: Any = options_section(
    OPTIONS.values(), kinds={
        "path": str | None,
        "robots": Annotated[tuple[RobotName, ...], Field(strict=False)] | None,
        "truth": Files, "fixes": Files, "factors": BySensor | None, "shift_s": BySensor | None,
    }, increments="cut",
)  # fmt: skip


class LogConfig(OF_LOG):  # type: ignore[misc]
    """Log, robots and time to read, and the options of its format, see below."""

    model_config = ConfigDict(extra="allow")

    without_events: Annotated[tuple[str, ...], Field(strict=False)] = ()
    """Robots of `robots` of which the log has no events."""

    @model_validator(mode="before")
    @classmethod
    def _refuse_unknown_keys(cls, value: Any) -> Any:
        given = {key: value[key] for key in value if key not in cls.model_fields} if isinstance(value, dict) else {}
        if not given:
            return value
        section = options_of_formats(tuple(known_formats().values()))
        for key in given:
            if key not in section.model_fields:
                raise unknown_key(key, "an unknown key", [*cls.model_fields, *section.model_fields])
        checked = section.model_validate(given)
        return value | {key: getattr(checked, key) for key in given}

    def options(self) -> dict[str, Any]:
        """Return the keys that only some formats have, as given."""
        return self.model_dump(include={*(self.model_extra or ())}, exclude_none=True)


@cache
def options_of_formats(formats: tuple[Format, ...]) -> type[Section]:
    """Return the section of the options of all formats: one that several have takes what one of them does."""
    kinds: dict[str, Any] = {}
    for option in (option for entry in formats for option in entry.options.values()):
        kinds[option.name] = annotation(option) | kinds.get(option.name)
    fields: Any = {name: (kind, None) for name, kind in kinds.items()}
    return create_model("LogOptions", __base__=Section, **fields)


OF_ROBOT: Any = options_section(declared_options(Robot), motion="unicycle")


class _AnyRobot(OF_ROBOT):  # type: ignore[misc]
    @model_validator(mode="after")
    def _start_fits(self) -> Self:
        robot: Any = self
        if robot.start is not None:
            refuse_odd_start(robot.motion, robot.start)
        return self


class RobotConfig(_AnyRobot):
    """One robot: how it moves, where it starts, what it carries.  Its motion decides: in the plane or in space."""

    start: StartConfig | None = None
    """Start; if absent, by the log's truth (the first true pose, moved back by the controls), or else the origin."""
    sensors: dict[str, PlaneSensor] = Field(default_factory=dict)
    """Sensors by the log's names; `each` holds for all of them."""


class SpaceRobotConfig(_AnyRobot):
    """One robot of space."""

    start: SpaceStartConfig | None = None
    """Start; if absent, by the log's truth (the first true pose, moved back by the controls), or else the origin."""
    sensors: dict[str, SpaceSensor] = Field(default_factory=dict)
    """Sensors by the log's names; `each` holds for all of them."""


def robot_world(robot: Any) -> str:
    """Return where a robot (a section, or the mapping it is made from) moves by its motion: "(plane)" or "(space)"."""
    motion = robot.get("motion") if isinstance(robot, dict) else robot.motion if isinstance(robot, _AnyRobot) else None
    kind = motion.get("type") if isinstance(motion, dict) else motion.of_name if isinstance(motion, ModelSection) else 0
    return "(space)" if isinstance(kind, str) and kind in classes("motion", "space") else "(plane)"


AnyRobot = Annotated[
    Annotated[RobotConfig, Tag("(plane)")] | Annotated[SpaceRobotConfig, Tag("(space)")], Discriminator(robot_world)
]


TRUTH = "truth"  # what stands for a file with the true landmarks


SETTINGS = {each.name: each for each in declared_options(Settings)}
OF_MAP: Any = options_section(
    [replace(SETTINGS["map"], name="type"), SETTINGS["numbers"], replace(SETTINGS["reparametrize"], words=("off",))]
)


class KnownConfig(Section):
    """A landmark known beforehand, in the numbers of its type: `Slam.add_landmark`."""

    id: LandmarkId
    """Its id: a number or a text."""
    mean: Numbers
    """Its mean: of a point x, y and, in space, z, of a tag x, y, z, qx, qy, qz, qw."""
    cov: Covariance | None = None
    """Covariance of its error, row by row; known exactly if absent."""
    landmark: Annotated[Any, Choice("landmark")] | None = None
    """Its type; what the first sensor starts, or a point, if absent."""


class MapConfig(OF_MAP):  # type: ignore[misc]
    """Storage of the covariance, and the landmarks known beforehand."""

    known: str | None = None
    """Landmarks known: a landmarks.csv or tagslam.yaml, beside this file or in KALMARK_DATA; `truth`: of the log."""
    exact: bool = False
    """Take the landmarks of `known` as exact, without the columns cov_... of the file."""
    landmarks: Annotated[tuple[KnownConfig, ...], Field(strict=False)] = ()
    """Landmarks known, of any type, in this file."""
    cov: Covariance | None = None
    """Joint covariance of robots, their biases and mounts that are estimated, and the `landmarks` with a `cov`."""


def _each() -> dict[str, AnyRobot]:
    return {"each": RobotConfig()}


class OfFile(Section):
    """Data read from a file; its name is that of the file, or of the folder of a file that is `called` so."""

    called: ClassVar[str]
    _file: Path | None = PrivateAttr(None)

    @property
    def file(self) -> Path | None:
        """The file this was read from, or None."""
        return self._file

    @property
    def name(self) -> str:
        """The file's name without its ending, its folder's for a ``config.yaml`` or ``world.yaml``, or `called`."""
        return name_of(self._file, self.called)


class _Head(OfFile):
    version: str | None = None
    """kalmark version that saved this file."""
    seed: int | None = None
    """Seed of the simulation the log came from."""
    plugins: Plugins = ()
    """Python files with models of your own.  This runs the code of those files."""
    log: LogConfig = LogConfig()
    """The log."""
    robots: dict[str, AnyRobot] = Field(default_factory=_each)
    """Robots by name; `each` holds for all of them."""


OF_FILTER: Any = options_section(
    [SETTINGS[name] for name in ("landmarks", "association", "upkeep", "estimator", "longest_pause_s")], _Head,
    association="identity", upkeep="upkeep", estimator="invariant",
)  # fmt: skip


class Config(OF_FILTER):  # type: ignore[misc]
    """Everything that decides a run.  A saved run's config.yaml is one of these and can be run again.

    >>> config = load_config("native", ["association.type=auto"])
    >>> isinstance(config, Config), list(config.robots), config.association.type
    (True, ['each'], 'auto')
    """

    called: ClassVar[str] = "config"

    map: MapConfig = MapConfig()
    """Covariance storage."""
    picture: Picture | None = None
    """Content and view of map.png, the page, videos and `kalmark view`."""

    _where: dict[KeyPath, str] = PrivateAttr(default_factory=dict)

    def overridden(self, *path: str) -> bool:
        """Return whether an override gave the value at `path`."""
        return place_around(self._where, path).startswith(OVERRIDE)

    def error(self, path: KeyPath, message: str) -> ConfigError:
        """Return the error of the value at `path`, naming the place it was read from."""
        where = place_around(self._where, path)
        return ConfigError(f"{where + ': ' if where else ''}{'.'.join(path)}: {message}")
