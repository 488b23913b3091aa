"""Immediate full corrections: applied to inactive blocks at once, as the dense filter does.  docs/compressed.md.

A correction d that turns the world by phi moves an active block by V(phi) d and turns its error coordinates; an
inactive one is moved by d alone, its error keeps its coordinates.  A large correction separates them by up to
|phi| |d| / 2, and many small ones leave the coordinates behind, while the robot's turn goes on.  An immediate full
correction avoids both; the robots' orientations are cloned then (Roumeliotis and Burdick 2002).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from kalmark.arrays import Array, Index
from kalmark.compiled import compiled
from kalmark.filter.layout import P_AT
from kalmark.filter.map import StochasticMap
from kalmark.geometry.angles import wrap
from kalmark.geometry.rotations import conjugate, left_jacobian, log, multiply
from kalmark.geometry.spaces import (
    NO_TURN,
    VECTOR,
    VECTOR3,
    Rn,
    Table,
    generator,
    generator_plane,
    retract,
    retract_plane,
)

TAU = 0.05  # of the least sigma of a point as seen from the robot: how far a correction may move it from inactive ones
MOST = 40  # rows of clones in a compression interval,
MORE = 500  # and one more for so many rows of the map: a full update costs their square


def most_clone_rows(n: int) -> int:
    """Return how many rows of clones an interval of a map of n rows may have."""
    return MOST + n // MORE


class Points:
    """The points of an active map, which a correction may move away from inactive blocks."""

    def __init__(self) -> None:
        self._rows: Index | None = None  # the first one of each

    def reset(self) -> None:
        """Take note that blocks have come or gone."""
        self._rows = None

    def parted(self, m: StochasticMap, robot: int, x_before: Array) -> bool:
        """Return whether the correction of the active map m, whose mean was `x_before`, has moved them too far."""
        if self._rows is None:
            slots = [slot for slot, space in enumerate(m.spaces) if space is not None and space.kinds in _POINTS]
            self._rows = m.blocks[np.array(slots, dtype=np.int64), P_AT]
        return bool(_parts(m.P, m.blocks[robot], self._rows, x_before, m.x, 2 if m.axes == 1 else 3))


_POINTS = ((VECTOR,), (VECTOR3,))


@compiled
def _parts(P: Array, robot: Index, points: Index, x_before: Array, x: Array, d: int) -> bool:
    """Return whether turn and motion of a robot, a row of `blocks`, move a point by over TAU sigmas seen from it."""
    at, r = robot[0], robot[2]
    now, before = x[at : at + 7], x_before[at : at + 7]
    moved = 0.0
    for i in range(d):
        moved += (now[i] - before[i]) ** 2
    flat = d == 2
    turn = abs(wrap(now[2] - before[2])) if flat else 2.0 * math.acos(min(1.0, abs((now[3:7] * before[3:7]).sum())))
    apart = 0.5 * turn * math.sqrt(moved) / TAU
    for l in points:
        variance = 0.0
        for i in range(d):
            variance += P[l + i, l + i] + P[r + i, r + i] - 2.0 * P[max(l, r) + i, min(l, r) + i]
        if variance < apart * apart:
            return True
    return False


def world_turns(robot: int, moved: dict[int, tuple[Array, Array]], axes: int) -> tuple[Array, Array]:
    """Return how a robot's correction turns the world, and what it did to the robots' turns (R axes,).

    `moved` has the robots' means before and after it.
    """
    turns = {r: turn_of(before, after, axes) for r, (before, after) in moved.items()}
    turn = turns[robot].copy()
    if axes == 6:
        turn[:3] += np.cross(moved[robot][0][:3], turn[3:])
    return turn, np.concatenate([*turns.values()])


def turn_of(before: Array, after: Array, axes: int) -> Array:
    """Return what a correction did to the turn (axes,) of a robot that stood at `before` and stands at `after`."""
    if axes == 1:
        return np.array([wrap(after[2] - before[2])])
    turn = log(multiply(after[3:7], conjugate(before[3:7])))
    if axes == 3:
        return turn
    return np.concatenate([np.linalg.solve(left_jacobian(turn), after[:3] - before[:3]), turn])


class ImmediateCorrections:
    """Those of an interval, each alone, and the sums of the corrections between them.

    `S` (A0, C) and `U` (T, C) are the displacements of auxiliary states and clones.  Each immediate correction has one
    column for each robot, the sum of its corrections before, and one for itself.
    """

    def __init__(self) -> None:
        self.robots = np.zeros((0, 2), dtype=np.int64)  # of each: how many there were, and whose it is
        self.S, self.U = np.zeros((0, 0)), np.zeros((0, 0))
        self.S_done, self.U_done = np.zeros((0, 1)), np.zeros((0, 1))  # displaced until the last one, by each robot
        self.rows, self.numbers = np.zeros((2, 0), dtype=np.int64)  # the clones in the active map
        self.axes = 0  # of the turns: blocks that need more axes get them in the next interval
        self.last: dict[int, tuple[Index, Index, Index]] = {}  # and behind what it is of, of each robot the last one
        self.turn, self.turns = NO_TURN, NO_TURN  # how each turns the world, what it did to the robots' turns, e' d,
        self.origins = np.zeros((0, 3))  # and where the robots stood: one after the other

    def __len__(self) -> int:
        return len(self.robots)

    def add(
        self, robot: int, S: Array, U: Array, ds: Array, du: Array, turn: Array, turns: Array, origins: Array
    ) -> None:  # fmt: skip
        """Add one of a robot: S (A0, R) and U (T, R) are all that was displaced before, ds and du what it did."""
        self.S, self.U = (
            np.column_stack([_since(old, now, done), d])
            for old, now, done, d in ((self.S, S, self.S_done, ds), (self.U, U, self.U_done, du))
        )
        self.S_done, self.U_done = S.copy(), U.copy()
        self.S_done[:, robot] += ds
        self.U_done[:, robot] += du
        self.robots = np.vstack([self.robots, [S.shape[1], robot]])
        self.turn, self.turns = np.concatenate([self.turn, turn]), np.concatenate([self.turns, turns])
        self.origins = np.concatenate([self.origins, origins])

    def displacements(self, S: Array, U: Array, axes: int, origins: Array) -> Displacements:
        """Return all of the interval; S (A0, R) and U (T, R) are their sums, with robots at `origins`."""
        if len(self):
            S, U = _since(self.S, S, self.S_done), _since(self.U, U, self.U_done)
            origins = np.concatenate([self.origins, origins])
        return Displacements(S, U, self.robots, self.turn, self.turns, origins, axes)

    def clone(self, m: StochasticMap, turns: dict[int, Index]) -> int:
        """Clone the robots' orientations, of which these are the rows in the active map; return how many."""
        index = np.concatenate([*turns.values()])
        k, self.axes = len(index), len(index) // len(turns)
        slot = m.augment(Rn(k), np.zeros(k), index, np.eye(k), np.zeros((k, k)))
        rows, numbers = m.rows(slot), np.arange(k) + m.numbers(slot).start
        self.rows, self.numbers = np.concatenate([self.rows, rows]), np.concatenate([self.numbers, numbers])
        last = [slice(end - min(3, self.axes), end) for end in range(self.axes, k + 1, self.axes)]
        self.last = {robot: (index[i], rows[i], numbers[i]) for robot, i in zip(turns, last, strict=True)}
        return k


