"""The curves of a report: everything thinned to at most about 2,000 points, as plain lists for JSON."""

from __future__ import annotations

import math
import re
from collections import Counter
from typing import TYPE_CHECKING, Any

import numpy as np

from kalmark.results.consistency import anees_interval, nees, nis, pose_error
from kalmark.results.history import Array, Ints, MapSnapshot
from kalmark.results.picture import Picture
from kalmark.slam.report import OUTCOMES

if TYPE_CHECKING:
    from kalmark.results.run import Run

POINTS = 2000
BINS = 120


def series(run: Run) -> dict[str, Any]:
    """Return all that the pictures of a report need; times in seconds since the first step."""
    picture = Picture.of(run)
    t = _since_start(run)
    return {
        "robots": [_robot(run, picture, robot, t) for robot in picture.paths],
        "trueLandmarks": _points(picture.landmarks),
        "fixes": {robot: xy(points[_thin(len(points))]) for robot, points in picture.fixes.items()},
        "usedFixes": {robot: xy(points[_thin(len(points))]) for robot, points in picture.used.items()},
        "maps": [_map(m, float(t[m.step])) for m in run.history.maps],
        "nis": _nis(run, t),
        "neesBounds": anees_interval(3),
        "outcomes": _outcomes(run, t),
    }


def _map(snapshot: MapSnapshot, t_s: float) -> dict[str, Any]:
    ids = [str(i) for i in snapshot.ids]
    return {"t": round(t_s, 3), "id": ids, **gaussians(snapshot.means, snapshot.covariances)}


def _since_start(run: Run) -> Array:
    t_ns = run.history.t_ns
    return (t_ns - t_ns[0]) * 1e-9 if len(t_ns) else np.empty(0)


def _robot(run: Run, picture: Picture, robot: str, t: Array) -> dict[str, Any]:
    rows = np.flatnonzero(run.history.robot == robot)
    rows = rows[_thin(len(rows))]
    mean, P = run.history.mean[rows], run.history.covariance[rows]
    out: dict[str, Any] = {"name": robot, "colour": picture.colour(robot), "t": significant(t[rows], 7)}
    out |= gaussians(mean[:, :2], P[:, :2, :2]) | {"theta": significant(mean[:, 2], 5)}
    if robot in picture.truth:
        true = picture.truth[robot]
        out["truth"] = xy(true[_thin(len(true))])
        out |= _errors(run, rows)
    return out


def _errors(run: Run, rows: Ints) -> dict[str, Any]:
    """Return errors (estimate less truth) and sigmas in m and degrees, and the NEES in the estimator's coordinates."""
    mean, P = run.history.mean[rows], run.history.covariance[rows]
    truth = run.truth.poses_in_map()[rows]
    scale = np.array([1.0, 1.0, 180.0 / np.pi])
    error = -pose_error(mean, truth) * scale
    sigma = np.sqrt(np.maximum(np.einsum("nii->ni", P), 0.0)) * scale
    return {
        "error": [significant(column) for column in error.T],
        "sigma": [significant(column) for column in sigma.T],
        "nees": significant(nees(pose_error(mean, truth, run.coordinates), P)),
    }


def _nis(run: Run, t: Array) -> dict[str, Any]:
    """Return NIS per degree of freedom over windows of equally many steps, and the 95 % bounds of each window."""
    history = run.history
    used = history.outcome == "associated"
    value, dof = nis(history.z[used], history.Z[used])
    window = max(1, -(-len(t) // (POINTS // 4)))
    count = -(-len(t) // window)
    at = history.step[used] // window
    total = np.bincount(at, np.nan_to_num(value), count)
    degrees = np.bincount(at, dof, count).astype(int)
    keep = degrees > 0
    bounds = {n: anees_interval(n) for n in np.unique(degrees[keep]).tolist()}
    return {
        "t": significant(t[np.minimum(np.arange(count) * window + window // 2, len(t) - 1)][keep], 7),
        "value": significant(total[keep] / degrees[keep]),
        "low": significant(np.array([bounds[n][0] / n for n in degrees[keep].tolist()])),
        "high": significant(np.array([bounds[n][1] / n for n in degrees[keep].tolist()])),
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


def xy(points: Array) -> dict[str, Any]:
    """Return points (N, 2) to a tenth of a millimetre."""
    return {"x": _rounded(points[:, 0], 4), "y": _rounded(points[:, 1], 4)}


def gaussians(means: Array, covariances: Array) -> dict[str, Any]:
    """Return means (N, 2) and covariances (N, 2, 2) column by column."""
    return xy(means) | {
        "pxx": significant(covariances[:, 0, 0]),
        "pxy": significant(covariances[:, 0, 1]),
        "pyy": significant(covariances[:, 1, 1]),
    }


def _thin(count: int) -> Ints:
    """Return at most about 2,000 evenly spread indices, the last one among them."""
    stride = max(1, -(-count // POINTS))
    indices = np.arange(0, count, stride)
    return np.append(indices, count - 1) if count and indices[-1] != count - 1 else indices


def _rounded(values: Array, digits: int) -> list[float | None]:
    return [value if math.isfinite(value) else None for value in np.round(values, digits).tolist()]


def significant(values: Array, digits: int = 4) -> list[float | None]:
    """Return values to so many significant digits, None for NaN and infinity."""
    return [float(f"{value:.{digits}g}") if np.isfinite(value) else None for value in values.tolist()]
