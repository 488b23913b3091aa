"""Spaces the blocks of the map live in: products of a few atoms, each with plus, minus, rotated and generator.

An atom is the smallest piece that a rotation of the world treats in its own way.  A block type is a list of atoms, so
the filter handles any block, and a new kind of block needs no code in the filter:

=========  ====  ===========================================  =================
atom       size  rotating the world by E                      generator
=========  ====  ===========================================  =================
SCALAR     1     nothing (depth, signature, bias, noise)      0
VECTOR     2     E x (point, velocity; plane)                 J x
HEADING    1     + angle, wrapped                             1
ANGLE      1     nothing, but wrapped (a mount's angle)       0
=========  ====  ===========================================  =================

Orientation errors are world errors, positions and landmarks are additive world vectors: Sola's 2-D coordinates.
Three dimensions add a VECTOR of size 3 and a ROTATION with 4 numbers and 3 degrees of freedom; that is why offsets into
the mean and into the covariance are kept apart everywhere.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from kalmark.compiled import compiled
from kalmark.geometry.angles import exponential_v, rotation, wrap

Array = npt.NDArray[np.float64]
Table = npt.NDArray[np.int64]

SCALAR, VECTOR, HEADING, ANGLE = 0, 1, 2, 3
REMOVED = -1
MEAN_SIZE = {SCALAR: 1, VECTOR: 2, HEADING: 1, ANGLE: 1}
ERROR_SIZE = {SCALAR: 1, VECTOR: 2, HEADING: 1, ANGLE: 1}

KIND, X_AT, P_AT = 0, 1, 2  # columns of a table of atoms


@compiled
def retract(atoms: Table, x: Array, d: Array, turn: float) -> None:
    """Move the mean in place by the correction d: plain plus for turn 0, the exponential for turn = d_theta.

    With `turn`, points move by V(d_theta) d: rotated by Exp(d_theta), then carried along V xi, for V J l = (E - I) l.
    """
    p, q = exponential_v(turn)
    for i in range(len(atoms)):
        kind, at, k = atoms[i, 0], atoms[i, 1], atoms[i, 2]
        if kind == 1:
            x[at] += p * d[k] - q * d[k + 1]
            x[at + 1] += q * d[k] + p * d[k + 1]
        elif kind == 0:
            x[at] += d[k]
        elif kind > 1:
            x[at] = wrap(x[at] + d[k])


@compiled
def generator(atoms: Table, x: Array, size: int) -> Array:
    """Return d x / d phi (size,) of rotating the world by phi about its origin, in error coordinates."""
    g = np.zeros(size)
    for i in range(len(atoms)):
        kind, at, k = atoms[i, 0], atoms[i, 1], atoms[i, 2]
        if kind == 1:
            g[k], g[k + 1] = -x[at + 1], x[at]
        elif kind == 2:
            g[k] = 1.0
    return g


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
        retract(self.atoms, x, np.asarray(d, dtype=np.float64), 0.0)
        return x

    def minus(self, x2: Array, x1: Array) -> Array:
        """Return the error d with x1 plus d = x2."""
        d = np.empty(self.dof)
        for kind, at, k in self.atoms:
            n = ERROR_SIZE[kind]
            d[k : k + n] = x2[at : at + n] - x1[at : at + n]
            if kind in (HEADING, ANGLE):
                d[k] = wrap(d[k])
        return d

    def rotated(self, x: Array, phi: float) -> Array:
        """Return x after rotating the world by phi (rad) about its origin."""
        x = np.array(x, dtype=np.float64)
        for kind, at, _ in self.atoms:
            if kind == VECTOR:
                x[at : at + 2] = rotation(phi) @ x[at : at + 2]
            elif kind == HEADING:
                x[at] = wrap(x[at] + phi)
        return x

    def generator(self, x: Array) -> Array:
        """Return the derivative (dof,) of `rotated` at phi = 0."""
        return generator(self.atoms, np.asarray(x, dtype=np.float64), self.dof)


SE2 = Space("SE2", (VECTOR, HEADING))
POINT2 = Space("point", (VECTOR,))


def Rn(n: int) -> Space:
    """Return the space of n plain numbers that no rotation of the world changes."""
    return Space(f"R{n}", (SCALAR,) * n)
