"""Read "Lost in the Woods" (T. Barfoot, University of Toronto): one robot, 17 cylinders, a laser, 10 Hz.

The laser sits `d` = 0.219 m ahead of the robot's centre: give its mount in the configuration.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import numpy as np

from kalmark.datasets.array_files import arrays, events_of, find_variables, times
from kalmark.declare import Within
from kalmark.errors import LogError
from kalmark.logs.log import Log, Trajectory
from kalmark.logs.source import Format, Request, one_robot
from kalmark.logs.table_columns import BEAM

ROBOT, SENSOR, FILE = "robot", "laser", "dataset2.mat"
COLUMNS = {"range_bearing": BEAM, "bearing": ("bearing_rad",)}
NAMES = ("t", "v", "om", "r", "b", "l", "x_true", "y_true", "th_true", "true_valid")


def read(
    path: Path,
    request: Request,
    r_max: Annotated[float | None, Within(gt=0), "Drop observations beyond this range, as the course does."] = None,
    measured: Annotated[
        Literal["range_bearing", "bearing"], "Take ranges and bearings, or bearings alone."
    ] = "range_bearing",
) -> Log:
    """Return the log.

    A control at t acts from t on and the scan at t is of the same instant; a range of 0 means "not seen".  A scan that
    saw nothing stays in the log, empty: the robot's path is scored there too.
    """
    limit = float("inf") if r_max is None else r_max
    data = arrays(path, NAMES)
    count = data["t"].size
    for name, value in data.items():
        if name != "l" and len(value) != count:
            raise LogError(f"{path}: {name} has {len(value)} rows, expected {count} as t has")
    t_ns = times(path, data["t"], "t row {row} is not after row {before}, expected increasing times")
    r, b = data["r"], data["b"]
    if (r < 0).any():
        row, landmark = (int(i) + 1 for i in np.argwhere(r < 0)[0])
        raise LogError(f"{path}: r row {row}, column {landmark} is negative, expected ranges of at least 0")
    u, poses = (np.column_stack([data[name].reshape(-1) for name in names]) for names in (("v", "om"), NAMES[6:9]))
    seen = [np.flatnonzero((row > 0) & (row <= limit)) for row in r]
    y = [np.column_stack([r[k, i], b[k, i]])[:, -len(COLUMNS[measured]) :] for k, i in enumerate(seen)]
    events = events_of(ROBOT, SENSOR, t_ns, u, zip(y, [(i + 1).tolist() for i in seen], strict=True))
    valid = data["true_valid"].reshape(-1) == 1
    return one_robot(
        "lost_in_the_woods",
        path,
        request,
        ROBOT,
        events,
        ("v_mps", "w_radps"),
        {SENSOR: COLUMNS[measured]},
        truth={ROBOT: Trajectory(t_ns[valid], poses[valid])} if valid.any() else {},
        landmarks={i + 1: position for i, position in enumerate(data["l"])},
    )


find = partial(find_variables, FILE, NAMES)
LOST_IN_THE_WOODS = Format("lost_in_the_woods", f"{FILE} or its folder", find, read)
