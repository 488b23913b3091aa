"""The noise of an inertial unit as Kalibr's `imu.yaml` has it, for a motion that names such a file as `data_sheet`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from kalmark.config.tree import OVERRIDE, Tree, show
from kalmark.declare import class_of, classes, parameters
from kalmark.errors import ConfigError, LogError
from kalmark.events import most
from kalmark.logs.source import mapping

KEY = "data_sheet"
NAMES = (
    "gyroscope_noise_density", "gyroscope_random_walk", "accelerometer_noise_density", "accelerometer_random_walk",
)  # fmt: skip


def data_sheet(path: str | Path) -> dict[str, float]:
    """Return the noise of an `imu.yaml` of Kalibr's, or a `sensor.yaml` of EuRoC's, as parameters of `inertial`.

    The keys may be below one named imu0, as in Kalibr's results.  What else is in the file is not read.  Raises
    ConfigError: file, key, value and what was expected.
    """
    path = Path(path)
    try:
        content = mapping(path)
    except LogError as error:
        raise ConfigError(str(error)) from None
    below = content.get("imu0")
    content = below if isinstance(below, dict) else content
    return {_parameter(name): _density(path, name, content.get(name)) for name in NAMES}


def _parameter(name: str) -> str:
    """Return the parameter of the motion, which has its unit at its end."""
    motion = class_of("motion", "inertial")
    return next(own.name for own in parameters(motion) if own.name.startswith(f"{name}_"))


def _density(path: Path, name: str, value: Any) -> float:
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if not number or not 0 <= value <= most(name)[0]:
        raise ConfigError(f"{path}: {name}: got {show(value)}, expected a number >= 0")
    return float(value)


def take_data_sheets(tree: Tree, path: Path | None) -> None:
    """Put the noise of each `data_sheet` that a motion of the tree, read from the file `path`, names in its place.

    What is given beside it stays.  The file is looked for beside `path`, that of an override in the working directory.
    Raises ConfigError.
    """
    robots = tree.values.get("robots")
    for name, robot in robots.items() if isinstance(robots, dict) else ():
        motion = robot.get("motion") if isinstance(robot, dict) else None
        if not isinstance(motion, dict) or KEY not in motion or not _has_one(motion.get("type")):
            continue
        key = ("robots", name, "motion", KEY)
        place, given = tree.place(key), motion.pop(KEY)
        if not isinstance(given, str):
            raise ConfigError(f"{place}: {'.'.join(key)}: got {show(given)}, expected the path of Kalibr's imu.yaml")
        beside = Path() if path is None or place.startswith(OVERRIDE) else path.resolve().parent
        try:
            found = data_sheet(beside / given)
        except ConfigError as error:
            raise ConfigError(f"{place}: {'.'.join(key)}: {error}") from None
        motion |= found | motion


def _has_one(kind: Any) -> bool:
    """Return whether a type of motion has the parameters of a data sheet."""
    models = classes("motion").get(kind, []) if isinstance(kind, str) else []
    return any(own.name == _parameter(NAMES[0]) for model in models for own in parameters(model))
