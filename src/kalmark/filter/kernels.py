"""The compiled linear algebra of the map: P is the lower triangle of a square buffer, its upper triangle is never read.

Every function works on the rows of the blocks it is given; no Jacobian of the size of the map is ever formed.
Rank-k updates go through BLAS (dsyrk): in C order our lower triangle is Fortran's upper one.
"""

from __future__ import annotations

import sys
from importlib.machinery import PathFinder
from importlib.util import module_from_spec
from pathlib import Path
from typing import Any

import llvmlite.binding
import numpy as np
import numpy.typing as npt
import scipy
from numba import types
from numba.extending import get_cython_function_address
from threadpoolctl import ThreadpoolController

from kalmark.compiled import compiled

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]


def _load_blas(module: str) -> str:
    """Load SciPy's BLAS alone, which numba's products call, too: the package around it takes half as long as numba."""
    spec = PathFinder.find_spec(module, [str(Path(folder) / "linalg") for folder in scipy.__path__])
    if module not in sys.modules and spec is not None and spec.loader is not None:
        sys.modules[module] = module_from_spec(spec)
        spec.loader.exec_module(sys.modules[module])
    return module


_BLAS = _load_blas("scipy.linalg.cython_blas")
llvmlite.binding.add_symbol("kalmark_dsyrk", get_cython_function_address(_BLAS, "dsyrk"))
llvmlite.binding.add_symbol("kalmark_dgemm", get_cython_function_address(_BLAS, "dgemm"))
_dsyrk = types.ExternalFunction("kalmark_dsyrk", types.void(*[types.intp] * 10))
_dgemm = types.ExternalFunction("kalmark_dgemm", types.void(*[types.intp] * 13))
_UPPER_TRANS = np.array([ord("U"), ord("T")], dtype=np.uint8)
_TRANS_NO = np.array([ord("T"), ord("N")], dtype=np.uint8)
_MINUS_ONE_ONE = np.array([-1.0, 1.0])

CACHED = 256  # rows of a covariance that stays in a cache between one pass over it and the next
BAND = 128  # rows of a larger one that do


def one_thread() -> Any:
    """Keep BLAS to one thread: with more, it stalls on the small updates of a filter.  A context manager, too."""
    return ThreadpoolController().limit(limits=1, user_api="blas")


@compiled
def columns(P: Array, index: Index, n: int) -> Array:
    """Return P[:n, index] (n, k)."""
    k = len(index)
    C = np.empty((n, k))
    for c in range(k):
        j = index[c]
        for i in range(j):
            C[i, c] = P[j, i]
        for i in range(j, n):
            C[i, c] = P[i, j]
    return C


@compiled
def submatrix(P: Array, index: Index) -> Array:
    """Return P[index][:, index] (k, k)."""
    k = len(index)
    S = np.empty((k, k))
    for a in range(k):
        i = index[a]
        for b in range(a + 1):
            j = index[b]
            S[a, b] = S[b, a] = P[i, j] if i >= j else P[j, i]
    return S


@compiled
def set_columns(P: Array, index: Index, C: Array) -> None:
    """Write P[:, index] = C (n, k) and its mirror."""
    for c in range(len(index)):
        j = index[c]
        for i in range(len(C)):
            if i >= j:
                P[i, j] = C[i, c]
            else:
                P[j, i] = C[i, c]


@compiled
def predict(P: Array, n: int, index: Index, F: Array, Q: Array) -> None:
    """P <- F P F' + Q, F and Q (k, k) acting on the rows `index`.  [S] (15)-(17).  O(n)."""
    C = columns(P, index, n) @ F.T
    k = len(index)
    block = np.empty((k, k))
    for a in range(k):
        block[a] = C[index[a]]
    block = F @ block + Q
    for a in range(k):
        for b in range(k):
            C[index[a], b] = 0.5 * (block[a, b] + block[b, a])
    set_columns(P, index, C)


@compiled
def augment(P: Array, n: int, at: int, index: Index, G: Array, Q: Array) -> None:
    """Append a block at rows `at`: P_Lx = G P_x, P_LL = G P G' + Q, G (d, k) on the rows `index`.  [S] (35)-(38)."""
    d = len(G)
    for a in range(d):
        P[at + a, : at + d] = 0.0
        P[at + d : n, at + a] = 0.0
    C = columns(P, index, n) @ G.T
    P_LL = G @ (submatrix(P, index) @ G.T) + Q
    for a in range(d):
        for b in range(d):
            C[at + a, b] = 0.5 * (P_LL[a, b] + P_LL[b, a])
    set_columns(P, np.arange(at, at + d), C)


@compiled
def clear(P: Array, n: int, at: int, d: int) -> None:
    """Set the rows and columns at..at+d to zero: a removed block, or a fresh one known exactly."""
    for a in range(at, at + d):
        P[a, : a + 1] = 0.0
        P[a:n, a] = 0.0


