"""Tree trunks, posts, pillars: whatever is round and stands alone.

A circle of radius R at range d and bearing b is hit by the beams within asin(R / d) of b, the one at angle a at

    r(a) = d cos(a - b) - sqrt(R^2 - d^2 sin^2(a - b)).

So a segment measures it by the ranges of its n beams, and by two edges, each between its outermost beam and the next
one, which passes by: n + 2 numbers for d, b and R, solved by Gauss and Newton.  One beam is enough.
"""

from __future__ import annotations

import math
from typing import Annotated, ClassVar

import numpy as np

from kalmark.arrays import Array, Index
from kalmark.compiled import compiled
from kalmark.declare import Count, Limit, NotNegative, Positive, register
from kalmark.detect.laser_scan import Detections, Laser

STEPS = 12
GRAZING = 0.35  # a beam that hits nearer to the edge than this, in radii of depth, is taken to hit there
LINEAR = 0.75  # of a step: beams are taken to be so wide at least, for an edge is straight only from there on


@register("detector", "trunks")
class Trunks(Laser):
    """Tree trunks and posts: range, bearing and radius of circles that stand alone.

    The radius, m, is the signature.  One is seen by `beams` at least, with nothing before its edges; its radius lies
    between `radius_min_m` and `radius_max_m`, and its beams within `roughness_m` of the circle, RMS.  `beam_width_rad`
    is the divergence of a beam, full angle: where it grazes an edge it is reflected from anywhere across it.
    `sigma_position_m` is added to the radius too.

    >>> a = np.linspace(-1.5, 1.5, 301)
    >>> post = np.where(abs(a) < 0.06, 2.0 - np.sqrt(0.15**2 - (2.0 * a).clip(-0.15, 0.15) ** 2), np.inf)
    >>> km.detect.Trunks().detect(post, a).y.round(2)
    array([[1.95, 0.  , 0.11]])
    """

    columns: ClassVar[tuple[str, ...]] = ("range_m", "bearing_rad", "radius_m")

    beams: Annotated[Count, "Beams on a trunk, at least."] = 2
    radius_min_m: Annotated[NotNegative, "Smallest radius."] = 0.0
    radius_max_m: Annotated[Limit, "Largest radius."] = 1.0
    roughness_m: Annotated[Positive, "Beams lie so far off the circle at most, RMS."] = 0.1
    beam_width_rad: Annotated[
        NotNegative, "Divergence of a beam, full angle; three quarters of the step between beams at least are taken."
    ] = 0.0

    def _find(self, r: Array, a: Array, intensities: Array | None) -> Detections:
        pieces, step = self.pieces(r, a)
        width = max(self.beam_width_rad, LINEAR * step)
        y, P, chi2, beams = circles(r, a, pieces, step, self.sigma_range_m**2, width**2 / 12, max(self.beams, 1))
        rms = np.sqrt(chi2 / (beams[:, 1] - beams[:, 0] + 1)) * self.sigma_range_m
        round_ = (rms <= self.roughness_m) & (self.radius_min_m <= y[:, 2]) & (y[:, 2] <= self.radius_max_m)
        return Detections(self.columns, y, P, beams, {"radius_m": y[:, 2], "rms_m": rms}).take(round_)

    def _widened(self, found: Detections) -> Detections:
        """Return the circles with the noise that is not in the beams, that of the radius included."""
        found = super()._widened(found)
        found.cov[:, 2, 2] += self.sigma_position_m**2
        return found


@compiled
def surface(d: float, R: float, delta: float) -> tuple[float, float, float, float]:
    """Return the range r of a circle at d under the angle delta off its centre, and r_d, r_delta, r_R."""
    s, c = math.sin(delta), math.cos(delta)
    depth = math.sqrt(max(R * R - (d * s) ** 2, (GRAZING * R) ** 2))
    return d * c - depth, c + d * s * s / depth, -d * s + d * d * s * c / depth, -R / depth


