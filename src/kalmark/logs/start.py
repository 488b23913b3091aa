"""Where a robot truly is when its log begins: before its first motion, not after it."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from kalmark.events import Control, Event
from kalmark.geometry.angles import wrap
from kalmark.logs.log import Array, Log, Trajectory


def begins_at(events: Iterable[Event], robot: str, held: bool) -> int | None:
    """Return the time (ns) at which a robot's first event begins, None if it has none.

    An increment is the motion that ended at its time, and began one interval (that to the next) before it.
    """
    mine = (event for event in events if event.robot == robot)
    first = next(mine, None)
    if first is None or held or not isinstance(first, Control):
        return None if first is None else first.t_ns
    second = next((event.t_ns for event in mine if isinstance(event, Control)), first.t_ns)
    return 2 * first.t_ns - second


def true_start(log: Log, robot: str, held: bool) -> Array | None:
    """Return the true pose (3,) or (7,) of a robot when its first event begins, None if the log does not have it.

    Where the truth begins only after a first increment, it is taken back by that increment.
    """
    truth, begin = log.truth.get(robot), begins_at(log.events, robot, held)
    if truth is None or begin is None:
        return None
    pose: Array = truth.at(begin)
    if np.isfinite(pose).all():
        return pose
    return None if held else _before(truth, next(event for event in log.events if event.robot == robot))


def _before(truth: Trajectory, event: Event) -> Array | None:
    """Return the true pose (3,) before an increment u that ended at a known one: r = r2 - R(r) u."""
    after: Array = truth.at(event.t_ns)
    if not isinstance(event, Control) or after.shape != (3,) or event.u.shape != (3,) or np.isnan(after).any():
        return None
    theta = wrap(after[2] - event.u[2])
    c, s = np.cos(theta), np.sin(theta)
    return np.append(after[:2] - np.array([[c, -s], [s, c]]) @ event.u[:2], theta)
