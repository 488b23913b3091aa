"""The stochastic map: one joint Gaussian over blocks (robots, landmarks, ...), {x, P} of [S] (5)-(6).

A block has a mean in its space and a range in the covariance.  A removed block leaves its slot to the next of its
size.  The buffers double when they are full, so that a new landmark costs O(n), [S] 2.3.4.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from copy import copy
from typing import Any, NamedTuple, Protocol

import numpy as np

from kalmark.arrays import Array, Index
from kalmark.filter import corrections, kernels
from kalmark.filter.layout import CAPACITY, P_AT, P_SIZE, Layout, Read, State, next_capacity, spaces_of
from kalmark.filter.nearest_blocks import Sorts, distances, near_places, nearest_pairs
from kalmark.filter.nearest_of_each import Asked, Nearest, Seen, nearest_landmarks
from kalmark.filter.prefault import Prefault
from kalmark.geometry.spaces import Space, Table

NO_SLOTS = np.zeros(0, dtype=np.int64)
AT_ONCE = 32  # inactive blocks that are read jointly without a request of the caller


class Marginal(NamedTuple):
    """A dense map that has the joint marginal of some blocks, and their slots there."""

    map: StochasticMap
    robot: int
    mount: int
    slots: Index


class Pairs(NamedTuple):
    """Places (M,) and the `numbers` (M,) of blocks that are near them.

    Of the blocks: their slots (L,), means (L, 2 or 3) and, if not too many are inactive, their joint marginal.
    """

    rows: Index
    numbers: Index
    slots: Index
    places: Array
    marginal: Marginal | None

    @classmethod
    def of(cls, slots: Index, places: Array, read: Marginal | None, p: Array, nearest: int, farther: float) -> Pairs:
        """Return the pairs of p (K, d) and blocks at `places` (N, d): the `nearest` of each, as `limits` has it."""
        rows, numbers, used = nearest_pairs(p, places, nearest, farther)
        marginal = None if read is None else read._replace(slots=read.slots[used])
        return cls(rows, numbers, slots[used], places[used], marginal)


class Map(Protocol):
    """A joint Gaussian over blocks, addressed by their slots: dense or compressed.

    An index of rows holds until the next correction or until a block is added.
    """

    averages: bool  # whether a scan can be fused by the mean over matchings
    dependent: bool  # whether a mount or an inertial unit is in it
    blocks: Table
    atoms: Table
    n: int  # degrees of freedom
    spaces: list[Space | None]

    def index(self, slot: int) -> Index:
        """Return the rows of a block, for `predict` and `augment`."""

    def rows(self, slot: int) -> Index:
        """Return the rows of a block in the covariance of all blocks: as many as it has degrees of freedom."""

    def mean(self, slot: int) -> Array:
        """Return a copy of a block's mean."""

    def first(self, slot: int) -> Array:
        """Return a copy of a block's first estimate, of a robot its last predicted one."""

    def means(self, slots: Index, d: int) -> Array:
        """Return the first d numbers (K, d) of blocks."""

    def covariance(self, slots: Sequence[int]) -> Array:
        """Return the joint covariance of blocks, in the order given."""

    def marginal(self, robot: int, mount: int, slots: Index) -> Marginal:
        """Return the joint marginal of a robot, its mount (-1: not in the map) and blocks, to be read only."""

    def pairs(self, sorts: Sorts, robot: int, mount: int, p: Array, nearest: int, farther: float) -> Pairs:
        """Return the wanted blocks near p (K, 2 or 3): of each place the `nearest`, at most `farther` times the least.

        They are read jointly with the robot and, if it is in the map, the mount.
        """

    def nearest(self, model: Any, scan: Seen, asked: Asked) -> Nearest | None:
        """Return the only wanted block that each observation can be of; None where more is needed to decide that.

        `model` is compiled.
        """

    def around(self, sorts: Sorts, p: Array, count: int) -> Index:
        """Return the slots (N,) of the wanted blocks nearest to p (2 or 3,), nearest first."""

    def add(self, space: Space, mean: Any, cov: Any = None) -> int:
        """Add a block that is independent of all others (`cov` None: known exactly); return its slot."""

    def augment(self, space: Space, mean: Array, index: Index, G: Array, Q: Array) -> int:
        """Add a block computed from the rows `index`: P_Lx = G P_x, P_LL = G P G' + Q.  [S] (35)-(38)."""

    def remove(self, slot: int) -> None:
        """Marginalise a block out; its slot is free for another of its shape.  [S] Table 1, state reduction."""

    def predict(self, index: Index, F: Array, Q: Array) -> None:
        """P <- F P F' + Q, F and Q acting on the rows `index` alone.  [S] (15)-(17)."""

    def set_predicted(self, slot: int, mean: Array) -> None:
        """Write a block's mean after a motion."""

    def movable(self, robot: int, added: Sequence[int]) -> Marginal:
        """Return the dense map on which a robot is moved, by a control to which blocks are `added`; slots there."""

    def opened(self, robot: int, mount: int, slots: Index, transports: bool) -> Marginal:
        """Return the dense map on which a scan of these blocks is fused, and their slots there."""

    def finish_correction(self, robot: int, transports: bool) -> None:
        """Complete the correction of what `opened` returned, by a scan of `robot`."""

    def state(self) -> State:
        """Return the description of the map for a file."""

    def arrays(self) -> Iterator[tuple[str, Array]]:
        """Return the arrays for a file by name."""


