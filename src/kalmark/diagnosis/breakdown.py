"""The innovations of a run by sensor, landmark, range, bearing, time and speed; the NEES by its parts.

Bar-Shalom, Li, Kirubarajan 2001, section 5.4: the time-average NIS, and the mean of the innovations, each against what
it varies by from scan to scan, at a level divided by the number of tests (Bonferroni).
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.special import ndtr

from kalmark.arrays import Array
from kalmark.geometry.gaussian import quantile
from kalmark.results.figure_texts import figure
from kalmark.results.history import History, Ints
from kalmark.results.measures import nees, nis
from kalmark.results.run import Run

BINS = 4
LEVEL = 0.01  # of false alarms in a whole table
LEAST = 20  # observations in a group
WORST = 3  # landmarks that are shown
BAND = 0.997
SPEED = "speed"
WINDOW = 50  # scans, over which a NEES is averaged


class Group(NamedTuple):
    """The innovations of a group: how many, NIS per degree of freedom, the largest mean in sigmas, an alarm or not."""

    of: str
    which: str
    number: int
    nis: float
    mean: float
    alarm: bool

    def cells(self) -> tuple[str, ...]:
        """Return the row of a table."""
        told = "not as stated" if self.alarm else ""
        return self.of, self.which, str(self.number), figure(self.nis), figure(self.mean, 2), told


def breakdown(run: Run) -> list[Group]:
    """Return the groups of a run's innovations, with the alarm of those that contradict the noise stated."""
    history = run.history
    rows = np.flatnonzero((history.outcome == "associated") & np.isfinite(history.z).any(axis=1))
    if len(rows) < LEAST:
        return []
    groups = [(of, which, mine) for of, which, mine in _groups(run, rows) if len(mine) >= LEAST]
    level = LEVEL / max(3 * len(groups), 1)
    found = [_judged(history, *group, level) for group in groups]
    landmarks = sorted((g for g in found if g.of == "landmark"), key=lambda g: -abs(np.log(max(g.nis, 1e-12))))
    return [g for g in found if g.of != "landmark"] + landmarks[:WORST]


def _judged(history: History, of: str, which: str, rows: Ints, level: float) -> Group:
    """Return a group.  The innovations of a scan share the error of the pose, so that scans are what is independent."""
    value, dof = nis(history.z[rows], history.Z[rows])
    sigma = np.sqrt(np.diagonal(history.Z[rows], axis1=1, axis2=2))
    some = np.isfinite(history.z[rows]) & (sigma > 0)
    white = np.where(some, history.z[rows] / np.where(some, sigma, 1.0), 0.0)
    _, scan = np.unique(history.step[rows], return_inverse=True)
    sums = [np.bincount(scan, column) for column in (np.nan_to_num(value) - dof, *white.T)]
    excess, *means = (float(s.sum() / max(np.sqrt(s @ s), 1e-300)) for s in sums)
    mean = max(means, key=abs) if of != SPEED else 0.0  # a speed has the errors in it that innovations have
    alarm = 2.0 * float(ndtr(-max(abs(excess), abs(mean)))) < level
    return Group(of, which, len(rows), float(np.nansum(value)) / max(int(dof.sum()), 1), mean, alarm)


def _groups(run: Run, rows: Ints) -> Iterator[tuple[str, str, Ints]]:
    history = run.history
    keys = history.sensor_keys()
    for key in sorted({keys[k] for k in rows.tolist()}):
        mine = rows[history.made_by(*key)[rows]]
        yield "sensor", ".".join(key), mine
        kind = str(run.section(*key).get("type", ""))
        columns = [name for name in ("range", "bearing") if name in kind]
        for k, name in enumerate(columns):
            yield from _bins(name, "m" if name == "range" else "rad", history.y[mine, k], mine)
    t = history.t_s[history.step[rows]]
    yield from _bins("time", "s", t, rows)
    yield from _bins(SPEED, "m/s", _speeds(history)[history.step[rows]], rows)
    for name in dict.fromkeys(history.landmark[rows].tolist()):
        yield "landmark", name, rows[history.landmark[rows] == name]


def _bins(of: str, unit: str, values: Array, rows: Ints) -> Iterator[tuple[str, str, Ints]]:
    """Yield groups of as many rows each, by their values."""
    edges = np.unique(np.nanquantile(values, np.linspace(0, 1, BINS + 1))) if len(values) else np.zeros(0)
    for low, high in pairwise(edges):
        mine = (values >= low) & ((values < high) | (high == edges[-1]))
        yield of, f"{figure(low, 2)} to {figure(high, 2)} {unit}", rows[mine]


def _speeds(history: History) -> Array:
    """Return the speed of each robot at its scans (S,), m/s."""
    out = np.zeros(len(history.t_ns))
    for name in history.robots:
        mine = np.flatnonzero(history.robot == name)
        if len(mine) > 1:
            way = np.linalg.norm(np.diff(history.poses[mine][:, : history.d], axis=0), axis=1)
            out[mine[1:]] = way / np.maximum(np.diff(history.t_s[mine]), 1e-3)
    return out


def nees_parts(run: Run) -> Iterator[tuple[str, str, str, str]]:
    """Yield the NEES per degree of freedom of position and heading of each robot and of the map, if there is truth.

    And the time from which its mean over `WINDOW` scans is above what a consistent filter has.
    """
    history, truth = run.history, run.truth.poses_in_map()
    d = history.d
    for name in history.robots:
        mine = np.flatnonzero((history.robot == name) & np.isfinite(truth).all(axis=1))
        if len(mine) < WINDOW or history.in_space:
            continue
        errors = history.poses[mine] - truth[mine]
        errors[:, d] = np.angle(np.exp(1j * errors[:, d]))
        P = history.covariance[mine]
        for part, at in (("position", slice(0, d)), ("heading", slice(d, d + 1)), ("pose", slice(0, d + 1))):
            value, dof = nees(errors[:, at], P[:, at, at]), at.stop - at.start
            yield name, part, figure(float(np.nanmean(value)) / dof), _since(history.t_s[mine], value, dof)


def _since(t_s: Array, value: Array, dof: int) -> str:
    """Return when the mean of a window leaves the band that the NEES of one step has, for good "" if it never does."""
    bound = float(quantile(BAND, dof))
    means = np.convolve(np.nan_to_num(value), np.full(WINDOW, 1.0 / WINDOW), mode="valid")
    above = np.flatnonzero(means > bound)
    return f"{t_s[above[0]]:.1f}" if len(above) else ""
