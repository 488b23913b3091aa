"""Read kalmark's own log, a folder of CSV files with headers (docs/datasets.md, "Native logs").

`controls.csv`  t_s, robot, the control's columns[, own noise]
`scans.csv`     t_s, robot, sensor, id[, class][, of], the sensors' columns[, own noise]; a sensor leaves the others'
                columns empty; `of` has the names of the blocks that a sensor of blocks measures: `door|mast`
`measurements.csv` t_s, robot, sensor[, of], the sensors' columns[, own noise]: scans of one row without an id
`fixes.csv`     t_s, robot, x_m, y_m[, z_m], own noise
`truth.csv`     t_s, robot, x_m, y_m, theta_rad | x_m, y_m, z_m, qx, qy, qz, qw
`landmarks.csv` id, x_m, y_m[, z_m][, x2_m, y2_m, z2_m | qx, qy, qz, qw]: points, both ends of lines, poses of tags;
                in the plane id, x_m, y_m[, x2_m, y2_m]: points, both ends of walls
`gps.csv`       t_s, robot, x_m, y_m, antenna_x_m, antenna_y_m: fixes that only score a run
`rig.yaml`      what the log describes of its robots and sensors, in the shape of a configuration

Plug-ins add tables (`kalmark.tables`), as `frames.csv` of images.

A row of `scans.csv` whose id and values are all empty is a scan that saw nothing.

Positions may be on the globe instead: `lat_deg, lon_deg[, height_m]` for `x_m, y_m[, z_m]` in any of these files; they
become metres east, north and up of one origin (`geodesy.py`).

Own noise is either a column `sigma_<column>` for each column, or the upper triangle `cov_00, cov_01, cov_11, ...`
numbered in the order of the columns (`cov_xx, cov_xy, cov_yy, ...` where they are x_m, y_m[, z_m]).
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field
from difflib import get_close_matches
from functools import partial
from heapq import merge
from itertools import groupby
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from kalmark.arrays import Array
from kalmark.declare import classes, is_own
from kalmark.errors import LogError
from kalmark.events import Control, Event, Fix, Id, Scan, fixed_seconds, short_text, sort_events, sort_key
from kalmark.logs.geodesy import Globe, origin_of
from kalmark.logs.log import LandmarkPlaces, Log, Names, PositionTrack, Section, SensorKey, Trajectory
from kalmark.logs.source import Format, Request, folder_of, read_mapping, spelling_hint
from kalmark.logs.table import PARQUET, Content, Refused, Row, read_table
from kalmark.logs.table_columns import CANONICAL, CONTROL, GPS, POSE2, POSE3, POSITION
from kalmark.plugins import entry_points_of, load

RIG = "rig.yaml"
TABLES = tuple(entry_points_of("tables"))
"""The tables of plug-ins: files of events."""
FILES = (
    "controls.csv", "scans.csv", "fixes.csv", "truth.csv", "landmarks.csv", "gps.csv", "measurements.csv", *TABLES
)  # fmt: skip
EVENTS = ("controls.csv", "scans.csv", "fixes.csv", "measurements.csv", *TABLES)
LANDMARK3 = (*POSITION, "x2_m", "y2_m", "z2_m", *POSE3[3:])
WALL = ("x_m", "y_m", "x2_m", "y2_m")
LANDMARKS = (POSITION[:2], WALL, POSITION, LANDMARK3[:6], POSE3)
"""The columns of a point and a wall of the plane, and of a point, a line and a tag, as `Log.landmarks` has them."""

Begins = dict[tuple[Path, str, str], int]
"""The line where a robot's controls and fixes (sensor "") and its scans by each sensor begin in a file."""

NEAR = 0.65  # of difflib's ratio


