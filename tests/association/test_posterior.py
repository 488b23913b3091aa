"""The posterior of matchings against a sum over all of them, and what is read from it."""

from __future__ import annotations

import itertools
from math import comb, exp, lgamma
from typing import Any

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from kalmark.association.posterior import Posterior, consistent_matchings, expected_in_gate, least_increase, posterior
from kalmark.geometry.gaussian import gate
from matched_points import Points

LINE = [[0.0, 0.0], [2.0, 0.0], [4.0, 0.0]]
P, PROBABILITY, MOST = 2, 0.999, 100_000


def log_weight(points: Points, pairs: tuple[int, ...], just: Any, experience: float) -> float:
    """Return the logarithm of the weight of a matching by its textbook form, up to a constant of all."""
    rows = [k for k, c in enumerate(pairs) if c >= 0]
    columns = [pairs[k] for k in rows]
    log_likelihood = 0.0
    if rows:
        z, Z = points.innovation(rows, columns)
        if z.ravel() @ np.linalg.solve(Z, z.ravel()) > gate(PROBABILITY, P * len(rows)):
            return -np.inf
        log_likelihood = float(multivariate_normal(np.zeros(z.size), Z).logpdf(z.ravel()))
        log_likelihood -= len(rows) * np.log(points.density)
    again = sum(bool(just[k, c]) for k, c in zip(rows, columns, strict=True))
    shares = again + experience + 0.5, len(rows) - again + 0.5, len(pairs) - len(rows) + 0.5
    return log_likelihood + sum(map(lgamma, shares))  # Dirichlet-multinomial of the three shares


@pytest.mark.parametrize(("just", "experience"), [(False, 0.0), (True, 0.0), (True, 5.0)])
@pytest.mark.parametrize("at_m", [0.3, 1.02])
def test_weights_are_those_of_a_sum_over_all_matchings(at_m: float, just: bool, experience: float) -> None:
    """Two observations on the line of three landmarks, shifted by nearly nothing or by half their distance."""
    points = Points([[at_m, 0.01], [at_m + 2.0, -0.01]], LINE, density=0.02)
    d2, flags = points.distances(), np.full((2, 3), just)
    found = posterior(points, np.arange(2), d2, d2 < 60.0, flags, P, PROBABILITY, MOST, experience)
    every = [c for c in itertools.product(range(-1, 3), repeat=2) if c[0] != c[1] or c[0] < 0]
    scores = np.array([log_weight(points, c, flags, experience) for c in every])
    right = dict(zip(every, np.exp(scores - scores.max()) / np.exp(scores - scores.max()).sum(), strict=True))
    got = dict(zip(map(tuple, found.pairs.tolist()), found.weights.tolist(), strict=True))
    assert len(got) == len(found.pairs), "none is counted twice"
    assert sum(right[c] for c in got) > 0.999
    assert found.weights.sum() == pytest.approx(1.0)
    for c, weight in got.items():
        assert weight == pytest.approx(right[c], abs=1e-3)
    assert tuple(found.pairs[0]) == max(right, key=right.__getitem__)


def test_of_two_shifts_of_a_line_each_is_as_likely_and_of_another_pose() -> None:
    points = Points([[1.0, 0.0], [3.0, 0.0]], LINE)
    d2 = points.distances()
    found = posterior(points, np.arange(2), d2, d2 < 60.0, d2 < 0.0, P, PROBABILITY, MOST, 0.0)
    assert {tuple(c) for c in found.pairs[:2].tolist()} == {(0, 1), (1, 2)}
    assert found.weights[0] == pytest.approx(found.weights[1])
    assert found.elsewhere == 3, "the other shift, and both reversed"
    z, Z = points.innovation([0, 1], found.pairs[0])
    ratio = multivariate_normal(np.zeros(4), Z).logpdf(z.ravel()) - 2 * np.log(points.density)
    assert found.chance == pytest.approx(comb(2, 2) * exp(-ratio))


def test_agreement_keeps_pairs_of_equal_distances_whatever_the_pose() -> None:
    points = Points([[50.0, 50.0], [50.0, 52.0], [54.0, 50.0]], [[0.0, 0.0], [0.0, 2.0], [4.0, 0.0], [30.0, 0.0]])
    found, finished = consistent_matchings(points, np.arange(3), points.distances(), np.ones((3, 4), bool), 0.99, MOST)
    assert finished
    exchanged = [[1, 0, -1], [2, -1, 0], [-1, 2, 1]]  # both ends of one distance, with a pair less
    assert sorted(found.tolist()) == sorted([[0, 1, 2], *exchanged])


def test_landmarks_in_a_gate_are_counted_over_the_volume_that_was_searched() -> None:
    d2 = np.array([[1.0, 4.0, 16.0, np.inf], [1.0, 2.0, np.inf, np.inf]])
    np.testing.assert_allclose(expected_in_gate(d2, 4.0, 2), [3 * 4 / 16, 2.0])
    np.testing.assert_allclose(expected_in_gate(d2, 4.0, 3), [3 * (4 / 16) ** 1.5, 2.0])


def test_a_pair_adds_to_a_matching_what_the_joint_d2_grows_by() -> None:
    """The first pair shows the shift of .3 m: from there the second observation is .1 m off, by 2 noises of 1 cm."""
    points = Points([[0.3, 0.0], [2.4, 0.0]], LINE, S=1e4)
    least = least_increase(points, np.arange(2), np.array([0, -1]), 1, np.arange(3))
    assert least == pytest.approx(0.1**2 / (2 * 1e-4), rel=1e-4)
    assert least_increase(points, np.arange(2), np.array([0, -1]), 1, np.array([0])) == np.inf, "0 is taken"


FOUND = Posterior(np.array([[0, 1], [0, -1], [2, 1]]), np.array([0.5, 0.3, 0.2]), 0.0, 0, True)


def test_shares_of_pairs_of_none_and_of_landmarks_just_seen_are_sums_of_weights() -> None:
    np.testing.assert_allclose(FOUND.shares(), [0.8, 0.7])
    np.testing.assert_allclose(FOUND.none(), [0.0, 0.3])
    just = np.array([[True, False, False], [False, True, True]])
    assert FOUND.again(just) == pytest.approx(0.5 * 2 + 0.3 * 1 + 0.2 * 1)


def test_a_reason_names_the_likeliest_landmarks_first() -> None:
    assert FOUND.why(0, "abc") == "ambiguous: 'a' 0.80, 'c' 0.20"
    cut = FOUND._replace(finished=False)
    assert cut.why(1, "abc") == "ambiguous: 'b' 0.70, none 0.30, and the search was not finished"
