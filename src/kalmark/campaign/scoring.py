"""Score one estimator on one simulated log: its errors and NEES at every step, its map, its divergence.

The error coordinates are those of `kalmark.campaign.errors`: the estimator's own and the world's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from kalmark.campaign import errors
from kalmark.campaign.errors import Judged
from kalmark.errors import DivergedError
from kalmark.events import Id, Scan
from kalmark.report import Report
from kalmark.results.align import rigid, rmse
from kalmark.results.consistency import SINGULAR, diverged, nees, pose_error
from kalmark.simulate.robots import Simulation
from kalmark.slam.slam import Slam

Array = npt.NDArray[np.float64]

NEES = ("pose", "heading", "state", "landmarks", "joint", "mount")
SERIES = (
    *NEES, "pose_world", "landmarks_world", "joint_world", *(f"{name}_dof" for name in NEES),
    "position_m", "heading_rad", "mount_m", "mount_rad",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Scores:
    """How one estimator did on one log.

    `series` has an array (robots, steps) for each of `SERIES`: NEES of the pose (3, in space 6), the heading or
    orientation (1, 3), the whole state if it has velocities (12), landmarks (the mean over the map), joint state, and
    the robot's uncertain mounts (the mean), each with its degrees of freedom `..._dof`; then errors.  NaN where there
    is nothing to say.
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


