"""Spaces the blocks of the map live in: products of a few atoms, each with plus, minus, rotated and generator.

An atom is the smallest piece that a rotation of the world treats in its own way.  A block type is a list of atoms, so
the filter handles any block, and a new kind of block needs no code in the filter:

=========  =============  ==================================================  =================
atom       mean / error   rotating the world by E                             generator
=========  =============  ==================================================  =================
SCALAR     1 / 1          nothing (depth, signature, bias, body rate, noise)  0
VECTOR     2 / 2          E x (point, velocity; plane)                        J x
HEADING    1 / 1          + angle, wrapped                                    1
ANGLE      1 / 1          nothing, but wrapped (a mount's angle)              0
VECTOR3    3 / 3          E x (point, velocity, direction; space)             -[x]x
ROTATION   4 / 3          E R (quaternion xyzw)                               I
=========  =============  ==================================================  =================

Orientation errors are world errors, R = Exp(d) R_hat, positions and landmarks are additive world vectors: Sola's 2-D
coordinates and their 3-D counterpart.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from kalmark.compiled import compiled
from kalmark.geometry.angles import exponential_v, rotation, wrap
from kalmark.geometry.rotations import conjugate, exp, left_jacobian, log, matrix, multiply

Array = npt.NDArray[np.float64]
Table = npt.NDArray[np.int64]

SCALAR, VECTOR, HEADING, ANGLE, VECTOR3, ROTATION = 0, 1, 2, 3, 4, 5
REMOVED = -1
MEAN_SIZE = {SCALAR: 1, VECTOR: 2, HEADING: 1, ANGLE: 1, VECTOR3: 3, ROTATION: 4}
ERROR_SIZE = {SCALAR: 1, VECTOR: 2, HEADING: 1, ANGLE: 1, VECTOR3: 3, ROTATION: 3}

KIND, X_AT, P_AT = 0, 1, 2  # columns of a table of atoms


@compiled
def retract(atoms: Table, x: Array, d: Array, turn: Array) -> None:
    """Move the mean in place by the correction d: plain plus without `turn`, else the exponential for turn = d_theta.

    `turn` has 0, 1 (plane) or 3 (space) components.  Points move by V(d_theta) d: rotated by Exp(d_theta), then carried
    along V xi, since V (generator d_theta) = (E - I) l.  Orientations turn by Exp(d_theta), then by their own xi.
    """
    p, q = exponential_v(turn[0]) if len(turn) == 1 else (1.0, 0.0)
    whole = turn if len(turn) == 3 else np.zeros(3)
    V = left_jacobian(turn) if len(turn) == 3 else np.eye(3)
    for i in range(len(atoms)):
        kind, at, k = atoms[i, 0], atoms[i, 1], atoms[i, 2]
        if kind == VECTOR:
            x[at] += p * d[k] - q * d[k + 1]
            x[at + 1] += q * d[k] + p * d[k + 1]
        elif kind == SCALAR:
            x[at] += d[k]
        elif kind in (HEADING, ANGLE):
            x[at] = wrap(x[at] + d[k])
        elif kind == VECTOR3:
            for j in range(3):
                x[at + j] += V[j, 0] * d[k] + V[j, 1] * d[k + 1] + V[j, 2] * d[k + 2]
        elif kind == ROTATION:
            own = exp(d[k : k + 3] - whole)
            x[at : at + 4] = multiply(exp(whole), multiply(own, x[at : at + 4]))


@compiled
def generator(atoms: Table, x: Array, size: int, axes: int) -> Array:
    """Return d x / d phi (size, axes) of rotating the world by phi about its origin, in error coordinates."""
    g = np.zeros((size, axes))
    for i in range(len(atoms)):
        kind, at, k = atoms[i, 0], atoms[i, 1], atoms[i, 2]
        if kind == VECTOR:
            g[k, 0], g[k + 1, 0] = -x[at + 1], x[at]
        elif kind == HEADING:
            g[k, 0] = 1.0
        elif kind == VECTOR3:
            g[k, 1], g[k, 2] = x[at + 2], -x[at + 1]
            g[k + 1, 0], g[k + 1, 2] = -x[at + 2], x[at]
            g[k + 2, 0], g[k + 2, 1] = x[at + 1], -x[at]
        elif kind == ROTATION:
            for j in range(3):
                g[k + j, j] = 1.0
    return g


NO_TURN = np.zeros(0)


@dataclass(frozen=True)
class Space:
    """A product of atoms; `names` label its error coordinates."""

    name: str
    kinds: tuple[int, ...]

    @cached_property
    def atoms(self) -> Table:
        """The atoms as rows (kind, offset in the mean, offset in the error)."""
        rows, x_at, p_at = [], 0, 0
        for kind in self.kinds:
            rows.append((kind, x_at, p_at))
            x_at, p_at = x_at + MEAN_SIZE[kind], p_at + ERROR_SIZE[kind]
        return np.array(rows, dtype=np.int64).reshape(-1, 3)

    @cached_property
    def size(self) -> int:
        """Numbers in a mean."""
        return sum(MEAN_SIZE[k] for k in self.kinds)

    @cached_property
    def dof(self) -> int:
        """Numbers in an error."""
        return sum(ERROR_SIZE[k] for k in self.kinds)

    def plus(self, x: Array, d: Array) -> Array:
        """Return x moved by the error d."""
        x = np.array(x, dtype=np.float64)
        retract(self.atoms, x, np.array(d, dtype=np.float64), NO_TURN)
        return x

    def minus(self, x2: Array, x1: Array) -> Array:
        """Return the error d with x1 plus d = x2."""
        d = np.empty(self.dof)
        x1, x2 = np.asarray(x1, dtype=np.float64), np.asarray(x2, dtype=np.float64)
        for kind, at, k in self.atoms:
            n = ERROR_SIZE[kind]
            if kind == ROTATION:
                d[k : k + 3] = log(multiply(x2[at : at + 4], conjugate(x1[at : at + 4])))
                continue
            d[k : k + n] = x2[at : at + n] - x1[at : at + n]
            if kind in (HEADING, ANGLE):
                d[k] = wrap(d[k])
        return d

    @cached_property
    def axes(self) -> int:
        """Axes the world can turn about: 1 in the plane, 3 in space."""
        return 3 if VECTOR3 in self.kinds or ROTATION in self.kinds else 1

    @cached_property
    def world(self) -> str:
        """Where it lives: "plane", "space", or "" for plain numbers, which fit either."""
        if any(kind in (VECTOR3, ROTATION) for kind in self.kinds):
            return "space"
        return "plane" if any(kind in (VECTOR, HEADING) for kind in self.kinds) else ""

    def rotated(self, x: Array, phi: Any) -> Array:
        """Return x after rotating the world by phi (rad; in space a rotation vector) about its origin."""
        x = np.array(x, dtype=np.float64)
        turn = exp(np.array(phi, dtype=np.float64)) if self.axes == 3 else np.zeros(4)
        for kind, at, _ in self.atoms:
            if kind == VECTOR:
                x[at : at + 2] = rotation(phi) @ x[at : at + 2]
            elif kind == HEADING:
                x[at] = wrap(x[at] + phi)
            elif kind == VECTOR3:
                x[at : at + 3] = matrix(turn) @ x[at : at + 3]
            elif kind == ROTATION:
                x[at : at + 4] = multiply(turn, x[at : at + 4])
        return x

    def generator(self, x: Array) -> Array:
        """Return the derivative (dof, axes) of `rotated` at phi = 0."""
        return generator(self.atoms, np.array(x, dtype=np.float64), self.dof, self.axes)


SE2 = Space("SE2", (VECTOR, HEADING))
POINT2 = Space("point", (VECTOR,))
SE3 = Space("SE3", (VECTOR3, ROTATION))
POINT3 = Space("point3", (VECTOR3,))


def Rn(n: int) -> Space:
    """Return the space of n plain numbers that no rotation of the world changes."""
    return Space(f"R{n}", (SCALAR,) * n)
