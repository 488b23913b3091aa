"""Scans and controls that a log has twice: recorded by two nodes, or merged from two files.

A copy has the numbers of the one before to the last bit, which noise forbids.  Where a robot stands, coarse numbers may
be the same for long; copies come in pairs.
"""

from __future__ import annotations

from itertools import compress
from typing import NamedTuple

import numpy as np

from kalmark.arrays import Array, Flags, Index
from kalmark.events import Control
from kalmark.logs.log import Log
from kalmark.results.run import Run
from kalmark.slam.held_readings import SELDOM

SHARE = 0.1  # of a stream that are copies
PAIRS = 0.9  # of the copies that stand alone: neither the one before nor the one after is a copy
LEAST = 10  # copies


class Copies(NamedTuple):
    """The copies in what a robot, or a `sensor` of it, wrote: how many of how many, and since when, s of the log.

    `sensor` is "" of its controls and its fixes.  `noticed`: the filter has left them out, as it does all of its fixes.
    """

    robot: str
    sensor: str
    number: int
    of: int
    since_s: float
    noticed: bool = False


def repeated_measurements(values: Array, first: Index) -> Flags:
    """Return which (S,) of successive measurements are copies of the one before; none, if they are few.

    `values` (K, m) are the rows of all measurements, `first` (S,) is the first row of each.
    """
    if not len(first):
        return np.zeros(0, dtype=np.bool_)
    rows, count = np.nan_to_num(values), np.diff([*first, len(values)])
    back = np.arange(len(rows)) - np.repeat(count, count)  # the row of the same place in the one before
    equal = (rows == rows[back]).all(axis=1)
    same = np.logical_and.reduceat(equal, first) & (count == np.roll(count, 1))
    same &= np.logical_or.reduceat(rows.any(axis=1), first)
    same[0] = False
    alone = same[1:-1] & ~same[:-2] & ~same[2:]
    enough = same.sum() >= max(LEAST, SHARE * len(first)) and alone.sum() >= PAIRS * same[1:-1].sum()
    return same if enough else np.zeros_like(same)


def repeated_scans(run: Run) -> Flags:
    """Return which observations (O,) of a run are in a scan that is a copy of the one before."""
    h, out = run.history, np.zeros(len(run.history.step), dtype=np.bool_)
    for key in sorted({*h.sensor_keys()}):
        rows = np.flatnonzero(h.made_by(*key))
        _, first, count = np.unique(h.step[rows], return_index=True, return_counts=True)
        out[rows] = np.repeat(repeated_measurements(h.y[rows], first), count)
    return out


def copies(run: Run, log: Log) -> list[Copies]:
    """Return the streams of a log with copies: scans of sensors, and controls."""
    h, slam = run.history, run.final_slam()
    given = {key: one for key, one in slam.state.given.items() if one.repeats >= max(LEAST, SELDOM * one.number)}
    found = [Copies(*key, one.repeats, one.number, one.since_ns * 1e-9, True) for key, one in given.items()]
    same = repeated_scans(run)
    for key in sorted({*compress(h.sensor_keys(), same)}):
        if key in given:
            continue
        mine = h.made_by(*key)
        steps = np.unique(h.step[mine & same])
        found.append(Copies(*key, len(steps), len(np.unique(h.step[mine])), h.at_s(steps[0])))
    for name in slam.robots:
        mine_ = [e for e in log.events if isinstance(e, Control) and e.robot == name and e.share == 1.0]
        twice = np.flatnonzero(repeated_measurements(np.array([e.u for e in mine_]), np.arange(len(mine_))))
        if len(twice):
            found.append(Copies(name, "", len(twice), len(mine_), mine_[twice[0]].t_s))
    return found
