"""The configuration of a filter built in Python, read off its models, in the form of a configuration file."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from kalmark.declare import own_name, parameters, plugin_of, registered_name
from kalmark.geometry.rotations import to_euler
from kalmark.logs.log import Log

PARTS = ("landmark", "association", "detector", "initialization")  # of a mounted sensor, if it has its own


def plain(value: Any) -> Any:
    """Return a value made of dicts, lists, texts, numbers and None only, ready for YAML or JSON."""
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [plain(item) for item in value]
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist())
    if value is None or isinstance(value, bool | int | float | str):
        return value
    return str(value)


def model(value: Any) -> dict[str, Any]:
    """Return the type and the parameters of a model, as a mapping."""
    kind = type(value)
    given = {own.name: vars(value)[own.name] for own in parameters(kind)}
    name = registered_name(kind) or own_name(kind)  # file.py:Class for a user's own that has none
    return {"type": name} | {key: plain(item) for key, item in given.items() if item is not None}


def describe(slam: Any, log: Any = None) -> dict[str, Any]:
    """Return the configuration of a Slam: log, robots, sensors, landmarks, association, estimator, map."""
    out: dict[str, Any] = {}
    if isinstance(log, Log) and log.path is not None:
        out["log"] = {"path": str(log.path), "format": log.format, "robots": list(log.robots)}
    models = [slam.landmark_type, slam.association, slam.estimator, *(robot.motion for robot in slam.robots.values())]
    for mount in (mount for robot in slam.robots.values() for mount in robot.sensors.values()):
        models += [mount.sensor, *(vars(mount)[part] for part in PARTS)]
    plugins = sorted({str(file) for each in models if (file := plugin_of(type(each))) is not None})
    if plugins:
        out["plugins"] = plugins
    out["robots"] = {name: _robot(robot) for name, robot in slam.robots.items()}
    if slam.landmark_type is not None:
        out["landmarks"] = model(slam.landmark_type)
    out["association"] = model(slam.association)
    out["upkeep"] = _keys(slam.upkeep)
    out["estimator"] = model(slam.estimator)
    reparametrize = "off" if slam.reparametrize is None else float(slam.reparametrize)
    out["map"] = {"type": slam.map_type, "numbers": slam.numbers, "reparametrize": reparametrize}
    return out


def _keys(value: Any) -> dict[str, Any]:
    return {key: value for key, value in model(value).items() if key != "type"}


def _robot(robot: Any) -> dict[str, Any]:
    start = describe_pose(robot.start)
    rates = ("vx_mps", "vy_mps", "vz_mps", "wx_radps", "wy_radps", "wz_radps")
    start |= dict(zip(rates, plain(robot.start)[7:], strict=False))
    if robot.cov is not None:
        start |= _sigmas(robot.cov)
    sensors = {name: _sensor(mount) for name, mount in robot.sensors.items()}
    return {"motion": model(robot.motion), "start": start, "sensors": sensors}


def _sensor(mount: Any) -> dict[str, Any]:
    out, at = model(mount.sensor), describe_pose(mount.at)
    if any(at.values()):
        out["mount"] = at
    for part in PARTS:
        if vars(mount)[part] is not None:
            out[part] = model(vars(mount)[part])
    if mount.attention != type(mount.attention)():
        out["attention"] = _keys(mount.attention)
    if mount.upkeep is not None:
        out["upkeep"] = _keys(mount.upkeep)
    if mount.cov is not None:
        out["mount"] = at | _sigmas(mount.cov)
    return out


def describe_pose(pose: Any) -> dict[str, float]:
    """Return a pose as configuration files have it: (x, y, theta), in space (x, y, z, roll, pitch, yaw)."""
    pose = [float(value) for value in pose]
    if len(pose) == 3:
        return dict(zip(("x_m", "y_m", "theta_rad"), pose, strict=True))
    angles = np.degrees(to_euler(np.array(pose[3:7]))[0]).tolist()
    return dict(zip(("x_m", "y_m", "z_m", "roll_deg", "pitch_deg", "yaw_deg"), (*pose[:3], *angles), strict=True))


def _sigmas(cov: Any) -> dict[str, float]:
    """Return the sigmas of a covariance as configuration files have them, one for all axes."""
    sigma = np.sqrt(np.diagonal(np.asarray(cov, dtype=np.float64))).tolist()
    if len(sigma) == 3:
        return {"sigma_xy_m": sigma[0], "sigma_theta_rad": sigma[2]}
    out = {"sigma_position_m": sigma[0], "sigma_rotation_deg": math.degrees(sigma[3])}
    return out if len(sigma) == 6 else out | {"sigma_v_mps": sigma[6], "sigma_w_radps": sigma[9]}
