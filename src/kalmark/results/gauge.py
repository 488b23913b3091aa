"""Covariances of the shape of a map: without the rigid motion of the world that its errors have in common.

A rigid motion g of robots and landmarks together changes no measurement between them.  If the start alone determines
the place of the world, all errors have its error in common, e = G g + s, G = [1, J (p - o)] of a point p, in space
[1, -[p - o]x], about an origin o.  The shape is judged after the motion that aligns the map best with the true one,

    g = T e,    T = (G' W G)^-1 G' W,

so that its errors are s = (1 - G T) e, and its covariance

    P_shape = P - X G' - G X' + G L G',    X = P T',    L = T P T'.

This is the S-transform to the datum of inner constraints (Baarda 1973; as gauges: Kanatani and Morris 2001), which is
the error that an aligned RMSE measures.  (1 - G T) G = 0: P_shape does not depend on the start's covariance, nor on
which robot starts where.  The weights W are 1 / (v + v_q), v the variances of the shape itself and v_q their lower
quartile: landmarks that are hardly known, such as points at great depth, do not move the datum.  Landmarks that are
known exactly are fixed points of g: with two of them, in space three, nothing is open.  Where fixes or known landmarks
determine the place of the world, g is small, and shape and world coincide.  docs/evaluation.md.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.linalg as la

from kalmark.arrays import Array, Index, diagonal_blocks

ROUNDS, SAME = 10, 1e-6  # until the weights are those of the shape
REGULAR = 1e-15
EXACT_M = 1e-9


class Datum(NamedTuple):
    """The motion g = T e (q,) about `origin`, T (q, n), of errors e (n,) of the datum's points; L is its covariance."""

    origin: Array
    T: Array
    L: Array

    @classmethod
    def of(cls, points: Array, across: Array, P: Array, fixed: Array) -> Datum:
        """Return the datum of points (N, d) of the joint covariance P (N d, N d) that keeps points `fixed` (F, d).

        `across` (N, d, d) are projections on what is measured of a point: 1, of a line's end that across the line.
        """
        d, origin = points.shape[1], points.mean(axis=0)
        q = 3 * (d - 1)
        free = la.null_space(generators(fixed, origin)[:, :d].reshape(-1, q)) if len(fixed) else np.eye(q)
        G = generators(points, origin)[:, :d] @ free
        seen, own = across @ G, np.einsum("kij,kji->k", across, diagonal_blocks(P, d))
        v = np.trace(diagonal_blocks(P, d), axis1=1, axis2=2)
        for _ in range(ROUNDS):
            weighted = seen / (v + _lower_quartile(v) + EXACT_M**2)[:, None, None]
            w, V = np.linalg.eigh(np.einsum("kia,kib->ab", weighted, seen))
            regular = w > REGULAR * w.max(initial=0.0)
            V, w = V[:, regular], w[regular]
            T = V @ (V / w).T @ weighted.reshape(len(P), len(G[0, 0])).T
            X = P @ T.T
            before, L = v, T @ X
            moved = np.sum(seen * (seen @ L - 2.0 * X.reshape(seen.shape)), axis=(1, 2))
            v = np.maximum(own + moved, 0.0)
            if np.all(np.abs(v - before) <= SAME * v):
                break
        return cls(origin, free @ T, free @ L @ free.T)

    def shape(self, G: Array, P: Array, X: Array) -> Array:
        """Return the covariances (..., m, m) of the shape of what moves by G (..., m, q), has P, and X = C T'.

        C (..., m, n) are the covariances with the points of the datum.
        """
        both = X @ G.swapaxes(-1, -2)
        out = P - both - both.swapaxes(-1, -2) + G @ self.L @ G.swapaxes(-1, -2)
        return np.asarray((out + out.swapaxes(-1, -2)) / 2)


def generators(points: Array, origin: Array) -> Array:
    """Return G (K, q, q) of poses at points (K, d): how they move with the world, its translation and rotation."""
    d = points.shape[1]
    G = np.tile(np.eye(3 * (d - 1)), (len(points), 1, 1))
    lever = points - origin
    if d == 2:
        G[:, 0, 2], G[:, 1, 2] = -lever[:, 1], lever[:, 0]
    else:
        for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
            G[:, i, 3 + j], G[:, j, 3 + i] = lever[:, k], -lever[:, k]
    return G


def _lower_quartile(v: Array) -> float:
    """Return the lower quartile of v (N,), between its two neighbours."""
    ordered, at = np.sort(v), 0.25 * (len(v) - 1)
    low = int(at)
    return float(ordered[low] + (at - low) * (ordered[min(low + 1, len(v) - 1)] - ordered[low]))


def shape_of_points(points: Array, P: Array, of: Index) -> Array:
    """Return the covariances (K, d, d) of the shape of points (K, d) of the joint covariance P (K d, K d).

    The datum is that of the points `of` (M,), their numbers.
    """
    d = points.shape[1]
    rows = (of[:, None] * d + np.arange(d)).ravel()
    datum = Datum.of(points[of], np.tile(np.eye(d), (len(of), 1, 1)), P[np.ix_(rows, rows)], np.empty((0, d)))
    C = P[:, rows].reshape(len(points), d, -1)
    return datum.shape(generators(points, datum.origin)[:, :d], diagonal_blocks(P, d), C @ datum.T.T)
