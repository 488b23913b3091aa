"""Searches of matchings on pairs made by hand: agreement of distances, the factor of a joint innovation, JCBB."""

from __future__ import annotations

import numpy as np
import pytest

from kalmark.association.matchings import agree, best_matching, count_possible, extend, matchings, narrow

SEEN = np.array([[0.0, 0.0], [3.0, 4.0]])  # 5 m apart
KNOWN = np.array([[1.0, 1.0], [1.0, 6.2]])  # 5.2 m apart
V = np.tile(0.01 * np.eye(2), (2, 1, 1))


@pytest.mark.parametrize(("shared", "variance"), [(0.0, 0.1), (0.03, 0.04)])
def test_two_pairs_agree_if_their_distances_differ_by_no_more_than_chance(shared: float, variance: float) -> None:
    """The variance of the difference is 2 x .01 of what was seen and 2 x (.04 - shared) of the landmarks."""
    C = np.kron([[0.04, shared], [shared, 0.04]], np.eye(2))
    least = 0.2**2 / variance
    assert agree(0, 0, 1, 1, (SEEN, V, KNOWN, C), 1.01 * least)
    assert not agree(0, 0, 1, 1, (SEEN, V, KNOWN, C), 0.99 * least)
    assert agree(1, 0, 0, 1, (SEEN, V, KNOWN, C), 1.01 * least), "exchanged, the distances are the same"


def test_pairs_of_one_place_agree_with_nothing() -> None:
    twice = np.zeros((2, 2))
    assert not agree(0, 0, 1, 1, (twice, V, KNOWN, 0.04 * np.eye(4)), 1e9)
    assert not agree(0, 0, 1, 1, (SEEN, V, twice, 0.04 * np.eye(4)), 1e9)


def test_a_pair_leaves_those_of_other_observations_and_landmarks_that_agree_with_it() -> None:
    places = np.array([[0.0, 0.0], [2.0, 0.0]]), V, np.array([[0.0, 0.0], [2.0, 0.0], [9.0, 0.0]]), 0.01 * np.eye(6)
    of, landmark = np.array([0, 0, 1, 1, 1]), np.array([0, 1, 0, 1, 2])
    left = np.ones(5, dtype=np.bool_)
    assert narrow(np.ones(5, dtype=np.bool_), 0, of, landmark, places, 9.0, left) == 2, "only two are compared"
    assert left.tolist() == [False, False, False, True, False]
    assert narrow(np.array([True, True, True, False, True]), 0, of, landmark, places, 9.0, left) == 1
    assert not left.any()


def test_observations_that_may_still_be_paired_are_counted() -> None:
    alive, first = np.array([True, False, False, False, True]), np.array([0, 1, 3, 5])
    assert [count_possible(alive, first, i) for i in range(4)] == [2, 1, 1, 0]


def test_points_on_a_line_at_equal_distances_match_each_other_shifted_and_reversed() -> None:
    l = np.array([[0.0, 0.0], [2.0, 0.0], [4.0, 0.0]])
    places = np.array([[7.0, 7.0], [7.0, 9.0]]), 1e-4 * V, l, 1e-6 * np.eye(6)
    search = np.array([0, 3, 6]), np.tile(np.arange(3), 2), places, 6.6, 0
    found, finished = matchings(*search, 10_000, 100)
    assert finished
    assert {(a % 3, b % 3) for a, b in found.tolist()} == {(0, 1), (1, 0), (1, 2), (2, 1)}
    assert matchings(*search, 10_000, 2)[1] is False, "there are more than may be kept"
    assert matchings(*search, 3, 100)[1] is False


def test_the_factor_of_chosen_pairs_grows_to_cholesky_s_and_d2_to_mahalanobis() -> None:
    rng, order = np.random.default_rng(0), [2, 0, 3]
    A = rng.normal(size=(8, 12))
    Z, z = A @ A.T, rng.normal(size=(4, 2))
    L, w, d2 = np.zeros((6, 6)), np.zeros(6), 0.0
    for count, m in enumerate(order):
        d2 += extend(L, w, z, Z, np.array(order), count, m, 2)
        rows = np.concatenate([[2 * k, 2 * k + 1] for k in order[: count + 1]])
        some, v, n = Z[np.ix_(rows, rows)], z[order[: count + 1]].ravel(), 2 * count + 2
        np.testing.assert_allclose(np.tril(L[:n, :n]), np.linalg.cholesky(some), atol=1e-12)
        assert d2 == pytest.approx(v @ np.linalg.solve(some, v))


def test_a_covariance_that_is_singular_with_a_pair_admits_it_never() -> None:
    Z, L, w = np.ones((2, 2)), np.zeros((2, 2)), np.zeros(2)
    z = np.zeros((2, 1))
    assert extend(L, w, z, Z, np.array([0, 1]), 0, 0, 1) == 0.0
    assert extend(L, w, z, Z, np.array([0, 1]), 1, 1, 1) == np.inf


FIRST, LANDMARK = (
    np.array([0, 2, 3]),
    np.array([1, 0, 1]),
)  # the first observation is nearer to landmark 1, as the other
Z_LINE, INNOVATIONS = np.ones((3, 3)) + 0.01 * np.eye(3), np.array([[-0.9], [1.1], [1.1]])


def test_a_shift_that_is_common_to_two_observations_pairs_both_with_what_is_not_nearest() -> None:
    """Landmarks at 0 and 2 seem to be at 1.1 and 3.1: the joint d2 of the shift is 2 x 1.1^2 / 2.01 = 1.204."""
    chosen, finished = best_matching(
        FIRST, LANDMARK, INNOVATIONS, Z_LINE, np.zeros(len(LANDMARK)), np.array([0.0, 9.0, 1.205]), 100
    )
    assert finished and chosen.tolist() == [1, 2]


def test_where_no_two_pairs_fit_the_one_of_least_d2_is_taken() -> None:
    chosen, _ = best_matching(
        FIRST, LANDMARK, INNOVATIONS, Z_LINE, np.zeros(len(LANDMARK)), np.array([0.0, 9.0, 1.203]), 100
    )
    assert chosen.tolist() == [0, -1]  # .81 / 1.01, the others 1.21 / 1.01
    chosen, _ = best_matching(
        FIRST, LANDMARK, INNOVATIONS, Z_LINE, np.zeros(len(LANDMARK)), np.array([0.0, 0.8, 0.8]), 100
    )
    assert chosen.tolist() == [-1, -1]
