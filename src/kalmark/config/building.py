"""From a configuration to the things it describes: the log, the robots, the filter."""

from __future__ import annotations

from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from kalmark.config.locate import check_format, find_log
from kalmark.config.models import Landmark, Motion, MountConfig, Sensor
from kalmark.config.reading import did_you_mean, load_config
from kalmark.config.schema import Config, RobotConfig, StartConfig
from kalmark.errors import LogError, ModelError
from kalmark.filter import estimators
from kalmark.logs import open_log
from kalmark.logs.log import Log
from kalmark.logs.start import true_start
from kalmark.models import landmarks, motion, sensors
from kalmark.slam import association
from kalmark.slam.events import Scan
from kalmark.slam.robot import Mount, Robot
from kalmark.slam.slam import Slam

T = TypeVar("T")

CLASSES: dict[str, Callable[..., Any]] = {
    "unicycle": motion.Unicycle,
    "odometry_2d": motion.Odometry2D,
    "ackermann": motion.Ackermann,
    "range_bearing": sensors.RangeBearing,
    "bearing": sensors.Bearing,
    "range": sensors.Range,
    "position": sensors.Position2D,
    "range_bearing_signature": sensors.RangeBearingSignature,
    "point": landmarks.Point2D,
    "point_signature": landmarks.PointSignature2D,
    "identity": association.ByIdentity,
    "nearest": association.NearestNeighbour,
    "ekf": estimators.Ekf,
    "invariant": estimators.Invariant,
    "fej": estimators.Fej,
}
MOTIONS = ("unicycle", "odometry_2d", "ackermann")
_MOUNTED = {"mount", "landmark", "association", "detector"}


def in_force(config: Config, log_path: str | Path | None = None) -> Config:
    """Return the configuration with its log's path found, or replaced by `log_path`.  Raises ConfigError, LogError."""
    log = config.log.model_copy(update={"path": str(find_log(config, log_path))})
    return config.model_copy(update={"log": log})


def open_config_log(config: Config, log_path: str | Path | None = None) -> Log:
    """Return the log that a configuration names, or the one at `log_path` read in the same way."""
    log, path = config.log, find_log(config, log_path)
    check_format(config, path)
    return open_log(
        path,
        log.format,
        robots=None if log.robots is None else list(log.robots),
        from_s=log.from_s,
        to_s=log.to_s,
        on_error=log.on_error,
        **log.options(),
    )


def build_slam(config: Config, log: Log | None = None) -> Slam:
    """Return the filter that a configuration describes, for the robots of a log.

    Without a log the robots are those that the configuration names; `each` alone is one robot called "robot".
    """
    return Slam(
        [build_robot(config, name, log) for name in _names(config, log)],
        association=_build(config, ("association",), config.association),
        estimator=_build(config, ("estimator",), config.estimator),
        landmarks=_build(config, ("landmarks",), config.landmarks),
        map=config.map.type,
    )


def slam_from_config(path_or_name: str | Path) -> Slam:
    """Return the filter of a configuration file or shipped name; the log it names tells robots and starts."""
    config = load_config(path_or_name)
    return build_slam(config, None if config.log.path is None else open_config_log(config))


def config_dict(config: Config) -> dict[str, Any]:
    """Return everything in force as plain values, to be saved as ``config.yaml`` and loaded again."""
    content = config.model_dump(mode="python", exclude_none=True, exclude={"version", "seed"})
    if config.log.robots is not None:
        content["log"]["robots"] = list(config.log.robots)
    return {"version": version("kalmark"), "seed": config.seed} | content


def build_robot(config: Config, name: str, log: Log | None = None) -> Robot:
    """Return one robot with its sensors, started where the configuration says, or else the log's truth."""
    key = name if name in config.robots else "each"
    if key not in config.robots:
        near = did_you_mean(name, [*config.robots])
        raise config.error(("robots",), f"got {', '.join(config.robots)}, expected {name!r} of the log, or each{near}")
    robot, path = config.robots[key], ("robots", key)
    moves = _build(config, (*path, "motion"), robot.motion)
    start, cov = _start(robot, name, log, moves.held)
    if log is not None:
        _refuse_misfit(config, key, name, moves.columns, log)
    mounts = {s: _mount(config, (*path, "sensors", s), sensor) for s, sensor in robot.sensors.items()}
    return Robot(name, moves, start=start, sensors=mounts, cov=cov)


def _refuse_misfit(config: Config, key: str, name: str, columns: tuple[str, ...], log: Log) -> None:
    """Refuse controls that the motion does not take and, unless bad input is skipped, sensors not configured."""
    robot, given = config.robots[key], tuple(log.control_columns.get(name, columns))
    if given != columns:
        fitting = [motion for motion in MOTIONS if CLASSES[motion]().columns == given]
        hint = f"; try --set robots.{key}.motion.type={fitting[0]}" if fitting else ""
        what = f"the controls of {name} have the columns {', '.join(given)}"
        raise LogError(f"{log.path}: {what}, expected {', '.join(columns)} of its motion {robot.motion.type}{hint}")
    if config.log.on_error == "skip":
        return
    for event in log.events:
        if isinstance(event, Scan) and event.robot == name and event.sensor not in robot.sensors:
            known = f"one of {', '.join(robot.sensors)}" if robot.sensors else "none, as none is configured"
            what = f"{name} has scans of the sensor {event.sensor!r}, expected {known}"
            raise LogError(f"{log.path}: {what}; add robots.{key}.sensors.{event.sensor}")


def _names(config: Config, log: Log | None) -> list[str]:
    named = [name for name in config.robots if name != "each"]
    if log is None:
        return named or ["robot"]
    for name in named if config.log.robots is None else ():
        if name not in log.robots:
            what = f"got a robot that the log does not have, expected one of {', '.join(log.robots)}"
            raise config.error(("robots", name), what + did_you_mean(name, log.robots))
    return list(log.robots)


def _start(robot: RobotConfig, name: str, log: Log | None, held: bool) -> tuple[Any, Any]:
    """Return the start (3,) and its covariance: as configured, else the truth before the first motion, else 0."""
    if robot.start is not None:
        s: StartConfig = robot.start
        return (s.x_m, s.y_m, s.theta_rad), np.diag(np.square([s.sigma_xy_m, s.sigma_xy_m, s.sigma_theta_rad]))
    pose = None if log is None else true_start(log, name, held)
    return ((0.0, 0.0, 0.0) if pose is None or len(pose) != 3 else pose), None


def _mount(config: Config, path: tuple[str, ...], sensor: Sensor) -> Mount:
    mount: MountConfig = sensor.mount
    landmark = None if sensor.landmark is None else _build(config, (*path, "landmark"), sensor.landmark)
    return Mount(_build(config, path, sensor), at=(mount.x_m, mount.y_m, mount.theta_rad), landmark=landmark)


def _build(config: Config, path: tuple[str, ...], section: Motion | Sensor | Landmark | Any) -> Any:
    """Return the model that a section describes; what the model itself refuses is told with the section's place."""
    try:
        return CLASSES[section.type](**section.model_dump(exclude={"type", *_MOUNTED}))
    except ModelError as error:
        raise config.error(path, str(error)) from None
