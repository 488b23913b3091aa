"""Classes of landmarks by Bayes' rule, values by hand: reports, distances in d2, landmarks that may be one."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

import kalmark as km
from kalmark.errors import ModelError
from kalmark.tracks.classes import add_report, distance_of_landmarks

CONES = km.Classes(("blue", "yellow"), error=0.1)
THREE = km.Classes(("a", "b", "c"), error=0.3)


def reported(*names: str | None, classes: km.Classes = CONES) -> dict[str, float]:
    """Return the log-likelihoods of a landmark of which these classes were reported."""
    known: dict[str, float] = {}
    for name in names:
        add_report(known, classes, name)
    return known


def test_wrong_reports_are_shared_among_the_other_classes() -> None:
    np.testing.assert_allclose(THREE.confusion_matrix, [[0.7, 0.15, 0.15], [0.15, 0.7, 0.15], [0.15, 0.15, 0.7]])
    np.testing.assert_allclose(THREE.likelihoods(["b", None]), [[0.15, 0.7, 0.15], [1.0, 1.0, 1.0]])
    assert THREE.likelihoods([]).shape == (0, 3)


def test_the_likelihood_of_a_report_is_that_of_each_true_class_to_be_reported_so() -> None:
    """A column of the confusion matrix, not a row."""
    cones = km.Classes(("blue", "yellow"), confusion=(0.9, 0.1, 0.3, 0.7))
    np.testing.assert_allclose(cones.likelihoods(["blue", "yellow"]), [[0.9, 0.3], [0.1, 0.7]])


def test_reports_add_the_logarithms_of_their_likelihoods() -> None:
    assert reported(None) == {}
    known = reported("blue", "blue", None, "yellow")
    assert known == pytest.approx({"blue": math.log(0.9 * 0.9 * 0.1), "yellow": math.log(0.1 * 0.1 * 0.9)})
    np.testing.assert_allclose(CONES.probabilities(known), [0.9, 0.1])
    np.testing.assert_allclose(CONES.probabilities({}), [0.5, 0.5])
    np.testing.assert_allclose(CONES.probabilities({"blue": -2000.0, "yellow": -2001.0})[1], 1.0 / (1.0 + math.e))


def test_the_distance_of_a_report_is_twice_the_log_of_how_much_less_likely_it_is_than_of_its_own_class() -> None:
    pairs, new = CONES.distances(["blue", None], [reported("blue"), reported("yellow"), {}])
    of_blue, of_yellow = 0.9 * 0.9 + 0.1 * 0.1, 0.9 * 0.1 + 0.1 * 0.9
    right = [-2.0 * math.log(p / 0.9) for p in (of_blue, of_yellow, 0.5)]
    np.testing.assert_allclose(pairs, [right, [0.0, 0.0, 0.0]], atol=1e-12)
    np.testing.assert_allclose(new, [right[2], 0.0], atol=1e-12)


def test_landmarks_of_one_class_are_nearer_and_of_two_classes_farther_than_those_without_reports() -> None:
    """2 (p . q) of two classes: .9 .9 + .1 .1 and .9 .1 + .1 .9."""
    blue, yellow = reported("blue"), reported("yellow")
    assert distance_of_landmarks(blue, blue) == pytest.approx(-2.0 * math.log(2.0 * 0.82))
    assert distance_of_landmarks(blue, yellow) == pytest.approx(-2.0 * math.log(2.0 * 0.18))
    assert distance_of_landmarks(blue, {}) == pytest.approx(0.0, abs=1e-12)
    assert distance_of_landmarks({}, {}) == 0.0
    many = reported("b", classes=THREE)
    assert distance_of_landmarks(many, many) == pytest.approx(-2.0 * math.log(3.0 * (0.7**2 + 2 * 0.15**2)))


def test_a_confusion_matrix_says_which_class_is_taken_for_which() -> None:
    three = km.Classes(("blue", "yellow", "orange"), confusion=(0.9, 0.05, 0.05, 0.05, 0.75, 0.2, 0.1, 0.3, 0.6))
    np.testing.assert_allclose(three.confusion_matrix[1], [0.05, 0.75, 0.2])
    known: dict[str, float] = {}
    add_report(known, three, "orange")
    assert three.probabilities(known)[2] == pytest.approx(0.6 / 0.85)
    pairs, new = three.distances(["blue"], [known, {}])
    assert pairs[0, 0] > pairs[0, 1] == pytest.approx(new[0])
    assert distance_of_landmarks({"blue": 0.0, "yellow": -9.0}, {"blue": -9.0, "yellow": 0.0}) > 10.0
    assert distance_of_landmarks({}, {}) == 0.0


@pytest.mark.parametrize(
    ("given", "why"),
    [
        ({"names": ("blue",)}, "at least two different texts"),
        ({"names": ("blue", "blue")}, "at least two different texts"),
        ({"names": ("blue", "yellow"), "error": 1.5}, "a probability between 0 and 1"),
        ({"names": ("blue", "yellow"), "confusion": (0.9, 0.2, 0.1, 0.9)}, "each 2 of the sum 1"),
    ],
)
def test_odd_classes_are_refused(given: dict[str, Any], why: str) -> None:
    with pytest.raises(ModelError, match=why):
        km.Classes(**given)
