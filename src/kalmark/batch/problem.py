"""The least-squares problem of a whole log: residuals of sensors, surveys and the motion between poses.

Everything is vectorised over the whole log: one factor holds all the observations of one mounted sensor.  The motion is
carried as constraints with a covariance that may be singular: a held control has two errors for the three coordinates
of a pose, an exact start has none.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse as sp

from kalmark.arrays import Array, Flags
from kalmark.batch.batch_state import (
    LANDMARKS,
    POSE_SPACES,
    POSES,
    BatchState,
    Ints,
    plus,
    step_residuals,
)
from kalmark.events import Id
from kalmark.geometry.pose_frames import ORIGIN
from kalmark.geometry.spaces import POINT2, POINT3, Space
from kalmark.models.observe import innovations_and_jacobians
from kalmark.models.protocols import PLACES
from kalmark.slam.factors import BlockMeasurement, MeasuredBlock

DIFFERENCE = 1e-5  # m and rad


class Block(NamedTuple):
    """An argument of K residuals: the `rows` (K,) of a group, or of them the leading numbers that are of `space`."""

    group: int
    rows: Ints
    space: Space


@dataclass(frozen=True, eq=False)
class Term:
    """K residuals z (K, p) of `blocks`, and E (K, p, .): errors dx of the blocks leave z - E dx.

    `residuals` returns both for the values (K, size) of each block.
    """

    residuals: Callable[..., tuple[Array, Array]]
    blocks: tuple[Block, ...]

    def at(self, state: BatchState) -> tuple[Array, Array]:
        """Return the residuals and E at a state; NaN where a sensor does not see its target."""
        return self.residuals(*self._values(state))

    def jacobian(self, E: Array, state: BatchState) -> sp.csr_array:
        """Return E (K, p, .) as a sparse matrix (K p, size of a step)."""
        k, p, _ = E.shape
        return _sparse(E, np.arange(k * p).reshape(k, p), self._columns(state), (k * p, state.ends[-1]))

    def hessian(self, state: BatchState, weighed: Callable[[Array], Array]) -> sp.csr_array:
        """Return the derivative of the gradient -E' weighed(z), by central differences; symmetric, as turns are not."""
        values, columns = self._values(state), []
        for k, (x, block) in enumerate(zip(values, self.blocks, strict=True)):
            for step in DIFFERENCE * np.eye(block.space.dof):
                gradients = []
                for d in (step, -step):
                    moved = plus(block.space, x, np.tile(d, (len(x), 1)), np.zeros((len(x), 0)))
                    z, E = self.residuals(*values[:k], moved, *values[k + 1 :])
                    gradients.append(-np.einsum("kij,ki->kj", E, weighed(z)))
                columns.append((gradients[0] - gradients[1]) / (2 * DIFFERENCE))
        C, at = np.stack(columns, axis=2), self._columns(state)
        return _sparse(0.5 * (C + C.swapaxes(1, 2)), at, at, (state.ends[-1],) * 2)

    def _values(self, state: BatchState) -> list[Array]:
        return [state.groups[group][rows, : space.size] for group, rows, space in self.blocks]

    def _columns(self, state: BatchState) -> Ints:
        """Return where in a step the errors (K, .) of all blocks are."""
        return np.concatenate(
            [state.columns(b.group, b.rows)[:, None] + np.arange(b.space.dof) for b in self.blocks], 1
        )


class Rows(NamedTuple):
    """Whitened residuals z (k,), their Jacobian H (k, size of a step), and the sum of z^2, robust if the factor is."""

    z: Array
    H: sp.csr_array
    chi2: float


