"""Figures and counts as people write them, and the words for the figures of a run, one source for all who show them.

The words are in ``figures.csv``: the part of the summary that a figure is of (`more`: only on the page), its key in
``summary.json``, its label and unit; a label that begins with two blanks is a part of the one above it.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator, Mapping
from importlib import resources
from typing import Any

Figures = dict[str, Any]  # by their keys in ``summary.json``
Summary = Mapping[str, Any]  # figures that are read
Words = tuple[tuple[str, str, str], ...]
TextRow = tuple[str, ...]  # of a table


_ROWS = [*csv.DictReader((resources.files("kalmark.results") / "figures.csv").read_text("utf-8").splitlines())]
TOTALS, MORE, ROBOT, BATCH = (
    tuple((row["key"], row["label"], row["unit"]) for row in _ROWS if row["part"] == part)
    for part in ("totals", "more", "robot", "batch")
)


def flatten(section: Any, where: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the values of nested mappings by their paths."""
    if isinstance(section, Mapping) and (section or not where):
        for key, value in section.items():
            yield from flatten(value, f"{where}.{key}" if where else str(key))
    else:
        yield where, section


def rows_with_labels(figures: Summary, words: Words) -> Iterator[tuple[str, str, Any, str]]:
    """Yield key, label, value and unit of each figure in the order of the words; last, by its key, what has none."""
    known = {key: (label, unit) for key, label, unit in words}
    for key in [*(key for key in known if key in figures), *(key for key in figures if key not in known)]:
        label, unit = known.get(key, (key, ""))
        yield key, label, figures[key], unit


DIFFERENCE_TITLE = "Difference of the poses from the batch solution"
DIFFERENCE_COLUMNS = ("robot", "from s", "to s", "sigmas of the filter")


def difference_rows(summary: Summary) -> list[TextRow]:
    """Return the differences of the poses over time that a comparison with the batch solution has, as a table."""
    rows = summary.get("batch", {}).get("pose_differences", ())
    return [(r["robot"], *(f"{r[key]:.1f}" for key in ("start_s", "end_s")), figure(r["sigmas"])) for r in rows]


def column_header(label: str, unit: str) -> str:
    """Return the words at the top of a column of figures: position RMSE (m)."""
    return f"{label.strip()} ({unit})" if unit else label.strip()


def figure(value: float, digits: int = 3) -> str:
    """Return a value to so many significant digits, without a power of ten where it is large: 110, not 1.1e+02."""
    text = f"{value:.{digits}g}"
    return f"{float(text):.0f}" if math.isfinite(value) and 10**digits <= abs(value) < 1e9 else text


def count(number: int, one: str, many: str = "") -> str:
    """Return a number with its noun: 1 scan, 2 scans."""
    return f"{number} {one if number == 1 else many or one + 's'}"
