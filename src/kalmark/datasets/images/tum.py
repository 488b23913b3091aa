"""The layout of TUM RGB-D (Sturm and others, 2012): `rgb.txt`, `depth.txt` and `groundtruth.txt`.

The robot is the colour camera.  A depth image belongs to the colour image nearest in time, within 20 ms; with depth
images the camera is one that measures depths (`pixel_depth`).
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np

from kalmark.datasets.images.rigs import CAMERA, ROBOT, calibration_beside, camera_log, camera_section
from kalmark.declare import Within
from kalmark.errors import LogError
from kalmark.logs.camera_calibration import INTRINSICS
from kalmark.logs.image_files import DEPTH_SCALE, frames_of
from kalmark.logs.log import Log
from kalmark.logs.poses import read_path
from kalmark.logs.source import Format, Request, increasing_times

NEAR_NS = 20_000_000
SIZE = {"width_px": 640, "height_px": 480}
PUBLISHED = {  # fx, fy, cx, cy and distortion k1, k2, p1, p2, k3 of the colour cameras, 640 x 480
    "1": ((517.306, 516.469, 318.643, 255.314), (0.262383, -0.953104, -0.005358, 0.002628, 1.163314)),
    "2": ((520.908620, 521.007327, 325.141442, 249.701764), (0.231222, -0.784899, -0.003257, -0.000105, 0.917205)),
    "3": ((535.4, 539.2, 320.1, 247.6), (0.0, 0.0, 0.0, 0.0, 0.0)),
}
_SERIES = re.compile(r"(?:freiburg|fr)([123])(?![0-9])")


def find(path: Path) -> Path | None:
    """Return the folder if it has `rgb.txt`."""
    folder = path if path.is_dir() else path.parent
    return folder if (path.is_dir() or path.name == "rgb.txt") and (folder / "rgb.txt").is_file() else None


def read(
    path: Path,
    request: Request,
    depth: Annotated[Literal["auto", "none"], "Take the depth images, if there are any."] = "auto",
    depth_scale: Annotated[float, Within(ge=1e-3), "The number of 1 m in a depth image."] = DEPTH_SCALE,
) -> Log:
    """Return the log.  Raises LogError."""
    listed = read_list(path / "rgb.txt")
    depths: dict[int, Path] = {}
    if depth == "auto" and (path / "depth.txt").is_file():
        depths = match_times([*listed], read_list(path / "depth.txt"))
    frames = frames_of(ROBOT, CAMERA, [*listed], [*listed.values()], request, [*map(depths.get, listed)], depth_scale)
    poses = path / "groundtruth.txt"
    truth = {ROBOT: read_path(poses, request)} if poses.is_file() else {}
    section = camera_section(frames, calibration_beside(path) or published_calibration(path.resolve().name))
    if depths:
        section["type"] = "pixel_depth"
    return camera_log("tum_rgbd", path, request, frames, {CAMERA: section}, name=path.name, truth=truth)


def published_calibration(name: str) -> dict[str, Any]:
    """Return the published calibration of a sequence by its name, {} if the name does not have the camera."""
    series = _SERIES.search(name)
    if series is None:
        return {}
    k, d = PUBLISHED[series[1]]
    return dict(zip(INTRINSICS, k, strict=True)) | SIZE | {"lens": "radtan", "distortion": [*d]}


def read_list(file: Path) -> dict[int, Path]:
    """Return files by their times (ns), which increase, of rows `t_s file`.  Raises LogError."""
    found: dict[int, Path] = {}
    for line, t_ns, names in increasing_times(file):
        if len(names) != 1:
            raise LogError(f"{file}:{line}: {len(names) + 1} cells, expected a time and a file")
        found[t_ns] = file.parent / names[0]
    if not found:
        raise LogError(f"{file}:1: no rows of data, expected times and files")
    return found


def match_times(t_ns: list[int], others: dict[int, Path]) -> dict[int, Path]:
    """Return by time (ns) the other file nearest in time; each belongs to one time, within `NEAR_NS`."""
    times, own = np.array([*others]), np.array(t_ns)
    found: dict[int, Path] = {}
    taken: dict[int, int] = {}
    for t in own.tolist():
        other = int(times[np.argmin(np.abs(times - t))])
        before = taken.get(other)
        if abs(other - t) > NEAR_NS or (before is not None and abs(before - other) <= abs(t - other)):
            continue
        if before is not None:
            del found[before]
        found[t], taken[other] = others[other], t
    return found


TUM_RGBD = Format("tum_rgbd", "a folder with rgb.txt of TUM RGB-D", find, read, describes_all=True)
