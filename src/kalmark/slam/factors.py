"""Factors: measurements y = h(x_1, ..., x_k) + v of any blocks of the map.  [S] A.5, docs/factors.md.

The value h becomes a block of the map, computed from the others, which is then observed itself.  So each estimator and
each map corrects by a factor without knowing of it: a landmark relative to another, a robot relative to another, two
landmarks that are one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from kalmark.arrays import Array, Flags
from kalmark.errors import EventError
from kalmark.events import Id, checked_id, finite, is_number, list_names, short_text
from kalmark.filter.estimators import Update
from kalmark.filter.map import NO_SLOTS, Map
from kalmark.geometry.angles import wrap
from kalmark.geometry.gaussian import gate as gate_of
from kalmark.geometry.spaces import Rn, Space
from kalmark.report import INDEFINITE, Observation
from kalmark.slam import moves
from kalmark.slam.checks import check_covariance, check_numbers
from kalmark.slam.state import State
from kalmark.tracks.scan import Start
from kalmark.tracks.track import Tracks

ROUNDS, SETTLED = 20, 1e-3  # linearisations at most, until nothing moves by that many of its sigmas
STEP = 1e-6  # of central differences, in m and rad


@dataclass(frozen=True, eq=False)
class ObservedItself:
    """The observation model of a block that is measured as it is, by a sensor on a mount (3,) or (7,)."""

    mount: Array
    numbers: int

    def linearize(self, head: Array, l: Array, y: Array) -> tuple[Array, Array, Array, Array]:
        """Return e = l (K, n), z = y - e, E_h = 0 (K, n, h) and E_l = 1 (K, n, n)."""
        count, n = l.shape
        E_l = np.tile(np.eye(n), (count, 1, 1))
        pose = 3 if len(self.mount) == 3 else 6
        return l.copy(), y - l, np.zeros((count, n, pose * (len(head) // len(self.mount)))), E_l


def update_by_blocks(robot: int, mount: int, at: Array, y: Array, R: Array, gate: float = math.inf) -> Update:
    """Return the correction by y (K, n) of K blocks that are measured as they are, R (K, n, n) being its noise.

    `robot` and `mount` are the slots of the robot and of the mount `at` with which the map turns (-1: no mount in it).
    `State.corrected_by` has the blocks.
    """
    return Update(ObservedItself(at, y.shape[1]), robot, mount, NO_SLOTS, y.shape[1], y, R, gate)


class _Block(NamedTuple):
    """A block that a factor measures: its slot, its space and its mean; of a landmark known exactly the slot is -1."""

    slot: int
    space: Space
    mean: Array

    @property
    def dof(self) -> int:
        return 0 if self.slot < 0 else self.space.dof


@dataclass(frozen=True, eq=False)
class BlockMeasurement:
    """A measurement y (p,) of blocks by their `names`, with the noise R (p, p).

    `expect` returns its expectation from their means, `angular` (p,) marks angles; `what` names it in messages.
    """

    names: list[Id]
    expect: Callable[..., Any]
    y: Array
    R: Array
    angular: Flags
    what: str

    def expectation(self, means: Sequence[Array]) -> Array:
        """Return e (p,), h at the means.  Raises EventError for anything else."""
        e = self.expect(*means)
        e = e.ravel() if isinstance(e, np.ndarray) else e if isinstance(e, list | tuple) else [e]
        return check_numbers(e, len(self.y), f"{self.what}: expectation", EventError)

    def residual(self, a: Array, b: Array) -> Array:
        """Return a - b (p,), the angles wrapped."""
        return np.where(self.angular, wrap(a - b), a - b)

    def linearize(self, blocks: Sequence[_Block], x: Sequence[Array]) -> tuple[Array, Array]:
        """Return e (p,) at the means x and its Jacobian G (p, n) in the errors of all blocks, by differences."""
        columns = []
        for i, block in enumerate(blocks):
            for d in STEP * np.eye(block.dof):
                ahead, behind = (self.expectation([*x[:i], block.space.plus(x[i], by), *x[i + 1 :]]) for by in (d, -d))
                columns.append(self.residual(ahead, behind) / (2.0 * STEP))
        return self.expectation(x), np.column_stack(columns)

    def as_block(self, blocks: Sequence[_Block], P: Array) -> tuple[float, Start]:
        """Return d2 at the means, and h as a block, linearised where they are after the correction.

        Gauss-Newton on these blocks alone, of the covariance P (n, n), as the corrections of scans iterate.
        """
        x, step, d2 = [block.mean for block in blocks], np.zeros(len(P)), math.nan
        ends = np.cumsum([block.dof for block in blocks])
        for _ in range(ROUNDS):
            e, G = self.linearize(blocks, x)
            back = [b.space.minus(b.mean, now)[: b.dof] for b, now in zip(blocks, x, strict=True)]
            value = e + G @ np.concatenate(back)  # of h at the means, as it is linearised at x
            z, Z = self.residual(self.y, value), G @ P @ G.T + self.R  # [S] (26)-(27)
            d2 = float(z @ np.linalg.solve(Z, z)) if math.isnan(d2) else d2  # [S] (83)
            before, step = step, P @ G.T @ np.linalg.solve(Z, z)  # [S] (28)-(29)
            moved = zip(blocks, np.split(step, ends), strict=False)
            x = [block.space.plus(block.mean, d) if block.dof else block.mean for block, d in moved]
            if (np.abs(step - before) <= SETTLED * np.sqrt(np.maximum(np.diag(P), 0.0))).all():
                break
        parts = tuple((block.slot, block.dof) for block in blocks if block.dof)
        return d2, Start(Rn(len(e)), value, parts, G, np.zeros((len(e), len(e))))


def factor_of(
    names: Sequence[Id], expect: Callable[..., Any], y: Any, cov: Any, angular: Sequence[bool]
) -> BlockMeasurement:
    """Return a factor of the blocks `names`.  Raises EventError for numbers that it cannot have."""
    own, what = _checked_names(names)
    if not callable(expect):
        raise EventError(f"{what}: expect is {short_text(expect)}, expected a function of the means of these")
    y = finite(y, f"{what}: y").ravel()
    p = len(y)
    if not p:
        raise EventError(f"{what}: y is empty, expected one number or more")
    R = check_covariance([[cov]] if p == 1 and np.ndim(cov) == 0 else cov, p, f"{what}: cov", definite=True)
    turns = [*angular] if isinstance(angular, list | tuple) and len(angular) in (0, p) else [None]
    if not all(isinstance(each, bool) for each in turns):
        raise EventError(f"{what}: angular is {short_text(angular)}, expected {p} truth values")
    return BlockMeasurement(own, expect, y, R, np.array(turns or [False] * p), what)


def _checked_names(names: Any) -> tuple[list[Id], str]:
    """Return the names of different blocks, and how messages call their factor.  Raises EventError."""
    several = list(names) if isinstance(names, list | tuple) else []
    what = f"factor of {list_names(several) if several else short_text(names)}"
    own = [checked_id(name, f"{what}: a name") for name in several]
    if not own or len({*own}) < len(own):
        raise EventError(f"{what}: expected the names of different robots and landmarks, in a list")
    return own, what


def correct_by_factor(state: State, factor: BlockMeasurement, share: float) -> Observation:
    """Correct by a factor if d2 is within the gate of the probability `share`."""
    if not is_number(share) or not 0.0 < share <= 1.0:
        raise EventError(f"{factor.what}: gate is {short_text(share)}, expected a probability above 0, 1 for no gate")
    names, robots = factor.names, [str(name) for name in factor.names if name in state.robots]
    blocks = _blocks(state.map, state.tracks, names)
    if not any(block.dof for block in blocks):
        raise EventError(f"{factor.what}: all of these are known exactly, expected one that is estimated")
    factor.linearize(blocks, [block.mean for block in blocks])  # what is wrong with it shows before anything moves
    if robots and state.t_ns is not None:
        moves.advance(state, *robots)  # a gap that is found here goes on: the robot's next report has it
        blocks = _blocks(state.map, state.tracks, names)
    d2, start = factor.as_block(blocks, state.map.covariance([block.slot for block in blocks if block.dof]))
    limit = gate_of(share, len(factor.y))
    if d2 > limit:
        return Observation(0, None, "rejected", names[0], d2, f"outside the gate of {limit:.2f}")
    moving = state.moving[next(iter([*robots, *state.robots]))]
    y = start.mean + factor.residual(factor.y, start.mean)
    at = state.map.mean(moving.slot)[: 3 if moving.motion.space.axes == 1 else 7]
    done = state.corrected_by([start], update_by_blocks(moving.slot, -1, at, y[None], factor.R[None]))
    outcome, reason = ("associated", "") if done.fused[0] else ("rejected", INDEFINITE)
    return Observation(0, None, outcome, names[0], d2, reason)


def _blocks(map_: Map, tracks: Tracks, names: Sequence[Id]) -> list[_Block]:
    """Return what a factor needs of its blocks.  Raises MapError for a name that is not in the map."""
    blocks, known = [], tracks.known
    for name in names:
        slot = -1 if name in known else tracks.slot(name)
        space = known.model(name).space if slot < 0 else map_.spaces[slot]
        assert space is not None
        blocks.append(_Block(slot, space, known.mean(name) if slot < 0 else map_.mean(slot)))
    return blocks
