"""Tables with a header, read row by row: of CSV and Parquet, or in memory; every complaint with file and line, or row.

A file is never in memory as a whole.  Units other than kalmark's are recognised by the end of a column's name
(`FACTORS`) and never guessed.
"""

from __future__ import annotations

import csv
import io
import math
import re
from collections import defaultdict
from collections.abc import Callable, Container, Generator, Iterator, Sequence
from dataclasses import dataclass, field
from difflib import get_close_matches
from pathlib import Path
from sys import intern
from typing import Any, NamedTuple, TypeVar

import numpy as np

from kalmark.arrays import Array
from kalmark.errors import LogError
from kalmark.events import MOST, Id, bound, largest_magnitude, short_text, unit_quaternion
from kalmark.logs import geodesy
from kalmark.logs.geodesy import Globe
from kalmark.logs.log import Names, SensorKey
from kalmark.logs.progress import track
from kalmark.logs.source import (
    Request,
    landmark_id,
    names_of_text,
    nanoseconds_of_text,
    number_of_text,
    read_text,
    reason_of,
    spelling_hint,
)
from kalmark.logs.table_columns import (
    DIRECTIONS,
    GLOBE,
    NAMES,
    NOT_NEGATIVE,
    POSE3,
    TIMES,
    UNITS,
    WHEELS,
    in_order,
    in_own_unit,
    in_unit_of,
    split_unit,
)

T = TypeVar("T")
CSV, PARQUET = ".csv", ".parquet"
ONE_IN_A_FILE = "expected one of them in a file: scans.csv and measurements.csv may have one each"
NEAR_PI = 0.99  # of pi: directions all around that are within pi come nearer to it
BATCH = 65_536  # rows of Parquet at a time
SEPARATORS = {"\t": "tabs", "|": "'|'", " ": "blanks"}

QUATERNION = POSE3[3:]

_COV = re.compile(r"cov_([0-9xyz])_?([0-9xyz])")


class Content(NamedTuple):
    """Content of a source: its header with the place of it, rows with their numbers, and how much of it has been read.

    `comma`: numbers may have a decimal comma.  `word` is what stands before the number of a row in messages.
    """

    header: list[str]
    where: str
    rows: Iterator[tuple[int, Sequence[Any]]]
    word: str = ":"
    comma: bool = False
    size: int = 0
    at: Callable[[], int] = lambda: 0

    def __str__(self) -> str:
        return self.where


@dataclass(frozen=True)
class Table:
    """Hold a table: its header by name, the columns that are values, those of noise, and its rows, to be read once.

    `given` are the names of columns in other units, with their factors, and `unit_ns` that of times.  With a `globe`
    its positions are on that: the cells of x_m, y_m and z_m are latitude, longitude and height.
    """

    path: Path
    index: dict[str, int]
    value_columns: Names
    noise_columns: Names
    content: Content
    given: dict[str, tuple[str, float]]
    unit_ns: int = TIMES["t_s"]
    globe: Globe | None = None
    directions: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))

    def name(self, column: str) -> str:
        """Return a column's name as the source has it."""
        return self.given[column][0] if column in self.given else column

    def each(self, request: Request, take: Callable[[Row], None], timed: bool = True, strictly: bool = False) -> None:
        """Let `take` read every row, as `made` does."""
        for _ in self.made(request, take, timed, strictly=strictly):
            pass

    def made(
        self, request: Request, make: Callable[[Row], T | None], timed: bool = True, by_sensor: bool = False,
        strictly: bool = False,
    ) -> Iterator[T]:  # fmt: skip
        """Yield `make` of every row; refuse a row that it refuses, or with another number of cells than the header.

        If `timed`, refuse those whose time runs backwards, or `strictly` stands still, within a robot (and sensor).
        Raises LogError if there is no row.
        """
        last: dict[SensorKey, Row] = {}
        content, row = self.content, None
        shown = request.progress and content.size > 0
        for line, cells in track(content.rows, self.path.name, content.size, show=shown, at=content.at):
            row = Row(self, line, cells)
            try:
                if len(cells) != len(self.index):
                    names = ", ".join(map(self.name, self.index))
                    raise Refused(f"{len(cells)} cells, expected {len(self.index)}: {names}")
                if timed:
                    row.read_start(by_sensor)
                    before = last.get(row.key)
                    if before is not None and row.t_ns < before.t_ns + strictly:
                        wanted = "increasing times" if strictly else "times that never run backwards"
                        raise Refused(f"time {row.time} after {before.time} of {row.robot}, expected {wanted}")
                    last[row.key] = row
                found = make(row)
            except Refused as refused:
                request.refuse(f"{self.path}{content.word}{line}: {refused}")
                continue
            if found is not None:
                yield found
        if row is None:
            raise LogError(f"{content.where}: no rows after the header, expected at least one")
        self.refuse_other_angles()

    def refuse_other_angles(self) -> None:
        """Refuse directions whose numbers contradict the unit of their column.  Raises LogError."""
        for column, values in self.directions.items():
            size, name = np.abs(values) / self.given.get(column, (column, 1.0))[1], self.name(column)
            stem, _, unit = name.rpartition("_")
            beyond, told = int((size > 2 * np.pi).sum()), f"{self.content.where}: {name}: "
            if unit == "rad" and 2 * beyond > len(size):
                wanted = f"radians; degrees are the column {stem}_deg"
                raise LogError(f"{told}{beyond} of {len(size)} numbers are beyond 2 pi, expected {wanted}")
            if unit == "deg" and NEAR_PI * np.pi < size.max() <= np.pi:
                wanted = f"degrees; radians are the column {stem}_rad"
                raise LogError(f"{told}all {len(size)} numbers are within pi and reach it, expected {wanted}")


