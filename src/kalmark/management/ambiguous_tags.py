"""Tags whose pose one scan does not determine, or whose pixels are far from what is expected of them.

*Planar pose ambiguity*: from afar the corners are nearly the same when the tag is mirrored along the line of sight.
Each scan gives how much worse the other pose fits, as a difference of chi-squares; the tag starts when their sum
decides.  Schweighofer and Pinz 2006.

*Pose-based relinearisation*, as after a time without any measurement: the pixels of a tag's corners are linear in its
pose over some degrees only.  Farther away their Jacobians mislead, and behind the camera there are none.  The pose that
the corners determine is linear in the errors of the robot and the tag.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from kalmark.arrays import Array, Index
from kalmark.filter.estimators import Update
from kalmark.management.pending import Step
from kalmark.models.imaging import TELLING
from kalmark.models.protocols import FarCorrected
from kalmark.tracks.channel import ObservationModel
from kalmark.tracks.scan import ScanContext
from kalmark.tracks.track import Pending

MIRRORED = "its mirror image fits as well"
AGAIN = 1 / 3  # weight of the second scan and those after it: their errors are correlated (docs/datasets3d.md)
FORGET_NS = 1_000_000_000  # evidence from so long before is dropped
SHARE = 100.0  # the poses count a hundredth of what they determine: enough to relinearise, and the corners count again


class Mirrored:
    """Starts a tag with an id when one of its two poses fits better at sufficient odds."""

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


def correct_by_tag_poses(
    scan: ScanContext, model: ObservationModel, slots: Index, rows: list[int], known: Array | None = None
) -> Update | None:  # fmt: skip
    """Return the correction by the poses of those tags of the observations `rows` that are far; None if none is.

    `slots` (K,) are the tags' blocks; of tags `known` (K, 7) exactly they are the robot's, and `model` is theirs.  A
    tag of ambiguous pose is left out, and so is what is no tag.
    """
    channel, map_, robot = scan.channel, scan.map, scan.robot
    if channel.far is None or not isinstance(channel.sensor, FarCorrected):
        return None
    y, R = scan.y[rows], scan.R[rows]
    exactly = np.zeros((len(rows), 0)) if known is None else known
    z = channel.innovations(map_, robot, model, slots, np.concatenate([y, exactly], axis=1))
    far = np.flatnonzero(channel.sensor.is_far(y, z))
    if not len(far):
        return None
    v, cov = channel.sensor.poses(y[far], R[far])
    v, by_pose = np.concatenate([v, exactly[far]], axis=1), channel.far if known is None else channel.far.exactly
    clear = channel.predict(map_, robot, by_pose, slots[far], v, cov)[1] <= channel.gate  # not of a NaN
    if not clear.any():
        return None
    some, R_far = slots[far][clear], SHARE * cov[clear]
    return Update(by_pose.model, robot, channel.mount, some, model.d, v[clear], R_far, channel.gate)
