"""Score one estimator on one simulated log: its errors and NEES at every step, its map, its divergence.

The error coordinates are those of `kalmark.results.consistency`: the estimator's own and the world's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from kalmark.errors import DivergedError
from kalmark.geometry.angles import wrap
from kalmark.logs.log import Log
from kalmark.results.align import rigid, rmse
from kalmark.results.consistency import SINGULAR, diverged, nees, point_error, pose_error
from kalmark.slam.events import Event, Id, Scan
from kalmark.slam.report import Report
from kalmark.slam.slam import Slam

Array = npt.NDArray[np.float64]

SERIES = (
    "pose", "pose_world", "heading", "landmarks", "landmarks_world",
    "joint", "joint_world", "joint_dof", "position_m", "heading_rad",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Scores:
    """How one estimator did on one log.

    `series` has an array (robots, steps) for each of `SERIES`: NEES of pose (3), heading (1), landmarks (2, the mean
    over the map) and joint state (with its dimensions `joint_dof`), then errors; NaN where there is nothing to say.
    """

    series: dict[str, Array]
    landmark_rmse_m: float
    landmark_rmse_raw_m: float
    landmarks: int
    nis: float
    nis_dof: int
    diverged: bool
    stopped: str

    def same(self, other: Scores) -> bool:
        """Tell whether two scores are equal bit for bit."""
        return all(self.series[k].tobytes() == other.series[k].tobytes() for k in SERIES)


def score(slam: Slam, log: Log, events: Sequence[Event], steps: Sequence[int], map_every: int = 10) -> Scores:
    """Feed `events` to a filter and score it against the truth of `log` after each scan.

    `events` are those of `log`, with or without ids; `steps` are the times (ns) of the steps.  Landmarks and joint
    state are scored at every `map_every`-th step and at the last.  A filter that refuses to go on has diverged.
    """
    scorer = _Scorer(slam, log, steps, map_every)
    stopped = ""
    for event, original in zip(events, log.events, strict=True):
        try:
            report = slam.process(event)
        except DivergedError as error:
            stopped = str(error)
            break
        if isinstance(original, Scan):
            scorer.after(report, original)
    return scorer.scores(stopped)


class _Scorer:
    """Gathers what the filter says step by step; poses are scored together at the end."""

    def __init__(self, slam: Slam, log: Log, steps: Sequence[int], map_every: int) -> None:
        self.slam, self.log, self.map_every = slam, log, map_every
        self.at = {t: k for k, t in enumerate(steps)}
        self.rows = {name: i for i, name in enumerate(log.robots)}
        self.last = len(steps) - 1
        shape = (len(self.rows), len(steps))
        self.truth = np.array([log.truth[name].at(np.array(steps, dtype=np.int64)) for name in self.rows])
        self.mean, self.P = np.full((*shape, 3), np.nan), np.full((*shape, 3, 3), np.nan)
        self.series = {key: np.full(shape, np.nan) for key in SERIES}
        self.true_id: dict[Id, Id] = {}
        self.nis, self.nis_dof = 0.0, 0

    def after(self, report: Report, scan: Scan) -> None:
        """Take in one scan; `scan` has the true ids."""
        assert scan.ids is not None
        for o in report.observations:
            if o.outcome == "new" and o.landmark is not None:
                self.true_id[o.landmark] = scan.ids[o.index]  # type: ignore[assignment]
            elif o.outcome == "associated" and o.d2 is not None:
                self.nis += o.d2
                self.nis_dof += scan.y.shape[1]
        row, k = self.rows[scan.robot], self.at[scan.t_ns]
        self.mean[row, k], self.P[row, k] = self.slam.mean(scan.robot), self.slam.covariance(scan.robot)
        if (k + 1) % self.map_every == 0 or k == self.last:
            self._score_map(scan.robot, row, k)

    def _score_map(self, robot: str, row: int, k: int) -> None:
        """Score landmarks and joint state; points turn with the heading error of the robot that saw last."""
        robots = [robot, *(name for name in self.rows if name != robot)]
        known = [(name, true) for name, true in self.true_id.items() if true in self.log.landmarks]
        means = [self.slam.mean(name) for name in (*robots, *(name for name, _ in known))]
        first = np.cumsum([0, *(len(m) for m in means)])
        at_points = first[len(robots) : -1, None] + np.arange(2)
        at = np.concatenate([np.arange(3 * len(robots)), at_points.ravel()])
        P = self.slam.covariance(*robots, *(name for name, _ in known))[np.ix_(at, at)]
        n = 3 * len(robots)
        blocks = n + 2 * np.arange(len(known))[:, None] + np.arange(2)
        P_points = P[blocks[:, :, None], blocks[:, None, :]]
        poses, true_poses = np.array(means[: len(robots)]), self.truth[[self.rows[name] for name in robots], k]
        dtheta = wrap(true_poses[0, 2] - poses[0, 2])
        points = np.array([m[:2] for m in means[len(robots) :]]).reshape(-1, 2)
        true_points = np.array([self.log.landmarks[true] for _, true in known]).reshape(-1, 2)
        errors = []
        for name, coordinates in (("", self.slam.estimator.coordinates), ("_world", "world")):
            d = point_error(points, true_points, dtheta, coordinates)
            values = nees_of_points(d, P_points)
            if np.isfinite(values).any():
                self.series["landmarks" + name][row, k] = np.nanmean(values)
            d_poses = np.column_stack(
                [
                    point_error(poses[:, :2], true_poses[:, :2], dtheta, coordinates),
                    wrap(true_poses[:, 2] - poses[:, 2]),
                ]
            )
            errors.append(np.concatenate([d_poses.ravel(), d.ravel()]))
        self.series["joint"][row, k], self.series["joint_world"][row, k] = joint_nees(np.array(errors), P)
        self.series["joint_dof"][row, k] = len(P) if np.isfinite(self.series["joint"][row, k]) else np.nan

    def scores(self, stopped: str) -> Scores:
        """Return the scores."""
        s, coordinates = self.series, self.slam.estimator.coordinates
        own, world = (pose_error(self.mean, self.truth, c) for c in (coordinates, "world"))
        s["pose"], s["pose_world"] = nees(own, self.P), nees(world, self.P)
        s["heading"] = nees(world[..., 2:], self.P[..., 2:, 2:])
        s["position_m"], s["heading_rad"] = np.linalg.norm(world[..., :2], axis=-1), np.abs(world[..., 2])
        aligned, raw, count = self._final_map()
        lost = any(
            diverged(own[i, :, :2], self.P[i, :, :2, :2], s["position_m"][i], path_m(self.truth[i]))
            for i in range(len(self.rows))
        )
        return Scores(s, aligned, raw, count, self.nis, self.nis_dof, lost or bool(stopped), stopped)

    def _final_map(self) -> tuple[float, float, int]:
        pairs = [
            (self.slam.mean(name)[:2], self.log.landmarks[true])
            for name, true in self.true_id.items()
            if true in self.log.landmarks
        ]
        mean, true = (np.array([pair[i] for pair in pairs]).reshape(-1, 2) for i in (0, 1))
        aligned = rmse(rigid(mean, true)(mean) - true) if len(pairs) >= 2 else float("nan")
        return aligned, rmse(mean - true), len(self.true_id)


def path_m(poses: Array) -> float:
    """Return the length of a path of true poses (N, 3)."""
    return float(np.linalg.norm(np.diff(poses[:, :2], axis=0), axis=1).sum())


def nees_of_points(d: Array, P: Array) -> Array:
    """Return the NEES (K,) of points with errors d (K, 2) and covariances P (K, 2, 2); NaN where P is singular."""
    a, b, c = P[:, 0, 0], P[:, 0, 1], P[:, 1, 1]
    determinant = a * c - b * b
    regular = (a > 0) & (c > 0) & (determinant > SINGULAR * a * c)
    value = (c * d[:, 0] ** 2 - 2 * b * d[:, 0] * d[:, 1] + a * d[:, 1] ** 2) / np.where(regular, determinant, 1.0)
    return np.where(regular, value, np.nan)


def joint_nees(d: Array, P: Array) -> Any:
    """Return the NEES (E,) of E errors d (E, n) of one state with covariance P (n, n); NaN if P is singular."""
    sigma = np.sqrt(np.diagonal(P))
    with np.errstate(divide="ignore", invalid="ignore"):
        correlation = P / np.outer(sigma, sigma)
    try:
        L = np.linalg.cholesky(correlation)
    except np.linalg.LinAlgError:
        return np.full(len(d), np.nan)
    if not (np.isfinite(L).all() and np.diagonal(L).min() ** 2 > SINGULAR):
        return np.full(len(d), np.nan)
    return np.sum(np.linalg.solve(L, (d / sigma).T) ** 2, axis=0)
