"""The parts common to importers: the call, the log, exact times and rows of text."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from decimal import Decimal
from difflib import get_close_matches
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from ruamel.yaml import YAML

from kalmark.arrays import Array
from kalmark.declare import Parameter, parameters
from kalmark.errors import LogError
from kalmark.events import LONGEST_ID, MOST, MOST_OTHER, Event, Id, short_text, sort_key
from kalmark.files import refuse_aliases
from kalmark.geometry import rotations
from kalmark.logs.log import Log, Names, Section
from kalmark.logs.table_columns import TIMES, in_unit_of

Refuse = Callable[[str], None]
"""Takes one line about a bad row: raises it as a LogError, or notes it and lets reading go on (`on_error`)."""

_PLAIN_TIME = re.compile(r"(-?)([0-9]+)(?:\.([0-9]{0,9}))?")
_OPENCV_HEAD = re.compile(r"\A%YAML:[^\n]*")  # which is no YAML
_INTEGER = re.compile(r"[+-]?[0-9]+")
_LONGEST_TIME = 60  # characters; 2**63 ns in seconds has 20
_T_MAX_NS = 2**63 - 1


class LeftOut(str):
    """A line about several `records` left out of a log; a plain text is about one."""

    records: int

    def __new__(cls, text: str, records: int) -> LeftOut:
        """Return the line."""
        line = super().__new__(cls, text)
        line.records = records
        return line


def records_of(line: str) -> int:
    """Return the number of left-out records that a line stands for."""
    return line.records if isinstance(line, LeftOut) else 1


@dataclass(frozen=True)
class Request:
    """Hold what the caller of `open_log` asked for: the robots (None: all) and what to do with a bad row.

    `refuse` takes a bad row; `skipped` collects what is left out, and is the log's list of that name.  With `progress`
    what takes longer than two seconds shows a bar on standard error.
    """

    robots: Names | None
    refuse: Refuse
    skipped: list[str]
    progress: bool = False

    def leave_out(self, records: int, line: str) -> None:
        """List that so many records were left out."""
        self.skipped.append(LeftOut(line, records))

    def includes(self, robot: str) -> bool:
        """Return whether this robot was asked for."""
        return self.robots is None or robot in self.robots


@dataclass(frozen=True)
class Format:
    """Describe one log format: `find` recognises it (the path to read, or None), `read` reads it.

    `read` takes that path, a `Request`, and the format's own options, each declared as a parameter of a model is: from
    the annotations follow their checks, keys of configurations and documentation.  A `general` one is recognised where
    no other is.  With `describes_all` a log has all that a configuration needs.  `robots` are those that a log may
    observe, in it or not; `known_maps` reads files of landmarks known beforehand, by the endings of their names.
    """

    name: str
    what: str
    find: Callable[[Path], Path | None]
    read: Callable[..., Log]
    robot_prefix: str = ""
    describes_all: bool = False
    general: bool = False
    robots: Names = ()
    known_maps: Mapping[str, Callable[[Path, bool], list[Any]]] = field(default_factory=dict, hash=False)

    @cached_property
    def options(self) -> dict[str, Parameter]:
        """The options that its logs may be read with, by name."""
        return {option.name: option for option in parameters(self.read)[2:]}


def refuse_options(declared: Mapping[str, Parameter], given: Mapping[str, Any], format: str = "") -> None:
    """Refuse options of logs that are unknown to a format, or not as they are declared.  Raises LogError."""
    for name, value in given.items():
        if name not in declared:
            wanted = f"{', '.join(declared) or 'none'}{spelling_hint(name, declared)}"
            raise LogError(f"log option {name!r} is unknown to {format}, expected {wanted}")
        option = declared[name]
        if value is not option.default and (wanted := option.refused(value)):
            hint = spelling_hint(str(value), option.words)
            raise LogError(f"log option {name} is {short_text(value)}, expected {wanted}{hint}")


def one_robot(
    format: str, path: Path, request: Request, robot: str, events: Iterable[Event], controls: Names,
    sensors: Mapping[str, Names], *, name: str = "", **rest: Any
) -> Log:  # fmt: skip
    """Return the log of one robot: its events in any order, the columns of its controls (none: ()) and sensors."""
    return Log(
        name=name or format, format=format, path=path, robots=(robot,), events=sorted(events, key=sort_key),
        skipped=request.skipped, control_columns={robot: controls} if controls else {},
        sensor_columns={(robot, sensor): columns for sensor, columns in sensors.items()}, **rest,
    )  # fmt: skip


def folder_of(path: Path, names: Iterable[str]) -> Path | None:
    """Return the folder that `path` is, or is in as one of these files, if it holds at least one of them."""
    folder = path if path.is_dir() else path.parent
    if path.is_file() and path.name not in names:
        return None
    return folder if any((folder / name).is_file() for name in names) else None


def spelling_hint(word: str, words: Iterable[str]) -> str:
    """Return a hint at the word that was probably meant, a column in the unit of the word, or nothing."""
    words = list(words)
    close = [column for each in words if (column := in_unit_of(word, each))] or get_close_matches(word, words, n=1)
    return f"; did you mean {close[0]!r}?" if close else ""


def reason_of(error: object, most: int = 160) -> str:
    """Return the text of an error of a library on one line, so many characters of it; without a text its type."""
    return " ".join(str(error).split())[:most] or type(error).__name__


def one_of(words: Iterable[str], word: Any) -> str:
    """Return that one of these words is expected, and the one that was probably meant."""
    words = list(words)
    return f"expected one of {', '.join(words)}{spelling_hint(str(word), words)}"


def quantity(value: Any, name: str) -> float:
    """Return an option's value as a finite number.  Raises LogError."""
    try:
        number = float(value)
    except (TypeError, ValueError, OverflowError):
        number = float("nan")
    if isinstance(value, bool) or not math.isfinite(number):
        raise LogError(f"log option {name} is {short_text(value)}, expected a finite number")
    if abs(number) > MOST["m"]:
        raise LogError(f"log option {name} is {short_text(value)}, expected at most {MOST['m']:.0e}")
    return number


