"""How blocks of a postponed map are read together, those at rest where they are."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import numpy.typing as npt

from kalmark.compiled import compiled
from kalmark.filter import kernels
from kalmark.filter.map import StochasticMap, laid_out
from kalmark.geometry.spaces import Table

if TYPE_CHECKING:
    from kalmark.filter.postponed import PostponedMap

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]


class Resting(NamedTuple):
    """Blocks at rest, laid out one after the other: their tables and means x there, their Jacobian G in
    `_resting_rows`, the covariance Q that they have besides, and where the last leap left them.
    """

    blocks: Table
    atoms: Table
    x: Array
    G: Array
    Q: Array
    x_left: Array


def resting(map_: PostponedMap, slots: Index) -> Resting:
    """Return blocks at rest as they are now, all carried along at once."""
    if map_._job is not None:
        map_._job.know(slots)
    blocks, atoms, numbers, rows = laid_out(map_.blocks[slots], map_.atoms)
    count = len(map_._A0)
    C = map_._read(rows, np.concatenate([map_._A0, rows]))
    now = map_._way().carried(atoms, map_.x[numbers], C[:, :count])
    G, Q = np.concatenate([C[:, :count], now.a], axis=1), C[:, count:].copy()
    return Resting(blocks, atoms, now.x, G, Q, now.x_left)


def places(map_: PostponedMap, slots: Index, d: int) -> Array:
    """Return the first d numbers (K, d) of blocks at rest."""
    now = resting(map_, slots)
    return now.x[now.blocks[:, :1] + np.arange(d)]


def joint(map_: PostponedMap, slots: Sequence[int]) -> Array:
    """Return the joint covariance of blocks, in the order given."""
    m, first, _, here = excerpt(map_, slots[0], -1, np.array(slots[1:], dtype=np.int64))
    return m.covariance([first, *here.tolist()])


def excerpt(map_: PostponedMap, robot: int, mount: int, slots: Index) -> tuple[StochasticMap, int, int, Index]:
    """Return a dense map to read these blocks from, and their slots there: the active one if all are there."""
    own, rest, here = told_apart(map_._at, np.concatenate([[robot, mount], slots]))
    if not len(rest):
        return map_.active, int(map_._at[robot]), map_._owners.get(mount, -1), map_._at[slots]
    m, asleep = map_.active, resting(map_, rest)
    blocks, atoms, numbers, rows = laid_out(m.blocks[own], m.atoms)
    moved = np.array([len(numbers), 0, len(rows), 0, len(atoms), 0])
    x, P = np.concatenate([m.x[numbers], asleep.x]), joined(m.P, rows, map_._resting_rows(), asleep.G, asleep.Q)
    blocks = np.concatenate([blocks, asleep.blocks + moved])
    atoms = np.concatenate([atoms, asleep.atoms + np.array([0, len(numbers), len(rows)])])
    return StochasticMap.of(x, P, blocks, atoms, map_.axes), int(here[0]), int(here[1]), here[2:]


@compiled
def told_apart(at: Index, slots: Index) -> tuple[Index, Index, Index]:
    """Return of blocks those that are active, as what they are in the active map, and those at rest, each once.

    And the place (K,) of each where those that are active come first; a slot of -1 is none.
    """
    own, rest, here = np.empty(len(slots), np.int64), np.empty(len(slots), np.int64), np.full(len(slots), -1)
    n = m = 0
    for k in range(len(slots)):
        if slots[k] < 0:
            continue
        active = at[slots[k]] >= 0
        some, number, count = (own, at[slots[k]], n) if active else (rest, slots[k], m)
        i = 0
        while i < count and some[i] != number:
            i += 1
        if i == count:
            some[i] = number
            n, m = (n + 1, m) if active else (n, m + 1)
        here[k] = i if active else -2 - i
    for k in range(len(slots)):
        if here[k] < -1:
            here[k] = n - 2 - here[k]
    return own[:n].copy(), rest[:m].copy(), here


@compiled
def joined(P: Array, rows: Index, extra: Index, G: Array, Q: Array) -> Array:
    """Return the covariance of these rows of P and of blocks B at rest: P_BA = G P, P_BB = G P G' + Q.

    G is in the rows `extra` of P.
    """
    e, n = len(extra), len(rows)
    S = kernels.submatrix(P, np.concatenate((extra, rows)))
    B = G @ S[:e]
    out = np.empty((n + len(G), n + len(G)))
    out[:n, :n], out[n:, :n], out[:n, n:] = S[e:, e:], B[:, e:], B[:, e:].T
    C = np.ascontiguousarray(B[:, :e]) @ G.T + Q
    out[n:, n:] = 0.5 * (C + C.T)
    return out
