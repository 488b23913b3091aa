"""The compiled linear algebra of the map: P is the lower triangle of a square buffer, its upper triangle is never read.

Every function works on the rows of the blocks it is given; no Jacobian of the size of the map is ever formed.
Rank-k updates go through BLAS (dgemm): in C order our matrices are Fortran's transposed ones.
"""

from __future__ import annotations

import ctypes
import math
import sys
from importlib.machinery import PathFinder
from importlib.util import module_from_spec
from pathlib import Path
from typing import Any

import llvmlite.binding
import numba
import numpy as np
import scipy
from numba import types
from numba.extending import get_cython_function_address
from threadpoolctl import ThreadpoolController

from kalmark.arrays import Array, Index
from kalmark.compiled import compiled
from kalmark.geometry.frames import product


def _load_blas(module: str) -> str:
    """Load SciPy's BLAS alone, which numba's products call, too: the package around it takes half as long as numba."""
    spec = PathFinder.find_spec(module, [str(Path(folder) / "linalg") for folder in scipy.__path__])
    if module not in sys.modules and spec is not None and spec.loader is not None:
        sys.modules[module] = module_from_spec(spec)
        spec.loader.exec_module(sys.modules[module])
    return module


def _routine(module: str, name: str, arguments: int) -> Any:
    """Return a routine of SciPy's BLAS or LAPACK, whose arguments are addresses, for compiled code or for Python."""
    address, form = get_cython_function_address(_load_blas(f"scipy.linalg.{module}"), name), ctypes.c_void_p
    if numba.config.DISABLE_JIT:
        return ctypes.CFUNCTYPE(None, *[form] * arguments)(address)
    llvmlite.binding.add_symbol(f"kalmark_{name}", address)
    return types.ExternalFunction(f"kalmark_{name}", types.void(*[types.intp] * arguments))


_dgemm = _routine("cython_blas", "dgemm", 13)
_dpotrf = _routine("cython_lapack", "dpotrf", 5)
_UPPER_NO = np.array([ord("U"), ord("N")], dtype=np.uint8)
_TRANS_NO = np.array([ord("T"), ord("N"), ord("T")], dtype=np.uint8)
_MINUS_ONE_ONE = np.array([-1.0, 1.0])

CACHED = 512  # rows of a covariance that stays in a cache between one pass over it and the next
BAND, NARROW = 128, 24  # rows of a larger one that do, and rows of a smaller one that are corrected at once
TILE = 64  # rows of a tile of which two do
FEW = 8  # rows of a factor whose product takes less time without BLAS

# Bounds on what rounding takes off a variance: with these a covariance stays one where 1e-5 rad are beside metres
KEPT = 2.0**-50  # of what a variance loses to a correction, and of the terms that a prediction adds up
RAISED = 2.0**-44  # of the variance of an innovation
LEAST_VARIANCE = 1e-20  # m^2, rad^2: what is smaller has no sign


def one_thread() -> Any:
    """Keep BLAS to one thread: with more, it stalls on the small updates of a filter.  A context manager, too."""
    return ThreadpoolController().limit(limits=1, user_api="blas")


@compiled
def take_rows(P: Array, index: Index, n: int) -> Array:
    """Return P[index, :n] (k, n)."""
    k = len(index)
    B = np.empty((k, n))
    for a in range(k):
        i = index[a]
        for j in range(i):
            B[a, j] = P[i, j]
        for j in range(i, n):
            B[a, j] = P[j, i]
    return B


@compiled
def copy_submatrix(P: Array, index: Index, S: Array) -> None:
    """Write P[index][:, index] into S (k, k): in tiles, since a mirror image as a whole goes through no cache."""
    k = len(index)
    for first in range(0, k, TILE):
        for left in range(0, first + 1, TILE):
            for a in range(first, min(first + TILE, k)):
                i = index[a]
                for b in range(left, min(left + TILE, a + 1)):
                    j = index[b]
                    S[a, b] = S[b, a] = P[i, j] if i >= j else P[j, i]


