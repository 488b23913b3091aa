"""The choice of a map: dense, compressed, or dense as long as it is small."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field

from kalmark.arrays import Index
from kalmark.filter.compressed import restoring as compressed
from kalmark.filter.compressed.compressed_map import CompressedMap
from kalmark.filter.compressed.restoring import NUMBERS
from kalmark.filter.compressed.storage import Triangle
from kalmark.filter.layout import Read, State
from kalmark.filter.map import Map, StochasticMap
from kalmark.geometry.spaces import RHO, Space

COUNTED = 100  # corrections whose costs are compared
STEP = 3e6  # multiplications of a dense map that take as long as a compressed map takes more for a step
ENTRY = 8e3  # of a block that becomes active, for each row of the map
DENSE = int(math.sqrt(STEP / 20.0) / 2.0)  # points of the plane of which ten are observed: it never pays for fewer
MOST = 1000  # landmarks of a dense map: 32 MB in the plane, and four times as much as soon as it grows


def new_map(type_: str, numbers: str) -> Map:
    """Return an empty map of a type; `numbers` are those in which a compressed one keeps inactive blocks."""
    return CompressedMap(Triangle(NUMBERS[numbers])) if type_ == "postponed" else StochasticMap()


@dataclass
class CostBalance:
    """The costs of corrections in a dense map and in a compressed one, in multiplications, `COUNTED` at a time.

    The active blocks of a compressed map would be those that are observed in this count or were in the last one.
    `observed` has of each block, by its slot, the number of the count in which it was observed last; `active` blocks
    were in this one, `before` in the last one.  `saved` is what a compressed map would save, `pays` whether it did.
    """

    observed: dict[int, int] = field(default_factory=dict)
    number: int = 0
    corrections: int = 0
    active: int = 0
    before: int = 0
    saved: float = 0.0
    pays: bool = False

    def add_correction(self, slots: Index, d: int, q: int, n: int) -> None:
        """Count a correction of n rows by q numbers, in which blocks of d numbers are observed.

        The first that counts is one that may take longer in a dense map.
        """
        if q * n**2 <= STEP and self.number == self.corrections == 0:
            return
        entries = 0
        for slot in slots.tolist():
            last = self.observed.get(slot)
            if last != self.number:
                self.observed[slot] = self.number
                self.active += 1
                entries += last is not None and last < self.number - 1
        rows = min(2 * d * max(self.active, self.before), n)  # with auxiliary states, as many
        self.saved += q * (n**2 - rows**2) - STEP - entries * ENTRY * n
        self.corrections += 1
        if self.corrections == COUNTED:
            self.pays = self.saved > 0.0 and self.number > 0  # in the first one all blocks are new
            self.number, self.corrections, self.before = self.number + 1, 0, self.active
            self.active, self.saved = 0, 0.0


def compress_map(map_: Map, landmarks: Iterable[Space], numbers: str) -> Map:
    """Return a map as a compressed one, unless most landmarks are inverse distances: these are always active."""
    if not isinstance(map_, StochasticMap):
        return map_
    rays = [RHO in space.kinds for space in landmarks]
    return map_ if 2 * sum(rays) > len(rays) else CompressedMap.from_dense(map_, Triangle(NUMBERS[numbers]))


def restore_map(state: State, read: Read) -> Map:
    """Build the map of a file from what `state` and `arrays` of a map have written."""
    return compressed.restore_compressed(state, read) if "postponed" in state else StochasticMap.restored(state, read)