class Displacements(NamedTuple):
    """Displacements of inactive blocks, and the turn of the world by each immediate correction among them.

    All as `ImmediateCorrections` has it, and the axes of the turns.
    """

    S: Array
    U: Array
    robots: Index
    turn: Array
    turns: Array
    origins: Array
    axes: int


@compiled
def _since(before: Array, now: Array, done: Array) -> Array:
    """Return [before, now - done]; rows and columns that were not there yet are zero."""
    first = before.shape[1]
    out = np.zeros((len(now), first + now.shape[1]))
    out[: len(before), :first] = before
    out[:, first:] = now
    out[: len(done), first : first + done.shape[1]] -= done
    return out


@compiled
def generator_in_plane(atoms: Table, x: Array, n: int, axes: int, origin: Array) -> Array:
    """Return the `generator` (n, axes) of blocks, of none or one axis, in the plane, without what is of space."""
    if axes > 1:
        return generator(atoms, x, n, axes, origin)
    return generator_plane(atoms, x, n, axes, origin) if axes == 1 else np.zeros((n, 0))


@compiled
def retract_in_plane(atoms: Table, x: Array, d: Array, turn: Array, axes: int) -> None:
    """`retract` blocks, of one axis, in the plane, without what is of space."""
    if axes == 1:
        retract_plane(atoms, x, d, turn)
    else:
        retract(atoms, x, d, turn)


@compiled
def transport_mean(
    atoms: Table, x: Array, G: Array, S: Array, U: Array, robots: Index, turn: Array, turns: Array, origins: Array,
    axes: int,
) -> tuple[Array, Array, Array]:  # fmt: skip
    """Return the mean x of blocks displaced by G S + a U, the one after the last immediate correction, and a.

    G (n, A0) is their covariance with the auxiliary states, a (n, T + R axes) the Jacobian of their errors in the
    clones, of the robots one after the other, and in the turns of now.
    """
    D = G @ S
    n = len(D)
    a = np.zeros((n, len(U) + axes * (D.shape[1] - robots[:, 0].sum() - len(robots))))
    column = kept = turned_by = stood = 0
    x, x_left, d = x.copy(), x, np.empty(n)
    turned = generator_in_plane(atoms, x, n, axes, origins[0])
    for k in range(len(robots) + 1):
        immediate = k < len(robots)
        count = robots[k, 0] if immediate else D.shape[1] - column
        width = count * axes
        for c in range(count + immediate):
            for i in range(n):
                d[i] = D[i, column + c]
                for j in range(kept):
                    d[i] += a[i, j] * U[j, column + c]
            robot, by = c, NO_TURN
            if c == count:
                robot, by = robots[k, 1], turn[k * axes : (k + 1) * axes]
                for i in range(n):
                    for j in range(width):
                        d[i] += a[i, kept + j] * turns[turned_by + j]
            own = kept + robot * axes
            if axes == 6:
                turned = generator_in_plane(atoms, x, n, axes, origins[stood + robot])
            retract_in_plane(atoms, x, d, by, axes)
            now = generator_in_plane(atoms, x, n, axes, origins[stood + robot])
            for i in range(n):
                for j in range(axes):
                    a[i, own + j] += now[i, j] - turned[i, j]
            turned = now
        if immediate:
            column, kept, turned_by, stood = column + count + 1, kept + width, turned_by + width, stood + count
            x_left = x.copy()
    return x, x_left, a
