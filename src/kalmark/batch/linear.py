"""One linear step of the batch solution: the Karush-Kuhn-Tucker system, solved by elimination of the path.

The step dx and the multipliers m of `minimise |z - H dx|^2 + w' Q^+ w subject to w = e + J dx` solve

    [[A, J'], [J, -Q]] [dx; m] = [H'z; -e],      w = Q m,      A = H'H  (Newton: the Hessian),

which needs no inverse of Q, so that Q may be singular.  The poses and multipliers form a chain in time, which a sparse
LU eliminates; without motion the poses are independent.  What is left is the dense Schur complement S on the landmarks
and mounts, whose inverse is their covariance.
"""

from __future__ import annotations

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp
from scipy.sparse.linalg import splu

from kalmark.batch.problem import Linearized, Problem
from kalmark.batch.state import LANDMARKS, POSES, Array
from kalmark.errors import KalmarkError

CHUNK = 128  # columns of the Schur complement at once: bounds the memory
FLAT = 1e-12  # least ratio of a squared pivot of S to the information of its block: below, it is not determined


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
                "batch solution: the path is not determined by its motion and its sightings"
            ) from None
        g = at.H.T @ at.z
        self.rhs = np.concatenate([g[self.path], -at.w])[self.order]
        self.S, self.g = A[self.rest][:, self.rest].toarray(), g[self.rest] - self.coupling.T @ self.lu.solve(self.rhs)
        for first in range(0, len(self.rest), CHUNK):
            columns = slice(first, first + CHUNK)
            self.S[:, columns] -= self.coupling.T @ self.lu.solve(self.coupling[:, columns].toarray())

    def step(self) -> tuple[Array, Array]:
        """Return the step of the whole state and the multipliers after it.  Raises UndeterminedError."""
        d_l, x, step = self._solved(self.g), np.empty(len(self.order)), np.zeros(self.state.ends[-1])
        x[self.order] = self.lu.solve(self.rhs - self.coupling @ d_l)
        step[self.path], step[self.rest] = x[: len(self.path)], d_l
        return step, x[len(self.path) :]

    def covariances(self) -> Array:
        """Return the covariances (m, dof, dof) of the landmarks: blocks of the inverse of S, zero where held."""
        m, dof, end = len(self.state.groups[LANDMARKS]), self.state.spaces[LANDMARKS].dof, self.state.ends[POSES]
        P, at = np.zeros((self.state.ends[-1] - end,) * 2), self.rest - end
        P[np.ix_(at, at)] = self._solved(np.eye(len(at)))
        return P[: m * dof, : m * dof].reshape(m, dof, m, dof)[np.arange(m), :, np.arange(m)]

    def _solved(self, b: Array) -> Array:
        """Return S^-1 b."""
        if not len(b):
            return b
        try:
            L, lower = la.cho_factor(0.5 * (self.S + self.S.T))
        except la.LinAlgError:
            L, lower = np.zeros((1, 1)), False
        if not (np.diagonal(L) ** 2 > FLAT * self.information).all():
            what = f"a {self.kind} is not determined, the sightings do not determine all poses and {self.kind}s"
            raise UndeterminedError(f"batch solution: {what}: expected more of them")
        x: Array = la.cho_solve((L, lower), b)
        return x
