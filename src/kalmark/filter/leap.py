"""When a correction is so large that what is at rest must turn with it, as in the dense filter, and not only move.

A correction d that turns the world by phi moves an active block by V(phi) d and one at rest by d alone: they part by up
to |phi| |d| / 2, where they may be known from each other to centimetres.  It happens when a loop closes late.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from kalmark.compiled import compiled
from kalmark.filter.drift import TAU
from kalmark.filter.map import P_AT, StochasticMap
from kalmark.geometry.angles import wrap
from kalmark.geometry.spaces import VECTOR, VECTOR3

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]


MOST = 20  # leaps in a phase: whatever is read at rest goes through all of them


class Points:
    """The points of an active map, which a correction may part from what is at rest."""

    def __init__(self) -> None:
        self._rows: Index | None = None  # the first one of each

    def look_again(self) -> None:
        """Take note that blocks have come or gone."""
        self._rows = None

    def parted(self, m: StochasticMap, robot: int, before: Array) -> bool:
        """Return whether the correction of the active map m that has moved a robot from `before` has done so."""
        if self._rows is None:
            slots = [slot for slot, space in enumerate(m.spaces) if space is not None and space.kinds in _POINTS]
            self._rows = m.blocks[np.array(slots, dtype=np.int64), P_AT]
        r, x = int(m.blocks[robot, P_AT]), m.x[m.numbers(robot)]
        return bool(_parts(m.P, r, self._rows, before, x, 2 if m.axes == 1 else 3))


_POINTS = ((VECTOR,), (VECTOR3,))


@compiled
def _parts(P: Array, r: int, points: Index, before: Array, now: Array, d: int) -> bool:
    """Return whether a turn and a move part points by more than TAU sigmas as seen from the robot, whose row is r."""
    moved = 0.0
    for i in range(d):
        moved += (now[i] - before[i]) ** 2
    flat = d == 2
    turn = abs(wrap(now[2] - before[2])) if flat else 2.0 * math.acos(min(1.0, abs((now[3:7] * before[3:7]).sum())))
    apart = 0.5 * turn * math.sqrt(moved) / TAU
    for l in points:
        variance = 0.0
        for i in range(d):
            variance += P[l + i, l + i] + P[r + i, r + i] - 2.0 * P[max(l, r) + i, min(l, r) + i]
        if variance < apart * apart:
            return True
    return False
