"""The kinds of arrays, for hints, a docstring states the shape; and matrices of blocks."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]


def block_diagonal(blocks: Sequence[Array]) -> Array:
    """Return the matrix with these blocks (m, n) on its diagonal: scipy's takes 30 us a block."""
    out, i, j = np.zeros(np.sum([block.shape for block in blocks], axis=0)), 0, 0
    for block in blocks:
        m, n = block.shape
        out[i : i + m, j : j + n] = block
        i, j = i + m, j + n
    return out


def diagonal_blocks(P: Array, d: int) -> Array:
    """Return the blocks (K, d, d) on the diagonal of P (K d, K d)."""
    k = len(P) // d
    return P.reshape(k, d, k, d)[np.arange(k), :, np.arange(k)]
