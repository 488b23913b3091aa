"""Second hypothesis of a robot's pose: a filter of the robot alone, started at measurements that the map rejects.

Where readings have placed a robot, some that do not fit are wrong, as those of a receiver that jumps, or the robot is
lost: its wheels slipped, it was carried away, its inertial unit was wrong for a second.  One reading does not
decide that.  So a second filter of the robot alone begins at it, more uncertain than it takes for that reading to fit.
It moves by the same controls and is corrected by the same readings of the state.  A receiver that jumps comes back, and
readings fit the map again.  If they fit the second hypothesis for longer than receivers usually are wrong, it is right.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from scipy.linalg import solve

from kalmark.arrays import Array
from kalmark.filter.estimators import Estimator, Update
from kalmark.filter.map import Map, StochasticMap
from kalmark.slam.held_control import MotionPart, Moving
from kalmark.slam.relocation_by_fixes import NEEDED

LASTS_S = 30.0  # readings fit a hypothesis that is right; the errors of receivers among houses seldom last so long
LASTS_UNIT_S = 10.0  # the same if the state has a velocity: what is wrong with it grows with the square of the time
WIDER = 100.0  # times the covariance by which a reading fits: it does not show yet what else is wrong, as a bias
WIDEST, WIDEST_RAD = 1e12, 0.5  # times a covariance, and sigma of an attitude: of what a filter begins with


@dataclass
class PoseHypothesis:
    """A robot alone in a map of its own, which has the robots, constants and mounts of the other one in the same slots.

    Since `since_ns` its readings fit, but for the last `misses`.
    """

    map: Map
    moving: Moving
    since_ns: int
    misses: int = 0
    SAVED: ClassVar = ("map", "since_ns", "misses")

    @classmethod
    def of(cls, map_: Map, moving: Moving, blocks: int, since_ns: int) -> PoseHypothesis:
        """Return the present state of the first so many blocks of a map, which are no landmarks."""
        own = StochasticMap()
        for slot, space in enumerate(map_.spaces[:blocks]):
            assert space is not None
            own.add(space, map_.mean(slot))
        own.predict(np.arange(own.n), np.eye(own.n), map_.covariance(range(blocks)))
        return cls(own, motion_of_hypothesis(moving), since_ns)

    def widen(self, z: Array, Z: Array, R: Array) -> None:
        """Make the robot more uncertain, in the proportions it has, than it takes for a position of it to fit.

        z (d,) is its innovation, Z (d, d) the covariance of that and R (d, d) the noise in it.
        """
        space, rows = self.moving.motion.space, self.map.index(self.moving.slot)
        P, d, s2 = self.map.covariance([self.moving.slot]), len(z), 1.0
        while s2 < WIDEST and z @ solve(s2 * (Z - R) + R, z, assume_a="pos") > d:
            s2 *= 2.0
        s2 *= WIDER
        factor = np.full(len(P), np.sqrt(s2))
        for i in range(d, d + space.axes):
            factor[i] = min(factor[i], max(WIDEST_RAD / max(np.sqrt(P[i, i]), 1e-12), 1.0))
        self.map.predict(rows, np.diag(factor), np.zeros_like(P))

    def move(self, estimator: Estimator, part: MotionPart) -> bool:
        """Move the robot by a part of its control; return whether that leads anywhere."""
        return estimator.predict(self.map, self.moving.movement(self.map, part))

    def correct(self, estimator: Estimator, update: Update) -> bool:
        """Correct by a reading of the state; return whether it fits."""
        done = estimator.correct(self.map, update)
        return bool(done.valid and done.fused[0])

    def explains(self, t_ns: int) -> bool:
        """Return whether its readings have fitted for so long that they are right."""
        space = self.moving.motion.space
        lasts_s = LASTS_S if space.dof == space.pose.dof else LASTS_UNIT_S
        return (t_ns - self.since_ns) * 1e-9 >= lasts_s

    @property
    def failed(self) -> bool:
        """True if its readings do not fit either."""
        return self.misses >= NEEDED


def motion_of_hypothesis(moving: Moving) -> Moving:
    """Return how a robot moves in the map of a second hypothesis."""
    return replace(moving, error=None, left_out=[])


def write_robot(map_: Map, moving: Moving, mean: Array, cov: Array) -> None:
    """Write the first numbers of a robot's state, and the covariance (d, d) of these, independent of all else.

    A velocity in the rest of the state stays what it is in the frame of the robot: it turns with its pose.  As a robot
    that was carried away may have another one, it is less certain by the greatest so far.  The constants of its
    controls and mounts are again as they were stated: they were corrected at another pose.
    """
    x, rows, d = map_.mean(moving.slot), map_.index(moving.slot), len(cov)
    after, F = np.concatenate([mean, x[len(mean) :]]), np.eye(len(rows))
    G = np.eye(len(rows), d)  # of the errors of `mean`
    Q, F[:d] = np.zeros_like(F), 0.0
    if moving.has_velocity and d < len(rows):
        (b, B), (now, B_now) = moving.velocity(x), moving.velocity(after)
        back = np.linalg.pinv(B_now[:, d:])
        after = moving.motion.space.plus(after, np.concatenate([np.zeros(d), back @ (b - now)]))
        F[d:] += back @ (B - np.hstack([np.zeros((len(b), d)), B_now[:, d:]]))
        G[d:] = -back @ B_now[:, :d]
        speeds = np.repeat(moving.fastest, [d - d // 2, d // 2])[: len(b)]
        Q[d:, d:] = (back * speeds**2) @ back.T
    map_.predict(rows, F, G @ cov @ G.T + Q)
    map_.set_predicted(moving.slot, after)
    for slot, stated, N in moving.constants:
        map_.predict(map_.index(slot), np.zeros_like(N), N)
        map_.set_predicted(slot, stated)
