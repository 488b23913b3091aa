"""NEES and NIS: coordinates, singular covariances, bounds."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2

from kalmark.geometry import V, V_inverse
from kalmark.results.measures import (
    anees_interval,
    has_diverged,
    map_nees,
    nees,
    nees_limit,
    nis,
    point_error,
    pose_error,
)


def test_log_coordinates_of_many_angles_at_once_are_those_of_each() -> None:
    angles, d = np.array([0.0, 1e-9, -1e-5, 1.9e-4, 2.1e-4, 0.3, -2.5, 3.1]), np.array([0.4, -0.7])
    expected = [V_inverse(a) @ d for a in angles]
    np.testing.assert_allclose(point_error(np.zeros((8, 2)), np.tile(d, (8, 1)), angles, "log"), expected, atol=1e-14)


def test_log_coordinates_undo_the_retraction_of_the_invariant_filter() -> None:
    """A landmark retracted by V(dtheta) d has the log error d, and the plain difference otherwise."""
    mean, d, dtheta = np.array([3.0, -2.0]), np.array([0.4, 0.7]), 0.8
    truth = mean + V(dtheta) @ d
    assert np.allclose(point_error(mean, truth, dtheta, "log"), d)
    assert np.allclose(point_error(mean, truth, dtheta, "world"), V(dtheta) @ d)
    with pytest.raises(ValueError, match="'world' or 'log'"):
        point_error(mean, truth, dtheta, "body")


def test_heading_errors_are_wrapped() -> None:
    d = pose_error(np.array([0.0, 0.0, 3.1]), np.array([0.0, 0.0, -3.1]))
    assert d[2] == pytest.approx(2 * np.pi - 6.2)


def test_nees_of_gaussian_errors_averages_to_their_dimension() -> None:
    rng = np.random.default_rng(5)
    factor = rng.normal(size=(3, 3)) * [[1.0], [10.0], [1e-3]]
    P = factor @ factor.T
    d = rng.normal(size=(2000, 3)) @ factor.T
    values = nees(d, np.broadcast_to(P, (2000, 3, 3)))
    low, high = anees_interval(3, 2000, 0.999)
    assert low < values.mean() < high
    assert values[0] == pytest.approx(d[0] @ np.linalg.inv(P) @ d[0], rel=1e-9)


def test_singular_covariances_are_left_out_whatever_their_scale() -> None:
    d = np.ones((4, 3))
    direction = np.array([1.0, 2.0, 0.1])
    P = np.stack([np.zeros((3, 3)), np.outer(direction, direction), 1e-14 * np.eye(3), np.full((3, 3), np.nan)])
    values = nees(d, P)
    assert np.isnan(values[[0, 1, 3]]).all()
    assert values[2] == pytest.approx(3e14)


def test_two_noises_that_move_three_numbers_leave_a_singular_covariance_whatever_rounding_leaves_of_its_pivots() -> (
    None
):
    """After its first control a pose has a covariance of rank 2."""
    s = np.geomspace(1e-6, 0.7, 50)
    G = np.zeros((50, 3, 2))
    G[:, 0, 0] = G[:, 2, 1] = 1.0
    G[:, 1] = np.stack([np.sqrt(1.0 - s**2), s], -1)
    assert np.isnan(nees(np.ones((50, 3)), G @ G.transpose(0, 2, 1))).all()


def test_the_nees_of_a_map_is_that_of_its_blocks_and_of_all_and_nothing_for_a_singular_covariance() -> None:
    rng, n, first, sizes = np.random.default_rng(2), 14, np.array([3, 5, 11]), np.array([2, 6, 3])
    A = rng.standard_normal((n, n)) * np.logspace(-2, 2, n)[:, None]
    d, P = rng.standard_normal((2, n)) * np.logspace(-2, 2, n), A @ A.T
    blocks = [(d[:, i : i + m], P[i : i + m, i : i + m]) for i, m in [*zip(first, sizes, strict=True), (0, n)]]
    each = np.array([np.einsum("ci,ci->c", e, np.linalg.solve(S, e.T).T) for e, S in blocks])
    expected = [*each[:3].mean(axis=0), 11 / 3, *each[3], n]
    np.testing.assert_allclose(map_nees(d, P, first, sizes), expected, rtol=1e-6)
    np.testing.assert_allclose(nees(d, np.stack([P, P])), expected[3:5], rtol=1e-6)
    A[4] = 2.0 * A[3]  # the first block, hence all
    np.testing.assert_allclose(map_nees(d, A @ A.T, first, sizes)[:3], [*each[1:3].mean(axis=0), 4.5], rtol=1e-6)
    assert np.isnan(map_nees(d, A @ A.T, first, sizes)[3:]).all()
    assert np.isnan(map_nees(d, np.zeros((n, n)), first, sizes)).all()


def test_nis_counts_only_the_rows_that_a_sensor_has() -> None:
    z = np.array([[1.0, 2.0], [3.0, np.nan], [np.nan, np.nan]])
    Z = np.full((3, 2, 2), np.nan)
    Z[0], Z[1, 0, 0] = np.diag([1.0, 4.0]), 9.0
    value, dof = nis(z, Z)
    assert np.allclose(value[:2], [2.0, 1.0])
    assert np.isnan(value[2])
    assert dof.tolist() == [2, 1, 0]


def test_bounds_of_an_average_narrow_with_the_number_of_runs() -> None:
    assert anees_interval(3) == pytest.approx(tuple(chi2.ppf([0.025, 0.975], 3)))
    low, high = anees_interval(3, 50)
    assert (low, high) == pytest.approx((2.36, 3.72), abs=0.01)


def test_a_run_has_diverged_only_if_far_in_sigmas_and_in_metres() -> None:
    P = np.broadcast_to(0.01 * np.eye(2), (2, 2, 2))
    d = np.array([[0.1, 0.0], [1.5, 0.0]])
    assert has_diverged(d, d, P, np.array([[0, 0, 0], [20.0, 0, 0]]))
    assert not has_diverged(d, d, P, np.array([[0, 0, 0], [100.0, 0, 0]]))
    assert not has_diverged(d, d, 100 * P, np.array([[0, 0, 0], [20.0, 0, 0]]))


def test_the_most_of_a_mean_nees_is_that_of_one_value_for_an_error_that_lasts_and_less_for_one_that_does_not() -> None:
    rng, N = np.random.default_rng(1), 300
    d, P = rng.normal(size=3), np.tile(np.diag([0.01, 4.0, 1.0]), (N, 1, 1))
    assert nees_limit(np.tile(d, (N, 1)), P) == pytest.approx(chi2.ppf(0.9999, 3))
    assert nees_limit(rng.normal(size=(N, 3)) * [0.1, 2.0, 1.0], P) == pytest.approx(chi2.ppf(0.97, 3))
    several = np.repeat(rng.normal(size=(4, 3)), 75, axis=0) * [0.1, 2.0, 1.0]
    assert chi2.ppf(0.97, 3) < nees_limit(several, P) < chi2.ppf(0.9999, 3) - 1.0
    P[10:] = 0.0
    assert np.isfinite(nees_limit(np.tile(d, (N, 1)), P)) and np.isnan(nees_limit(np.ones((2, 3)), P[-2:]))


@pytest.mark.parametrize("rho", [0.9, 0.99, 0.999])
def test_hardly_a_consistent_run_of_errors_that_last_has_a_mean_nees_above_what_it_may_be(rho: float) -> None:
    P, above = np.tile(np.eye(3), (400, 1, 1)), 0
    errors, step = np.random.default_rng(3).normal(size=(1000, 400, 3)), np.sqrt(1.0 - rho**2)
    for k in range(1, 400):
        errors[:, k] = rho * errors[:, k - 1] + step * errors[:, k]
    for d, mean in zip(errors, nees(errors, np.tile(P, (1000, 1, 1, 1))).mean(axis=1).tolist(), strict=True):
        limit = nees_limit(d, P)
        above += mean > limit
        assert 100.0 * mean > limit or rho == 0.999
    assert nees_limit(10.0 * errors[0], P) == pytest.approx(nees_limit(errors[0], P))
    assert above <= 2
