"""When a correction is so large that what is at rest must turn with it, as in the dense filter, and not only move.

A correction d that turns the world by phi moves an active block by V(phi) d and one at rest by d alone: they part by up
to |phi| |d| / 2, where they may be known from each other to centimetres.  It happens when a loop closes late.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np
import numpy.typing as npt

from kalmark.filter.drift import TAU
from kalmark.filter.flush import turn_of
from kalmark.filter.map import StochasticMap
from kalmark.geometry.spaces import VECTOR, VECTOR3

Array = npt.NDArray[np.float64]

EXACT_M = 1e-4  # nothing is known better than that


def leapt(active: StochasticMap, robot: int, before: Array, others: Iterable[int]) -> bool:
    """Return whether the correction that has moved a robot from `before` parts active blocks from those at rest.

    By more than TAU of the least sigma of a point among the `others` (slots), as seen from the robot.
    """
    after, d = active.mean(robot), 2 if active.axes == 1 else 3
    turn = turn_of(before, after, active.axes)[-3:].tolist()
    apart = 0.5 * math.hypot(*turn) * math.dist(after[:d].tolist(), before[:d].tolist())
    if apart <= TAU * EXACT_M:
        return False
    points = [active.rows(slot)[:d] for slot in others if _is_point(active, slot)]
    if not points:
        return False
    l, r = np.array(points), active.rows(robot)[:d]
    P = active.P
    variances = P[l, l] + P[r, r] - 2.0 * P[np.maximum(l, r), np.minimum(l, r)]
    return apart > TAU * max(EXACT_M, float(np.sqrt(np.maximum(variances.sum(axis=1), 0.0)).min()))


def _is_point(active: StochasticMap, slot: int) -> bool:
    space = active.spaces[slot]
    return space is not None and space.kinds in ((VECTOR,), (VECTOR3,))
