"""What the logs of space share: poses from other conventions, YAML files, and the rig that a log describes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from kalmark.errors import LogError
from kalmark.geometry import rotations
from kalmark.logs.log import Array
from kalmark.logs.text import read_text


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


def mapping(path: Path) -> dict[str, Any]:
    """Return the content of a YAML file.  Raises LogError if it is none."""
    try:
        content = YAML(typ="safe").load(read_text(path))
    except YAMLError as error:
        where = getattr(error, "problem_mark", None)
        line = where.line + 1 if where is not None else 1
        raise LogError(f"{path}:{line}: not YAML ({getattr(error, 'problem', error)}), expected a mapping") from None
    if not isinstance(content, dict):
        raise LogError(f"{path}:1: holds {type(content).__name__}, expected a mapping")
    return content
