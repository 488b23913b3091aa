"""Jumps of a robot against its controls: those of one robot are one cause, and controls that jump themselves are named.

A robot that is bumped, whose wheels slip or that is carried moves without its controls.  A control that is far larger
than all others, at the time of a jump, is the opposite: the odometry jumps, and the robot does not.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from kalmark.arrays import Array
from kalmark.diagnosis.causes import JUMPS, Finding
from kalmark.events import Control
from kalmark.logs.log import Log

USUAL, TIMES = 0.99, 2.0  # share of the controls that are usual, and how many times as large is one that jumps
NEAR_S = 0.5  # before and after a jump, within which a control may be the reason
LISTED = 5  # times of further jumps


class OddControl(NamedTuple):
    """A control far larger than all others: its time, its column and value, and how many times the usual it is.

    `usual` is that of a second.
    """

    t_s: float
    column: str
    value: float
    times: float
    usual: float


class Controls:
    """All controls of a robot, to find those among them that are far larger than the others."""

    def __init__(self, log: Log, columns: Sequence[str], robot: str) -> None:
        mine = [e for e in log.events if isinstance(e, Control) and e.robot == robot]
        self.columns, self.t_s, share = columns, np.array([e.t_s for e in mine]), np.array([e.share for e in mine])
        self.u = np.array([e.u for e in mine]).reshape(len(mine), len(columns)) / share[:, None]
        self.interval_s = float(np.median(np.diff(self.t_s) / share[1:])) if len(mine) > 1 else 0.0
        self.usual = np.quantile(np.abs(self.u), USUAL, axis=0) if mine else np.zeros(0)

    def odd(self, t_s: float, lasts_s: float = 0.0) -> OddControl | None:
        """Return the control near a time of the log, or in so long, that is far larger than the others, if one is."""
        near = np.flatnonzero((self.t_s >= t_s - NEAR_S) & (self.t_s <= t_s + lasts_s + NEAR_S))
        if not len(near):
            return None
        times = np.abs(self.u[near]) / np.maximum(self.usual, 1e-300) * (self.usual > 0)
        row, column = divmod(int(np.argmax(times)), times.shape[1])
        if times[row, column] < TIMES:
            return None
        k = int(near[row])
        per_s = 1.0 if self.columns[column].endswith("ps") else self.interval_s
        value, most = float(self.u[k, column]), float(self.usual[column]) / max(per_s, 1e-9)
        return OddControl(float(self.t_s[k]), self.columns[column], value, float(times[row, column]), most)


def merge_jumps(found: Sequence[Finding], begin_s: float) -> list[Finding]:
    """Return findings with the jumps of each robot as one: the largest, and the times of all in s of the log.

    The first scan is at `begin_s`.
    """
    rest = [f for f in found if f.name not in JUMPS]
    jumps = sorted((f for f in found if f.name in JUMPS), key=lambda f: -f.gain)
    for robot in dict.fromkeys(f.of[0] for f in jumps):
        first, *more = [f for f in jumps if f.of[0] == robot]
        times = [first.since_s or 0.0, *sorted(f.since_s or 0.0 for f in more)]
        of = (robot, *(f"{begin_s + t:.1f}" for t in times))
        rest.append(replace(first, of=of, gain=sum(f.gain for f in (first, *more))))
    return rest


def step_size(step: Array) -> tuple[float, float]:
    """Return the length, m, and the turn, deg, of a step (3,) or (6,)."""
    d = 2 if len(step) == 3 else 3
    return float(np.linalg.norm(step[:d])), math.degrees(float(np.linalg.norm(step[d:])))
