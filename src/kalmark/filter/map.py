"""The stochastic map: one joint Gaussian over blocks (robots, landmarks, ...), {x, P} of [S] (5)-(6).

A block has a mean in its space and a range in the covariance.  A removed block leaves its slot to the next of its
size.  The buffers double when they are full, so that a new landmark costs O(n), [S] 2.3.4.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from kalmark.compiled import compiled
from kalmark.errors import MapError
from kalmark.filter import kernels
from kalmark.filter.fresh import Fresh
from kalmark.geometry.spaces import REMOVED, Space, Table

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]

CAPACITY = 72  # an odd number of cache lines, and so its successors: rows of 2^k keep a column in few places of a cache

X_AT, X_SIZE, P_AT, P_SIZE, ATOM_AT, ATOMS = range(6)  # columns of `blocks`


def next_capacity(capacity: int) -> int:
    """Return the capacity that follows when this one is full."""
    return 2 * capacity + 8


class Layout:
    """Where blocks are: their slots, means, and the rows they have in a covariance that a subclass keeps.

    Blocks are addressed by slots, the rows of `blocks`; names are the caller's business.
    """

    def __init__(self, capacity: int = CAPACITY) -> None:
        self.x: Array = np.zeros(capacity)
        self.x_first: Array = np.zeros(capacity)  # where each block was first estimated, robots last predicted
        self.blocks: Table = np.zeros((0, 6), dtype=np.int64)
        self.atoms: Table = np.zeros((0, 3), dtype=np.int64)
        self.spaces: list[Space | None] = []
        self.used = 0  # slots
        self.axes = 1  # of the gauge: 1 in the plane, 3 in space, 6 where translations have a generator, too
        self.n = 0  # rows of P in use
        self.x_n = 0  # numbers of x in use
        self._free: dict[tuple[int, ...], list[int]] = {}
        self._rows: dict[int, Index] = {}  # and the numbers, by slot, as far as anyone has asked for them
        self._numbers: dict[int, slice] = {}

    def rows(self, slot: int) -> Index:
        """Return the rows of P of a block, to be read only."""
        rows = self._rows.get(slot)
        if rows is None:
            at = self.blocks[slot, P_AT]
            rows = self._rows[slot] = np.arange(at, at + self.blocks[slot, P_SIZE])
        return rows

    def numbers(self, slot: int) -> slice:
        """Return where a block's mean is in x."""
        where = self._numbers.get(slot)
        if where is None:
            at = int(self.blocks[slot, X_AT])
            where = self._numbers[slot] = slice(at, at + int(self.blocks[slot, X_SIZE]))
        return where

    def _place(self, space: Space, mean: Array) -> int:
        """Return a slot for a block, its mean written, its rows of P not yet."""
        if mean.shape != (space.size,):
            raise MapError(f"a {space.name} has {space.size} numbers, got an array of shape {mean.shape}")
        free = self._free.get(space.kinds)
        slot = free.pop() if free else self._append(space)
        _, _, _, _, atom_at, count = self.blocks[slot]
        self.atoms[atom_at : atom_at + count, 0] = space.kinds
        self.spaces[slot], self.used = space, self.used + 1
        self.axes = max(self.axes, 6 if space.steps else space.axes)
        where = self.numbers(slot)
        self.x[where] = self.x_first[where] = mean
        return slot

    def _append(self, space: Space) -> int:
        first = self._first_row(space.dof)
        self._reserve(max(self.x_n + space.size, first + space.dof))
        row = [self.x_n, space.size, first, space.dof, len(self.atoms), len(space.kinds)]
        self.blocks = _appended(self.blocks, np.array([row]))
        self.atoms = _appended(self.atoms, space.atoms + np.array([0, self.x_n, first]))
        self.spaces.append(space)
        self.x_n, self.n = self.x_n + space.size, first + space.dof
        return len(self.blocks) - 1

    def _first_row(self, dof: int) -> int:
        """Return where the rows of a new block begin."""
        return self.n

    def _reserve(self, size: int) -> None:
        """Make room for a mean and a covariance of that size."""
        capacity = len(self.x)
        if size > capacity:
            bigger = max((size + 7) // 16 * 16 + 8, next_capacity(capacity))
            x, x_first = np.zeros(bigger), np.zeros(bigger)
            x[:capacity], x_first[:capacity] = self.x, self.x_first
            self.x, self.x_first = x, x_first

    def _vacate(self, slot: int) -> None:
        """Forget a block; its slot is free for another of its shape."""
        space = self.spaces[slot]
        assert space is not None
        self.x[self.numbers(slot)] = 0.0
        self._free.setdefault(space.kinds, []).append(slot)
        atom_at, count = self.blocks[slot, ATOM_AT], self.blocks[slot, ATOMS]
        self.atoms[atom_at : atom_at + count, 0] = REMOVED
        self.spaces[slot], self.used = None, self.used - 1


class StochasticMap(Layout):
    """The joint Gaussian of all blocks, dense: predict O(n), correct O(n^2), augment O(n), reduce O(n).

    P is a lower triangle.
    """

    def __init__(self, capacity: int = CAPACITY) -> None:
        super().__init__(capacity)
        self.P: Array = np.zeros((capacity, capacity))
        self._next: Array | None = None  # a larger one
        self.fresh = Fresh()

    @classmethod
    def of(cls, x: Array, P: Array, blocks: Table, atoms: Table, axes: int) -> StochasticMap:
        """Return a map to be read only, of these arrays."""
        m = cls.__new__(cls)
        m._rows, m._numbers = {}, {}
        m.x, m.P, m.blocks, m.atoms, m.axes, m.n, m.x_n = x, P, blocks, atoms, axes, len(P), len(x)
        return m

    # ------------------------------------------------------------------ reading
    def index(self, slot: int) -> Index:
        """Return the rows of P of a block."""
        return self.rows(slot)

    def mean(self, slot: int) -> Array:
        """Return a copy of a block's mean."""
        return self.x[self.numbers(slot)].copy()

    def first(self, slot: int) -> Array:
        """Return a copy of a block's first estimate, of a robot its last predicted one."""
        return self.x_first[self.numbers(slot)].copy()

    def covariance(self, slots: Sequence[int]) -> Array:
        """Return the joint covariance of blocks, in the order given."""
        return kernels.submatrix(self.P, np.concatenate([self.index(s) for s in slots]))

    def means(self, slots: Index, d: int) -> Array:
        """Return the first d numbers (K, d) of blocks."""
        return self.x[self.blocks[slots, X_AT][:, None] + np.arange(d)]

    def awake(self) -> tuple[Array, Table, Index]:
        """Return the means that are kept up to date, the blocks they belong to and the slots of these, -1 for none."""
        return self.x, self.blocks, np.arange(len(self.blocks))

    def excerpt(self, robot: int, mount: int, slots: Index) -> tuple[StochasticMap, int, int, Index]:
        """Return a dense map to read these blocks from, and their slots there."""
        return self, robot, mount, slots

    # ------------------------------------------------------------------ growing and shrinking
    def add(self, space: Space, mean: Any, cov: Any = None) -> int:
        """Add a block that is independent of all others (`cov` None: known exactly); return its slot."""
        slot = self._place(space, np.asarray(mean, dtype=np.float64))
        at, d = self.blocks[slot, P_AT], self.blocks[slot, P_SIZE]
        kernels.clear(self.P, self.n, at, d)
        if cov is not None:
            self.P[at : at + d, at : at + d] = cov
        return slot

    def augment(self, space: Space, mean: Array, index: Index, G: Array, Q: Array) -> int:
        """Add a block computed from the rows `index`: P_Lx = G P_x, P_LL = G P G' + Q.  [S] (35)-(38)."""
        slot = self._place(space, mean)
        kernels.augment(self.P, self.n, self.blocks[slot, P_AT], index, np.ascontiguousarray(G), Q)
        return slot

    def remove(self, slot: int) -> None:
        """Marginalise a block out; its slot is free for another of its shape.  [S] Table 1, state reduction."""
        kernels.clear(self.P, self.n, self.blocks[slot, P_AT], self.blocks[slot, P_SIZE])
        self._vacate(slot)

    def reset(self) -> None:
        """Forget all blocks, keep the room."""
        self.blocks, self.atoms, self.spaces, self.used = self.blocks[:0], self.atoms[:0], [], 0
        self.n, self.x_n, self._free, self._rows, self._numbers = 0, 0, {}, {}, {}

    def _reserve(self, size: int) -> None:
        super()._reserve(size)
        capacity, bigger = len(self.P), len(self.x)
        if bigger > capacity:
            P, self._next = self._next, None
            if P is None or len(P) != bigger:
                P = np.zeros((bigger, bigger))
            P[:capacity, :capacity] = self.P
            self.P = P

    def prepare(self) -> int:
        """Have a larger buffer ready in time; return how many bytes of it were used for the first time now."""
        if self._next is None and 2 * self.n > len(self.P):
            size = next_capacity(len(self.P))
            self._next = np.zeros((size, size))
            self.fresh.put(self._next, 0, size * size)
        return self.fresh.use_some()

    # ------------------------------------------------------------------ moving
    def predict(self, index: Index, F: Array, Q: Array) -> None:
        """P <- F P F' + Q, F and Q acting on the rows `index` alone.  [S] (15)-(17)."""
        kernels.predict(self.P, self.n, index, F, Q)

    def set_predicted(self, slot: int, mean: Array) -> None:
        """Write a block's mean after a motion."""
        where = self.numbers(slot)
        self.x[where] = self.x_first[where] = mean

    # ------------------------------------------------------------------ correcting
    def opened(self, robot: int, mount: int, slots: Index, transports: bool) -> tuple[StochasticMap, int, int, Index]:
        """Return the dense map on which a scan of these blocks is fused, and their slots there."""
        return self, robot, mount, slots

    def corrected(self, robot: int, transports: bool) -> None:
        """Take note that `robot` has corrected what `opened` returned."""
        self.prepare()


def _appended(table: Table, rows: Table) -> Table:
    """Return the table with rows at its end, in a buffer that doubles when it is full."""
    count = len(table)
    buffer = table.base
    if buffer is None or count + len(rows) > len(buffer):
        buffer = np.zeros((max(64, 2 * (count + len(rows))), table.shape[1]), dtype=np.int64)
        buffer[:count] = table
    buffer[count : count + len(rows)] = rows
    return buffer[: count + len(rows)]


@compiled
def laid_out(blocks: Table, atoms: Table) -> tuple[Table, Table, Index, Index]:
    """Return the tables of these blocks, one after the other, and the numbers and rows they had before."""
    own, table = np.empty_like(blocks), np.empty((blocks[:, 5].sum(), 3), np.int64)
    numbers, rows = np.empty(blocks[:, 1].sum(), np.int64), np.empty(blocks[:, 3].sum(), np.int64)
    x_to = p_to = atom_to = 0
    for k in range(len(blocks)):
        x_at, x_size, p_at, p_size, atom_at, count = blocks[k]
        own[k, 0], own[k, 1], own[k, 2], own[k, 3], own[k, 4], own[k, 5] = x_to, x_size, p_to, p_size, atom_to, count
        for i in range(x_size):
            numbers[x_to + i] = x_at + i
        for i in range(p_size):
            rows[p_to + i] = p_at + i
        for i in range(count):
            kind, x, p = atoms[atom_at + i]
            table[atom_to + i, 0], table[atom_to + i, 1], table[atom_to + i, 2] = kind, x - x_at + x_to, p - p_at + p_to
        x_to, p_to, atom_to = x_to + x_size, p_to + p_size, atom_to + count
    return own, table, numbers, rows
