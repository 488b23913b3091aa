"""Read the simulated world of the Freiburg SLAM course: rotate, translate, rotate; range and bearing, known ids."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from kalmark.errors import LogError
from kalmark.events import Id
from kalmark.logs.log import Array, Log
from kalmark.logs.source import Format, Request
from kalmark.logs.steps import Steps
from kalmark.logs.text import landmark_id, number, rows

ROBOT, SENSOR, FILE = "robot", "sensor", "sensor_data.dat"


def find(path: Path) -> Path | None:
    """Return the file of steps and observations, given it or its folder."""
    file = path / FILE if path.is_dir() else path
    if not file.is_file():
        return None
    with file.open("rb") as stream:
        return file if stream.readline(200).startswith((b"ODOMETRY ", b"SENSOR ")) else None


def read(path: Path, request: Request) -> Log:
    """Return the log: step k, an increment in the frame of the pose before it, ends at k seconds.

    The simulated noise makes a range negative where the robot passes over a landmark: those observations are left
    out and always listed in `skipped`.
    """
    steps = Steps(ROBOT, SENSOR)
    for line, cells in rows(path):
        where = f"{path}:{line}"
        try:
            if cells[0] == "ODOMETRY":
                steps.step(increment(*(number(cell) for cell in exactly(cells[1:], 3))))
            elif cells[0] == "SENSOR":
                name, *rest = exactly(cells[1:], 3)
                y = [number(cell) for cell in rest]
                if y[0] < 0:
                    request.skipped.append(f"{where}: range is {y[0]}, expected a range of at least 0")
                    continue
                steps.see(y, landmark_id(name), request.refuse, where)
            else:
                raise ValueError
        except ValueError:
            request.refuse(f"{where}: {' '.join(cells)!r}, expected ODOMETRY r1 t r2 or SENSOR id range bearing")
    events = steps.close()
    if not events:
        raise LogError(f"{path}: no step that can be used, expected ODOMETRY r1 t r2")
    return Log(
        name="freiburg_course",
        format="freiburg_course",
        path=path,
        robots=(ROBOT,),
        events=events,
        landmarks=read_landmarks(path.parent / "world.dat", request),
        skipped=request.skipped,
        control_columns={ROBOT: ("dx_m", "dy_m", "dtheta_rad")},
        sensor_columns={(ROBOT, SENSOR): ("range_m", "bearing_rad")},
    )


def increment(r1: float, t: float, r2: float) -> tuple[float, float, float]:
    """Return (dx, dy, dtheta) of turning by r1, driving t and turning by r2."""
    return t * math.cos(r1), t * math.sin(r1), r1 + r2


def exactly(cells: list[str], count: int) -> list[str]:
    """Return the cells if there are `count` of them.  Raises ValueError."""
    if len(cells) != count:
        raise ValueError(cells)
    return cells


def read_landmarks(path: Path, request: Request) -> dict[Id, Array]:
    """Return the true landmarks of `world.dat`, or {} without the file."""
    landmarks: dict[Id, Array] = {}
    if path.is_file():
        for line, cells in rows(path):
            try:
                name, x, y = exactly(cells, 3)
                landmarks[landmark_id(name)] = np.array([number(x), number(y)])
            except ValueError:
                request.refuse(f"{path}:{line}: {' '.join(cells)!r}, expected id, x and y")
    return landmarks


FREIBURG = Format("freiburg_course", f"{FILE} or its folder", find, read)
