"""A folder of images, or a video: one camera that is moved by hand.

The time of an image is its name, or a row of `times.txt`, or its number over the rate `fps`.  A calibration beside the
images (`rigs.CALIBRATIONS`) is taken; true poses are `groundtruth.txt` of TUM, `poses.txt` of KITTI, or
`cam_traj_truth.txt` of the New Tsukuba set, a row an image: x y z in cm in the axes of a camera, and the rotation row
by row in those of OpenGL (y up, z to the back): the images turn so.
"""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np

from kalmark.datasets.images.rigs import CAMERA, ROBOT, calibration_beside, camera_log, camera_section, no_times
from kalmark.declare import Within
from kalmark.errors import LogError
from kalmark.events import Frame, short_text
from kalmark.logs.log import Log, Trajectory
from kalmark.logs.poses import kitti_rows, read_path
from kalmark.logs.source import (
    Format,
    Request,
    frame,
    nanoseconds_of_text,
    number_of_text,
    rows_in_time,
    text_rows,
)
from kalmark.vision.image_files import ENDINGS, Forward, frames_of, video_facts, video_images

VIDEOS = (".mp4", ".avi", ".mkv", ".mov", ".webm", ".m4v", ".mpg", ".mpeg", ".ogv")
TIMES = "times.txt"
OPTICAL = np.diag([1.0, -1.0, -1.0])  # of the axes of OpenGL, in which New Tsukuba turns: y up, z to the back
TRUE_POSES = "groundtruth.txt", "poses.txt", "cam_traj_truth.txt"
NEW_TSUKUBA = {"fx_px": 615.0, "fy_px": 615.0, "cx_px": 320.0, "cy_px": 240.0, "width_px": 640, "height_px": 480}
_NUMBER = re.compile(r"[0-9]+(?:\.[0-9]+)?")
UNITS_NS = {10: 1_000_000_000, 13: 1_000_000, 16: 1_000, 19: 1}  # of a time since 1970, by its digits


def images_in(path: Path) -> list[Path]:
    """Return the image files in a folder, in the order of the numbers in their names."""
    inside = [file for file in path.iterdir() if file.suffix.lower() in ENDINGS and file.is_file()]
    return sorted(inside, key=lambda file: ([int(n) for n in re.findall("[0-9]+", file.stem)], file.name))


def find(path: Path) -> Path | None:
    """Return the folder that has the images: this one, or the only one in it."""
    if not path.is_dir():
        return None
    if any(file.suffix.lower() in ENDINGS for file in path.iterdir()):
        return path
    inside = [child for child in path.iterdir() if child.is_dir() and find(child) == child]
    return inside[0] if len(inside) == 1 else None


Rate = Annotated[float | None, Within(ge=1e-3), "Images a second, where they have no times, or others."]


def read(path: Path, request: Request, fps: Rate = None) -> Log:
    """Return the log of a folder of images.  Raises LogError."""
    files = images_in(path)
    t_ns = times_of(path, files, fps)
    frames = frames_of(ROBOT, CAMERA, t_ns, files, request)
    return _log("images", path, request, frames, t_ns, path)


def find_video(path: Path) -> Path | None:
    """Return the video, given it or a folder that has one and no more."""
    if path.is_dir():
        inside = [file for file in path.iterdir() if find_video(file)] if find(path) is None else []
        return inside[0] if len(inside) == 1 else None
    return path if path.suffix.lower() in VIDEOS else None


def read_video(path: Path, request: Request, fps: Rate = None) -> Log:
    """Return the log of a video.  Raises LogError."""
    count, rate = video_facts(path)
    rate = rate if fps is None else fps
    if not rate:
        raise LogError(f"{path}: the video has no rate, expected log.fps (Hz)")
    images = Forward(partial(video_images, path))
    t_ns = [round(k * 1e9 / rate) for k in range(count)]
    frames = [Frame(t_ns=t, robot=ROBOT, sensor=CAMERA, image=partial(images.at, k)) for k, t in enumerate(t_ns)]
    return _log("video", path, request, frames, t_ns, path.parent)


def _log(format: str, path: Path, request: Request, frames: list[Frame], t_ns: list[int], folder: Path) -> Log:
    """Return the log of frames with what is beside the images, or beside their folder."""
    places = (folder, folder.parent) if format == "images" else (folder,)
    known = next(filter(None, map(calibration_beside, places)), {})
    file = next((place / name for place in places for name in TRUE_POSES if (place / name).is_file()), None)
    truth = {} if file is None else {ROBOT: true_path(file, t_ns, request)}
    known = known or (NEW_TSUKUBA if file is not None and file.name == TRUE_POSES[2] else {})
    return camera_log(
        format, path, request, frames, {CAMERA: camera_section(frames, known)}, name=path.stem, truth=truth
    )


def times_of(path: Path, files: list[Path], fps: float | None) -> list[int]:
    """Return the times (ns) of images, which increase.  Raises LogError."""
    beside = next((place / TIMES for place in (path, path.parent) if (place / TIMES).is_file()), None)
    if fps is not None:
        return [round(k * 1e9 / fps) for k in range(len(files))]
    if beside is not None:
        return read_times(beside, len(files))
    found = [named_time(file.stem) for file in files]
    t_ns = [t for t in found if t is not None]
    if len(t_ns) < len(files):
        raise no_times(path, f"the name {short_text(files[found.index(None)].name)} is no time")
    bad = next((k for k in range(1, len(t_ns)) if t_ns[k] <= t_ns[k - 1]), None)
    if bad is not None:
        raise no_times(path, f"{files[bad].name} is not after {files[bad - 1].name}")
    return t_ns


def named_time(stem: str) -> int | None:
    """Return the time (ns) that a name is: seconds with decimals, or s, ms, us or ns since 1970; None if it is none."""
    if not _NUMBER.fullmatch(stem):
        return None
    if "." in stem:
        return nanoseconds_of_text(stem)
    return int(stem) * UNITS_NS[len(stem)] if len(stem) in UNITS_NS else None


def read_times(file: Path, count: int) -> list[int]:
    """Return the times (ns) of so many images: the first number of each row, in s.  Raises LogError."""
    t_ns = [t for _, t, _ in rows_in_time(file, text_rows(file))]
    if len(t_ns) != count:
        raise LogError(f"{file}: {len(t_ns)} times for {count} images, expected one each")
    return t_ns


def true_path(file: Path, t_ns: list[int], request: Request) -> Trajectory:
    """Return the true poses of a camera, those of a file without times at the times (ns) of all its images.

    Raises LogError.
    """
    if file.name == TRUE_POSES[0]:
        return read_path(file, request)
    if file.name == TRUE_POSES[1]:
        return Trajectory.of(dict(kitti_rows(file, request, np.array(t_ns))))
    poses = []
    for line, cells in text_rows(file):
        try:
            numbers = np.array([number_of_text(cell) for cell in cells]).reshape(4, 3)
        except ValueError:
            raise LogError(f"{file}:{line}: {len(cells)} cells, expected 12 finite numbers") from None
        poses.append(frame(0.01 * numbers[0], OPTICAL @ numbers[1:] @ OPTICAL))
    if len(poses) != len(t_ns):
        raise LogError(f"{file}: {len(poses)} poses for {len(t_ns)} images, expected one each")
    return Trajectory(np.array(t_ns), np.array(poses))


IMAGES = Format("images", "a folder of images", find, read, describes_all=True, general=True)
VIDEO = Format("video", "a video", find_video, read_video, describes_all=True, general=True)
