"""What every importer shares: the door it is called through, and the log it gives back."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from kalmark.errors import LogError
from kalmark.logs.log import Log
from kalmark.logs.text import Refuse

STEP_NS = 1_000_000_000
"""Formats whose steps carry no time get one second a step."""


class LeftOut(str):
    """A line that tells of several `records` left out of a log; a plain text tells of one."""

    records: int

    def __new__(cls, text: str, records: int) -> LeftOut:
        """Return the line."""
        line = super().__new__(cls, text)
        line.records = records
        return line


def records_of(line: str) -> int:
    """Return how many records a line tells of that were left out."""
    return line.records if isinstance(line, LeftOut) else 1


@dataclass(frozen=True)
class Request:
    """Hold what the caller of `open_log` asked for: the robots (None: all) and what to do with a bad row.

    `refuse` takes a bad row; `skipped` collects what is left out, and is the log's list of that name.
    """

    robots: tuple[str, ...] | None
    refuse: Refuse
    skipped: list[str]

    def leave_out(self, records: int, line: str) -> None:
        """List that so many records were left out."""
        self.skipped.append(LeftOut(line, records))

    def wants(self, robot: str) -> bool:
        """Return whether this robot was asked for."""
        return self.robots is None or robot in self.robots


@dataclass(frozen=True)
class Format:
    """Describe one log format: how to tell it (`find` gives the path to read, or None) and how to read it."""

    name: str
    what: str
    find: Callable[[Path], Path | None]
    read: Callable[..., Log]
    options: tuple[str, ...] = ()
    robot_prefix: str = ""


def folder_of(path: Path, names: Iterable[str]) -> Path | None:
    """Return the folder that `path` is, or is in as one of these files, if it holds at least one of them."""
    folder = path if path.is_dir() else path.parent
    if path.is_file() and path.name not in names:
        return None
    return folder if any((folder / name).is_file() for name in names) else None


def nearest(word: str, words: Iterable[str]) -> str:
    """Return a hint at the word that was probably meant, or nothing."""
    close = get_close_matches(word, list(words), n=1)
    return f"; did you mean {close[0]!r}?" if close else ""


def choice(value: Any, name: str, allowed: tuple[str, ...]) -> str:
    """Return an option's value if it is one of those allowed.  Raises LogError."""
    if value not in allowed:
        hint = nearest(str(value), allowed)
        raise LogError(f"log option {name} is {value!r}, expected one of {', '.join(allowed)}{hint}")
    return str(value)


def quantity(value: Any, name: str, low: float = float("-inf")) -> float:
    """Return an option's value as a finite number of at least `low`.  Raises LogError."""
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = float("nan")
    if isinstance(value, bool) or not low <= number < float("inf"):
        wanted = "a finite number" if low == float("-inf") else f"a finite number of at least {low:g}"
        raise LogError(f"log option {name} is {value!r}, expected {wanted}")
    return number
