"""Read kalmark's own log, a folder of CSV files with headers (docs/datasets.md, "Native logs").

`controls.csv`  t_s, robot, the control's columns[, own noise]
`scans.csv`     t_s, robot, sensor, id, the sensors' columns[, own noise]; a sensor leaves the others' columns empty
`fixes.csv`     t_s, robot, x_m, y_m[, z_m], own noise
`truth.csv`     t_s, robot, x_m, y_m, theta_rad | x_m, y_m, z_m, qx, qy, qz, qw
`landmarks.csv` id, x_m, y_m[, z_m][, x2_m, y2_m, z2_m | qx, qy, qz, qw]: points, both ends of lines, poses of tags
`gps.csv`       t_s, robot, x_m, y_m, antenna_x_m, antenna_y_m: fixes that only score a run
`rig.yaml`      what the log describes of its robots and sensors, in the shape of a configuration

A row of `scans.csv` whose id and values are all empty is a scan that saw nothing.

Own noise is either a column `sigma_<column>` for each column, or the upper triangle `cov_00, cov_01, cov_11, ...`
numbered in the order of the columns (`cov_xx, cov_xy, cov_yy, ...` where they are x_m, y_m[, z_m]).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import numpy as np

from kalmark.errors import LogError
from kalmark.events import Control, Event, Fix, Id, Scan, order
from kalmark.logs.log import Array, Log, PositionTrack, Trajectory
from kalmark.logs.rig import mapping
from kalmark.logs.source import Format, Request, folder_of, nearest
from kalmark.logs.stray import Places, refuse_misspelt
from kalmark.logs.table import CONTROL, OBSERVATION, Row, Table, read_table
from kalmark.logs.text import landmark_id, seconds

RIG = "rig.yaml"
FILES = ("controls.csv", "scans.csv", "fixes.csv", "truth.csv", "landmarks.csv", "gps.csv")
LANDMARK3 = ("x_m", "y_m", "z_m", "x2_m", "y2_m", "z2_m", "qx", "qy", "qz", "qw")
POSE2, POSE3 = ("x_m", "y_m", "theta_rad"), ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")
LANDMARKS = (LANDMARK3[:2], LANDMARK3[:3], LANDMARK3[:6], POSE3)
"""The columns of a point of the plane, of one of space, of a line and of a tag, as `Log.landmarks` has them."""


def read(path: Path, request: Request) -> Log:
    """Return the native log in a folder.  Raises LogError with file and line."""
    if not any((path / name).is_file() for name in FILES[:3]):
        raise LogError(f"{path}: no controls.csv, scans.csv or fixes.csv, expected at least one of them")
    others = [file.name for file in path.glob("*.csv") if file.name not in FILES]
    for name in FILES:
        near = [] if (path / name).is_file() else get_close_matches(name, others, n=1, cutoff=0.85)
        if near:
            raise LogError(f"{path / near[0]}: a file of this name is not read, expected {name}")
    events: list[Event] = []
    control_columns: dict[str, tuple[str, ...]] = {}
    sensor_columns: dict[tuple[str, str], tuple[str, ...]] = {}
    places: Places = {}
    if (path / "controls.csv").is_file():
        events += read_controls(path / "controls.csv", request, control_columns, places)
    if (path / "scans.csv").is_file():
        events += read_scans(path / "scans.csv", request, sensor_columns, places)
    if (path / "fixes.csv").is_file():
        events += read_fixes(path / "fixes.csv", request, places)
    truth = optional(path / "truth.csv", read_truth, request)
    describes = mapping(path / RIG) if (path / RIG).is_file() else {}
    seen = {name for event in events if isinstance(event, Scan) for name in event.ids or ()}
    strays = refuse_misspelt(places, {*truth, *describes.get("robots", ()), *map(str, seen)}, request)
    events = [event for event in events if event.robot not in strays]
    robots = tuple(dict.fromkeys(event.robot for event in events))
    return Log(
        name=path.name,
        path=path,
        robots=robots,
        events=sorted(events, key=order),
        truth=truth,
        landmarks=optional(path / "landmarks.csv", read_landmarks, request),
        gps=optional(path / "gps.csv", read_gps, request),
        skipped=request.skipped,
        control_columns={robot: names for robot, names in control_columns.items() if robot not in strays},
        sensor_columns={key: names for key, names in sensor_columns.items() if key[0] not in strays},
        places={(robot, sensor): (file, line) for (file, robot, sensor), line in reversed(places.items())},
        describes=describes,
    )


def optional(path: Path, reader: Callable[[Path, Request], dict[Any, Any]], request: Request) -> dict[Any, Any]:
    """Return what a file holds, or {} if the log does not have it."""
    return reader(path, request) if path.is_file() else {}


def read_controls(path: Path, request: Request, columns: dict[str, tuple[str, ...]], places: Places) -> list[Event]:
    """Return the controls of `controls.csv` and note the columns of each robot's and where they begin."""
    events: list[Event] = []
    for row in timed(read_table(path, ("t_s", "robot"), known=CONTROL), request):
        places.setdefault((path, row.robot, ""), row.line)
        u = row.values(columns, row.robot, request)
        if u is None:
            continue
        cov = row.own_noise(columns[row.robot], request, definite=False)
        if cov is not False:
            events.append(Control(t_ns=row.t_ns, robot=row.robot, u=u, cov=cov))
    return events


