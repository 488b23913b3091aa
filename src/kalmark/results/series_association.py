"""The association page of a report: scans that were ambiguous, with what their observations were compared with."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from kalmark.results.explain import Explanation, Fate, explained
from kalmark.results.history import Array, History, Ints
from kalmark.results.thinned import gaussians, rounded, significant

if TYPE_CHECKING:
    from kalmark.results.run import Run

SCANS = 60  # drawn at most, the most ambiguous ones
CHANGES = 200  # in the table
MARKS = 2000  # in the timeline
TENTATIVE = "tentative: "  # how the reasons of those begin that never were landmarks
UNSURE = ("between ", "its nearest ", "it does not fit", "cliques as large")  # how reasons of ambiguity begin


def association_series(run: Run, t: Array) -> dict[str, Any]:
    """Return ambiguous scans in the order of time, and when landmarks were merged or removed."""
    changes = [c for c in run.history.decisions.changes if not c.reason.startswith(TENTATIVE)]
    return {
        "scans": [_scan(explained(run, step)) for step in ambiguous(run.history).tolist()],
        "changes": {
            what: significant(np.array([t[c.step] for c in changes if c.what == what][:MARKS]), 7)
            for what in dict.fromkeys(c.what for c in changes)
        },
    }


def ambiguous(history: History) -> Ints:
    """Return the steps of the most ambiguous scans, in the order of time: those with most observations in doubt."""
    told = history.decisions
    if not len(told.row):
        return np.zeros(0, dtype=np.int64)
    reasons = history.reason
    doubt = (history.outcome == "deferred").astype(np.int64)
    doubt += np.logical_or.reduce([np.char.startswith(reasons, start) for start in UNSURE])
    shown = np.zeros(len(history.step), dtype=np.bool_)
    shown[told.row] = True
    score = np.bincount(history.step[shown], doubt[shown], len(history.t_ns))
    best = np.argsort(-score, kind="stable")[:SCANS]
    return np.sort(best[score[best] > 0])


def change_rows(run: Run) -> Iterator[tuple[str, str, str, str]]:
    """Return rows of what became of landmarks: when, which, what, why; tentative ones that went are not among them."""
    history = run.history
    told = [c for c in history.decisions.changes if not c.reason.startswith(TENTATIVE)]
    for c in told[:CHANGES]:
        t_s = (history.t_ns[c.step] - history.t_ns[0]) * 1e-9
        yield f"{t_s:.1f}", c.landmark, c.what, c.reason
    if len(told) > CHANGES:
        yield "", "", "", f"and {len(told) - CHANGES} more: see associations.csv"


def _scan(told: Explanation) -> dict[str, Any]:
    pose = gaussians(told.pose[None, :2], told.covariance[None, :2, :2])
    return {
        "t": round(told.t_s, 3),
        "in_log": told.in_log,
        "robot": told.robot,
        "sensor": told.sensor,
        "pose": pose,
        "seen": [_fate(fate) for fate in told.fates],
    }


def _fate(fate: Fate) -> dict[str, Any]:
    x, y = rounded(fate.seen_at[:2], 4)
    near = [
        {"name": c.landmark, "d2": float(f"{c.d2:.3g}")} | dict(zip("xy", rounded(c.place[:2], 4), strict=True))
        for c in fate.near
    ]
    text = f"{fate.outcome}{' ' + fate.landmark if fate.landmark else ''}{': ' if fate.reason else ''}{fate.reason}"
    return {
        "x": x, "y": y, "k": fate.index, "outcome": fate.outcome, "landmark": fate.landmark, "text": text, "near": near,
    }  # fmt: skip
