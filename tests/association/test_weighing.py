"""What each association makes of matchings and their weights: the likeliest, one drawn, a mean, the largest clique."""

from __future__ import annotations

import math
from collections import Counter
from typing import Any

import numpy as np
import pytest

import kalmark as km
from kalmark.association.posterior import Posterior
from kalmark.association.protocol import Answer, Mixture
from matched_points import Asked, Points

NAMES: list[Any] = ["a", "b", "c"]
NEAR = np.ones(2, dtype=np.bool_)
DEFERRED, REMAP, MIXTURE = (each.value for each in (Answer.DEFERRED, Answer.REMAP, Answer.MIXTURE))
LINE = [[0.0, 0.0], [2.0, 0.0], [4.0, 0.0]]
AMBIGUOUS = Points([[1.0, 0.0], [3.0, 0.0]], LINE)  # half a distance off, of a sigma of half a metre
CLEAR = Points([[0.02, 0.0], [2.02, 0.0]], LINE, S=1e-4)
ASKED: Any = Asked(AMBIGUOUS, NAMES)


def found_of(*weights: float, finished: bool = True, chance: float = 0.0, elsewhere: int = 0) -> Posterior:
    """Return matchings of two observations of these weights; all have the first pair, the first one the second, too."""
    pairs = np.array([[0, 1], [0, -1], [0, 2]])[: len(weights)]
    return Posterior(pairs, np.array(weights), chance, elsewhere, finished)


def test_a_pair_is_taken_from_its_confidence_on_and_deferred_below() -> None:
    method = km.association.Automatic(confidence=0.8)
    assert method.choose(ASKED, NAMES, found_of(0.81, 0.19), NEAR, False).pairs.tolist() == [0, 1]
    pairs, reasons, _ = method.choose(ASKED, NAMES, found_of(0.79, 0.21), NEAR, False)
    assert pairs.tolist() == [0, DEFERRED]
    assert reasons == {1: "ambiguous: 'b' 0.79, none 0.21"}
    nothing_near = np.array([True, False])
    assert method.choose(ASKED, NAMES, found_of(0.79, 0.21), nothing_near, False).pairs.tolist() == [0, 1]


def test_all_is_deferred_after_a_search_that_was_not_finished() -> None:
    found = found_of(1.0, finished=False)
    assert km.association.Automatic().choose(ASKED, NAMES, found, NEAR, False).pairs.tolist() == [DEFERRED, DEFERRED]


@pytest.mark.parametrize(
    ("chance", "elsewhere", "observations", "takes"),
    [(1e-4, 0, 3, True), (2e-3, 0, 3, False), (1e-4, 1, 3, False), (1e-4, 0, 4, False)],
    ids=["clear", "by chance", "elsewhere", "half of the scan"],
)
def test_a_lost_robot_takes_a_matching_of_most_of_its_scan_that_nothing_else_explains(
    chance: float, elsewhere: int, observations: int, takes: bool
) -> None:
    pairs = np.full((1, observations), -1)
    pairs[0, :2] = 0, 1
    found = Posterior(pairs, np.ones(1), chance, elsewhere, True)
    got = km.association.Automatic().choose(ASKED, NAMES, found, np.ones(observations, dtype=np.bool_), True).pairs
    assert got.tolist() == (pairs[0].tolist() if takes else [REMAP] * observations)


def test_matchings_are_drawn_as_often_as_they_are_likely() -> None:
    asked: Any = Asked(AMBIGUOUS, NAMES)
    drawn, weights = Counter[int](), {1: 0.7, -1: 0.2, 2: 0.1}
    found = found_of(*weights.values())
    for asked.time in range(2000):
        one, again = (km.association.Sampled().choose(asked, NAMES, found, NEAR, False) for _ in range(2))
        assert one.pairs.tolist() == again.pairs.tolist()
        drawn[int(one.pairs[1])] += 1
    for c, p in weights.items():
        assert abs(drawn[c] - 2000 * p) < 4 * math.sqrt(2000 * p * (1 - p))


