"""Memory that is used bit by bit ahead of time: its first use is what takes long, some milliseconds for 2 MB."""

from __future__ import annotations

from collections import deque
from typing import Any
from weakref import ref

import numpy.typing as npt

Numbers = npt.NDArray[Any]

BIT, PAGE = 1 << 21, 4096  # bytes to use at once, a large page of memory, and of a small one


class Fresh:
    """Parts of arrays whose memory nobody has used yet, as long as somebody keeps the array, in the order of need."""

    def __init__(self) -> None:
        self._waiting: deque[tuple[ref[Numbers], int, int]] = deque()

    def put(self, array: Numbers, first: int, last: int) -> None:
        """Have the numbers first..last of a contiguous array be used in time; what is in them stays."""
        self._waiting.append((ref(array), first, last))

    def forget(self) -> None:
        """Have nothing wait any more: what is used from here on does not depend on what was before."""
        self._waiting.clear()

    def use_some(self) -> int:
        """Use the next bit of memory; return how many bytes."""
        if not self._waiting:
            return 0
        kept, first, last = self._waiting.popleft()
        array = kept()
        if array is None:
            return 0
        end = min(last, first + BIT // array.itemsize)
        here = array.reshape(-1)[first : end : PAGE // array.itemsize]
        here[:] = here.copy()
        if end < last:
            self._waiting.appendleft((kept, end, last))
        return (end - first) * int(array.itemsize)
