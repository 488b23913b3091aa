"""The compiled part of the detectors of walls and corners: surfaces cut into straight pieces, a line through each.

A line at distance p from the laser whose normal has the direction n is hit by the beam at angle a at p / cos(a - n).
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from kalmark.compiled import compiled

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]

STEPS = 10
CORE = 8  # the part of a piece, at each end, that does not say where its line is
NEAR2 = 16.0  # a beam within 4 sigma of a line is on it


@compiled
def farthest(x: Array, y: Array, i: int, j: int) -> tuple[int, float]:
    """Return which of the points i to j of x, y (N,) is farthest from the chord between these two, and its distance."""
    dx, dy = x[j] - x[i], y[j] - y[i]
    length, at, most = math.hypot(dx, dy), i, 0.0
    for k in range(i + 1, j):
        if length > 0.0:
            off = abs(dx * (y[k] - y[i]) - dy * (x[k] - x[i])) / length
        else:
            off = math.hypot(x[k] - x[i], y[k] - y[i])
        if off > most:
            at, most = k, off
    return at, most


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
                stack[depth, 0], stack[depth, 1] = (
                    k,
                    j,
                )  # the left half is looked at first: the order is that of the beams
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
def grown(r: Array, a: Array, pieces: Index, variance: float, beams: int) -> Index:
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