@dataclass
class Rows:
    """Gather the observations of one scan; a bad row refuses the whole scan, an empty one says it saw nothing."""

    y: list[list[float]] = field(default_factory=list)
    ids: list[Id | None] = field(default_factory=list)
    covs: list[Array | None] = field(default_factory=list)
    lines: list[int] = field(default_factory=list)
    bad: bool = False
    empty: bool = False


def read_scans(path: Path, request: Request, columns: dict[Any, tuple[str, ...]], places: Places) -> list[Event]:
    """Return the scans of `scans.csv`, one a robot, sensor and time; note each sensor's columns and where it begins."""
    scans: dict[tuple[int, str, str], Rows] = {}
    table = read_table(path, ("t_s", "robot", "sensor", "id"), known=OBSERVATION)
    for row in timed(table, request, by_sensor=True):
        places.setdefault((path, row.robot, row.sensor), row.line)
        rows = scans.setdefault((row.t_ns, row.robot, row.sensor), Rows())
        rows.bad |= not add_row(rows, row, request, columns)
    events: list[Event] = []
    for (t_ns, robot, sensor), rows in scans.items():
        if rows.bad:
            request.leave_out(len(rows.lines), f"{path}: scan of {robot} by {sensor} at t={seconds(t_ns)} s, all of it")
            continue
        covs = [cov for cov in rows.covs if cov is not None]
        cov = np.array(covs) if covs else None
        events.append(Scan(t_ns=t_ns, robot=robot, sensor=sensor, y=rows.y, ids=rows.ids, cov=cov))
    return events


def add_row(rows: Rows, row: Row, request: Request, columns: dict[Any, tuple[str, ...]]) -> bool:
    """Add one row of `scans.csv` to its scan; return False if it was refused."""
    key = (row.robot, row.sensor)
    empty = not any(row.text(name) for name in ("id", *row.table.value_columns, *row.table.noise_columns))
    if rows.empty or (empty and rows.lines):
        return row.refuse(request, "an empty row and others in one scan, expected it alone: the scan saw nothing")
    if empty:
        rows.empty = True
        return True
    y = row.values(columns, key, request)
    if y is None:
        return False
    cov = row.own_noise(columns[key], request, definite=True)
    if cov is False:
        return False
    text = row.text("id")
    name = landmark_id(text) if text else None
    if name is not None and name in rows.ids:
        first = rows.lines[rows.ids.index(name)]
        return row.refuse(request, f"id {name!r} is in this scan already (line {first}), expected each landmark once")
    if rows.covs and (rows.covs[0] is None) != (cov is None):
        return row.refuse(request, "own noise in some rows of this scan only, expected it in all of them or in none")
    rows.y.append(y)
    rows.ids.append(name)
    rows.covs.append(cov)
    rows.lines.append(row.line)
    return True


def read_fixes(path: Path, request: Request, places: Places) -> list[Event]:
    """Return the absolute position fixes of `fixes.csv`."""
    table = read_table(path, ("t_s", "robot", "x_m", "y_m"), allowed=("z_m",))
    if not table.noise_columns:
        raise LogError(f"{path}:1: no column of noise, expected cov_xx, cov_xy, cov_yy or sigma_x_m, sigma_y_m")
    columns: dict[str, tuple[str, ...]] = {}
    events: list[Event] = []
    for row in timed(table, request):
        places.setdefault((path, row.robot, ""), row.line)
        y = row.values(columns, row.robot, request)
        if y is None:
            continue
        cov = row.own_noise(columns[row.robot], request, definite=True)
        if cov is None:
            cov = row.refuse(request, "the fix has no noise, expected a covariance in m^2")
        if cov is not False:
            events.append(Fix(t_ns=row.t_ns, robot=row.robot, y=y, cov=cov))
    return events


