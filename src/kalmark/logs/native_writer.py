"""Write a log as the folder of CSV files that `native.read` reads back to the nanosecond and to the last bit."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from ruamel.yaml import YAML

from kalmark.arrays import Array
from kalmark.errors import LogError
from kalmark.events import Control, Event, Fix, Frame, Id, Scan, fixed_seconds
from kalmark.files import replace_folder
from kalmark.logs.image_files import write_depth, write_image
from kalmark.logs.log import Log
from kalmark.logs.native import FILES, LANDMARKS, RIG
from kalmark.logs.source import landmark_id, nanoseconds_of_text
from kalmark.logs.table import PARQUET, cov_columns
from kalmark.logs.table_columns import CANONICAL, GPS, POSE2, POSE3, POSITION

Table = tuple[list[str], list[dict[str, str]]]
FRAMES, IMAGES = "frames.csv", "images"
PICTURES = "image", "depth", "right"  # columns of FRAMES that name files
EMPTY: Table = ([], [])  # measurements.csv: what has no id is written into scans.csv, too


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
    tables = (
        controls_table(log),
        scans_table(log),
        fixes_table(log),
        truth(log),
        landmarks_table(log),
        gps(log),
        EMPTY,
    )
    replace_folder(folder, lambda made: _fill(made, log, (*tables, frames_table(log, made)), parquet), own, FILES[0])
    return folder


def _fill(folder: Path, log: Log, tables: Sequence[Table], parquet: bool) -> None:
    for file_name, (header, rows) in zip(FILES, tables, strict=True):
        if not rows:
            continue
        if parquet and file_name != FRAMES:
            write_parquet((folder / file_name).with_suffix(PARQUET), header, rows)
            continue
        with (folder / file_name).open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, header, lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)
    if log.describes:
        with (folder / RIG).open("w", encoding="utf-8") as file:
            YAML(typ="safe", pure=True).dump(log.describes, file)


def write_parquet(path: Path, header: list[str], rows: list[dict[str, str]]) -> None:
    """Write a table as Parquet: times in ns, texts, and numbers to the last bit; what is empty is null."""
    import pyarrow
    import pyarrow.parquet

    columns: dict[str, Any] = {}
    for name in header:
        told = [row.get(name) or None for row in rows]
        if name == "t_s":
            columns["t_ns"] = [nanoseconds_of_text(text) if text else None for text in told]
        else:
            texts = name in ("robot", "sensor", "id")
            columns[name] = told if texts else [None if text is None else float(text) for text in told]
    pyarrow.parquet.write_table(pyarrow.table(columns), path)


def controls_table(log: Log) -> Table:
    """Return header and rows of controls.csv."""
    events = [event for event in log if isinstance(event, Control)]
    columns = union(check_columns(log.control_columns, c.robot, len(c.u)) for c in events)
    if part := next((c for c in events if c.share < 1), None):
        raise LogError(
            f"the control at {fixed_seconds(part.t_ns)} s is a part, expected whole increments: those 'recorded'"
        )
    noise = cov_columns(max((len(c.cov) for c in events if c.cov is not None), default=0))
    rows = [
        time_and_robot(c)
        | cells(columns, log.control_columns[c.robot], c.u)
        | upper_triangle(c.cov, f"control at {c.t_s} s")
        for c in events
    ]
    return ["t_s", "robot", *columns, *noise], rows


def scans_table(log: Log) -> Table:
    """Return header and rows of scans.csv."""
    events = [event for event in log if isinstance(event, Scan)]
    columns = union(check_columns(log.sensor_columns, (s.robot, s.sensor), s.y.shape[1]) for s in events if len(s.y))
    noise = cov_columns(max((s.y.shape[1] for s in events if s.cov is not None), default=0))
    rows: list[dict[str, str]] = []
    seen: set[tuple[int, str, str]] = set()
    for s in events:
        key = (s.t_ns, s.robot, s.sensor)
        if key in seen:
            raise LogError(
                f"two scans of {s.robot!r} by {s.sensor!r} at t={fixed_seconds(s.t_ns)} s, expected one at a time"
            )
        seen.add(key)
        begin = time_and_robot(s) | {"sensor": name(s.sensor)}
        if len(s.y) == 0:
            rows.append(begin)
            continue
        used, size = log.sensor_columns[s.robot, s.sensor], s.y.shape[1]
        covs = [None] * len(s.y) if s.cov is None else np.broadcast_to(s.cov, (len(s.y), size, size))
        for y, id_, cov in zip(s.y, s.ids or [None] * len(s.y), covs, strict=True):
            told = {} if id_ is None else {"id": id_text(id_)}
            rows.append(begin | told | cells(columns, used, y) | upper_triangle(cov, f"scan at {s.t_s} s"))
    return ["t_s", "robot", "sensor", "id", *columns, *noise], rows


def frames_table(log: Log, folder: Path) -> Table:
    """Return header and rows of frames.csv, and write the images below the folder: IMAGES/SENSOR/NANOSECONDS.png."""
    rows: list[dict[str, str]] = []
    for frame in log:
        if not isinstance(frame, Frame):
            continue
        row = time_and_robot(frame) | {"sensor": name(frame.sensor)}
        told = frame.pixels(), frame.depths(), frame.right_grey()
        for column, pixels, write in zip(PICTURES, told, (write_image, write_depth, write_image), strict=True):
            if pixels is None:
                continue
            place = Path(IMAGES, f"{frame.robot}_{frame.sensor}".replace("/", "_"), f"{frame.t_ns}_{column}.png")
            (folder / place).parent.mkdir(parents=True, exist_ok=True)
            write(folder / place, pixels)
            row[column] = place.as_posix()
        rows.append(row)
    return ["t_s", "robot", "sensor", *(c for c in PICTURES if c == "image" or any(c in row for row in rows))], rows


def fixes_table(log: Log) -> Table:
    """Return header and rows of fixes.csv."""
    events = [event for event in log if isinstance(event, Fix)]
    size = max((len(f.y) for f in events), default=2)
    rows = [
        time_and_robot(f) | texts_of_columns(POSITION, f.y) | upper_triangle(f.cov, f"fix at {f.t_s} s", "xyz")
        for f in events
    ]
    return ["t_s", "robot", *POSITION[:size], *cov_columns(size, "xyz")], rows


def truth(log: Log) -> Table:
    """Return header and rows of truth.csv."""
    sizes = {path.poses.shape[1] for path in log.truth.values()}
    if len(sizes) > 1:
        raise LogError("truth holds poses in the plane and in space, expected one kind")
    columns = POSE3 if sizes == {7} else POSE2
    rows = [
        {"t_s": fixed_seconds(int(t)), "robot": name(robot)} | texts_of_columns(columns, pose)
        for robot, path in log.truth.items() for t, pose in zip(path.t_ns, path.poses, strict=True)
    ]  # fmt: skip
    return ["t_s", "robot", *columns], rows


def landmarks_table(log: Log) -> Table:
    """Return header and rows of landmarks.csv."""
    of_size = {len(names): names for names in LANDMARKS}
    sizes = {len(values) for values in log.landmarks.values()}
    if not (sizes <= {2, 4} or sizes <= {3, 6, 7}):
        raise LogError(f"landmarks have {', '.join(map(str, sorted(sizes)))} numbers, expected 2 and 4, or 3, 6 and 7")
    columns = union(of_size[size] for size in sorted(sizes)) or LANDMARKS[0]
    rows = [{"id": id_text(id_)} | cells(columns, of_size[len(l)], l) for id_, l in log.landmarks.items()]
    return ["id", *columns], rows


def gps(log: Log) -> Table:
    """Return header and rows of gps.csv."""
    rows = [
        {"t_s": fixed_seconds(int(t)), "robot": name(robot)} | texts_of_columns(GPS, [*xy, *track.antenna])
        for robot, track in log.gps.items() for t, xy in zip(track.t_ns, track.xy, strict=True)
    ]  # fmt: skip
    return ["t_s", "robot", *GPS], rows


def time_and_robot(event: Event) -> dict[str, str]:
    """Return the cells of an event's time and robot."""
    return {"t_s": fixed_seconds(event.t_ns), "robot": name(event.robot)}


def check_columns(columns: dict[Any, tuple[str, ...]], key: Any, size: int) -> tuple[str, ...]:
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


def cells(columns: tuple[str, ...], used: tuple[str, ...], values: Array) -> dict[str, str]:
    """Return the cells of `values`, named by `used`, some of `columns`.  Raises LogError if their order is another."""
    if columns != used and tuple(column for column in columns if column in used) != used:
        raise LogError(f"columns {', '.join(used)} would be read back in another order, expected that of {columns}")
    return texts_of_columns(used, values)


def texts_of_columns(columns: Sequence[str], values: Any) -> dict[str, str]:
    """Return numbers by column, as the shortest text that reads back as the same float."""
    return {column: repr(float(value)) for column, value in zip(columns, values, strict=False)}


def upper_triangle(cov: Array | None, what: str, axes: str = "0123456789") -> dict[str, str]:
    """Return the cells of the upper triangle of a covariance, row by row.  Raises LogError if it is not symmetric."""
    if cov is None:
        return {}
    if not np.array_equal(cov, cov.T):
        raise LogError(f"{what}: covariance {cov.tolist()} is not symmetric, expected a symmetric one")
    return texts_of_columns(cov_columns(len(cov), axes), cov[np.triu_indices(len(cov))])


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
