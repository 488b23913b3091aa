"""Positions fitted to ranges alone, or strengths, by Levenberg's and Marquardt's steps from several starts.

The chi-square of a position is that of all ranges, whose errors are those of the places that they were made from, of
the sensor's own parameters and of the ranges, marginalised: Sigma = H_x P H_x' + R.  [S] (32)-(38).
"""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import numpy as np

from kalmark.arrays import Array, Flags, Index
from kalmark.compiled import address_of, by_address, compiled, python_form, signature_of
from kalmark.models.landmark_views import EXPECT, NOISE, VARY, expect, noise_of, vary
from kalmark.models.observe import is_built_in

TINY = 1e-12  # of information: where a range does not depend on the position, this stays where it is
STEPS = 25  # of a search,
TOGETHER = 0.01  # in which positions come together that are so many sigmas apart

# of a model, the places (n, 2), their S, the ranges and positions l (J, 2): what `Fits` has of these
FIT = signature_of(
    "Tuple((f8[:, ::1], f8[::1], f8[::1], f8[:, ::1], f8[:, :, ::1], f8[:, :, ::1], f8[:, :, ::1], f8[:, ::1]))"
    "(Tuple((i8, i8, i8, i8, f8[::1], f8[::1], b1[::1])), f8[:, ::1], f8[:, :, :, ::1],"
    " Tuple((f8[::1], f8[::1], b1[::1])), f8[:, ::1])"
)
call_fit = by_address(FIT)


class Fits(NamedTuple):
    """Fit of J positions l (J, 2) to n ranges: `cost` = -2 log likelihood and chi-square (J,), residuals z (J, n).

    `H` (J, n, 2) is with respect to the position, `H_w` (J, n, k + 2) to the sensor's own parameters in the map and the
    place of each range, `inverse` (J, n, n) that of the covariance, and `R` (J, n) the ranges' variances, as the
    position would have them.
    """

    l: Array
    cost: Array
    chi2: Array
    z: Array
    H: Array
    H_w: Array
    inverse: Array
    R: Array

    def of(self, j: int | Index) -> Fits:
        """Return that of one position, or of some."""
        return Fits(*(each[j] for each in self))

    @property
    def information(self) -> Array:
        """The information matrix (2, 2) of one position."""
        return self.H.T @ self.inverse @ self.H


class RangeProblem(NamedTuple):
    """Ranges from the sensor's places (n, 2), to which positions are fitted, and the blocks that those depend on.

    `S_x` (n, k + 2, .) is the Jacobian of the sensor's k own parameters and each place, `S` (n, k + 2, n, k + 2) the
    covariance of these.  `ranges` are the measurements y (n,), their variances (n,), and where these vary (n,); `model`
    has the sensor's expectation, its Jacobian of the parameters and its noise, with their arguments.
    """

    slots: list[int]
    S_x: Array
    S: Array
    places: Array
    ranges: tuple[Array, ...]
    model: tuple[Any, ...]

    @property
    def own(self) -> int:
        """Number of the sensor's parameters in the map."""
        return self.S_x.shape[1] - 2

    def fit(self, l: Array) -> Fits:
        """Return the fit of positions l (J, 2)."""
        return Fits(*call_fit(self._function, (self.model, self.places, self.S, self.ranges, np.ascontiguousarray(l))))

    def search(self, now: Fits, damping: Array, settled: float, all_: bool = True) -> tuple[Fits, Array]:
        """Return the fit of positions (J, 2) after Levenberg's and Marquardt's steps, and the damping (J,) of these.

        The search is over when all of them have settled in a minimum, or the likeliest one; of those that come together
        one is left.
        """
        function = self._function
        search = python_form(_search) if callable(function) else _search
        given = self.model, self.places, self.S, self.ranges
        found, damping = search(function, given, tuple(map(np.ascontiguousarray, now)), damping, settled, all_)
        return Fits(*found), damping

    @property
    def _function(self) -> Any:
        """The address of the compiled fit; of a user's sensor its Python form, which may stand for it."""
        return python_form(_fit_positions) if callable(self.model[0]) else _addresses()[0]


def model_of(sensor: Any, calibrates: bool, varies: bool) -> tuple[Any, ...]:
    """Return the expectation of a sensor, its Jacobian of the parameters and its noise, and what they are given."""
    if not is_built_in(sensor, None):

        def expected(code: int, par: Array, angular: Flags, v: Array, y: Array) -> tuple[Array, Array, Array]:
            e, E_v = sensor.expect(v)
            return e, y - e, E_v

        return (
            expected,
            lambda code, par, angular, v, e: sensor.parameters_jacobian(v),
            lambda numbers, e: sensor.range_variance(e)[:, None, None],
            0, *[np.zeros(0)] * 2, np.zeros(1, np.bool_),
        )  # fmt: skip
    made: Any = type(sensor)
    _, expected_at, varied_at, noisy_at = _addresses(made, calibrates, varies)
    return (
        expected_at,
        varied_at,
        noisy_at,
        int(sensor.code),
        sensor.constants,
        np.asarray(sensor.noise_numbers if varies else np.zeros(0), dtype=np.float64),
        np.array(sensor.angular, dtype=np.bool_),
    )


