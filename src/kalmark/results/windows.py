"""Is the map wrong from some time on?  NIS, observations left out and the whiteness of innovations, in windows of time.

A filter on a wrong map contradicts itself: innovations that are too large or keep their signs, and observations that
fit nothing.  Bar-Shalom, Li, Kirubarajan 2001, section 5.4: time-average NIS and autocorrelation of the innovations.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import chi2

from kalmark.results.history import Array, History, Ints
from kalmark.results.measures import nis
from kalmark.results.recording import Recording
from kalmark.results.words import figure

DEGREES = 100  # of freedom in a window, at least
OBSERVATIONS = 60  # in a window of those left out, at least
CHANCE = 1e-6  # with which a consistent run would raise a flag
TIMES = 3.0  # a window's NIS over the median window's
LEFT_OUT = 0.5  # share of a window's observations that fit nothing, where the median window has less than half of it
CORRELATED = 0.5  # by which a window's autocorrelation of innovations exceeds the median window's
PAIRS = 60  # of successive innovations in a window
SCANS = 10  # at least, as good as, in a window: the observations of one share the error of the pose
SCANS_PAIRED = 30  # in a window of pairs
MOST_GAP_STEPS = 5


@dataclass(frozen=True)
class Window:
    """A stretch of time: when it begins and ends, in seconds since the first step, and its figure."""

    start_s: float
    end_s: float
    value: float
    number: int


def window_figures(history: History) -> dict[str, Any]:
    """Return the figures of ``summary.json`` that windows of time have; absent where there is too little."""
    out: dict[str, Any] = {}
    for name, windows in (("nis", nis_windows(history)), ("left_out", left_out_windows(history))):
        if len(windows) > 1:
            worst = max(windows, key=lambda w: w.value)
            out |= {f"{name}_window_max": worst.value, f"{name}_window_max_s": [worst.start_s, worst.end_s]}
            out[f"{name}_window_median"] = float(np.median([w.value for w in windows]))
    correlations = autocorrelations(history)
    if correlations:
        out["innovation_autocorrelation"] = float(np.median([w.value for w in correlations]))
    return out


def nis_windows(history: History) -> list[Window]:
    """Return the NIS per degree of freedom of windows of at least so many degrees, one after the other."""
    used = history.outcome == "associated"
    value, dof = nis(history.z[used], history.Z[used])
    return _windows(history, history.step[used], np.nan_to_num(value), dof, DEGREES, SCANS)


def left_out_windows(history: History) -> list[Window]:
    """Return the share of observations that were rejected, or ignored because they fit nothing, window by window."""
    mine = history.outcome != "tentative"
    out = np.isin(history.outcome[mine], ["rejected", "ignored", "deferred"]) & (history.d2[mine] > 0)
    told = np.char.startswith(history.reason[mine], "between ") | np.char.startswith(
        history.reason[mine], "it does not"
    )
    wrong = (out | told).astype(np.float64)
    return _windows(history, history.step[mine], wrong, np.ones(len(wrong), dtype=np.int64), OBSERVATIONS, SCANS)


def autocorrelations(history: History) -> list[Window]:
    """Return the correlation of successive whitened innovations of the same landmark, window by window."""
    rows = np.flatnonzero((history.outcome == "associated") & np.isfinite(history.z).any(axis=1))
    white = _whitened(history, rows)
    robots = history.robot[history.step[rows]]
    order = np.lexsort((history.step[rows], history.landmark[rows], history.sensor[rows], robots))
    one, two = order[:-1], order[1:]
    same = (history.landmark[rows[one]] == history.landmark[rows[two]]) & (robots[one] == robots[two])
    same &= history.sensor[rows[one]] == history.sensor[rows[two]]
    same &= history.step[rows[two]] - history.step[rows[one]] <= MOST_GAP_STEPS
    one, two = one[same], two[same]
    turn = np.argsort(history.step[rows[two]], kind="stable")
    a, b, step = white[one[turn]], white[two[turn]], history.step[rows[two[turn]]]
    both = np.nansum(a * b, axis=1)
    size = np.sqrt(np.nansum(a**2, axis=1) * np.nansum(b**2, axis=1))
    ones = np.ones(len(both), dtype=np.int64)
    products, sizes = (_windows(history, step, value, ones, PAIRS, SCANS_PAIRED) for value in (both, size))
    return [
        Window(p.start_s, p.end_s, p.value / max(s.value, 1e-300), p.number)
        for p, s in zip(products, sizes, strict=True)
    ]


def _whitened(history: History, rows: Ints) -> Array:
    """Return L^-1 z (K, p), L the factor of Z, NaN where there is none."""
    out = np.full((len(rows), history.z.shape[1]), np.nan)
    sizes = np.isfinite(history.z[rows]).sum(axis=1)
    for m in np.unique(sizes[sizes > 0]):
        mine = np.flatnonzero(sizes == m)
        L = np.linalg.cholesky(history.Z[rows[mine], :m, :m])
        out[mine, :m] = np.linalg.solve(L, history.z[rows[mine], :m, None])[..., 0]
    return out


def _windows(history: History, step: Ints, value: Array, weight: Ints, least: int, scans: int) -> list[Window]:
    """Return sums of values over sums of weights, cut each time the weights add up to so much.

    A scan counts for no more than one of so many `scans` of a window.
    """
    if not len(step):
        return []
    _, scan = np.unique(step, return_inverse=True)
    counts = weight * np.minimum(1.0, least / scans / np.maximum(np.bincount(scan, weight), 1.0))[scan]
    number = ((np.cumsum(counts) - counts) / least + 1e-9).astype(np.int64)
    t, out = history.t_s, []
    for i in range(int(number[-1]) + 1):
        mine = number == i
        if counts[mine].sum() >= 0.9 * least:
            first, last = step[mine][0], step[mine][-1]
            share = float(value[mine].sum() / weight[mine].sum())
            out.append(Window(float(t[first]), float(t[last]), share, round(counts[mine].sum())))
    return out


def window_warnings(run: Recording, _: Any = None) -> Iterator[str]:
    """Return a line for each sign that the map is wrong."""
    history = run.history
    begin_s = float(history.t_ns[0]) * 1e-9 if len(history.t_ns) else 0.0
    yield from _of(nis_windows(history), _high_nis, begin_s)
    yield from _of(left_out_windows(history), _left_out, begin_s)
    yield from _of(autocorrelations(history), _correlated, begin_s)


def _of(windows: list[Window], told: Any, begin_s: float) -> Iterator[str]:
    if len(windows) < 3:
        return
    median = float(np.median([w.value for w in windows]))
    worst = max(windows, key=lambda w: w.value)
    line = told(worst, median, len(windows))
    if line:
        when = f"from t={worst.start_s:.1f} to {worst.end_s:.1f} s"
        if begin_s:
            when += f" ({begin_s + worst.start_s:.1f} to {begin_s + worst.end_s:.1f} s in the log)"
        yield f"{line} {when}: the map may be wrong from there on"


def _high_nis(worst: Window, median: float, count: int) -> str:
    bound = float(chi2.ppf(1 - CHANCE / count, worst.number)) / worst.number
    if worst.value <= max(bound, TIMES * median):
        return ""
    return f"NIS per degree of freedom rises to {figure(worst.value, 2)}, median {figure(median, 2)},"


def _correlated(worst: Window, median: float, count: int) -> str:
    if worst.value - max(median, 0.0) < CORRELATED:
        return ""
    return f"successive innovations are correlated by {figure(worst.value, 2)}, median {figure(median, 2)},"


def _left_out(worst: Window, median: float, count: int) -> str:
    if worst.value < LEFT_OUT or median > LEFT_OUT / 2:
        return ""
    return f"{worst.value:.0%} of the observations fit nothing, median {median:.0%},"
