"""From a configuration to the robots and the filter that it describes."""

from __future__ import annotations

from importlib.metadata import version
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from kalmark.config.choices import ModelSection, model_of
from kalmark.config.misfit import refuse_controls, refuse_scans
from kalmark.config.mounting import covariance_of, pose_of, velocity_of
from kalmark.config.opening import described, open_run
from kalmark.config.reading import did_you_mean, load_config
from kalmark.config.schema import Config
from kalmark.errors import ModelError
from kalmark.logs.log import Log
from kalmark.logs.start import true_start
from kalmark.models.protocols import Motion as MotionModel
from kalmark.slam.robot import Mount, Robot
from kalmark.slam.slam import Slam


def build_slam(config: Config, log: Log | None = None) -> Slam:
    """Return the filter that a configuration describes, for the robots of a log and with what the log says of them.

    Without a log the robots are those that the configuration names; `each` alone is one robot called "robot".
    """
    config = config if log is None else described(config, log)
    robots = [build_robot(config, name, log) for name in _names(config, log)]
    types = {
        "association": _build(config, ("association",), config.association),
        "estimator": _build(config, ("estimator",), config.estimator),
        "landmarks": _build(config, ("landmarks",), config.landmarks, robots[0].motion.space.world),
    }
    try:
        m = config.map
        kept = model_of(config.upkeep)
        return Slam(robots, **types, map=m.type, numbers=m.numbers, reparametrize=m.linearity, upkeep=kept)
    except ModelError as error:
        raise config.error(("robots",), str(error)) from None


def slam_from_config(path_or_name: str | Path) -> Slam:
    """Return the filter of a configuration file or shipped name; the log it names tells robots, starts and the rest."""
    config = load_config(path_or_name)
    return build_slam(config) if config.log.path is None else build_slam(*open_run(path_or_name))


def config_dict(config: Config) -> dict[str, Any]:
    """Return everything in force as plain values, to be saved as ``config.yaml`` and loaded again."""
    content = _plain(config)
    return {"version": version("kalmark"), "seed": config.seed} | {
        key: value for key, value in content.items() if key not in ("version", "seed")
    }


def _plain(value: Any) -> Any:
    """Return sections as mappings; a key without value only where the user wrote it, to undo what the log describes."""
    if isinstance(value, BaseModel):
        fields = {name: getattr(value, name) for name in type(value).model_fields}
        return {n: _plain(v) for n, v in fields.items() if v is not None or n in value.model_fields_set}
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    return [_plain(item) for item in value] if isinstance(value, tuple) else value


def build_robot(config: Config, name: str, log: Log | None = None) -> Robot:
    """Return one robot with its sensors, started where the configuration says, or else the log's truth."""
    key = name if name in config.robots else "each"
    if key not in config.robots:
        near = did_you_mean(name, [*config.robots])
        raise config.error(("robots",), f"got {', '.join(config.robots)}, expected {name!r} of the log, or each{near}")
    robot, path = config.robots[key], ("robots", key)
    moves = _build(config, (*path, "motion"), robot.motion)
    start, cov = _start(robot.start, name, log, moves)
    world = moves.space.world
    if log is not None:
        refuse_controls(config, key, name, moves.columns, log)
    mounts = {s: _mount(config, (*path, "sensors", s), sensor, world) for s, sensor in robot.sensors.items()}
    if log is not None:
        refuse_scans(config, key, name, mounts, log)
    try:
        return Robot(name, moves, start=start, sensors=mounts, cov=cov)
    except ModelError as error:
        raise config.error(path, str(error)) from None


def _names(config: Config, log: Log | None) -> list[str]:
    named = [name for name in config.robots if name != "each"]
    if log is None:
        return named or ["robot"]
    for name in named if config.log.robots is None else ():
        if name not in log.robots:
            what = f"got a robot that the log does not have, expected one of {', '.join(log.robots)}"
            raise config.error(("robots", name), what + did_you_mean(name, log.robots))
    return list(log.robots)


def _start(section: Any, name: str, log: Log | None, moves: MotionModel) -> tuple[Any, Any]:
    """Return the start and its covariance: as configured, else the truth before the first motion, else the origin."""
    space = moves.space
    if section is not None:
        pose = pose_of(section)
        start = pose if space.size == len(pose) else [*pose, *velocity_of(section)]
        return start, covariance_of(section, space.dof)
    true = None if log is None else true_start(log, name, moves.held)
    return (true if true is not None and (len(true) == 3) == (space.size == 3) else None), None


def _mount(config: Config, path: tuple[str, ...], sensor: Any, world: str) -> Mount:
    own = {
        "landmark": _build(config, (*path, "landmark"), sensor.landmark, world),
        "association": _build(config, (*path, "association"), sensor.association),
        "cov": covariance_of(sensor.mount, 3 if world == "plane" else 6),
    }
    if sensor.detector is not None:
        found, chooses = sensor.detector, "signature" in type(sensor.detector).model_fields
        if chooses and found.signature is None:
            found = found.model_copy(update={"signature": "signature" in sensor.type})
        own["detector"] = _build(config, (*path, "detector"), found)
    if sensor.attention is not None:
        own["attention"] = model_of(sensor.attention)
    if sensor.upkeep is not None:
        own["upkeep"] = model_of(sensor.upkeep)
    if world == "plane" and sensor.initialization.type != "immediate":
        own["initialization"] = _build(config, (*path, "initialization"), sensor.initialization)
    try:
        return Mount(_build(config, path, sensor), at=pose_of(sensor.mount), **own)
    except ModelError as error:
        raise config.error(path, str(error)) from None


def _build(config: Config, path: tuple[str, ...], section: ModelSection | None, world: str = "plane") -> Any:
    """Return the model that a section describes; what the model itself refuses is told with the section's place."""
    if section is None:
        return None
    try:
        return model_of(section, world)
    except ModelError as error:
        raise config.error(path, str(error)) from None
