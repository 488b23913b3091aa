"""Write a log as the folder of CSV files that `native.read` reads back to the nanosecond and to the last bit."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from ruamel.yaml import YAML

from kalmark.arrays import Array
from kalmark.errors import LogError
from kalmark.events import Control, Event, Fix, Id, Raw, Scan, fixed_seconds
from kalmark.files import replace_folder
from kalmark.logs.log import Log, Names
from kalmark.logs.native import FILES, LANDMARKS, RIG, TABLES
from kalmark.logs.source import BETWEEN, landmark_id, names_of_text, nanoseconds_of_text
from kalmark.logs.table import PARQUET, cov_columns
from kalmark.logs.table_columns import GPS, NAMES, POSE2, POSE3, POSITION, in_order
from kalmark.plugins import load

Row = dict[str, Any]


def write_native(log: Log, folder: Path | str, *, parquet: bool = False) -> Path:
    """Write `log` as a native log and return its folder; files of an earlier native log there are replaced.

    With `parquet` its tables are files of Parquet instead of CSV.

    Files without a row are not written.  Raises LogError if the log has something that the files cannot hold (an
    unnamed column, two scans of one sensor at one time, an id that would be read as another).

    >>> from kalmark.logs import write_native
    >>> controls = {"t_s": [0.0, 0.1], "robot": ["rover"] * 2, "v_mps": [0.5, 0.5], "w_radps": [0.0, 0.1]}
    >>> write_native(km.log_from(controls=controls), "my_log").name
    'my_log'
    """
    folder = Path(folder)
    own = [*FILES, RIG, *(str(Path(name).with_suffix(PARQUET)) for name in FILES)]
    replace_folder(folder, lambda made: _fill(made, log, parquet), own, FILES[0])
    return folder


def _fill(folder: Path, log: Log, parquet: bool) -> None:
    tables = {  # measurements.csv: what has no id is written into scans.csv, too
        "controls.csv": controls(log), "scans.csv": scans(log), "fixes.csv": fixes(log), "truth.csv": truth(log),
        "landmarks.csv": landmarks(log), "gps.csv": gps(log),
    }  # fmt: skip
    if any(isinstance(event, Raw) for event in log):
        tables |= {name: load("tables", name).rows(log, folder) for name in TABLES}
    for file_name, made in tables.items():
        rows = [*made]
        if not rows:
            continue
        header = header_of(rows)
        for used in (*log.control_columns.values(), *log.sensor_columns.values()):
            there = [name for name in header if name in used]
            if len(there) == len(used) and there != [*used]:
                raise LogError(
                    f"columns {', '.join(used)} would be read back in another order, expected that of "
                    f"{', '.join(there)}"
                )
        if parquet and file_name not in TABLES:
            write_parquet((folder / file_name).with_suffix(PARQUET), header, rows)
            continue
        with (folder / file_name).open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, header, lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)
    if log.describes:
        with (folder / RIG).open("w", encoding="utf-8") as file:
            YAML(typ="safe", pure=True).dump(log.describes, file)


def header_of(rows: Sequence[Row]) -> list[str]:
    """Return the columns of a table: names, numbers in the order in which they are read back, noise."""
    names = dict.fromkeys(name for row in rows for name in row)
    noise = sorted(name for name in names if name.startswith("cov_"))
    values = in_order(name for name in names if name not in (*NAMES, *noise))
    return [*(name for name in NAMES if name in names), *values, *noise]


def write_parquet(path: Path, header: Sequence[str], rows: Sequence[Row]) -> None:
    """Write a table as Parquet: times in ns, texts, and numbers to the last bit; what is empty is null."""
    import pyarrow
    import pyarrow.parquet

    columns: dict[str, Any] = {}
    for name in header:
        if name == "t_s":
            columns["t_ns"] = [nanoseconds_of_text(row[name]) for row in rows]
        else:
            columns[name] = [None if row.get(name) == "" else row.get(name) for row in rows]
    pyarrow.parquet.write_table(pyarrow.table(columns), path)


def controls(log: Log) -> Iterator[Row]:
    """Yield the rows of controls.csv."""
    for c in log:
        if not isinstance(c, Control):
            continue
        if c.share < 1:
            raise LogError(
                f"the control at {fixed_seconds(c.t_ns)} s is a part, expected whole increments: those 'recorded'"
            )
        noise = upper_triangle(c.cov, f"control at {c.t_s} s")
        yield time_and_robot(c) | numbers(log.control_columns, c.robot, c.u) | noise


def scans(log: Log) -> Iterator[Row]:
    """Yield the rows of scans.csv."""
    seen: set[tuple[int, str, str]] = set()
    for s in log:
        if not isinstance(s, Scan):
            continue
        if (s.t_ns, s.robot, s.sensor) in seen:
            raise LogError(
                f"two scans of {s.robot!r} by {s.sensor!r} at t={fixed_seconds(s.t_ns)} s, expected one at a time"
            )
        seen.add((s.t_ns, s.robot, s.sensor))
        begin, (count, size) = time_and_robot(s) | {"sensor": name(s.sensor), "id": ""}, s.y.shape
        if not count:
            yield begin
        covs = [None] * count if s.cov is None else np.broadcast_to(s.cov, (count, size, size))
        nothing = [None] * count
        rows = zip(s.y, s.ids or nothing, s.classes or nothing, s.of or nothing, covs, strict=True)
        for y, id_, class_, of, cov in rows:
            own = numbers(log.sensor_columns, (s.robot, s.sensor), y) | upper_triangle(cov, f"scan at {s.t_s} s")
            told = {
                "id": "" if id_ is None else id_text(id_), "class": class_, "of": of and names_text(of)
            }  # fmt: skip
            yield begin | {key: text for key, text in told.items() if text is not None} | own


def fixes(log: Log) -> Iterator[Row]:
    """Yield the rows of fixes.csv."""
    for f in log:
        if isinstance(f, Fix):
            noise = upper_triangle(f.cov, f"fix at {f.t_s} s", "xyz")
            yield time_and_robot(f) | by_column(POSITION, f.y) | noise


def truth(log: Log) -> Iterator[Row]:
    """Yield the rows of truth.csv."""
    sizes = {path.poses.shape[1] for path in log.truth.values()}
    if len(sizes) > 1:
        raise LogError("truth holds poses in the plane and in space, expected one kind")
    for robot, path in log.truth.items():
        for t, pose in zip(path.t_ns.tolist(), path.poses, strict=True):
            told = by_column(POSE3 if sizes == {7} else POSE2, pose)
            yield {"t_s": fixed_seconds(t), "robot": name(robot)} | told


def landmarks(log: Log) -> Iterator[Row]:
    """Yield the rows of landmarks.csv."""
    of_size = {len(names): names for names in LANDMARKS}
    sizes = {len(values) for values in log.landmarks.values()}
    if not (sizes <= {2, 4} or sizes <= {3, 6, 7}):
        raise LogError(f"landmarks have {', '.join(map(str, sorted(sizes)))} numbers, expected 2 and 4, or 3, 6 and 7")
    return ({"id": id_text(id_)} | by_column(of_size[len(l)], l) for id_, l in log.landmarks.items())


def gps(log: Log) -> Iterator[Row]:
    """Yield the rows of gps.csv."""
    for robot, track in log.gps.items():
        for t, xy in zip(track.t_ns.tolist(), track.xy, strict=True):
            yield {"t_s": fixed_seconds(t), "robot": name(robot)} | by_column(GPS, [*xy, *track.antenna])


def time_and_robot(event: Event) -> Row:
    """Return the cells of an event's time and robot."""
    return {"t_s": fixed_seconds(event.t_ns), "robot": name(event.robot)}