# ------------------------------------------------------------------ text, without losing a bit
def raise_refusal(line: str) -> None:
    """Refuse a bad row by raising LogError."""
    raise LogError(line)


def nanoseconds_of_text(text: str, unit_ns: int = 1_000_000_000) -> int:
    """Return the time in `text`, in units of `unit_ns`, as the nearest integer nanoseconds, exactly, or ValueError."""
    if len(text) > _LONGEST_TIME:
        raise ValueError(text)
    plain = _PLAIN_TIME.fullmatch(text) if unit_ns == 1_000_000_000 else None
    if plain:
        sign, whole, fraction = plain.groups()
        t_ns = int(whole) * 1_000_000_000 + int((fraction or "").ljust(9, "0"))
        t_ns = -t_ns if sign else t_ns
    else:
        try:
            t_s = Decimal(text if "_" not in text else "")
            if not t_s.copy_abs() < _T_MAX_NS:  # abs overflows; of 1e999990 an integer has a million digits
                raise ValueError(text)
            t_ns = int((t_s * unit_ns).to_integral_value())
        except (ArithmeticError, ValueError):  # of Decimal: no number, or one too large
            raise ValueError(text) from None
    if abs(t_ns) > _T_MAX_NS:
        raise ValueError(text)
    return t_ns


def landmark_id(text: str) -> Id:
    """Return an id from a file: int if the text is an integer, otherwise the text; or ValueError if it is too long."""
    if len(text) > LONGEST_ID:
        raise ValueError(f"{short_text(text)} is an id of {len(text)} characters, expected at most {LONGEST_ID}")
    return int(text) if _INTEGER.fullmatch(text) else text


BETWEEN = "|"  # names of several blocks in one text


def names_of_text(text: str) -> list[Id]:
    """Return the robots and landmarks of a text that has several, or ValueError if one is too long."""
    return [landmark_id(part.strip()) for part in text.split(BETWEEN)]


def number_of_text(text: str, limit: float = MOST_OTHER**2) -> float:
    """Return a finite number of at most `limit` (of a variance, as the widest), or ValueError."""
    value = float(text)
    if not math.isfinite(value) or abs(value) > limit or "_" in text:
        raise ValueError(text)
    return value


def is_number_text(text: str) -> bool:
    """Return whether a text is a finite number."""
    try:
        number_of_text(text)
    except ValueError:
        return False
    return True


