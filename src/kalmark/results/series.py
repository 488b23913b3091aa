"""The curves of a report: everything thinned to at most about 2,000 points, as plain lists for JSON."""

from __future__ import annotations

import re
from collections import Counter
from typing import TYPE_CHECKING, Any

import numpy as np

from kalmark.report import OUTCOMES
from kalmark.results.consistency import anees_interval, nees, nis, pose_error
from kalmark.results.history import Array, Ints, MapSnapshot
from kalmark.results.picture import Picture, broken, grouped
from kalmark.results.series_association import association_series
from kalmark.results.series_fixes import fix_series
from kalmark.results.series_space import space_series
from kalmark.results.thinned import POINTS, gaussians, significant, thin, xy

if TYPE_CHECKING:
    from kalmark.results.run import Run

BINS = 120


def series(run: Run) -> dict[str, Any]:
    """Return all that the pictures of a report need; times in seconds since the first step."""
    picture = Picture.of(run)
    t = _since_start(run)
    dof = 6 if run.history.in_space else 3
    if run.history.in_space:
        shown = space_series(run, t)
    else:
        shown = {
            "trueLandmarks": _points(picture.landmarks),
            "fixes": {robot: xy(points[thin(len(points))]) for robot, points in picture.fixes.items()},
            "usedFixes": {robot: xy(points[thin(len(points))]) for robot, points in picture.used.items()},
            "maps": [_map(m, float(t[m.step])) for m in run.history.maps],
        }
    return shown | {
        "robots": [_robot(run, picture, robot, t) for robot in picture.paths],
        "innovations": fix_series(run, picture),
        "nis": _nis(run, t),
        "dof": dof,
        "neesBounds": anees_interval(dof),
        "outcomes": _outcomes(run, t),
        "association": association_series(run, t),
    }


def _map(snapshot: MapSnapshot, t_s: float) -> dict[str, Any]:
    ids = [str(i) for i in snapshot.ids]
    return {"t": round(t_s, 3), "id": ids, **gaussians(snapshot.means, snapshot.covariances)}


def _since_start(run: Run) -> Array:
    t_ns = run.history.t_ns
    return (t_ns - t_ns[0]) * 1e-9 if len(t_ns) else np.empty(0)


def _robot(run: Run, picture: Picture, robot: str, t: Array) -> dict[str, Any]:
    rows = np.flatnonzero(run.history.robot == robot)
    rows = rows[thin(len(rows))]
    mean, P = run.history.poses[rows], run.history.pose_covariances[rows]
    out: dict[str, Any] = {"name": robot, "colour": picture.colour(robot), "t": significant(t[rows], 7)}
    d = 3 if run.history.in_space else 2
    out |= gaussians(mean[:, :d], P[:, :d, :d])
    stretches = picture.stretches[robot][thin(len(picture.stretches[robot]))]
    out["gaps"] = (np.flatnonzero(np.diff(stretches)) + 1).tolist()
    out |= {"theta": significant(mean[:, 2], 5)} if d == 2 else {"q": [significant(q, 5) for q in mean[:, 3:].T]}
    if robot in picture.truth:
        true = picture.truth[robot]
        out["truth"] = xy(broken(true[thin(len(true))], stretches))
        out |= _errors(run, rows)
    return out


def _errors(run: Run, rows: Ints) -> dict[str, Any]:
    """Return errors (estimate less truth) and sigmas in m and degrees, and the NEES in the estimator's coordinates."""
    mean, P = run.history.poses[rows], run.history.pose_covariances[rows]
    truth = run.truth.poses_in_map()[rows]
    metres, turns = (3, 3) if run.history.in_space else (2, 1)
    scale = np.repeat([1.0, 180.0 / np.pi], [metres, turns])
    error = -pose_error(mean, truth) * scale
    sigma = np.sqrt(np.maximum(np.einsum("nii->ni", P), 0.0)) * scale
    return {
        "error": [significant(column) for column in error.T],
        "sigma": [significant(column) for column in sigma.T],
        "nees": significant(nees(pose_error(mean, truth, run.coordinates), P)),
    }


def _nis(run: Run, t: Array) -> dict[str, Any]:
    """Return NIS per degree of freedom over windows of steps, the 95 % bounds of each, and where gaps in time are."""
    history = run.history
    used = history.outcome == "associated"
    value, dof = nis(history.z[used], history.Z[used])
    steps, at = np.unique(history.step[used][dof > 0], return_inverse=True)
    window = max(1, -(-len(t) // (POINTS // 4)))
    groups, gaps = grouped(steps, history.t_ns[steps], window)
    total = np.bincount(groups[at], value[dof > 0])
    degrees = np.bincount(groups[at], dof[dof > 0]).astype(int)
    bounds = {n: anees_interval(n) for n in np.unique(degrees).tolist()}
    return {
        "t": significant(np.bincount(groups, t[steps]) / np.bincount(groups), 7),
        "value": significant(total / degrees),
        "low": significant(np.array([bounds[n][0] / n for n in degrees.tolist()])),
        "high": significant(np.array([bounds[n][1] / n for n in degrees.tolist()])),
        "gaps": gaps.tolist(),
        "window": window,
    }


def _outcomes(run: Run, t: Array) -> dict[str, Any]:
    """Return how many observations had which outcome in each of some 120 stretches of time."""
    history = run.history
    edges = np.linspace(0.0, max(float(t[-1]), 1e-9) if len(t) else 1.0, BINS + 1)
    when = t[history.step]
    counts = {name: np.histogram(when[history.outcome == name], edges)[0].tolist() for name in OUTCOMES}
    return {
        "t": significant((edges[:-1] + edges[1:]) / 2, 7),
        "counts": {name: column for name, column in counts.items() if any(column)},
    }


def reasons(run: Run, most: int = 15) -> list[tuple[str, str, int]]:
    """Return the commonest (outcome, reason, count); of too many, those that differ in a number only count as one."""
    pairs = zip(run.history.outcome.tolist(), run.history.reason.tolist(), strict=True)
    said = Counter((outcome, reason) for outcome, reason in pairs if reason)
    if len(said) > most:
        merged: Counter[tuple[str, str]] = Counter()
        for (outcome, reason), count in said.items():
            merged[outcome, re.sub(r"(?<!\bd)\d+(\.\d+)?(e[+-]?\d+)?", "…", reason)] += count
        said = merged
    return [(outcome, reason, count) for (outcome, reason), count in said.most_common(most)]


def _points(landmarks: dict[Any, Array]) -> dict[str, Any]:
    points = np.array(list(landmarks.values())).reshape(-1, 2)
    return {"id": [str(i) for i in landmarks], **xy(points)}
