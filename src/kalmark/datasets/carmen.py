"""Read logs of the Carnegie Mellon Robot Navigation Toolkit (CARMEN): laser scans and odometry, one message a line.

=========================================  ============================================================================
line                                       numbers
=========================================  ============================================================================
`FLASER`, `RLASER`                         n, n ranges, laser pose (3), odometry (3), time, host, time of the logger
`ODOM`                                     odometry (3), tv, rv, acceleration, time, host, time of the logger
`ROBOTLASER1`, `ROBOTLASER2`               type, first angle, field of view, step, most, accuracy, mode, n, n ranges,
                                           k, k intensities, laser pose (3), odometry (3), 5 of the robot, time, ...
`PARAM robot_frontlaser_offset` and so on  how far ahead of the robot's middle a laser is
=========================================  ============================================================================

The odometry is that of the wheels, as a path; the log has the increments from each pose to the next.  The beams of
`FLASER` and `RLASER` go from right to left over 180 degrees; scans of 181 or 361 beams include both ends, of others
the left end is left out.  Messages without a time, as older logs have them, are one second apart.
"""

from __future__ import annotations

import math
from itertools import pairwise
from pathlib import Path

import numpy as np

from kalmark.arrays import Array
from kalmark.datasets.text_logs import STEP_NS, begins_with
from kalmark.errors import LogError
from kalmark.events import Control, Event, Scan
from kalmark.logs.increments import increment_between
from kalmark.logs.log import Log, Section
from kalmark.logs.source import (
    Format,
    Request,
    nanoseconds_of_text,
    number_of_text,
    one_robot,
    reason_of,
    text_rows,
)
from kalmark.logs.table_columns import BEAM, INCREMENT2

ROBOT = "robot"
LASERS = {"FLASER": "front_laser", "RLASER": "rear_laser", "ROBOTLASER1": "front_laser", "ROBOTLASER2": "rear_laser"}
OFFSETS = {"robot_frontlaser_offset": "front_laser", "robot_rearlaser_offset": "rear_laser"}
MOST_M = 80.0  # of an old laser, which gives this, or a little more, for no return
STARTS = tuple(f"{tag} ".encode() for tag in (*LASERS, "ODOM"))


class _CarmenReader:
    """Gathers the path of the odometry and the scans."""

    def __init__(self, path: Path, request: Request) -> None:
        self.path, self.request = path, request
        self.odometry: dict[int, Array] = {}
        self.scans: dict[tuple[str, int], Array] = {}
        self.offsets: dict[str, float] = {}
        self.unread: dict[str, int] = {}
        self.steps = self.timed = 0

    def take(self, cells: list[str]) -> None:
        """Take one line.  Raises ValueError, IndexError."""
        tag = cells[0]
        if tag == "ODOM":
            if len(cells) < 7:
                raise IndexError
            self.pose(self.time(cells[7:]), cells[1:4])
        elif tag in ("FLASER", "RLASER"):
            n = int(cells[1])
            rest = cells[2 + n :]
            if n < 2 or len(rest) < 6:
                raise ValueError(f"{len(cells)} cells and {n} ranges, expected them, two poses and a time")
            t_ns = self.time(rest[6:])
            both = n % 2 == 1
            step = math.pi / (n - 1 if both else n)
            self.scan(tag, t_ns, cells[2 : 2 + n], -math.pi / 2, step, MOST_M)
            self.pose(t_ns, rest[3:6])
        elif tag in LASERS:
            first, _, step, most = (number_of_text(cell) for cell in cells[2:6])
            n = int(cells[8])
            after = cells[9 + n :]
            rest = after[1 + int(after[0]) :]
            self.scan(tag, nanoseconds_of_text(rest[11]), cells[9 : 9 + n], first, step, most)
            self.pose(nanoseconds_of_text(rest[11]), rest[3:6])
        elif tag == "PARAM" and cells[1] in OFFSETS:
            self.offsets[OFFSETS[cells[1]]] = number_of_text(cells[2])
        elif tag != "PARAM":
            self.unread[tag] = self.unread.get(tag, 0) + 1

    def time(self, cells: list[str]) -> int:
        """Return the time (ns) that a message ends in; the next step of a log without any.  Raises ValueError."""
        if self.steps if cells else self.timed:
            raise ValueError(f"a message {'with' if cells else 'without'} a time, expected all or none to have one")
        if cells:
            self.timed += 1
            return nanoseconds_of_text(cells[0])
        self.steps += 1
        return self.steps * STEP_NS

    def pose(self, t_ns: int, cells: list[str]) -> None:
        """Take a pose of the odometry."""
        self.odometry.setdefault(t_ns, np.array([number_of_text(cell) for cell in cells]))

    def scan(self, tag: str, t_ns: int, cells: list[str], first: float, step: float, most: float) -> None:
        """Take the beams of a scan that returned."""
        r = np.array([number_of_text(cell) for cell in cells])
        if (r < 0).any():
            raise ValueError(f"range {r.min()}, expected ranges of at least 0")
        y = np.column_stack([r, first + step * np.arange(len(r))])
        key = LASERS[tag], t_ns
        if key in self.scans:
            raise ValueError("a second scan at this time, expected one")
        self.scans[key] = y[r < most]

    def events(self) -> list[Event]:
        """Return the increments of the odometry and the scans."""
        events: list[Event] = []
        for (_, before), (t_ns, here) in pairwise(sorted(self.odometry.items())):
            events.append(Control(t_ns=t_ns, robot=ROBOT, u=increment_between(before, here)))
        for (sensor, t_ns), beams in self.scans.items():
            events.append(Scan(t_ns=t_ns, robot=ROBOT, sensor=sensor, y=beams if len(beams) else ()))
        return events


def read(path: Path, request: Request) -> Log:
    """Return the log.  Raises LogError, with file and line."""
    reader = _CarmenReader(path, request)
    for line, cells in text_rows(path):
        try:
            reader.take(cells)
        except (ValueError, IndexError) as error:
            what = "too few cells" if isinstance(error, IndexError) else reason_of(error)
            request.refuse(f"{path}:{line}: {cells[0]}: {what}, expected a message of CARMEN with finite numbers")
    if not reader.odometry:
        raise LogError(f"{path}: no message that can be used, expected {CARMEN.what}")
    for tag, count in sorted(reader.unread.items()):
        request.leave_out(count, f"{path}: {count} {tag} messages, which are not read")
    sensors = sorted({sensor for sensor, _ in reader.scans})
    mounts: Section = {}
    for sensor in sensors:
        behind = {"theta_rad": math.pi} if sensor == "rear_laser" else {}
        mounts[sensor] = {"mount": {"x_m": reader.offsets.get(sensor, 0.0)} | behind}
    told: Section = {"motion": {"type": "odometry_2d"}} | ({"sensors": mounts} if mounts else {})
    return one_robot(
        "carmen", path, request, ROBOT, reader.events(), INCREMENT2, dict.fromkeys(sensors, BEAM),
        name=path.stem, describes={"robots": {ROBOT: told}},
    )  # fmt: skip


def find(path: Path) -> Path | None:
    """Return the file if one of its first lines is a message of CARMEN."""
    known = path.is_file() and path.suffix in (".log", ".clf", ".carmen")
    return path if known and begins_with(path, STARTS) else None


CARMEN = Format("carmen", "a log of CARMEN (.log, .clf): FLASER, RLASER, ODOM, ROBOTLASER1", find, read)
