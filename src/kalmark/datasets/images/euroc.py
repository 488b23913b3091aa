"""The layout of EuRoC (Burri and others, 2016), ASL's: `mav0` with cameras, an inertial unit and the true states.

The robot is the inertial unit; `T_BS` of a camera's sensor.yaml is its mount.  The readings from the first image to the
last drive the robot, with the noise of the data sheet or, where the unit shakes, of the readings.  It starts in its
true state at the first image where the log has that, else at rest.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

import numpy as np

from kalmark.arrays import Array
from kalmark.config.data_sheets import data_sheet
from kalmark.datasets.images.rigs import MOTION, ROBOT, camera_log, camera_section, files_by_time
from kalmark.errors import LogError
from kalmark.events import Control, Frame, short_text
from kalmark.files import unpack_file
from kalmark.geometry.named_poses import describe_pose
from kalmark.logs.log import Log, Names, Section, Times, Trajectory, interpolate
from kalmark.logs.source import Format, Request, one_of, raise_refusal, read_text, timed_rows
from kalmark.logs.table_columns import INERTIAL, POSITION, TWIST3
from kalmark.models.motion import noise_densities
from kalmark.vision.camera_calibration import read_calibration
from kalmark.vision.image_files import frames_of

TRUE_STATES = "state_groundtruth_estimate0/data.csv"
ADIS16448 = {  # the data sheet in EuRoC's imu0/sensor.yaml
    "gyroscope_noise_density_rad_per_sqrt_s": 1.6968e-4,
    "gyroscope_random_walk_radps_per_sqrt_s": 1.9393e-5,
    "accelerometer_noise_density_mps_per_sqrt_s": 2.0e-3,
    "accelerometer_random_walk_mps2_per_sqrt_s": 3.0e-3,
}
DENSITIES = tuple(ADIS16448)[::2]  # not the walks
SURE = {
    "sigma_rotation_deg": [1.0, 1.0, 0.0],
    "sigma_v_mps": 0.05,
    "sigma_bias_w_radps": 0.01,
    "sigma_bias_a_mps2": 0.1,
}
AT_REST = {"at_rest": True, "sigma_bias_w_radps": 0.1, "sigma_bias_a_mps2": 0.1}
BIASES = tuple(f"bias_{name}" for name in INERTIAL)
STATE = (*POSITION, "qw", "qx", "qy", "qz", *TWIST3[:3], *BIASES)


def find(path: Path) -> Path | None:
    """Return the folder `mav0`, given it or the one around it."""
    return next((f for f in (path, path / "mav0") if (f / "cam0" / "data.csv").is_file()), None)


def read(
    path: Path,
    request: Request,
    cameras: Annotated[Names, "The cameras, by the names of their folders."] = ("cam0",),
    imu: Annotated[Literal["auto", "none"], "Let the inertial unit move the robot, if there is one."] = "auto",
) -> Log:
    """Return the log of these cameras.  Raises LogError."""
    there = sorted(folder.name for folder in path.glob("cam*") if (folder / "data.csv").is_file())
    for name in cameras:
        if name not in there:
            raise LogError(f"{path}: no camera {short_text(name)}, {one_of(there, name)}")
    frames: list[Frame] = []
    sections: Section = {}
    for name in cameras:
        file = path / name / "data.csv"
        listed = files_by_time(path / name / "data", file, lines_of(file), "ns")
        taken = frames_of(ROBOT, name, [*listed], [*listed.values()], request)
        calibration = read_calibration(path / name / "sensor.yaml")
        frames, sections[name] = [*frames, *taken], camera_section(taken, calibration)
    begin, end = (pick(frame.t_ns for frame in frames) for pick in (min, max))
    states = true_states(path)
    truth = {} if states is None else {ROBOT: Trajectory(states.t_ns, states.rows[:, :7])}
    readings = csv_of(path / "imu0" / "data.csv", INERTIAL) if imu == "auto" else None
    name = (path.resolve().parent if path.name == "mav0" else path).name
    if readings is None:
        return camera_log("euroc", path, request, frames, sections, MOTION, name=name, truth=truth)
    start = None if states is None else start_section(states, begin)
    half_ns = int(np.median(np.diff(readings.t_ns))) // 2 if len(readings.t_ns) > 1 else 0
    since = readings.t_ns - half_ns  # a reading is of the interval around its time
    first = int(np.searchsorted(since, begin, "right")) - 1 if start is not None else 0
    if first < 0:
        raise LogError(f"{path / 'imu0'}: the readings begin after the first image, expected some before it")
    kept = slice(first, int(np.searchsorted(since, end, "right")))
    times, u = since[kept], readings.rows[kept]
    held = np.maximum(times, begin) if start is not None else times  # the first one, from the start on
    controls = [Control(t_ns=t, robot=ROBOT, u=one) for t, one in zip(held.tolist(), u, strict=True)]
    motion: Section = {"type": "inertial"} | inertial_noise(path / "imu0" / "sensor.yaml")
    for key, density in zip(DENSITIES, noise_densities(np.asarray(times * 1e-9), u), strict=True):
        motion[key] = max(motion[key], density)
    return camera_log("euroc", path, request, [*frames, *controls], sections, motion, INERTIAL, name=name, truth=truth,
                      start=AT_REST if start is None else start)  # fmt: skip


class TimedRows(NamedTuple):
    """Rows (N, m) at times (N,) ns."""

    t_ns: Times
    rows: Array


def lines_of(file: Path) -> Iterator[tuple[int, list[str]]]:
    """Yield (line, cells) of a CSV file, packed or not, without its comments.  Raises LogError."""
    packed = file.with_name(f"{file.name}.gz")
    try:
        text = b"".join(unpack_file(packed, LogError)).decode() if packed.is_file() else read_text(file)
    except UnicodeDecodeError as error:
        raise LogError(f"{packed}: {error}, expected UTF-8") from None
    for line, content in enumerate(text.splitlines(), 1):
        if content.strip() and not content.lstrip().startswith("#"):
            yield line, [cell.strip() for cell in content.split(",")]


def csv_of(file: Path, names: Names) -> TimedRows | None:
    """Return a table of EuRoC, ns and numbers, without rows that run back in time; None if there is no such file.

    Raises LogError.
    """
    if not file.is_file() and not file.with_name(f"{file.name}.gz").is_file():
        return None
    rows = [*timed_rows(file, names, raise_refusal, lines_of(file), "ns", strictly=True)]
    t_ns = np.array([t_ns for _, t_ns, _ in rows], dtype=np.int64)
    return TimedRows(t_ns, np.array([numbers for *_, numbers in rows]))


def true_states(path: Path) -> TimedRows | None:
    """Return the true states: x y z, qx qy qz qw, velocity, biases of rate and force (16,); None without a file.

    They are those of the layout, or of the only file `gt*.csv` beside `mav0`.  Raises LogError.
    """
    others = sorted(path.resolve().parent.glob("gt*.csv"))
    file = path / TRUE_STATES
    if not file.is_file():
        if len(others) != 1:
            return None
        file = others[0]
    table = csv_of(file, STATE)
    assert table is not None
    order = [0, 1, 2, 4, 5, 6, 3, *range(7, 16)]  # EuRoC's quaternions begin with w
    states = table.rows[:, order]
    states[:, 3:7] /= np.linalg.norm(states[:, 3:7], axis=1, keepdims=True)
    return TimedRows(table.t_ns, states)


def start_section(states: TimedRows, t_ns: int) -> Section | None:
    """Return the true state at a time (ns) as the section of a start, None if that is outside the true states."""
    after = int(np.searchsorted(states.t_ns, t_ns))
    if t_ns < states.t_ns[0] or after == len(states.t_ns):
        return None
    before = max(after - 1, 0)
    span = max(int(states.t_ns[after] - states.t_ns[before]), 1)
    share = (t_ns - int(states.t_ns[before])) / span if after > before else 0.0
    a, b = states.rows[before], states.rows[after]
    pose = interpolate(a[None, :7], b[None, :7], np.array([share]))[0]
    rest = a[7:] + share * (b[7:] - a[7:])
    return describe_pose(pose) | dict(zip((*TWIST3[:3], *BIASES), map(float, rest), strict=True)) | SURE


def inertial_noise(file: Path) -> dict[str, float]:
    """Return the noise of the inertial unit: of its sensor.yaml, without one that of EuRoC's.  Raises ConfigError."""
    return data_sheet(file) if file.is_file() else dict(ADIS16448)


EUROC = Format("euroc", "a folder mav0 with cam0/data.csv of EuRoC", find, read, describes_all=True)
