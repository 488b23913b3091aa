"""Robots alone in a map whose start was wrong: their first fixes did not fit, until the map was moved onto them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from kalmark.arrays import Array
from kalmark.results.history import History
from kalmark.results.measures import Rigid, level
from kalmark.slam.relocation_by_fixes import NEEDED


class Restart(NamedTuple):
    """Move of the map onto the first fixes: time, way (`onto`), distance, m, and number of fixes.

    `agreed` (N, d) are the fixes that it was moved onto, of the `variance`, m^2.
    """

    t_ns: int
    onto: Rigid
    moved_m: float
    fixes: int
    agreed: Array
    variance: float


def restarts(history: History) -> dict[str, Restart]:
    """Return robots whose map too few fixes fitted before it was moved onto others (`slam/relocation_by_fixes.py`)."""
    found: dict[str, Restart] = {}
    for robot in () if len(history.robots) > 1 else history.robots:
        mine = [fix for fix in history.fixes if fix.robot == robot]
        first = next((k for k, fix in enumerate(mine) if fix.moved_m > 0), None)
        if first is None or history.priors or sum(fix.used for fix in mine[:first]) >= NEEDED:
            continue
        begin = max((k + 1 for k in range(first) if mine[k].used), default=0)
        agreed = mine[begin : first + 1]
        there = np.array([fix.y for fix in agreed])
        variance = float(np.mean([np.diag(fix.Z) for fix in agreed]))
        onto = level(there - [fix.z for fix in agreed], there)
        found[robot] = Restart(mine[first].t_ns, onto, mine[first].moved_m, first + 1, there, variance)
    return found
