"""Read UTIAS MRCLAM: five robots, fifteen landmarks with barcodes, range and bearing from a camera.

K. Leung et al., "The UTIAS multi-robot cooperative localization and mapping dataset" (docs/datasets.md).
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated

from kalmark.datasets.text_logs import read_points
from kalmark.declare import Number
from kalmark.errors import LogError
from kalmark.events import Control, Event, Id, Scan, short_text, sort_key
from kalmark.logs.log import Log, Names, Trajectory
from kalmark.logs.source import Format, Request, one_of, text_rows, timed_rows
from kalmark.logs.table_columns import BEAM

SENSOR = "camera"
MRCLAM_ROBOTS = tuple(f"robot{n}" for n in range(1, 6))
"""Subjects 1 to 5, the others are landmarks."""
_ROBOT_FILE = re.compile(r"Robot([1-5])_(Odometry|Measurement|Groundtruth)\.dat")


def find(path: Path) -> Path | None:
    """Return the dataset's folder, given it or a file in it."""
    folder = path if path.is_dir() else path.parent
    if path.is_file() and not _ROBOT_FILE.fullmatch(path.name) and path.name != "Barcodes.dat":
        return None
    return folder if robots_in(folder) else None


def robots_in(folder: Path) -> Names:
    """Return the names of the robots that the folder has odometry or measurements of."""
    found = (_ROBOT_FILE.fullmatch(file.name) for file in folder.iterdir())
    numbers = {int(match[1]) for match in found if match and match[2] != "Groundtruth"}
    return tuple(f"robot{n}" for n in sorted(numbers))


def read(
    path: Path,
    request: Request,
    bearing_shift_s: Annotated[Number, "Added to the time of every observation."] = 0.0,
    robot_sightings: Annotated[bool, "Use the robots' observations of each other."] = True,
) -> Log:
    """Return the log of the wanted robots; measurements take the time of their stamp plus `bearing_shift_s`.

    Measurements of barcodes that belong to no subject are left out and always listed in `skipped`, those of other
    robots only with `robot_sightings=False`.
    """
    present = robots_in(path)
    for robot in request.robots or ():
        if robot not in present:
            raise LogError(f"{path}: no robot {robot!r}, {one_of(present, robot)}")
    shift_ns = round(bearing_shift_s * 1e9)
    subjects = read_barcodes(path / "Barcodes.dat", request)
    ignored = () if robot_sightings else MRCLAM_ROBOTS
    robots = tuple(robot for robot in present if request.includes(robot))
    events: list[Event] = []
    truth = {}
    for robot in robots:
        stem = robot.replace("robot", "Robot")
        moved, seen, true = (path / f"{stem}_{what}.dat" for what in ("Odometry", "Measurement", "Groundtruth"))
        if moved.is_file():
            table = timed_rows(moved, ("v_mps", "w_radps"), request.refuse)
            events += [Control(t_ns=t_ns, robot=robot, u=u) for _, t_ns, u in table]
        else:
            request.refuse(f"{moved}: no such file, expected the odometry of {robot} (a set of measurements only?)")
        if seen.is_file():
            events += read_measurements(seen, robot, subjects, shift_ns, request, ignored)
        if true.is_file():
            truth[robot] = read_truth(true, request)
    landmarks = path / "Landmark_Groundtruth.dat"
    return Log(
        path.name, robots, sorted(events, key=sort_key), "mrclam", path, truth,
        read_points(landmarks, request.refuse, int, (3, 4, 5), "subject, x, y and their deviations"),
        skipped=request.skipped, control_columns=dict.fromkeys(robots, ("v_mps", "w_radps")),
        sensor_columns={(robot, SENSOR): BEAM for robot in robots},
    )  # fmt: skip


def read_barcodes(path: Path, request: Request) -> dict[int, Id]:
    """Return the landmark id of each barcode: the subject's number, or the robot's name."""
    subjects: dict[int, Id] = {}
    for line, cells in text_rows(path):
        try:
            subject, barcode = map(int, cells)
            subjects[barcode] = f"robot{subject}" if subject <= len(MRCLAM_ROBOTS) else subject
        except ValueError:
            request.refuse(f"{path}:{line}: {short_text(' '.join(cells))}, expected a subject and its barcode")
    return subjects


def read_measurements(
    path: Path, robot: str, subjects: dict[int, Id], shift_ns: int, request: Request, ignored: tuple[Id, ...]
) -> list[Event]:
    """Return the scans of one robot: the measurements of one stamp are one scan."""
    scans: dict[int, dict[Id, list[float]]] = {}
    unknown: dict[int, list[int]] = {}  # lines by barcode
    observations = 0
    for line, t_ns, (barcode, *y) in timed_rows(path, ("barcode", "range_m", "bearing_rad"), request.refuse):
        subject = subjects.get(int(barcode))
        if y[0] < 0:
            request.refuse(f"{path}:{line}: range_m is {y[0]}, expected a range of at least 0")
        elif subject is None:
            unknown.setdefault(int(barcode), []).append(line)
        elif subject in ignored:
            observations += 1
        elif subject in scans.setdefault(t_ns + shift_ns, {}):
            request.refuse(f"{path}:{line}: subject {subject} twice at one time, expected each once in a scan")
        else:
            scans[t_ns + shift_ns][subject] = y
    for code, lines in sorted(unknown.items()):
        told = f"{path}:{lines[0]}: {len(lines)} of barcode {code}, which no subject carries"
        request.leave_out(len(lines), told)
    if observations:
        request.leave_out(observations, f"{path}: {observations} observations of robots (robot_sightings is false)")
    made = ((t_ns, list(seen), list(seen.values())) for t_ns, seen in scans.items() if seen)
    return [Scan(t_ns=t_ns, robot=robot, sensor=SENSOR, y=y, ids=ids) for t_ns, ids, y in made]


def read_truth(path: Path, request: Request) -> Trajectory:
    """Return the true poses of one robot; rows of a repeated time are refused."""
    rows = timed_rows(path, ("x_m", "y_m", "theta_rad"), request.refuse, strictly=True)
    poses = {t_ns: pose for _, t_ns, pose in rows}
    if not poses:
        raise LogError(f"{path}: no row that can be used, expected true poses")
    return Trajectory.of(poses)


MRCLAM = Format("mrclam", "a folder with Barcodes.dat and RobotN_Odometry.dat, RobotN_Measurement.dat", find, read,
                robot_prefix="robot", robots=MRCLAM_ROBOTS)  # fmt: skip
