"""Spaces of the blocks of the map: products of a few atoms, each with plus, minus, rotated and generator.

An atom is the smallest piece that a rotation of the world treats in its own way.  A block type is a list of atoms, so
the filter handles any block, and a new kind of block needs no code in the filter:

===========  =============  ==================================================  =================
atom         mean / error   rotating the world by E                             generator
===========  =============  ==================================================  =================
SCALAR       1 / 1          nothing (depth, signature, bias, body rate, noise)  0
VECTOR       2 / 2          E x (point, velocity; plane)                        J x
HEADING      1 / 1          + angle, wrapped                                    1
ANGLE        1 / 1          nothing, but wrapped (a mount's angle)              0
VECTOR3      3 / 3          E x (point, velocity, ray; space)                   -[x]x
ROTATION     4 / 3          E R (quaternion xyzw)                               I
DIRECTION    2 / 2          of E m (azimuth, elevation of the unit vector m)    -Y_m [m]x
TURNED       4 / 3          nothing (a mount's quaternion)                      0
HOMOGENEOUS  4 / 4          E h, rho (the point h / rho)                        -[h]x, 0
PLUECKER     6 / 6          E n, E v (the line of direction v, moment n)        -[n]x, -[v]x
ANCHOR       3 / 3          as VECTOR3: where inverse distances count from      -[x]x
RHO          1 / 1          as SCALAR: the inverse of a distance to the ANCHOR  0
                            (in the plane, to the VECTOR its block begins with)
OWN          3 / 3          as VECTOR3: of a robot, moved by its own rotation   -[x]x
                            (the ROTATION before it)
===========  =============  ==================================================  =================

Orientation errors are world errors, R = Exp(d) R_hat, positions and landmarks are additive world vectors: Sola's 2-D
coordinates and their 3-D counterpart.

HOMOGENEOUS and PLUECKER are moved by a translation t of the world by what depends on their value, h + rho t and
n + t x v, so that translation has a generator, too: rho I and -[v]x.  All others are moved by what does not, and need
none.  For inverse distances see `filter/parallax.py`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np

from kalmark.arrays import Array, Index
from kalmark.compiled import compiled
from kalmark.geometry.angles import exponential_v, rotation, wrap
from kalmark.geometry.directions import direction_many, spherical_many
from kalmark.geometry.rotations import conjugate, exp, left_jacobian, log, matrix, multiply, skew

Table = Index

SCALAR, VECTOR, HEADING, ANGLE, VECTOR3, ROTATION, DIRECTION, TURNED = range(8)
HOMOGENEOUS, PLUECKER, ANCHOR, RHO, OWN = range(8, 13)
REMOVED = -1
MEAN_SIZE = np.array([1, 2, 1, 1, 3, 4, 2, 4, 4, 6, 3, 1, 3])
ERROR_SIZE = np.array([1, 2, 1, 1, 3, 3, 2, 3, 4, 6, 3, 1, 3])
LINEAR = np.array([0, 0, 0, 0, 3, 0, 0, 0, 3, 6, 3, 0, 3])  # leading numbers that are vectors of space

KIND, X_AT, P_AT = 0, 1, 2  # columns of a table of atoms


@compiled
def retract_plane(atoms: Table, x: Array, d: Array, turn: Array) -> None:
    """Move atoms of the plane, and plain numbers, as `retract` does."""
    p, q = exponential_v(turn[0]) if len(turn) == 1 else (1.0, 0.0)
    for i in range(len(atoms)):
        kind, at, k = atoms[i, 0], atoms[i, 1], atoms[i, 2]
        if kind == VECTOR:
            x[at] += p * d[k] - q * d[k + 1]
            x[at + 1] += q * d[k] + p * d[k + 1]
        elif kind in (SCALAR, RHO):
            x[at] += d[k]
        elif kind in (HEADING, ANGLE):
            x[at] = wrap(x[at] + d[k])


@compiled
def retract(atoms: Table, x: Array, d: Array, turn: Array) -> None:
    """Move the mean x (size,) in place by the correction d (dof,): by plain plus, with `turn` by the exponential.

    `turn` is (0,), d_theta (1,) in the plane, (3,) in space, or (xi_p, d_theta) (6,) where a translation matters.
    Points move by V(d_theta) d: rotated by Exp(d_theta), then carried along V xi, since V (generator d_theta) =
    (E - I) l.  Orientations turn by Exp(d_theta), then by their own xi.
    """
    retract_plane(atoms, x, d, turn)
    whole = turn[len(turn) - 3 :] if len(turn) >= 3 else np.zeros(3)
    V = V_own = left_jacobian(whole) if len(turn) >= 3 else np.eye(3)
    for i in range(len(atoms)):
        kind, at, k = atoms[i, 0], atoms[i, 1], atoms[i, 2]
        if kind == ROTATION:
            own, V_own = exp(d[k : k + 3] - whole), left_jacobian(d[k : k + 3]) if len(turn) >= 3 else np.eye(3)
            x[at : at + 4] = multiply(exp(whole), multiply(own, x[at : at + 4]))
        elif kind == TURNED:
            x[at : at + 4] = multiply(exp(d[k : k + 3]), x[at : at + 4])
        elif kind == DIRECTION:
            _retract_direction(x[at : at + 2], d[k : k + 2], whole)
        elif kind >= VECTOR3 and kind != RHO:
            if kind == PLUECKER and len(turn) == 6:
                _move_moment(x[at : at + 6], turn[:3].copy(), V, whole)
            _add_vectors(x[at : at + LINEAR[kind]], V_own if kind == OWN else V, d[k : k + LINEAR[kind]])
            if kind == HOMOGENEOUS:
                x[at + 3] += d[k + 3]


@compiled
def _add_vectors(x: Array, V: Array, d: Array) -> None:
    """Add V d to each vector of three in x (3 k,)."""
    for a in range(0, len(x), 3):
        for j in range(3):
            x[a + j] += V[j, 0] * d[a] + V[j, 1] * d[a + 1] + V[j, 2] * d[a + 2]


@compiled
def _move_moment(x: Array, step: Array, V: Array, turn: Array) -> None:
    """Add to the moment of a Pluecker line x (6,) the product of a large turn and a large step."""
    v = x[3:].copy()
    x[:3] += skew(V @ step) @ (matrix(exp(turn)) @ v) - V @ (skew(step) @ v)


@compiled
def _retract_direction(x: Array, d: Array, turn: Array) -> None:
    """Turn a direction (azimuth, elevation) by Exp(turn), then by its own xi = d - generator turn."""
    step = d.copy()
    if turn.any():
        m = direction_many(x.reshape(1, 2))[0][0]
        step -= _direction_generator(m) @ turn
        x[:] = spherical_many((matrix(exp(turn)) @ m).reshape(1, 3))[0][0, 1:]
    x += step
    if abs(x[1]) > 0.5 * np.pi:  # over the pole
        x[1], x[0] = np.sign(x[1]) * np.pi - x[1], x[0] + np.pi
    x[0] = wrap(x[0])


@compiled
def _direction_generator(m: Array) -> Array:
    """Return how the azimuth and elevation of m (3,) move (2, 3) when the world turns: -Y_m [m]x."""
    Y_m, g = spherical_many(m.reshape(1, 3))[1], np.empty((2, 3))
    for a in range(2):
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            g[a, i] = Y_m[0, 1 + a, k] * m[j] - Y_m[0, 1 + a, j] * m[k]
    return g


@compiled
def generator_plane(atoms: Table, x: Array, size: int, axes: int, origin: Array) -> Array:
    """Return the generator (size, axes) of a rotation of the world, for atoms of the plane, as `generator` does."""
    g = np.zeros((size, axes))
    for i in range(len(atoms)):
        kind, at, k = atoms[i, 0], atoms[i, 1], atoms[i, 2]
        if kind == VECTOR:
            g[k, 0], g[k + 1, 0] = -x[at + 1], x[at]
        elif kind == HEADING:
            g[k, 0] = 1.0
    return g


@compiled
def generator(atoms: Table, x: Array, size: int, axes: int, origin: Array) -> Array:
    """Return how the errors (size, axes) move when the world turns about its origin, d x / d phi.

    With six axes, for maps in which translations matter, the first three are the observing robot's step xi_p; then the
    last three are turns about the robot, which stands at `origin` (3,): d = xi + (generator - generator_t
    generator_p) d_theta + generator_t d_p.
    """
    g, turn = generator_plane(atoms, x, size, axes, origin), axes - 3
    for i in range(len(atoms)):
        kind, at, k = atoms[i, 0], atoms[i, 1], atoms[i, 2]
        if kind == ROTATION:
            for j in range(3):
                g[k + j, turn + j] = 1.0
        elif kind == DIRECTION:
            moved = _direction_generator(direction_many(x[at : at + 2].reshape(1, 2))[0][0])
            for a in range(2):
                for j in range(3):
                    g[k + a, turn + j] = moved[a, j]
        elif kind >= 0 and LINEAR[kind] > 0:
            for a in range(0, LINEAR[kind], 3):
                g[k + a, turn + 1], g[k + a, turn + 2] = x[at + a + 2], -x[at + a + 1]
                g[k + a + 1, turn], g[k + a + 1, turn + 2] = -x[at + a + 2], x[at + a]
                g[k + a + 2, turn], g[k + a + 2, turn + 1] = x[at + a + 1], -x[at + a]
            if kind in (HOMOGENEOUS, PLUECKER) and axes == 6:
                step = x[at + 3] * np.eye(3) if kind == HOMOGENEOUS else -skew(x[at + 3 : at + 6])
                back = skew(origin)
                for a in range(3):
                    for j in range(3):
                        g[k + a, j] = step[a, j]
                        g[k + a, 3 + j] += step[a, 0] * back[0, j] + step[a, 1] * back[1, j] + step[a, 2] * back[2, j]
    return g


NO_TURN = np.zeros(0)


@dataclass(frozen=True)
class Space:
    """A product of atoms; `names` label its error coordinates.

    >>> km.geometry.SE2.size, km.geometry.SE2.dof
    (3, 3)
    >>> km.geometry.SE2.plus(np.array([0.0, 0.0, 3.0]), np.array([1.0, 0.0, 0.5])).round(3)
    array([ 1.   ,  0.   , -2.783])
    """

    name: str
    kinds: tuple[int, ...]

    @cached_property
    def atoms(self) -> Table:
        """The atoms (N, 3), rows of kind, offset in the mean, offset in the error."""
        rows, x_at, p_at = [], 0, 0
        for kind in self.kinds:
            rows.append((kind, x_at, p_at))
            x_at, p_at = x_at + int(MEAN_SIZE[kind]), p_at + int(ERROR_SIZE[kind])
        return np.array(rows, dtype=np.int64).reshape(-1, 3)

    @cached_property
    def size(self) -> int:
        """Numbers in a mean."""
        return sum(int(MEAN_SIZE[k]) for k in self.kinds)

    @cached_property
    def dof(self) -> int:
        """Numbers in an error."""
        return sum(int(ERROR_SIZE[k]) for k in self.kinds)

    def plus(self, x: Array, d: Array) -> Array:
        """Return x (size,) moved by the error d (dof,)."""
        x, moved = np.array(x, dtype=np.float64), retract if self.world == "space" else retract_plane
        moved(self.atoms, x, np.array(d, dtype=np.float64), NO_TURN)
        return x

    def minus(self, x2: Array, x1: Array) -> Array:
        """Return the error d (dof,) with x1 plus d = x2, both (size,)."""
        d = np.empty(self.dof)
        x1, x2 = np.asarray(x1, dtype=np.float64), np.asarray(x2, dtype=np.float64)
        for kind, at, k in self.atoms:
            n = ERROR_SIZE[kind]
            if kind in (ROTATION, TURNED):
                d[k : k + 3] = log(multiply(x2[at : at + 4], conjugate(x1[at : at + 4])))
                continue
            d[k : k + n] = x2[at : at + n] - x1[at : at + n]
            if kind in (HEADING, ANGLE, DIRECTION):
                d[k] = wrap(d[k])
        return d

    @cached_property
    def axes(self) -> int:
        """Axes the world can turn about: 1 in the plane, 3 in space."""
        return 3 if self.world == "space" else 1

    @property
    def d(self) -> int:
        """Dimensions of its world: 2 in the plane, 3 in space."""
        return 3 if self.world == "space" else 2

    @property
    def pose(self) -> Space:
        """The space of the poses of its world: `SE2` or `SE3`."""
        return SE3 if self.world == "space" else SE2

    @cached_property
    def steps(self) -> bool:
        """True if a translation of the world moves it by what depends on its value."""
        return HOMOGENEOUS in self.kinds or PLUECKER in self.kinds

    @cached_property
    def world(self) -> str:
        """The world it belongs to: "plane", "space", or "" for plain numbers, which fit either."""
        if any(kind >= VECTOR3 and kind != RHO for kind in self.kinds):
            return "space"
        return "plane" if any(kind in (VECTOR, HEADING) for kind in self.kinds) else ""

    def rotated(self, x: Array, phi: Any) -> Array:
        """Return x (size,) after a rotation of the world about its origin by phi (rad), in space a vector (3,)."""
        x = np.array(x, dtype=np.float64)
        turn = exp(np.array(phi, dtype=np.float64)) if self.axes == 3 else np.zeros(4)
        for kind, at, _ in self.atoms:
            if kind == VECTOR:
                x[at : at + 2] = rotation(phi) @ x[at : at + 2]
            elif kind == HEADING:
                x[at] = wrap(x[at] + phi)
            elif kind == ROTATION:
                x[at : at + 4] = multiply(turn, x[at : at + 4])
            elif kind == DIRECTION:
                m = direction_many(x[at : at + 2].reshape(1, 2))[0][0]
                x[at : at + 2] = spherical_many((matrix(turn) @ m).reshape(1, 3))[0][0, 1:]
            for a in range(0, LINEAR[kind], 3):
                x[at + a : at + a + 3] = matrix(turn) @ x[at + a : at + a + 3]
        return x

    def generator(self, x: Array) -> Array:
        """Return the derivative (dof, axes) of `rotated` at phi = 0."""
        turned = generator if self.world == "space" else generator_plane
        return turned(self.atoms, np.array(x, dtype=np.float64), self.dof, self.axes, np.zeros(3))


SE2 = Space("SE2", (VECTOR, HEADING))
"""Poses of the plane: x, y [m] and the heading [rad]."""
POINT2 = Space("point", (VECTOR,))
"""Points of the plane: x, y [m]."""
SE3 = Space("SE3", (VECTOR3, ROTATION))
"""Poses in space: x, y, z [m] and a quaternion, its real part last; errors have six numbers."""
POINT3 = Space("point3", (VECTOR3,))
"""Points in space: x, y, z [m]."""
MOUNTS = {3: Space("mount", (SCALAR, SCALAR, ANGLE)), 7: Space("mount in space", (SCALAR, SCALAR, SCALAR, TURNED))}


def mount_space(pose: int, parameters: int = 0) -> Space:
    """Return the space of a mount, 3 or 7 numbers, followed by the sensor's own parameters."""
    mount = MOUNTS[pose]
    return Space(mount.name, (*mount.kinds, *(SCALAR,) * parameters)) if parameters else mount


@lru_cache
def Rn(n: int) -> Space:
    """Return the space of n plain numbers that no rotation of the world changes.

    >>> km.geometry.Rn(4).dof
    4
    """
    return Space(f"R{n}", (SCALAR,) * n)
