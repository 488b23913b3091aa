"""Walls, and the corners in which they meet.

Surfaces are cut into straight pieces, and a line is fitted through each.  A line at distance p from the laser whose
normal has the direction n is hit by the beam at angle a at p / cos(a - n).
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Annotated, ClassVar

import numpy as np

from kalmark.arrays import Array, Index
from kalmark.compiled import compiled
from kalmark.declare import Count, NotNegative, Positive, register
from kalmark.detect.laser_scan import Acute, Detections, Laser
from kalmark.geometry.gaussian import gate

STEPS = 10
CORE = 8  # the part of a piece, at each end, that does not determine its line
NEAR2 = 16.0  # a beam within 4 sigma of a line is on it
TRIM = 2  # beams at the ends of a wall that are left out of the fit: they may be of either of two walls
PROBABILITY = 0.9999  # with which a straight wall passes for one


@register("detector", "walls")
class Walls(Laser):
    """Straight walls, by the distance of their line from the laser, m, and the direction of its normal, rad.

    Then their right and left end, m along the line from the foot of the perpendicular on: where the beams on it end, so
    it may be longer.  Covariances (K, 2, 2) are of the first two numbers.  A piece of surface is cut where it bends by
    more than `split_m`.  A wall has at least `beams` beams and `length_m`, and fits a line by the chi-square of its
    ranges.  Its ends (K, 2, 2), m in the laser's frame, are an attribute, too.

    >>> a = np.linspace(-1.0, 1.0, 201)
    >>> km.detect.Walls().detect(4.0 / np.cos(a), a).y[:, :2].round(2)
    array([[4., 0.]])
    """

    columns: ClassVar[tuple[str, ...]] = ("distance_m", "normal_rad", "right_m", "left_m")
    given: ClassVar[int] = 4

    split_m: Annotated[Positive, "A wall is straight to this."] = 0.2
    beams: Annotated[Count, "Beams on a wall, at least."] = 8
    length_m: Annotated[NotNegative, "Length of a wall, at least."] = 0.5

    def _find(self, r: Array, a: Array, intensities: Array | None) -> Detections:
        pieces, _ = self.pieces(r, a)
        least = max(self.beams, 2 * TRIM + 3)
        beams = straight_pieces(r, a, pieces, self.split_m, least)
        beams = refine_pieces(r, a, beams, self.sigma_range_m**2, least)
        u, P, chi2 = lines(r, a, beams, self.sigma_range_m**2, TRIM)
        at = a[beams] - u[:, 1:]
        with np.errstate(divide="ignore", invalid="ignore"):
            far = u[:, :1] / np.cos(at)
        ends = np.stack([far * np.cos(a[beams]), far * np.sin(a[beams])], axis=2)
        abscissas = far * np.sin(at)
        length = abscissas[:, 1] - abscissas[:, 0]
        most = np.array([gate(PROBABILITY, int(n)) for n in np.maximum(beams[:, 1] - beams[:, 0] - 1 - 2 * TRIM, 1)])
        y = np.column_stack([u, abscissas])
        found = Detections(Walls.columns, y, P, beams, {"ends_m": ends, "length_m": length})
        return found.take((chi2 <= most) & (length >= self.length_m))

    def _widened(self, found: Detections) -> Detections:
        """Return the walls with the noise that is not in the beams."""
        return replace(found, cov=found.cov + np.diag([self.sigma_position_m**2, self.sigma_bearing_rad**2]))


@register("detector", "corners")
class Corners(Walls):
    """Corners of walls: range, bearing and opening angle.

    The angle, rad, is the signature, over pi where the corner stands out.  One is where two walls meet that follow each
    other in the scan: within `gap_m` of the ends of both, and at `bend_deg` at least.

    >>> a = np.linspace(-0.5, 1.5, 401)
    >>> room = np.minimum(4.0 / np.cos(a), 3.0 / np.maximum(np.sin(a), 1e-3))
    >>> km.detect.Corners().detect(room, a).y.round(2)
    array([[5.  , 0.64, 1.57]])
    """

    columns: ClassVar[tuple[str, ...]] = ("range_m", "bearing_rad", "opening_rad")
    given: ClassVar[int] = 2

    gap_m: Annotated[NotNegative, "Largest distance of the ends of its walls from the corner."] = 0.3
    bend_deg: Annotated[Acute, "Angle between the walls, at least."] = 30.0

    def _find(self, r: Array, a: Array, intensities: Array | None) -> Detections:
        walls = super()._find(r, a, intensities)
        first = np.arange(len(walls) - 1) if len(walls) > 1 else np.zeros(0, dtype=np.int64)
        second, ends = first + 1, walls.attributes["ends_m"]
        (p1, n1), (p2, n2) = walls.y[first, :2].T, walls.y[second, :2].T
        turn = np.sin(n2 - n1)
        bent = np.abs(turn) >= math.sin(math.radians(self.bend_deg))
        first, second, p1, n1, p2, n2, turn = (v[bent] for v in (first, second, p1, n1, p2, n2, turn))
        c = np.stack([p1 * np.sin(n2) - p2 * np.sin(n1), p2 * np.cos(n1) - p1 * np.cos(n2)], axis=1) / turn[:, None]
        gaps = np.linalg.norm(np.stack([ends[first, 1], ends[second, 0]]) - c, axis=2)
        Y = _jacobian(c, n1, n2, turn)
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


def _jacobian(c: Array, n1: Array, n2: Array, turn: Array) -> Array:
    """Return Y (K, 3, 4) of range, bearing and opening with respect to p1, n1, p2, n2.

    c solves c . (cos n, sin n) = p for both lines; d(opening) = d(n1 - n2).
    """
    C = np.zeros((len(c), 2, 4))
    for k, sign, n, other in ((0, 1, n1, n2), (2, -1, n2, n1)):
        C[:, :, k] = sign * np.stack([np.sin(other), -np.cos(other)], axis=1) / turn[:, None]
        along = c[:, 0] * np.sin(n) - c[:, 1] * np.cos(n)  # - c . d(cos n, sin n) / dn
        C[:, :, k + 1] = C[:, :, k] * along[:, None]
    d = np.maximum(np.hypot(c[:, 0], c[:, 1]), 1e-9)[:, None]
    Y = np.zeros((len(c), 3, 4))
    Y[:, 0] = np.einsum("ki,kij->kj", c / d, C)
    Y[:, 1] = np.einsum("ki,kij->kj", np.stack([-c[:, 1], c[:, 0]], axis=1) / d**2, C)
    Y[:, 2, 1], Y[:, 2, 3] = 1.0, -1.0
    return Y


@compiled
def farthest(x: Array, y: Array, i: int, j: int) -> tuple[int, float]:
    """Return which of the points i to j of x, y (N,) is farthest from the chord between these two, and its distance."""
    u, v = x[i : j + 1] - x[i], y[i : j + 1] - y[i]
    length = math.hypot(u[-1], v[-1])
    off = np.abs(u[-1] * v - v[-1] * u) / length if length > 0.0 else np.hypot(u, v)
    at = int(np.argmax(off))
    return i + at, off[at]


@compiled
def straight_pieces(r: Array, a: Array, pieces: Index, split_m: float, beams: int) -> Index:
    """Return the pieces (S, 2) cut where they bend: at the point farthest from the chord, if it is beyond `split_m`.

    The cut belongs to both halves.  Those of fewer than `beams` beams are left out.  Iterative end point fit.
    """
    x, y = r * np.cos(a), r * np.sin(a)
    out, count = np.empty((2 * len(r) + 1, 2), np.int64), 0
    stack = np.empty((len(r) + 1, 2), np.int64)
    for s in range(len(pieces)):
        stack[0], depth = pieces[s], 1
        while depth > 0:
            depth -= 1
            i, j = stack[depth, 0], stack[depth, 1]
            k, off = farthest(x, y, i, j)
            if off > split_m:
                stack[depth, 0] = k  # the left half is looked at first: the order is that of the beams
                stack[depth + 1, 0], stack[depth + 1, 1] = i, k
                depth += 2
            elif j - i + 1 >= beams:
                out[count, 0], out[count, 1] = i, j
                count += 1
    return out[:count].copy()


@compiled
def fit_line(r: Array, a: Array, variance: float) -> tuple[Array, Array, float]:
    """Return (p, n) of the line that beams r (n,) at a (n,) hit, its covariance (2, 2), chi-square; NaN if none."""
    u, P, chi2 = np.empty(2), np.empty((2, 2)), np.inf
    last = len(r) - 1
    dx = r[last] * math.cos(a[last]) - r[0] * math.cos(a[0])
    dy = r[last] * math.sin(a[last]) - r[0] * math.sin(a[0])
    u[1] = math.atan2(dx, -dy)
    u[0] = r[0] * math.cos(a[0] - u[1])
    if u[0] < 0.0:
        u[0], u[1] = -u[0], u[1] + math.pi
    for _ in range(STEPS):
        A, B, C, g0, g1, chi2 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for i in range(len(r)):
            c = math.cos(a[i] - u[1])
            if c < 1e-3:
                return np.full(2, np.nan), P, np.inf
            J0, J1 = 1.0 / c, -u[0] * math.sin(a[i] - u[1]) / (c * c)
            z = r[i] - u[0] / c
            A, B, C = A + J0 * J0, B + J0 * J1, C + J1 * J1
            g0, g1, chi2 = g0 + J0 * z, g1 + J1 * z, chi2 + z * z
        det = A * C - B * B
        if not det > 0.0:
            return np.full(2, np.nan), P, np.inf
        P[0, 0], P[0, 1], P[1, 0], P[1, 1] = C / det, -B / det, -B / det, A / det
        step0, step1 = (C * g0 - B * g1) / det, (A * g1 - B * g0) / det
        u[0], u[1] = u[0] + step0, u[1] + step1
        if abs(step0) + abs(step1) < 1e-9:
            break
    u[1] = (u[1] + math.pi) % (2 * math.pi) - math.pi
    return u, P * variance, chi2 / variance


@compiled
def refine_pieces(r: Array, a: Array, pieces: Index, variance: float, beams: int) -> Index:
    """Return the pieces (S, 2) with their ends put right, in the order of the beams: a cut is rarely at the corner.

    The longest first, the line through the middle of each takes the beams beside it as far as they lie on it.
    """
    taken, out, count = np.zeros(len(r), np.bool_), np.empty_like(pieces), 0
    for s in np.argsort(pieces[:, 0] - pieces[:, 1], kind="mergesort"):
        i, j = pieces[s]
        while i < j and taken[i]:
            i += 1
        while j > i and taken[j]:
            j -= 1
        off = max((j - i + 1) // CORE, 1)
        i, j = i + off, j - off
        if j - i < 2:
            continue
        u, _, _ = fit_line(r[i : j + 1], a[i : j + 1], variance)
        for side in (-1, 1):
            k = (i if side < 0 else j) + side
            while 0 <= k < len(r) and not taken[k] and (r[k] - u[0] / math.cos(a[k] - u[1])) ** 2 <= NEAR2 * variance:
                k += side
            i, j = (k + 1, j) if side < 0 else (i, k - 1)
        if j - i + 1 >= beams:
            taken[i : j + 1] = True
            out[count, 0], out[count, 1] = i, j
            count += 1
    return out[np.argsort(out[:count, 0])].copy()


@compiled
def lines(r: Array, a: Array, pieces: Index, variance: float, trim: int) -> tuple[Array, Array, Array]:
    """Return (p, n) (S, 2), covariances (S, 2, 2) and chi-squares (S,) of the pieces, each end `trim` beams short."""
    u, P, chi2 = np.empty((len(pieces), 2)), np.empty((len(pieces), 2, 2)), np.empty(len(pieces))
    for s in range(len(pieces)):
        i, j = pieces[s, 0] + trim, pieces[s, 1] - trim + 1
        u[s], P[s], chi2[s] = fit_line(r[i:j], a[i:j], variance)
    return u, P, chi2
