"""Read two sets of steps without times: the DLR Spatial Cognition set (U. Frese) and the Freiburg SLAM course's world.

Step k ends at k seconds, and the scan of what was seen after it is of the same instant.

DLR: metric steps and circular landmarks with covariances.  The file's robot frame has X to the right and -Y forward, so
its third axis points down and its headings grow clockwise.  kalmark's frame is x forward, y left, z up:

    x = -Y,  y = -X,  theta = -Phi          M = [[0, -1, 0], [-1, 0, 0], [0, 0, -1]]

`M` carries increments (u = M u_file, C = M C_file M^T), its upper left block observations.  A path or map in the
file's frame becomes one in kalmark's by the same exchange of axes.

Freiburg: a simulated robot that rotates, translates, rotates; range and bearing, known ids.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np

from kalmark.arrays import Array
from kalmark.datasets.text_logs import STEP_NS, begins_with, file_in, read_points
from kalmark.declare import Within
from kalmark.errors import LogError
from kalmark.events import Control, Event, Id, Scan, short_text
from kalmark.logs.log import Log
from kalmark.logs.source import (
    Format,
    Request,
    landmark_id,
    number_of_text,
    one_robot,
    text_rows,
)
from kalmark.logs.table_columns import BEAM, INCREMENT2, POSITION

ROBOT = "robot"
M = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
ORDER = np.array([[0, 1, 3], [1, 2, 4], [3, 4, 5]])  # of the file's cXX cXY cYY cXPhi cYPhi cPhiPhi in a covariance
SPURIOUS = -1


class Record(NamedTuple):
    """One line: the increment of a step, or an observation `y` of the landmark `id` after it."""

    is_step: bool
    y: Any
    cov: Array | None = None
    id: Id | None = None


def find(path: Path, name: str, starts: tuple[bytes, ...]) -> Path | None:
    """Return the file of this name, given it or its folder, if one of its first lines has one of these starts."""
    file = file_in(path, name)
    return file if file.is_file() and begins_with(file, starts, 8192) else None


def events_of(
    path: Path, request: Request, sensor: str, read: Callable[[str, list[str]], Record | None], expected: str, step: str
) -> list[Event]:
    """Return the events of a file whose lines `read` turns into records (None: left out); ValueError refuses a line."""
    steps: list[tuple[Record, list[Record]]] = []
    for line, cells in text_rows(path):
        where = f"{path}:{line}"
        try:
            record = read(where, cells)
        except ValueError:
            request.refuse(f"{where}: {short_text(' '.join(cells))}, expected {expected}")
            continue
        if record is None:
            continue
        if record.is_step:
            steps.append((record, []))
        elif not steps:
            request.refuse(f"{where}: an observation before the first step, expected it after one")
        elif record.id is not None and any(record.id == other.id for other in steps[-1][1]):
            request.refuse(f"{where}: id {record.id!r} twice after one step, expected each landmark once in a scan")
        else:
            steps[-1][1].append(record)
    if not steps:
        raise LogError(f"{path}: no step that can be used, expected {step}")
    events: list[Event] = []
    for t_ns, (moved, seen) in enumerate(steps, 1):
        events.append(Control(t_ns=t_ns * STEP_NS, robot=ROBOT, u=moved.y, cov=moved.cov))
        if seen:
            y, ids = [one.y for one in seen], [one.id for one in seen]
            cov = None if seen[0].cov is None else [one.cov for one in seen]
            events.append(Scan(t_ns=t_ns * STEP_NS, robot=ROBOT, sensor=sensor, y=y, ids=ids, cov=cov))
    return events


def read_dlr(
    path: Path,
    request: Request,
    covariance_scale: Annotated[float, Within(ge=1e-9), "Multiplies all covariances of the file."] = 1.0,
) -> Log:
    """Return the log; the id -1 (spurious) becomes None."""
    expected = (
        "STEP image dX dY dPhi cXX cXY cYY cXPhi cYPhi cPhiPhi"
        " or LANDMARK_C pX pY quality cXX cXY cYY id, with covariances that are positive definite"
    )
    events = events_of(path, request, "camera", partial(dlr_record, scale=covariance_scale), expected, "STEP lines")
    return one_robot("dlr", path, request, ROBOT, events, INCREMENT2, {"camera": POSITION[:2]})


def dlr_record(where: str, cells: list[str], scale: float) -> Record:
    """Return one line of the DLR set, both sorts with three numbers and a covariance.  Raises ValueError."""
    if cells[0] == "STEP" and len(cells) == 11:
        n, values, id_ = 3, [number_of_text(cell) for cell in cells[2:]], None
    elif cells[0] in ("LANDMARK_C", "LANDMARK") and len(cells) == 8:
        n, values, id_ = 2, [number_of_text(cell) for cell in cells[1:7]], landmark_id(cells[7])
    else:
        raise ValueError
    m, cov = M[:n, :n], np.array(values[3:])[ORDER[:n, :n]]
    np.linalg.cholesky(cov)  # its LinAlgError is a ValueError
    return Record(n == 3, m @ values[:n], scale * (m @ cov @ m.T), None if id_ == SPURIOUS else id_)


def read_freiburg(path: Path, request: Request) -> Log:
    """Return the log; each step is an increment in the frame of the pose before it.

    The simulated noise makes a range negative where the robot passes over a landmark: those observations are left
    out and always listed in `skipped`.
    """
    expected = "ODOMETRY r1 t r2 or SENSOR id range bearing"
    record = partial(freiburg_record, request=request)
    events = events_of(path, request, "sensor", record, expected, "ODOMETRY r1 t r2")
    landmarks = read_points(path.parent / "world.dat", request.refuse, landmark_id, (3,), "id, x and y")
    return one_robot("freiburg_course", path, request, ROBOT, events, INCREMENT2, {"sensor": BEAM}, landmarks=landmarks)


def freiburg_record(where: str, cells: list[str], request: Request) -> Record | None:
    """Return one line of the course: turn by r1, drive t, turn by r2, or an observation.  Raises ValueError."""
    kind, first, *rest = cells
    if kind not in ("ODOMETRY", "SENSOR") or len(rest) != 2:
        raise ValueError
    a, b = map(number_of_text, rest)
    if kind == "ODOMETRY":
        r1 = number_of_text(first)
        return Record(True, (a * math.cos(r1), a * math.sin(r1), r1 + b))
    if a < 0:
        request.skipped.append(f"{where}: range is {a}, expected a range of at least 0")
        return None
    return Record(False, (a, b), id=landmark_id(first))


DLR = Format("dlr", "map.circles or its folder",
             partial(find, name="map.circles", starts=(b"STEP ", b"LANDMARK_C ")), read_dlr)  # fmt: skip
FREIBURG = Format("freiburg_course", "sensor_data.dat or its folder",
                  partial(find, name="sensor_data.dat", starts=(b"ODOMETRY ", b"SENSOR ")), read_freiburg)  # fmt: skip
