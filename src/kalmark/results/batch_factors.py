"""What sensors and surveys say of a state of poses and points: whitened residuals, Jacobians, curvature.

Everything is vectorised over the whole log: one factor holds all the observations of one mounted sensor.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from kalmark.geometry.spaces import Space
from kalmark.results.batch_rows import POINTS, SPACES, looked, plus

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
DIFFERENCE = 1e-5  # m and rad


class State(NamedTuple):
    """Where everything is: poses of the nodes, (n, 3) in the plane or (n, 7) in space, and points (m, 2) or (m, 3).

    A step of the whole state has q numbers a pose, 3 or 6, then d a point, 2 or 3.
    """

    poses: Array
    points: Array

    @property
    def pose_space(self) -> Space:
        """SE2 or SE3."""
        return SPACES[self.poses.shape[1]]

    @property
    def point_space(self) -> Space:
        """The space of the points."""
        return POINTS[self.points.shape[1]]

    @property
    def q(self) -> int:
        """Numbers in the error of a pose."""
        return self.pose_space.dof

    @property
    def d(self) -> int:
        """Numbers in a position."""
        return self.points.shape[1]

    @property
    def size(self) -> int:
        """Numbers in a step."""
        return self.q * len(self.poses) + self.points.size

    def places(self) -> Array:
        """Return the positions (n + m, d) of the nodes and points."""
        return np.concatenate([self.poses[:, : self.d], self.points])

    def columns(self, place: Ints) -> Ints:
        """Return where in a step the positions of some of the `places` begin."""
        n = len(self.poses)
        return np.where(place < n, self.q * place, self.q * n + self.d * (place - n))


class Rows(NamedTuple):
    """Whitened residuals z (k,) and their Jacobian H (k, q n + d m), z - H dx being what a step dx leaves."""

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

    `view` is how the mounted sensor sees points (`kalmark.models.observe`), `node` (K,) are the poses, `target` (K,)
    says which of the state's `places` is sighted.
    """

    view: Any
    node: Ints
    target: Ints
    y: Array
    R: Array

    def rows(self, state: State) -> Rows:
        """Return the whitened y - h(v), v the target in the sensor's frame.  [S] (63)."""
        z, E_r, E_l = looked(self.view, *self._seen(state), self.y)
        return _whitened(z, self.R, [(state.q * self.node, E_r), (state.columns(self.target), E_l)], state.size)

    def curvature(self, state: State) -> sp.csr_array:
        """Return what the Hessian has beside E' R^-1 E, by central differences of the gradient."""
        r, l = self._seen(state)
        E = np.concatenate(looked(self.view, r, l, self.y)[1:], axis=2)
        C = derivative(self._gradient, [state.pose_space, state.point_space], [r, l])
        C -= E.swapaxes(1, 2) @ np.linalg.solve(self.R, E)
        return pair_matrix(C, state.q * self.node, state.columns(self.target), state.q, state.size)

    def _gradient(self, r: Array, l: Array) -> Array:
        z, E_r, E_l = looked(self.view, r, l, self.y)
        weighed = np.linalg.solve(self.R, z[:, :, None])
        return -(np.concatenate([E_r, E_l], axis=2).swapaxes(1, 2) @ weighed)[:, :, 0]

    def _seen(self, state: State) -> tuple[Array, Array]:
        """Return the observing poses and the positions (K, d) of the targets."""
        return state.poses[self.node], state.places()[self.target]


@dataclass(frozen=True, eq=False)
class Positions:
    """Absolute positions `y` (K, d) with noise `R` (K, d, d) of some of the state's `places`, `target` (K,)."""

    target: Ints
    y: Array
    R: Array

    def rows(self, state: State) -> Rows:
        """Return the whitened y - p."""
        z = self.y - state.places()[self.target]
        E = np.tile(np.eye(state.d), (len(z), 1, 1))
        return _whitened(z, self.R, [(state.columns(self.target), E)], state.size)

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


def derivative(gradient: Callable[..., Array], spaces: Sequence[Space], at: Sequence[Array]) -> Array:
    """Return the derivative (K, p, p) of a gradient (K, p) by the errors of its arguments, made symmetric.

    `at` are the arguments, rows of the `spaces`.  Central differences; symmetric, since turns do not commute.
    """
    columns = []
    for k, (space, x) in enumerate(zip(spaces, at, strict=True)):
        for step in DIFFERENCE * np.eye(space.dof):
            shifted = (plus(space, x, np.tile(sign * step, (len(x), 1))) for sign in (1.0, -1.0))
            there, back = (gradient(*at[:k], moved, *at[k + 1 :]) for moved in shifted)
            columns.append((there - back) / (2 * DIFFERENCE))
    C = np.stack(columns, axis=2)
    return 0.5 * (C + C.swapaxes(1, 2))


def pair_matrix(C: Array, first: Ints, second: Ints, q: int, size: int) -> sp.csr_array:
    """Return the sparse sum of blocks C (K, p, p): q of their rows and columns at `first`, the others at `second`."""
    at = [(first, slice(None, q)), (second, slice(q, None))]
    return block_matrix([(row, column, C[:, i, j]) for row, i in at for column, j in at], (size, size))


def _whitened(z: Array, R: Array, blocks: list[tuple[Ints, Array]], size: int) -> Rows:
    """Divide residuals and Jacobians by the Cholesky factor of R."""
    k, m = z.shape
    L_inverse = np.linalg.inv(np.linalg.cholesky(R))
    row = m * np.arange(k)
    H = block_matrix([(row, column, L_inverse @ J) for column, J in blocks], (m * k, size))
    return Rows(np.einsum("kij,kj->ki", L_inverse, z).ravel(), H)
