"""How blocks of a postponed map are read together, those at rest where they are."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import numpy.typing as npt

from kalmark.compiled import compiled
from kalmark.filter import kernels
from kalmark.filter.leap import carried
from kalmark.filter.map import StochasticMap, laid_out
from kalmark.geometry.spaces import Table

if TYPE_CHECKING:
    from kalmark.filter.postponed import PostponedMap

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]


NONE = np.zeros(0, dtype=np.int64)
AT_ONCE = 32  # blocks at rest to be read jointly, where that is not asked for


class Resting(NamedTuple):
    """Blocks at rest, laid out one after the other: their tables and means x there, their Jacobian G in
    `_resting_rows`, the covariance Q that they have besides, and where the last leap left them.
    """

    slots: Index
    blocks: Table
    atoms: Table
    x: Array
    G: Array
    Q: Array
    x_left: Array

    def places(self, d: int) -> Array:
        """Return the first d numbers (K, d) of each."""
        return self.x[self.blocks[:, :1] + np.arange(d)]


def resting(map_: PostponedMap, slots: Index) -> Resting:
    """Return blocks at rest as they are now, all carried along at once."""
    if map_._job is not None:
        map_._job.know(slots)
    blocks, atoms, numbers, rows = laid_out(map_.blocks[slots], map_.atoms)
    C = map_._read(rows, np.concatenate([map_._A0, rows]))
    return Resting(slots, blocks, atoms, *carried_along(atoms, map_.x[numbers], C, *map_._way()))


@compiled
def carried_along(
    atoms: Table, x: Array, C: Array, S: Array, U: Array, robots: Index, turn: Array, turns: Array, origins: Array,
    axes: int,
) -> tuple[Array, Array, Array, Array]:  # fmt: skip
    """Return x, G, Q and x_left of `Resting`, C being the covariance with the shadows and, behind that, their own."""
    count = C.shape[1] - len(C)
    G = C[:, :count].copy()
    x, x_left, a = carried(atoms, x, G, S, U, robots, turn, turns, origins, axes)
    return x, np.concatenate((G, a), axis=1), C[:, count:].copy(), x_left


def places(map_: PostponedMap, slots: Index, d: int) -> Array:
    """Return the first d numbers (K, d) of blocks at rest."""
    parts = [slots[i : i + AT_ONCE] for i in range(0, len(slots), AT_ONCE)]
    return np.concatenate([resting(map_, part).places(d) for part in parts])


def joint(map_: PostponedMap, slots: Sequence[int]) -> Array:
    """Return the joint covariance of blocks, in the order given."""
    m, first, _, here = excerpt(map_, slots[0], -1, np.array(slots[1:], dtype=np.int64))
    return m.covariance([first, *here.tolist()])


def excerpt(
    map_: PostponedMap, robot: int, mount: int, slots: Index, read: Resting | None = None
) -> tuple[StochasticMap, int, int, Index]:
    """Return a dense map to read these blocks from, and their slots there: the active one if all are there.

    `read` are those at rest among them if they have been read since anything changed, and others.
    """
    first = NONE if read is None else read.slots
    own, rest, here = told_apart(map_._at, np.concatenate([[robot, mount], first, slots]))
    if not len(rest):
        return map_.active, int(map_._at[robot]), map_._owners.get(mount, -1), map_._at[slots]
    m, now = map_.active, read if read is not None and len(first) == len(rest) else resting(map_, rest)
    x, P, blocks, atoms = joined(
        m.x, m.P, m.blocks[own], m.atoms, map_._resting_rows(), now.x, now.blocks, now.atoms, now.G, now.Q
    )
    return StochasticMap.of(x, P, blocks, atoms, map_.axes), int(here[0]), int(here[1]), here[2 + len(first) :]


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
def joined(
    x: Array, P: Array, blocks: Table, atoms: Table, extra: Index,
    x_B: Array, blocks_B: Table, atoms_B: Table, G: Array, Q: Array,
) -> tuple[Array, Array, Table, Table]:  # fmt: skip
    """Return mean, covariance and tables of active blocks followed by blocks B at rest, whose G is in the rows `extra`.

    P_BA = G P, P_BB = G P G' + Q.
    """
    own, table, numbers, rows = laid_out(blocks, atoms)
    e, n = len(extra), len(rows)
    S = kernels.submatrix(P, np.concatenate((extra, rows)))
    B = G @ S[:e]
    joint = np.empty((n + len(G), n + len(G)))
    joint[:n, :n], joint[n:, :n], joint[:n, n:] = S[e:, e:], B[:, e:], B[:, e:].T
    C = np.ascontiguousarray(B[:, :e]) @ G.T + Q
    joint[n:, n:] = 0.5 * (C + C.T)
    count = len(own)
    own, table = np.concatenate((own, blocks_B)), np.concatenate((table, atoms_B))
    own[count:, 0] += len(numbers)
    own[count:, 2] += n
    own[count:, 4] += len(table) - len(atoms_B)
    table[len(table) - len(atoms_B) :, 1] += len(numbers)
    table[len(table) - len(atoms_B) :, 2] += n
    return np.concatenate((x[numbers], x_B)), joint, own, table