def read(
    path: Path,
    request: Request,
    origin: Annotated[
        Any, "[latitude_deg, longitude_deg, height_m] of the origin of positions on the globe; the first one if absent."
    ] = None,
) -> Log:
    """Return the native log in a folder.  Raises LogError with file and line."""
    there = tables(path)
    if not {*EVENTS} & there.keys():
        raise LogError(
            f"{path}: no controls.csv, scans.csv, fixes.csv or measurements.csv, expected at least one of them"
        )
    others = [file.name for file in path.glob("*.csv") if file.name not in FILES]
    for name in FILES:
        near = [] if name in there else get_close_matches(name, others, n=1, cutoff=0.85)
        if near:
            raise LogError(f"{path / near[0]}: a file of this name is not read, expected {name}")
    describes = read_rig(path / RIG) if (path / RIG).is_file() else {}
    return log_of_tables(there, request, path.name, path, describes, Globe(origin_of(origin, "log option origin")))


def tables(path: Path) -> dict[str, Path]:
    """Return the tables in a folder by the names of their CSV files.  Raises LogError if one is there twice."""
    found: dict[str, Path] = {}
    for name in FILES:
        same = [file for file in (path / name, (path / name).with_suffix(PARQUET)) if os.path.lexists(file)]
        for file in same:
            if not file.is_file():  # a folder, a pipe, a link to nothing
                raise LogError(f"{file}: not a file, expected a table")
        if len(same) > 1:
            raise LogError(f"{same[1]}: beside {name}, expected one of them")
        if same:
            found[name] = same[0]
    return found


def log_of_tables(
    there: Mapping[str, Path | Content], request: Request, called: str, path: Path | None, describes: Section,
    globe: Globe | None = None,
) -> Log:  # fmt: skip
    """Return the log of tables, by the names of their CSV files.  Raises LogError with file and line."""
    reader = _NativeReader(request, globe=globe)
    for name, read_file in zip(FILES, reader.readers, strict=True):
        if name in there:
            reader.events += read_file(there[name]) or ()
    seen = {name for event in reader.events if isinstance(event, Scan) for name in event.ids or ()}
    known = {*reader.truth, *describes.get("robots", ()), *map(str, seen)}
    strays = refuse_misspelt_robots(reader.places, known, request)
    events = [event for event in reader.events if event.robot not in strays] if strays else reader.events
    columns = {key: names for key, names in reader.columns.items() if key[0] not in strays}
    return Log(
        name=called, path=path, robots=tuple(dict.fromkeys(event.robot for event in events)),
        events=sort_events(events), truth=reader.truth, landmarks=reader.landmarks, gps=reader.gps,
        skipped=request.skipped, describes=describes,
        control_columns={robot: names for (robot, sensor), names in columns.items() if not sensor},
        sensor_columns={key: names for key, names in columns.items() if key[1]},
        places={(robot, sensor): (file, line) for (file, robot, sensor), line in reversed(reader.places.items())},
        origin=reader.globe.origin,
    )  # fmt: skip


def read_rig(path: Path) -> Section:
    """Return the content of `rig.yaml`.  Raises LogError if it is no mapping with a mapping of robots."""
    content = read_mapping(path)
    robots = content.get("robots", {})
    if not isinstance(robots, dict):
        raise LogError(f"{path}: robots: got {short_text(robots)}, expected a mapping of keys")
    for name, robot in robots.items():
        if not isinstance(robot, dict):
            raise LogError(f"{path}: robots.{name}: got {short_text(robot)}, expected a mapping of keys")
    return content


@dataclass
class _Rows:
    """Collect the observations of one scan; a bad row is left out, an empty one is a scan without observations."""

    t_ns: int
    y: list[list[float]] = field(default_factory=list)
    ids: list[Id | None] = field(default_factory=list)
    classes: list[str | None] = field(default_factory=list)
    of: list[list[Id]] = field(default_factory=list)
    covs: list[Array | None] = field(default_factory=list)
    lines: list[int] = field(default_factory=list)
    empty: bool = False


