"""Write a log as the folder of CSV files that `native.read` reads back to the nanosecond and to the last bit."""

from __future__ import annotations

import csv
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from ruamel.yaml import YAML

from kalmark.errors import LogError
from kalmark.events import Control, Fix, Id, Scan
from kalmark.logs.log import Array, Log
from kalmark.logs.native import FILES, LANDMARKS, POSE2, POSE3, RIG
from kalmark.logs.table import CANONICAL, cov_columns
from kalmark.logs.text import landmark_id, seconds

Table = tuple[list[str], list[list[str]]]


def write_native(log: Log, folder: Path | str) -> Path:
    """Write `log` as a native log and return its folder; files of an earlier native log there are replaced.

    Files without a row are not written.  Raises LogError if the log has something that the files cannot hold (an
    unnamed column, two scans of one sensor at one time, an id that would be read as another).
    """
    folder = Path(folder)
    tables = {
        "controls.csv": controls_table(log),
        "scans.csv": scans_table(log),
        "fixes.csv": fixes_table(log),
        "truth.csv": truth_table(log),
        "landmarks.csv": landmarks_table(log),
        "gps.csv": gps_table(log),
    }
    folder.mkdir(parents=True, exist_ok=True)
    for name in FILES:
        header, rows = tables[name]
        if not rows:
            (folder / name).unlink(missing_ok=True)
            continue
        with (folder / name).open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(header)
            writer.writerows(rows)
    (folder / RIG).unlink(missing_ok=True)
    if log.describes:
        with (folder / RIG).open("w", encoding="utf-8") as file:
            YAML(typ="safe", pure=True).dump(log.describes, file)
    return folder


def controls_table(log: Log) -> Table:
    """Return header and rows of controls.csv."""
    controls = [event for event in log if isinstance(event, Control)]
    columns = union(checked(log.control_columns, c.robot, len(c.u)) for c in controls)
    noise = noise_columns((len(c.u) for c in controls if c.cov is not None), columns)
    rows = []
    for c in controls:
        used = log.control_columns[c.robot]
        rows.append(
            [seconds(c.t_ns), name(c.robot), *place(columns, used, c.u), *upper(c.cov, noise, f"control at {c.t_s} s")]
        )
    return ["t_s", "robot", *columns, *noise], rows


def scans_table(log: Log) -> Table:
    """Return header and rows of scans.csv."""
    scans = [event for event in log if isinstance(event, Scan)]
    columns = union(checked(log.sensor_columns, (s.robot, s.sensor), s.y.shape[1]) for s in scans if len(s.y))
    noise = noise_columns((s.y.shape[1] for s in scans if s.cov is not None), columns)
    rows: list[list[str]] = []
    seen: set[tuple[int, str, str]] = set()
    for s in scans:
        key = (s.t_ns, s.robot, s.sensor)
        if key in seen:
            raise LogError(f"two scans of {s.robot!r} by {s.sensor!r} at t={seconds(s.t_ns)} s, expected one at a time")
        seen.add(key)
        if len(s.y) == 0:
            rows.append([seconds(s.t_ns), name(s.robot), name(s.sensor), "", *[""] * (len(columns) + len(noise))])
            continue
        used, size = log.sensor_columns[s.robot, s.sensor], s.y.shape[1]
        covs = [None] * len(s.y) if s.cov is None else np.broadcast_to(s.cov, (len(s.y), size, size))
        start = [seconds(s.t_ns), name(s.robot), name(s.sensor)]
        for y, id_, cov in zip(s.y, s.ids or [None] * len(s.y), covs, strict=True):
            noise_cells = upper(cov, noise, f"scan at {s.t_s} s")
            rows.append([*start, "" if id_ is None else id_text(id_), *place(columns, used, y), *noise_cells])
    return ["t_s", "robot", "sensor", "id", *columns, *noise], rows


def fixes_table(log: Log) -> Table:
    """Return header and rows of fixes.csv."""
    fixes = [event for event in log if isinstance(event, Fix)]
    size = max((len(f.y) for f in fixes), default=2)
    columns = ("x_m", "y_m", "z_m")[:size]
    noise = cov_columns(size, "xyz")
    rows = []
    for f in fixes:
        used = columns[: len(f.y)]
        cells = dict(zip(cov_columns(len(f.y), "xyz"), upper_numbers(f.cov, f"fix at {f.t_s} s"), strict=True))
        rows.append([seconds(f.t_ns), name(f.robot), *place(columns, used, f.y), *(cells.get(n, "") for n in noise)])
    return ["t_s", "robot", *columns, *noise], rows


