"""Variance components of a run by maximum likelihood: how large each noise that a configuration states really is.

The data of the batch problem, linear about its optimum, have the covariance V, the sum over the noises k of exp(t_k)
V_k.  With y'P V_k P y = q_k of what the state leaves of the data, the score of t_k is (q_k - E q_k) / 2 and the Fisher
information is the covariance of q_k / 2: both from simulated data.  The likelihood is that of the data without the
state (REML), which is the likelihood of the innovations of a filter without prior landmarks.
Patterson and Thompson 1971, Biometrika 58; Schweppe 1965, IEEE Transactions on Information Theory 11.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse as sp

from kalmark.arrays import Array, Flags
from kalmark.batch.batch_state import BatchState
from kalmark.batch.data import BatchInput, replay_events
from kalmark.batch.problem import Motions, Problem
from kalmark.diagnosis.causes import BLOCKS
from kalmark.diagnosis.linear import Left, Linear
from kalmark.logs.log import Log
from kalmark.slam.robot import Robot

SETS = 60  # of simulated data
STEPS, SMALL = 12, 0.01  # of Fisher's scoring, and of the logarithm of a sigma: as good as none
LONGEST = math.log(3.0)  # step of the logarithm of a variance
LEAST, MOST = 0.1, 30.0  # times a stated sigma: beyond, the data only bound it
KNOWN = 0.35  # largest sigma of the logarithm of a sigma that the data determine
ALMOST, ROUNDING = 0.9, 1e-6  # what makes parts of covariances the same
FAINT = 0.1  # information on a t that is as good as none
NOTHING = 2 * math.log(1e-6)  # the logarithm of the variance of a noise that is not there


@dataclass(frozen=True)
class Noise:
    """A noise of a configuration: the path of its key there, the names of the robots that have it, its `stated` value.

    `scale` is what its logarithm counts from: the value stated, or where that is zero one to begin with.
    """

    path: tuple[str, ...]
    robots: tuple[str, ...]
    stated: float
    scale: float

    def __str__(self) -> str:
        return ".".join(self.path)

    @property
    def zero(self) -> float:
        """The logarithm t of the variance stated, over that of the scale."""
        return 0.0 if self.stated else NOTHING


class NoiseEstimate(NamedTuple):
    """A noise by maximum likelihood: its value, the sigma of its logarithm, and whether the data determine it.

    At the `bound` are those that the data only bound from one side.
    """

    value: float
    sigma: float
    determined: bool = True
    bound: bool = False


class NoiseComponent(NamedTuple):
    """Part of a noise in the covariances: R (K, p, p) of each factor, Q (q n, q n) of the motion.

    `columns` (r,) are those of the root of the motion's covariance that it scales, None if it does more than that.
    """

    R: list[Array]
    Q: sp.csr_array
    columns: Flags | None


def with_noise(robots: Mapping[str, Robot], values: Mapping[Noise, float]) -> dict[str, Robot]:
    """Return the robots with other values of some noises."""
    out = dict(robots)
    for noise, value in values.items():
        for name in noise.robots:
            out[name] = _with(out[name], noise.path[2:], value)
    return out


def _with(robot: Robot, path: tuple[str, ...], value: float) -> Robot:
    if path[0] == "motion":
        motion: Any = robot.motion
        return replace(robot, motion=replace(motion, **{path[1]: value}))
    mount, sensor = robot.sensors[path[1]], robot.sensors[path[1]].sensor
    changed = replace(mount, sensor=replace(sensor, **{path[2]: value}))  # type: ignore[type-var]
    return replace(robot, sensors={**robot.sensors, path[1]: changed})


class Components:
    """The noises of a run, and what each adds to the covariances of the data `given` with the events of a log."""

    def __init__(self, given: BatchInput, log: Log, state: BatchState, noises: Sequence[Noise]) -> None:
        robots = with_noise(given.robots, {noise: noise.scale for noise in noises})
        self.given, self.log, self.state = replace(given, robots=robots), log, state
        self.first = first = self._problem({})
        parts = [_between(first, self._problem({noise: math.sqrt(2.0) * noise.scale})) for noise in noises]
        acts = [part.Q.nnz > 0 or any(R.any() for R in part.R) for part in parts]
        self.noises = [noise for noise, some in zip(noises, acts, strict=True) if some]
        self.parts = [part for part, some in zip(parts, acts, strict=True) if some]

    def _problem(self, values: Mapping[Noise, float]) -> Problem:
        return replay_events(replace(self.given, robots=with_noise(self.given.robots, values)), self.log)

    def linear(self, t: Array) -> Linear:
        """Return the problem with the variances exp(t) (K,) times those of the scales."""
        if any(part.columns is None for part in self.parts):
            values = {noise: noise.scale * math.exp(x / 2) for noise, x in zip(self.noises, t, strict=True)}
            return Linear.of(self._problem(values), self.state)
        R, scale = [factor.R for factor in self.first.factors], np.ones(self.first.motions.root.shape[1])
        for part, x in zip(self.parts, t, strict=True):
            R = [now + (math.exp(x) - 1.0) * more for now, more in zip(R, part.R, strict=True)]
            scale[part.columns] *= math.exp(x / 2)
        motions = replace(self.first.motions, root=sp.csr_array(self.first.motions.root @ sp.diags_array(scale)))
        factors = tuple(replace(factor, R=now) for factor, now in zip(self.first.factors, R, strict=True))
        return Linear.of(replace(self.first, motions=motions, factors=factors), self.state)

    def t_of(self, values: Mapping[Noise, float]) -> Array:
        """Return t (K,) of the values of some noises, of the others as they are stated."""
        now = [values.get(noise, noise.stated) / noise.scale for noise in self.noises]
        return np.array([max(2.0 * math.log(max(x, 1e-300)), NOTHING) for x in now])

    def fit(self, values: Mapping[Noise, float], fixed: Collection[Noise] = ()) -> dict[Noise, NoiseEstimate]:
        """Return the estimate of each noise, beginning at some values.

        Those that are `fixed`, or that the data do not determine, are as stated.
        """
        free = np.array([noise not in fixed for noise in self.noises], dtype=np.bool_)
        stated, low, high = np.array([noise.zero for noise in self.noises]), 2 * math.log(LEAST), 2 * math.log(MOST)
        begin = np.clip(self.t_of(values), low, high)
        while True:
            t, sigma = self._maximum(np.where(free, begin, stated), free)
            bound = (t < low + SMALL) | (t > high - SMALL)
            vague = free & (sigma > KNOWN) & (~bound | (stated == NOTHING))
            if not vague.any():
                break
            free[np.argmax(np.where(vague, sigma, 0.0))] = False
        made = [
            NoiseEstimate(noise.scale * math.exp(x / 2) if f else noise.stated, float(s), bool(f), bool(b and f))
            for noise, x, s, f, b in zip(self.noises, t, sigma, free, bound, strict=True)
        ]
        return dict(zip(self.noises, made, strict=True))

    def _maximum(self, begin: Array, free: Flags) -> tuple[Array, Array]:
        """Return t (K,), of which some are `free`, and the sigma (K,) of the logarithms of the values.

        Fisher's scoring.
        """
        t, low, high = begin.copy(), 2 * math.log(LEAST), 2 * math.log(MOST)
        sigma = np.full(len(free), math.inf)
        for _ in range(STEPS if free.any() else 0):
            g, I, spread = self._score(t)
            g, I, spread = g[free], I[np.ix_(free, free)], spread[np.ix_(free, free)]
            inverse = np.linalg.pinv(I, hermitian=True)
            towards = np.linalg.solve(I + FAINT * np.eye(len(g)), g)
            moved = np.clip(t[free] + np.clip(towards, -LONGEST, LONGEST), low, high)
            step, t[free] = np.abs(moved - t[free]).max() / 2, moved
            robust = inverse @ spread @ inverse
            sigma[free] = 0.5 * np.sqrt(np.maximum(np.diag(inverse), np.diag(robust)))
            if step < SMALL:
                break
        return t, sigma

    def _score(self, t: Array) -> tuple[Array, Array, Array]:
        """Return the score (K,) of t (K,), its information (K, K), and its covariance by stretches of the run."""
        linear = self.linear(t)
        have, simulated = linear.residuals, linear.simulated(SETS)
        blocks = linear.rows.node * BLOCKS // len(linear.problem.robots)
        q, usual, by_block = [], [], []
        for part, x in zip(self.parts, t, strict=True):
            rows, moves = _squares(linear, part, have)
            all_rows, all_moves = _squares(linear, part, simulated)
            scale = 0.5 * math.exp(x)
            n = len(linear.problem.robots)
            node = np.repeat(np.arange(n) * BLOCKS // n, len(moves) // max(n, 1))
            here = np.bincount(blocks, rows - all_rows.mean(axis=1), BLOCKS)
            here += np.bincount(node, moves - all_moves.mean(axis=1), BLOCKS)
            by_block.append(scale * here)
            q.append(scale * (rows.sum() + moves.sum()))
            usual.append(scale * (all_rows.sum(axis=0) + all_moves.sum(axis=0)))
        sets, stretches = np.array(usual), np.array(by_block)
        stretches = stretches - stretches.mean(axis=1, keepdims=True)
        return np.array(q) - sets.mean(axis=1), np.atleast_2d(np.cov(sets)), stretches @ stretches.T


def _between(one: Problem, two: Problem) -> NoiseComponent:
    """Return by how much the covariances of a problem are larger than those of another."""
    R = [b.R - a.R for a, b in zip(one.factors, two.factors, strict=True)]
    Q = sp.csr_array(two.motions.Q - one.motions.Q)
    Q.data[np.abs(Q.data) < 1e-12 * abs(one.motions.Q).max()] = 0.0
    Q.eliminate_zeros()
    return NoiseComponent(R, Q, _columns(one.motions, Q))


def _columns(motions: Motions, Q: sp.csr_array) -> Flags | None:
    """Return the columns (r,) of the root of which Q is the square: all those of some kinds; None if it is not one."""
    kinds, out = np.array(motions.kinds), np.zeros(motions.root.shape[1], dtype=np.bool_)
    for kind in dict.fromkeys(motions.kinds) if Q.nnz else ():
        mine = kinds == kind
        square = motions.root[:, mine] @ motions.root[:, mine].T
        out |= mine & bool(square.multiply(Q).sum() > ALMOST * square.multiply(square).sum())
    square = motions.root[:, out] @ motions.root[:, out].T
    return out if abs(square - Q).max() <= ROUNDING * max(abs(Q).max(), 1e-300) else None


def _squares(linear: Linear, part: NoiseComponent, left: Left) -> tuple[Array, Array]:
    """Return r_i (D r)_i (N, ...), D the whitened part of R, and m_i (Q m)_i (q n, ...)."""
    r = left.r if left.r.ndim == 2 else left.r[:, None]
    out, first = [], 0
    for factor, R in zip(linear.problem.factors, part.R, strict=True):
        k, p, _ = R.shape
        L = np.linalg.inv(np.linalg.cholesky(factor.R))
        mine = r[first : first + k * p].reshape(k, p, -1)
        out.append((mine * (L @ R @ L.transpose(0, 2, 1) @ mine)).reshape(k * p, -1))
        first += k * p
    rows = np.concatenate(out).reshape(left.r.shape)
    return rows, left.m * (part.Q @ left.m)