@dataclass(frozen=True, eq=False)
class Factor:
    """A term with independent noise `R` (K, p, p); residuals that are longer than `huber` when whitened count less.

    `y` (K, m) is what was measured, by a `sensor` of a robot with a `view` of the landmarks; ("", "") for a survey and
    between blocks.  `absolute`: y are positions.
    """

    term: Term
    y: Array
    R: Array
    huber: float = np.inf
    sensor: tuple[str, str] = ("", "")
    view: Any = None
    absolute: bool = False

    @property
    def is_survey(self) -> bool:
        """True of the positions of surveyed landmarks."""
        return self.absolute and self.term.blocks[0].group == LANDMARKS

    def rows(self, state: BatchState) -> Rows:
        """Return the whitened residuals and what they sum up to."""
        z, E = self.term.at(state)
        L_inverse = np.linalg.inv(np.linalg.cholesky(self.R))
        z, E = np.einsum("kij,kj->ki", L_inverse, z), L_inverse @ E
        length = np.sqrt(np.sum(z**2, axis=1))
        inside = np.minimum(length, self.huber)
        if (length > self.huber).any():
            root = np.sqrt(self.huber / np.maximum(length, self.huber))[:, None]
            z, E = root * z, root[:, :, None] * E
        return Rows(z.ravel(), self.term.jacobian(E, state), float(inside @ (2 * length - inside)))

    def hessian(self, state: BatchState) -> sp.csr_array:
        """Return the second derivative of |z|^2 / 2, not robust."""
        weights = np.asarray(np.linalg.inv(self.R), dtype=np.float64)
        return self.term.hessian(state, lambda z: np.einsum("kij,kj->ki", weights, z))


def observation_factor(
    view: Any, blocks: tuple[Block, ...], y: Array, R: Array, huber: float, sensor: tuple[str, str]
) -> Factor:
    """Return what a mounted sensor measured, y (K, m) with noise R (K, p, p).  [S] (63).

    `view` is its observation model (`kalmark.models.observe`); the blocks are the poses, its mount if that is unknown,
    and the targets, landmarks or the positions of other poses.
    """

    def residuals(*values: Array) -> tuple[Array, Array]:
        return innovations_and_jacobians(view, np.concatenate(values[:-1], axis=1), values[-1], y)

    return Factor(Term(residuals, blocks), y, R, huber, sensor, view)


def positions(group: int, rows: Ints, y: Array, R: Array) -> Factor:
    """Return absolute positions y (K, d) with noise R (K, d, d) of rows (K,) of a group."""
    E, space = np.tile(np.eye(y.shape[1]), (len(y), 1, 1)), POINT2 if y.shape[1] == 2 else POINT3
    return Factor(Term(lambda p: (y - p, E), (Block(group, rows, space),)), y, R, absolute=True)


def between(sensor: Any, blocks: tuple[Block, ...], models: Sequence[Any], y: Array, R: Array) -> Factor:
    """Return what a sensor of blocks measured, y (K, m) with noise R (K, m, m), of landmarks of the `models`.

    The model of a pose is None.
    """
    angular, places = np.array(sensor.angular, dtype=np.bool_), sensor.views == PLACES

    def residuals(*values: Array) -> tuple[Array, Array]:
        found = []
        for k, x in enumerate(zip(*values, strict=True)):
            of = BlockMeasurement([], sensor.expect, y[k], R[k], angular, type(sensor).__name__, places)
            parts = [MeasuredBlock(0, b.space, x_b, of_b) for b, x_b, of_b in zip(blocks, x, models, strict=True)]
            e, G = of.linearize(parts, x)
            found.append((of.residual(y[k], e), G))
        return np.array([z for z, _ in found]), np.array([G for _, G in found])

    return Factor(Term(residuals, blocks), y, R)


def _sparse(E: Array, row: Ints, column: Ints, shape: tuple[int, int]) -> sp.csr_array:
    """Return the sparse sum of the matrices E (K, p, q) at rows (K, p) and columns (K, q)."""
    at = np.broadcast_to(row[:, :, None], E.shape).ravel(), np.broadcast_to(column[:, None, :], E.shape).ravel()
    return sp.csr_array(sp.coo_array((E.ravel(), at), shape=shape))