class _NativeReader:
    """Reads the files of a log, one method each, and gathers what is in them.

    `columns` are those of each robot's controls (sensor "") and of each sensor, `places` where they begin.  `in_order`:
    the rows of a file are in the order of time, whichever robot and sensor they are of.  `globe` has the origin of
    positions on it.
    """

    def __init__(self, request: Request, in_order: bool = False, globe: Globe | None = None) -> None:
        self.request, self.in_order, self.globe = request, in_order, globe or Globe()
        self.events: list[Event] = []
        self.columns: dict[SensorKey, Names] = {}
        self.places: Begins = {}
        self.truth: dict[str, Trajectory] = {}
        self.landmarks: LandmarkPlaces = {}
        self.gps: dict[str, PositionTrack] = {}
        self.readers: tuple[Callable[[Path | Content], Iterator[Event] | None], ...] = (
            self.controls, self.scans, self.fixes, self.read_truth, self.read_landmarks, self.read_gps,
            self.measurements, *(partial(self.of_plugin, name) for name in TABLES),
        )  # fmt: skip

    def note(self, row: Row) -> None:
        """Note where the controls, fixes or scans of a row begin."""
        self.places.setdefault((row.table.path, *row.key), row.line)

    def controls(self, path: Path | Content) -> Iterator[Event]:
        """Yield the controls of `controls.csv`."""

        def make(row: Row) -> Event:
            self.note(row)
            u, cov = row.measured(self.columns, definite=False)
            return Control(t_ns=row.t_ns, robot=row.robot, u=u, cov=cov)

        return read_table(path, ("t_s", "robot"), known=known_columns(CONTROL)).made(self.request, make)

    def scans(self, path: Path | Content) -> Iterator[Event]:
        """Yield the scans of `scans.csv`: one a robot, sensor and time."""
        scans: dict[SensorKey, _Rows] = {}  # those that may still get rows: of each sensor the last

        def make(row: Row) -> list[Event]:
            self.note(row)
            over = [row.key] if row.key in scans and scans[row.key].t_ns != row.t_ns else []
            if self.in_order:
                over = [key for key, rows in scans.items() if rows.t_ns < row.t_ns]
            done = [event for key in over for event in self.closed(path, key, scans.pop(key))]
            rows = scans.setdefault(row.key, _Rows(row.t_ns))
            try:
                self.add(rows, row)
            except Refused as refused:
                self.request.refuse(f"{path}{row.table.content.word}{row.line}: {refused}")
            return done

        table = read_table(path, ("t_s", "robot", "sensor", "id"), known=known_columns(), globe=self.globe)
        for done in table.made(self.request, make, by_sensor=True):
            yield from done
        for key, rows in scans.items():
            yield from self.closed(path, key, rows)

    def closed(self, path: Path | Content, key: SensorKey, rows: _Rows) -> Iterator[Event]:
        """Yield the event of the rows of a scan, which has no more; none if all of them are bad."""
        if not rows.y and not rows.empty:
            return
        robot, sensor = key
        covs = [cov for cov in rows.covs if cov is not None]
        cov = np.array(covs) if covs else None
        classes = rows.classes if any(rows.classes) else None
        ids, of = (None, rows.of) if any(rows.of) else (rows.ids, None)
        yield Scan(t_ns=rows.t_ns, robot=robot, sensor=sensor, y=rows.y, ids=ids, cov=cov, classes=classes, of=of)

    def add(self, rows: _Rows, row: Row) -> None:
        """Add one row of `scans.csv` to its scan.  Raises Refused."""
        empty = not any(row.text(name) for name in ("id", *row.table.value_columns, *row.table.noise_columns))
        if rows.empty or (empty and rows.y):
            raise Refused("an empty row and others in one scan, expected it alone: the scan saw nothing")
        rows.empty = empty
        if empty:
            return
        (y, cov), name = row.measured(self.columns), row.id()
        if name is not None and name in rows.ids:
            first = rows.lines[rows.ids.index(name)]
            raise Refused(f"id {name!r} is in this scan already (line {first}), expected each landmark once")
        if rows.covs and (rows.covs[0] is None) != (cov is None):
            raise Refused("own noise in some rows of this scan only, expected it in all of them or in none")
        rows.y.append(y)
        rows.ids.append(name)
        rows.classes.append((row.text("class") if "class" in row.table.index else "") or None)
        rows.of.append(row.names("of"))
        rows.covs.append(cov)
        rows.lines.append(row.line)

    def measurements(self, path: Path | Content) -> Iterator[Event]:
        """Yield the readings of `measurements.csv`, one a row."""

        def make(row: Row) -> Event:
            self.note(row)
            y, cov = row.measured(self.columns)
            of = row.names("of")
            return Scan(t_ns=row.t_ns, robot=row.robot, sensor=row.sensor, y=[y], cov=cov, of=[of] if of else None)

        table = read_table(path, ("t_s", "robot", "sensor"), known=known_columns(), globe=self.globe)
        return table.made(self.request, make, by_sensor=True)

    def of_plugin(self, name: str, path: Path | Content) -> Iterator[Event]:
        """Return the events of a table of a plug-in.  Raises PluginError."""
        events: Iterator[Event] = load("tables", name).read(path, self.request, self.note)
        return events

    def fixes(self, path: Path | Content) -> Iterator[Event]:
        """Yield the absolute positions of `fixes.csv`."""
        table = read_table(path, ("t_s", "robot", "x_m", "y_m"), allowed=("z_m",), globe=self.globe)
        if not table.noise_columns:
            raise LogError(f"{path}:1: no column of noise, expected cov_xx, cov_xy, cov_yy or sigma_x_m, sigma_y_m")
        columns: dict[SensorKey, Names] = {}

        def make(row: Row) -> Event:
            self.note(row)
            y, cov = row.measured(columns)
            if cov is None:
                raise Refused("the fix has no noise, expected a covariance in m^2")
            return Fix(t_ns=row.t_ns, robot=row.robot, y=y, cov=cov)

        return table.made(self.request, make)

    def read_truth(self, path: Path | Content) -> None:
        """Read `truth.csv`: the true trajectory of each robot."""
        table = read_table(path, ("t_s", "robot"), known=(*POSE2, *POSE3), globe=self.globe)
        if set(table.value_columns) not in (set(POSE2), set(POSE3)):
            odd = next((name for name in table.value_columns if name not in (*POSE2, *POSE3)), None)
            hint = spelling_hint(odd, (*POSE2, *POSE3)) if odd else ""
            given = ", ".join(table.value_columns) or "of a pose: none"
            raise LogError(f"{path}:1: columns {given}, expected either {', '.join(POSE2)} or {', '.join(POSE3)}{hint}")
        columns = POSE2 if "theta_rad" in table.value_columns else POSE3
        paths: dict[str, dict[int, list[float]]] = {}

        def take(row: Row) -> None:
            pose = row.numbers(columns)
            paths.setdefault(row.robot, {})[row.t_ns] = pose

        table.each(self.request, take, strictly=True)
        self.truth = {robot: Trajectory.of(p) for robot, p in paths.items()}

    def read_landmarks(self, path: Path | Content) -> None:
        """Read `landmarks.csv`: true positions, both ends of lines (6,), poses of tags (7,)."""

        def take(row: Row) -> None:
            given = tuple(name for name in row.table.value_columns if row.text(name) or name in LANDMARK3[:2])
            name, values = row.new_id(self.landmarks), row.numbers(given)
            if given not in LANDMARKS:
                raise Refused(f"{', '.join(given)}, expected a point, both ends of a line or the pose of a tag")
            self.landmarks[name] = np.array(values)

        table = read_table(path, ("id", "x_m", "y_m"), allowed=LANDMARK3[2:], globe=self.globe)
        table.each(self.request, take, timed=False)

    def read_gps(self, path: Path | Content) -> None:
        """Read `gps.csv`: position fixes that only score a run."""
        tracks: dict[str, list[tuple[int, list[float]]]] = {}

        def take(row: Row) -> None:
            values, rows = row.numbers(GPS), tracks.setdefault(row.robot, [])
            if rows and values[2:] != rows[0][1][2:]:
                raise Refused(f"antenna is {values[2:]}, expected {rows[0][1][2:]} as in the robot's first row")
            rows.append((row.t_ns, values))

        read_table(path, ("t_s", "robot", *GPS), allowed=(), globe=self.globe).each(self.request, take)
        self.gps = {robot: PositionTrack.of(rows) for robot, rows in tracks.items()}


