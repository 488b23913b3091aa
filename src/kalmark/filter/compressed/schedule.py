"""Update scheduling: when a compression interval ends and in what slices its full update is done, by their costs."""

from __future__ import annotations

import math

SLICE = 1.5e8  # multiplications of a full update to do after a correction at most, some 9 ms: less falls behind
LEAST = 2e7  # and at least, if any: to begin takes time, too
ELEMENT = 80.0  # multiplications of a full update that take as long as to correct one more active element
PREFAULT = 45.0  # multiplications that take as long as the page fault of one byte
START = 5e7  # multiplications that take as long as to begin a full update
NEEDED = 4  # times the rows that a scan observes, at most, are those of an active map without any others
MOST = 1000  # rows of the active map, besides those it began with


class Schedule:
    """The schedule of one compression interval.  `most` limits the rows of the active map; by default costs decide."""

    def __init__(self, most: int | None) -> None:
        self.most = most
        self.begun = 0  # rows of the active map when it was first corrected, but for new blocks
        self.paid = 0  # elements that have been corrected besides those

    def begin(self, rows: int, observed: int) -> None:
        """Take note of the rows of the active map at its first correction, of which so many are observed.

        Rows beyond `NEEDED` times these are of blocks that were added before it.
        """
        self.begun = min(rows, NEEDED * observed)

    def count(self, rows: int) -> None:
        """Take note of a correction of so many rows of the active map."""
        self.paid += rows**2 - self.begun**2

    def progress(self, rows: int, auxiliary: int, n: int) -> float:
        """Return how far the interval is: at 1 a full update is due, at 2 it is overdue."""
        if self.most is not None:
            return rows / self.most
        paid = ELEMENT * self.paid / (START + auxiliary * float(n) ** 2)
        return max(paid, (rows - self.begun) / min(MOST, 120.0 + n ** (2 / 3)))

    def due(self, progress: float, spent: float, work: float) -> float:
        """Return how much of a full update to do now, in multiplications, to end it before the next one begins."""
        due = progress / 0.8 * work - spent if progress < 0.8 else math.inf
        if due < LEAST:
            return 0.0
        return min(due, SLICE * max(1.0, 32.0 * (progress - 1.0)))
