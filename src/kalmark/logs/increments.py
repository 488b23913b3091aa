"""Increments of odometry cut at the scans between their ends, so that each scan finds its robot where it was.

An increment is known when it has ended, and a filter goes on as events arrive: it takes a scan within one at the place
where the last one ended.  A log that is recorded is known as a whole.  Within an increment the twist is taken to be
constant, and its error to be white, so that each part has its share of the increment's covariance.  Where its rate
lies between those of its neighbours, D / 2 or more from both, it may as well have changed by D at any time within:
`unevenness` has the variance of the parts.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import replace
from itertools import chain

import numpy as np

from kalmark.arrays import Array
from kalmark.events import Control, Event, Scan, sort_key
from kalmark.geometry.angles import V, V_inverse, wrap
from kalmark.geometry.frames3d import compose, inverse
from kalmark.geometry.rotations import left_jacobian, left_jacobian_inverse
from kalmark.geometry.rotations import log as rotation_vector
from kalmark.logs.log import Log, Names
from kalmark.logs.table_columns import INCREMENT2, INCREMENT3, WHEELS

LONG = 5  # usual intervals: a longer one may be of a gap, of which the increment is only the end
CUT = INCREMENT2, INCREMENT3, WHEELS  # columns of increments that can be cut


def cut_increments(log: Log) -> Log:
    """Return a log with its increments cut at the scans, frames and fixes between their ends.

    Those of a robot are also cut at the scans of other robots that observe it by its name.
    """
    events: list[Event] = [event for event in log.events if not isinstance(event, Control)]
    asked: dict[str, set[int]] = defaultdict(set)
    for event in events:
        seen = (*(event.ids or ()), *chain(*(event.of or ()))) if isinstance(event, Scan) else ()
        for robot in (event.robot, *seen):
            asked[str(robot)].add(event.t_ns)
    for robot in log.robots:
        controls = log.controls_of(robot)
        columns = tuple(log.control_columns.get(robot, ()))
        events += _parts(controls, columns, sorted(asked[robot])) if columns in CUT else controls
    return replace(log, events=sorted(events, key=sort_key))


def _parts(controls: list[Control], columns: Names, asked: list[int]) -> Iterator[Control]:
    """Yield the increments of a robot with these columns, those cut within which there are times (ns) asked for.

    The first began one interval, that to the second, before its end, as for `begins_at`.
    """
    if len(controls) < 2:
        yield from controls
        return
    ends, times = np.array([control.t_ns for control in controls]), np.array(asked, dtype=np.int64)
    begins = np.append(2 * ends[0] - ends[1], ends[:-1])
    longest_ns = LONG * np.median(ends - begins)
    firsts, lasts = np.searchsorted(times, begins, "right"), np.searchsorted(times, ends, "left")
    lasts_ns = ends - begins
    u = np.array([control.u for control in controls])
    rates = u / np.maximum(lasts_ns, 1)[:, None]
    steps = np.diff(rates, axis=0)
    before, after = np.vstack([steps[:1], steps]), np.vstack([steps, steps[-1:]])
    changes = 2 * np.minimum(np.abs(before), np.abs(after)) * (before * after > 0)
    for k, (whole, first, last) in enumerate(zip(controls, firsts.tolist(), lasts.tolist(), strict=True)):
        if first == last or lasts_ns[k] > longest_ns:
            yield whole
            continue
        cuts = [int(begins[k]), *asked[first:last], whole.t_ns]
        shares = (np.array(cuts) - begins[k]) / lasts_ns[k]
        for t_ns, a, b in zip(cuts[1:], shares[:-1].tolist(), shares[1:].tolist(), strict=True):
            part, more = part_of(whole.u, columns, b - a), (changes[k] * lasts_ns[k]) ** 2 * unevenness(a, b)
            yield Control(t_ns=t_ns, robot=whole.robot, u=part, cov=whole.cov, share=b - a, uneven=more)


def unevenness(a: float, b: float) -> float:
    """Return the mean square of by how much the part of a motion from a to b, shares of its time, is not b - a of it.

    The motion has a step of 1 in its rate at any time within, all equally likely.
    """
    return (b - a) ** 2 * (a**3 + (1 - b) ** 3) / (3 * (1 - (b - a)))


def increment_between(a: Array, b: Array) -> Array:
    """Return the increment, (3,) in the plane or (6,) in space, that leads from the pose a (3,) or (7,) to b."""
    if len(a) == 7:
        step = compose(inverse(a)[0], b)[0]
        return np.append(step[:3], rotation_vector(step[3:]))
    c, s = np.cos(a[2]), np.sin(a[2])
    x, y = b[:2] - a[:2]
    return np.array([c * x + s * y, c * y - s * x, wrap(b[2] - a[2])])


def part_of(u: Array, columns: Names, share: float) -> Array:
    """Return the part of an increment (k,) that a constant twist makes in a share of its time.

    A twist (v, w) moves by V(w) v and turns by w: of a share f these are V(f w) f v and f w.  [S] (57)-(60) composed.
    """
    part = share * u
    if columns == INCREMENT2:
        part[:2] = V(part[2]) @ V_inverse(u[2]) @ part[:2]
    elif columns == INCREMENT3:
        part[:3] = left_jacobian(part[3:]) @ left_jacobian_inverse(u[3:]) @ part[:3]
    return part
