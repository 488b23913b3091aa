"""Associations one by one, as an assignment and jointly, on distances made by hand; what is between two gates."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

import kalmark as km
from kalmark.association.gated import assign
from kalmark.association.protocol import NEW, averages, new_gate, weighs
from matched_points import Asked, Points

ASKED: Any = None  # the question of a method that reads nothing but distances
ROWS = np.arange(2)


def test_an_assignment_has_the_least_sum_and_none_counts_as_the_gate() -> None:
    assert assign(np.array([[1.0, 2.0], [1.5, 9.0]]), 10.0).tolist() == [1, 0], "2 + 1.5 < 1 + 9"
    d2 = np.array([[1.0, 7.5], [2.0, 30.0]])
    assert assign(d2, 9.0).tolist() == [1, 0], "7.5 + 2 < 1 + gate"
    assert assign(np.where(d2 == 7.5, 8.5, d2), 9.0).tolist() == [0, -1], "1 + gate < 8.5 + 2"
    assert assign(np.array([[9.1]]), 9.0).tolist() == [-1]


def test_the_nearest_pair_goes_first_and_what_it_takes_is_taken() -> None:
    found = km.association.NearestNeighbour().match(ASKED, ROWS, ["a", "b"], np.array([[1.0, 4.0], [0.5, 3.0]]), 9.0)
    assert found.pairs.tolist() == [-1, 0]
    assert found.reasons == {0: "its nearest landmark 'a' is taken by a nearer observation"}
    apart = km.association.NearestNeighbour().match(ASKED, ROWS, ["a", "b"], np.array([[1.0, 4.0], [9.0, 3.0]]), 9.0)
    assert (apart.pairs.tolist(), apart.reasons) == ([0, 1], {})
    far = km.association.NearestNeighbour().match(ASKED, ROWS, ["a", "b"], np.array([[1.0, 4.0], [9.0, 9.1]]), 0.5)
    assert far.pairs.tolist() == [-1, -1]


def test_the_assignment_gives_way_where_the_nearest_does_not() -> None:
    d2 = np.array([[1.0, 4.0], [0.5, 30.0]])
    assert km.association.GlobalAssignment().match(ASKED, ROWS, ["a", "b"], d2, 9.0).pairs.tolist() == [1, 0]


@pytest.mark.parametrize(("p", "gate"), [(1, 6.634897), (2, 9.210340), (3, 11.344867)])
def test_a_gate_is_the_quantile_of_chi_square(p: int, gate: float) -> None:
    assert km.association.NearestNeighbour(gate=0.99).threshold(p, 5.0) == pytest.approx(gate)
    assert km.association.ByIdentity(gate=0.99).threshold(p, 5.0) == pytest.approx(gate)
    assert km.association.ByIdentity("off").threshold(p, 5.0) == math.inf
    assert km.association.ByIdentity("default").threshold(p, 5.0) == 5.0
    assert km.association.Automatic().threshold(p, 5.0) == math.inf


def test_inside_the_gate_it_is_paired_beyond_the_second_new_and_between_them_left_alone() -> None:
    """Of a sigma of 1 m the gates are at 3.03 m and 4.80 m."""
    v = [[1.0, 0.0], [0.0, 4.0], [0.0, -4.9], [20.0, 0.0], [1.5, 0.0], [60.0, 0.0]]
    points = Points(v, [[0.0, 0.0], [40.0, 0.0], [20.0, 0.0]], S=0.0, R=1.0)
    asked: Any = Asked(points, ["a", "b", "c"], (None, None, None, "c", None, "d"))
    answers = km.association.GlobalAssignment().associate(asked)
    assert answers == [
        ("a", ""),
        (None, "between 'a' and a new landmark: d2 16.0"),
        (NEW, "no landmark near"),
        ("c", ""),
        (None, "its nearest landmark 'a' is another observation's"),
        ("d", ""),
    ]


def test_a_landmark_of_an_id_is_no_candidate_and_without_any_all_is_new() -> None:
    points = Points([[0.0, 0.0], [0.1, 0.0]], [[0.0, 0.0]], S=0.0, R=1.0)
    asked: Any = Asked(points, ["a"], ("a", None))
    assert km.association.NearestNeighbour().associate(asked) == [("a", ""), (NEW, "no landmark near")]


def test_a_distance_that_is_not_a_number_is_as_far_as_can_be() -> None:
    points = Points([[0.0, 0.0], [np.nan, 0.0]], [[0.0, 0.0]], S=0.0, R=1.0)
    asked: Any = Asked(points, ["a"])
    assert km.association.GlobalAssignment().associate(asked) == [("a", ""), (NEW, "no landmark near")]


def test_a_joint_test_sees_the_shift_that_is_common_to_a_scan() -> None:
    """Both observations are 1.1 m east of their landmarks, the first therefore nearer to the other one's."""
    points = Points([[1.1, 0.0], [3.1, 0.0]], [[0.0, 0.0], [2.0, 0.0]], S=1.0, R=0.01)
    asked: Any = Asked(points, ["a", "b"])
    assert [name for name, _ in km.association.JointCompatibility().associate(asked)] == ["a", "b"]
    assert [name for name, _ in km.association.NearestNeighbour().associate(asked)] == ["b", None]


def test_a_joint_test_leaves_out_what_is_inside_its_own_gate_and_does_not_fit_the_others() -> None:
    """The third is 1 m off by itself, of a sigma of 1 m, and 1 m from where the shift of the others has it."""
    points = Points([[0.0, 0.0], [9.0, 0.0], [1.0, 9.0]], [[0.0, 0.0], [9.0, 0.0], [0.0, 9.0]], S=1.0, R=1e-4)
    asked: Any = Asked(points, ["a", "b", "c"])
    answers = km.association.JointCompatibility().associate(asked)
    assert [name for name, _ in answers] == ["a", "b", None]
    assert answers[2][1] == "it does not fit with the others"
    assert [name for name, _ in km.association.GlobalAssignment().associate(asked)] == ["a", "b", "c"]


def test_ids_are_trusted_and_what_has_none_is_left_alone() -> None:
    asked: Any = Asked(Points([[0.0, 0.0], [1.0, 0.0]], [[0.0, 0.0]]), ["a"], (7, None))
    assert km.association.ByIdentity().associate(asked) == [(7, ""), (None, "no id in the log")]


def test_what_an_association_does_not_say_of_itself_has_a_default() -> None:
    told = {method: (weighs(method), averages(method), new_gate(method)) for method in METHODS}
    assert [*told.values()] == [
        (False, False, 0.99999), (False, False, 0.9), (True, False, 0.99999), (True, True, 0.99999)
    ]  # fmt: skip


METHODS = (
    km.association.ByIdentity(),
    km.association.NearestNeighbour(new_gate=0.9),
    km.association.Automatic(),
    km.association.Averaged(),
)
