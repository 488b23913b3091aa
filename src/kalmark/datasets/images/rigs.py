"""The description of a log of images: a camera that moves in space, and the search in its images."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from kalmark.errors import LogError
from kalmark.events import Event, Frame
from kalmark.logs.log import Log, Names, Section
from kalmark.logs.source import Request, one_robot, rows_in_time
from kalmark.vision.camera_calibration import read_calibration
from kalmark.vision.image_files import image_size

ROBOT, CAMERA = "robot", "camera"
MOTION = {"type": "constant_velocity_3d", "sigma_v_mps_per_sqrt_s": 1.0, "sigma_w_radps_per_sqrt_s": 2.0}
"""Of a camera that is moved by hand."""
START = {"sigma_v_mps": 0.3, "sigma_w_radps": 0.5}
SEARCH = {
    "detector": {"type": "active_search"},
    "landmark": {"type": "homogeneous", "prior_rho_per_m": 0.5, "sigma_rho_per_m": 0.5},
}
"""Search for landmarks; of one camera alone the depths with which they begin are the unit of length."""
CALIBRATIONS = ("calibration.yaml", "camera.yaml", "camera_info.yaml", "calibration.yml", "camera.yml", "config.yml")


def camera_section(frames: Sequence[Frame], known: Mapping[str, Any] | None = None) -> Section:
    """Return the section of a pin-hole camera: what is known of it, for images of the size of these.

    A calibration for images of another size is scaled: the centre of the first pixel is 0.
    """
    size, found = image_size(frames), dict(known or {})
    for axis, name in (("x", "width_px"), ("y", "height_px")):
        scale = size[name] / found.get(name, size[name])
        if scale != 1.0:
            found[f"f{axis}_px"] *= scale
            found[f"c{axis}_px"] = (found[f"c{axis}_px"] + 0.5) * scale - 0.5
    return {"type": "pinhole"} | found | size | SEARCH


def calibration_beside(folder: Path) -> Section:
    """Return the calibration in a folder, by the file names that programs give it, {} if there is none.

    Raises LogError if it cannot be read.
    """
    file = next((folder / name for name in CALIBRATIONS if (folder / name).is_file()), None)
    if file is None:
        return {}
    found = read_calibration(file)
    found.pop("mount", None)  # on a body that this log does not have
    return found


def camera_log(
    format: str, path: Path, request: Request, events: Iterable[Event], sensors: Mapping[str, Any],
    motion: Mapping[str, Any] = MOTION, controls: Names = (), **rest: Any,
) -> Log:  # fmt: skip
    """Return the log of a robot with cameras, `sensors` by name, whose frames are among the events."""
    start = rest.pop("start", START)
    robot = {"motion": dict(motion), "start": dict(start), "sensors": dict(sensors)}
    rig: Section = {"robots": {ROBOT: robot}, "map": {"type": "dense"}}  # most landmarks are in view
    if motion is MOTION:
        rig["estimator"] = {"type": "ekf"}  # one linearisation: docs/vision.md
    return one_robot(format, path, request, ROBOT, events, controls, {}, describes=rig, **rest)


def files_by_time(folder: Path, file: Path, rows: Iterable[tuple[int, list[str]]], unit: str = "s") -> dict[int, Path]:
    """Return files in a folder by their times (ns), which increase, of the rows of a file: a time and a name each.

    Raises LogError.
    """
    found: dict[int, Path] = {}
    for line, t_ns, names in rows_in_time(file, rows, unit=unit):
        if len(names) != 1:
            raise LogError(f"{file}:{line}: {len(names) + 1} cells, expected a time and a file")
        found[t_ns] = folder / names[0]
    return found


def no_times(path: Path, what: str) -> LogError:
    """Return the error of images without times."""
    return LogError(f"{path}: {what}, expected times: names that are times, times.txt beside them, or log.fps (Hz)")
