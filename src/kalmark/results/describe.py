"""The configuration of a filter built in Python, read off its models, in the form of a configuration file."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np

TYPES = {
    "Unicycle": "unicycle",
    "Odometry2D": "odometry_2d",
    "Ackermann": "ackermann",
    "RangeBearing": "range_bearing",
    "Bearing": "bearing",
    "Range": "range",
    "Position2D": "position",
    "RangeBearingSignature": "range_bearing_signature",
    "Point2D": "point",
    "PointSignature2D": "point_signature",
    "ByIdentity": "identity",
    "NearestNeighbour": "nearest",
    "Ekf": "ekf",
    "Invariant": "invariant",
    "Fej": "fej",
}


def type_name(model: Any) -> str:
    """Return a model's name in configuration files, or module:Class for a user's own."""
    cls = type(model)
    return TYPES.get(cls.__name__, f"{cls.__module__}:{cls.__qualname__}")


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
    """Return the type and the parameters of a model that is a dataclass, as a mapping."""
    out: dict[str, Any] = {"type": type_name(value)}
    if dataclasses.is_dataclass(value):
        given = {f.name: getattr(value, f.name) for f in dataclasses.fields(value) if f.init and f.repr}
        out |= {key: plain(item) for key, item in given.items() if item is not None}
    return out


def describe(slam: Any, log: Any = None) -> dict[str, Any]:
    """Return the configuration of a Slam: log, robots, sensors, landmarks, association, estimator, map."""
    out: dict[str, Any] = {}
    if getattr(log, "path", None) is not None:
        out["log"] = {"path": str(log.path), "format": log.format, "robots": list(log.robots)}
    out["robots"] = {name: _robot(robot) for name, robot in slam.robots.items()}
    for key in ("landmarks", "association"):
        value = getattr(slam, key, None)
        if value is not None and not callable(value):
            out[key] = model(value)
    out["estimator"] = model(slam.estimator)
    return out


def _robot(robot: Any) -> dict[str, Any]:
    out: dict[str, Any] = {"motion": model(robot.motion)}
    start = [float(value) for value in robot.start]
    if len(start) == 3:
        out["start"] = dict(zip(("x_m", "y_m", "theta_rad"), start, strict=True))
        if robot.cov is not None:
            variance = np.diagonal(np.asarray(robot.cov, dtype=np.float64)).tolist()
            out["start"] |= {"sigma_xy_m": math.sqrt(variance[0]), "sigma_theta_rad": math.sqrt(variance[2])}
    out["sensors"] = {}
    for name, mount in robot.sensors.items():
        sensor = model(mount.sensor)
        if any(mount.at):
            sensor["mount"] = dict(zip(("x_m", "y_m", "theta_rad"), plain(mount.at), strict=False))
        if mount.landmark is not None:
            sensor["landmark"] = model(mount.landmark)
        out["sensors"][name] = sensor
    return out
