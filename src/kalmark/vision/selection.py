"""Matches that agree: one-point RANSAC, then active search for the rest.  Civera et al. 2010; Davison 2005.

One match of one landmark, fused into a copy of the mean, determines nearly all of the camera's rotation.  The others
agree with it if they are then found within a pixel or two.  The matches that agree with the best of a few such matches
are accepted together.  The ellipses of the rest are then small; they are searched in the order of information gain.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from kalmark.arrays import Array, Flags, Index
from kalmark.vision.joint_expectation import PIXEL, Belief, Prospect
from kalmark.vision.template_matching import Searcher

GATE = 9.0  # of d2: three sigmas of each axis of an ellipse
MOST_AREA_PX = 10_000.0  # of an ellipse that is searched; a larger one is reduced to it
TRIES = 6
SURE = 0.99  # no more tries once it is so probable that one of them was no outlier
AGREE = 2.0  # sigmas of the noise of a pixel within which a match agrees with another one
WORTH_PX = 3.0  # one landmark at a time is searched while its ellipse has such a radius
ONE_BY_ONE = 3


@dataclass
class Selection:
    """Matches of K landmarks: pixels y (K, 2), scores (K,), flags `searched` and `matched` (K,).

    `belief` is the density after them, `centres` (K, 2) and `regions` (K, 2, 2) the ellipses searched, NaN where
    none was, `base` the landmark on whose match the others agree.  The covariance of the map was too small by `wider`.
    """

    belief: Belief
    y: Array
    searched: Flags
    matched: Flags
    centres: Array
    regions: Array
    base: int = -1
    tries: int = 0
    wider: float = 1.0


class ImageSearch:
    """One search of an image for the landmarks of a prospect; `valid` (n,) are those of which there is a template."""

    def __init__(self, prospect: Prospect, valid: Index, searcher: Searcher, updates: int) -> None:
        self.prospect, self.valid, self.searcher, self.updates = prospect, valid, searcher, updates
        self.sigma = np.sqrt(np.diagonal(prospect.R, axis1=1, axis2=2)[:, :PIXEL].max(axis=1, initial=0.0))
        k = len(prospect)
        self.found = Selection(
            prospect.belief, np.full((k, 2), np.nan), np.zeros(k, np.bool_), np.zeros(k, np.bool_),
            np.full((k, 2), np.nan), np.full((k, 2, 2), np.nan),
        )  # fmt: skip

    def run(self, random: np.random.Generator) -> Selection:
        """Return the matches."""
        if len(self.valid):
            self._consensus(random)
            self._active()
        return self.found

    def run_again(self, rows: Index, y: Array) -> Selection:
        """Return the matches, with those y (n, 2) of some recognised landmarks.

        Where they are farther off than expected, in the median, the covariance is too small by as much.
        """
        found = self.found
        d2 = float(np.median(self._d2(found.belief, rows, y)))
        if d2 > GATE:
            found.wider = d2 / PIXEL
            found.belief = replace(found.belief, S=found.wider * found.belief.S, C=found.wider * found.belief.C)
        self._take(rows, y)
        self._active()
        return found

    # ------------------------------------------------------------------ one-point RANSAC
    def _consensus(self, random: np.random.Generator) -> None:
        """Accept the matches that agree with the best of some single ones."""
        found, prior = self.found, self.prospect.belief
        best, best_y = np.zeros(0, np.int64), np.zeros((0, 2))
        needed = float(TRIES)
        for base in random.permutation(self.valid)[:TRIES].tolist():
            if found.tries >= needed:
                break
            found.tries += 1
            rows = np.array([base])
            y, good = self._in_ellipses(prior, rows)
            if not good[0]:
                continue
            rows, y = self._agreeing(base, y)
            if len(rows) > len(best):
                best, best_y, found.base = rows, y, base
                share = len(best) / len(self.valid)
                needed = math.log(1 - SURE) / math.log(1 - share) if share < 1 else 0.0
        if len(best) > 1:
            if len(best) > self.updates:
                some = np.sort(random.permutation(len(best))[: self.updates])
                best, best_y = best[some], best_y[some]
            self._take(best, best_y)

    def _agreeing(self, base: int, y: Array) -> tuple[Index, Array]:
        """Return the landmarks (n,) that are found where the match y (1, 2) of one predicts them, and their pixels."""
        prospect, prior = self.prospect, self.prospect.belief
        e = prospect.expected(prospect.moved(prior, [base], y))[:, :PIXEL]
        others = self.valid[self.valid != base]
        at, scores = self.searcher.in_discs(others, e[others], AGREE * self.sigma[others])
        good = np.flatnonzero(scores >= self.searcher.accept)
        fits = good[self._d2(prior, others[good], at[good]) <= GATE]
        return np.concatenate([[base], others[fits]]), np.concatenate([y, at[fits]])

    def _d2(self, belief: Belief, rows: Index, y: Array) -> Array:
        z = y - belief.pixels[rows]
        return np.einsum(
            "ka,ka->k", z, np.linalg.solve(self.prospect.innovations(belief, rows), z[:, :, None])[:, :, 0]
        )

    def _take(self, rows: Index, y: Array) -> None:
        found = self.found
        found.matched[rows] = found.searched[rows] = True
        found.y[rows] = y
        found.belief = self.prospect.after(found.belief, rows, y)

    # ------------------------------------------------------------------ active search
    def _active(self) -> None:
        """Search for the rest, in the order of their information gain."""
        found = self.found
        found.searched[:] = found.matched  # what did not agree is searched again, in a smaller ellipse
        for _ in range(ONE_BY_ONE):
            pending, radii = self._pending()
            if not len(pending) or radii[0] < WORTH_PX:
                break
            y, good = self._in_ellipses(found.belief, pending[:1])
            if good[0]:
                self._take(pending[:1], y)
        pending, _ = self._pending()
        y, good = self._in_ellipses(found.belief, pending)
        if good.any():
            self._take(pending[good], y[good])

    def _pending(self) -> tuple[Index, Array]:
        """Return the landmarks yet to be searched, the largest ellipses first, and their mean radii in px."""
        found = self.found
        left = self.valid[~found.searched[self.valid]]
        Z = self.prospect.innovations(found.belief, left)
        radii = math.sqrt(GATE) * np.maximum(np.linalg.det(Z), 0.0) ** 0.25
        order = np.argsort(-radii, kind="stable")[: max(self.updates - int(found.matched.sum()), 0)]
        return left[order], radii[order]

    def _in_ellipses(self, belief: Belief, rows: Index) -> tuple[Array, Flags]:
        """Return the pixels (n, 2) of landmarks found in their ellipses, and which are found (n,)."""
        found, Z, e = self.found, self.prospect.innovations(belief, rows), belief.pixels[rows]
        found.searched[rows], found.centres[rows], found.regions[rows] = True, e, Z
        area = math.pi * GATE * np.sqrt(np.maximum(np.linalg.det(Z), 1e-12))
        smaller = np.minimum(1.0, MOST_AREA_PX / area)[:, None, None]
        y, scores = self.searcher.in_ellipses(rows, e, Z * smaller, GATE)
        return y, scores >= self.searcher.accept
