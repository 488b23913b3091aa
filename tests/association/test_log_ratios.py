"""The log ratios of pairs against their joint likelihood, and the groups that are accepted."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.stats import multivariate_normal

import kalmark as km
from kalmark.association.ratio import LogRatios, doubtful_pairs, log_density_about, log_ratios
from kalmark.filter.map import StochasticMap
from kalmark.geometry import POINT2
from kalmark.tracks.track import Track, Tracks


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
    assert doubtful_pairs(found, given, 1000.0) == out


def test_the_density_about_landmarks_is_that_of_those_observed_with_them_or_of_the_space_seen() -> None:
    m, tracks, point = StochasticMap(), Tracks(["r"]), km.landmarks.Point2D()
    places = {"a": (0.0, 0.0), "b": (3.0, 0.0), "c": (0.0, 4.0), "d": (10.0, 0.0), "e": (0.5, 0.0)}
    for name, place in places.items():
        tracks.confirm(Track(name, point, m.add(POINT2, place, np.eye(2))))
    tracks.note_scan(["a", "b", "c"])  # e, as near as it is, may be a itself
    sensor = np.array([10.0, 2.0, 0.3])
    two, alone = math.log(2 / (math.pi * 4.0**2)), math.log(1 / (math.pi * 2.0**2))
    assert log_density_about(m, tracks, ["a"], sensor) == pytest.approx(two)
    assert log_density_about(m, tracks, ["d"], sensor) == pytest.approx(alone)
    assert log_density_about(m, tracks, ["a", "a", "d"], sensor) == pytest.approx(two), "the median"
    for name, place in (("k", (20.0, 0.0)), ("l", (20.0, 5.0))):
        tracks.known.add(name, point, np.array(place))
    known = math.log(1 / (math.pi * 5.0**2))
    assert log_density_about(m, tracks, ["k"], sensor) == pytest.approx(known)