def known_columns(own: Names = CANONICAL) -> Names:
    """Return these columns and those of the motions and sensors that users have registered."""
    models = [model for role in ("motion", "sensor") for of in classes(role).values() for model in of]
    columns = [name for model in models if not is_own(model) for name in getattr(model, "columns", ())]
    return (*own, *columns)


def stream(path: Path, request: Request) -> Iterator[Event]:
    """Yield the events of the native log in a folder, in their order, without keeping them.

    Raises LogError with file and line, for rows that are not in the order of time, too.
    """
    reader, there = _NativeReader(request, in_order=True), tables(path)
    files = [
        _by_time(there[name], read_file(there[name]) or iter(()))
        for name, read_file in zip(FILES, reader.readers, strict=True)
        if name in there and name in EVENTS
    ]
    return merge(*files, key=sort_key)


def _by_time(path: Path, events: Iterator[Event]) -> Iterator[Event]:
    """Yield the events of a file, those of one time in their order.  Raises LogError if its times run backwards."""
    last_ns = None
    for t_ns, same in groupby(events, key=lambda event: event.t_ns):
        if last_ns is not None and t_ns < last_ns:
            raise LogError(
                f"{path}: an event at {fixed_seconds(t_ns)} s after one at {fixed_seconds(last_ns)} s, expected rows "
                "in the order of time: only these can be read one by one"
            )
        last_ns = t_ns
        yield from sorted(same, key=sort_key)


