"""Tell a misspelt robot from one of its own: it is in one file of a log alone, and another is in others."""

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


def _meant(robot: str, files: Mapping[str, Mapping[Path, int]], strays: set[str]) -> tuple[str, ...]:
    """Return the robot of nearly this name that is in another file, or else all that are, unless they are numbered."""
    there = [other for other, lines in files.items() if lines.keys() - files[robot].keys() and other not in strays]
    others = [other for other in there if _letters(other) != _letters(robot)]
    near = get_close_matches(robot, others, n=1, cutoff=NEAR)
    return tuple(near) if near or len(others) < len(there) else tuple(others)


def _letters(name: str) -> str:
    return re.sub("[0-9]", "", name)
