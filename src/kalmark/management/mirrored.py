"""Planar pose ambiguity: which of its two poses a tag has, by the evidence of several scans.

From afar a tag looks the same when it is mirrored along the line of sight.  Each scan says how much worse the other
pose fits, as a difference of chi-squares; the tag starts when their sum decides.  Schweighofer and Pinz 2006.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from kalmark.management.pending import Step
from kalmark.models.sensors_camera import TELLING
from kalmark.tracks.scan import ScanContext
from kalmark.tracks.track import Pending

Array = npt.NDArray[np.float64]

MIRRORED = "its mirror image fits as well"
AGAIN = 1 / 3  # weight of the second scan and those after it: their errors are correlated (docs/datasets3d.md)
FORGET_NS = 1_000_000_000  # evidence from so long before is dropped


class Mirrored:
    """Starts a tag with an id when one of its two poses fits better beyond doubt."""

    def observe(self, scan: ScanContext, k: int, pending: Pending) -> Step:
        """Add the evidence of a scan; start the tag if it decides."""
        v, _, chi2 = scan.channel.sensor.both(scan.y[k : k + 1])
        if not np.isfinite(chi2[0, 0]):
            return Step("new", "", start=scan.start_of(k))  # no tag at all
        poses: Array = scan.channel.landmark.from_view(scan.pose(), v[0])[0]
        which, known = settle(pending, poses, float(chi2[0, 1] - chi2[0, 0]), scan.event.t_ns)
        return Step("deferred", MIRRORED, known) if which is None else Step("new", "", start=scan.start_of(k, which))

    def solve(self, scan: ScanContext, pending: Pending) -> Step:
        """Wait for more scans."""
        return Step("deferred", MIRRORED)


def settle(pending: Pending, poses: Array, first: float, t_ns: int) -> tuple[int | None, Pending]:
    """Return which of two poses (2, 7) in the map a tag has, the first better by the chi-square `first` in this scan.

    None if that is not decided; and what is known of it then.  The poses are paired with those of the scan before by
    their orientations.
    """
    if pending.poses is None or t_ns - pending.t_ns > FORGET_NS:
        swapped, evidence = False, first
    else:
        alike = np.abs(pending.poses[:, 3:] @ poses[:, 3:].T)  # cosines of half the angles between them
        angles = np.arccos(np.minimum(alike, 1.0))
        swapped = bool(angles[0, 1] + angles[1, 0] < angles[0, 0] + angles[1, 1])
        evidence = pending.evidence + AGAIN * (-first if swapped else first)
    which = int(swapped == (evidence > 0)) if abs(evidence) >= TELLING else None
    return which, replace(pending, poses=poses[::-1] if swapped else poses, evidence=evidence, t_ns=t_ns)


def is_clear(scan: ScanContext, k: int) -> bool:
    """Return whether one scan alone decides which pose a tag has; one without an id must be decided so."""
    _, _, chi2 = scan.channel.sensor.both(scan.y[k : k + 1])
    return not np.isfinite(chi2[0, 0]) or bool(chi2[0, 1] - chi2[0, 0] >= TELLING)
