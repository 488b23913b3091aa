"""`Config`: everything that decides a run, each key with its default, in one frozen model."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Discriminator, Field, PrivateAttr, Tag, model_validator

from kalmark.config.choices import Choice, ModelSection, model_of, section_of
from kalmark.config.mounting import (
    VELOCITY,
    Association,
    Landmark,
    PlaneSensor,
    Plugins,
    SpaceSensor,
    SpaceStartConfig,
    StartConfig,
    Upkeep,
)
from kalmark.config.sections import Linearity, NotNegative, Number, Positive, RobotName, Section, expected
from kalmark.config.tree import OVERRIDE, name_of
from kalmark.declare import classes
from kalmark.errors import ConfigError

Motion = Annotated[Any, Choice("motion")]
Estimator = Annotated[Any, Choice("estimator", default="invariant")]


class LogConfig(Section):
    """Which log, and how much of it."""

    path: str | None = None
    """Folder or file; beside this file, in KALMARK_DATA or downloaded."""
    format: str | None = None
    """Format of the log; recognised if absent."""
    robots: Annotated[tuple[RobotName, ...], Field(strict=False)] | None = None
    """Use only these robots, by name or number."""
    from_s: Number | None = None
    """Start here, counted from the first event of the log."""
    to_s: Number | None = None
    """End here, counted from the first event of the log."""
    on_error: Literal["raise", "skip"] = "raise"
    """What to do with bad input: refuse, or leave out."""
    ids: Literal["given", "hidden"] = "given"
    """`hidden`: the filter is not told which landmark is which; the summary says how often it was wrong."""
    r_max: Positive | None = None
    """lost_in_the_woods: drop observations beyond this range."""
    measured: Literal["range_bearing", "bearing"] | None = None
    """lost_in_the_woods: take ranges and bearings, or bearings alone (range_bearing if absent)."""
    bearing_shift_s: Number | None = None
    """mrclam: added to the time of every observation."""
    robot_sightings: bool | None = None
    """mrclam: use the robots' sightings of each other (true if absent)."""
    covariance_scale: Positive | None = None
    """dlr: multiplies all covariances of the file."""
    detections: Literal["laser", "slsjf", "rfs"] | None = None
    """victoria_park: which detections."""
    steering: Literal["ascii", "mat"] | None = None
    """victoria_park: which steering calibration."""
    min_disparity_px: NotNegative | None = None
    """kitti_stereo_features: drop observations with a smaller disparity (1 if absent)."""
    rates: Literal["mean", "held"] | None = None
    """kitti_stereo_features: hold the mean of two rates between them, or the first (mean if absent)."""
    tag_size_m: Positive | None = None
    """tagslam: size of the tags that tagslam.yaml gives none of their own."""
    cameras: Literal["all", "given"] | None = None
    """tagslam: all, or those with a pose in camera_poses.yaml (all if absent)."""
    odometry: Literal["auto", "none"] | None = None
    """tagslam: use the odometry of the bag (auto if absent)."""
    sigma_px: Positive | None = None
    """tagslam: noise of a corner's coordinate (the pixel_noise of tagslam.yaml if absent)."""

    def options(self) -> dict[str, Any]:
        """Return the keys that only some formats have, as given."""
        common = {"path", "format", "robots", "from_s", "to_s", "on_error", "ids"}
        return self.model_dump(exclude=common, exclude_none=True)


class _AnyRobot(Section):
    motion: Motion = section_of("motion", "unicycle")()
    """Motion model."""


class RobotConfig(_AnyRobot):
    """One robot: how it moves, where it starts, what it carries.  Its motion decides: in the plane or in space."""

    start: StartConfig | None = None
    """Start; if absent, the log's truth, or else the origin."""
    sensors: dict[str, PlaneSensor] = Field(default_factory=dict)
    """Sensors by the log's name of each."""