def truth_table(log: Log) -> Table:
    """Return header and rows of truth.csv."""
    sizes = {path.poses.shape[1] for path in log.truth.values()}
    if len(sizes) > 1:
        raise LogError("truth holds poses in the plane and in space, expected one kind")
    columns = POSE3 if sizes == {7} else POSE2
    rows = [
        [seconds(int(t)), name(robot), *numbers(pose)]
        for robot, path in log.truth.items()
        for t, pose in zip(path.t_ns, path.poses, strict=True)
    ]
    return ["t_s", "robot", *columns], rows


def landmarks_table(log: Log) -> Table:
    """Return header and rows of landmarks.csv."""
    of_size = {len(names): names for names in LANDMARKS}
    sizes = {len(values) for values in log.landmarks.values()}
    if not sizes <= of_size.keys() or (2 in sizes and len(sizes) > 1):
        raise LogError(f"landmarks have {', '.join(map(str, sorted(sizes)))} numbers, expected all 2, or 3, 6 and 7")
    columns = union(of_size[size] for size in sorted(sizes)) or LANDMARKS[0]
    rows = [[id_text(id_), *place(columns, of_size[len(l)], l)] for id_, l in log.landmarks.items()]
    return ["id", *columns], rows


def gps_table(log: Log) -> Table:
    """Return header and rows of gps.csv."""
    rows = [
        [seconds(int(t)), name(robot), *numbers(xy), *numbers(track.antenna)]
        for robot, track in log.gps.items()
        for t, xy in zip(track.t_ns, track.xy, strict=True)
    ]
    return ["t_s", "robot", "x_m", "y_m", "antenna_x_m", "antenna_y_m"], rows


def checked(columns: dict[Any, tuple[str, ...]], key: Any, size: int) -> tuple[str, ...]:
    """Return the column names of a control or scan.  Raises LogError if the log does not name them."""
    names = columns.get(key)
    if names is None or len(names) != size:
        raise LogError(f"columns of {key!r} are {names!r}, expected the names of its {size} numbers")
    return names


def union(columns: Iterable[tuple[str, ...]]) -> tuple[str, ...]:
    """Return all column names, in the order in which they are read back."""
    names = list(dict.fromkeys(name for group in dict.fromkeys(columns) for name in group))
    known = [name for name in CANONICAL if name in names]
    return (*known, *(name for name in names if name not in known))


def noise_columns(sizes: Iterable[int], columns: tuple[str, ...]) -> list[str]:
    """Return the names of the noise columns that hold every covariance of these sizes."""
    return cov_columns(max(sizes, default=0))


def place(columns: tuple[str, ...], used: tuple[str, ...], values: Array) -> list[str]:
    """Return the cells of `values`, named by `used`, under `columns`; others stay empty."""
    if columns == used:
        return numbers(values)
    if tuple(column for column in columns if column in used) != used:
        raise LogError(f"columns {', '.join(used)} would be read back in another order, expected that of {columns}")
    cells = dict(zip(used, numbers(values), strict=True))
    return [cells.get(column, "") for column in columns]


def upper(cov: Array | None, noise: list[str], what: str) -> list[str]:
    """Return the cells of a covariance under the columns `noise`."""
    if cov is None:
        return [""] * len(noise)
    cells = dict(zip(cov_columns(len(cov)), upper_numbers(cov, what), strict=True))
    return [cells.get(column, "") for column in noise]


def upper_numbers(cov: Array, what: str) -> list[str]:
    """Return the upper triangle of a symmetric covariance, row by row."""
    if not np.array_equal(cov, cov.T):
        raise LogError(f"{what}: covariance {cov.tolist()} is not symmetric, expected a symmetric one")
    return numbers(cov[np.triu_indices(len(cov))])


def numbers(values: Any) -> list[str]:
    """Return numbers as the shortest text that reads back as the same float."""
    return [repr(float(value)) for value in values]


def name(text: str) -> str:
    """Return a robot's or sensor's name.  Raises LogError if it would be read back as another."""
    if not text or text != text.strip() or "\n" in text or "\r" in text:
        raise LogError(f"name is {text!r}, expected text without space at its ends and without line breaks")
    return text


def id_text(id_: Id) -> str:
    """Return a landmark id.  Raises LogError if it would be read back as another."""
    text = str(id_)
    if isinstance(id_, str):
        name(text)
    if landmark_id(text) != id_:
        raise LogError(f"id {id_!r} would be read back as {landmark_id(text)!r}, expected an integer or a word")
    return text