def _of_parquet(path: Path) -> Content:
    def parts() -> Iterator[Any]:
        """Yield the names of the columns and the number of rows, then columns of some rows at a time."""
        import pyarrow
        import pyarrow.parquet

        try:
            file = pyarrow.parquet.ParquetFile(path)
            yield [str(name) for name in file.schema_arrow.names], file.metadata.num_rows
            for batch in file.iter_batches(BATCH):
                yield [column.to_pylist() for column in batch.columns]
        except (pyarrow.ArrowException, OSError, ValueError, UnicodeError) as error:
            reason = reason_of(error)
            raise LogError(f"{path}: not a file of Parquet that can be read ({reason}), expected a whole one") from None

    found, done = parts(), 0
    names, size = next(found)

    def rows() -> Iterator[tuple[int, Sequence[Any]]]:
        nonlocal done
        for columns in found:
            for cells in zip(*columns, strict=True):
                done += 1
                yield done, cells

    return Content(names, str(path), rows(), " row ", size=size, at=lambda: done)


def _of_csv(path: Path, separator: str = ",") -> Content:
    """Return the content of a CSV file; where its header has semicolons and no comma, they separate the cells."""
    if path.suffix == CSV and not path.is_file():
        read_text(path)  # raises with the reason
    stream = path.open("rb")
    encoding = "utf-16" if stream.read(2) in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig"
    stream.seek(0)
    reader = csv.reader(io.TextIOWrapper(stream, encoding, newline=""), strict=True, delimiter=separator)

    def rows() -> Generator[tuple[int, list[str]], None, None]:
        try:
            for cells in reader:
                if cells:
                    yield reader.line_num, cells
        except csv.Error as error:
            raise LogError(f"{path}:{reader.line_num}: {error}, expected comma separated values") from None
        except UnicodeError:
            read_text(path)  # raises with the line
            raise LogError(f"{path}: not text, expected a text file in UTF-8") from None
        finally:
            stream.close()

    found: Generator[tuple[int, list[str]], None, None] = rows()
    line, header = next(found, (0, []))
    if not any(cell.strip() for cell in header):
        read_text(path)
        raise LogError(f"{path}:1: the file is empty, expected rows of data")
    header = [cell.strip() for cell in header]
    if len(header) == 1 and ";" in header[0]:
        found.close()
        return _of_csv(path, ";")
    other = next((what for cut, what in SEPARATORS.items() if cut in header[0]), "")
    if len(header) == 1 and other:
        raise LogError(f"{path}:{line}: the cells seem to be separated by {other}, expected commas or semicolons")
    size = path.stat().st_size

    def at() -> int:
        return size if stream.closed else min(stream.tell(), size)

    return Content(header, f"{path}:{line}", found, comma=separator == ";", size=size, at=at)


