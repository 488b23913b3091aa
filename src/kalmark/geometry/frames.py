"""Frames of the plane, F = (x, y, angle), with Jacobians and their product.  [S] A.2 to A.5, (54)-(64), and App. C.1.

Value first, then Jacobians in argument order; a Jacobian ``OUT_in`` is d OUT / d in.  Points are (2,) or K at once,
(K, 2); their Jacobians then are (K, 2, 3) and (K, 2, 2).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from kalmark.arrays import Array
from kalmark.compiled import compiled
from kalmark.geometry.angles import wrap


@compiled
def compose(a: Array, b: Array) -> tuple[Array, Array, Array]:
    """Return c = a o b (frame b given in frame a), C_a (3, 3) and C_b (3, 3).  [S] (55).

    >>> c, C_a, C_b = km.geometry.compose(np.array([1.0, 2.0, np.pi / 2]), np.array([1.0, 0.0, 0.0]))
    >>> c.round(3)
    array([1.   , 3.   , 1.571])
    """
    cos, sin = math.cos(a[2]), math.sin(a[2])
    x, y = cos * b[0] - sin * b[1], sin * b[0] + cos * b[1]
    c, C_a, C_b = np.empty(3), np.eye(3), np.eye(3)
    c[0], c[1], c[2] = a[0] + x, a[1] + y, wrap(a[2] + b[2])
    C_a[0, 2], C_a[1, 2] = -y, x
    C_b[0, 0], C_b[0, 1], C_b[1, 0], C_b[1, 1] = cos, -sin, sin, cos
    return c, C_a, C_b


@compiled
def inverse(a: Array) -> tuple[Array, Array]:
    """Return the inverse frame b, with b o a = 0, and B_a (3, 3).

    >>> b, B_a = km.geometry.inverse(np.array([1.0, 2.0, np.pi / 2]))
    >>> b.round(3)
    array([-2.   ,  1.   , -1.571])
    """
    cos, sin = math.cos(a[2]), math.sin(a[2])
    x, y = -cos * a[0] - sin * a[1], sin * a[0] - cos * a[1]
    return np.array([x, y, wrap(-a[2])]), np.array([[-cos, -sin, y], [sin, -cos, -x], [0.0, 0.0, -1.0]])


@compiled
def to_frame_many(f: Array, p: Array) -> tuple[Array, Array, Array]:
    """Express K global points (K, 2) in frame F.  [S] (56)."""
    cos, sin = math.cos(f[2]), math.sin(f[2])
    k = len(p)
    pf, PF_f, PF_p = np.empty((k, 2)), np.empty((k, 2, 3)), np.empty((k, 2, 2))
    for i in range(k):
        dx, dy = p[i, 0] - f[0], p[i, 1] - f[1]
        pf[i, 0], pf[i, 1] = cos * dx + sin * dy, cos * dy - sin * dx
        PF_f[i, 0, 0], PF_f[i, 0, 1], PF_f[i, 0, 2] = -cos, -sin, pf[i, 1]
        PF_f[i, 1, 0], PF_f[i, 1, 1], PF_f[i, 1, 2] = sin, -cos, -pf[i, 0]
        PF_p[i, 0, 0], PF_p[i, 0, 1] = cos, sin
        PF_p[i, 1, 0], PF_p[i, 1, 1] = -sin, cos
    return pf, PF_f, PF_p


@compiled
def from_frame_many(f: Array, pf: Array) -> tuple[Array, Array, Array]:
    """Express K points (K, 2) of frame F in the global frame.  [S] (55)."""
    cos, sin = math.cos(f[2]), math.sin(f[2])
    k = len(pf)
    pw, PW_f, PW_pf = np.empty((k, 2)), np.empty((k, 2, 3)), np.empty((k, 2, 2))
    for i in range(k):
        x, y = cos * pf[i, 0] - sin * pf[i, 1], sin * pf[i, 0] + cos * pf[i, 1]
        pw[i, 0], pw[i, 1] = f[0] + x, f[1] + y
        PW_f[i, 0, 0], PW_f[i, 0, 1], PW_f[i, 0, 2] = 1.0, 0.0, -y
        PW_f[i, 1, 0], PW_f[i, 1, 1], PW_f[i, 1, 2] = 0.0, 1.0, x
        PW_pf[i, 0, 0], PW_pf[i, 0, 1] = cos, -sin
        PW_pf[i, 1, 0], PW_pf[i, 1, 1] = sin, cos
    return pw, PW_f, PW_pf


@compiled
def scan_many(p: Array) -> tuple[Array, Array]:
    """Measure range and bearing of K points (K, 2) of the sensor's frame; Y_p (K, 2, 2).  [S] (61)."""
    k = len(p)
    y, Y_p = np.empty((k, 2)), np.empty((k, 2, 2))
    for i in range(k):
        px, py = p[i, 0], p[i, 1]
        d2 = px * px + py * py
        d = math.sqrt(d2)
        y[i, 0], y[i, 1] = d, math.atan2(py, px)
        Y_p[i, 0, 0], Y_p[i, 0, 1] = px / d, py / d
        Y_p[i, 1, 0], Y_p[i, 1, 1] = -py / d2, px / d2
    return y, Y_p


