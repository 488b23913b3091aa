"""The optimum of a problem by Gauss-Newton, by Newton's method where that is slow, or by Levenberg's method.

A step is taken along the exponential: a stretch of the path that turns takes its observed landmarks along.  With motion
it is halved until the merit falls, which is the cost plus an exact penalty on the constraints (Nocedal & Wright,
Numerical Optimization, 18.3).  Large residuals make Gauss-Newton slow: where it lowers the merit little, the steps use
the curvature.

The step dx and the multipliers m of `minimise |z - H dx|^2 + w' Q^+ w subject to w = e + J dx` solve

    [[A, J'], [J, -Q]] [dx; m] = [H'z; -e],      w = Q m,      A = H'H  (Newton: the Hessian),

which needs no inverse of Q, so that Q may be singular.  The poses and multipliers form a chain in time, which a sparse
LU eliminates; without motion the poses are independent.  The remainder is the dense Schur complement S on the landmarks
and mounts, whose inverse is their covariance.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp
from scipy.sparse.linalg import splu
from threadpoolctl import threadpool_limits

from kalmark.arrays import Array
from kalmark.batch.batch_state import LANDMARKS, POSES, BatchState, Ints, unsolvable_problem
from kalmark.batch.problem import Linearized, Problem
from kalmark.errors import KalmarkError
from kalmark.events import Id

NEAR = 1e-2  # relative step below which Newton's method is tried, and share of the merit, if a step was shortened
ROUNDING = 1e-6  # relative step below which the cost does not distinguish which of two states is better
DAMPING = 1e-4  # the first of Levenberg's method
CHUNK = 128  # columns of the Schur complement at once: bounds the memory
KEPT = 10_000_000  # numbers of what the path makes of landmarks and mounts, up to which they are kept for each solution
FLAT = 1e-12  # least ratio of a squared pivot of S to the information of its block: below, it is not determined


@dataclass(frozen=True, eq=False)
class Batch:
    """The optimum of a log's data: its state, with a pose `nodes` (S,) for each scan and the landmarks `ids`.

    `joint` (m dof, m dof) is the covariance of the landmarks, `chi2` is the sum of squared whitened residuals (motion
    included), `dof` their number less what they determine, `relative_step` the last one over the map's size.
    """

    ids: list[Id]
    nodes: Ints
    state: BatchState
    joint: Array
    chi2: float
    dof: int
    iterations: int
    relative_step: float

    @property
    def poses(self) -> Array:
        """The poses (S, 3) or (S, 7) at the scans."""
        return self.state.groups[POSES][self.nodes]

    @property
    def means(self) -> Array:
        """The landmarks (m, size)."""
        return self.state.groups[LANDMARKS]

    @cached_property
    def covariances(self) -> Array:
        """The covariances (m, dof, dof) of the landmarks."""
        return _blocks(self.joint, len(self.means))

    def sigma(self) -> Array:
        """Return the sigma (m,) of each landmark's position: the root of its covariance's trace, in metres."""
        d = self.state.d
        return np.sqrt(np.trace(self.covariances[:, :d, :d], axis1=1, axis2=2))


def optimum(
    problem: Problem,
    start: BatchState | None = None,
    *,
    iterations: Iterable[int] = range(1, 101),
    tolerance: float = 1e-9,
) -> Batch:
    """Find the maximum-likelihood path and map: O(steps) and O(landmarks^3) each of the `iterations`.

    Ends when a step is below `tolerance` of the map's size, and in radians.  Raises KalmarkError if the start does not
    show what was seen, if something is not determined, or if the iterations do not suffice.
    """
    search = _Search(problem, problem.start if start is None else start)
    with threadpool_limits(1):
        for iteration in iterations:
            search.advance()
            if search.size < tolerance or search.flat:
                at, P = search.at, Reduced(problem, search.at).joint()
                chi2, dof = 2 * search.cost(at, search.multipliers), len(at.z) + len(at.w) - int(problem.free.sum())
                return Batch(problem.ids, problem.nodes, at.state, P, chi2, dof, iteration, search.size)
    raise unsolvable_problem(f"the last of {iteration} steps is {search.size:.3g} of the map, expected {tolerance:g}")


class _Search:
    """State of the search: the problem there, the multipliers (w,) of the motion, the penalties (w,) on its violation.

    Each constraint has its own penalty: one whose multiplier is small, a motion that is not known, hinders no step.
    `slow` if Newton's method is to be tried.
    """

    def __init__(self, problem: Problem, start: BatchState) -> None:
        _refuse_hidden(problem, start)
        self.problem, self.at, self.size = problem, problem.at(start), np.inf
        self.damping, self.flat, self.slow = 0.0 if len(self.at.w) else DAMPING, False, False
        self.multipliers, self.penalty = np.zeros((2, len(self.at.w)))
        self.followers = followers(self.at)

    def advance(self) -> None:
        """Take one step, of Newton's method if slow and if that lowers the merit; without motion of Levenberg's."""
        if self.damping:
            lower = self._take(Reduced(self.problem, self.at, damping=self.damping), shortest=1.0)
            self.damping = 0.1 * self.damping if lower else max(10 * self.damping, 1e-9)
            self.flat = self.size < ROUNDING and not lower
            return
        if self.slow:
            with suppress(UndeterminedError):
                if self._take(Reduced(self.problem, self.at, self.multipliers)):
                    return
        if not self._take(Reduced(self.problem, self.at)):
            raise unsolvable_problem("no step lowers the cost, expected a better start or fewer outliers")

    def cost(self, at: Linearized, multipliers: Array) -> float:
        """Return half the sum of squared residuals: of the factors, and of the motion's errors w = Q m."""
        return 0.5 * at.chi2 + 0.5 * float(multipliers @ (self.problem.motions.Q @ multipliers))

    def _take(self, reduced: Reduced, shortest: float = 1e-6) -> bool:
        """Go the longest of 1, 1/2, 1/4, ... `shortest` of a step that lowers the merit; return whether there is."""
        step, multipliers = reduced.step()
        change, self.size = multipliers - self.multipliers, self.at.state.relative(step)
        self.penalty = np.maximum(self.penalty, 1.5 * np.abs(multipliers))
        now, fraction = self._merit(self.at, self.multipliers), 1.0
        while fraction >= shortest:
            at = self.problem.at(self.at.state.moved(fraction * step, self.followers))
            there = self.multipliers + fraction * change
            merit = self._merit(at, there)
            if merit < now or (self.size < ROUNDING and not self.damping):  # NaN is not lower
                self.at, self.multipliers = at, there
                self.slow = self.size < NEAR or (fraction < 1.0 and now - merit < NEAR * now)
                return True
            fraction /= 2
        return False

    def _merit(self, at: Linearized, multipliers: Array) -> float:
        return self.cost(at, multipliers) + float(self.penalty @ np.abs(at.w - self.problem.motions.Q @ multipliers))


