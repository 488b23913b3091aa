"""Text in and out without losing a bit: exact times, landmark ids, numbers, and rows that know their line."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator
from decimal import Decimal, InvalidOperation
from pathlib import Path

from kalmark.errors import LogError
from kalmark.events import Id

Refuse = Callable[[str], None]
"""Takes one line about a bad row: raises it as a LogError, or notes it and lets reading go on (`on_error`)."""

_PLAIN_TIME = re.compile(r"(-?)([0-9]+)(?:\.([0-9]{0,9}))?")
_INTEGER = re.compile(r"[+-]?[0-9]+")
_T_MAX_NS = 2**63 - 1


def raising(line: str) -> None:
    """Refuse a bad row by raising LogError."""
    raise LogError(line)


def nanoseconds(text: str) -> int:
    """Return the seconds in `text` as integer nanoseconds, exactly (nearest beyond nine decimals), or ValueError."""
    plain = _PLAIN_TIME.fullmatch(text)
    if plain:
        sign, whole, fraction = plain.groups()
        t_ns = int(whole) * 1_000_000_000 + int((fraction or "").ljust(9, "0"))
        t_ns = -t_ns if sign else t_ns
    else:
        try:
            t_ns = int((Decimal(text) * 1_000_000_000).to_integral_value())
        except (InvalidOperation, OverflowError, ValueError):
            raise ValueError(text) from None
    if abs(t_ns) > _T_MAX_NS:
        raise ValueError(text)
    return t_ns


def seconds(t_ns: int) -> str:
    """Return integer nanoseconds as text in seconds, exactly, with nine decimals."""
    whole, fraction = divmod(abs(t_ns), 1_000_000_000)
    return f"{'-' if t_ns < 0 else ''}{whole}.{fraction:09d}"


def landmark_id(text: str) -> Id:
    """Return an id from a file: int if the text is an integer, otherwise the text."""
    return int(text) if _INTEGER.fullmatch(text) else text


def number(text: str) -> float:
    """Return a finite number, or ValueError."""
    value = float(text)
    if not math.isfinite(value) or "_" in text:
        raise ValueError(text)
    return value


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


def rows(path: Path, text: str | None = None) -> Iterator[tuple[int, list[str]]]:
    """Yield (line number, cells) of white-space separated text, without blank lines and `#` comments."""
    text = read_text(path) if text is None else text
    for line, content in enumerate(text.split("\n"), start=1):
        cells = content.split()
        if cells and not cells[0].startswith("#"):
            yield line, cells


def timed_rows(
    path: Path, names: tuple[str, ...], refuse: Refuse, text: str | None = None
) -> Iterator[tuple[int, int, list[float]]]:
    """Yield (line, t_ns, numbers) of rows `t_s, *names` whose time never runs back; bad rows go to `refuse`.

    Raises LogError if the file is missing, empty or has no row at all.
    """
    last_ns, last_text, count = -_T_MAX_NS, "", 0
    for line, cells in rows(path, text):
        count += 1
        if len(cells) != len(names) + 1:
            columns = ", ".join(("t_s", *names))
            refuse(f"{path}:{line}: {len(cells)} numbers in the row, expected {len(names) + 1}: {columns}")
            continue
        try:
            t_ns, values = nanoseconds(cells[0]), [float(cell) for cell in cells[1:]]
            if not all(map(math.isfinite, values)):
                raise ValueError
        except ValueError:
            refuse(f"{path}:{line}: {bad_cell(cells, ('t_s', *names))}, expected a finite number")
            continue
        if t_ns < last_ns:
            refuse(f"{path}:{line}: time {cells[0]} s after {last_text} s, expected times that never run backwards")
            continue
        last_ns, last_text = t_ns, cells[0]
        yield line, t_ns, values
    if count == 0:
        raise LogError(f"{path}:1: no rows of data, expected columns {', '.join(('t_s', *names))}")


def bad_cell(cells: list[str], names: tuple[str, ...]) -> str:
    """Say which of these cells is not a finite number."""
    for cell, name in zip(cells, names, strict=True):
        try:
            number(cell)
        except ValueError:
            return f"{name} is {cell!r}"
    return f"{names[0]} is {cells[0]!r}"