def read_text(path: Path) -> str:
    """Return the content of a text file.  Raises LogError if it is missing, empty or not text."""
    try:
        text = path.read_bytes().decode("utf-8-sig")
    except OSError as error:
        raise LogError(f"{path}: {error.strerror or error}, expected a readable file") from None
    except UnicodeDecodeError as error:
        raise LogError(f"{path}: byte {error.start} is not text, expected a text file in UTF-8") from None
    if not text.strip():
        raise LogError(f"{path}:1: the file is empty, expected rows of data")
    return text


def text_rows(path: Path, text: str | None = None) -> Iterator[tuple[int, list[str]]]:
    """Yield (line number, cells) of white-space separated text, without blank lines and `#` comments."""
    text = read_text(path) if text is None else text
    for line, content in enumerate(text.split("\n"), start=1):
        cells = content.split()
        if cells and not cells[0].startswith("#"):
            yield line, cells


def rows_in_time(
    file: Path, rows: Iterable[tuple[int, list[str]]], refuse: Refuse = raise_refusal, unit: str = "s",
    strictly: bool = True,
) -> Iterator[tuple[int, int, list[str]]]:  # fmt: skip
    """Yield (line, t_ns, other cells) of rows that begin with a time; one that runs back goes to `refuse`.

    So does one that stands still, if `strictly`.  Raises LogError if there is no row.
    """
    last_ns, last, line = -_T_MAX_NS - 1, "", 0
    wanted = "increasing times" if strictly else "times that never run backwards"
    for line, (cell, *rest) in rows:
        try:
            t_ns = nanoseconds_of_text(cell, TIMES[f"t_{unit}"])
        except ValueError:
            refuse(f"{file}:{line}: {short_text(cell)}, expected a time in {unit}")
            continue
        if t_ns < last_ns + strictly:
            refuse(f"{file}:{line}: time {cell} {unit} after {last} {unit}, expected {wanted}")
            continue
        last_ns, last = t_ns, cell
        yield line, t_ns, rest
    if not line:
        raise LogError(f"{file}:1: no rows of data, expected rows that begin with a time in {unit}")


def timed_rows(
    path: Path, names: Names, refuse: Refuse, rows: Iterable[tuple[int, list[str]]] | None = None, unit: str = "s",
    strictly: bool = False,
) -> Iterator[tuple[int, int, list[float]]]:  # fmt: skip
    """Yield (line, t_ns, numbers) of rows of a time and `names`, as `rows_in_time`; bad rows go to `refuse`.

    The rows are those of the text of the file, or given.
    """
    rows = text_rows(path) if rows is None else rows
    for line, t_ns, cells in rows_in_time(path, rows, refuse, unit, strictly):
        if len(cells) != len(names):
            columns = ", ".join((f"t_{unit}", *names))
            refuse(f"{path}:{line}: {len(cells) + 1} numbers in the row, expected {len(names) + 1}: {columns}")
            continue
        try:
            values = [number_of_text(cell) for cell in cells]
        except ValueError:
            odd = next(n for n, cell in enumerate(cells) if not is_number_text(cell))
            refuse(f"{path}:{line}: {names[odd]} is {cells[odd]!r}, expected a finite number")
            continue
        yield line, t_ns, values


# ------------------------------------------------------------------ rigs: poses of other conventions, YAML files
def frame(position: Any, matrix: Any) -> Array:
    """Return the frame (7,), x y z qx qy qz qw, of a position (3,) and a rotation matrix (3, 3), local to global."""
    turn = rotations.from_matrix(np.array(matrix, dtype=np.float64))
    return np.append(np.asarray(position, dtype=np.float64).reshape(3), turn)


def read_mapping(path: Path) -> Section:
    """Return the content of a YAML file, OpenCV's among them.  Raises LogError if it is none."""
    text = _OPENCV_HEAD.sub("", read_text(path)).replace("!!opencv-matrix", "")
    try:
        content = YAML(typ="safe", pure=True).load(text)
    except Exception as error:  # of odd YAML the parser raises anything: unhashable keys, dates, integers, recursion
        where = getattr(error, "problem_mark", None)
        line = where.line + 1 if where is not None else 1
        problem = reason_of(getattr(error, "problem", None) or error, 80)
        raise LogError(f"{path}:{line}: not YAML ({problem}), expected a mapping") from None
    refuse_aliases(content, str(path), LogError)
    if not isinstance(content, dict):
        raise LogError(f"{path}:1: holds {type(content).__name__}, expected a mapping")
    return content