@dataclass(frozen=True, eq=False)
class Motions:
    """The errors w (n, q) of the robots' motion as the residuals of `term`, of which w = root e + systematic s.

    The e (r,) are white, each of one of the `kinds`, the s (K,) are named by `errors`.
    """

    term: Term
    root: sp.csr_array
    kinds: list[str]
    systematic: Array
    errors: tuple[Any, ...]

    @cached_property
    def Q(self) -> sp.csr_array:
        """The covariance (q n, q n) of the errors."""
        return sp.csr_array(self.root @ self.root.T)


def motionless(size: int) -> Motions:
    """Return the motion of poses (n, size) that have none."""
    return motions(np.zeros(0, dtype=np.int64), np.zeros((0, size)), sp.csr_array((0, 0)), [], np.zeros((0, 0)), ())


def motions(
    previous: Ints, step: Array, root: sp.csr_array, kinds: list[str], systematic: Array, errors: tuple[Any, ...]
) -> Motions:
    """Return the motion of all robots: pose i follows pose `previous[i]` (-1: the origin, for a start) by `step[i]`.

    The steps (n, 3) or (n, 7) are in the frames of the previous poses, and so are their errors.  Steps that share a
    held control have columns of the `root` (q n, r) of their covariance in common.
    """
    started, space = previous >= 0, POSE_SPACES[step.shape[1]]

    def residuals(a: Array, b: Array) -> tuple[Array, Array]:
        w, W = step_residuals(np.where(started[:, None], a, ORIGIN[space.size]), b, step)
        W[~started, :, : space.dof] = 0.0
        return w, -W

    blocks = Block(POSES, np.where(started, previous, 0), space), Block(POSES, np.arange(len(step)), space)
    return Motions(Term(residuals, blocks), root, kinds, systematic, errors)


class Linearized(NamedTuple):
    """A problem at a state: whitened residuals z and H, their `chi2`, the motion's errors w and their Jacobian J."""

    state: BatchState
    z: Array
    H: sp.csr_array
    chi2: float
    w: Array
    J: sp.csr_array


@dataclass(frozen=True, eq=False)
class Problem:
    """Minimise the whitened residuals + w' Q^+ w, w the errors of the motion, which must lie in the range of Q.

    `free` marks the numbers of a step that are unknown; the others are held.  The search begins at `start`.  `ids` name
    the landmarks, of `kind`, and `nodes` (S,) are the poses at the scans of the log; `robots` (n,) are those of all
    poses.
    """

    motions: Motions
    factors: tuple[Factor, ...]
    free: Flags
    start: BatchState
    ids: list[Id]
    nodes: Ints
    robots: list[str]
    kind: str

    def at(self, state: BatchState) -> Linearized:
        """Return the problem linearised at a state."""
        rows = [factor.rows(state) for factor in self.factors]
        z = np.concatenate([np.empty(0), *(r.z for r in rows)])
        H = sp.vstack([sp.csr_array((0, state.ends[-1])), *(r.H for r in rows)], format="csr")
        w, E = self.motions.term.at(state)
        J = self.motions.term.jacobian(-E, state)
        return Linearized(state, z, H, sum(r.chi2 for r in rows), w.ravel(), J)

    def hessian(self, state: BatchState, multipliers: Array) -> sp.csr_array:
        """Return the second derivative of the Lagrangian |z|^2 / 2 + m' w."""
        total = self.motions.term.hessian(state, lambda w: multipliers.reshape(w.shape))
        for factor in self.factors:
            total = sp.csr_array(total + factor.hessian(state))
        return total

    def left(self, state: BatchState) -> list[tuple[str, Array]]:
        """Return what a state leaves of each sensor's measurements, (K, p); NaN where a landmark is not in view."""
        return [(factor.sensor[1], factor.term.at(state)[0]) for factor in self.factors if factor.sensor[1]]
