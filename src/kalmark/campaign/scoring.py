"""Score one estimator on one simulated log: its errors and NEES at every step, its map, its divergence.

The error d of an estimate x is what the estimator would have to correct it by: in "log" coordinates its retraction
(`kalmark.geometry.spaces.retract`) by the error `turn` of the observing robot's orientation gives the truth, in "world"
coordinates plain plus does.  Landmarks are judged as those of a run are (`kalmark.results.landmark_errors`).
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from kalmark.arrays import Array, Flags, block_diagonal
from kalmark.errors import DivergedError
from kalmark.events import Id, Scan
from kalmark.geometry.angles import wrap
from kalmark.geometry.spaces import POINT2, POINT3
from kalmark.models.landmarks import Polar2D
from kalmark.report import Report
from kalmark.results.landmark_errors import BlockError, landmark_error
from kalmark.results.landmark_table import place_and_jacobian
from kalmark.results.measures import (
    MAP_NEES,
    aligned_rmse,
    finite_mean,
    has_diverged,
    map_nees,
    nees,
    point_error,
    pose_error,
    rmse,
    rotation_error,
)
from kalmark.simulate.robots import Simulation
from kalmark.slam.slam import Slam

ANY_ENDS = np.array([0.0, 1.0])  # of a line, which is judged where the true ends are
NEES = ("pose", "heading", "state", "landmarks", "joint", "mount")
SERIES = (
    *NEES, "pose_world", "landmarks_world", "joint_world", *(f"{name}_dof" for name in NEES),
    "position_m", "heading_rad", "mount_m", "mount_rad",
)  # fmt: skip


class Uncertain(NamedTuple):
    """A mount that calibrates itself: whose, its true pose (3,) or (7,), and which errors (3|6,) may differ from 0."""

    carrier: str
    truth: Array
    open: Flags


def state_error(mean: Array, truth: Array, turn: Any, coordinates: str) -> Array:
    """Return the error of a robot's state: a pose (3,) or (7,), and what is behind it.

    In space that is a velocity in the world and numbers of the robot's frame, (13,) or (16,), or a gravity in the world
    behind them, (19,).  In the plane all of it, up to (6,), is in the robot's frame.
    """
    pose = 3 if len(mean) < 7 else 7
    behind = truth[pose:] - mean[pose:]
    for at in range(0, len(behind), 9) if pose == 7 else ():  # vectors in the world
        vector = slice(at, at + 3)
        behind[vector] = point_error(mean[7:][vector], truth[7:][vector], turn, coordinates)
    return np.concatenate([pose_error(mean[:pose], truth[:pose], coordinates, turn), behind])


def robot_turn(mean: Array, truth: Array) -> Any:
    """Return the error of a robot's orientation: of its heading, or a rotation vector (3,)."""
    return wrap(truth[2] - mean[2]) if len(mean) < 7 else rotation_error(mean[3:7], truth[3:7])


def judge_landmark(
    model: Any, mean: Array, P: Array, truth: Array, turn: Any, coordinates: str, eye: Array
) -> BlockError | None:
    """Judge a landmark last observed from `eye` (2|3,), as `landmark_error`, by the error of its state."""
    found = place_and_jacobian(model, mean, ANY_ENDS)
    if found is None:
        return None
    place, P_l = found
    error = landmark_error(model.kind, place, P_l @ P @ P_l.T, truth, eye, turn, coordinates)
    if error is None:
        return None
    own, world, F, *points = error
    if isinstance(model, Polar2D):  # its Gaussian is on an arc: so is its error
        own, world = _unrolled(mean, own), _unrolled(mean, world)
    return BlockError(own, world, F @ P_l, *points)


def _unrolled(l: Array, error: Array) -> Array:
    """Return the error (2,) of a polar point l (4,) with its way along the arc about the anchor unrolled."""
    u, d = np.array([np.cos(l[2]), np.sin(l[2])]), l[3]
    n, w = np.array([-u[1], u[0]]), d * u + error
    return d * np.arctan2(w @ n, w @ u) * n + (np.linalg.norm(w) - d) * u


@dataclass(frozen=True, eq=False)
class Scores:
    """Scores of one estimator on one log.

    `series` has an array (robots, steps) for each of `SERIES`: NEES of the pose (3, in space 6), the heading or
    orientation (1, 3), the whole state if it has more than a pose, landmarks (the mean over the map), joint state,
    and the robot's uncertain mounts (the mean), each with its degrees of freedom `..._dof`; NaN where there is
    no score.

    >>> from kalmark.simulate import load_world
    >>> world = load_world("cloister", ["steps=10"])
    >>> scores = run_campaign(world, 1, ["ekf"], jobs=1, progress=False).scores["ekf"][0]
    >>> scores.series["pose"].shape, float(scores.series["pose_dof"][0, -1]), scores.diverged
    ((1, 10), 3.0, False)
    """

    series: dict[str, Array]
    landmark_rmse_m: float
    landmark_rmse_raw_m: float
    landmarks: int
    nis: float
    nis_dof: int
    diverged: bool
    stopped: str


