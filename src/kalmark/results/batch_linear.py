"""One linear step of the batch solution: the Karush-Kuhn-Tucker system, solved by elimination of the path.

The step dx and the multipliers m of `minimise |z - H dx|^2 + w' Q^+ w subject to w = e + J dx` solve

    [[A, J'], [J, -Q]] [dx; m] = [H'z; -e],      w = Q m,      A = H'H  (Newton: plus the curvature),

which needs no inverse of Q, so that Q may be singular.  The poses and multipliers form a chain in time, which a sparse
LU eliminates; what is left is the dense Schur complement S on the points, whose inverse is their covariance.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import scipy.linalg as la
import scipy.sparse as sp
from scipy.sparse.linalg import splu

from kalmark.errors import KalmarkError
from kalmark.results.batch_factors import State
from kalmark.results.batch_problem import Problem

Array = npt.NDArray[np.float64]
CHUNK = 128  # columns of the Schur complement at once: bounds the memory
FLAT = 1e-12  # least ratio of the squared pivots of S: below, a direction is not determined


class Step(NamedTuple):
    """A step of the poses (n, q) and of the points (m, d), and the multipliers (q n,) after it."""

    poses: Array
    points: Array
    multipliers: Array


class _Reduced(NamedTuple):
    """The system after elimination of the path: S x = g for the free points; `lu`, `rhs`, `coupling` lead back."""

    S: Array
    g: Array
    lu: Any
    rhs: Array
    coupling: sp.csr_array


def gauss_newton(problem: Problem, state: State) -> Step:
    """Return the step to the optimum of the linearised problem.  Raises KalmarkError if something is not determined."""
    return _step(problem, state, None)


def newton(problem: Problem, state: State, multipliers: Array) -> Step:
    """Return the Newton step on the Lagrangian.  Raises KalmarkError where that has no minimum."""
    return _step(problem, state, multipliers)


def covariance(problem: Problem, state: State) -> Array:
    """Return the joint covariance (d m, d m) of all points, the inverse of S; zero where a point is known exactly."""
    free = np.flatnonzero(_free(problem, state))
    P = np.zeros((state.points.size,) * 2)
    if len(free):
        P[np.ix_(free, free)] = la.cho_solve(_factored(_reduced(problem, state, None).S), np.eye(len(free)))
    return P


def _step(problem: Problem, state: State, multipliers: Array | None) -> Step:
    n, q = len(state.poses), state.q
    S, g, lu, rhs, coupling = _reduced(problem, state, multipliers)
    d_l = la.cho_solve(_factored(S), g) if len(g) else g
    x, points = np.empty(2 * q * n), np.zeros(state.points.size)
    x[_interleaved(n, q)] = lu.solve(rhs - coupling @ d_l)
    points[_free(problem, state)] = d_l
    return Step(x[: q * n].reshape(n, q), points.reshape(state.points.shape), x[q * n :])


def _reduced(problem: Problem, state: State, multipliers: Array | None) -> _Reduced:
    path = state.q * len(state.poses)
    z, H = problem.sighted(state)
    e, J = problem.constraints(state.poses)
    A = sp.csr_array(H.T @ H)
    if multipliers is not None:
        A = sp.csr_array(A + problem.curvature(state, multipliers))
    points = path + np.flatnonzero(_free(problem, state))
    order = _interleaved(len(state.poses), state.q)
    kkt = sp.block_array([[A[:path, :path], J.T], [J, -problem.Q]], format="csc")[order][:, order]
    coupling = sp.vstack([A[:path, points], sp.csr_array((path, len(points)))], format="csr")[order]
    try:
        lu = splu(sp.csc_matrix(kkt), permc_spec="COLAMD", diag_pivot_thresh=0.1)
    except RuntimeError:
        raise KalmarkError("batch solution: the path is not determined by its motion and its sightings") from None
    S = A[points][:, points].toarray()
    for first in range(0, len(points), CHUNK):
        columns = slice(first, first + CHUNK)
        S[:, columns] -= coupling.T @ lu.solve(coupling[:, columns].toarray())
    g = H.T @ z
    rhs = np.concatenate([g[:path], -e])[order]
    return _Reduced(S, g[points] - coupling.T @ lu.solve(rhs), lu, rhs, coupling)


def _factored(S: Array) -> tuple[Array, bool]:
    """Return the Cholesky factor of S as `cho_solve` takes it."""
    try:
        L, lower = la.cho_factor(0.5 * (S + S.T))
    except la.LinAlgError:
        L, lower = np.zeros((1, 1)), False
    pivots = np.diagonal(L) ** 2
    if not pivots.min() > FLAT * pivots.max():
        raise KalmarkError("batch solution: a landmark is not determined by its observations, expected more of them")
    return L, lower


def _free(problem: Problem, state: State) -> npt.NDArray[np.bool_]:
    return np.repeat(~problem.fixed, state.d)


def _interleaved(n: int, q: int) -> npt.NDArray[np.int64]:
    """Return the order that puts each node's multipliers behind its pose: the chain becomes a narrow band."""
    poses = np.arange(q * n).reshape(n, q)
    return np.concatenate([poses, q * n + poses], axis=1).ravel()
