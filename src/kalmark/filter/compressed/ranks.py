"""The numerical rank of what a full update subtracts: far from the active blocks it is small.  docs/compressed.md.

Of P_BB - W W' any rotation of the columns of W is free.  Here it is one after which the rows of most blocks are nearly
zero from some column on; a tile of the product needs only the columns before that.  The omitted part of an element is
at most `EXACT` times the sigmas of its row and its column.
"""

from __future__ import annotations

import numpy as np

from kalmark.arrays import Array, Index
from kalmark.compiled import compiled

EXACT = 1e-13
STEP = 8  # columns: widths are multiples of it
SAMPLE, FAR = 160, 128  # rows that the rotation is made from, and those of them that are farthest
ROUGH = SAMPLE // 8  # directions beyond which a row near the active blocks has more than one that is far
FEWEST = 2000  # rows of a map: in a smaller one all tiles are about as wide as W


def rotate_factor(L: Array, W: Array) -> Array:
    """Return L Q (n, q) with a rotation Q that leaves rows far from the active blocks few columns.

    W (N, q) are rows of P0_BA L, in units of their sigmas.
    """
    from scipy.linalg.lapack import dgeqp3, dormqr

    T, order, *_ = dgeqp3(W.T)
    rough = np.empty(len(W))
    rough[order - 1] = np.sqrt((np.triu(T)[ROUGH:] ** 2).sum(axis=0))
    far = np.sort(np.argsort(rough, kind="stable")[:FAR])
    T, _, tau, *_ = dgeqp3(W[far].T)
    k = len(tau)
    return np.ascontiguousarray(dormqr("R", "N", T[:, :k], tau, L, 64 * len(L))[0])


@compiled
def add_rests(rests: Array, panels: Index, W: Array, variances: Array) -> None:
    """Enter rows W (N, q) into the rests (panels, B) of their panels.

    These are the largest norms of a row, in its sigmas, from each STEP-th column on.
    """
    q = W.shape[1]
    for i in range(len(W)):
        if variances[i] <= 0.0:
            continue
        square = 0.0
        for b in range((q - 1) // STEP, -1, -1):
            for j in range(b * STEP, min(q, (b + 1) * STEP)):
                square += W[i, j] * W[i, j]
            rests[panels[i], b] = max(rests[panels[i], b], np.sqrt(square / variances[i]))


@compiled
def widths_of(rests: Array, panel: int, q: int, exact: float) -> Index:
    """Return how many of q columns the tiles (panel + 1,) of a panel need: `rests` (panels, B) are their rows'."""
    widths = np.full(panel + 1, q)
    for j in range(panel + 1):
        for b in range(rests.shape[1]):
            if rests[panel, b] * rests[j, b] <= exact:
                widths[j] = min(q, b * STEP)
                break
    return widths
