"""Memory that is touched bit by bit before it is needed: the page faults of 2 MB take some milliseconds."""

from __future__ import annotations

from collections import deque
from typing import Any
from weakref import ref

import numpy.typing as npt

Numbers = npt.NDArray[Any]

BIT, PAGE = 1 << 21, 4096  # bytes to touch at once, a large page of memory, and of a small one


class Prefault:
    """Parts of arrays, `waiting` to be touched in the order in which they will be needed, as long as they are kept."""

    def __init__(self) -> None:
        self.waiting: deque[tuple[ref[Numbers], int, int]] = deque()

    def add(self, array: Numbers, first: int, last: int) -> None:
        """Add the numbers first..last of a contiguous array (N,); their values stay."""
        self.waiting.append((ref(array), first, last))

    def clear(self) -> None:
        """Drop all that is left to touch."""
        self.waiting.clear()

    def some(self) -> int:
        """Touch the next bit of memory; return its size in bytes."""
        if not self.waiting:
            return 0
        kept, first, last = self.waiting.popleft()
        array = kept()
        if array is None:
            return 0
        end = min(last, first + BIT // array.itemsize)
        here = array.reshape(-1)[first : end : PAGE // array.itemsize]
        here[:] = here.copy()
        if end < last:
            self.waiting.appendleft((kept, end, last))
        return (end - first) * int(array.itemsize)
