"""The configuration of a filter built in Python, read off its models, in the form of a configuration file."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np

from kalmark.geometry.rotations import to_euler

TYPES = {
    "Unicycle": "unicycle",
    "Odometry2D": "odometry_2d",
    "Ackermann": "ackermann",
    "Odometry3D": "odometry_3d",
    "Velocity3D": "velocity_3d",
    "ConstantVelocity3D": "constant_velocity_3d",
    "RangeBearing": "range_bearing",
    "Bearing": "bearing",
    "Range": "range",
    "Position2D": "position",
    "RangeBearingSignature": "range_bearing_signature",
    "RangeBearing3D": "range_bearing_3d",
    "Position3D": "position_3d",
    "PinHole": "pinhole",
    "Omnidirectional": "omnidirectional",
    "Stereo": "stereo",
    "Segments": "segments",
    "TagPose": "tag_pose",
    "TagCorners": "tag_corners",
    "Point2D": "point",
    "Point3D": "point",
    "Polar2D": "polar",
    "InverseDepth2D": "inverse_depth",
    "InverseDepth3D": "inverse_depth",
    "AnchoredHomogeneous": "anchored_homogeneous",
    "Homogeneous": "homogeneous",
    "Tag": "tag",
    "PlueckerLine": "pluecker_line",
    "AnchoredPlueckerLine": "anchored_pluecker_line",
    "InverseDepthLine": "inverse_depth_line",
    "AnchoredHomogeneousLine": "anchored_homogeneous_line",
    "HomogeneousLine": "homogeneous_line",
    "PointSignature2D": "point_signature",
    "Delayed": "delayed",
    "ByIdentity": "identity",
    "NearestNeighbour": "nearest",
    "GlobalAssignment": "global",
    "JointCompatibility": "jcbb",
    "Trunks": "trunks",
    "Reflectors": "reflectors",
    "Corners": "corners",
    "Cliques": "clique",
    "Sampled": "sample",
    "Averaged": "jpda",
    "Automatic": "auto",
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
    out["upkeep"] = _keys(slam.upkeep)
    out["estimator"] = model(slam.estimator)
    return out


def _keys(value: Any) -> dict[str, Any]:
    return {key: value for key, value in model(value).items() if key != "type"}


def _robot(robot: Any) -> dict[str, Any]:
    out: dict[str, Any] = {"motion": model(robot.motion)}
    out["start"] = _start(robot)
    out["sensors"] = {}
    for name, mount in robot.sensors.items():
        sensor = model(mount.sensor)
        at = describe_pose(mount.at)
        if any(at.values()):
            sensor["mount"] = at
        for part in ("landmark", "association", "detector", "initialization"):
            if getattr(mount, part, None) is not None:
                sensor[part] = model(getattr(mount, part))
        attention = getattr(mount, "attention", None)
        if attention is not None and attention != type(attention)():
            sensor["attention"] = _keys(attention)
        if getattr(mount, "upkeep", None) is not None:
            sensor["upkeep"] = _keys(mount.upkeep)
        if getattr(mount, "cov", None) is not None:
            sensor["mount"] = at | _sigmas(mount.cov)
        out["sensors"][name] = sensor
    return out


def _start(robot: Any) -> dict[str, float]:
    out = describe_pose(robot.start)
    out |= dict(
        zip(("vx_mps", "vy_mps", "vz_mps", "wx_radps", "wy_radps", "wz_radps"), plain(robot.start)[7:], strict=False)
    )
    return out if robot.cov is None else out | _sigmas(robot.cov)


def describe_pose(pose: Any) -> dict[str, float]:
    """Return a pose as configuration files have it: (x, y, theta), in space (x, y, z, roll, pitch, yaw)."""
    pose = [float(value) for value in pose]
    if len(pose) == 3:
        return dict(zip(("x_m", "y_m", "theta_rad"), pose, strict=True))
    roll, pitch, yaw = np.degrees(to_euler(np.array(pose[3:7]))[0]).tolist()
    return dict(zip(("x_m", "y_m", "z_m"), pose[:3], strict=True)) | {
        "roll_deg": roll,
        "pitch_deg": pitch,
        "yaw_deg": yaw,
    }


def _sigmas(cov: Any) -> dict[str, float]:
    """Return the sigmas of a covariance as configuration files have them, one for all axes."""
    sigma = np.sqrt(np.diagonal(np.asarray(cov, dtype=np.float64))).tolist()
    if len(sigma) == 3:
        return {"sigma_xy_m": sigma[0], "sigma_theta_rad": sigma[2]}
    out = {"sigma_position_m": sigma[0], "sigma_rotation_deg": math.degrees(sigma[3])}
    return out if len(sigma) == 6 else out | {"sigma_v_mps": sigma[6], "sigma_w_radps": sigma[9]}
