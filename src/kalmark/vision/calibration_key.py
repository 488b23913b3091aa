"""The key `calibration` of cameras in a configuration: a file of OpenCV, ROS, Kalibr, EuRoC or ORB-SLAM."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from kalmark.config.data_sheets import has_parameter
from kalmark.config.tree import quote_value
from kalmark.errors import ConfigError, LogError
from kalmark.vision.camera_calibration import INTRINSICS, read_calibration


def calibration(path: str | Path, camera: str | None = None) -> dict[str, Any]:
    """Return a camera's calibration (OpenCV, Kalibr, ROS, EuRoC) as parameters of `pinhole`; its mount as `mount`.

    `camera` names one of several in the file.  Raises ConfigError: file, key, value and what was expected.
    """
    try:
        return read_calibration(Path(path), camera)
    except LogError as error:
        raise ConfigError(str(error)) from None


def fits(kind: Any) -> bool:
    """Return whether a type of sensor has the parameters of a calibration."""
    return has_parameter("sensor", kind, INTRINSICS[0])


def values(given: Any, folder: Path, kind: str) -> dict[str, Any]:
    """Return the parameters of a type of sensor by the path of a file, or {file: PATH, camera: NAME}.

    The path is relative to `folder`.  Raises ConfigError.
    """
    several = isinstance(given, dict) and given.keys() == {"file", "camera"}
    file, camera = (given["file"], str(given["camera"])) if several else (given, None)
    if not isinstance(file, str):
        wanted = "the path of a camera's calibration, or {file: PATH, camera: NAME}"
        raise ConfigError(f"got {quote_value(given)}, expected {wanted}")
    found = calibration(folder / file, camera)
    if has_parameter("sensor", kind, "lens"):
        return found
    if np.any(found["distortion"]):
        raise ConfigError(f"got a lens with distortion, expected one without: {kind} has none")
    return {own: value for own, value in found.items() if own not in ("lens", "distortion")}
