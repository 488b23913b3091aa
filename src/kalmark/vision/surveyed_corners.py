"""Landmarks known beforehand, which have no patch yet: corners of an image where they must be, found together.

Where the sensor is known to a pixel each has one corner near its place.  Where it is not, an ellipse holds many: so
each corner in that of one landmark is tried, which moves the expectations of the others as a match does, and the others
are taken where a corner is nearest to that.  The trial that fits best counts, if no other one fits nearly as well.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from kalmark.arrays import Array
from kalmark.vision import opencv as cv2
from kalmark.vision.features import responses
from kalmark.vision.joint_expectation import Belief, Prospect
from kalmark.vision.selection import GATE

AT_ONCE = 12  # landmarks that are looked for in a frame
BASES = 4  # of them that are tried as the first one
CORNERS = 30  # the strongest in an ellipse
SURE = 9.0  # by so much in d2 any other trial must fit worse
APART = 4  # px: a corner is the strongest so far around


class FirstLook:
    """An image (H, W) in which landmarks of a prospect are searched that no image has shown before."""

    def __init__(self, image: Any, prospect: Prospect, contrast: float) -> None:
        self.prospect = prospect
        response = responses(image)
        top = cv2.dilate(response, np.ones((2 * APART + 1, 2 * APART + 1), np.uint8))
        v, u = np.nonzero((response == top) & (response >= contrast**2))
        order = np.argsort(-response[v, u], kind="stable")
        self.corners = at = np.column_stack([u, v])[order].astype(np.float64)
        if len(at):
            stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 30, 0.01)
            fine = cv2.cornerSubPix(image, at.astype(np.float32), (APART, APART), (-1, -1), stop).astype(np.float64)
            self.corners = fine[np.abs(fine - at).max(axis=1) < APART]

    def found(self, belief: Belief, rows: list[int]) -> dict[int, Array]:
        """Return the pixels (2,) of landmarks by their rows; none if they are ambiguous."""
        Z = self.prospect.innovations(belief, np.array(rows, dtype=np.int64))
        order = [rows[k] for k in np.argsort(np.linalg.det(Z), kind="stable")[:AT_ONCE].tolist()]
        trials = []
        for base in order[:BASES]:
            rest = [base, *(k for k in order if k != base)]
            trials += [self._agreeing(belief, rest, y) for y in self._near(belief, base)[0][:CORNERS]]
        if not trials:
            return {}
        best, cost = min(trials, key=lambda trial: trial[1])
        rivals = [c for fits, c in trials if any(k in fits and not np.array_equal(fits[k], y) for k, y in best.items())]
        if min(rivals, default=np.inf) - cost < SURE:
            return {}
        return best

    def _agreeing(self, belief: Belief, order: list[int], y: Array) -> tuple[dict[int, Array], float]:
        """Return the matches with the first of some landmarks at y (2,), and the sum of d2, missing ones included."""
        fits: dict[int, Array] = {}
        cost = 0.0
        for k in order:
            if fits:
                near, d2 = self._near(belief, k)
                if not len(near):
                    cost += GATE
                    continue
                y = near[int(d2.argmin())]
            z = y - belief.pixels[k]
            cost += float(z @ np.linalg.solve(self.prospect.innovations(belief, np.array([k]))[0], z))
            fits[k] = y
            belief = self.prospect.after(belief, [k], y[None])
        return fits, cost

    def _near(self, belief: Belief, row: int) -> tuple[Array, Array]:
        """Return the corners (n, 2) in the ellipse of a landmark, the strongest first, and their d2 (n,)."""
        z = self.corners - belief.pixels[row]
        W = np.linalg.inv(self.prospect.innovations(belief, np.array([row]))[0])
        d2 = np.einsum("ka,ab,kb->k", z, W, z)
        inside = d2 <= GATE
        return self.corners[inside], d2[inside]
