"""The batch problem of a run, linear about its optimum: what noise and systematic errors leave of the data.

The data are the whitened residuals z of the sensors and the errors w of the motion (docs/batch.md).  The state takes up
what it can of them, (r, m) is left: r = z - H dx, and m the multipliers, with r'r + m'Qm the sum of squares.  Both are
linear in the data: a systematic error s that adds (Z, W) s to them is estimated by s = g / I with the score
g = Z'r + W'm and its information I = Z'r_Z + W'm_Z, (r_Z, m_Z) being what is left of (Z, W) itself.  Rao's score test;
Bar-Shalom, Li, Kirubarajan 2001, section 5.4, for the whiteness of residuals.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from scipy.spatial import cKDTree

from kalmark.arrays import Array, Flags
from kalmark.batch.batch_state import LANDMARKS, POSES, BatchState, Ints
from kalmark.batch.problem import Factor, Linearized, Problem
from kalmark.batch.solver import Reduced, followers

NONE = -1
OUT = 1e3  # times its noise: what is so uncertain does not count


class ResidualOrigins(NamedTuple):
    """Origin of each whitened residual (N,): factor and row there, column, landmark (-1: none) and node.

    `one` and `two` (P,) are the rows of successive observations of one landmark, by one sensor and column.
    """

    factor: Ints
    row: Ints
    column: Ints
    landmark: Ints
    node: Ints
    one: Ints
    two: Ints


class Left(NamedTuple):
    """Residuals of data, a column a set: r (N, ...) of the sensors, m (q n, ...) of the motion."""

    r: Array
    m: Array


@dataclass(frozen=True, eq=False)
class Linear:
    """A problem linearised at `base`, with some of it taken out of the data and its noise made larger or smaller.

    `noise` (N,) and `errors` (r,) are factors of the noise of the residuals and of the motion's errors, `z` (N,) and
    `w` (q n,) are what was taken out of the data, as whitened by the problem.  `within` are the factors of the noise
    of each sensor (robot, name) that a gate leaves, by column; all of it where there is none.
    """

    problem: Problem
    base: Linearized
    noise: Array
    errors: Array
    z: Array
    w: Array
    within: Mapping[tuple[str, str], Array]

    @classmethod
    def of(cls, problem: Problem, state: BatchState, within: Mapping[tuple[str, str], Array] | None = None) -> Linear:
        """Return the problem at a state, as it is."""
        at, r = problem.at(state), problem.motions.root.shape[1]
        none = np.zeros(len(at.z)), np.zeros(len(at.w))
        return cls(problem, at, np.ones(len(at.z)), np.ones(r), *none, within or {})

    @property
    def state(self) -> BatchState:
        """State of the linearisation."""
        return self.base.state

    def scaled(self, noise: Array | float, errors: Array | float) -> Linear:
        """Return it with the noise (N,) times and the motion's errors (r,) times as large."""
        return replace(self, noise=self.noise * noise, errors=self.errors * errors)

    def without(self, Z: Array, W: Array) -> Linear:
        """Return it with Z (N,), whitened as `at` is, and W (q n,) taken out of the data."""
        return replace(self, z=self.z + Z * self.noise, w=self.w + W)

    @cached_property
    def root(self) -> sp.csr_array:
        """The root (q n, r) of the covariance of the motion's errors."""
        return sp.csr_array(self.problem.motions.root @ sp.diags_array(self.errors))

    @cached_property
    def Q(self) -> sp.csr_array:
        """The covariance (q n, q n) of the motion's errors."""
        return sp.csr_array(self.root @ self.root.T)

    @cached_property
    def at(self) -> Linearized:
        """Residuals and Jacobians, whitened by the noise."""
        H = sp.csr_array(sp.diags_array(1.0 / self.noise) @ self.base.H)
        return self.base._replace(z=(self.base.z - self.z) / self.noise, H=H, w=self.base.w - self.w)

    @cached_property
    def reduced(self) -> Reduced:
        """The factorised problem."""
        return Reduced(replace(self.problem, motions=replace(self.problem.motions, root=self.root)), self.at)

    @cached_property
    def rows(self) -> ResidualOrigins:
        """Origin of each residual."""
        parts: list[tuple[Ints, ...]] = []
        for f, factor in enumerate(self.problem.factors):
            k, p, _ = factor.R.shape
            first, last = factor.term.blocks[0], factor.term.blocks[-1]
            on_map = last.group == LANDMARKS and bool(factor.sensor[1])
            node_ = first.rows if first.group == POSES else np.zeros(k, dtype=np.int64)
            of = (np.full(k, f), np.arange(k), last.rows if on_map else np.full(k, NONE), node_)
            factor_, row, landmark, node = (np.repeat(a, p) for a in of)
            parts.append((factor_, row, np.tile(np.arange(p), k), landmark, node))
        factor_, row, column, landmark, node = (np.concatenate(a) for a in zip(*parts, strict=True))
        order = np.lexsort((node, landmark, column, factor_))
        one, two = order[:-1], order[1:]
        same = (landmark[one] >= 0) & (node[two] > node[one])
        for of_ in (landmark, column, factor_):
            same &= of_[one] == of_[two]
        return ResidualOrigins(factor_, row, column, landmark, node, one[same], two[same])

    @cached_property
    def observations(self) -> Ints:
        """The number (N,) of the observation that each residual is a component of."""
        first = np.concatenate([[0], np.cumsum([len(f.R) for f in self.problem.factors])])
        return np.unique(self.rows.row + first[self.rows.factor], return_inverse=True)[1]

    @property
    def surveys(self) -> Flags:
        """Flags (N,) of the residuals of surveyed landmarks."""
        of = [f.is_survey for f in self.problem.factors]
        return np.array(of, dtype=np.bool_)[self.rows.factor]

    @cached_property
    def spacing(self) -> float:
        """The median distance, m, of a landmark to the next one; infinite of fewer than two."""
        places = self.state.groups[LANDMARKS][:, : self.state.d]
        return float(np.median(cKDTree(places).query(places, k=2)[0][:, 1])) if len(places) > 1 else np.inf

    @cached_property
    def step(self) -> float:
        """The length, m, of a long step of a robot from one pose to the next: 1 % are longer."""
        poses, robots, lengths = (
            self.state.groups[POSES][:, : self.state.d],
            np.array(self.problem.robots),
            [np.zeros(1)],
        )
        for robot in dict.fromkeys(self.problem.robots):
            lengths.append(np.linalg.norm(np.diff(poses[robots == robot], axis=0), axis=1))
        return float(np.quantile(np.concatenate(lengths), 0.99))

    @property
    def kept(self) -> Flags:
        """Flags (N,) of the residuals that count."""
        return self.noise < OUT

    def moved(self) -> BatchState:
        """Return the state at which the data as they are have their optimum."""
        return self.state.moved(self.reduced.step()[0], followers(self.at))

    def whitened(self, parts: list[Array]) -> Array:
        """Return Z (N, ...) of what is added to the innovations of each factor (K, p, ...)."""
        rows = [
            np.einsum("kij,kj...->ki...", np.linalg.inv(np.linalg.cholesky(factor.R)), part).reshape(
                -1, *part.shape[2:]
            )
            for factor, part in zip(self.problem.factors, parts, strict=True)
        ]
        return np.asarray((np.concatenate(rows).T / self.noise).T)

    def left(self, z: Array, w: Array) -> Left:
        """Return the residuals of data z (N, ...), w (q n, ...)."""
        step, m = self.reduced.solved(z, w)
        return Left(z - self.at.H @ step, m)

    def scores_of(self, Z: Array, W: Array) -> tuple[Array, Array, Left]:
        """Return the scores (K,) of errors Z (N, K), W (q n, K), their information (K, K), and what is left of them."""
        have, left = self.residuals, self.left(Z, W)
        return Z.T @ have.r + W.T @ have.m, Z.T @ left.r + W.T @ left.m, left

    @cached_property
    def residuals(self) -> Left:
        """Residuals of the data of the run."""
        return self.left(self.at.z, self.at.w)

    def simulated(self, number: int, seed: int = 0) -> Left:
        """Return residuals of simulated data in which everything is as configured, a column a set."""
        rng = np.random.default_rng(seed)
        within = np.concatenate([self._within(factor) for factor in self.problem.factors])
        z, e = rng.normal(size=(len(self.at.z), number)), rng.normal(size=(self.root.shape[1], number))
        return self.left(z * within[:, None], self.root @ e)

    def _within(self, factor: Factor) -> Array:
        """Return the share of the noise within a gate, of each row of a factor."""
        k, p = factor.R.shape[:2]
        left = self.within.get(factor.sensor, np.ones(p))
        return np.tile(left if len(left) == p else np.full(p, left.mean()), k)

    def errors_of(self, left: Left) -> Array:
        """Return the estimates of the white errors of the motion (r, ...), of unit variance or less."""
        return np.asarray(self.root.T @ left.m)