@cache
def _addresses(sensor: Any = None, calibrates: bool = False, varies: bool = False) -> tuple[int, int, int, int]:
    """Return the addresses of the fit, and of what it calls of a class of sensors; 0 for what it does not need."""
    return (
        address_of(_fit_positions, FIT),
        address_of(sensor.expected, EXPECT) if sensor else 0,
        address_of(sensor.varied, VARY) if calibrates else 0,
        address_of(sensor.noisy, NOISE) if varies else 0,
    )


@compiled
def _fit_positions(model: Any, places: Array, S: Array, ranges: Any, l: Array) -> Any:
    """Return what `Fits` has of positions l (J, 2)."""
    (y, variance, varies), n, w, number = ranges, len(places), S.shape[1], len(l)
    v = (np.expand_dims(l, 1) - places).reshape((number * n, 2))
    e, _, E_v = expect(model[0], (model[3], model[4], model[6], v, np.zeros((number * n, 1))))
    H, H_w, R = np.empty((number, n, 2)), np.empty((number, n, w)), np.empty((number, n))
    H[:] = E_v.reshape((number, n, 2))
    H_w[:, :, w - 2 :] = -H
    if w > 2:
        H_w[:, :, : w - 2] = vary(model[1], (model[3], model[4], model[6], v, e)).reshape((number, n, w - 2))
    R[:] = variance
    if varies.any():
        own = noise_of(model[2], (model[5], e)).reshape((number, n))
        for i in range(n):
            if varies[i]:
                R[:, i] = own[:, i]
    z, inverse, chi2, cost = np.empty((number, n)), np.empty((number, n, n)), np.empty(number), np.empty(number)
    Sigma, HS = np.empty((n, n)), np.empty(w)
    for j in range(number):
        for i in range(n):
            z[j, i] = y[i] - e[j * n + i, 0]
            for k in range(n):
                for b in range(w):
                    HS[b] = 0.0
                    for a in range(w):
                        HS[b] += H_w[j, i, a] * S[i, a, k, b]
                Sigma[i, k] = 0.0
                for b in range(w):
                    Sigma[i, k] += HS[b] * H_w[j, k, b]
            Sigma[i, i] += R[j, i]
        if not (np.isfinite(Sigma).all() and np.isfinite(z[j]).all()):  # so far away nothing is left of it
            z[j], H[j], H_w[j], inverse[j], chi2[j], cost[j] = 0.0, 0.0, 0.0, 0.0, np.inf, np.inf
            continue
        inverse[j] = np.linalg.inv(Sigma)
        chi2[j] = z[j] @ (inverse[j] @ z[j])
        cost[j] = chi2[j] + np.linalg.slogdet(Sigma)[1]
    return l, cost, chi2, z, H, H_w, inverse, R


@compiled
def _search(fit: Any, given: Any, now: Any, damping: Array, settled: float, all_: bool) -> Any:
    """Return what `Fits` has of the positions after Levenberg's and Marquardt's steps, and their damping (J,)."""
    for _ in range(STEPS):
        l, cost, chi2, z, H, H_w, inverse, R = now
        number = len(l)
        g, A, decrease = np.empty((number, 2)), np.empty((number, 2, 2)), np.empty(number)
        for j in range(number):
            J = H[j].T @ inverse[j]
            g[j], A[j] = J @ z[j], J @ H[j]
            A[j] += TINY * np.eye(2)
            decrease[j] = g[j] @ np.linalg.solve(A[j], g[j])  # of chi-square by a step without damping
        if decrease.max() < settled or (not all_ and decrease[np.argmin(cost)] < settled):
            break
        first = _first_of_each(l, A)
        damping, next_l = damping[first], l[first]
        for k, j in enumerate(first):
            A[j, 0, 0] *= 1 + damping[k]
            A[j, 1, 1] *= 1 + damping[k]
            next_l[k] += np.linalg.solve(A[j], g[j])
        new = call_fit(fit, (given[0], given[1], given[2], given[3], next_l))
        for k, j in enumerate(first):
            by_same = new[3][k] @ (inverse[j] @ new[3][k])  # Sigma as it was
            is_better = np.isfinite(new[2][k]) and by_same < chi2[j]
            damping[k] *= 0.1 if is_better else 10
            if not is_better:
                new[0][k], new[1][k], new[2][k], new[3][k] = l[j], cost[j], chi2[j], z[j]
                new[4][k], new[5][k], new[6][k], new[7][k] = H[j], H_w[j], inverse[j], R[j]
        now = new
    return now, damping


@compiled
def _first_of_each(l: Array, A: Array) -> Index:
    """Return which positions l (J, 2) are the first of those within TOGETHER sigmas, by information matrices A."""
    first = np.ones(len(l), np.bool_)
    for i in range(1, len(l)):
        first[i] = np.isfinite(l[i]).all()
        for j in range(i):
            gap = l[j] - l[i]
            first[i] &= not gap @ (A[i] @ gap) < TOGETHER**2
    return np.flatnonzero(first)
