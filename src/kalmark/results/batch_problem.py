"""The least-squares problem of a whole log: poses at the scans, points, the motion between and the sightings.

The motion is carried as constraints with a covariance that may be singular: a held control has two errors for the three
coordinates of a pose, an exact start has none.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from kalmark.geometry.angles import wrap
from kalmark.results.batch_factors import Array, Factor, Ints, Rows, State, block_matrix, rotations, size_of


@dataclass(frozen=True, eq=False)
class Problem:
    """Minimise the whitened sightings + w' Q^+ w, w the errors of the steps, which must lie in the range of Q.

    Node i follows node `previous[i]` (-1: the map's origin, for a start) by `step[i]` in that node's frame; `Q`
    (3 n, 3 n) is the covariance of all steps' errors in those frames, with blocks between steps that share a held
    control.  `fixed` (m,) are the points that are known exactly.
    """

    previous: Ints
    step: Array
    Q: sp.csr_array
    factors: tuple[Factor, ...]
    fixed: npt.NDArray[np.bool_]

    def errors(self, poses: Array) -> Array:
        """Return the motions that the poses imply, minus the steps: the errors w (n, 3)."""
        a, d = self._relative(poses)
        error = d - self.step
        error[:, 2] = wrap(poses[:, 2] - a[:, 2] - self.step[:, 2])
        return error

    def constraints(self, poses: Array) -> tuple[Array, sp.csr_array]:
        """Return the errors w (3 n,) and their Jacobian (3 n, 3 n) with respect to the poses."""
        a, d = self._relative(poses)
        n = len(poses)
        cos, sin = np.cos(a[:, 2]), np.sin(a[:, 2])
        W_b = np.zeros((n, 3, 3))
        W_b[:, 0, 0], W_b[:, 0, 1], W_b[:, 1, 0], W_b[:, 1, 1], W_b[:, 2, 2] = cos, sin, -sin, cos, 1.0
        W_a = -W_b
        W_a[:, 0, 2], W_a[:, 1, 2] = d[:, 1], -d[:, 0]
        moved = self.previous >= 0
        row, here = 3 * np.arange(n), 3 * np.arange(n)
        blocks = [(row, here, W_b), (row[moved], 3 * self.previous[moved], W_a[moved])]
        return self.errors(poses).ravel(), block_matrix(blocks, (3 * n, 3 * n))

    def sighted(self, state: State) -> Rows:
        """Return all factors' whitened residuals and Jacobians."""
        parts = [factor.rows(state) for factor in self.factors]
        if not parts:
            return Rows(np.empty(0), sp.csr_array((0, size_of(state))))
        return Rows(np.concatenate([p.z for p in parts]), sp.vstack([p.H for p in parts], format="csr"))

    def curvature(self, state: State, multipliers: Array) -> sp.csr_array:
        """Return what the Hessian of the Lagrangian has beside the squared Jacobian: of sightings and constraints."""
        total = self._constraint_curvature(state, multipliers)
        for factor in self.factors:
            C = factor.curvature(state)
            total = total if C is None else sp.csr_array(total + C)
        return total

    def _constraint_curvature(self, state: State, multipliers: Array) -> sp.csr_array:
        """Return the Hessian of m' w, w = R(-theta_a) (p_b - p_a) for a node b after a."""
        moved = np.flatnonzero(self.previous >= 0)
        a, d = self._relative(state.poses)
        m = multipliers.reshape(-1, 3)[:, :2]
        C = np.zeros((len(a), 3, 6))  # by the previous pose a and by the pose b
        C[:, 2, 3:5] = np.einsum("kij,kj->ki", rotations(a[:, 2]), np.stack([-m[:, 1], m[:, 0]], axis=1))
        C[:, 2, :2] = C[:, :2, 2] = -C[:, 2, 3:5]
        C[:, 2, 2] = -np.sum(m * d[:, :2], axis=1)
        at_a, at_b, C_aa, C_ab = 3 * self.previous[moved], 3 * moved, C[moved, :, :3], C[moved, :, 3:]
        blocks = [(at_a, at_a, C_aa), (at_a, at_b, C_ab), (at_b, at_a, C_ab.swapaxes(1, 2))]
        return block_matrix(blocks, (size_of(state),) * 2)

    def _relative(self, poses: Array) -> tuple[Array, Array]:
        """Return the previous poses a and the nodes' positions and headings in their frames."""
        a = np.where((self.previous >= 0)[:, None], poses[self.previous], 0.0)
        d = poses - a
        d[:, :2] = np.einsum("kij,kj->ki", rotations(-a[:, 2]), d[:, :2])
        return a, d
