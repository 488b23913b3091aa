"""Do fits of positions to ranges find where these were made from, compiled and in Python, and pass over what is far?"""

from __future__ import annotations

import numpy as np
import pytest

import kalmark as km
from kalmark.arrays import Array
from kalmark.models.range_fit import Fits, RangeProblem, model_of

PLACES = np.array([[0.0, 0.0], [4.0, 0.0], [0.0, 3.0], [5.0, 5.0]])
POINT = np.array([2.0, 7.0])
STARTS = np.array([[3.0, -6.0], [1.0, 6.0], [2.5, 8.0], [-4.0, 2.0]])


class OwnRange(km.sensors.Range):
    """A user's sensor: Python."""


def problem_of(sensor: km.sensors.Range, varies: bool = False) -> RangeProblem:
    n = len(PLACES)
    S = (0.01 * np.eye(2 * n)).reshape(n, 2, n, 2)
    ranges = np.linalg.norm(POINT - PLACES, axis=1), np.full(n, 0.04), np.full(n, varies)
    return RangeProblem([], np.zeros((n, 2, 0)), S, PLACES, ranges, model_of(sensor, False, varies))


def found(problem: RangeProblem, starts: Array = STARTS) -> Fits:
    return problem.search(problem.fit(starts), np.full(len(starts), 1e-3), 1e-12)[0]


@pytest.mark.parametrize("varies", [False, True])
def test_the_position_is_found_by_compiled_sensors_and_by_a_users(varies: bool) -> None:
    built_in, own = (kind(sigma_range_m=0.2, sigma_range_rel=0.02) for kind in (km.sensors.Range, OwnRange))
    fits = [found(problem_of(sensor, varies)) for sensor in (built_in, own)]
    best = fits[0].of(int(np.argmin(fits[0].cost)))
    assert np.abs(best.l - POINT).max() < 1e-6 if not varies else np.abs(best.l - POINT).max() < 0.1
    for compiled, python in zip(*fits, strict=True):
        assert np.abs(compiled - python).max() < 1e-9


def test_a_covariance_is_that_of_the_places_and_of_the_ranges() -> None:
    fit = problem_of(km.sensors.Range(sigma_range_m=0.2)).fit(POINT[None])
    assert np.abs(np.linalg.inv(fit.inverse[0]) - 0.05 * np.eye(4)).max() < 1e-12
    assert fit.chi2[0] < 1e-20


def test_a_position_too_far_away_fits_nothing_and_stops_no_other() -> None:
    problem = problem_of(km.sensors.Range(sigma_range_m=0.2))
    fits = found(problem, np.array([[np.inf, 0.0], [1.0, 6.0]]))
    assert np.isinf(fits.cost[~np.isfinite(fits.l).all(axis=1)]).all()
    assert np.abs(fits.l[np.argmin(fits.cost)] - POINT).max() < 1e-6
