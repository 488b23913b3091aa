"""The compiled part of the trunk detector: segments of a scan, and a circle through each.

A circle of radius R at range d and bearing b is hit by the beams within asin(R / d) of b, the one at angle a at

    r(a) = d cos(a - b) - sqrt(R^2 - d^2 sin^2(a - b)).

So a segment measures it by the ranges of its n beams, and by two edges, each between its outermost beam and the next
one, which passes by: n + 2 numbers for d, b and R, solved by Gauss and Newton.  One beam is enough.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from kalmark.compiled import compiled

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]

STEPS = 12
GRAZING = 0.35  # a beam that hits nearer to the edge than this, in radii of depth, is taken to hit there


@compiled
def segments(r: Array, a: Array, step: float, slope: float, jump_m: float) -> Index:
    """Return the first and last beam (S, 2) of each piece of surface in a scan of ranges r (N,) at angles a (N,).

    Ranges that are not finite are no returns.  Neighbours, at most 1.5 steps apart, belong together unless their ranges
    differ by more than on a surface that is hit under an angle of at least `slope`:
    r sin(step) / sin(slope - step) + jump_m.  Borges and Aldon 2004.
    """
    n, count = len(r), 0
    out = np.empty((n, 2), np.int64)
    rate = math.sin(step) / math.sin(slope - step)
    for i in range(n):
        if not math.isfinite(r[i]):
            continue
        joined = count > 0 and out[count - 1, 1] == i - 1 and a[i] - a[i - 1] <= 1.5 * step
        if joined and abs(r[i] - r[i - 1]) <= min(r[i], r[i - 1]) * rate + jump_m:
            out[count - 1, 1] = i
        else:
            out[count, 0] = out[count, 1] = i
            count += 1
    return out[:count].copy()


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
