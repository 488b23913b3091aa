"""Read the Plaza logs (J. Djugash, B. Hamner, S. Roth, CMU): a robot lawn mower that ranges to four radio beacons.

The text files have the increments of odometry (time, distance, turn) and the ranges (time, receiver, beacon, range);
truth, of the robot and of the beacons, is in the .mat file alone.  docs/datasets.md.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import groupby
from pathlib import Path

import numpy as np

from kalmark.datasets.array_files import arrays
from kalmark.errors import LogError
from kalmark.events import Control, Event, Scan, short_text
from kalmark.logs.log import LandmarkPlaces, Log, Trajectory
from kalmark.logs.source import (
    Format,
    Refuse,
    Request,
    nanoseconds_of_text,
    number_of_text,
    one_robot,
    text_rows,
    timed_rows,
)
from kalmark.logs.table_columns import INCREMENT2

ROBOT, SENSOR = "robot", "radio"
ODOMETRY, RANGES, TRUTH = "_DR.txt", "_TD.txt", "_.mat"


def find(path: Path) -> Path | None:
    """Return the file of odometry, given one of the files or their folder."""
    for ending in (ODOMETRY, RANGES, TRUTH):
        if path.is_file() and path.name.startswith("Plaza") and path.name.endswith(ending):
            path = path.with_name(path.name.removesuffix(ending) + ODOMETRY)
            return path if path.is_file() else None
    files = sorted(path.glob(f"Plaza*{ODOMETRY}")) if path.is_dir() else []
    return files[0] if len(files) == 1 else None


def read(path: Path, request: Request) -> Log:
    """Return the log: an increment ends at its time, its turn is half before and half after its way."""
    name = path.name.removesuffix(ODOMETRY)
    steps = timed_rows(path, ("distance_m", "dtheta_rad"), request.refuse)
    events: list[Event] = [
        Control(t_ns=t_ns, robot=ROBOT, u=[along * np.cos(turn / 2), along * np.sin(turn / 2), turn])
        for _, t_ns, (along, turn) in steps
    ]
    events += range_scans(path.with_name(name + RANGES), request)
    truth, beacons = read_truth(path.with_name(name + TRUTH))
    columns, sensors = INCREMENT2, {SENSOR: ("range_m",)}
    return one_robot("plaza", path.parent, request, ROBOT, events, columns, sensors,
                     name=name.lower(), truth=truth, landmarks=beacons)  # fmt: skip


def range_scans(path: Path, request: Request) -> Iterator[Scan]:
    """Return the ranges of each time; of a beacon that answered twice the second is left out and listed.

    The file is in pieces that overlap in time: their rows are sorted.
    """
    table = sorted(ranges(path, request.refuse), key=lambda row: row[1])
    if not table:
        raise LogError(f"{path}: no range that can be used, expected columns t_s, receiver, beacon, range_m")
    for t_ns, group in groupby(table, key=lambda row: row[1]):
        seen: dict[int, float] = {}
        for line, _, beacon, value in group:
            if beacon in seen:
                request.skipped.append(f"{path}:{line}: beacon {beacon} twice at one time, expected it once")
            seen.setdefault(beacon, value)
        yield Scan(t_ns=t_ns, robot=ROBOT, sensor=SENSOR, y=[[r] for r in seen.values()], ids=list(seen))


def ranges(path: Path, refuse: Refuse) -> Iterator[tuple[int, int, int, float]]:
    """Yield line, time, beacon and range of each row; bad rows go to `refuse`."""
    if not path.is_file():
        raise LogError(f"{path}: no such file, expected the ranges that belong to the odometry beside it")
    for line, cells in text_rows(path):
        try:
            t, _, beacon, value = cells
            row = line, nanoseconds_of_text(t), int(number_of_text(beacon)), number_of_text(value)
            if row[3] < 0:
                raise ValueError
        except ValueError:
            refuse(
                f"{path}:{line}: {short_text(' '.join(cells))}, "
                "expected time, receiver, beacon and a range of at least 0"
            )
        else:
            yield row


def read_truth(path: Path) -> tuple[dict[str, Trajectory], LandmarkPlaces]:
    """Return the true path of the robot and the surveyed beacons, nothing without the file."""
    if not path.is_file():
        return {}, {}
    data = arrays(path, ("GT", "TL"))
    if data["GT"].shape[1:] != (4,) or data["TL"].shape[1:] != (3,):
        raise LogError(
            f"{path}: shapes are GT {data['GT'].shape}, TL {data['TL'].shape}, expected 4 columns (time, x, y, "
            "heading) and 3 (beacon, x, y)"
        )
    t_ns = np.rint(data["GT"][:, 0] * 1e9).astype(np.int64)
    beacons: LandmarkPlaces = {int(row[0]): row[1:].copy() for row in data["TL"]}
    return {ROBOT: Trajectory(t_ns, data["GT"][:, 1:])}, beacons


PLAZA = Format("plaza", "a folder with Plaza1_DR.txt and Plaza1_TD.txt", find, read)
