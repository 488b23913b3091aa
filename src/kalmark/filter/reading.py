"""How blocks of a postponed map are read together, those at rest where they are."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

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


AT_ONCE = 32  # blocks at rest to be read jointly, where that is not asked for


class Resting(NamedTuple):
    """Blocks at rest, laid out one after the other: their means x, their Jacobian G in `_resting_rows`, the covariance
    Q that they have besides, and where the last leap left them.
    """

    x: Array
    G: Array
    Q: Array
    x_left: Array


def resting(map_: PostponedMap, slots: Index) -> Resting:
    """Return blocks at rest as they are now, all carried along at once."""
    _, atoms, x, C = kept(map_, slots)
    return Resting(*carried_along(atoms, x, C, *map_._way()))


def places(map_: PostponedMap, slots: Index, d: int) -> Array:
    """Return the first d numbers (K, d) of blocks at rest."""
    out = np.empty((len(slots), d))
    for i in range(0, len(slots), AT_ONCE):
        some = slots[i : i + AT_ONCE]
        blocks, atoms, x, C = kept(map_, some)
        x = carried_along(atoms, x, C, *map_._way())[0]
        out[i : i + AT_ONCE] = x[blocks[:, :1] + np.arange(d)]
    return out


def kept(map_: PostponedMap, slots: Index) -> tuple[Table, Table, Array, Array]:
    """Return the tables of blocks at rest, laid out one after the other, the mean that they have come to rest with,
    and their covariance with the shadows and, behind that, their own.
    """
    if map_._job is not None:
        map_._job.know(slots)
    blocks, atoms, numbers, rows = laid_out(map_.blocks[slots], map_.atoms)
    return blocks, atoms, map_.x[numbers], map_._read(rows, np.concatenate([map_._A0, rows]))


@compiled
def carried_along(
    atoms: Table, x: Array, C: Array, S: Array, U: Array, robots: Index, turn: Array, turns: Array, origins: Array,
    axes: int,
) -> tuple[Array, Array, Array, Array]:  # fmt: skip
    """Return `Resting` of blocks as they are `kept`, which have come a `Way`."""
    count = C.shape[1] - len(C)
    G = C[:, :count].copy()
    x, x_left, a = carried(atoms, x, G, S, U, robots, turn, turns, origins, axes)
    return x, np.concatenate((G, a), axis=1), C[:, count:].copy(), x_left


def joint(map_: PostponedMap, slots: Sequence[int]) -> Array:
    """Return the joint covariance of blocks, in the order given."""
    m, first, _, here = excerpt(map_, slots[0], -1, np.array(slots[1:], dtype=np.int64))
    return m.covariance([first, *here.tolist()])


def excerpt(map_: PostponedMap, robot: int, mount: int, slots: Index) -> tuple[StochasticMap, int, int, Index]:
    """Return a dense map to read these blocks from, and their slots there: the active one if all are there."""
    own, rest, here = told_apart(map_._at, np.concatenate([[robot, mount], slots]))
    m = map_.active
    if not len(rest):
        return m, int(map_._at[robot]), map_._owners.get(mount, -1), map_._at[slots]
    active = m.x, m.P, m.blocks[own], m.atoms, map_._resting_rows()
    all_: tuple[Any, ...] = (*active, *kept(map_, rest), *map_._way())
    return StochasticMap.of(*joined(*all_), map_.axes), int(here[0]), int(here[1]), here[2:]


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
    blocks_B: Table, atoms_B: Table, x_B: Array, C: Array,
    S: Array, U: Array, robots: Index, turn: Array, turns: Array, origins: Array, axes: int,
) -> tuple[Array, Array, Table, Table]:  # fmt: skip
    """Return mean, covariance and tables of some active blocks, followed by blocks B at rest as they are `kept`.

    P_BA = G P, P_BB = G P G' + Q, where G is in the rows `extra` of P.
    """
    x_B, G, Q, _ = carried_along(atoms_B, x_B, C, S, U, robots, turn, turns, origins, axes)
    own, table, numbers, rows = laid_out(blocks, atoms)
    e, n, b, a = len(extra), len(rows), len(own), len(table)
    P_own = kernels.submatrix(P, np.concatenate((extra, rows)))
    B = G @ P_own[:e]
    joint = np.empty((n + len(G), n + len(G)))
    joint[:n, :n], joint[n:, :n], joint[:n, n:] = P_own[e:, e:], B[:, e:], B[:, e:].T
    P_BB = np.ascontiguousarray(B[:, :e]) @ G.T + Q
    joint[n:, n:] = 0.5 * (P_BB + P_BB.T)
    own, table = np.concatenate((own, blocks_B)), np.concatenate((table, atoms_B))
    own[b:, 0] += len(numbers)
    own[b:, 2] += n
    own[b:, 4] += a
    table[a:, 1] += len(numbers)
    table[a:, 2] += n
    return np.concatenate((x[numbers], x_B)), joint, own, table
