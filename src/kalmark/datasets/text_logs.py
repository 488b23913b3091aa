"""Text files of published logs: recognised by the lines that they begin with, points in rows, steps without a time."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np

from kalmark.events import Id, short_text
from kalmark.logs.log import LandmarkPlaces
from kalmark.logs.source import Refuse, number_of_text, text_rows

STEP_NS = 1_000_000_000
"""Formats whose steps carry no time get one second a step."""


def file_in(path: Path, name: str) -> Path:
    """Return the file of this name in a folder, or the path itself if it is not a folder."""
    return path / name if path.is_dir() else path


def begins_with(file: Path, starts: Iterable[bytes], size: int = 65536) -> bool:
    """Return whether a line among the first bytes of a file has one of these starts."""
    with file.open("rb") as stream:
        begin = b"\n" + stream.read(size)
    return any(b"\n" + start in begin for start in starts)


def read_points(
    path: Path, refuse: Refuse, id_of: Callable[[str], Id], sizes: tuple[int, ...], expected: str
) -> LandmarkPlaces:
    """Return the positions by id in rows `id x y` of so many cells, or {} without the file."""
    points = {}
    for line, cells in text_rows(path) if path.is_file() else ():
        try:
            if len(cells) not in sizes:
                raise ValueError
            points[id_of(cells[0])] = np.array([number_of_text(cell) for cell in cells[1:3]])
        except ValueError:
            refuse(f"{path}:{line}: {short_text(' '.join(cells))}, expected {expected}")
    return points
