"""Pose-based relinearisation of measurements far from what is expected of them, as after a time without any.

The pixels of a tag's corners are linear in its pose over some degrees only: farther away their Jacobians mislead, and
behind the camera there are none.  The pose that the corners determine is linear in the errors of the robot and the tag.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from kalmark.filter.estimators import Update
from kalmark.models.protocols import FarCorrected
from kalmark.tracks.channel import ObservationModel
from kalmark.tracks.scan import ScanContext

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]

SHARE = 100.0  # the poses count a hundredth of what they determine: enough to relinearise, and the corners count again


def approach(scan: ScanContext, model: ObservationModel, slots: Index, rows: list[int]) -> Update | None:
    """Return the correction by the poses of those tags of the observations `rows` that are far; None if none is.

    `slots` (K,) are the tags' blocks.  A tag of ambiguous pose is left out, and so is what is no tag.
    """
    channel, map_, robot = scan.channel, scan.map, scan.robot
    if channel.far is None or not isinstance(channel.sensor, FarCorrected):
        return None
    y, R = scan.y[rows], scan.R[rows]
    far = np.flatnonzero(channel.sensor.is_far(y, channel.innovations(map_, robot, model, slots, y)))
    if not len(far):
        return None
    v, cov = channel.sensor.poses(y[far], R[far])
    clear = channel.predict(map_, robot, channel.far, slots[far], v, cov)[1] <= channel.gate  # not of a NaN
    if not clear.any():
        return None
    some, R_far = slots[far][clear], SHARE * cov[clear]
    return Update(channel.far.model, robot, channel.mount, some, model.d, v[clear], R_far, channel.gate)
