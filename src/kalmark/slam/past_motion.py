"""The last motions of a robot, for sensors whose stamps are late: the pose of the robot at the measurement.

The lag is estimated with the map, behind the mount of its sensor (`models/observe.py`).  About its mean the mount is
where the motions of that time have it.  How it changes with the lag is the mean twist of an interval about that time,
as long as the time since the last scan: the noise of the last control alone is in the innovation, too, and the lag
would come out too small (errors in variables; Fuller 1987, section 1.1).
"""

from __future__ import annotations

import numpy as np

from kalmark.arrays import Array
from kalmark.geometry.pose_frames import ORIGIN
from kalmark.models.observe import follow_twist, sensor_pose

TINY_S = 1e-9
SIZES = {3: 3, 6: 7}  # of a pose, by the size of a twist
KEPT_S = 3.0  # of motions: more than any lag, and some scans


class PastMotion:
    """The last motions of a robot: their `seconds` (N,) and `twists` (N, 3 or 6) in its frame, the last ones first.

    `scanned` has the seconds of motion since the last scan of each sensor that lags.
    """

    seconds: Array
    twists: Array
    scanned: dict[str, float]

    def __init__(self, dof: int) -> None:
        self.seconds, self.twists, self.scanned = np.zeros(0), np.zeros((0, dof)), {}

    def add(self, seconds: float, twist: Array) -> None:
        """Add a motion of so many seconds with a twist (3 or 6,)."""
        kept = int(np.searchsorted(np.cumsum(self.seconds), KEPT_S)) + 1
        self.seconds = np.append(seconds, self.seconds[:kept])
        self.twists = np.vstack([twist, self.twists[:kept]])
        self.scanned = {name: ago + seconds for name, ago in self.scanned.items()}

    def look_back(self, sensor: str, lag_s: float) -> Array:
        """Return the lag, the twist (3 or 6,) that changes with it and where the robot was then (3 or 7,).

        The place is in the frame of the robot now.  The scan is noted as the last one of its sensor.
        """
        since, self.scanned[sensor] = self.scanned.get(sensor, KEPT_S), 0.0
        place = ORIGIN[SIZES[self.twists.shape[1]]]
        steps = self._within(0.0, lag_s) if lag_s > 0.0 else np.full(1, lag_s)
        steps[-1] += max(lag_s - self.seconds.sum(), 0.0)  # before the first motion it went on alike
        for seconds, twist in zip(steps.tolist(), self.twists, strict=False):
            place = sensor_pose(place, follow_twist(twist, -seconds)[0])[0] if seconds else place
        from_s = max(lag_s - 0.5 * since, 0.0)
        weights = self._within(from_s, from_s + since)
        twist = weights @ self.twists / max(weights.sum(), TINY_S)
        return np.concatenate([[lag_s], twist, place])

    def _within(self, from_s: float, to_s: float) -> Array:
        """Return the seconds (N,) of each motion that were so long ago."""
        ends = np.cumsum(self.seconds)
        return np.clip(np.minimum(ends, to_s) - np.maximum(ends - self.seconds, from_s), 0.0, None)
