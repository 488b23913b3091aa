"""The log ratios of pairs against their joint likelihood, and the groups that are accepted."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from kalmark.association.ratio import LogRatios, doubtful, log_ratios


def normal(z: np.ndarray, Z: np.ndarray) -> float:
    return float(multivariate_normal(np.zeros(z.size), Z).logpdf(z.ravel()))


def test_the_log_ratios_of_pairs_add_up_to_that_of_all_whatever_their_order() -> None:
    """p(z_1) p(z_2 | z_1) p(z_3 | z_1, z_2) / chance^3."""
    rng = np.random.default_rng(2)
    A = rng.normal(size=(6, 9))
    Z, z, chance = A @ A.T, rng.normal(size=(3, 2)), rng.normal(size=3)
    joint = normal(z, Z) - chance.sum()
    for given in range(4):
        found = log_ratios(z, Z, chance, given)
        assert found.ratio.sum() == pytest.approx(joint)
        assert found.order[:given] == [*range(given)]
        assert sorted(found.order) == [0, 1, 2]


def test_each_is_the_largest_given_those_before_and_bounded_by_that_of_no_misfit() -> None:
    Z, z = np.array([[4.0, 3.9], [3.9, 4.0]]), np.array([[2.0], [1.9]])
    found = log_ratios(z, Z, np.log([0.1, 0.2]))
    first = -0.5 * (4.0 / 4 + math.log(2 * math.pi * 4)) - math.log(0.1)
    variance, off = 4.0 - 3.9**2 / 4, 1.9 - 3.9 / 4 * 2.0  # of the second, given the first
    second = -0.5 * (off**2 / variance + math.log(2 * math.pi * variance)) - math.log(0.2)
    assert found.order == [0, 1]
    np.testing.assert_allclose(found.ratio, [first, second])
    np.testing.assert_allclose(found.bound, [first + 0.5, second + 0.5 * off**2 / variance])


@pytest.mark.parametrize(
    ("ratio", "bound", "given", "out"),
    [
        ([-1.0, 8.0], [-0.5, 9.0], 0, []),  # 7 > log 1000: they are accepted together
        ([-1.0, 7.0], [-0.5, 9.0], 0, [0, 1]),  # 6 < log 1000
        ([8.0, 8.0], [9.0, 9.0], 0, []),  # neither needs another one
        ([-1.0, 9.0, -4.0], [-0.5, 10.0, -3.0], 0, [2]),  # two against the one that contradicts them
        ([9.0, -4.0], [1.0, -3.0], 0, [1, 0]),  # one against one
        ([-9.0, 8.0], [-8.0, 9.0], 1, []),  # the first is taken as it is
    ],
)
def test_groups_are_accepted_at_their_joint_odds(
    ratio: list[float], bound: list[float], given: int, out: list[int]
) -> None:
    found = LogRatios([*range(len(ratio))], np.array(ratio), np.array(bound))
    assert doubtful(found, given, 1000.0) == out