class SpaceRobotConfig(_AnyRobot):
    """One robot of space."""

    start: SpaceStartConfig | None = None
    """Start; if absent, the log's truth, or else the origin."""
    sensors: dict[str, SpaceSensor] = Field(default_factory=dict)
    """Sensors by the log's name of each."""

    @model_validator(mode="after")
    def _start_fits(self) -> SpaceRobotConfig:
        if self.start is not None and model_of(self.motion).space.size == 7:
            for key in VELOCITY:
                if self.start.model_dump()[key] not in (0, (0, 0, 0)):
                    raise expected(f"0: {self.motion.type} has no velocity in its state", "start", key)
        return self


def robot_world(robot: Any) -> str:
    """Return where a robot (a section, or the mapping it is made from) moves by its motion: "(plane)" or "(space)"."""
    motion = robot.get("motion") if isinstance(robot, dict) else robot.motion if isinstance(robot, _AnyRobot) else None
    kind = (
        motion.get("type") if isinstance(motion, dict) else motion.of_name if isinstance(motion, ModelSection) else None
    )
    return "(space)" if isinstance(kind, str) and kind in classes("motion", "space") else "(plane)"


AnyRobot = Annotated[
    Annotated[RobotConfig, Tag("(plane)")] | Annotated[SpaceRobotConfig, Tag("(space)")], Discriminator(robot_world)
]


class MapConfig(Section):
    """How the covariance is kept."""

    type: Literal["auto", "dense", "postponed"] = "auto"
    """`dense` corrects the whole covariance at once, `postponed` only what is in view, `auto` is dense while small."""
    numbers: Literal["float64", "float32"] = "float64"
    """In what a postponed map keeps what is at rest; `float32` takes half the memory."""
    reparametrize: Linearity = 0.03
    """Inverse-depth and anchored points become Euclidean below this linearity index; or off."""

    @property
    def linearity(self) -> float | None:
        """The linearity index, None for off."""
        return None if isinstance(self.reparametrize, str) else self.reparametrize


def _each() -> dict[str, AnyRobot]:
    return {"each": RobotConfig()}


class Config(Section):
    """Everything that decides a run.  A saved run's config.yaml is one of these and can be run again."""

    version: str | None = None
    """kalmark version that saved this file."""
    seed: int | None = None
    """Seed of the simulation the log came from."""
    plugins: Plugins = ()
    """Python files with models of your own.  This runs the code of those files."""
    log: LogConfig = LogConfig()
    """The log."""
    robots: dict[str, AnyRobot] = Field(default_factory=_each)
    """Robots by name; `each` stands for every robot not named."""
    landmarks: Landmark | None = None
    """Landmark type; what fits each sensor if absent."""
    association: Association = section_of("association", "identity")()
    """Which landmark was that."""
    upkeep: Upkeep = section_of("upkeep", "upkeep")()
    """What makes a landmark of sightings without an id."""
    estimator: Estimator = section_of("estimator", "invariant")()
    """Filter."""
    map: MapConfig = MapConfig()
    """Covariance storage."""

    _file: Path | None = PrivateAttr(None)
    _where: dict[tuple[str, ...], str] = PrivateAttr(default_factory=dict)

    @property
    def file(self) -> Path | None:
        """The file this was read from, or None."""
        return self._file

    @property
    def name(self) -> str:
        """The file's name without its ending, its folder's name for a ``config.yaml``, or "config"."""
        return name_of(self._file, "config")

    def overridden(self, *path: str) -> bool:
        """Return whether an override gave the value at `path`."""
        return self._place(path).startswith(OVERRIDE)

    def error(self, path: tuple[str, ...], message: str) -> ConfigError:
        """Return the error of the value at `path`, naming the place it was read from."""
        where = self._place(path)
        return ConfigError(f"{where + ': ' if where else ''}{'.'.join(path)}: {message}")

    def _place(self, path: tuple[str, ...]) -> str:
        return next((self._where[path[:n]] for n in range(len(path), -1, -1) if path[:n] in self._where), "")