def read_truth(path: Path, request: Request) -> dict[str, Trajectory]:
    """Return the true trajectory of each robot in `truth.csv`."""
    table = read_table(path, ("t_s", "robot"), known=(*POSE2, *POSE3))
    if set(table.value_columns) not in (set(POSE2), set(POSE3)):
        odd = next((name for name in table.value_columns if name not in (*POSE2, *POSE3)), None)
        hint = nearest(odd, (*POSE2, *POSE3)) if odd else ""
        given = ", ".join(table.value_columns) or "of a pose: none"
        raise LogError(f"{path}:1: columns {given}, expected {pose_columns()}{hint}")
    columns = POSE2 if "theta_rad" in table.value_columns else POSE3
    paths: dict[str, tuple[list[int], list[list[float]]]] = {}
    for row in timed(table, request, strictly=True):
        pose = row.numbers(columns, request)
        if pose is None:
            continue
        if len(pose) == 7 and abs(np.linalg.norm(pose[3:]) - 1) > 1e-6:
            row.refuse(request, f"quaternion has norm {np.linalg.norm(pose[3:]):.9g}, expected 1")
            continue
        times, poses = paths.setdefault(row.robot, ([], []))
        times.append(row.t_ns)
        poses.append(pose)
    return {robot: Trajectory(np.array(t), np.array(p)) for robot, (t, p) in paths.items()}


def pose_columns() -> str:
    """Say which columns a true pose may have."""
    return f"either {', '.join(POSE2)} or {', '.join(POSE3)}"


def read_landmarks(path: Path, request: Request) -> dict[Id, Array]:
    """Return the true landmarks of `landmarks.csv`: positions, both ends of lines (6,), poses of tags (7,)."""
    landmarks: dict[Id, Array] = {}
    table = read_table(path, ("id", "x_m", "y_m"), allowed=LANDMARK3[2:])
    for row in table.rows(request):
        given = tuple(name for name in table.value_columns if row.text(name) or name in LANDMARK3[:2])
        name, numbers = row.text("id"), row.numbers(given, request)
        if numbers is None:
            continue
        if not name:
            row.refuse(request, "id is empty, expected the landmark's id")
        elif landmark_id(name) in landmarks:
            row.refuse(request, f"id {name} is in this file already, expected each landmark once")
        elif given not in LANDMARKS:
            row.refuse(request, f"{', '.join(given)}, expected a point, both ends of a line or the pose of a tag")
        else:
            landmarks[landmark_id(name)] = np.array(numbers)
    return landmarks


def read_gps(path: Path, request: Request) -> dict[str, PositionTrack]:
    """Return the position fixes of `gps.csv`, which only score a run."""
    columns = ("x_m", "y_m", "antenna_x_m", "antenna_y_m")
    table = read_table(path, ("t_s", "robot", *columns), allowed=())
    tracks: dict[str, tuple[list[int], list[list[float]], list[float]]] = {}
    for row in timed(table, request):
        values = row.numbers(columns, request)
        if values is None:
            continue
        times, xy, antenna = tracks.setdefault(row.robot, ([], [], values[2:]))
        if values[2:] != antenna:
            row.refuse(request, f"antenna is {values[2:]}, expected {antenna} as in the robot's first row")
            continue
        times.append(row.t_ns)
        xy.append(values[:2])
    return {robot: PositionTrack(np.array(t), np.array(p), np.array(a)) for robot, (t, p, a) in tracks.items()}


def timed(table: Table, request: Request, *, by_sensor: bool = False, strictly: bool = False) -> Iterator[Row]:
    """Yield the rows whose time does not run backwards within a robot (and sensor); refuse the others."""
    last: dict[Any, Row] = {}
    for row in table.rows(request):
        if not row.read_time(request) or not row.read_names(request, by_sensor):
            continue
        key = (row.robot, row.sensor)
        before = last.get(key)
        if before is not None and row.t_ns < before.t_ns + strictly:
            wanted = "increasing times" if strictly else "times that never run backwards"
            row.refuse(
                request, f"time {row.text('t_s')} s after {before.text('t_s')} s of {row.robot}, expected {wanted}"
            )
            continue
        last[key] = row
        yield row


NATIVE = Format("native", "a folder with controls.csv, scans.csv", lambda path: folder_of(path, FILES), read)
