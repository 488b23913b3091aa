"""Files that a configuration names: of a motion Kalibr's `imu.yaml` or a preset; of a camera its `calibration`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from kalmark.config.tree import KeyPath, Tree, folder_beside, quote_value
from kalmark.declare import class_of, classes, parameters
from kalmark.errors import ConfigError, LogError
from kalmark.events import is_number, largest_magnitude
from kalmark.logs.camera_calibration import INTRINSICS, read_calibration
from kalmark.logs.source import read_mapping

KEY, CALIBRATION = "data_sheet", "calibration"
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
    return {_parameter(name): _density(path, name, content.get(name)) for name in NAMES}


def _parameter(name: str) -> str:
    """Return the parameter of the motion, which has its unit at its end."""
    motion = class_of("motion", "inertial")
    return next(own.name for own in parameters(motion) if own.name.startswith(f"{name}_"))


def _density(path: Path, name: str, value: Any) -> float:
    if not is_number(value) or not 0 <= value <= largest_magnitude(name)[0]:
        raise ConfigError(f"{path}: {name}: got {quote_value(value)}, expected a number >= 0")
    return float(value)


def calibration(path: str | Path, camera: str | None = None) -> dict[str, Any]:
    """Return a camera's calibration (OpenCV, Kalibr, ROS, EuRoC) as parameters of `pinhole`; its mount as `mount`.

    `camera` names one of several in the file.  Raises ConfigError: file, key, value and what was expected.
    """
    try:
        return read_calibration(Path(path), camera)
    except LogError as error:
        raise ConfigError(str(error)) from None


def take_data_sheets(tree: Tree, path: Path | None) -> None:
    """Put what is in each `data_sheet` and `calibration` that a tree, read from the file `path`, names in its place.

    Keys beside it stay.  The file is looked for beside `path`, that of an override in the working directory.
    Raises ConfigError.
    """
    robots = tree.values.get("robots")
    for name, robot in robots.items() if isinstance(robots, dict) else ():
        if not isinstance(robot, dict):
            continue
        _take_preset(tree, ("robots", name, "motion"), robot.get("motion"))
        _take(tree, path, ("robots", name, "motion"), robot.get("motion"))
        sensors = robot.get("sensors")
        for sensor, section in sensors.items() if isinstance(sensors, dict) else ():
            _take(tree, path, ("robots", name, "sensors", sensor), section)


def _take_preset(tree: Tree, where: KeyPath, section: Any) -> None:
    """Put the numbers of the device that a motion names as its `preset` in its place."""
    if not isinstance(section, dict) or "preset" not in section or not _has_one(KEY, section.get("type")):
        return
    from kalmark.presets import MOTIONS

    place, given = tree.place((*where, "preset")), section.pop("preset")
    if not isinstance(given, str) or given not in MOTIONS:
        raise ConfigError(
            f"{place}: {'.'.join((*where, 'preset'))}: got {quote_value(given)}, expected one of {', '.join(MOTIONS)}"
        )
    unit, names = MOTIONS[given].sensor, {own.name for own in parameters(class_of("motion", "inertial"))}
    section |= {name: getattr(unit, name) for name in MOTIONS[given].sources if name in names} | section


def _take(tree: Tree, path: Path | None, where: KeyPath, section: Any) -> None:
    """Replace the file of a motion or a sensor by its values."""
    key = KEY if where[-1] == "motion" and len(where) == 3 else CALIBRATION
    if not isinstance(section, dict) or key not in section or not _has_one(key, section.get("type")):
        return
    place, given = tree.place((*where, key)), section.pop(key)
    name = f"{place}: {'.'.join((*where, key))}"
    file, camera = given, None
    if key == CALIBRATION and isinstance(given, dict) and given.keys() == {"file", "camera"}:
        file, camera = given["file"], str(given["camera"])
    if not isinstance(file, str):
        of_camera = "the path of a camera's calibration, or {file: PATH, camera: NAME}"
        wanted = "the path of Kalibr's imu.yaml" if key == KEY else of_camera
        raise ConfigError(f"{name}: got {quote_value(given)}, expected {wanted}")
    there = folder_beside(path, place) / file
    try:
        found = data_sheet(there) if key == KEY else calibration(there, camera)
    except ConfigError as error:
        raise ConfigError(f"{name}: {error}") from None
    if key == CALIBRATION and not _has("sensor", section["type"], "lens"):
        if np.any(found["distortion"]):
            raise ConfigError(f"{name}: got a lens with distortion, expected one without: {section['type']} has none")
        found = {own: value for own, value in found.items() if own not in ("lens", "distortion")}
    section |= found | section


def _has_one(key: str, kind: Any) -> bool:
    """Return whether a type of motion has the parameters of a data sheet, or one of sensor those of a calibration."""
    return _has("motion", kind, _parameter(NAMES[0])) if key == KEY else _has("sensor", kind, INTRINSICS[0])


def _has(role: str, kind: Any, name: str) -> bool:
    models = classes(role).get(kind, []) if isinstance(kind, str) else []
    return any(own.name == name for model in models for own in parameters(model))