@compiled
def solve3(A: Array, g: Array) -> tuple[Array, Array]:
    """Return the solution of A x = g (3,) and the inverse of A (3, 3), a symmetric matrix; NaN if it is singular."""
    C = np.empty((3, 3))
    for i in range(3):
        p, q = (i + 1) % 3, (i + 2) % 3
        for j in range(3):
            s, t = (j + 1) % 3, (j + 2) % 3
            C[i, j] = A[p, s] * A[q, t] - A[p, t] * A[q, s]
    det = A[0, 0] * C[0, 0] + A[0, 1] * C[0, 1] + A[0, 2] * C[0, 2]
    C = C / det if det > 0.0 else np.full((3, 3), np.nan)
    return C @ g, C


@compiled
def fit_circle(
    r: Array, a: Array, low: float, high: float, var_edge: float, var_range: float, var_beam: float
) -> tuple[Array, Array, float]:
    """Return (d, b, R), its covariance (3, 3) and the chi-square of a segment r (n,) at a (n,) with edges low and high.

    `var_range` is that of a range, `var_beam` that of where in its width a beam is reflected, which matters where it
    grazes, `var_edge` that of an edge.  NaN if there is no such circle.
    """
    x, P, chi2 = np.empty(3), np.empty((3, 3)), np.inf
    sine = min(math.sin((high - low) / 2), 0.9)
    x[2] = np.min(r) * sine / (1.0 - sine)
    x[0], x[1] = np.min(r) + x[2], (low + high) / 2
    J = np.empty(3)
    for _ in range(STEPS):
        A, g, chi2 = np.zeros((3, 3)), np.zeros(3), 0.0
        for i in range(len(r) + 2):
            if i < len(r):
                e, J[0], slope, J[2] = surface(x[0], x[2], a[i] - x[1])
                J[1] = -slope
                z, weight = r[i] - e, 1.0 / (var_range + slope * slope * var_beam)
            else:
                side = 1.0 if i == len(r) else -1.0
                ratio = min(x[2] / x[0], 0.95)
                root = math.sqrt(1.0 - ratio * ratio)
                z = (high if side > 0 else low) - x[1] - side * math.asin(ratio)
                J[0], J[1], J[2] = -side * ratio / (x[0] * root), 1.0, side / (x[0] * root)
                weight = 1.0 / var_edge
            chi2 += z * z * weight
            for p in range(3):
                g[p] += J[p] * weight * z
                for q in range(3):
                    A[p, q] += J[p] * weight * J[q]
        step, P = solve3(A, g)
        x += step
        if not x[2] > 0.0 or not x[0] > x[2]:
            return np.full(3, np.nan), P, np.inf
        if abs(step[0]) + abs(step[2]) + x[0] * abs(step[1]) < 1e-4:
            break
    return x, P, chi2


@compiled
def circles(
    r: Array, a: Array, pieces: Index, step: float, var_range: float, var_beam: float, beams: int
) -> tuple[Array, Array, Array, Index]:
    """Return circles (S, 3), covariances (S, 3, 3), chi-squares (S,) and beams (S, 2) of the pieces that stand alone.

    Those are pieces of at least `beams` beams with nothing nearer beside them: what hides an edge makes it no edge.
    The first and the last beam of a scan are at an edge too, but of what is not known.
    """
    count = 0
    y, P, chi2 = np.empty((len(pieces), 3)), np.empty((len(pieces), 3, 3)), np.empty(len(pieces))
    used = np.empty((len(pieces), 2), np.int64)
    for s in range(len(pieces)):
        i, j = pieces[s]
        if j - i + 1 < beams or i == 0 or j == len(r) - 1:
            continue
        hidden = a[i] - a[i - 1] <= 1.5 * step and r[i - 1] < r[i]
        if hidden or (a[j + 1] - a[j] <= 1.5 * step and r[j + 1] < r[j]):
            continue
        low, high = a[i] - step / 2, a[j] + step / 2
        x, C, c2 = fit_circle(r[i : j + 1], a[i : j + 1], low, high, step * step / 12, var_range, var_beam)
        if math.isfinite(c2):
            y[count], P[count], chi2[count], used[count, 0], used[count, 1] = x, C, c2, i, j
            count += 1
    return y[:count].copy(), P[:count].copy(), chi2[:count].copy(), used[:count].copy()