def numbers(columns: dict[Any, Names], key: Any, values: Array) -> Row:
    """Return the numbers (m,) of a control or an observation by column.  Raises LogError if the log names none."""
    names = columns.get(key)
    if names is None or len(names) != len(values):
        raise LogError(f"columns of {key!r} are {names!r}, expected the names of its {len(values)} numbers")
    return by_column(names, values)


def by_column(columns: Sequence[str], values: Any) -> Row:
    """Return numbers by column."""
    return {column: float(value) for column, value in zip(columns, values, strict=False)}


def upper_triangle(cov: Array | None, what: str, axes: str = "0123456789") -> Row:
    """Return the cells of the upper triangle of a covariance, row by row.  Raises LogError if it is not symmetric."""
    if cov is None:
        return {}
    if not np.array_equal(cov, cov.T):
        raise LogError(f"{what}: covariance {cov.tolist()} is not symmetric, expected a symmetric one")
    return by_column(cov_columns(len(cov), axes), cov[np.triu_indices(len(cov))])


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


def names_text(names: Sequence[Id]) -> str:
    """Return the names of blocks as one text.  Raises LogError if it would be read back as others."""
    text = BETWEEN.join(map(id_text, names))
    if names_of_text(text) != [*names]:
        raise LogError(f"names {[*names]} would be read back as {names_of_text(text)}, expected none with {BETWEEN!r}")
    return text
