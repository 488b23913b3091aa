"""Read "Lost in the Woods" (T. Barfoot, University of Toronto): one robot, 17 cylinders, a laser, 10 Hz.

The laser sits `d` = 0.219 m ahead of the robot's centre: give its mount in the configuration.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from kalmark.errors import LogError
from kalmark.events import Control, Event, Scan, order
from kalmark.logs.log import Log, Trajectory
from kalmark.logs.matlab import arrays, column, variables
from kalmark.logs.source import Format, Request, quantity

ROBOT, SENSOR, FILE = "robot", "laser", "dataset2.mat"
COLUMNS = {"range_bearing": ("range_m", "bearing_rad"), "bearing": ("bearing_rad",)}
NAMES = ("t", "v", "om", "r", "b", "l", "x_true", "y_true", "th_true", "true_valid")


def find(path: Path) -> Path | None:
    """Return the MATLAB file, given it or its folder."""
    file = path / FILE if path.is_dir() else path
    return file if file.suffix == ".mat" and variables(file) >= set(NAMES) else None


def read(path: Path, request: Request, r_max: Any = None, measured: Any = "range_bearing") -> Log:
    """Return the log; ranges over `r_max` m are dropped, as the course does (None: all are kept).

    Of what was `measured` only bearings may be asked for, "bearing".

    A control at t acts from t on and the scan at t is of the same instant; a range of 0 means "not seen".  A scan that
    saw nothing stays in the log, empty: the robot's path is scored there too.
    """
    if measured not in COLUMNS:
        raise LogError(f"{path}: measured is {measured!r}, expected {' or '.join(COLUMNS)}")
    limit = float("inf") if r_max is None else quantity(r_max, "r_max", 0.0)
    data = arrays(path, NAMES)
    t_ns = np.rint(column(data["t"]) * 1e9).astype(np.int64)
    count = len(t_ns)
    for name, value in data.items():
        if name != "l" and len(value) != count:
            raise LogError(f"{path}: {name} has {len(value)} rows, expected {count} as t has")
    if not (np.diff(t_ns) > 0).all():
        row = int(np.argmin(np.diff(t_ns) > 0)) + 2
        raise LogError(f"{path}: t row {row} is not after row {row - 1}, expected increasing times")
    if (data["r"] < 0).any():
        row, landmark = (int(i) + 1 for i in np.argwhere(data["r"] < 0)[0])
        raise LogError(f"{path}: r row {row}, column {landmark} is negative, expected ranges of at least 0")
    controls = np.column_stack([column(data["v"]), column(data["om"])])
    poses = np.column_stack([column(data[name]) for name in ("x_true", "y_true", "th_true")])
    valid = column(data["true_valid"]) == 1
    events: list[Event] = []
    for t, u, r, b in zip(t_ns.tolist(), controls, data["r"], data["b"], strict=True):
        events.append(Control(t_ns=t, robot=ROBOT, u=u))
        seen = np.flatnonzero((r > 0) & (r <= limit))
        y = np.column_stack([r[seen], b[seen]])[:, -len(COLUMNS[measured]) :]
        events.append(Scan(t_ns=t, robot=ROBOT, sensor=SENSOR, y=y, ids=(seen + 1).tolist()))
    return Log(
        name="lost_in_the_woods",
        format="lost_in_the_woods",
        path=path,
        robots=(ROBOT,),
        events=sorted(events, key=order),
        truth={ROBOT: Trajectory(t_ns[valid], poses[valid])} if valid.any() else {},
        landmarks={i + 1: position for i, position in enumerate(data["l"])},
        skipped=request.skipped,
        control_columns={ROBOT: ("v_mps", "w_radps")},
        sensor_columns={(ROBOT, SENSOR): COLUMNS[measured]},
    )


LOST_IN_THE_WOODS = Format("lost_in_the_woods", f"{FILE} or its folder", find, read, options=("r_max", "measured"))
