"""Products of small matrices, compiled."""

from __future__ import annotations

import numpy as np

from kalmark.arrays import Array
from kalmark.compiled import compiled


@compiled
def product(A: Array, B: Array) -> Array:
    """Return A B (m, n), for an A (m, k) that is so small that a call of BLAS would cost more than the sum."""
    out = np.zeros((len(A), B.shape[1]))
    for i in range(len(A)):
        for k in range(len(B)):
            a = A[i, k]
            for j in range(B.shape[1]):
                out[i, j] += a * B[k, j]
    return out
