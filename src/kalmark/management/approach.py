"""Come near to sightings that are far from what is expected of them, as after a time in which a robot saw nothing.

The pixels of a tag's corners move in proportion with its pose over some degrees only: further away they pull anywhere,
and behind the camera there are none.  The pose that the corners tell is linear in the errors of the robot and the tag.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from kalmark.tracks.scene import Look, View

if TYPE_CHECKING:
    from kalmark.slam.slam import Slam

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]

SHARE = 100.0  # the poses count a hundredth of what they tell: enough to come near, and the corners tell it again


def approach(slam: Slam, view: View, robot: int, look: Look, slots: Index, y: Array, R: Array) -> None:
    """Correct by the poses of those tags y (K, m), noise R (K, p, p), that are far from where they are expected.

    `slots` (K,) are the tags' blocks.  Those that could be two poses say nothing, nor does what is no tag.
    """
    if view.rough is None:
        return
    sensor: Any = view.sensor
    far = np.flatnonzero(sensor.is_far(y, view.innovation_of(slam.map, robot, look, slots, y)))
    if not len(far):
        return
    v, cov = sensor.poses(y[far], R[far])
    d2 = view.predict(slam.map, robot, view.rough, slots[far], v, cov)[1]
    clear = d2 <= view.gate  # not of a NaN
    if clear.any():
        scan = (slots[far][clear], look.d, v[clear], SHARE * cov[clear], view.gate)
        slam.estimator.correct(slam.map, view.rough.view, robot, view.mount, *scan)