def _refuse_hidden(problem: Problem, start: BatchState) -> None:
    """Raise KalmarkError if a state does not show a sensor what it saw."""
    for factor in problem.factors:
        hidden = np.flatnonzero(np.isnan(factor.term.at(start)[0]).any(axis=1))
        if len(hidden):
            node, *_, target = (int(block.rows[hidden[0]]) for block in factor.term.blocks)
            known = factor.term.blocks[-1].group == LANDMARKS
            what = f"{problem.kind if known else 'pose'} {problem.ids[target] if known else target}"
            what += f" to {factor.sensor[1]} at pose {node}"
            raise unsolvable_problem(f"the start does not show {what}, which saw it")


def followers(at: Linearized) -> sp.csr_array:
    """Return (m, n): for each landmark the weights, summing to 1, of the poses that see it."""
    (path, end), (pose, landmark) = at.state.ends[:2], at.state.spaces[:2]
    shape = len(at.state.groups[LANDMARKS]), len(at.state.groups[POSES])
    seen = sp.csr_array((np.ones(at.H.nnz), at.H.indices, at.H.indptr), shape=at.H.shape)
    together = sp.coo_array(seen[:, path:end].T @ seen[:, :path])
    weights = sp.coo_array((together.data, (together.row // landmark.dof, together.col // pose.dof)), shape=shape)
    total: Array = np.asarray(weights.sum(axis=1)).ravel()
    return sp.csr_array(sp.diags_array(1.0 / np.maximum(total, 1.0)) @ weights)


class UndeterminedError(KalmarkError):
    """The observations do not determine everything, or Newton's method has no minimum."""


class Reduced:
    """A linearised problem with its path eliminated: S x = g for the free numbers of landmarks and mounts.

    With `multipliers` it is Newton's, on the Lagrangian; `damping` is Levenberg's.  Raises UndeterminedError.
    """

    def __init__(
        self, problem: Problem, at: Linearized, multipliers: Array | None = None, damping: float = 0.0
    ) -> None:
        free, end = np.flatnonzero(problem.free), at.state.ends[POSES]
        self.kind, self.state, self.path, self.rest = problem.kind, at.state, free[free < end], free[free >= end]
        A = sp.csr_array(at.H.T @ at.H) if multipliers is None else problem.hessian(at.state, multipliers)
        if damping:
            A = sp.csr_array(A + sp.diags_array(damping * A.diagonal()))
        largest = [np.repeat(part.max(axis=1), part.shape[1]) for part in at.state.parts(A.diagonal())]
        self.information = np.concatenate(largest)[self.rest]
        A_path, J, q = A[self.path], at.J[:, self.path], at.state.spaces[POSES].dof
        nodes = np.concatenate([self.path // q, np.arange(len(at.w)) // q])
        self.order = np.argsort(nodes, kind="stable")  # multipliers behind their poses: a narrow band
        kkt = sp.block_array([[A_path[:, self.path], J.T], [J, -problem.motions.Q]], format="csc")
        self.coupling = sp.vstack([A_path[:, self.rest], sp.csr_array((len(at.w), len(self.rest)))], format="csr")[
            self.order
        ]
        try:
            self.lu = splu(sp.csc_matrix(kkt[self.order][:, self.order]), permc_spec="COLAMD", diag_pivot_thresh=0.1)
        except RuntimeError:
            raise UndeterminedError(
                "batch solution: the path is not determined by its motion and its observations"
            ) from None
        self.at, self.S = at, A[self.rest][:, self.rest].toarray()
        self.through = np.empty(self.coupling.shape if math.prod(self.coupling.shape) <= KEPT else (0, 0))
        for first in range(0, len(self.rest), CHUNK):
            columns = slice(first, first + CHUNK)
            solved = self.lu.solve(self.coupling[:, columns].toarray())
            self.S[:, columns] -= self.coupling.T @ solved
            if self.through.size:
                self.through[:, columns] = solved

    def step(self) -> tuple[Array, Array]:
        """Return the step (N,) of the whole state and the multipliers after it.  Raises UndeterminedError."""
        return self.solved(self.at.z, self.at.w)

    def solved(self, z: Array, w: Array) -> tuple[Array, Array]:
        """Return the step (N, ...) and the multipliers for whitened residuals z and errors w of the motion, (., ...).

        Raises UndeterminedError.
        """
        g = self.at.H.T @ z
        rhs = np.concatenate([g[self.path], -w])[self.order]
        alone = self.lu.solve(rhs)
        d_l = self._solved(g[self.rest] - self.coupling.T @ alone)
        x, step = np.empty_like(rhs), np.zeros_like(g)
        x[self.order] = alone - self.through @ d_l if self.through.size else self.lu.solve(rhs - self.coupling @ d_l)
        step[self.path], step[self.rest] = x[: len(self.path)], d_l
        return step, x[len(self.path) :]

    def covariances(self) -> Array:
        """Return the covariances (m, dof, dof) of the landmarks: blocks of the inverse of S, zero where held."""
        return _blocks(self.joint(), len(self.state.groups[LANDMARKS]))

    def joint(self) -> Array:
        """Return the joint covariance (m dof, m dof) of the landmarks: the inverse of S, zero where held."""
        end = self.state.ends[POSES]
        P, at = np.zeros((self.state.ends[-1] - end,) * 2), self.rest - end
        P[np.ix_(at, at)] = self._solved(np.eye(len(at)))
        size = self.state.ends[LANDMARKS] - end
        return P[:size, :size]

    @cached_property
    def factor(self) -> tuple[Array, bool]:
        """The Cholesky factor of S.  Raises UndeterminedError."""
        try:
            L, lower = la.cho_factor(0.5 * (self.S + self.S.T))
        except la.LinAlgError:
            L, lower = np.zeros((1, 1)), False
        if not (np.diagonal(L) ** 2 > FLAT * self.information).all():
            what = f"a {self.kind} is not determined, the observations do not determine all poses and {self.kind}s"
            raise UndeterminedError(f"batch solution: {what}: expected more of them")
        return L, lower

    def _solved(self, b: Array) -> Array:
        """Return S^-1 b.  Raises UndeterminedError."""
        if not len(b):
            return b
        x: Array = la.cho_solve(self.factor, b)
        return x


def _blocks(P: Array, m: int) -> Array:
    """Return the diagonal blocks (m, dof, dof) of P (m dof, m dof)."""
    dof = len(P) // max(m, 1)
    return P.reshape(m, dof, m, dof)[np.arange(m), :, np.arange(m)]