@compiled
def submatrix(P: Array, index: Index) -> Array:
    """Return P[index][:, index] (k, k)."""
    S = np.empty((len(index), len(index)))
    copy_submatrix(P, index, S)
    return S


@compiled
def set_rows(P: Array, index: Index, B: Array) -> None:
    """Write P[index, :n] = B (k, n) and its mirror."""
    for a in range(len(index)):
        i = index[a]
        for j in range(i):
            P[i, j] = B[a, j]
        for j in range(i, B.shape[1]):
            P[j, i] = B[a, j]


@compiled
def quadratic(A: Array, S: Array) -> Array:
    """Return A S A' (m, m) of A (m, n) and S (n, n), symmetric to the last bit."""
    AS, C = product(A, S), np.empty((len(A), len(A)))
    for i in range(len(A)):
        for j in range(i + 1):
            one = other = 0.0
            for k in range(A.shape[1]):
                one += AS[i, k] * A[j, k]
                other += AS[j, k] * A[i, k]
            C[i, j] = C[j, i] = 0.5 * (one + other)
    return C


@compiled
def lower_product(M: Array, B: Array) -> Array:
    """Return M B of a lower triangle M (m, m), zero elsewhere, and B (m, n), two rows by four of B at a time."""
    m, n = B.shape
    out = np.zeros((m, n))
    for k in range(m % 2 * n):
        out[0, k] = M[0, 0] * B[0, k]
    for i in range(m % 2, m, 2):
        j = 0
        while j + 4 <= i + 2:
            a, b, c, d = M[i, j], M[i, j + 1], M[i, j + 2], M[i, j + 3]
            e, f, g, h = M[i + 1, j], M[i + 1, j + 1], M[i + 1, j + 2], M[i + 1, j + 3]
            for k in range(n):
                r, s, t, u = B[j, k], B[j + 1, k], B[j + 2, k], B[j + 3, k]
                out[i, k] += a * r + b * s + c * t + d * u
                out[i + 1, k] += e * r + f * s + g * t + h * u
            j += 4
        while j < i + 2:
            a, e = M[i, j], M[i + 1, j]
            for k in range(n):
                out[i, k] += a * B[j, k]
                out[i + 1, k] += e * B[j, k]
            j += 1
    return out


@compiled
def moved_noise(moved: Array, F: Array, R_u: Array, N: Array) -> tuple[Array, bool]:
    """Return Q = R_u N R_u' (n, n), and whether Q, the moved mean (n,) and F (n, n) are finite."""
    Q, total = quadratic(R_u, N), 0.0
    for i in range(len(moved)):
        total += 0.0 * moved[i]
    for i in range(len(F)):
        for j in range(len(F)):
            total += 0.0 * (F[i, j] + Q[i, j])
    return Q, total == 0.0  # 0 times what is not finite is NaN


@compiled
def predict(P: Array, n: int, index: Index, F: Array, Q: Array) -> None:
    """P <- F P F' + Q, F and Q (k, k) acting on the rows `index`.  [S] (15)-(17).  O(n)."""
    B = product(F, take_rows(P, index, n))
    block = quadratic(F, submatrix(P, index))
    for a in range(len(index)):
        for b in range(len(index)):
            B[a, index[b]] = block[a, b] + 0.5 * (Q[a, b] + Q[b, a])
        terms = 0.0
        for b in range(len(index)):  # at most the sum of all |F P F'|, of which no change needs none
            terms += abs(F[a, b]) * math.sqrt(max(P[index[b], index[b]], 0.0))
        B[a, index[a]] += KEPT * max(terms * terms - P[index[a], index[a]], 0.0)
    set_rows(P, index, B)


@compiled
def any_product(A: Array, B: Array) -> Array:
    """Return A B, for an A (m, k) of any size."""
    return product(A, B) if len(A) <= FEW else A @ B


