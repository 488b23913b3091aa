"""CSV tables with a header, read row by row, every complaint with file and line."""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path

import numpy as np

from kalmark.arrays import Array
from kalmark.errors import LogError
from kalmark.events import MOST, Id, bound, most, shown
from kalmark.logs.source import Request, landmark_id, nanoseconds, nearest, number, read_text

NAMES = ("t_s", "robot", "sensor", "id")
CONTROL = (
    "v_mps", "vx_mps", "vy_mps", "vz_mps", "w_radps", "wx_radps", "wy_radps", "wz_radps", "steering_rad",
    "dv_mps", "dvx_mps", "dvy_mps", "dvz_mps", "dw_radps", "dwx_radps", "dwy_radps", "dwz_radps",
    "dx_m", "dy_m", "dz_m", "rx_rad", "ry_rad", "rz_rad", "dtheta_rad", "left_rad", "right_rad",
    "front_left_radps", "front_right_radps", "rear_left_radps", "rear_right_radps",
)  # fmt: skip
OBSERVATION = (
    "range_m", "bearing_rad", "azimuth_rad", "elevation_rad", "signature",
    "x_m", "y_m", "z_m", "qx", "qy", "qz", "qw", "x2_m", "y2_m", "z2_m",
    "u_px", "v_px", "ul_px", "vl_px", "ur_px", "vr_px",
    "u1_px", "v1_px", "u2_px", "v2_px", "u3_px", "v3_px", "u4_px", "v4_px", "size_m",
)  # fmt: skip
READING = (  # of a robot itself by its own sensors, and of senders
    "heading_rad", "theta_rad", "rssi_dbm", "difference_m", "roll_rad", "pitch_rad",
    "ax_mps2", "ay_mps2", "az_mps2", "speed_mps", "range_rate_mps",
)  # fmt: skip
CANONICAL = (*CONTROL, *OBSERVATION, *READING)
"""The order in which known columns make a control or an observation, whatever their order in the file."""
NOT_NEGATIVE = {"range_m": "range", "size_m": "size"}
UNITS = {
    "s": "seconds", "m": "metres", "rad": "radians", "px": "pixels", "mps": "m/s", "radps": "rad/s", "mps2": "m/s^2",
}  # fmt: skip
"""The units of columns, by the end of their names."""
OTHER_UNITS = {
    "ms", "us", "ns", "sec", "secs", "seconds", "min", "h", "mm", "cm", "dm", "km", "in", "ft", "meter", "meters",
    "metre", "metres", "deg", "degree", "degrees", "rads", "radian", "radians", "mrad", "kmh", "kph", "mph", "dps",
    "degps", "degs", "rpm", "pixel", "pixels", "pix",
}  # fmt: skip
SEPARATORS = {";": "';'", "\t": "tabs", "|": "'|'", " ": "blanks"}

_RANK = {name: rank for rank, name in enumerate(CANONICAL)}
_COV = re.compile(r"cov_([0-9xyz])_?([0-9xyz])")


@dataclass(frozen=True)
class Table:
    """Hold a CSV file: its header by name, the columns that are values, those of noise, and its rows."""

    path: Path
    index: dict[str, int]
    value_columns: tuple[str, ...]
    noise_columns: tuple[str, ...]
    content: list[tuple[int, list[str]]]

    def each(
        self, request: Request, take: Callable[[Row], None], timed: bool = True, by_sensor: bool = False,
        strictly: bool = False,
    ) -> None:  # fmt: skip
        """Let `take` read every row; refuse those that it refuses, or with other cells than the header has.

        If `timed`, refuse those whose time runs backwards, or `strictly` stands still, within a robot (and sensor).
        """
        last: dict[tuple[str, str], Row] = {}
        for line, cells in self.content:
            row = Row(self, line, cells)
            try:
                if len(cells) != len(self.index):
                    raise Refused(f"{len(cells)} cells, expected {len(self.index)}: {', '.join(self.index)}")
                if timed:
                    row.read_start(by_sensor)
                    before = last.get(row.key)
                    if before is not None and row.t_ns < before.t_ns + strictly:
                        wanted = "increasing times" if strictly else "times that never run backwards"
                        at = f"time {row.text('t_s')} s after {before.text('t_s')} s of {row.robot}"
                        raise Refused(f"{at}, expected {wanted}")
                    last[row.key] = row
                take(row)
            except Refused as refused:
                request.refuse(f"{self.path}:{line}: {refused}")


def read_table(
    path: Path, required: tuple[str, ...], allowed: tuple[str, ...] | None = None, known: tuple[str, ...] = ()
) -> Table:
    """Return the table in a CSV file, which must have the columns `required`.

    Other columns must be among `allowed` (None: any but those that are one of `known` in another unit or in none);
    noise columns always may be there.  Raises LogError if the file is missing, empty, has no row after its header, or
    a header that does not fit.
    """
    reader = csv.reader(io.StringIO(read_text(path), newline=""), strict=True)
    try:
        content = [(reader.line_num, cells) for cells in reader if cells]
    except csv.Error as error:
        raise LogError(f"{path}:{reader.line_num}: {error}, expected comma separated values") from None
    where, header = f"{path}:{content[0][0]}", [cell.strip() for cell in content[0][1]]
    separator = next((what for cut, what in SEPARATORS.items() if cut in header[0]), "")
    if len(header) == 1 and separator:
        raise LogError(f"{where}: the cells seem to be separated by {separator}, expected commas")
    known = (*required, *(allowed or ()), *known)
    for name in header:
        refuse_unit(where, name, known)
    for name in required:
        if name not in header:
            odd = get_close_matches(name, [other for other in header if other not in known], n=1)
            what, hint = (
                (f"column {odd[0]!r} is unknown", f"; did you mean {name!r}?") if odd else (f"no column {name}", "")
            )
            raise LogError(f"{where}: {what}, expected {', '.join(required)}{hint}")
    for name in header:
        if header.count(name) > 1 or not name:
            raise LogError(f"{where}: column {name!r} appears {header.count(name)} times, expected named columns")
    noise = tuple(name for name in header if name.startswith(("sigma_", "cov_")))
    values = [name for name in header if name not in NAMES and name not in noise]
    for name in values:
        if allowed is not None and name not in required and name not in allowed:
            wanted = f"{', '.join((*required, *allowed))}{nearest(name, allowed)}"
            raise LogError(f"{where}: column {name!r} is unknown, expected {wanted}")
    if len(content) == 1:
        raise LogError(f"{where}: no rows after the header, expected at least one")
    values.sort(key=lambda name: _RANK.get(name, len(_RANK)))
    return Table(path, {name: i for i, name in enumerate(header)}, tuple(values), noise, content[1:])