@compiled
def inv_scan_many(y: Array) -> tuple[Array, Array]:
    """Turn K ranges and bearings (K, 2) into points of the sensor's frame; P_y (K, 2, 2).  [S] (62)."""
    k = len(y)
    p, P_y = np.empty((k, 2)), np.empty((k, 2, 2))
    for i in range(k):
        d, cos, sin = y[i, 0], math.cos(y[i, 1]), math.sin(y[i, 1])
        p[i, 0], p[i, 1] = d * cos, d * sin
        P_y[i, 0, 0], P_y[i, 0, 1] = cos, -d * sin
        P_y[i, 1, 0], P_y[i, 1, 1] = sin, d * cos
    return p, P_y


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


@compiled
def multiply_many(A: Array, B: Array) -> Array:
    """Return the products (K, a, c) of the first b columns of K matrices (K, a, b or more) with (K, b, c)."""
    C = np.zeros((len(A), A.shape[1], B.shape[2]))
    for i in range(len(A)):
        for a in range(A.shape[1]):
            for b in range(B.shape[1]):
                for c in range(B.shape[2]):
                    C[i, a, c] += A[i, a, b] * B[i, b, c]
    return C


def one_or_many(function: Callable[..., tuple[Array, ...]], *given: Any) -> Any:
    """Call a function of K rows, its last argument (K, n), or of a single one (n,) given without that dimension."""
    *frame, p = (np.ascontiguousarray(each, dtype=np.float64) for each in given)
    found = function(*frame, np.atleast_2d(p))
    return found if p.ndim == 2 else tuple(each[0] for each in found)


def to_frame(f: Any, p: Any) -> tuple[Array, Array, Array]:
    """Express global points p (2,) or (K, 2) in frame F: pf, PF_f, PF_p.  [S] (56).

    >>> pf, PF_f, PF_p = km.geometry.to_frame([1.0, 2.0, np.pi / 2], [1.0, 5.0])
    >>> pf.round(3)
    array([3., 0.])
    """
    return one_or_many(to_frame_many, f, p)


def from_frame(f: Any, pf: Any) -> tuple[Array, Array, Array]:
    """Express points pf (2,) or (K, 2) of frame F globally: pw, PW_f, PW_pf.  [S] (55).

    >>> pw, PW_f, PW_pf = km.geometry.from_frame([1.0, 2.0, np.pi / 2], [3.0, 0.0])
    >>> pw.round(3)
    array([1., 5.])
    """
    return one_or_many(from_frame_many, f, pf)


def scan(p: Any) -> tuple[Array, Array]:
    """Measure range (m) and bearing (rad) of points (2,) or (K, 2) of the sensor's frame: y, Y_p.  [S] (61).

    >>> y, Y_p = km.geometry.scan([3.0, 4.0])
    >>> y.round(3)
    array([5.   , 0.927])
    """
    return one_or_many(scan_many, p)


def inv_scan(y: Any) -> tuple[Array, Array]:
    """Turn ranges and bearings (2,) or (K, 2) into points of the sensor's frame: p, P_y.  [S] (62).

    >>> p, P_y = km.geometry.inv_scan([5.0, 0.0])
    >>> p.round(3)
    array([5., 0.])
    """
    return one_or_many(inv_scan_many, y)


def observe(r: Any, p: Any) -> tuple[Array, Array, Array]:
    """Measure range and bearing y (K, 2) of global points p (K, 2) from robot r (3,).  [S] (63), C.2.2.

    Returns y, Y_r (K, 2, 3) and Y_p (K, 2, 2); one point (2,) is measured without the leading dimension.

    >>> y, Y_r, Y_p = km.geometry.observe([0.0, 0.0, np.pi / 2], [[3.0, 4.0], [0.0, 2.0]])
    >>> y.round(3)
    array([[ 5.   , -0.644],
           [ 2.   ,  0.   ]])
    """
    pr, PR_r, PR_p = to_frame(r, p)
    y, Y_pr = scan(pr)
    return y, Y_pr @ PR_r, Y_pr @ PR_p


def inv_observe(r: Any, y: Any) -> tuple[Array, Array, Array]:
    """Return the global points p (K, 2) that robot r (3,) observes at ranges and bearings y (K, 2).  [S] (64), C.2.3.

    Returns p, P_r (K, 2, 3) and P_y (K, 2, 2); one measurement (2,) gives them without the leading dimension.

    >>> p, P_r, P_y = km.geometry.inv_observe([1.0, 2.0, np.pi / 2], [3.0, 0.0])
    >>> p.round(3)
    array([1., 5.])
    """
    pr, PR_y = inv_scan(y)
    p, P_r, P_pr = from_frame(r, pr)
    return p, P_r, P_pr @ PR_y


def move(r: Any, u: Any, n: Any) -> tuple[Array, Array, Array]:
    """Move robot r by u + n = (forward, turn), forward along the old heading: ro, RO_r, RO_n (3, 2).  [S] (59)-(60).

    >>> r, R_r, R_n = km.geometry.move([0.0, 0.0, np.pi / 2], [1.0, 0.1], [0.0, 0.0])
    >>> r.round(3)
    array([0.   , 1.   , 1.671])
    """
    forward, turn = np.asarray(u, dtype=np.float64) + np.asarray(n, dtype=np.float64)
    ro, RO_r, RO_d = compose(np.ascontiguousarray(r, dtype=np.float64), np.array([forward, 0.0, turn]))
    return ro, RO_r, RO_d[:, [0, 2]]
