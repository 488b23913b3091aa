"""What of a scan is used: which landmarks are corrected, where new ones start, which are given up.  [TB] 4.4."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from kalmark.errors import ModelError

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Attention:
    """A budget for each scan of a sensor, and when a landmark is given up; by default all is used and none given up.

    `updates`: most landmarks corrected by a scan, those whose measurement tells most first; `sequential`: one after the
    other instead of jointly.  `starts`: most new landmarks a scan, `first_starts` while the map is empty, spread over a
    `grid` (columns, rows) of the image and `margin_px` from its borders.  With `delete`, a landmark that should be in
    view is removed after `searches` scans if it was found in less than `match_ratio` of them, or fitted in less than
    `inlier_ratio` of those.
    """

    updates: int | None = None
    sequential: bool = False
    starts: int | None = None
    first_starts: int | None = None
    grid: tuple[int, int] = (1, 1)
    margin_px: float = 0.0
    delete: bool = False
    searches: int = 10
    match_ratio: float = 0.1
    inlier_ratio: float = 0.5

    def __post_init__(self) -> None:
        for name in ("updates", "starts", "first_starts", "searches"):
            value = getattr(self, name)
            if value is not None and (type(value) is not int or value < 0):
                raise ModelError(f"Attention: {name} is {value!r}, expected a whole number of at least 0")
        object.__setattr__(self, "grid", tuple(self.grid))
        if len(self.grid) != 2 or not all(type(n) is int and n > 0 for n in self.grid):
            raise ModelError(f"Attention: grid is {self.grid!r}, expected two positive numbers: columns and rows")

    def worth_a_correction(self, information: Array) -> npt.NDArray[np.bool_]:
        """Return which of the observations are corrected by, given what they tell (K,): the best `updates` of them."""
        best = np.zeros(len(information), dtype=np.bool_)
        best[np.argsort(-information, kind="stable")[: self.updates]] = True
        return best

    def worth_a_start(
        self, new: Sequence[int], used: Sequence[int], y: Array, image: Any, empty: bool
    ) -> dict[int, str]:
        """Return why some of the observations `new` do not become landmarks; the others do.

        `used` are those of landmarks in the map; `image` is (width, height) px or None.
        """
        most = self.first_starts if empty and self.first_starts is not None else self.starts
        reasons: dict[int, str] = {}
        if image is not None and self.margin_px > 0:
            inside = np.all((y[:, :2] >= self.margin_px) & (y[:, :2] <= np.array(image) - self.margin_px), axis=1)
            reasons = {k: f"nearer than {self.margin_px} px to the border" for k in new if not inside[k]}
        waiting = [k for k in new if k not in reasons]
        if most is None or len(waiting) <= most:
            return reasons
        cells = [0] * len(y) if image is None else self._cells(y, image)
        crowd, chosen = Counter(cells[k] for k in used), set[int]()
        while len(chosen) < most:
            k = min((k for k in waiting if k not in chosen), key=lambda k: (crowd[cells[k]], k))
            chosen.add(k)
            crowd[cells[k]] += 1
        return reasons | {k: f"more than {most} new ones in a scan" for k in waiting if k not in chosen}

    def _cells(self, y: Array, image: Any) -> list[int]:
        """Return the cell of the grid each observation (K, m) lies in."""
        counts = np.array(self.grid)
        cell = np.clip((y[:, :2] / np.array(image) * counts).astype(int), 0, counts - 1)
        found: list[int] = (cell[:, 1] * counts[0] + cell[:, 0]).tolist()
        return found

    def hopeless(self, searched: int, matched: int, fitted: int) -> str:
        """Return why a landmark searched, found and fitted so often is given up, "" if it is not."""
        if searched < self.searches:
            return ""
        if matched < self.match_ratio * searched:
            return f"found in {matched} of {searched} scans"
        return f"fitted {fitted} of {matched} times" if fitted < self.inlier_ratio * matched else ""


EVERYTHING = Attention()