@compiled
def augment(P: Array, n: int, rows: Index, index: Index, G: Array, Q: Array) -> None:
    """Append blocks at `rows` (d,): P_Lx = G P_x, P_LL = G P G' + Q, G (d, k) on the rows `index`.  [S] (35)-(38)."""
    B = any_product(G, take_rows(P, index, n))
    GP, G_T = np.empty(G.shape), np.empty((G.shape[1], len(G)))
    for a in range(len(rows)):
        for c in range(len(index)):
            GP[a, c], G_T[c, a] = B[a, index[c]], G[a, c]
    P_LL = any_product(GP, G_T)
    for a in range(len(rows)):
        for b in range(len(rows)):
            B[a, rows[b]] = 0.5 * (P_LL[a, b] + P_LL[b, a] + (Q[a, b] + Q[b, a]))
    set_rows(P, rows, B)


@compiled
def clear_block(P: Array, n: int, at: int, d: int) -> None:
    """Set the rows and columns at..at+d of P (n, n) to zero: a removed block, or a new one that is known exactly."""
    for a in range(at, at + d):
        for b in range(a + 1):
            P[a, b] = 0.0
        for b in range(a, n):
            P[b, a] = 0.0


@compiled
def keep_some(P: Array, V: Array) -> None:
    """Raise the diagonal of P (n, n) by `KEPT` of that of V' V, V (q, n): more than its subtraction rounds."""
    lost = np.zeros(V.shape[1])
    for k in range(len(V)):
        for i in range(len(lost)):
            lost[i] += V[k, i] * V[k, i]
    for i in range(len(lost)):
        P[i, i] += KEPT * lost[i]


@compiled
def downdate(P: Array, V: Array) -> None:
    """P <- P - V' V, V (q, n), on the lower triangle.  [S] (30) with K Z K' = V' V, V = L^-1 H P.  O(n^2 q).

    The variances keep `KEPT` of what they lose.
    """
    keep_some(P, V)
    subtract_symmetric(P, V, V)


@compiled
def subtract_symmetric(P: Array, L: Array, R: Array) -> None:
    """P (n, n) <- P - L' R on the lower triangle, for L and R (q, n) whose product is symmetric.

    By bands of rows, through BLAS: so narrow while P is small that its threads, which would cost more than they save,
    are not asked for.  It writes to the right of the diagonal, too.
    """
    q, n = L.shape
    if q == 0:
        return
    band = NARROW if n <= CACHED else BAND
    for first in range(0, n, band):
        last = min(first + band, n)
        C, here = P.ctypes.data + first * P.strides[0], L.ctypes.data + first * L.strides[1]
        subtract_product(C, P.shape[1], here, last - first, R.ctypes.data, last, q, n, True)
    L[0, 0], R[0, 0] = L[0, 0], R[0, 0]  # keeps them alive until the calls are over


@compiled
def add_square(P: Array, D: Array) -> None:
    """P <- P + D D', D (n, q), on the lower triangle."""
    n, q = D.shape
    for i in range(n):
        for j in range(i + 1):
            for k in range(q):
                P[i, j] += D[i, k] * D[j, k]


@compiled
def add_half_turn(w: Array, a: Array, theta: Index) -> None:
    """Add half of P[theta, theta] a to the rows w = P[theta] (axes, n), in place."""
    axes, n = w.shape
    half = np.empty((axes, axes))
    for c in range(axes):
        for b in range(axes):
            half[c, b] = 0.5 * w[c, theta[b]]
    for c in range(axes):
        for b in range(axes):
            for j in range(n):
                w[c, j] += half[c, b] * a[b, j]


@compiled
def subtract_product(C: int, stride: int, L: int, rows: int, R: int, columns: int, q: int, n: int, outer: bool) -> None:
    """C -= L R' for L (rows, q) and R (columns, q), or, if `outer`, C -= L' R for L (q, rows) and R (q, columns).

    L and R, of n numbers a row, and C, of `stride`, are at those addresses.
    """
    sizes = np.array([columns, rows, q, stride, n], dtype=np.int32)
    at, chars, numbers = sizes.ctypes.data, _TRANS_NO.ctypes.data + outer, _MINUS_ONE_ONE.ctypes.data
    _dgemm(chars, chars + 1, at, at + 4, at + 8, numbers, R, at + 16, L, at + 16, numbers + 8, C, at + 12)
    sizes[0] = rows  # keeps them alive until the call is over


