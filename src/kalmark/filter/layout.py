"""The blocks of a map: their slots, their means, and their rows in a covariance."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from kalmark.arrays import Array, Index
from kalmark.compiled import compiled
from kalmark.errors import MapError
from kalmark.geometry.spaces import ANGLE, OWN, REMOVED, RHO, TURNED, Space, Table

State = dict[str, Any]  # of a JSON file
Read = Callable[[str, tuple[int, ...]], Array]  # of a name and the shape expected

CAPACITY = 72  # an odd number of cache lines, and so its successors: rows of 2^k keep a column in few places of a cache

TURNING = frozenset((ANGLE, TURNED, OWN))  # atoms of a mount and of an inertial unit

X_AT, X_SIZE, P_AT, P_SIZE, ATOM_AT, ATOMS = range(6)  # columns of `blocks`


def next_capacity(capacity: int) -> int:
    """Return the capacity that follows when this one is full."""
    return 2 * capacity + 8


class Layout:
    """The slots and means of blocks, and the rows they have in a covariance that a subclass keeps.

    A block is addressed by its slot, a row of `blocks`; who calls gives it a name.
    """

    def __init__(self, capacity: int = CAPACITY) -> None:
        self.x: Array = np.zeros(capacity)
        self.x_first: Array = np.zeros(capacity)  # where each block was first estimated, robots last predicted
        self.blocks: Table = np.zeros((0, 6), dtype=np.int64)
        self.atoms: Table = np.zeros((0, 3), dtype=np.int64)
        self.spaces: list[Space | None] = []
        self.used = 0  # slots
        self.axes = 1  # of the gauge: 1 in the plane, 3 in space, 6 where translations have a generator, too
        self.inverse_depths = False  # whether there are any, or have been,
        self.dependent = False  # and whether a mount or an inertial unit is in the map: vectors may depend on these
        self.n = 0  # rows of P in use
        self.x_n = 0  # numbers of x in use
        self._free: dict[tuple[int, ...], list[int]] = {}
        self._rows: dict[int, Index] = {}  # by slot, as computed so far; likewise the numbers
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

    def stored(self, slots: Index, d: int) -> Array:
        """Return the first d numbers (K, d) that x has of blocks."""
        return self.x[self.blocks[slots, X_AT][:, None] + np.arange(d)]

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
        self.inverse_depths = self.inverse_depths or RHO in space.kinds
        self.dependent = self.dependent or not TURNING.isdisjoint(space.kinds)
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
        """Remove a block; its slot is free for another of its shape."""
        space = self.spaces[slot]
        assert space is not None
        self.x[self.numbers(slot)] = 0.0
        self._free.setdefault(space.kinds, []).append(slot)
        atom_at, count = self.blocks[slot, ATOM_AT], self.blocks[slot, ATOMS]
        self.atoms[atom_at : atom_at + count, 0] = REMOVED
        self.spaces[slot], self.used = None, self.used - 1

    # ------------------------------------------------------------------ files
    def shapes(self) -> list[Space]:
        """Return the space of each slot; a free one has that of the block that was there."""
        vacant = self._vacant()
        return [vacant[slot] if space is None else space for slot, space in enumerate(self.spaces)]

    def _vacant(self) -> dict[int, Space]:
        return {slot: Space("removed", kinds) for kinds, slots in self._free.items() for slot in slots}

    def free(self) -> list[int]:
        """Return the free slots: of each shape the last one is filled first."""
        return [slot for slots in self._free.values() for slot in slots]

    def state(self) -> State:
        """Return the blocks for a file, without their tables: these are built again, so that they fit the arrays."""
        return {
            "capacity": min(len(self.x), max(1024, 2 * self.n, 2 * self.x_n)),
            "blocks": [[space.name, list(space.kinds)] for space in self.shapes()],
            "free": self.free(),
        }

    def arrays(self) -> Iterator[tuple[str, Array]]:
        """Return the arrays for a file by name."""
        yield "x", self.x[: self.x_n]
        yield "x_first", self.x_first[: self.x_n]

    def removed(self, slot: Any) -> int:
        """Return the slot of a block that a file lists as removed.  Raises MapError if there is none."""
        if type(slot) is not int or not 0 <= slot < len(self.spaces) or self.spaces[slot] is None:
            raise MapError(f"removed slot is {slot!r}, expected each one of {len(self.spaces)} once")
        return slot


def spaces_of(state: State) -> list[Space]:
    """Return the spaces of the blocks of a file.  Raises MapError if the capacity does not fit them."""
    spaces = [Space(str(name), tuple(kinds)) for name, kinds in state["blocks"]]
    n, x_n, capacity = sum(s.dof for s in spaces), sum(s.size for s in spaces), state["capacity"]
    if type(capacity) is not int or not max(n, x_n) <= capacity <= max(1024, 2 * n, 2 * x_n):
        raise MapError(f"capacity is {capacity!r}, expected at least {max(n, x_n)} for the blocks of the map")
    return spaces


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
def concatenate_tables(blocks: Table, atoms: Table) -> tuple[Table, Table, Index, Index]:
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