def score(slam: Slam, simulated: Simulation, steps: Sequence[int], map_every: int = 10) -> Scores:
    """Feed a simulated log to a filter and score it against the truth after each scan.

    `steps` are the times (ns) of the steps.  Landmarks, mounts and joint state are scored at every `map_every`-th step
    and at the last.  A filter that refuses to go on has diverged.
    """
    scorer = _Scorer(slam, simulated, steps, map_every)
    slam.prepare_for(simulated.log.events)
    stopped = ""
    for event in simulated.log.events:
        try:
            report = slam.process(event)
        except DivergedError as error:
            stopped = str(error)
            break
        if isinstance(event, Scan) and len(event.y):
            scorer.after(report, event)
    return scorer.scores(stopped)


class _Scorer:
    """Record of the filter's estimates step by step; poses are scored together at the end."""

    def __init__(self, slam: Slam, simulated: Simulation, steps: Sequence[int], map_every: int) -> None:
        self.slam, self.simulated, self.map_every = slam, simulated, map_every
        self.log = simulated.log
        self.at = {t: k for k, t in enumerate(steps)}
        self.rows = {name: i for i, name in enumerate(self.log.robots)}
        self.last = len(steps) - 1
        shape = (len(self.rows), len(steps))
        self.truth = np.array([self.log.truth[name].at(np.array(steps, dtype=np.int64)) for name in self.rows])
        size = self.truth.shape[-1]
        self.d, dof = (2, 3) if size == 3 else (3, 6)
        self.mean, self.P = np.full((*shape, size), np.nan), np.full((*shape, dof, dof), np.nan)
        self.series = {key: np.full(shape, np.nan) for key in SERIES}
        self.true_id: dict[Id, Id | None] = {}
        self.eyes: dict[Id, Array] = {}  # where each landmark was last observed from
        self.uncertain = {
            f"{name}.{key}": Uncertain(name, simulated.mounts[name, key], np.diagonal(mount.cov) > 0)
            for name, robot in slam.robots.items()
            for key, mount in robot.sensors.items()
            if mount.cov is not None and mount.cov.any()
        }
        self.nis, self.nis_dof = 0.0, 0
        self.states = defaultdict[int, list[tuple[int, Array, Array]]](list)  # by row: steps, errors, covariances

    def after(self, report: Report, scan: Scan) -> None:
        """Take in one scan."""
        real = self.simulated.origins[scan.t_ns, scan.robot, scan.sensor]
        row, k = self.rows[scan.robot], self.at[scan.t_ns]
        mean, P, dof = self.slam.mean(scan.robot), self.slam.covariance(scan.robot), self.P.shape[-1]
        for o in report.observations:
            if o.outcome in ("associated", "new") and o.landmark is not None:
                self.eyes[o.landmark] = mean[: self.d]
            if o.outcome == "new" and o.landmark is not None:
                self.true_id[o.landmark] = real[o.index]
            elif o.outcome == "associated" and o.d2 is not None:
                self.nis += o.d2
                self.nis_dof += report.z.shape[1]
        self.mean[row, k], self.P[row, k] = mean[: self.mean.shape[-1]], P[:dof, :dof]
        if len(mean) > self.mean.shape[-1]:
            turn = robot_turn(mean, self._state(scan.robot, k))
            d = state_error(mean, self._state(scan.robot, k), turn, self.slam.estimator.coordinates)
            self.states[row].append((k, d, P))
        if (k + 1) % self.map_every == 0 or k == self.last:
            self._score_map(scan.robot, row, k)

    def _state(self, robot: str, k: int) -> Array:
        states: Array = self.simulated.states[robot][k + 1]
        return states

    def _score_map(self, robot: str, row: int, k: int) -> None:
        """Score landmarks, mounts and joint state; points turn with the error of the robot that saw last.

        Robots that lag behind are left out of the joint state: their truth of that time is not known.
        """
        slam, coordinates = self.slam, self.slam.estimator.coordinates
        turn = robot_turn(slam.mean(robot), self._state(robot, k))
        judged: dict[Id, BlockError] = {}
        here = [name for name in self.rows if name != robot and not slam.lags(name)]
        for name in (robot, *here):
            mean = slam.mean(name)
            dof = slam.robots[name].motion.space.dof
            own, world = (state_error(mean, self._state(name, k), turn, c) for c in (coordinates, "world"))
            judged[name] = BlockError(own, world, np.eye(dof))
        mounts: dict[Id, BlockError] = {}  # rotations of the world frame do not change them
        errors = {name: pose_error(slam.mean(name)[: len(of.truth)], of.truth) for name, of in self.uncertain.items()}
        for name, of in self.uncertain.items():
            d = errors[name][of.open]
            mounts[name] = BlockError(d, d, np.eye(len(slam.covariance(name)))[np.flatnonzero(of.open)])
        landmarks = dict(self._landmarks(turn))
        self._score_mounts({n: errors[n] for n, of in self.uncertain.items() if of.carrier == robot}, row, k)
        judged |= mounts | landmarks
        F = block_diagonal([j.F for j in judged.values()])
        P = F @ slam.covariance(*judged) @ F.T
        d = np.array([np.concatenate([getattr(j, c) for j in judged.values()]) for c in ("own", "world")])
        sizes = np.array([len(j.own) for j in landmarks.values()], dtype=np.int64)
        first = len(P) - sizes.sum() + np.cumsum(sizes) - sizes
        for key, value in zip(MAP_NEES, map_nees(d, P, first, sizes).tolist(), strict=True):
            self.series[key][row, k] = value

    def _landmarks(self, turn: Any) -> Iterator[tuple[Id, BlockError]]:
        """Yield the landmarks that have a truth, and whose depth is known well enough."""
        slam, coordinates = self.slam, self.slam.estimator.coordinates
        points: dict[Id, Array] = {}
        for name, true in self.true_id.items():
            model, truth = slam.landmark_model(name), self.log.landmarks.get(true)  # type: ignore[arg-type]
            if model is None or truth is None or slam.is_known(name):
                continue
            if model.space in (POINT2, POINT3) and len(truth) == self.d:
                points[name] = truth
                continue
            state = slam.mean(name), slam.covariance(name)
            if j := judge_landmark(model, *state, truth, turn, coordinates, self.eyes[name]):
                yield name, j
        if points:  # all at once
            truth, place = np.array([*points.values()]), np.array([slam.mean(name) for name in points])
            own, world = (point_error(place, truth, turn, c) for c in (coordinates, "world"))
            for i, name in enumerate(points):
                yield name, BlockError(own[i], world[i], np.eye(self.d), place[i : i + 1], truth[i : i + 1])

    def _score_mounts(self, errors: dict[str, Array], row: int, k: int) -> None:
        """Score mounts by their errors d (3|6,); a coordinate that is known exactly has no sigma to compare with."""
        if not errors:
            return
        series, values, dof = self.series, [], []
        for name, d in errors.items():
            at = np.flatnonzero(self.uncertain[name].open)
            values.append(nees(d[at], self.slam.covariance(name)[np.ix_(at, at)]))
            dof.append(len(at))
        series["mount"][row, k], series["mount_dof"][row, k] = finite_mean(values), np.mean(dof)
        parts = np.array([[np.linalg.norm(d[: self.d]), np.linalg.norm(d[self.d :])] for d in errors.values()])
        series["mount_m"][row, k], series["mount_rad"][row, k] = parts.max(axis=0)

    def scores(self, stopped: str) -> Scores:
        """Return the scores."""
        for row, kept in self.states.items():
            steps, errors, covariances = (np.array(one) for one in zip(*kept, strict=True))
            self.series["state"][row, steps] = nees(errors, covariances)
            self.series["state_dof"][row, steps] = errors.shape[1]
        d, robot = self.d, self.log.robots[0]
        turn = robot_turn(self.slam.mean(robot), self._state(robot, self.last))
        judged = [j for _, j in self._landmarks(turn)]
        place, true = (np.concatenate([np.empty((0, d)), *(j[i] for j in judged)]) for i in (3, 4))
        found = place, true, len(judged), sum(true is not None for true in self.true_id.values())
        coordinates = self.slam.estimator.coordinates
        return scores_of(
            self.series, self.mean, self.P, self.truth, coordinates, found, self.nis, self.nis_dof, stopped
        )  # fmt: skip


