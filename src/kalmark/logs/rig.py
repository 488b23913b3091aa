"""What the logs of space share: poses from other conventions, and the rig that a log describes."""

from __future__ import annotations

from typing import Any

import numpy as np

from kalmark.geometry import rotations
from kalmark.logs.log import Array


def frame(position: Any, matrix: Any) -> Array:
    """Return the frame (7,), x y z qx qy qz qw, of a position (3,) and a rotation matrix (3, 3), local to global."""
    turn = rotations.from_matrix(np.array(matrix, dtype=np.float64))
    return np.append(np.asarray(position, dtype=np.float64).reshape(3), turn)


def vector_frame(position: Any, vector: Any) -> Array:
    """Return the frame (7,) of a position (3,) m and a rotation vector (3,) rad."""
    turn = rotations.exp(np.array(vector, dtype=np.float64))
    return np.append(np.asarray(position, dtype=np.float64).reshape(3), turn)


def placed(pose: Array) -> dict[str, float]:
    """Return a frame (7,) as a configuration gives mounts and starts: x_m, y_m, z_m, roll_deg, pitch_deg, yaw_deg."""
    angles = np.degrees(rotations.to_euler(np.array(pose[3:], dtype=np.float64))[0]).round(12) + 0.0  # no -0
    names = ("x_m", "y_m", "z_m", "roll_deg", "pitch_deg", "yaw_deg")
    return dict(zip(names, [*map(float, pose[:3]), *map(float, angles)], strict=True))


def named(prefix: str, axes: str, suffix: str, values: Any) -> dict[str, float]:
    """Return one key for each axis: `named("sigma_v", "xyz", "_mps", (1, 2, 3))` has sigma_vx_mps = 1, ..."""
    return {f"{prefix}{axis}{suffix}": float(value) for axis, value in zip(axes, values, strict=True)}
