"""The maximum-likelihood path and points by Gauss-Newton, and by Newton's method once near the optimum.

A step is taken along the exponential: a stretch of the path that turns takes the points it sees along.  It is halved
until the merit falls, which is the cost plus an exact penalty on the constraints (Nocedal & Wright, Numerical
Optimization, 18.3).  Outliers make Gauss-Newton crawl, so the last steps count the curvature.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from kalmark.errors import KalmarkError
from kalmark.results.batch_factors import State
from kalmark.results.batch_linear import Step, covariance, gauss_newton, newton
from kalmark.results.batch_problem import Problem
from kalmark.results.batch_rows import plus

Array = npt.NDArray[np.float64]
NEAR = 1e-2  # relative step below which Newton's method is tried
ROUNDING = 1e-6  # relative step below which the cost cannot tell any more which of two states is better


@dataclass(frozen=True, eq=False)
class Solution:
    """The optimum: its state, the points' joint covariance (d m, d m), and how it was reached.

    `chi2` is the sum of squared whitened residuals, motion included; `relative_step` the last step over the map's size.
    """

    state: State
    covariance: Array
    chi2: float
    iterations: int
    relative_step: float


def minimise(
    problem: Problem,
    start: State,
    *,
    iterations: int = 100,
    tolerance: float = 1e-9,
    tell: Callable[[int, float, float], None] | None = None,
) -> Solution:
    """Iterate from `start` until a step is below `tolerance` of the map's size (and in radians); O(n) + O(m^3) each.

    `tell(iteration, chi2, relative step)` is called after each.  Raises KalmarkError if it does not converge.
    """
    search = _Search(problem, start)
    for iteration in range(1, iterations + 1):
        search.advance()
        if tell is not None:
            tell(iteration, search.chi2(), search.size)
        if search.size < tolerance:
            P = covariance(problem, search.state)
            return Solution(search.state, P, search.chi2(), iteration, search.size)
    raise KalmarkError(
        f"batch solution: the last of {iterations} steps is {search.size:.3g} of the map, expected {tolerance:g}"
    )


class _Search:
    """Where the search stands: the state, the multipliers of the motion, the penalty (q,) on its violation."""

    def __init__(self, problem: Problem, start: State) -> None:
        self.problem, self.state = problem, start
        self.multipliers, self.penalty = np.zeros(start.q * len(start.poses)), np.zeros(start.q)
        self.followers = _followers(problem, start)
        self.size = np.inf

    def advance(self) -> None:
        """Take one step, of Newton's method if near and if that lowers the merit."""
        if self.size < NEAR:
            try:
                self._take(newton(self.problem, self.state, self.multipliers))
            except KalmarkError:
                pass
            else:
                return
        self._take(gauss_newton(self.problem, self.state))

    def chi2(self) -> float:
        """Return twice the cost."""
        return 2 * self._cost(self.state, self.multipliers)

    def _take(self, step: Step) -> None:
        """Go the longest of 1, 1/2, 1/4, ... of the step that lowers the merit."""
        size = _relative(self.state, step)
        self.penalty = np.maximum(self.penalty, 1.5 * np.abs(step.multipliers).reshape(-1, self.state.q).max(axis=0))
        now, fraction = self._merit(self.state, self.multipliers), 1.0
        while fraction > 1e-6:
            state = _moved(self.state, step, fraction, self.followers)
            multipliers = self.multipliers + fraction * (step.multipliers - self.multipliers)
            if size < ROUNDING or self._merit(state, multipliers) < now:
                self.state, self.multipliers, self.size = state, multipliers, size
                return
            fraction /= 2
        raise KalmarkError("batch solution: no step lowers the cost, expected a better start or fewer outliers")

    def _cost(self, state: State, multipliers: Array) -> float:
        """Return half the sum of squared residuals: of the factors, and of the motion's errors w = Q m."""
        z = self.problem.sighted(state).z
        return float(0.5 * (z @ z) + 0.5 * (multipliers @ (self.problem.Q @ multipliers)))

    def _merit(self, state: State, multipliers: Array) -> float:
        defect = self.problem.errors(state.poses).ravel() - self.problem.Q @ multipliers
        return self._cost(state, multipliers) + float(self.penalty @ np.abs(defect).reshape(-1, state.q).sum(axis=0))


def _relative(state: State, step: Step) -> float:
    """Return the largest turn of a pose (rad), or shift over half the extent of the map (at least 1 m)."""
    extent = max(1.0, 0.5 * float(np.ptp(state.places(), axis=0).max()))
    shift = max(np.abs(step.poses[:, : state.d]).max(), np.abs(step.points).max(initial=0.0)) / extent
    return float(max(shift, np.abs(step.poses[:, state.d :]).max()))


def _moved(state: State, step: Step, fraction: float, followers: sp.csr_array) -> State:
    """Move along the exponential, x + V(dtheta) dx; a point turns with the poses that see it."""
    d, turns = fraction * step.poses, fraction * step.poses[:, state.d :]
    points = plus(state.point_space, state.points, fraction * step.points, followers @ turns)
    return State(plus(state.pose_space, state.poses, d, turns), points)


def _followers(problem: Problem, state: State) -> sp.csr_array:
    """Return (m, n): for each point the weights, summing to 1, of the poses that see it."""
    n, m = len(state.poses), len(state.points)
    H = problem.sighted(state).H
    path = state.q * n
    seen = sp.csr_array((np.ones(H.nnz), H.indices, H.indptr), shape=H.shape)
    together = sp.coo_array(seen[:, path:].T @ seen[:, :path])
    at = together.row // state.d, together.col // state.q
    weights = sp.csr_array(sp.coo_array((together.data, at), shape=(m, n)))
    total: Array = np.asarray(weights.sum(axis=1)).ravel()
    return sp.csr_array(sp.diags_array(1.0 / np.maximum(total, 1.0)) @ weights)
