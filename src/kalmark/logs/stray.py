"""Tell a misspelt robot from one of its own: it is in one file of a log alone, and one of nearly its name elsewhere."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from difflib import get_close_matches
from pathlib import Path

from kalmark.logs.source import Request

Places = dict[tuple[Path, str, str], int]
"""The line where a robot's controls and fixes (sensor "") and its scans by each sensor begin in a file."""

NEAR = 0.65  # of difflib's ratio


def refuse_misspelt(places: Places, known: Collection[str], request: Request) -> set[str]:
    """Refuse the robots whose name seems misspelt, with file and line, and return them.

    Not those asked for by name, those of `known` and those whose name differs by its digits: they are numbered.
    """
    files: dict[str, dict[Path, int]] = {}
    for (path, robot, _), line in places.items():
        files.setdefault(robot, {}).setdefault(path, line)
    strays: set[str] = set()
    for robot, lines in files.items() if request.robots is None else ():
        meant = None if len(lines) > 1 or robot in known else _meant(robot, files, strays)
        if meant is not None:
            (path, line), both = next(iter(lines.items())), f"[{meant},{robot}]"
            request.refuse(
                f"{path}:{line}: robot {robot!r} is in no other file of the log, expected {meant!r}; "
                f"if both are robots, ask for them: log.robots={both}"
            )
            strays.add(robot)
    return strays


def _meant(robot: str, files: Mapping[str, Mapping[Path, int]], strays: set[str]) -> str | None:
    """Return the robot of nearly this name that is in another file, too."""
    others = [
        other
        for other, lines in files.items()
        if lines.keys() - files[robot].keys() and other not in strays and _letters(other) != _letters(robot)
    ]
    near = get_close_matches(robot, others, n=1, cutoff=NEAR)
    return near[0] if near else None


def _letters(name: str) -> str:
    return re.sub("[0-9]", "", name)