def refuse_misspelt_robots(places: Begins, known: Collection[str], request: Request) -> set[str]:
    """Refuse the robots whose name seems misspelt, with file and line, and return them.

    Or that have nothing in common with the others: scans without controls, where another robot has controls.  Not those
    asked for by name, those of `known` and those whose name differs by its digits: they are numbered.
    """
    files: dict[str, dict[Path, int]] = {}
    for (path, robot, _), line in places.items():
        files.setdefault(robot, {}).setdefault(path, line)
    strays: set[str] = set()
    for robot, lines in files.items() if request.robots is None else ():
        meant = () if len(lines) > 1 or robot in known else _meant(robot, files, strays)
        if meant:
            (path, line), every = next(iter(lines.items())), "both" if len(meant) == 1 else "all"
            request.refuse(
                f"{path}:{line}: robot {robot!r} is in no other file of the log, "
                f"expected {' or '.join(map(repr, meant))}; if {every} are robots, ask for them: "
                f"log.robots=[{','.join([*meant, robot])}]"
            )
            strays.add(robot)
    return strays


def _meant(robot: str, files: Mapping[str, Mapping[Path, int]], strays: set[str]) -> Names:
    """Return the robot of nearly this name that is in another file, or else all that are, unless they are numbered."""
    there = [other for other, lines in files.items() if lines.keys() - files[robot].keys() and other not in strays]
    others = [other for other in there if _letters(other) != _letters(robot)]
    near = get_close_matches(robot, others, n=1, cutoff=NEAR)
    return tuple(near) if near or len(others) < len(there) else tuple(others)


def _letters(name: str) -> str:
    return re.sub("[0-9]", "", name)


ANY = (*FILES, *(Path(name).with_suffix(PARQUET).name for name in FILES))
NATIVE = Format("native", "a folder with controls.csv, scans.csv", lambda path: folder_of(path, ANY), read)
