"""Search for templates inside ellipses: normalised cross-correlation, coarse to fine, to a fraction of a pixel.

All sums are of whole numbers, so that they are exact.  A first look at every second pixel of every second row rejects
most places early.  Ellipses of some size are searched at half the resolution first, by OpenCV.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from kalmark.arrays import Array, Index
from kalmark.compiled import compiled
from kalmark.vision import opencv as cv2

COARSE_PX = 8.0  # an ellipse of larger radius is searched at half the resolution first
COARSE_LESS = 0.15  # the score may be so much lower there
COARSE_BEST = 3  # maxima there that are looked at in full resolution
EARLY_LESS = 0.25  # the score of every fourth pixel may be so much lower
OUTSIDE = -2.0  # the score of what is not in the image
LEAST_GAIN = 0.1  # of a template where it is found: with less contrast it is something else


class Searcher:
    """Searches one image (H, W) for templates (K, s, s) of s = 4 n + 1 pixels, whose centres half the resolution keeps.

    `accept` is the least score of a match.
    """

    def __init__(self, image: Any, templates: Any, accept: float) -> None:
        self.image, self.templates, self.accept = np.ascontiguousarray(image), templates, accept
        self._half: Any = None

    def in_ellipses(self, which: Index, e: Array, Z: Array, d2: float) -> tuple[Array, Array]:
        """Return the pixels (k, 2) of templates `which` (k,) in (y - e)' Z^-1 (y - e) <= d2, and scores (k,).

        The score of what is not found is below `accept`.
        """
        r: Array = np.sqrt(d2 * np.diagonal(Z, axis1=1, axis2=2))
        large = np.flatnonzero(r.max(axis=1, initial=0.0) > COARSE_PX).tolist()
        limit = np.full(len(which), d2)
        limit[large] = -1.0
        W = np.ascontiguousarray(np.linalg.inv(Z))
        y, scores = best_matches(self.image, self.templates, which, e, W, r, limit, self.accept)
        for k in large:
            y[k], scores[k] = self._coarse_to_fine(int(which[k]), e[k], Z[k], d2, r[k])
        return y, scores

    def in_discs(self, which: Index, e: Array, radius: Array) -> tuple[Array, Array]:
        """Return where templates `which` (k,) are found within a radius (k,) of e, (k, 2), and their scores (k,)."""
        W = np.broadcast_to(np.eye(2), (len(which), 2, 2)).copy()
        r = np.column_stack([radius, radius])
        return best_matches(self.image, self.templates, which, e, W, r, radius * radius, self.accept)

    def _coarse_to_fine(self, which: int, e: Array, Z: Array, d2: float, r: Array) -> tuple[Array, float]:
        """Search at half the resolution, then about the best places there."""
        if self._half is None:
            self._half = cv2.pyrDown(self.image)
        template = cv2.pyrDown(self.templates[which])
        h, size = template.shape[0] // 2, np.array(self._half.shape[::-1])
        low = np.maximum(np.ceil(e / 2 - r / 2), h).astype(np.int64)
        end = np.minimum(np.floor(e / 2 + r / 2), size - 1 - h).astype(np.int64) + 1
        best, most = e, OUTSIDE
        if (low >= end).any():
            return best, most
        region = self._half[low[1] - h : end[1] + h, low[0] - h : end[0] + h]
        scores = cv2.matchTemplate(region, template, cv2.TM_CCOEFF_NORMED)
        x, y = (2.0 * np.arange(first, stop) - at for first, stop, at in zip(low, end, e, strict=True))
        W = np.linalg.inv(Z)
        inside = W[0, 0] * x**2 + 2 * W[0, 1] * y[:, None] * x + W[1, 1] * (y**2)[:, None] <= d2
        scores = np.where(inside, scores, OUTSIDE)
        for _ in range(COARSE_BEST):
            j, i = divmod(int(scores.argmax()), scores.shape[1])
            if scores[j, i] < self.accept - COARSE_LESS:
                break
            near = np.array([[x[i] + e[0], y[j] + e[1]]])
            (found,), (score,) = self.in_discs(np.array([which]), near, np.array([2.0]))
            if score > most:
                best, most = found, float(score)
            scores[max(j - 1, 0) : j + 2, max(i - 1, 0) : i + 2] = OUTSIDE
        return best, most


@compiled
def correlation(image: Any, template: Any, u: int, v: int, step: int) -> float:
    """Return the normalised cross-correlation of a template with the image about column u and row v.

    Of every `step`-th pixel of every `step`-th row.  -2 outside of the image, 0 where either has no contrast.
    """
    s = template.shape[0]
    left, top = u - s // 2, v - s // 2
    if left < 0 or top < 0 or left + s > image.shape[1] or top + s > image.shape[0]:
        return -2.0
    n = ((s + step - 1) // step) ** 2
    a = b = aa = bb = ab = np.int64(0)
    for j in range(0, s, step):
        for i in range(0, s, step):
            p, q = np.int64(image[top + j, left + i]), np.int64(template[j, i])
            a += p
            b += q
            aa += p * p
            bb += q * q
            ab += p * q
    spread = float(n * aa - a * a) * float(n * bb - b * b)
    return float(n * ab - a * b) / math.sqrt(spread) if spread > 0.0 else 0.0


@compiled
def best_matches(
    image: Any, templates: Any, which: Index, e: Array, W: Array, r: Array, limit: Array, accept: float
) -> tuple[Array, Array]:  # fmt: skip
    """Return for each template `which` (k,) the best place (k, 2) in (y - e)' W (y - e) <= limit and its score (k,).

    `r` (k, 2) is half the size of a box about that.  The pixel nearest to e always counts; with a negative limit none.
    """
    k = len(which)
    found, scores = e.copy(), np.full(k, -2.0)
    for o in range(k):
        if not (limit[o] >= 0.0 and np.isfinite(e[o, 0]) and np.isfinite(e[o, 1])):
            continue
        template, best, at_u, at_v = templates[which[o]], -2.0, 0, 0
        near_u, near_v = int(np.rint(e[o, 0])), int(np.rint(e[o, 1]))
        across, down = int(r[o, 0]) + 1, int(r[o, 1]) + 1
        for v in range(near_v - down, near_v + down + 1):
            for u in range(near_u - across, near_u + across + 1):
                x, y = u - e[o, 0], v - e[o, 1]
                far = W[o, 0, 0] * x * x + 2.0 * W[o, 0, 1] * x * y + W[o, 1, 1] * y * y
                if far > limit[o] and not (u == near_u and v == near_v):
                    continue
                if correlation(image, template, u, v, 2) < accept - EARLY_LESS:
                    continue
                score = correlation(image, template, u, v, 1)
                if score > best:
                    best, at_u, at_v = score, u, v
        scores[o] = best
        if best >= accept:
            across_top, down_top = top(image, template, at_u, at_v)
            found[o, 0], found[o, 1] = at_u + across_top, at_v + down_top
    return found, scores


@compiled
def top(image: Any, template: Any, u: int, v: int) -> tuple[float, float]:
    """Return the offset of the maximum of a quadratic, fitted to the nine scores about (u, v), from (u, v).

    Nothing where the quadratic has none nearby, or at the border of the image.
    """
    c = np.empty((3, 3))
    for j in range(3):
        for i in range(3):
            c[j, i] = correlation(image, template, u + i - 1, v + j - 1, 1)
            if c[j, i] < -1.0:
                return 0.0, 0.0
    x = y = xx = yy = 0.0
    for k in range(3):
        x += (c[k, 2] - c[k, 0]) / 6.0
        y += (c[2, k] - c[0, k]) / 6.0
        xx += (c[k, 2] - 2.0 * c[k, 1] + c[k, 0]) / 3.0
        yy += (c[2, k] - 2.0 * c[1, k] + c[0, k]) / 3.0
    xy = (c[2, 2] - c[2, 0] - c[0, 2] + c[0, 0]) / 4.0
    det = xx * yy - xy * xy
    if not (det > 0.0 and xx < 0.0):
        return 0.0, 0.0
    a, b = -(yy * x - xy * y) / det, -(xx * y - xy * x) / det
    return min(max(a, -1.0), 1.0), min(max(b, -1.0), 1.0)


@compiled
def fit_template(image: Any, template: Any, y: Array, rates: Array) -> tuple[Array, Array, float]:
    """Return gain g, offset o, shift t and slopes ds (4 + m,) of a template (s, s) found at y (2,), by least squares.

    I(x) = g T(x) + o - T_x (x_s ds + t), rates x_s (m, 2, 2), each a matrix that multiplies x.  Then the inverse of the
    information, for a variance of 1, and the sum of the squares that are left.  NaN where it is partly outside.
    """
    s, m = template.shape[0], 4 + len(rates)
    h, column, A, b, whole = s // 2, np.empty(m), np.zeros((m, m)), np.zeros(m), 0.0
    left, above = int(np.floor(y[0])), int(np.floor(y[1]))
    if left < h or above < h or left + h + 1 >= image.shape[1] or above + h + 1 >= image.shape[0]:
        return np.full(m, np.nan), A, 0.0
    du, dv = y[0] - left, y[1] - above
    for j in range(1, s - 1):
        for i in range(1, s - 1):
            u, v = left + i - h, above + j - h
            value = (1.0 - dv) * ((1.0 - du) * image[v, u] + du * image[v, u + 1])
            value += dv * ((1.0 - du) * image[v + 1, u] + du * image[v + 1, u + 1])
            T_u = 0.5 * (float(template[j, i + 1]) - float(template[j, i - 1]))
            T_v = 0.5 * (float(template[j + 1, i]) - float(template[j - 1, i]))
            column[0], column[1], column[2], column[3] = float(template[j, i]), 1.0, -T_u, -T_v
            for a in range(m - 4):
                column[4 + a] = -T_u * (rates[a, 0, 0] * (i - h) + rates[a, 0, 1] * (j - h))
                column[4 + a] -= T_v * (rates[a, 1, 0] * (i - h) + rates[a, 1, 1] * (j - h))
            for p in range(m):
                b[p] += column[p] * value
                for q in range(m):
                    A[p, q] += column[p] * column[q]
            whole += value * value
    for p in range(m):
        A[p, p] += 1e-6 * (1.0 + A[p, p])
    found: Any = np.linalg.solve(A, b)
    inverse: Any = np.linalg.inv(A)
    return found, inverse, float(whole - found @ b)


@compiled
def shift_covariances(image: Any, templates: Any, which: Index, y: Array) -> Array:
    """Return the covariances (k, 2, 2) of least-squares shifts of templates `which` (k,) that were found at y (k, 2).

    With the variance of what the fit leaves.  Zero where the template is partly outside, or belongs to another image.
    """
    C, no_slopes = np.zeros((len(which), 2, 2)), np.zeros((0, 2, 2))
    for o in range(len(which)):
        found, inverse, rest = fit_template(image, templates[which[o]], y[o], no_slopes)
        if found[0] > LEAST_GAIN:
            C[o] = max(rest, 0.0) / ((templates.shape[1] - 2) ** 2 - 4) / found[0] ** 2 * inverse[2:, 2:]
    return C
