"""The layout of KITTI's odometry benchmark (Geiger and others, 2012): `image_0`, `times.txt`, `calib.txt`, true poses.

The robot is the left grey camera, whose poses the benchmark has, in `poses.txt` or in `../../poses/NUMBER.txt`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from kalmark.errors import LogError
from kalmark.logs.calibration import INTRINSICS
from kalmark.logs.images.folder import TIMES, images_in, read_times
from kalmark.logs.images.pictures import frames_of
from kalmark.logs.images.rigs import CAMERA, ROBOT, camera, camera_log
from kalmark.logs.log import Log, Trajectory
from kalmark.logs.poses import kitti_rows
from kalmark.logs.source import Format, Request, number, rows

FOLDERS = "image_0", "image_2"  # of the left grey and the left colour camera
CALIBRATION = "calib.txt"


def find(path: Path) -> Path | None:
    """Return the folder of a sequence: with images, their times and the calibration."""
    there = path.is_dir() and any((path / name).is_dir() for name in FOLDERS)
    return path if there and (path / TIMES).is_file() and (path / CALIBRATION).is_file() else None


def read(path: Path, request: Request) -> Log:
    """Return the log.  Raises LogError."""
    folder = next(path / name for name in FOLDERS if (path / name).is_dir())
    files = images_in(folder)
    t_ns = read_times(path / TIMES, len(files))
    frames = frames_of(ROBOT, CAMERA, t_ns, files, request)
    own, shared = path / "poses.txt", path.resolve().parent.parent / "poses" / f"{path.resolve().name}.txt"
    file = next((file for file in (own, shared) if file.is_file()), None)
    found = {} if file is None else dict(kitti_rows(file, request, np.array(t_ns)))
    truth = {ROBOT: Trajectory(np.array([*found]), np.array([*found.values()]))} if found else {}
    section = camera(frames, projection(path / CALIBRATION, f"P{folder.name[-1]}:"))
    return camera_log("kitti_odometry", path, request, frames, {CAMERA: section}, name=path.name, truth=truth)


def projection(file: Path, name: str) -> dict[str, Any]:
    """Return the intrinsics of a camera's matrix (3, 4) in a file of KITTI.  Raises LogError."""
    for line, cells in rows(file):
        if cells[0] != name:
            continue
        try:
            P = np.array([number(cell) for cell in cells[1:]]).reshape(3, 4)
        except ValueError:
            raise LogError(f"{file}:{line}: {len(cells) - 1} cells, expected 12 finite numbers") from None
        return dict(zip(INTRINSICS, (float(v) for v in (P[0, 0], P[1, 1], P[0, 2], P[1, 2])), strict=True))
    raise LogError(f"{file}: no row {name}, expected the camera's matrix")


KITTI_ODOMETRY = Format("kitti_odometry", "a sequence of KITTI's odometry benchmark with image_0, times.txt and "
                        "calib.txt", find, read, describes_all=True)  # fmt: skip