def read_table(
    source: Path | Content, required: Names, allowed: Names | None = None,
    known: Names = (), globe: Globe | None = None,
) -> Table:  # fmt: skip
    """Return the table of a source, which must have the columns `required`.

    Other columns must be among `allowed` (None: any but those that are one of `known` in another unit or in none);
    noise columns always may be there.  Columns in other units are renamed, and their numbers multiplied; those of
    positions on a `globe` are taken for x_m, y_m and z_m, if one is given.  Raises LogError if the source is missing or
    empty, or has a header that does not fit.
    """
    if isinstance(source, Content):
        content = source
    else:
        content = _of_parquet(source) if source.suffix == PARQUET else _of_csv(source)
    where, known = content.where, (*required, *(allowed or ()), *known)
    header, given, unit_ns = header_in_units(content.header, known)
    on_globe = globe is not None and any(name in header for name in ("lat_deg", "lon_deg"))
    if on_globe:
        header = columns_in_plane(where, header, given)
    for name in header:
        refuse_unit(where, name, known)
    for name in required:
        if name not in header:
            hints = {other: hint for other in header if other not in known and (hint := spelling_hint(other, [name]))}
            odd, hint = next(iter(hints.items()), ("", ""))
            what = f"column {odd!r} is unknown" if odd else f"no column {name}"
            raise LogError(f"{where}: {what}, expected {', '.join(required)}{hint}")
    for name in header:
        if header.count(name) > 1 or not name:
            twice = [given for given, meant in zip(content.header, header, strict=True) if meant == name]
            if len({*twice}) > 1:
                raise LogError(f"{where}: columns {' and '.join(twice)} are both {name}, {ONE_IN_A_FILE}")
            raise LogError(f"{where}: column {name!r} appears {len(twice)} times, expected named columns")
    noise = tuple(name for name in header if name.startswith(("sigma_", "cov_")))
    values = [name for name in header if name not in NAMES and name not in noise]
    for name in values:
        if allowed is not None and name not in required and name not in allowed:
            raise LogError(
                f"{where}: column {name!r} is unknown, expected "
                f"{', '.join((*required, *allowed))}{spelling_hint(name, allowed)}"
            )
    index = {name: i for i, name in enumerate(header)}
    return Table(
        Path(str(source)), index, tuple(in_order(values)), noise, content, given, unit_ns, globe if on_globe else None
    )


def columns_in_plane(where: str, header: list[str], given: dict[str, tuple[str, float]]) -> list[str]:
    """Return a header with the columns of positions on the globe under their names in the tangent plane.

    Notes in `given` what they were called.  Raises LogError where one is missing, or positions are there in both ways.
    """
    for name in ("lat_deg", "lon_deg"):
        if name not in header:
            raise LogError(f"{where}: no column {name}, expected lat_deg, lon_deg[, height_m]")
    both = [name for name in GLOBE.values() if name in header]
    if both:
        raise LogError(f"{where}: columns lat_deg and {both[0]}, {ONE_IN_A_FILE}")
    given.update({GLOBE[name]: (name, 1.0) for name in header if name in GLOBE})
    return [GLOBE.get(name, name) for name in header]


def header_in_units(header: list[str], known: Names) -> tuple[list[str], dict[str, tuple[str, float]], int]:
    """Return a header in kalmark's units, the names of columns that had others with their factors, and that of times.

    Only names that are known, or their standard deviations, have units that are known.
    """
    out, given, unit_ns = [], {}, TIMES["t_s"]
    for name in header:
        meant, factor = in_own_unit(name)
        if name in TIMES and "t_s" in known and name not in known:
            out.append("t_s")
            given["t_s"], unit_ns = (name, 1.0), TIMES[name]
        elif name not in known and meant.removeprefix("sigma_") in known:
            out.append(meant)
            given[meant] = (name, factor)
        else:
            out.append(name)
    return out, given, unit_ns


def refuse_unit(where: str, name: str, known: Names) -> None:
    """Refuse a column that is one of `known` but for its unit: without it, in another one, or otherwise written."""
    plain = "_".join(re.findall("[a-z0-9]+", name.lower()))
    stem, _ = split_unit(name)
    meant = [each for each in known if stem == each.rpartition("_")[0] or plain == each]
    if stem and name not in known and meant:
        closest = next(iter(get_close_matches(plain, meant, n=1, cutoff=0.0)))
        measure = UNITS.get(closest.rpartition("_")[2])
        other = in_unit_of(name, closest)
        hint = f"; did you mean {other!r}?" if other not in ("", name, closest) else ""
        raise LogError(
            f"{where}: column {name!r} is unknown, expected {closest}{f', in {measure}' if measure else ''}{hint}"
        )


