"""The layout of TUM RGB-D (Sturm and others, 2012): `rgb.txt`, `depth.txt` and `groundtruth.txt`.

The robot is the colour camera.  A depth image belongs to the colour image nearest in time, within 20 ms; with depth
images the camera is one that measures depths (`pixel_depth`).
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Literal

import numpy as np

from kalmark.datasets.images.rigs import CAMERA, ROBOT, calibration_beside, camera_log, camera_section, files_by_time
from kalmark.declare import Within
from kalmark.logs.log import Log, Section
from kalmark.logs.poses import read_path
from kalmark.logs.source import Format, Request, text_rows
from kalmark.vision.camera_calibration import INTRINSICS
from kalmark.vision.image_files import DEPTH_SCALE, frames_of

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
    listed = files_by_time(path, path / "rgb.txt", text_rows(path / "rgb.txt"))
    depths: dict[int, Path] = {}
    if depth == "auto" and (path / "depth.txt").is_file():
        depths = match_times([*listed], files_by_time(path, path / "depth.txt", text_rows(path / "depth.txt")))
    frames = frames_of(ROBOT, CAMERA, [*listed], [*listed.values()], request, [*map(depths.get, listed)], depth_scale)
    poses = path / "groundtruth.txt"
    truth = {ROBOT: read_path(poses, request)} if poses.is_file() else {}
    section = camera_section(frames, calibration_beside(path) or published_calibration(path.resolve().name))
    if depths:
        section["type"] = "pixel_depth"
    return camera_log("tum_rgbd", path, request, frames, {CAMERA: section}, name=path.name, truth=truth)


def published_calibration(name: str) -> Section:
    """Return the published calibration of a sequence by its name, {} if the name does not have the camera."""
    series = _SERIES.search(name)
    if series is None:
        return {}
    k, d = PUBLISHED[series[1]]
    return dict(zip(INTRINSICS, k, strict=True)) | SIZE | {"lens": "radtan", "distortion": [*d]}


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