def test_what_is_rather_of_a_landmark_is_averaged_over() -> None:
    found = Posterior(np.array([[0, 1], [0, -1], [-1, 2]]), np.array([0.35, 0.45, 0.2]), 0.0, 0, True)
    pairs, _, mixed = km.association.Averaged().choose(ASKED, NAMES, found, NEAR, False)
    assert pairs.tolist() == [MIXTURE, MIXTURE], "of one with .8, and of either of two with .55"
    assert mixed is found
    rather_none = found._replace(weights=np.array([0.25, 0.55, 0.2]))
    assert km.association.Averaged().choose(ASKED, NAMES, rather_none, NEAR, False).pairs.tolist() == [MIXTURE, -1]
    far = np.array([False, True])
    assert km.association.Averaged().choose(ASKED, NAMES, found, far, False).pairs.tolist() == [-1, MIXTURE]


def answers(method: Any, points: Points, adrift: bool = False) -> list[Any]:
    return [answer for answer, _ in method.associate(Asked(points, NAMES, adrift=adrift))]


def test_two_shifts_that_fit_alike_are_deferred_and_a_clear_pose_pairs_one_by_one() -> None:
    assert answers(km.association.Automatic(), AMBIGUOUS) == [Answer.DEFERRED] * 2
    assert answers(km.association.Cliques(), AMBIGUOUS) == [Answer.DEFERRED] * 2
    for method in (km.association.Automatic(), km.association.Sampled(), km.association.Cliques()):
        assert answers(method, CLEAR) == ["a", "b"]
    assert answers(km.association.Automatic(), AMBIGUOUS, adrift=True) == [Answer.REMAP] * 2
    assert answers(km.association.Sampled(), AMBIGUOUS) in (["a", "b"], ["b", "c"])


def test_an_average_has_both_shifts_with_equal_weights() -> None:
    first, second = answers(km.association.Averaged(), AMBIGUOUS)
    assert isinstance(first, Mixture) and first is second
    assert {tuple(c) for c in first.pairs[:2].tolist()} == {(0, 1), (1, 2)}
    assert first.weights[0] == pytest.approx(first.weights[1])
    assert (first.names, first.rows.tolist()) == (NAMES, [0, 1])


def test_a_scan_with_a_clear_pose_teaches_how_many_were_of_landmarks_just_seen() -> None:
    asked: Any = Asked(CLEAR, NAMES)  # |Z| / |R| = 4 for each
    km.association.Automatic().associate(asked)
    assert asked.reobserved == 2


def test_what_no_landmark_explains_from_where_the_others_are_seen_is_new() -> None:
    """It is .6 m from its landmark, .4 m of that by the shift which the others show to a centimetre."""
    posts = [[0.0, 0.0], [2.0, 0.0], [0.0, 3.3]]
    points = Points([[0.4, 0.0], [2.4, 0.0], [1.0, 3.3]], posts, S=0.25)
    assert answers(km.association.Automatic(), points) == ["a", "b", Answer.NEW]


def test_a_lost_robot_pairs_with_what_it_has_just_seen_and_maps_the_strange_anew() -> None:
    d2 = np.array([[1.0, np.inf], [np.inf, 15.0], [np.inf, 30.0], [4.0, np.inf]])
    pairs, reasons, mixed = km.association.Automatic().remapped(d2, 9.2, 23.0, {2: "why"})
    assert (pairs.tolist(), reasons, mixed) == ([0, DEFERRED, REMAP, DEFERRED], {2: "why"}, None)


def test_more_candidates_are_asked_for_until_each_observation_has_one_outside_its_gate() -> None:
    """Of 60 landmarks on a line, 40 are within the gate of 99 % and 3.03 sigmas of 5 m."""
    points = Points([[0.0, 0.0]], [[0.75 * k, 0.0] for k in range(-30, 30)], S=25.0, R=1e-4)
    asked, counts = Asked(points, [*range(60)]), list[int]()

    def candidates(nearest: int, farther: float) -> list[Any]:
        counts.append(nearest)
        return sorted(asked.names, key=lambda k: float(np.abs(points.l[k, 0])))[:nearest]

    asked.candidates = candidates
    names, d2 = km.association.Automatic().near(asked, np.arange(1), 9.21)
    assert counts == [8, 32, 128]
    assert (len(names), int((d2 <= 9.21).sum())) == (60, 41)
