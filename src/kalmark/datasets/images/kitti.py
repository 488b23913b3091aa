"""The layout of KITTI's odometry benchmark (Geiger and others, 2012): `image_0`, `times.txt`, `calib.txt`, true poses.

The robot is the left grey camera, whose poses the benchmark has, in `poses.txt` or in `../../poses/NUMBER.txt`; with
the images of the right one, `image_1`, it is a rectified pair (`stereo`).  Of colour: `image_2` and `image_3`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import numpy as np

from kalmark.datasets.images.folder import TIMES, images_in, read_times
from kalmark.datasets.images.rigs import CAMERA, ROBOT, camera_log, camera_section
from kalmark.errors import LogError
from kalmark.logs.log import Log, Section, Trajectory
from kalmark.logs.poses import kitti_rows
from kalmark.logs.source import Format, Request, number_of_text, text_rows
from kalmark.vision.camera_calibration import INTRINSICS
from kalmark.vision.image_files import frames_of

FOLDERS = "image_0", "image_2"  # of the left grey and the left colour camera
CALIBRATION = "calib.txt"


def find(path: Path) -> Path | None:
    """Return the folder of a sequence: with images, their times and the calibration."""
    there = path.is_dir() and any((path / name).is_dir() for name in FOLDERS)
    return path if there and (path / TIMES).is_file() and (path / CALIBRATION).is_file() else None


def read(
    path: Path,
    request: Request,
    right: Annotated[Literal["auto", "none"], "Take the images of the right camera, if there are any."] = "auto",
) -> Log:
    """Return the log.  Raises LogError."""
    folder = next(path / name for name in FOLDERS if (path / name).is_dir())
    files, other = images_in(folder), path / f"image_{int(folder.name[-1]) + 1}"
    t_ns = read_times(path / TIMES, len(files))
    pair = right == "auto" and other.is_dir()
    rights = [other / file.name for file in files] if pair else [None] * len(files)
    frames = frames_of(ROBOT, CAMERA, t_ns, files, request, rights=rights)
    own, shared = path / "poses.txt", path.resolve().parent.parent / "poses" / f"{path.resolve().name}.txt"
    file = next((file for file in (own, shared) if file.is_file()), None)
    found = {} if file is None else dict(kitti_rows(file, request, np.array(t_ns)))
    truth = {ROBOT: Trajectory.of(found)} if found else {}
    section = camera_section(frames, projection(path / CALIBRATION, f"P{folder.name[-1]}:")[0])
    if pair:
        section |= {"type": "stereo", "baseline_m": baseline(path / CALIBRATION, folder.name[-1], other.name[-1])}
    return camera_log("kitti_odometry", path, request, frames, {CAMERA: section}, name=path.name, truth=truth)


def baseline(file: Path, left: str, right: str) -> float:
    """Return the baseline [m] from the left to the right camera, by their numbers.  Raises LogError."""
    at = [projection(file, f"P{number}:")[1] for number in (left, right)]
    if not at[1] > at[0]:
        raise LogError(f"{file}: camera {right} is {at[1] - at[0]:g} m to the right of {left}, expected more than 0")
    return at[1] - at[0]


def projection(file: Path, name: str) -> tuple[Section, float]:
    """Return the intrinsics of a camera's matrix (3, 4) in a file of KITTI, and its place along x [m].

    Raises LogError.
    """
    for line, cells in text_rows(file):
        if cells[0] != name:
            continue
        try:
            P = np.array([number_of_text(cell) for cell in cells[1:]]).reshape(3, 4)
        except ValueError:
            raise LogError(f"{file}:{line}: {len(cells) - 1} cells, expected 12 finite numbers") from None
        found = dict(zip(INTRINSICS, (float(v) for v in (P[0, 0], P[1, 1], P[0, 2], P[1, 2])), strict=True))
        return found, -float(P[0, 3] / P[0, 0])
    raise LogError(f"{file}: no row {name}, expected the camera's matrix")


KITTI_ODOMETRY = Format("kitti_odometry", "a sequence of KITTI's odometry benchmark with image_0, times.txt and "
                        "calib.txt", find, read, describes_all=True)  # fmt: skip