class StochasticMap(Layout):
    """The joint Gaussian of all blocks, dense: predict O(n), correct O(n^2), augment O(n), reduce O(n).

    P is a lower triangle.
    """

    averages = True

    def __init__(self, capacity: int = CAPACITY) -> None:
        super().__init__(capacity)
        self.P: Array = np.zeros((capacity, capacity))
        self._next: Array | None = None  # a larger one
        self.prefault = Prefault()

    @classmethod
    def of(
        cls, x: Array, P: Array, blocks: Table, atoms: Table, axes: int, inverse_depths: bool, dependent: bool
    ) -> StochasticMap:  # fmt: skip
        """Return a map to be read only, of these arrays."""
        m = cls.__new__(cls)
        m._rows, m._numbers = {}, {}
        m.x, m.P, m.blocks, m.atoms, m.n, m.x_n = x, P, blocks, atoms, len(P), len(x)
        m.axes, m.inverse_depths, m.dependent = axes, inverse_depths, dependent
        return m

    def with_numbers(self, x: Array, x_first: Array, P: Array) -> StochasticMap:
        """Return a map of the same blocks, which cannot grow, of the means and first estimates (n,) and P (n, n)."""
        other = copy(self)
        vars(other).update(x=x, x_first=x_first, P=P, _next=P)
        return other

    @property
    def whole(self) -> corrections.Map:
        """The map as compiled code takes it."""
        return self.arrays_for(parallax=True)

    def arrays_for(self, parallax: bool) -> corrections.Map:
        """Return the map as compiled code takes it, for a correction of inverse distances by `parallax` or not."""
        ways = corrections.routines(self.axes, parallax and self.inverse_depths, self.dependent)
        return self.x, self.P, self.n, self.blocks, self.atoms, self.axes, ways

    # ------------------------------------------------------------------ reading
    index, means = Layout.rows, Layout.stored

    def mean(self, slot: int) -> Array:
        """Return a copy of a block's mean."""
        return self.x[self.numbers(slot)].copy()

    def first(self, slot: int) -> Array:
        """Return a copy of a block's first estimate, of a robot its last predicted one."""
        return self.x_first[self.numbers(slot)].copy()

    def covariance(self, slots: Sequence[int]) -> Array:
        """Return the joint covariance of blocks, in the order given."""
        return kernels.submatrix(self.P, np.concatenate([self.index(s) for s in slots]))

    def marginal(self, robot: int, mount: int, slots: Index) -> Marginal:
        """Return this map, and the slots as they are."""
        return Marginal(self, robot, mount, slots)

    def pairs(self, sorts: Sorts, robot: int, mount: int, p: Array, nearest: int, farther: float) -> Pairs:
        """Return the wanted blocks near p (K, 2 or 3), all compared."""
        slots, _ = near_places(p, self.x, self.blocks, np.arange(len(self.blocks)), sorts, nearest, farther)
        places = self.stored(slots, p.shape[1])
        return Pairs.of(slots, places, self.marginal(robot, mount, slots), p, nearest, farther)

    def nearest(self, model: Any, scan: Seen, asked: Asked) -> Nearest | None:
        """Return the only wanted block that each observation can be of; None of a scan of which that is not clear."""
        clear, found = nearest_landmarks(model, self.whole, scan, np.arange(len(self.blocks)), asked)
        return Nearest(*found) if clear else None

    def around(self, sorts: Sorts, p: Array, count: int) -> Index:
        """Return the slots (N,) of the wanted blocks nearest to p (2 or 3,), nearest first."""
        slots, _ = near_places(p[None], self.x, self.blocks, np.arange(len(self.blocks)), sorts, count, math.inf)
        gaps = distances(p[None], self.stored(slots, len(p)))[0]
        return slots[np.argsort(gaps, kind="stable")[:count]]

    # ------------------------------------------------------------------ growing and shrinking
    def add(self, space: Space, mean: Any, cov: Any = None) -> int:
        """Add a block that is independent of all others (`cov` None: known exactly); return its slot."""
        slot = self._place(space, np.asarray(mean, dtype=np.float64))
        at, d = self.blocks[slot, P_AT], self.blocks[slot, P_SIZE]
        kernels.clear_block(self.P, self.n, at, d)
        if cov is not None:
            self.P[at : at + d, at : at + d] = cov
        return slot

    def augment(self, space: Space, mean: Array, index: Index, G: Array, Q: Array) -> int:
        """Add a block computed from the rows `index`: P_Lx = G P_x, P_LL = G P G' + Q.  [S] (35)-(38)."""
        return self.extend([space], [mean], index, G, Q)[0]

    def extend(self, spaces: Sequence[Space], means: Sequence[Array], index: Index, G: Array, Q: Array) -> list[int]:
        """Add blocks, as `augment` adds one, with the rows of G (d, k) and Q (d, d) one block after the other."""
        slots = [self._place(space, mean) for space, mean in zip(spaces, means, strict=True)]
        rows = np.concatenate([self.rows(slot) for slot in slots])
        kernels.augment(self.P, self.n, rows, index, np.ascontiguousarray(G), Q)
        return slots

    def remove(self, slot: int) -> None:
        """Marginalise a block out; its slot is free for another of its shape.  [S] Table 1, state reduction."""
        kernels.clear_block(self.P, self.n, self.blocks[slot, P_AT], self.blocks[slot, P_SIZE])
        self._vacate(slot)

    def reset(self) -> None:
        """Remove all blocks, keep the buffers."""
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
        """Prefault a larger buffer bit by bit; return the number of bytes of this call."""
        if self._next is None and 2 * self.n > len(self.P):
            size = next_capacity(len(self.P))
            self._next = np.zeros((size, size))
            self.prefault.add(self._next, 0, size * size)
        return self.prefault.some() if self.prefault.waiting else 0

    # ------------------------------------------------------------------ moving
    def predict(self, index: Index, F: Array, Q: Array) -> None:
        """P <- F P F' + Q, F and Q acting on the rows `index` alone.  [S] (15)-(17)."""
        kernels.predict(self.P, self.n, index, F, Q)

    def set_predicted(self, slot: int, mean: Array) -> None:
        """Write a block's mean after a motion."""
        where = self.numbers(slot)
        self.x[where] = self.x_first[where] = mean

    def movable(self, robot: int, added: Sequence[int]) -> Marginal:
        """Return this map, and the slots as they are."""
        return Marginal(self, robot, -1, np.array(added, dtype=np.int64) if added else NO_SLOTS)

    # ------------------------------------------------------------------ correcting
    def opened(self, robot: int, mount: int, slots: Index, transports: bool) -> Marginal:
        """Return this map, and the slots as they are."""
        return Marginal(self, robot, mount, slots)

    def finish_correction(self, robot: int, transports: bool) -> None:
        """Prepare a larger buffer in time."""
        self.prepare()

    # ------------------------------------------------------------------ files
    def arrays(self) -> Iterator[tuple[str, Array]]:
        """Return the arrays for a file by name."""
        yield from super().arrays()
        yield "P", self.P[: self.n, : self.n][np.tril_indices(self.n)]

    @classmethod
    def restored(cls, state: State, read: Read, prefix: str = "") -> StochasticMap:
        """Build a map of a file block by block, then remove what was removed: its tables fit by construction."""
        spaces = spaces_of(state)
        m = cls(state["capacity"])
        for space in spaces:
            m.add(space, np.zeros(space.size))
        for slot in state["free"]:
            m.remove(m.removed(slot))
        n, x_n = m.n, m.x_n
        m.x[:x_n], m.x_first[:x_n] = read(f"{prefix}x", (x_n,)), read(f"{prefix}x_first", (x_n,))
        m.P[:n, :n][np.tril_indices(n)] = read(f"{prefix}P", (n * (n + 1) // 2,))
        return m
