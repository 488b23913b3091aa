"""What sensors and surveys say of a state of poses and points: whitened residuals, Jacobians, curvature.

Everything is vectorised over the whole log: one factor holds all the observations of one mounted sensor.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from kalmark.geometry.angles import wrap

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
DIFFERENCE = 1e-5  # m and rad


class State(NamedTuple):
    """Where everything is: poses (n, 3) = (x, y, theta) of the nodes and points (m, 2)."""

    poses: Array
    points: Array


class Rows(NamedTuple):
    """Whitened residuals z (k,) and their Jacobian H (k, 3 n + 2 m), z - H dx being what a step dx leaves."""

    z: Array
    H: sp.csr_array


class Factor(Protocol):
    """Whatever says something of the state with independent, regular noise."""

    def rows(self, state: State) -> Rows:
        """Return the whitened residuals at `state` and the Jacobian of what is expected."""

    def curvature(self, state: State) -> sp.csr_array | None:
        """Return what the Hessian of |z|^2 / 2 has beside H'H, or None for nothing."""


@dataclass(frozen=True, eq=False)
class Sightings:
    """What one mounted sensor measured: K observations `y` (K, m) with noise `R` (K, m, m).

    `node` (K,) is the pose, `target` (K,) the column of the state where the sighted position (x, y) begins.
    """

    sensor: Any
    mount: Array
    node: Ints
    target: Ints
    y: Array
    R: Array

    def rows(self, state: State) -> Rows:
        """Return the whitened y - h(v), v the target in the sensor's frame.  [S] (63)."""
        z, E = self._linearised(*self._seen(state))
        return _whitened(z, self.R, [(3 * self.node, E[:, :, :3]), (self.target, E[:, :, 3:])], size_of(state))

    def curvature(self, state: State) -> sp.csr_array:
        """Return what the Hessian has beside E' R^-1 E, by central differences of the gradient."""
        r, l = self._seen(state)
        E = self._linearised(r, l)[1]
        C = -E.swapaxes(1, 2) @ np.linalg.solve(self.R, E)
        for c, d in enumerate(DIFFERENCE * np.eye(5)):
            there, back = self._gradient(r + d[:3], l + d[3:]), self._gradient(r - d[:3], l - d[3:])
            C[:, :, c] += (there - back) / (2 * DIFFERENCE)
        C = 0.5 * (C + C.swapaxes(1, 2))
        at = [(3 * self.node, slice(0, 3)), (self.target, slice(3, 5))]
        return block_matrix([(row, column, C[:, i, j]) for row, i in at for column, j in at], (size_of(state),) * 2)

    def _gradient(self, r: Array, l: Array) -> Array:
        z, E = self._linearised(r, l)
        return -np.einsum("kmi,km->ki", E, np.linalg.solve(self.R, z[:, :, None])[:, :, 0])

    def _seen(self, state: State) -> tuple[Array, Array]:
        """Return the observing poses (K, 3) and the positions of the targets (K, 2)."""
        flat = np.concatenate([state.poses.ravel(), state.points.ravel()])
        return state.poses[self.node], np.stack([flat[self.target], flat[self.target + 1]], axis=1)

    def _linearised(self, r: Array, l: Array) -> tuple[Array, Array]:
        """Return y - h(v) (K, m) and E (K, m, 5) with respect to poses and targets.  [S] (56), (63), batched."""
        turned = rotations(-self.mount[2:3])[0]
        to_sensor = rotations(-r[:, 2] - self.mount[2])
        v = np.einsum("kij,kj->ki", to_sensor, l - r[:, :2])
        V = np.concatenate([-to_sensor, np.stack([v[:, 1], -v[:, 0]], axis=1)[:, :, None], to_sensor], axis=2)
        e, E_v = self.sensor.expect(v - turned @ self.mount[:2])
        z = self.y - e
        angular = np.asarray(self.sensor.angular, dtype=bool)
        z[:, angular] = wrap(z[:, angular])
        return z, E_v @ V


@dataclass(frozen=True, eq=False)
class Positions:
    """Absolute positions `y` (K, 2) with noise `R` (K, 2, 2) of whatever begins at the columns `target` (K,)."""

    target: Ints
    y: Array
    R: Array

    def rows(self, state: State) -> Rows:
        """Return the whitened y - p."""
        flat = np.concatenate([state.poses.ravel(), state.points.ravel()])
        z = self.y - np.stack([flat[self.target], flat[self.target + 1]], axis=1)
        return _whitened(z, self.R, [(self.target, np.tile(np.eye(2), (len(z), 1, 1)))], size_of(state))

    def curvature(self, state: State) -> None:
        """Return None: positions are linear."""


def block_matrix(blocks: list[tuple[Ints, Ints, Array]], shape: tuple[int, int]) -> sp.csr_array:
    """Return the sparse sum of dense blocks (K, p, q), the k-th at (row[k], column[k])."""
    rows, columns, values = [], [], []
    for row, column, block in blocks:
        p, q = block.shape[1:]
        rows.append(np.broadcast_to(row[:, None, None] + np.arange(p)[:, None], block.shape).ravel())
        columns.append(np.broadcast_to(column[:, None, None] + np.arange(q), block.shape).ravel())
        values.append(block.ravel())
    at = np.concatenate(rows), np.concatenate(columns)
    return sp.csr_array(sp.coo_array((np.concatenate(values), at), shape=shape))


def size_of(state: State) -> int:
    return state.poses.size + state.points.size


def rotations(angles: Array) -> Array:
    cos, sin = np.cos(angles), np.sin(angles)
    return np.stack([np.stack([cos, -sin], -1), np.stack([sin, cos], -1)], -2)


def _whitened(z: Array, R: Array, blocks: list[tuple[Ints, Array]], size: int) -> Rows:
    """Divide residuals and Jacobians by the Cholesky factor of R."""
    k, m = z.shape
    L_inverse = np.linalg.inv(np.linalg.cholesky(R))
    row = m * np.arange(k)
    H = block_matrix([(row, column, L_inverse @ J) for column, J in blocks], (m * k, size))
    return Rows(np.einsum("kij,kj->ki", L_inverse, z).ravel(), H)
