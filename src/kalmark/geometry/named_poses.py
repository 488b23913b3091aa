"""Poses by the keys that configurations have for them: metres, and degrees in space."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from kalmark.arrays import Array
from kalmark.geometry.rotations import from_euler, to_euler

POSES = {
    "plane": ("x_m", "y_m", "theta_rad"),
    "space": ("x_m", "y_m", "z_m", "roll_deg", "pitch_deg", "yaw_deg"),
}


def world_of(said: Mapping[str, Any]) -> str:
    """Return "plane" or "space", where the keys of a mount or a start have it."""
    return "plane" if "theta_rad" in said else "space"


def describe_pose(pose: Any) -> dict[str, float]:
    """Return a pose (3,) or (7,) by its keys: x, y and theta; in space x, y, z, roll, pitch and yaw."""
    pose = [float(value) for value in pose]
    if len(pose) == 3:
        return dict(zip(POSES["plane"], pose, strict=True))
    angles = np.degrees(to_euler(np.array(pose[3:7]))[0]).round(12) + 0.0  # no -0
    return dict(zip(POSES["space"], (*pose[:3], *angles.tolist()), strict=True))


def pose_of(said: Mapping[str, Any]) -> Array:
    """Return the pose that a mount or a start describes: (3,) in the plane, (7,) in space; what is absent is 0."""
    given = [float(said.get(key, 0.0)) for key in POSES[world_of(said)]]
    if len(given) == 3:
        return np.array(given)
    q = said.get("quaternion")
    return np.append(given[:3], from_euler(np.radians(given[3:]))[0] if q is None else q)
