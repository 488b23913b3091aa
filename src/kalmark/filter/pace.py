"""When a postponed map flushes and in what slices: what a phase has cost against what its flush will."""

from __future__ import annotations

import math

SLICE = 0.9e8  # multiplications of a flush to do after a correction at most, some 6 ms: less falls behind and hurries
LEAST = 2e7  # of a flush to do after a correction at least, if any: to begin with it takes time, too
DEAR = 80.0  # multiplications of a flush that take as long as a correction of one more element of the active map
USING = 45.0  # multiplications that take as long as to use a byte of memory for the first time
START = 5e7  # multiplications that take as long as to begin a flush
MOST = 1000  # rows of the active map, besides those it began with


class Pace:
    """The pace of one phase.  `most` limits the rows of the active map; by default costs decide."""

    def __init__(self, most: int | None) -> None:
        self.most = most
        self.begun = 0  # rows of the active map when it was first corrected
        self.paid = 0  # elements that have been corrected besides those

    def count(self, rows: int) -> None:
        """Take note of a correction of so many rows of the active map."""
        self.begun = self.begun or rows
        self.paid += rows**2 - self.begun**2

    def progress(self, rows: int, shadows: int, n: int) -> float:
        """Return how far the phase is: at 1 it is time for a flush, at 2 it is high time."""
        if self.most is not None:
            return rows / self.most
        paid = DEAR * self.paid / (START + shadows * float(n) ** 2)
        return max(paid, (rows - self.begun) / min(MOST, 120.0 + n ** (2 / 3)))

    def due(self, progress: float, spent: float, work: float) -> float:
        """Return how much of a flush to do now, in multiplications, so that it will be over before the next one."""
        due = progress / 0.8 * work - spent if progress < 0.8 else math.inf
        if due < LEAST:
            return 0.0
        return min(due, SLICE * max(1.0, 32.0 * (progress - 1.0)))
