"""Detection probability of a sensor over its field of view, counted in scans from different poses (looks).

A look is a scan from another pose than the last one, or after many from one pose: scans in a row miss a landmark for
the same reason.  The detection probability is a product of three factors, by the range, by the bearing and by what may
hide a landmark (an object that stands nearer; a side from where it was not seen yet), so that a chance where little is
seen (beyond a detector's reach, behind it, behind a tree) counts for little.  Each factor is what is seen over what the
other two expect there (Deming and Stephan 1940).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from kalmark.arrays import Array, Flags, Index
from kalmark.errors import MapError
from kalmark.geometry.pose_frames import FRAMES

MOVED, TURNED_RAD, STANDING = 0.1, 0.2, 20  # of the range; a turn; scans of a sensor that stands: another look
PER_OCTAVE, NEAREST_LOG2, RANGES, BEARINGS = 4, 8, 80, 24  # of ranges, from 2^-8 m on; sectors of bearings
AGAIN = 8  # looks until what a miss counts is estimated again, but for the first ones
CELLS = RANGES, BEARINGS, 4  # the last: nothing stands nearer, or something; both again where it was not seen from yet
HIDDEN = 0.1, 5.0  # of landmarks are hidden from another direction; looks that this is worth
SECTORS, SIDE = 24, 2  # of directions from a landmark to a sensor, and of one of its twelve sides
ROUNDS = 4  # in which the factors of the detection probability are fitted
MOST = 0.98  # of a detection probability


@dataclass
class Looks:
    """The last look of a sensor, and what was seen of what was expected in all of them.

    `pose` (3,) or (7,) is that of the sensor at the last look, `scale_m` how far it saw, `since` the scans since then
    and `changes` the landmarks that had come or gone; so many looks were `taken`.  `counts` (2, *CELLS) are the
    landmarks seen and expected, by range, by bearing, and by what may hide them, `table` (*CELLS,) what a
    miss counts there, and `log_miss` the log probability that a landmark is missed which stands where those are that
    are seen.  From a side from where a landmark was not seen yet all misses together count at most `most`.
    """

    pose: Array | None = None
    scale_m: float = 1.0
    since: int = 0
    changes: int = -1
    taken: int = 0
    counts: Array = field(default_factory=lambda: np.zeros((2, *CELLS)))
    table: Array = field(default_factory=lambda: np.ones(CELLS))
    log_miss: float = math.log(0.5)
    most: float = 1.0

    def is_due(self, pose: Array, changes: int) -> bool:
        """Return whether a scan from this pose is another look; a landmark that came or went makes it one."""
        self.since += 1
        if self.pose is None or changes != self.changes or self.since >= STANDING:
            return True
        d = 2 if len(pose) == 3 else 3
        if math.dist(pose[:d].tolist(), self.pose[:d].tolist()) > MOVED * self.scale_m:
            return True
        if d == 2:
            return abs(math.remainder(float(pose[2] - self.pose[2]), 2 * math.pi)) > TURNED_RAD
        return 2 * math.acos(min(1.0, abs(float(pose[3:] @ self.pose[3:])))) > TURNED_RAD

    def take(self, pose: Array, changes: int, scale_m: float) -> None:
        """Take note of a look."""
        self.pose, self.changes, self.since, self.scale_m = pose.copy(), changes, 0, scale_m
        self.taken += 1

    def weights(self, cells: Index) -> Array:
        """Return what a miss counts (K,) in these cells (K, 3), 1 where most is seen.

        It is log(1 - p) / log(1 - q), p the detection probability there and q that of what is seen.
        """
        if (self.taken < AGAIN or self.taken % AGAIN == 0) and self.counts[0].any():
            p, hidden = self.detection()
            self.log_miss = math.log1p(-min(float((self.counts[0] * p).sum() / self.counts[0].sum()), MOST))
            self.table = np.log1p(-np.minimum(p, -math.expm1(self.log_miss))) / self.log_miss
            self.most = math.log(hidden) / self.log_miss
        return np.asarray(self.table[tuple(cells.T)])

    def detection(self) -> tuple[Array, float]:
        """Return the detection probability (*CELLS,): a factor by the range, one by the bearing, one by what may hide.

        Each is what is seen there over what the others expect.  Where nothing is known it is a half by the range, and
        the others change nothing.  With it comes the probability that something hides a landmark on a side from where
        it was not seen yet: what is not seen there of what the others expect, `HIDDEN` before that is known.
        """
        seen, expected = self.counts
        r, b, h = (np.ones(n) for n in CELLS)
        for _ in range(ROUNDS):
            r = (seen.sum((1, 2)) + 0.5) / (expected @ h @ b + 1.0)
            b = (seen.sum((0, 2)) + 0.5) / (r @ (expected @ h) + 0.5)
            h = (seen.sum((0, 1)) + 0.5) / (b @ np.tensordot(r, expected, 1) + 0.5)
        there = float((b @ np.tensordot(r, expected, 1) * h[0])[2])
        q = (max(there - float(seen[..., 2].sum()), 0.0) + HIDDEN[0] * HIDDEN[1]) / (there + HIDDEN[1])
        return np.minimum(r[:, None, None] * b[:, None] * h, MOST), q

    def count(self, cells: Index, seen: Flags) -> None:
        """Count what was seen (K,) of what was expected in these cells (K, 3)."""
        np.add.at(self.counts[1], tuple(cells.T), 1.0)
        np.add.at(self.counts[0], tuple(cells[seen].T), 1.0)

    def restored(self) -> None:
        """Check the arrays of a file.  Raises MapError."""
        shapes = (self.counts.shape, self.table.shape) == ((2, *CELLS), CELLS)
        if not shapes or not (self.counts >= 0).all() or not (self.table >= 0).all() or not self.log_miss < 0.0:
            raise MapError(
                f"the counts of looks are {self.counts.shape} and {self.table.shape}, expected {(2, *CELLS)}"
            )


def sectors_of(pose: Array, v: Array) -> Index:
    """Return the sectors (K,) of the directions, about the vertical, from things v (K, 2 or 3) to their sensor."""
    back = pose[: v.shape[1]] - FRAMES[len(pose)].from_frame(pose, v)[0]
    return np.asarray((np.arctan2(back[:, 1], back[:, 0]) / (2 * math.pi) + 0.5) * SECTORS % SECTORS, dtype=np.int64)


def cells_of(r: Array, bearing: Array, hidden: Flags, in_reach: Flags) -> Index:
    """Return the cells (K, 3) of landmarks at ranges r and bearings (K,), which may be `hidden`, or out of reach."""
    cells = np.empty((len(r), 3), np.int64)
    octave = PER_OCTAVE * (np.log2(np.maximum(r, 2.0**-NEAREST_LOG2)) + NEAREST_LOG2)
    cells[:, 0] = np.minimum(octave, RANGES - 1)
    cells[:, 1] = (bearing / (2 * math.pi) + 0.5) * BEARINGS % BEARINGS
    cells[:, 2] = hidden + 2 * ~in_reach
    return cells
