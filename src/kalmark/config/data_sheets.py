"""Files that a configuration names: of a motion Kalibr's `imu.yaml` or a preset; of sensors those of plug-ins."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from kalmark.config.tree import KeyPath, Plain, Tree, folder_beside, quote_value
from kalmark.declare import Parameter, class_of, classes, parameters
from kalmark.errors import ConfigError, LogError
from kalmark.logs.source import read_mapping
from kalmark.plugins import entry_points_of, load

KEY = "data_sheet"
NAMES = (
    "gyroscope_noise_density", "gyroscope_random_walk", "accelerometer_noise_density", "accelerometer_random_walk",
)  # fmt: skip


def data_sheet(path: str | Path) -> dict[str, float]:
    """Return the noise of an `imu.yaml` of Kalibr's, or a `sensor.yaml` of EuRoC's, as parameters of `inertial`.

    The keys may be below one named imu0, as in Kalibr's results.  Other keys of the file are not read.  Raises
    ConfigError: file, key, value and what was expected.
    """
    path = Path(path)
    try:
        content = read_mapping(path)
    except LogError as error:
        raise ConfigError(str(error)) from None
    below = content.get("imu0")
    content = below if isinstance(below, dict) else content
    for name in NAMES:
        if wanted := _parameter(name).refused(value := content.get(name)):
            raise ConfigError(f"{path}: {name}: got {quote_value(value)}, expected {wanted}")
    return {_parameter(name).name: float(content[name]) for name in NAMES}


def _parameter(name: str) -> Parameter:
    """Return the parameter of the motion, which has its unit at its end."""
    motion = class_of("motion", "inertial")
    return next(own for own in parameters(motion) if own.name.startswith(f"{name}_"))


def take_data_sheets(tree: Tree, path: Path | None) -> None:
    """Put what is in each `data_sheet` and `calibration` that a tree, read from the file `path`, names in its place.

    Keys beside it stay.  The file is looked for beside `path`, that of an override in the working directory.
    Raises ConfigError.
    """
    robots = tree.values.get("robots")
    for name, robot in robots.items() if isinstance(robots, dict) else ():
        if not isinstance(robot, dict):
            continue
        where, motion, sensors = ("robots", name, "motion"), robot.get("motion"), robot.get("sensors")
        if isinstance(motion, dict) and {"preset", KEY} & motion.keys():
            _take_motion(tree, path, where, motion)
        for sensor, section in sensors.items() if isinstance(sensors, dict) else ():
            for key in entry_points_of("sheets") if isinstance(section, dict) else ():
                if key in section and load("sheets", key).fits(section.get("type")):
                    _take_sheet(tree, path, ("robots", name, "sensors", sensor), section, key)


def has_parameter(role: str, kind: Any, name: str) -> bool:
    """Return whether a type has a parameter."""
    models = classes(role).get(kind, []) if isinstance(kind, str) else []
    return any(own.name == name for model in models for own in parameters(model))


def _take_motion(tree: Tree, path: Path | None, where: KeyPath, section: Plain) -> None:
    """Put the numbers of the `preset` of a motion, and those of its `data_sheet`, in their places."""
    if not has_parameter("motion", section.get("type"), _parameter(NAMES[0]).name):
        return
    if "preset" in section:
        _take_preset(tree, where, section)
    if KEY in section:
        _take_sheet(tree, path, where, section, KEY)


def _take_preset(tree: Tree, where: KeyPath, section: Plain) -> None:
    """Put the numbers of the device that a motion names as its `preset` in its place."""
    from kalmark.presets import MOTIONS

    place, given = tree.place((*where, "preset")), section.pop("preset")
    if not isinstance(given, str) or given not in MOTIONS:
        raise ConfigError(
            f"{place}: {'.'.join((*where, 'preset'))}: got {quote_value(given)}, expected one of {', '.join(MOTIONS)}"
        )
    unit, names = MOTIONS[given].sensor, {own.name for own in parameters(class_of("motion", "inertial"))}
    section |= {name: getattr(unit, name) for name in MOTIONS[given].sources if name in names} | section


def _take_sheet(tree: Tree, path: Path | None, where: KeyPath, section: Plain, key: str) -> None:
    """Replace the file that a motion or a sensor names at a key by its values."""
    values_of = _values if key == KEY else load("sheets", key).values
    place, given = tree.place((*where, key)), section.pop(key)
    try:
        found = values_of(given, folder_beside(path, place), section.get("type"))
    except ConfigError as error:
        raise ConfigError(f"{place}: {'.'.join((*where, key))}: {error}") from None
    section |= found | section


def _values(given: Any, folder: Path, _: Any) -> dict[str, float]:
    """Return the parameters of a motion by the file that it names.  Raises ConfigError."""
    if not isinstance(given, str):
        raise ConfigError(f"got {quote_value(given)}, expected the path of Kalibr's imu.yaml")
    return data_sheet(folder / given)