def refuse_unit(where: str, name: str, known: tuple[str, ...]) -> None:
    """Refuse a column that is one of `known` but for its unit: without it, in another one, or otherwise written."""
    plain = "_".join(re.findall("[a-z0-9]+", name.lower()))
    stem, _, unit = plain.rpartition("_")
    stem = stem if unit in OTHER_UNITS or unit in UNITS else plain
    meant = [each for each in known if stem == each.rpartition("_")[0] or plain == each]
    if stem and name not in known and meant:
        closest = next(iter(get_close_matches(plain, meant, n=1, cutoff=0.0)))
        measure = UNITS.get(closest.rpartition("_")[2])
        raise LogError(f"{where}: column {name!r} is unknown, expected {closest}{f', in {measure}' if measure else ''}")


class Refused(Exception):
    """What is wrong with a row."""


class Row:
    """One row of a table: its cells by column, its time and names once they have been read."""

    __slots__ = ("cells", "line", "robot", "sensor", "t_ns", "table")

    def __init__(self, table: Table, line: int, cells: list[str]) -> None:
        self.table, self.line, self.cells = table, line, cells
        self.t_ns, self.robot, self.sensor = 0, "", ""

    @property
    def key(self) -> tuple[str, str]:
        """Its robot and sensor."""
        return self.robot, self.sensor

    def text(self, column: str) -> str:
        """Return the text of a cell."""
        return self.cells[self.table.index[column]].strip()

    def read_start(self, with_sensor: bool) -> None:
        """Read the column t_s exactly, the robot and, if asked, the sensor.  Raises Refused."""
        try:
            self.t_ns = nanoseconds(self.text("t_s"))
        except ValueError:
            wanted = "a finite number of seconds, within 292 years of 0"
            raise Refused(f"t_s is {shown(self.text('t_s'))}, expected {wanted}") from None
        self.robot, self.sensor = self.text("robot"), self.text("sensor") if with_sensor else ""
        if not self.robot or (with_sensor and not self.sensor):
            raise Refused(f"{'sensor' if self.robot else 'robot'} is empty, expected a name")

    def id(self) -> Id | None:
        """Return the landmark's id, None for an empty cell.  Raises Refused."""
        try:
            return landmark_id(self.text("id")) if self.text("id") else None
        except ValueError as error:
            raise Refused(f"id: {error}") from None

    def numbers(self, columns: tuple[str, ...]) -> list[float]:
        """Return the finite numbers in these columns.  Raises Refused."""
        values = []
        for column in columns:
            try:
                values.append(number(self.cells[self.table.index[column]], math.inf))
            except ValueError:
                raise Refused(f"{column} is {shown(self.text(column))}, expected a finite number") from None
            if abs(values[-1]) > (MOST["m"] ** 2 if column.startswith("cov_") else most(column)[0]):
                wanted = f"at most {MOST['m'] ** 2:.0e}" if column.startswith("cov_") else bound(column)
                raise Refused(f"{column} is {shown(self.text(column))}, expected {wanted}")
            if values[-1] < 0 and column in NOT_NEGATIVE:
                raise Refused(f"{column} is {self.text(column)}, expected a {NOT_NEGATIVE[column]} of at least 0")
        return values

    def values(self, columns: dict[tuple[str, str], tuple[str, ...]]) -> list[float]:
        """Return this row's values; the first of its key settles in `columns` which these are.  Raises Refused."""
        used = columns.get(self.key) or tuple(name for name in self.table.value_columns if self.text(name))
        if not used:
            names = ", ".join(self.table.value_columns) or "a column of values"
            raise Refused(f"no value in the row, expected numbers in {names}")
        values = self.numbers(used)
        for name in self.table.value_columns:
            if name not in used and self.text(name):
                who = " ".join(self.key).strip()
                raise Refused(f"{name} is {self.text(name)}, expected an empty cell as in {who}'s first row")
        columns.setdefault(self.key, used)
        return values

    def own_noise(self, columns: tuple[str, ...], *, definite: bool) -> Array | None:
        """Return the covariance (m, m) that this row gives for `columns`, None if none.  Raises Refused."""
        given = tuple(name for name in self.table.noise_columns if self.text(name))
        if not given:
            return None
        cov = covariance(dict(zip(given, self.numbers(given), strict=True)), columns)
        lowest = float(np.linalg.eigvalsh(cov)[0])
        if lowest < -1e-12 * float(np.abs(cov).max()) or (definite and lowest <= 0):
            wanted = "positive definite" if definite else "positive semidefinite"
            raise Refused(f"noise {cov.tolist()} has eigenvalue {lowest:.3g}, expected it {wanted}")
        return cov


def covariance(given: dict[str, float], columns: tuple[str, ...]) -> Array:
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
