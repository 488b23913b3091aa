"""The part of a scan that is used: landmarks to correct, observations to start new ones, landmarks to remove.

Measurement selection: Davison 2005; [TB] 4.4.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Sequence
from typing import Annotated, Any

import numpy as np

from kalmark.arrays import Array, Flags
from kalmark.association.protocol import DEFERRED, REMAP, Answer, Decision
from kalmark.declare import NotNegative, Within, register
from kalmark.models.protocols import image_size
from kalmark.tracks.channel import ObservationModel
from kalmark.tracks.scan import ScanContext

Group = tuple[ObservationModel, list[int]]


@register("attention", "attention")
class Attention:
    """Selection of the landmarks to correct, of places for new ones, and of landmarks to remove.

    By default all is used and none given up.

    >>> lidar = km.Mount(km.sensors.RangeBearing(), attention=km.Attention(starts=1))
    >>> slam = km.Slam(km.Robot("rover", km.motion.Unicycle(), sensors={"lidar": lidar}))
    >>> report = slam.process(km.Scan(0.0, "rover", "lidar", [[4.0, 0.3], [2.0, -1.0]], ids=[7, 8]))
    >>> slam.landmarks().ids
    [7]
    """

    updates: Annotated[
        int | None,
        Within(ge=0),
        "At most so many landmarks corrected a scan, those of most expected information first; all if absent.",
    ] = None
    sequential: Annotated[bool, "Correct one landmark after the other, not all of a scan jointly."] = False
    starts: Annotated[int | None, Within(ge=0), "At most so many new landmarks a scan; all if absent."] = None
    first_starts: Annotated[int | None, Within(ge=0), "The same while the map is empty; `starts` if absent."] = None
    grid: Annotated[
        tuple[int, int], Within(ge=1), "New landmarks are spread over so many columns and rows of the image."
    ] = (1, 1)
    margin_px: Annotated[NotNegative, "No new landmark nearer to the image's border than this."] = 0.0
    delete: Annotated[bool, "Remove landmarks that are not found again."] = False
    searches: Annotated[
        int, Within(ge=0), "With `delete`: how often a landmark was expected before it may be removed."
    ] = 10
    match_ratio: Annotated[
        float, Within(ge=0, le=1), "With `delete`: remove it if it was found in less than this share of them."
    ] = 0.1
    inlier_ratio: Annotated[
        float,
        Within(ge=0, le=1),
        "With `delete`: remove it if less than this share of what was found passed the gate.",
    ] = 0.5

    def __post_init__(self) -> None:
        object.__setattr__(self, "grid", tuple(self.grid))

    def worth_a_correction(self, information: Array) -> Flags:
        """Return which observations are used, given their information (K,): the best `updates` of them."""
        best = np.zeros(len(information), dtype=np.bool_)
        best[np.argsort(-information, kind="stable")[: self.updates]] = True
        return best

    def worth_a_start(
        self, new: Sequence[int], used: Sequence[int], y: Array, image: Any, empty: bool
    ) -> dict[int, str]:
        """Return why some of the observations `new` do not become landmarks; the others do.

        `y` (K, m) are all observations, `used` those of landmarks in the map; `image` is (width, height) px or None.
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

    def removal_reason(self, searched: int, matched: int, fitted: int) -> str:
        """Return why a landmark searched, found and fitted so often is removed, "" if it is not."""
        if searched < self.searches:
            return ""
        if matched < self.match_ratio * searched:
            return f"found in {matched} of {searched} scans"
        return f"fitted {fitted} of {matched} times" if fitted < self.inlier_ratio * matched else ""


EVERYTHING = Attention()


def select_observations(
    scan: ScanContext, attention: Attention, groups: Sequence[Group], decisions: Sequence[Decision]
) -> tuple[list[Group], list[int]]:
    """Return the groups of observations with those alone that correct the map, and the rows that are left out."""
    rows, information = [], []
    for model, some in groups:
        slots = scan.tracks.slots_of([decisions[k][0] for k in some])
        Z, _, R = scan.predict(model, slots, some)
        rows += some
        information.append(np.nan_to_num(np.linalg.slogdet(Z)[1] - np.linalg.slogdet(R)[1], nan=-np.inf))
    worth = attention.worth_a_correction(np.concatenate(information))
    out = [k for k, good in zip(rows, worth, strict=True) if not good]
    return [(model, [k for k in some if k not in out]) for model, some in groups], out


def reasons_against_start(
    scan: ScanContext, attention: Attention, starts: Collection[Answer], new: Sequence[int], known: Sequence[int],
    decisions: Sequence[Decision],
) -> dict[int, str]:  # fmt: skip
    """Return why some of the observations that could start landmarks do not.

    `starts` are the answers that start a landmark; `known` are the observations of landmarks in the map.
    """
    if attention == EVERYTHING:
        return {}
    held = [None, *(answer for answer in (DEFERRED, REMAP) if answer not in starts)]
    wanted = [k for k in new if decisions[k][0] not in held and decisions[k][0] not in scan.tracks.slots]
    if not wanted:
        return {}
    empty = not scan.tracks.confirmed
    return attention.worth_a_start(wanted, known, scan.y, image_size(scan.channel.sensor), empty)
