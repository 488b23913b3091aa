"""The least-squares problem of a whole log: poses at the scans, points, the motion between and the sightings.

The motion is carried as constraints with a covariance that may be singular: a held control has two errors for the three
coordinates of a pose, an exact start has none.  Poses are (n, 3) with q = 3 errors, or in space (n, 7) with q = 6.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from kalmark.results.batch_factors import Array, Factor, Ints, Rows, State, block_matrix, derivative, pair_matrix
from kalmark.results.batch_rows import ORIGIN, beyond


@dataclass(frozen=True, eq=False)
class Problem:
    """Minimise the whitened sightings + w' Q^+ w, w the errors of the steps, which must lie in the range of Q.

    Node i follows node `previous[i]` (-1: the map's origin, for a start) by `step[i]` in that node's frame; `Q`
    (q n, q n) is the covariance of all steps' errors in those frames, with blocks between steps that share a held
    control.  `fixed` (m,) are the points that are known exactly.
    """

    previous: Ints
    step: Array
    Q: sp.csr_array
    factors: tuple[Factor, ...]
    fixed: npt.NDArray[np.bool_]

    def errors(self, poses: Array) -> Array:
        """Return the motions that the poses imply, beyond the steps: the errors w (n, q)."""
        return beyond(self._before(poses), poses, self.step)[0]

    def constraints(self, poses: Array) -> tuple[Array, sp.csr_array]:
        """Return the errors w (q n,) and their Jacobian (q n, q n) with respect to the poses."""
        w, W_a, W_b = beyond(self._before(poses), poses, self.step)
        n, q = w.shape
        moved = self.previous >= 0
        here = q * np.arange(n)
        blocks = [(here, here, W_b), (here[moved], q * self.previous[moved], W_a[moved])]
        return w.ravel(), block_matrix(blocks, (q * n, q * n))

    def sighted(self, state: State) -> Rows:
        """Return all factors' whitened residuals and Jacobians."""
        parts = [factor.rows(state) for factor in self.factors]
        if not parts:
            return Rows(np.empty(0), sp.csr_array((0, state.size)))
        return Rows(np.concatenate([p.z for p in parts]), sp.vstack([p.H for p in parts], format="csr"))

    def curvature(self, state: State, multipliers: Array) -> sp.csr_array:
        """Return what the Hessian of the Lagrangian has beside the squared Jacobian: of sightings and constraints."""
        total = self._constraint_curvature(state, multipliers)
        for factor in self.factors:
            C = factor.curvature(state)
            total = total if C is None else sp.csr_array(total + C)
        return total

    def _constraint_curvature(self, state: State, multipliers: Array) -> sp.csr_array:
        """Return the Hessian of m' w."""
        moved = np.flatnonzero(self.previous >= 0)
        q = state.q
        m, step = multipliers.reshape(-1, q, 1)[moved], self.step[moved]

        def gradient(a: Array, b: Array) -> Array:
            _, W_a, W_b = beyond(a, b, step)
            return (np.concatenate([W_a, W_b], axis=2).swapaxes(1, 2) @ m)[:, :, 0]

        at = [state.poses[self.previous[moved]], state.poses[moved]]
        C = derivative(gradient, [state.pose_space] * 2, at)
        return pair_matrix(C, q * self.previous[moved], q * moved, q, state.size)

    def _before(self, poses: Array) -> Array:
        """Return the previous poses, the origin before a start."""
        return np.where((self.previous >= 0)[:, None], poses[self.previous], ORIGIN[poses.shape[1]])
