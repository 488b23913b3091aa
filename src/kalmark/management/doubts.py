"""Which of the two poses that look alike a tag has: the evidence of several scans, until it tells.

From afar a tag looks the same when it is mirrored along the line of sight.  Each scan says how much worse the other
pose fits, as a difference of chi-squares; it takes some scans until that is beyond doubt.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from kalmark.events import Id
from kalmark.filter.estimators import Map
from kalmark.models.sensors_camera import TELLING

if TYPE_CHECKING:
    from kalmark.tracks.scene import View

Array = npt.NDArray[np.float64]

MIRRORED = "its mirror image fits as well"
AGAIN = 1 / 3  # what the second scan and those after it count: their errors are correlated (docs/datasets3d.md)
FORGET_NS = 1_000_000_000  # what was not seen for so long is begun anew


@dataclass
class Doubt:
    """Two poses (2, 7) in the map that a tag may have, and by how much chi-square the first fits better."""

    poses: Array
    evidence: float
    t_ns: int


class Doubts:
    """The tags that are not in the map yet because they may be their mirror images."""

    def __init__(self) -> None:
        self.open: dict[Id, Doubt] = {}

    def which(self, view: View, map_: Map, robot: int, name: Any, y: Array, t_ns: int) -> int | None:
        """Return which of the landmarks that look like y (m,) to start, None if there is no telling yet.

        0 wherever there is but one.  What has no name cannot be recognised: it is settled by one scan or not at all.
        """
        if not hasattr(view.sensor, "both"):
            return 0
        v, _, chi2 = view.sensor.both(y[None])
        if not np.isfinite(chi2[0, 0]):
            return 0  # no tag at all
        poses: Array = view.landmark.from_view(view.pose(map_, robot), v[0])[0]
        if not isinstance(name, int | str):
            return 0 if chi2[0, 1] - chi2[0, 0] >= TELLING else None
        return self.settle(name, poses, float(chi2[0, 1] - chi2[0, 0]), t_ns)

    def settle(self, name: Id, poses: Array, first: float, t_ns: int) -> int | None:
        """Return which of two poses (2, 7) in the map a tag has, the first better by so much chi-square in this scan.

        The poses are paired with those of the scan before by their orientations.
        """
        before = self.open.pop(name, None)
        if before is None or t_ns - before.t_ns > FORGET_NS:
            swapped, evidence = False, first
        else:
            alike = np.abs(before.poses[:, 3:] @ poses[:, 3:].T)  # cosines of half the angles between them
            angles = np.arccos(np.minimum(alike, 1.0))
            swapped = bool(angles[0, 1] + angles[1, 0] < angles[0, 0] + angles[1, 1])
            evidence = before.evidence + AGAIN * (-first if swapped else first)
        if abs(evidence) >= TELLING:
            return int(swapped == (evidence > 0))
        self.open[name] = Doubt(poses[::-1] if swapped else poses, evidence, t_ns)
        return None
