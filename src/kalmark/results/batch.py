"""The maximum-likelihood trajectory and map of a log: the strongest check of a filter on data without truth.

`solve_batch` takes the observations the filter used and finds, by sparse Gauss-Newton on all of them at once, the path
and the points that explain them best, and the points' covariances.  A filter that is consistent ends with the same map
to a fraction of its sigma, and with the same sigma; one that is not claims to know better than the optimum can.
Derivation and figures: docs/batch.md.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from kalmark.errors import KalmarkError
from kalmark.events import Event, Id
from kalmark.results.align import rmse
from kalmark.results.batch_factors import State
from kalmark.results.batch_input import Input, Known, batch_input
from kalmark.results.batch_solve import Solution, minimise
from kalmark.results.batch_tags_input import adjust_run

if TYPE_CHECKING:
    from kalmark.logs.log import Log
    from kalmark.results.run import Run

Array = npt.NDArray[np.float64]
MANY_NODES = 2000  # from here on a line tells how far it is


@dataclass(frozen=True, eq=False)
class Batch:
    """The optimum of a run's data: poses (S, 3) at its S steps, points (m, 2) and their covariances (m, 2, 2).

    In space they are (S, 7), (m, 3) and (m, 3, 3).
    `chi2` is the sum of squared whitened residuals (motion included), `dof` their number less what they determine;
    `relative_step` is the last step of `iterations`, over the map's size.
    """

    poses: Array
    ids: list[Id]
    means: Array
    covariances: Array
    chi2: float
    dof: int
    iterations: int
    relative_step: float

    def sigma(self) -> Array:
        """Return the sigma (m,) of each point: the root of its covariance's trace, in metres."""
        return np.sqrt(np.trace(self.covariances, axis1=1, axis2=2))

    def compare(self, run: Run) -> dict[str, Any]:
        """Return how far the filter's map and path are from the optimum of the same data.

        `sigma_ratio`: median over landmarks of the filter's sigma over the batch's (1: honest, below: overconfident).
        `map_difference_m`: RMS over landmarks of the distance between the two.  `map_difference_sigma`: the largest
        such distance over the batch's sigma of that landmark.  `path_ratio`: with truth, the filter's raw position RMSE
        over the batch's, which sees the future, else None.  `path_difference_m`: RMS over steps of the distance.
        """
        at = {str(name): k for k, name in enumerate(self.ids)}
        rows = [(k, at[str(name)]) for k, name in enumerate(run.landmarks.ids) if str(name) in at]
        d = self.means.shape[1]
        mine = np.array([j for _, j in rows], dtype=np.int64)
        theirs = [k for k, _ in rows]
        sigma = self.sigma()[mine]
        distance = np.array([np.linalg.norm(run.landmarks.means[k][:d] - self.means[j]) for k, j in rows])
        filtered = np.array([np.sqrt(np.trace(run.landmarks.covariances[k][:d, :d])) for k in theirs])
        free = sigma > 0
        path = run.history.mean[:, :d] - self.poses[:, :d]
        return {
            "sigma_ratio": _or_none(np.median, filtered[free] / sigma[free]),
            "map_difference_m": _or_none(lambda d: np.sqrt(np.mean(d**2)), distance),
            "map_difference_sigma": _or_none(np.max, distance[free] / sigma[free]),
            "path_ratio": self._path_ratio(run),
            "path_difference_m": rmse(path) if len(path) else None,
            "landmarks": len(rows),
            "iterations": self.iterations,
            "chi2_per_dof": self.chi2 / self.dof if self.dof > 0 else None,
        }

    def _path_ratio(self, run: Run) -> float | None:
        truth = run.truth.poses_in_map()
        known, d = np.isfinite(truth).all(axis=1), self.means.shape[1]
        if not known.any():
            return None
        mine, theirs = (rmse(path[known, :d] - truth[known, :d]) for path in (self.poses, run.history.mean))
        return theirs / mine if mine > 0 else None


def solve_batch(
    run: Run,
    log: Log | Iterable[Event],
    *,
    known: Known | None = None,
    initial: Batch | None = None,
    iterations: int = 100,
    progress: bool = True,
) -> Batch:
    """Find the maximum-likelihood path and map of a run's data: O(steps) and O(landmarks^3) an iteration.

    `log` is what the run was made from.  Starts from the filter's solution, or from `initial`.  `known` gives the
    landmarks that were in the map before the log, id: (mean, covariance or None for exactly).  Fixes are all used.
    Raises KalmarkError if something is not determined, or if it does not converge within `iterations`.
    """
    given = batch_input(run, log, known)
    start = given.start if initial is None else _replaced(given, initial)
    with _telling(progress and len(start.poses) > MANY_NODES) as tell:
        solution = minimise(given.problem, start, iterations=iterations, tell=tell)
    return _batch(given, solution)


def compare(run: Run, log: Log | Iterable[Event] | None = None, *, progress: bool = True) -> dict[str, Any]:
    """Return the entry `batch` of a run's summary (see `Batch.compare`, of a run that saw tags `TagBatch.compare`).

    The log is read again unless it is given or not needed.
    """
    if not np.isnan(run.history.left_px).all():
        return adjust_run(run).compare()
    return solve_batch(run, _log_of(run) if log is None else log, progress=progress).compare(run)


def _batch(given: Input, solution: Solution) -> Batch:
    m, d = given.start.points.shape
    blocks = solution.covariance.reshape(m, d, m, d)[np.arange(m), :, np.arange(m)]
    residuals = given.problem.sighted(solution.state).z.size
    return Batch(
        poses=solution.state.poses[given.nodes],
        ids=given.ids,
        means=solution.state.points,
        covariances=blocks,
        chi2=solution.chi2,
        dof=residuals - d * int(np.sum(~given.problem.fixed)),
        iterations=solution.iterations,
        relative_step=solution.relative_step,
    )


def _replaced(given: Input, initial: Batch) -> State:
    """Return the start with the poses and points of an earlier solution of the same log."""
    poses, points = given.start.poses.copy(), given.start.points.copy()
    if len(initial.poses) != len(given.nodes):
        raise KalmarkError(f"batch solution: initial has {len(initial.poses)} poses, expected {len(given.nodes)}")
    poses[given.nodes] = initial.poses
    at = {name: k for k, name in enumerate(given.ids)}
    for name, mean in zip(initial.ids, initial.means, strict=True):
        if name in at:
            points[at[name]] = mean
    return State(poses, points)


def _log_of(run: Run) -> Iterable[Event]:
    """Read again the log a run was made from, as its configuration says."""
    from kalmark.config.opening import open_config_log
    from kalmark.config.schema import Config

    if run.log.path is None:
        raise KalmarkError("batch solution: the run does not say which log it was made from, expected the log itself")
    try:
        config = Config.model_validate({"log": run.config.get("log", {})})
    except ValueError as error:
        raise KalmarkError(
            f"batch solution: the run's configuration does not say how to read its log: {error}"
        ) from None
    return open_config_log(config, run.log.path)


def _or_none(figure: Callable[[Array], Any], values: Array) -> float | None:
    return float(figure(values)) if len(values) else None


@contextmanager
def _telling(show: bool) -> Iterator[Callable[[int, float, float], None] | None]:
    """Yield what shows each iteration in a line on standard error, or None."""
    if not show:
        yield None
        return
    from rich.console import Console

    with Console(stderr=True).status("batch solution: first iteration") as status:

        def tell(iteration: int, chi2: float, size: float) -> None:
            status.update(f"batch solution: iteration {iteration}, chi2 {chi2:.6g}, step {size:.1e}")

        yield tell