def scores_of(
    series: dict[str, Array], mean: Array, P: Array, truth: Array, coordinates: str,
    found: tuple[Array, Array, int, int], nis: float, nis_dof: int, stopped: str,
) -> Scores:  # fmt: skip
    """Return the scores of a run: `series` has those of the map, those of the poses are added.

    The poses are `mean` (robots, steps, 3 or 7) with covariances P and `truth`; `found` are the points of the map,
    where they truly are (both (N, 2 or 3)), of how many landmarks they are, and how many landmarks have a truth.
    """
    d = 2 if mean.shape[-1] == 3 else 3
    own, world = (pose_error(mean, truth, c) for c in (coordinates, "world"))
    series["pose"] = nees(own, P)
    series["pose_world"] = nees(world, P)
    series["heading"] = nees(world[..., d:], P[..., d:, d:])
    for name, size in (("pose", own.shape[-1]), ("heading", own.shape[-1] - d)):
        series[f"{name}_dof"] = np.where(np.isfinite(series[name]), float(size), np.nan)
    series["position_m"], series["heading_rad"] = (np.linalg.norm(e, axis=-1) for e in (world[..., :d], world[..., d:]))
    place, true, judged, count = found
    aligned = aligned_rmse(place, true) if judged >= d else float("nan")
    lost = any(has_diverged(*part) for part in zip(own, world, P, truth, strict=True))
    return Scores(series, aligned, rmse(place - true), count, nis, nis_dof, lost or bool(stopped), stopped)
