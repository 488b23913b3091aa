"""Walls, and the corners in which they meet."""

from __future__ import annotations

import math
from typing import Annotated, ClassVar

import numpy as np

from kalmark.declare import Count, NotNegative, Positive, register
from kalmark.detect.lines import grown, lines, straight_pieces
from kalmark.detect.scan import Acute, Array, Detections, Laser
from kalmark.geometry.gaussian import gate

TRIM = 2  # beams at the ends of a wall that are left out of the fit: which of two walls they hit is not sure
PROBABILITY = 0.9999  # with which a straight wall passes for one


@register("detector", "walls")
class Walls(Laser):
    """Straight walls, by the distance of their line from the laser, m, and the direction of its normal, rad.

    They are for a sensor and a landmark of your own: kalmark has none of walls of the plane yet.  A piece of surface is
    cut where it bends by more than `split_m`.  A wall has at least `beams` beams and `length_m`, and fits a line by the
    chi-square of its ranges.  Its ends (K, 2, 2), m in the laser's frame, are an attribute: where the beams on it end,
    so it may be longer.
    """

    columns: ClassVar[tuple[str, ...]] = ("distance_m", "normal_rad")

    split_m: Annotated[Positive, "A wall is straight to this."] = 0.2
    beams: Annotated[Count, "Beams on a wall, at least."] = 8
    length_m: Annotated[NotNegative, "Length of a wall, at least."] = 0.5

    def _find(self, r: Array, a: Array, intensities: Array | None) -> Detections:
        pieces, _ = self.pieces(r, a)
        least = max(self.beams, 2 * TRIM + 3)
        beams = straight_pieces(r, a, pieces, self.split_m, least)
        beams = grown(r, a, beams, self.sigma_range_m**2, least)
        u, P, chi2 = lines(r, a, beams, self.sigma_range_m**2, TRIM)
        at = a[beams] - u[:, 1:]
        with np.errstate(divide="ignore", invalid="ignore"):
            far = u[:, :1] / np.cos(at)
        ends = np.stack([far * np.cos(a[beams]), far * np.sin(a[beams])], axis=2)
        length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
        most = np.array([gate(PROBABILITY, int(n)) for n in np.maximum(beams[:, 1] - beams[:, 0] - 1 - 2 * TRIM, 1)])
        found = Detections(Walls.columns, u, P, beams, {"ends_m": ends, "length_m": length})
        return found.take((chi2 <= most) & (length >= self.length_m))

    def _widened(self, found: Detections) -> Detections:
        """Return the walls with the noise that is not in the beams."""
        cov = found.cov.copy()
        cov[:, 0, 0] += self.sigma_position_m**2
        cov[:, 1, 1] += self.sigma_bearing_rad**2
        return Detections(found.columns, found.y, cov, found.beams, found.attributes)


@register("detector", "corners")
class Corners(Walls):
    """Corners of walls: range, bearing and opening angle.

    The angle, rad, is the signature, over pi where the corner stands out.  One is where two walls meet that follow each
    other in the scan: within `gap_m` of the ends of both, and at `bend_deg` at least.
    """

    columns: ClassVar[tuple[str, ...]] = ("range_m", "bearing_rad", "opening_rad")

    gap_m: Annotated[NotNegative, "How far from the corner the ends of its walls may be."] = 0.3
    bend_deg: Annotated[Acute, "Angle between the walls, at least."] = 30.0

    def _find(self, r: Array, a: Array, intensities: Array | None) -> Detections:
        walls = super()._find(r, a, intensities)
        first = np.arange(len(walls) - 1) if len(walls) > 1 else np.zeros(0, dtype=np.int64)
        second, ends = first + 1, walls.attributes["ends_m"]
        (p1, n1), (p2, n2) = walls.y[first].T, walls.y[second].T
        turn = np.sin(n2 - n1)
        bent = np.abs(turn) >= math.sin(math.radians(self.bend_deg))
        first, second, p1, n1, p2, n2, turn = (v[bent] for v in (first, second, p1, n1, p2, n2, turn))
        c = np.stack([p1 * np.sin(n2) - p2 * np.sin(n1), p2 * np.cos(n1) - p1 * np.cos(n2)], axis=1) / turn[:, None]
        gaps = np.linalg.norm(np.stack([ends[first, 1], ends[second, 0]]) - c, axis=2)
        Y = _jacobian(c, n1, n2, turn, p1, p2)
        N = np.zeros((len(c), 4, 4))
        N[:, :2, :2], N[:, 2:, 2:] = walls.cov[first], walls.cov[second]
        along1, along2 = ends[first, 0] - c, ends[second, 1] - c
        opening = np.arctan2(along1[:, 1], along1[:, 0]) - np.arctan2(along2[:, 1], along2[:, 0])
        y = np.column_stack([np.hypot(*c.T), np.arctan2(c[:, 1], c[:, 0]), np.mod(opening, 2 * math.pi)])
        beams = np.column_stack([walls.beams[first, 0], walls.beams[second, 1]])
        shape = {"opening_rad": y[:, 2]}
        found = Detections(self.columns, y, Y @ N @ Y.swapaxes(1, 2), beams, shape)
        return found.take((gaps <= self.gap_m).all(axis=0) & (y[:, 0] > 0))

    def _widened(self, found: Detections) -> Detections:
        """Return the corners with the noise that is not in the beams."""
        return Laser._widened(self, found)


def _jacobian(c: Array, n1: Array, n2: Array, turn: Array, p1: Array, p2: Array) -> Array:
    """Return Y (K, 3, 4) of range, bearing and opening with respect to p1, n1, p2, n2.

    c solves c . (cos n, sin n) = p for both lines; d(opening) = d(n1 - n2).
    """
    C = np.zeros((len(c), 2, 4))
    t = turn[:, None]
    to1 = np.stack([np.sin(n2), -np.cos(n2)], axis=1) / t
    to2 = np.stack([-np.sin(n1), np.cos(n1)], axis=1) / t
    along1 = c[:, 0] * np.sin(n1) - c[:, 1] * np.cos(n1)  # - c . d(cos n, sin n) / dn
    along2 = c[:, 0] * np.sin(n2) - c[:, 1] * np.cos(n2)
    C[:, :, 0], C[:, :, 1] = to1, to1 * along1[:, None]
    C[:, :, 2], C[:, :, 3] = to2, to2 * along2[:, None]
    d = np.maximum(np.hypot(c[:, 0], c[:, 1]), 1e-9)[:, None]
    Y = np.zeros((len(c), 3, 4))
    Y[:, 0] = np.einsum("ki,kij->kj", c / d, C)
    Y[:, 1] = np.einsum("ki,kij->kj", np.stack([-c[:, 1], c[:, 0]], axis=1) / d**2, C)
    Y[:, 2, 1], Y[:, 2, 3] = 1.0, -1.0
    return Y