@compiled
def downdate_and_transport(P: Array, V: Array, a: Array, theta: Index) -> None:
    """P <- A (P - V' V) A' with A = I + a e_theta', V (m, n), a (n, axes), theta the rows of as many axes.  O(n^2 m).

    A P A' = P + a w' + w a', w = P[:, theta] + a P[theta, theta] / 2, in one pass over P with `downdate`.
    """
    n, axes = a.shape
    q = len(V)
    keep_some(P, V)
    w, a_T = np.empty((axes, n)), np.empty((axes, n))
    for c in range(axes):
        t = theta[c]
        for j in range(n):
            w[c, j], a_T[c, j] = P[t, j] if j <= t else P[j, t], a[j, c]
        for i in range(q):
            v = V[i, t]
            for j in range(n):
                w[c, j] -= v * V[i, j]
    add_half_turn(w, a_T, theta)
    L, R = np.empty((q + 2 * axes, n)), np.empty((q + 2 * axes, n))
    for i in range(q):
        for j in range(n):
            L[i, j] = R[i, j] = V[i, j]
    for c in range(axes):
        for j in range(n):
            L[q + c, j] = -w[c, j]
            R[q + c, j] = a_T[c, j]
            L[q + axes + c, j] = -a_T[c, j]
            R[q + axes + c, j] = w[c, j]
    subtract_symmetric(P, L, R)


@compiled
def cholesky_inverse(S: Array) -> tuple[Array, bool]:
    """Return L^-1 (n, n) with L L' = S (n, n), and whether S is positive definite.

    Elimination of [S, 1], each row by those above it, four at a time: what is left of S is L', what has become of 1 is
    L^-1.
    """
    n = len(S)
    T, M = np.zeros((n, 2 * n)), np.zeros((n, n))
    for i in range(n):
        for j in range(n):
            T[i, j] = S[i, j]
    for i in range(n):
        j = 0
        while j + 4 <= i:
            a, b, c, d = T[j, i], T[j + 1, i], T[j + 2, i], T[j + 3, i]
            for k in range(i, n + j + 4):
                T[i, k] -= a * T[j, k] + b * T[j + 1, k] + c * T[j + 2, k] + d * T[j + 3, k]
            j += 4
        while j < i:
            a = T[j, i]
            for k in range(i, n + j + 1):
                T[i, k] -= a * T[j, k]
            j += 1
        if not T[i, i] > 0.0:
            return M, False
        scale = 1.0 / np.sqrt(T[i, i])
        T[i, n + i] = 1.0
        for k in range(i, n + i + 1):
            T[i, k] *= scale
        for k in range(i + 1):
            M[i, k] = T[i, n + k]
    return M, True


@compiled
def are_covariances(S: Array, margin: float) -> bool:
    """Return whether S (K, n, n), in units of their sigmas, are symmetric up to |margin| and S + margin 1 definite.

    By Cholesky's pivots.  Near the limit the answer may be wrong: only the eigenvalues are certain there.
    """
    n = S.shape[1]
    sigma, L = np.empty(n), np.empty((n, n))
    for C in S:
        for i in range(n):
            if C[i, i] < 0.0:
                return False
            sigma[i] = math.sqrt(max(C[i, i], LEAST_VARIANCE))
            for j in range(i + 1):
                s = C[i, j] / sigma[i] / sigma[j]
                if not abs(s - C[j, i] / sigma[i] / sigma[j]) <= abs(margin):
                    return False
                s += margin if i == j else 0.0
                for c in range(j):
                    s -= L[i, c] * L[j, c]
                if j < i:
                    L[i, j] = s / L[j, j]
                elif s > 0.0:
                    L[i, i] = math.sqrt(s)
                else:
                    return False
    return True


@compiled
def cholesky(S: Array) -> bool:
    """Replace the lower triangle of S (n, n) by L, L L' = S; return whether S is positive definite."""
    sizes = np.array([len(S), 0], dtype=np.int32)
    at = sizes.ctypes.data
    _dpotrf(_UPPER_NO.ctypes.data, at, S.ctypes.data, at, at + 4)
    return sizes[1] == 0
