"""Refuse a log whose controls or scans are not what the configured motion and sensors take, and what no robot takes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from kalmark.config.merging import EACH
from kalmark.config.reading import did_you_mean
from kalmark.config.schema import Config
from kalmark.config.tree import OVERRIDE, Tree
from kalmark.declare import built_in, registered_name
from kalmark.detect.scan import RAW, Laser
from kalmark.errors import ConfigError, LogError
from kalmark.events import Scan
from kalmark.logs.log import Log
from kalmark.slam.robot import Mount


def refuse_idle(tree: Tree, log: Log) -> None:
    """Refuse what was set on the command line for robots of which the log has none."""
    named: Any = tree.values.get("robots")
    for path, place in tree.places.items() if isinstance(named, dict) else ():
        if path[:1] != ("robots",) or len(path) < 2 or path[1] in log.robots or not place.startswith(OVERRIDE):
            continue
        if path[1] != EACH:
            near = did_you_mean(path[1], log.robots)
            wanted = f"one of {', '.join(log.robots)}{near}"
            raise ConfigError(
                f"{place}: robots.{path[1]}: got a robot that is not in this log or run, expected {wanted}"
            )
        if all(name in named for name in log.robots):
            names = " or ".join(f"robots.{name}" for name in log.robots)
            raise ConfigError(f"{place}: robots.each: no robot takes it, as each one is named, expected {names}")


def refuse_controls(config: Config, key: str, name: str, columns: tuple[str, ...], log: Log) -> None:
    """Refuse controls that the motion of a robot does not take."""
    given = tuple(log.control_columns.get(name, columns))
    if given != columns:
        fitting = _fitting("motion", given)
        hint = f"; try --set robots.{key}.motion.type={fitting[0]}" if fitting else _meant(given, columns)
        what = f"the controls of {name} have the columns {', '.join(given)}"
        wanted = f"{', '.join(columns)} of its motion {config.robots[key].motion.type}"
        raise LogError(f"{_header(log, name, '')}: {what}, expected {wanted}{hint}")


def refuse_scans(config: Config, key: str, name: str, mounts: dict[str, Mount], log: Log) -> None:
    """Refuse observations that a sensor does not take and, unless bad input is skipped, sensors not configured."""
    for (robot, sensor), given in log.sensor_columns.items():
        if robot != name or sensor not in mounts or not isinstance(mounts[sensor].detector, Laser | None):
            continue
        raw = mounts[sensor].detector is not None
        columns = RAW[: max(len(given), 2)] if raw else mounts[sensor].sensor.columns
        if given != columns:
            kind = config.robots[key].sensors[sensor].type
            fitting = [] if raw else _fitting("sensor", given)
            hint = f"; try --set robots.{key}.sensors.{sensor}.type={fitting[0]}" if fitting else _meant(given, columns)
            wanted = f"{', '.join(columns)} of {'its beams' if raw else f'its type {kind}'}"
            what = f"the scans of {name} by {sensor} have the columns {', '.join(given)}"
            raise LogError(f"{_header(log, name, sensor)}: {what}, expected {wanted}{hint}")
    if config.log.on_error == "skip":
        return
    used = {event.sensor for event in log.events if isinstance(event, Scan) and event.robot == name}
    for event in log.events:
        if isinstance(event, Scan) and event.robot == name and event.sensor not in mounts:
            idle = [sensor for sensor in mounts if sensor not in used]
            if idle and not did_you_mean(event.sensor, [sensor for sensor in mounts if sensor in used]):
                raise _misnamed(config, key, name, idle, event.sensor, log)
            known = f"one of {', '.join(mounts)}" if mounts else "none, as none is configured"
            file, line = log.places.get((name, event.sensor), (log.path, 0))
            what = f"{name} has scans of the sensor {event.sensor!r}, expected {known}"
            hint = f"if it is another one, add robots.{key}.sensors.{event.sensor}"
            raise LogError(f"{file}{f':{line}' if line else ''}: {what}; {hint}")


def _fitting(role: str, columns: tuple[str, ...]) -> list[str | None]:
    """Return the types of kalmark's own models that take these columns."""
    return [registered_name(model) for model in built_in(role) if model.columns == columns]


def _misnamed(config: Config, key: str, name: str, idle: list[str], sensor: str, log: Log) -> ConfigError:
    """Return the error of a sensor that the log has by another name."""
    meant = next((each for each in idle if did_you_mean(sensor, [each])), idle[0])
    file, line = log.places.get((name, sensor), (log.path, 0))
    where = f"{file}{f':{line}' if line else ''}"
    what = f"the log has no scans by it, expected {sensor!r} as in {where}"
    hint = f"if that is another sensor, add robots.{key}.sensors.{sensor}"
    return config.error(("robots", key, "sensors", meant), f"{what}; {hint}")


def _header(log: Log, robot: str, sensor: str) -> str | Path | None:
    """Return the place of the names of these columns."""
    return f"{log.places[robot, sensor][0]}:1" if (robot, sensor) in log.places else log.path


def _meant(given: tuple[str, ...], columns: tuple[str, ...]) -> str:
    """Return a hint at the column that was probably meant by one that is too much."""
    missing = [name for name in columns if name not in given]
    return next(filter(None, (did_you_mean(name, missing) for name in given if name not in columns)), "")