@compiled
def downdate(P: Array, W: Array) -> None:
    """P <- P - W W', W (n, q), on the lower triangle.  [S] (30) with K Z K' = W W', W = P H' L^-T.  O(n^2 q)."""
    n, q = W.shape
    if n <= 40:  # below, the call costs more than the sum
        for i in range(n):
            for j in range(i + 1):
                s = 0.0
                for k in range(q):
                    s += W[i, k] * W[j, k]
                P[i, j] -= s
        return
    sizes = np.array([n, q, q, P.shape[1]], dtype=np.int32)
    at = sizes.ctypes.data
    chars, numbers = _UPPER_TRANS.ctypes.data, _MINUS_ONE_ONE.ctypes.data
    _dsyrk(chars, chars + 1, at, at + 4, numbers, W.ctypes.data, at + 8, numbers + 8, P.ctypes.data, at + 12)
    sizes[0] = W.shape[0]  # keeps both alive until the call is over


@compiled
def add_square(P: Array, D: Array) -> None:
    """P <- P + D D', D (n, q), on the lower triangle."""
    n, q = D.shape
    for i in range(n):
        for j in range(i + 1):
            for k in range(q):
                P[i, j] += D[i, k] * D[j, k]


@compiled
def transport(P: Array, a: Array, theta: int) -> None:
    """P <- A P A' with A = I + a e_theta', a (n, 1 or 3): P += a w' + w a', w = P[:, theta] + a P[theta, theta] / 2."""
    n, axes = a.shape
    rows = np.arange(theta, theta + axes)
    w = columns(P, rows, n) + a @ (0.5 * submatrix(P, rows))
    for c in range(axes):
        a_c, w_c = a[:, c].copy(), w[:, c].copy()
        for i in range(n):
            a_i, w_i = a_c[i], w_c[i]
            for j in range(i + 1):
                P[i, j] += a_i * w_c[j] + w_i * a_c[j]


@compiled
def subtract_product(C: int, stride: int, L: int, rows: int, R: int, columns: int, q: int) -> None:
    """C -= L R' for L (rows, q), R (columns, q) and C, of so many numbers a row, at those addresses."""
    sizes = np.array([columns, rows, q, stride], dtype=np.int32)
    at, chars, numbers = sizes.ctypes.data, _TRANS_NO.ctypes.data, _MINUS_ONE_ONE.ctypes.data
    _dgemm(chars, chars + 1, at, at + 4, at + 8, numbers, R, at + 8, L, at + 8, numbers + 8, C, at + 12)
    sizes[0] = rows  # keeps them alive until the call is over


@compiled
def downdate_and_transport(P: Array, W: Array, a: Array, theta: int) -> None:
    """P <- A (P - W W') A', `downdate` and `transport` in one pass over a P that is larger than a cache."""
    n, axes = a.shape
    if n <= CACHED:
        downdate(P, W)
        transport(P, a, theta)
        return
    q, rows = W.shape[1], np.arange(theta, theta + axes)
    L, R = np.empty((n, q + 2 * axes)), np.empty((n, q + 2 * axes))
    w = columns(P, rows, n) - W @ W[theta : theta + axes].T
    w += a @ (0.5 * w[theta : theta + axes])
    L[:, :q], L[:, q : q + axes], L[:, q + axes :] = W, -w, -a
    R[:, :q], R[:, q : q + axes], R[:, q + axes :] = W, a, w
    for first in range(0, n, BAND):
        last = min(first + BAND, n)
        C, here = P.ctypes.data + first * P.strides[0], L.ctypes.data + first * L.strides[0]
        subtract_product(C, P.shape[1], here, last - first, R.ctypes.data, last, L.shape[1])
    L[0], R[0] = 0.0, 0.0  # keeps them alive until the calls are over


@compiled
def cholesky_inverse(S: Array) -> tuple[Array, bool]:
    """Return L^-1 with L L' = S, and whether S is positive definite."""
    n = len(S)
    L = np.zeros((n, n))
    for j in range(n):
        for i in range(j, n):
            s = S[i, j]
            for k in range(j):
                s -= L[i, k] * L[j, k]
            if i > j:
                L[i, j] = s / L[j, j]
            elif s > 0.0:
                L[j, j] = np.sqrt(s)
            else:
                return L, False
    M = np.zeros((n, n))
    for j in range(n):
        M[j, j] = 1.0 / L[j, j]
        for i in range(j + 1, n):
            s = 0.0
            for k in range(j, i):
                s += L[i, k] * M[k, j]
            M[i, j] = -s / L[i, i]
    return M, True


@compiled
def all_finite(a: Array, B: Array, C: Array) -> bool:
    """Return whether a vector and two matrices hold finite numbers only."""
    return bool(np.isfinite(a).all() and np.isfinite(B).all() and np.isfinite(C).all())