def score(slam: Slam, simulated: Simulation, steps: Sequence[int], map_every: int = 10) -> Scores:
    """Feed a simulated log to a filter and score it against the truth after each scan.

    `steps` are the times (ns) of the steps.  Landmarks, mounts and joint state are scored at every `map_every`-th step
    and at the last.  A filter that refuses to go on has diverged.
    """
    scorer = _Scorer(slam, simulated, steps, map_every)
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
    """Gathers what the filter says step by step; poses are scored together at the end."""

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
        self.uncertain = {
            f"{name}.{key}": (name, simulated.mounts[name, key])
            for name, robot in slam.robots.items()
            for key, mount in robot.sensors.items()
            if mount.cov is not None
        }
        self.nis, self.nis_dof = 0.0, 0

    def after(self, report: Report, scan: Scan) -> None:
        """Take in one scan."""
        real = self.simulated.origins[scan.t_ns, scan.robot, scan.sensor]
        for o in report.observations:
            if o.outcome == "new" and o.landmark is not None:
                self.true_id[o.landmark] = real[o.index]
            elif o.outcome == "associated" and o.d2 is not None:
                self.nis += o.d2
                self.nis_dof += report.z.shape[1]
        row, k = self.rows[scan.robot], self.at[scan.t_ns]
        mean, P, dof = self.slam.mean(scan.robot), self.slam.covariance(scan.robot), self.P.shape[-1]
        self.mean[row, k], self.P[row, k] = mean[: self.mean.shape[-1]], P[:dof, :dof]
        if len(mean) > self.mean.shape[-1]:
            turn = errors.robot_turn(mean, self._state(scan.robot, k))
            d = errors.state_error(mean, self._state(scan.robot, k), turn, self.slam.estimator.coordinates)
            self.series["state"][row, k], self.series["state_dof"][row, k] = nees(d, P), len(d)
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
        turn = errors.robot_turn(slam.mean(robot), self._state(robot, k))
        judged: dict[Id, Judged] = {}
        here = [name for name in self.rows if name != robot and not slam.lags(name)]
        for name in (robot, *here):
            mean = slam.mean(name)
            dof = slam.robots[name].motion.space.dof
            judged[name] = errors.robot(mean, self._state(name, k), turn, coordinates, dof)
        mounts: dict[Id, Judged] = {
            name: errors.mount(slam.mean(name)[: len(truth)], truth) for name, (_, truth) in self.uncertain.items()
        }
        landmarks: dict[Id, Judged] = dict(self._landmarks(turn, slam.mean(robot)[: self.d]))
        self._score_landmarks(landmarks, row, k)
        self._score_mounts({n: mounts[n] for n, (carrier, _) in self.uncertain.items() if carrier == robot}, row, k)
        judged |= mounts | landmarks
        F = block_diagonal([j.F for j in judged.values()])
        P = F @ slam.covariance(*judged) @ F.T
        d = np.array([np.concatenate([getattr(j, c) for j in judged.values()]) for c in ("own", "world")])
        series = self.series
        series["joint"][row, k], series["joint_world"][row, k] = joint_nees(d, P)
        series["joint_dof"][row, k] = len(P) if np.isfinite(series["joint"][row, k]) else np.nan

    def _landmarks(self, turn: Any, eye: Array) -> Any:
        """Yield the landmarks that have a truth, and whose depth is known well enough."""
        slam = self.slam
        for name, true in self.true_id.items():
            model = slam.landmark_model(name)
            if true in self.log.landmarks and model is not None:
                mean, P = slam.mean(name), slam.covariance(name)
                truth = self.log.landmarks[true]
                if (j := errors.landmark(model, mean, P, truth, turn, slam.estimator.coordinates, eye)) is not None:
                    yield name, j

    def _score_landmarks(self, landmarks: dict[Id, Judged], row: int, k: int) -> None:
        values: dict[str, list[Array]] = {"": [], "_world": [], "_dof": []}
        for size in {len(j.own) for j in landmarks.values()}:
            same = {name: j for name, j in landmarks.items() if len(j.own) == size}
            P = np.array([j.F @ self.slam.covariance(name) @ j.F.T for name, j in same.items()])
            own, world = (nees(np.array([getattr(j, c) for j in same.values()]), P) for c in ("own", "world"))
            values[""].append(own)
            values["_world"].append(world)
            values["_dof"].append(np.where(np.isfinite(own), float(size), np.nan))
        for name, parts in values.items():
            numbers = np.concatenate([np.empty(0), *parts])
            if np.isfinite(numbers).any():
                self.series["landmarks" + name][row, k] = np.nanmean(numbers)

    def _score_mounts(self, mounts: dict[str, Judged], row: int, k: int) -> None:
        if not mounts:
            return
        dof = len(next(iter(mounts.values())).own)
        value = [nees(j.own, self.slam.covariance(name)[:dof, :dof]) for name, j in mounts.items()]
        if np.isfinite(value).any():
            self.series["mount"][row, k] = np.nanmean(value)
            self.series["mount_dof"][row, k] = len(next(iter(mounts.values())).own)
        d = [j.own for j in mounts.values()]
        self.series["mount_m"][row, k] = max(np.linalg.norm(e[: self.d]) for e in d)
        self.series["mount_rad"][row, k] = max(np.linalg.norm(e[self.d :]) for e in d)

    def scores(self, stopped: str) -> Scores:
        """Return the scores."""
        s, coordinates, d = self.series, self.slam.estimator.coordinates, self.d
        own, world = (pose_error(self.mean, self.truth, c) for c in (coordinates, "world"))
        s["pose"], s["pose_world"] = nees(own, self.P), nees(world, self.P)
        s["heading"] = nees(world[..., d:], self.P[..., d:, d:])
        for name, size in (("pose", own.shape[-1]), ("heading", own.shape[-1] - d)):
            s[f"{name}_dof"] = np.where(np.isfinite(s[name]), float(size), np.nan)
        s["position_m"], s["heading_rad"] = (np.linalg.norm(e, axis=-1) for e in (world[..., :d], world[..., d:]))
        aligned, raw, count = self._final_map()
        lost = any(
            diverged(own[i, :, :d], self.P[i, :, :d, :d], s["position_m"][i], path_m(self.truth[i], d))
            for i in range(len(self.rows))
        )
        return Scores(s, aligned, raw, count, self.nis, self.nis_dof, lost or bool(stopped), stopped)

    def _final_map(self) -> tuple[float, float, int]:
        robot = self.log.robots[0]
        mean = self.slam.mean(robot)
        judged = [j for _, j in self._landmarks(errors.robot_turn(mean, self._state(robot, self.last)), mean[: self.d])]
        place, true = (np.concatenate([np.empty((0, self.d)), *(j[i] for j in judged)]) for i in (3, 4))
        aligned = rmse(rigid(place, true)(place) - true) if len(judged) >= self.d else float("nan")
        return aligned, rmse(place - true), sum(true is not None for true in self.true_id.values())


def path_m(poses: Array, d: int) -> float:
    """Return the length of a path of true poses (N, 3|7), whose first d numbers are the position."""
    return float(np.linalg.norm(np.diff(poses[:, :d], axis=0), axis=1).sum())


def block_diagonal(blocks: Sequence[Array]) -> Array:
    """Return the blocks (f, dof) along the diagonal of one matrix."""
    from scipy.linalg import block_diag

    F: Array = block_diag(*blocks)
    return F


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
