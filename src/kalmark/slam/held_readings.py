"""Repeated measurements, as of a receiver that repeats its last one until it has a new one.

A measurement that has the numbers of the one before to the last bit, though its robot has moved by its controls since,
is that one: noise forbids it, unless the numbers are so coarse that they repeat by chance.  Its probability is
estimated from the sensor's own measurements: the least difference q of successive ones is a step of their numbers, and
noise of which differences have the geometric mean g repeats a number with the probability CHANCE q / g.  Numbers that
repeat alone, while others of the same measurement change, do so by chance as often as they did.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from kalmark.arrays import Array
from kalmark.events import Id
from kalmark.geometry.gaussian import gate
from kalmark.report import Observation, Report
from kalmark.slam.held_control import MotionPart

AGAIN = "it repeats the one before to the last bit, though the robot has moved: it is no new measurement"
SELDOM = 0.01  # of new measurements may be taken for old ones
MOVED = 0.99  # probability at which a robot has moved
CHANCE = math.exp(-0.5 * (np.euler_gamma + math.log(2.0))) / math.sqrt(2.0 * math.pi)  # of Gaussian noise: g is known
TOGETHER = 128  # measurements of the same ids whose differences are counted at once
NOTHING = np.zeros(0)
SAME = 1e-9  # differences are rounding below it, as a share of a number


def record_repeated_reading(report: Report, ids: Sequence[Id | None], p: int, of: Id | None = None) -> Report:
    """Enter into a report that all of a measurement, with innovations of p numbers, was given before."""
    report.blank(p)
    report.observations = [Observation(k, id_, "ignored", of, None, AGAIN) for k, id_ in enumerate(ids)]
    return report


@dataclass
class LastMeasurement:
    """The last measurement of a sensor, y (K, m) with its ids, and statistics of its numbers.

    `recent` are the last ones of the same ids, y the last of them; differences between them are counted many at a time.
    Of two with other ids those of the ids in both are, until enough are known.
    Of each column: the `least` difference of successive measurements (0 of none), the sum of the logarithms of
    differences, and how many `differ` and are `equal`.  `went` and `doubt` (c,) are the controls since it was given and
    their variances.  `repeats` of `number` measurements were left out, since `since_ns`.
    """

    recent: list[Array]
    ids: tuple[Id | None, ...] | None
    least: Array
    logs: Array
    differ: Array
    equal: Array
    went: Array = field(default_factory=lambda: NOTHING)
    doubt: Array = field(default_factory=lambda: NOTHING)
    repeats: int = 0
    number: int = 1
    since_ns: int = 0

    def __post_init__(self) -> None:
        self._motions: list[MotionPart] = []  # which `went` and `doubt` do not have yet

    @classmethod
    def of(cls, y: Array, ids: tuple[Id | None, ...] | None) -> LastMeasurement:
        """Return the record of a first measurement."""
        return cls([y], ids, *np.zeros((4, y.shape[1])))

    @property
    def y(self) -> Array:
        """The last measurement (K, m)."""
        return self.recent[-1]

    def add_motion(self, part: MotionPart) -> None:
        """Add the motion of a part of a control, with its variances."""
        self._motions.append(part)
        if len(self._motions) == TOGETHER:
            self.sum_motions()

    def sum_motions(self) -> None:
        """Bring `went` and `doubt` up to date."""
        for part in self._motions:
            u, variances = part.u, part.N.diagonal()
            if part.dt_s > 0.0:
                u, variances = u * part.dt_s, variances * part.dt_s**2
            first = len(self.went) != len(u)
            self.went, self.doubt = (u, variances) if first else (self.went + u, self.doubt + variances)
        self._motions.clear()

    def chance(self) -> float:
        """Return the probability that a new measurement has the same numbers, 1 if unknown; columns are independent."""
        self._count()
        if not self.differ.any():
            return 1.0
        some = self.differ > 0
        g = np.exp(self.logs[some] / self.differ[some])
        by_noise, alone = np.ones(len(some)), self.equal / np.maximum(self.equal + self.differ, 1.0)
        by_noise[some] = np.minimum(CHANCE * self.least[some] / g, 1.0)
        return float(np.prod(np.maximum(by_noise, alone)))

    def has_moved(self, velocity: Array, P: Array) -> bool:
        """Return whether the robot has moved since: by its controls or, if it has one, its velocity (v,), P (v, v)."""
        self.sum_motions()
        x, variances = (velocity, np.diagonal(P)) if len(velocity) else (self.went, self.doubt)
        return bool(np.sum(x**2 / np.maximum(variances, 1e-30)) > gate(MOVED, max(len(x), 1)))

    def take(self, y: Array, ids: tuple[Id | None, ...] | None) -> bool:
        """Take a measurement; return whether it has the numbers of the one before."""
        self.number += 1
        last = self.recent[-1]
        if ids == self.ids and y.shape == last.shape:
            if y.item(0) == last.item(0) and (y == last).all():  # most differ in the first number
                return True
            self.recent.append(y)
            if len(self.recent) > TOGETHER:
                self._count()
        else:
            self._count()
            if ids and self.ids and self.differ.max() < TOGETHER:
                at = dict(zip(self.ids, range(len(last)), strict=True))
                both = [(at[name], k) for k, name in enumerate(ids) if name is not None and name in at]
                before, now = np.array(both, dtype=np.int64).reshape(-1, 2).T
                self.recent = [last[before], y[now]]
                self._count()
            self.recent = [y]
        self.ids, self.went, self.doubt = ids, NOTHING, NOTHING
        self._motions.clear()
        return False

    def _count(self) -> None:
        """Count the differences between the recent measurements."""
        if len(self.recent) == 1 or not self.recent[0].size:
            return
        y = np.array(self.recent)
        d = np.abs(np.diff(y, axis=0)).reshape(-1, y.shape[2])
        new = d > SAME * np.abs(y[1:]).reshape(d.shape)
        least = np.where(new, d, np.inf).min(axis=0)
        least = np.where(self.differ > 0, np.minimum(self.least, least), least)
        self.least = np.where(new.any(axis=0), least, self.least)
        self.logs = self.logs + np.where(new, np.log(np.where(new, d, 1.0)), 0.0).sum(axis=0)
        self.differ, self.equal = self.differ + new.sum(axis=0), self.equal + (~new).sum(axis=0)
        self.recent = self.recent[-1:]
