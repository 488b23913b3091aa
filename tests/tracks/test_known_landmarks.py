"""Landmarks known exactly: rows of one array by kind, who is near, and what is left when some are removed."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

import kalmark as km
from kalmark.errors import MapError
from kalmark.tracks.known_landmarks import Known, KnownLandmarks

POINT, WALL = km.landmarks.Point2D(), km.landmarks.Wall2D()
LINE = np.array([0.6, 0.8, 2.0])
ROW = [(0.0, 0.0), (1.0, 0.0), (3.0, 0.0), (7.0, 0.0)]
MODELS: dict[str, Any] = {POINT.kind: None}  # of a sensor that observes points


def known(places: Any = ROW) -> Known:
    of = Known(POINT)
    for i, place in enumerate(places):
        of.add(i, np.array(place))
    return of


def test_more_than_an_array_has_rows_for_are_kept_with_their_counts() -> None:
    places = np.arange(80.0).reshape(40, 2)
    of = known(places[:16])
    of.counts[3] = 5
    assert [of.add(i, places[i]) for i in range(16, 40)] == [*range(16, 40)]
    np.testing.assert_array_equal(of.values, places)
    assert (of.counts.sum(), of.counts[3]) == (5, 5)


def test_the_last_takes_the_row_of_one_that_is_removed() -> None:
    of = known()
    assert of.tree().query([0.0, 0.0])[1] == 0
    of.remove(0)
    assert of.names == [3, 1, 2]
    np.testing.assert_array_equal(of.places(), [ROW[3], ROW[1], ROW[2]])
    assert of.tree().query([0.0, 0.0])[1] == 1, "the tree is made again"


def test_pairs_are_found_by_how_far_apart_they_are() -> None:
    """Apart by 1, 3 and 7 m from the first, by 2 and 6 m from the second, by 4 m from the third."""
    of = known()

    def pairs(low: float, high: float, most: int = 100) -> list[list[int]]:
        return sorted(map(sorted, of.pairs(low, high, most).tolist()))

    assert pairs(1.5, 3.5) == [[0, 2], [1, 2]]
    assert pairs(0.0, 1.5) == [[0, 1]], "within what was found before"
    assert pairs(3.5, 10.0) == [[0, 3], [1, 3], [2, 3]]
    assert known().pairs(0.0, 10.0, 5).tolist() == [], "six are too many"


def test_the_density_about_a_landmark_is_that_of_its_neighbours() -> None:
    assert known([(0.0, 0.0), (3.0, 0.0)]).density() == pytest.approx(1 / (math.pi * 3**2))
    # the fourth neighbour of the middle of a cross is 1 m off, that of its ends, which are more, 2 m
    cross = [(0.0, 0.0), (1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)]
    assert known(cross).density() == pytest.approx(4 / (math.pi * 2**2))


def test_neighbours_of_a_place_are_told_by_distance_by_reach_and_by_number() -> None:
    of = known()
    np.testing.assert_allclose(of.gaps(np.array([1.0, 0.0]), 2), [1.0, 2.0])
    np.testing.assert_allclose(of.gaps(np.array([1.0, 0.0]), 9), [1.0, 2.0, 6.0])
    assert known(ROW[:1]).gaps(np.zeros(2), 2).tolist() == []
    assert of.within(np.array([2.0, 0.0]), 1.1) == [1, 2]
    assert of.within(np.array([2.0, 0.0]), math.inf) == [0, 1, 2, 3]
    p = np.array([[0.1, 0.0], [9.0, 0.0], [np.nan, 0.0]])
    assert of.nearest(p, 1).tolist() == [0, 3]
    assert of.nearest(p, 2).tolist() == [0, 1, 2, 3]
    assert of.nearest(p[:0], 1).tolist() == []


def all_kinds() -> KnownLandmarks:
    known = KnownLandmarks()
    for name, place in zip("abcd", ROW, strict=True):
        known.add(name, POINT, np.array(place))
    known.add("wall", WALL, LINE)
    return known


def test_landmarks_of_several_kinds_are_found_by_name() -> None:
    known = all_kinds()
    assert (len(known), [*known], known.changes) == (5, [*"abcd", "wall"], 5)
    assert "a" in known and "z" not in known and ["a"] not in known
    assert (known.kind("a"), known.kind("wall"), known.kind("z")) == (POINT.kind, WALL.kind, None)
    assert known.model("wall") is WALL
    np.testing.assert_array_equal(known.means("ca", 2), [ROW[2], ROW[0]])
    np.testing.assert_array_equal(known.means(["b", "wall"], 2), [ROW[1], LINE[:2]])
    known.mean("a")[:] = 9.0
    np.testing.assert_array_equal(known.mean("a"), ROW[0])  # a copy was changed


def test_after_a_removal_each_name_is_still_what_it_was() -> None:
    known = all_kinds()
    known.count("abcd", [True, True, False, True])
    known.count("ad", [False, True])
    known.remove("a")
    assert (known.kind("a"), len(known), known.changes) == (None, 4, 6)
    np.testing.assert_array_equal(known.means("bcd", 2), ROW[1:])
    assert [known.observations(name) for name in "bcd"] == [1, 0, 2]
    known.remove("d")
    assert [known.observations(name) for name in "bc"] == [1, 0]
    np.testing.assert_array_equal(known.mean("wall"), LINE)


def test_of_lines_the_ends_are_told_and_near_a_place_are_only_the_kinds_that_a_sensor_observes() -> None:
    known = all_kinds()
    assert known.extent("a") is None
    np.testing.assert_array_equal(known.extent("wall"), WALL.first_ends)
    assert known.near(MODELS, np.array([[6.0, 0.0]]), 2) == ["c", "d"]
    assert known.near({}, np.array([[6.0, 0.0]]), 2) == []


def test_names_are_found_anew_after_a_file_was_read_and_one_that_is_there_twice_is_refused() -> None:
    known = all_kinds()
    known.restored()
    assert {name: known.kind(name) for name in known} == {**dict.fromkeys("abcd", POINT.kind), "wall": WALL.kind}
    known.of_kind[WALL.kind].names[0] = "a"
    with pytest.raises(MapError, match="a landmark known exactly is there twice"):
        known.restored()
    of = all_kinds().of_kind[POINT.kind]
    of.names.extend(range(100))
    with pytest.raises(MapError, match="the values of 104 known landmarks"):
        of.restored()