def decimal_point(text: str) -> str:
    """Return a number with a decimal comma with a point.  Raises ValueError if it has both, as of thousands."""
    if "," not in text:
        return text
    if "." in text or text.count(",") > 1:
        raise ValueError(text)
    return text.replace(",", ".")


class Refused(Exception):
    """Reason why a row is refused."""


class Row:
    """One row of a table: its cells by column, its time and names once they have been read."""

    __slots__ = ("cells", "line", "robot", "sensor", "t_ns", "table")

    def __init__(self, table: Table, line: int, cells: Sequence[Any]) -> None:
        self.table, self.line, self.cells = table, line, cells
        self.t_ns, self.robot, self.sensor = 0, "", ""

    @property
    def key(self) -> SensorKey:
        """Its robot and sensor."""
        return self.robot, self.sensor

    @property
    def time(self) -> str:
        """Its time as the source has it, with the unit."""
        return f"{self.text('t_s')} {self.table.name('t_s').removeprefix('t_')}"

    def text(self, column: str) -> str:
        """Return the text of a cell, "" of an empty one."""
        cell = self.cells[self.table.index[column]]
        return cell.strip() if type(cell) is str else "" if cell is None else str(cell)

    def read_start(self, with_sensor: bool) -> None:
        """Read the column t_s exactly, the robot and, if asked, the sensor.  Raises Refused."""
        text, table = self.text("t_s"), self.table
        try:
            self.t_ns = nanoseconds_of_text(decimal_point(text) if table.content.comma else text, table.unit_ns)
        except ValueError:
            raise Refused(
                f"{table.name('t_s')} is {short_text(text)}, expected a finite number of seconds, within 292 years of 0"
            ) from None
        self.robot, self.sensor = intern(self.text("robot")), intern(self.text("sensor")) if with_sensor else ""
        if not self.robot or (with_sensor and not self.sensor):
            raise Refused(f"{'sensor' if self.robot else 'robot'} is empty, expected a name")

    def id(self) -> Id | None:
        """Return the landmark's id, None for an empty cell.  Raises Refused."""
        return next(iter(self.names("id")), None)

    def names(self, column: str) -> list[Id]:
        """Return the robots and landmarks of a cell, none of an empty or missing one.  Raises Refused."""
        if column not in self.table.index:
            return []
        cell, text = self.cells[self.table.index[column]], self.text(column)
        if type(cell) is float and cell.is_integer():  # as tables in memory make numbers beside empty cells
            text = str(int(cell))
        try:
            return [] if not text else names_of_text(text) if column == "of" else [landmark_id(text)]
        except ValueError as error:
            raise Refused(f"{column}: {error}") from None

    def new_id(self, known: Container[Id]) -> Id:
        """Return the id of a landmark that is not known yet.  Raises Refused."""
        name = self.id()
        if name is None:
            raise Refused("id is empty, expected the landmark's id")
        if name in known:
            raise Refused(f"id {name} is in this file already, expected each landmark once")
        return name

    def number(self, column: str) -> float:
        """Return the finite number in a column, in kalmark's unit.  Raises ValueError."""
        cell, table = self.cells[self.table.index[column]], self.table
        if type(cell) is str:
            value = number_of_text(decimal_point(cell) if table.content.comma else cell, math.inf)
        elif isinstance(cell, int | float) and not isinstance(cell, bool):
            value = number_of_text(repr(cell), math.inf) if type(cell) is int else cell
            if not math.isfinite(value):
                raise ValueError(cell)
        else:
            raise ValueError(cell)
        return value * table.given[column][1] if column in table.given else value

    def numbers(self, columns: Names) -> list[float]:
        """Return the finite numbers in these columns.  Raises Refused."""
        values, name = [], self.table.name
        for column in columns:
            try:
                values.append(self.number(column))
            except (ValueError, OverflowError):
                raise Refused(f"{name(column)} is {short_text(self.text(column))}, expected a finite number") from None
            if abs(values[-1]) > (MOST["m"] ** 2 if column.startswith("cov_") else largest_magnitude(column)[0]):
                wanted = f"at most {MOST['m'] ** 2:.0e}" if column.startswith("cov_") else bound(column)
                wanted += ": did the counter of the wheel run over (2^32 steps)?" if column in WHEELS else ""
                raise Refused(f"{name(column)} is {short_text(self.text(column))}, expected {wanted}")
            if values[-1] < 0 and column in NOT_NEGATIVE:
                raise Refused(f"{name(column)} is {self.text(column)}, expected a {NOT_NEGATIVE[column]} of at least 0")
            if column in DIRECTIONS:
                self.table.directions[column].append(values[-1])
        if columns[-1:] == QUATERNION[-1:] and columns[-4:] == QUATERNION:
            values[-4:] = unit_quaternion(np.array(values[-4:]), Refused).tolist()
        return values if self.table.globe is None else self._placed(self.table.globe, columns, values)

    def _placed(self, globe: Globe, columns: Names, values: list[float]) -> list[float]:
        """Return values in which a position on the globe is one in the tangent plane.  Raises Refused."""
        at = [columns.index(name) for name in GLOBE.values() if name in columns]
        if not at:
            return values
        for name in ("x_m", "y_m"):
            if name not in columns:
                raise Refused(f"{self.table.name(name)} is {short_text(self.text(name))}, expected a finite number")
        lla = [values[i] for i in at]
        if wrong := geodesy.fault(lla):
            raise Refused(wrong)
        for i, place in zip(at, globe.local(lla).tolist(), strict=False):
            values[i] = place
        return values

    def values(self, columns: dict[SensorKey, Names]) -> list[float]:
        """Return this row's values; the first of its key settles in `columns` which these are.  Raises Refused."""
        used = columns.get(self.key) or tuple(name for name in self.table.value_columns if self.text(name))
        if not used:
            names = ", ".join(self.table.value_columns) or "a column of values"
            raise Refused(f"no value in the row, expected numbers in {names}")
        missing = [name for name in used if name not in self.table.index]
        if missing:
            who, names = " ".join(self.key).strip(), ", ".join(used)
            raise Refused(f"no column {missing[0]}, expected {names} as {who} has in another file")
        values = self.numbers(used)
        for name in self.table.value_columns:
            if name not in used and self.text(name):
                who = " ".join(self.key).strip()
                raise Refused(
                    f"{self.table.name(name)} is {self.text(name)}, expected an empty cell as in {who}'s first row"
                )
        columns.setdefault(self.key, used)
        return values

    def measured(self, columns: dict[SensorKey, Names], *, definite: bool = True) -> tuple[list[float], Array | None]:
        """Return this row's `values` and their own covariance (m, m), None if it gives none.  Raises Refused."""
        y = self.values(columns)
        given = tuple(name for name in self.table.noise_columns if self.text(name))
        if not given:
            return y, None
        cov = covariance_of_cells(dict(zip(given, self.numbers(given), strict=True)), columns[self.key])
        lowest = float(np.linalg.eigvalsh(cov)[0])
        if lowest < -1e-12 * float(np.abs(cov).max()) or (definite and lowest <= 0):
            wanted = "positive definite" if definite else "positive semidefinite"
            raise Refused(f"noise {cov.tolist()} has eigenvalue {lowest:.3g}, expected it {wanted}")
        return y, cov


