"""Systematic errors in a part of a run: a sensor that is turned, wheels that slip for a while, a bias that jumps.

The times are those of the largest score (Basseville, Nikiforov 1993, section 2.4), looked for among stretches of the
run, then near the best of them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from kalmark.arrays import Array, Index
from kalmark.diagnosis.causes import LEAST_GAIN, LEAST_INFORMATION, SEEN, Finding, systematic
from kalmark.diagnosis.error_columns import ALL, DRIFT, LATE, TURNED, Column
from kalmark.diagnosis.linear import Linear
from kalmark.events import Control, Event, Scan, sort_key
from kalmark.logs.log import Log
from kalmark.results.run import Run

STRETCHES, ROUNDS = 20, 4  # in which the time is looked for, and how often within the best of them
TRIED = 3  # errors whose time is looked for
ALONE = 0.9  # of what an error of its own in each stretch explains, the share that one in a part of the run has to


def find_onsets(linear: Linear, columns: list[Column], t_s: Array) -> list[Finding]:
    """Return the systematic errors that explain most in a part of the run, and clearly more than all the time.

    `t_s` (n,) are the times of the poses.  Where other stretches have as much to explain the error did not begin: a
    calibration drifts.  `p` counts that the times were looked for.
    """
    row_s, step_s = _times(linear, t_s)
    turned = {column.of[:2] for column in columns if column.name == TURNED}
    columns = [_as_turn(c) for c in columns if c.name == TURNED or c.unit != "rad" or c.of[:2] not in turned]
    likely, found = list[tuple[float, Column]](), list[Finding]()
    edges = np.quantile(t_s, np.linspace(0.0, 1.0, STRETCHES, endpoint=False))
    for column in columns:
        gains = _gains(linear, column, row_s, step_s, edges)
        if gains.max() > gains[0, -1] + LEAST_GAIN:
            likely.append((float(gains.max()), column))
    for _, column in sorted(likely, key=lambda one: -one[0])[:TRIED]:
        found += _passing(linear, column, t_s)
    return found


def _as_turn(column: Column) -> Column:
    """Return an offset of bearings as the turn of its mount that it is, in the plane, and other errors as they are."""
    if column.name != "bearing_offset" or column.of[1] == ALL:
        return column
    return column._replace(name=TURNED, Z=-column.Z, most=math.pi / 2)


def _times(linear: Linear, t_s: Array) -> tuple[Array, Array]:
    """Return the times of each residual (N,) and of each error of the motion (q n,)."""
    n = len(linear.problem.robots)
    return t_s[linear.rows.node], np.repeat(t_s, len(linear.at.w) // max(n, 1))


def _passing(linear: Linear, column: Column, t_s: Array) -> Iterator[Finding]:
    """Yield an error in the best part of a run, if that explains clearly more than all of it, and little is left."""
    row_s, step_s = _times(linear, t_s)
    times = np.sort(np.concatenate([row_s[column.Z != 0.0], step_s[column.W != 0.0]]))[SEEN:-SEEN]
    if len(times) < STRETCHES:
        return
    gain, begin_s, end_s = _best_part(linear, column, row_s, step_s, np.unique(times))
    steady = max((one.gain for one in systematic(linear, [column])), default=0.0)
    if gain <= LEAST_GAIN + steady or gain < ALONE * _piecewise_gain(linear, column, row_s, step_s, times):
        return
    Z, W = (
        np.where((begin_s <= of_s) & (of_s < end_s), part, 0.0)
        for of_s, part in ((row_s, column.Z), (step_s, column.W))
    )
    part = column._replace(Z=Z, W=W, most=math.inf if W.any() else column.most)  # wheels may spin
    for one in systematic(linear, [part]):
        p = min(1.0, one.p * len(times) * (1 if end_s == math.inf else len(times)))
        if W.any():  # an error of a step begins and ends at the pose before, in the same segment of the run
            usual_s = float(np.median(np.diff(np.unique(t_s))))
            begin_s = max(float(t_s[t_s < begin_s].max(initial=0.0)), begin_s - usual_s)
            end_s = float(t_s[t_s < end_s].max()) if end_s < math.inf else end_s
        yield replace(one, p=p, since_s=begin_s, until_s=end_s)


def _best_part(
    linear: Linear, column: Column, row_s: Array, step_s: Array, times: Array
) -> tuple[float, float, float]:  # fmt: skip
    """Return the gain of an error in the best part of a run, and when that begins and ends, among `times` (T,).

    It ends only if that explains clearly more.
    """
    best, some = (0.0, 0.0, math.inf), _evenly(times, STRETCHES)
    for _ in range(ROUNDS):
        edges = times[some]
        gains = _gains(linear, column, row_s, step_s, edges)
        first, last = divmod(int(np.argmax(gains)), len(edges))
        if gains[:, -1].max() > gains[first, last] - LEAST_GAIN:
            first, last = int(np.argmax(gains[:, -1])), len(edges) - 1
        ends = last < len(edges) - 1
        best = float(gains[first, last]), float(edges[first]), float(edges[last + 1]) if ends else math.inf
        closer = np.unique(np.concatenate([_near(times, some, k) for k in ((first, last + 1) if ends else (first,))]))
        if np.array_equal(closer, some):
            break
        some = closer
    return best


def _near(times: Array, some: Index, k: int) -> Index:
    """Return the numbers of times from the one of `some` before the k-th to the one after it."""
    a, b = int(some[max(k - 1, 0)]), int(some[min(k + 1, len(some) - 1)])
    return a + _evenly(times[a : b + 1], STRETCHES // 2)


def _evenly(times: Array, number: int) -> Index:
    """Return the numbers of so many of the times, or all."""
    return np.unique(np.linspace(0, len(times) - 1, number).astype(np.int64))


def _gains(linear: Linear, column: Column, row_s: Array, step_s: Array, edges: Array) -> Array:
    """Return the gains (S, S) of an error from the begin of one stretch to the end of another, 0 of no information.

    The stretches begin at `edges` (S,).
    """
    g, I = _scores(linear, column, row_s, step_s, edges)
    g = np.append(0.0, np.cumsum(g))
    I = np.pad(np.cumsum(np.cumsum(I, axis=0), axis=1), ((1, 0), (1, 0)))
    most = I.diagonal()
    g, I = g[1:] - g[:-1, None], most[1:] + most[:-1, None] - I[:-1, 1:] - I[1:, :-1].T
    enough = np.triu(LEAST_INFORMATION * most.max(initial=0.0) < I)
    return np.asarray(np.where(enough, 0.5 * g * g / np.where(enough, I, 1.0), 0.0))


def _scores(linear: Linear, column: Column, row_s: Array, step_s: Array, edges: Array) -> tuple[Array, Array]:
    """Return the scores g (S,) of an error in each stretch, and their information I (S, S)."""
    Z, W = (
        np.where((np.searchsorted(edges, of_s, side="right") - 1)[:, None] == np.arange(len(edges)), of[:, None], 0.0)
        for of_s, of in ((row_s, column.Z), (step_s, column.W))
    )
    return linear.scores_of(Z, W)[:2]


def _piecewise_gain(linear: Linear, column: Column, row_s: Array, step_s: Array, times: Array) -> float:
    """Return the gain of an error that has another value in each stretch."""
    g, I = _scores(linear, column, row_s, step_s, times[_evenly(times, STRETCHES)])
    return float(0.5 * g @ np.linalg.pinv(0.5 * (I + I.T), LEAST_INFORMATION, hermitian=True) @ g)


# ------------------------------------------------------------------ the log without it
def without_onset(run: Run, log: Log, finding: Finding) -> Log | None:
    """Return a log without an error in a part of it, of a sensor's time or column, or of the controls; None of others.

    Those of a mount are a turn in the plane.  A clock drifts from the first scan on.
    """
    robot, second, *rest = finding.of
    of, s, first_s = run.final_slam().robots[robot], finding.value, run.history.at_s(0)
    begin_s, end_s = (first_s + (t or 0.0) for t in (finding.since_s, finding.until_s))
    is_control = rest[-1:] in (["scale"], ["offset"])
    names = of.motion.columns if is_control else of.sensors[second].sensor.columns if second in of.sensors else ()
    k = [names.index(name) for name in ([second] if is_control else rest) if name in names]
    if not (k or finding.name == LATE) or finding.name == "mount_position":
        return None
    each_s = np.diff([e.t_s for e in log.events if isinstance(e, Control) and e.robot == robot])

    def changed(a: Array) -> Array:
        a = a.copy()
        if finding.name == "range_scale" or rest[-1:] == ["scale"]:
            a[..., k] /= 1.0 - s if is_control else 1.0 + s  # s is a share of the control as it was estimated
        elif is_control:
            a[..., k] += s * (1.0 if of.motion.held else float(np.median(each_s)))
        else:
            a[..., k] += s if finding.name == TURNED else -s
        return a

    def replaced(e: Event) -> Event:
        if e.robot != robot:
            return e
        within = begin_s <= e.t_s < end_s
        if is_control and isinstance(e, Control) and (within if of.motion.held else begin_s < e.t_s <= end_s):
            return replace(e, u=changed(e.u))
        if not within or not isinstance(e, Scan) or second not in (ALL, e.sensor):
            return e
        if finding.name == LATE:
            return replace(e, t_ns=e.t_ns + round(1e9 * s * (e.t_s - first_s if finding.unit == DRIFT else 1.0)))
        return replace(e, y=changed(e.y)) if len(e.y) else e

    return replace(log, events=sorted(map(replaced, log.events), key=sort_key))