def covariance_of_cells(given: dict[str, float], columns: Names) -> Array:
    """Return the covariance that `sigma_<column>` or `cov_ij` numbers describe.  Raises Refused."""
    size = len(columns)
    sigmas = [f"sigma_{name}" for name in columns]
    if any(name.startswith("sigma_") for name in given):
        if sorted(given) != sorted(sigmas):
            raise Refused(f"noise in {', '.join(given)}, expected {', '.join(sigmas)}")
        if any(value < 0 for value in given.values()):
            raise Refused(f"noise {given}, expected standard deviations of at least 0")
        return np.diag([given[name] ** 2 for name in sigmas])
    axes = {**{str(i): i for i in range(size)}, **{name[0]: i for i, name in enumerate(columns) if name[1:] == "_m"}}
    cov = np.full((size, size), np.nan)
    for name, value in given.items():
        match = _COV.fullmatch(name)
        i, j = (axes.get(axis) for axis in match.groups()) if match else (None, None)
        if i is None or j is None or not np.isnan(cov[i, j]):
            break
        cov[i, j] = cov[j, i] = value
    if np.isnan(cov).any() or len(given) != size * (size + 1) // 2:
        raise Refused(f"noise in {', '.join(given)}, expected {', '.join(cov_columns(size))}")
    return cov


def cov_columns(size: int, axes: str = "0123456789") -> list[str]:
    """Return the names of the upper triangle of a covariance, row by row."""
    return [f"cov_{axes[i]}{axes[j]}" for i in range(size) for j in range(i, size)]
