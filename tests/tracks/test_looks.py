"""Looks of a sensor: when a scan is another one, the cells of a landmark, and what a miss counts there."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from kalmark.errors import MapError
from kalmark.tracks.looks import AGAIN, MOST, RANGES, STANDING, Looks, cells_of

POSE = np.array([1.0, 2.0, 3.1])
LEVEL = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])


def looked(pose: np.ndarray, scale_m: float = 10.0) -> Looks:
    looks = Looks()
    looks.take(pose, 5, scale_m)
    return looks


def test_the_first_scan_is_a_look_and_the_next_from_there_is_none() -> None:
    assert Looks().is_due(POSE, 0)
    assert not looked(POSE).is_due(POSE, 5)
    assert looked(POSE).is_due(POSE, 6), "a landmark has come"


@pytest.mark.parametrize(("step", "due"), [(0.99, False), (1.01, True)])
def test_a_step_of_a_tenth_of_the_range_makes_another_look(step: float, due: bool) -> None:
    assert looked(POSE).is_due(POSE + step * np.array([0.6, 0.8, 0.0]), 5) is due
    assert looked(LEVEL).is_due(LEVEL + step * np.array([0.0, 0.6, 0.8, 0, 0, 0, 0]), 5) is due


@pytest.mark.parametrize(("turn", "due"), [(0.19, False), (0.21, True)])
def test_a_turn_of_a_fifth_of_a_radian_makes_another_look(turn: float, due: bool) -> None:
    for sign in (1.0, -1.0):  # the one across the seam
        assert looked(POSE).is_due(POSE + sign * np.array([0.0, 0.0, turn]), 5) is due
        q = [0.0, sign * math.sin(turn / 2), 0.0, math.cos(turn / 2)]
        assert looked(LEVEL).is_due(np.array([0.0, 0.0, 0.0, *q]), 5) is due
        assert looked(LEVEL).is_due(np.array([0.0, 0.0, 0.0, *np.negative(q)]), 5) is due, "the same rotation"


def test_a_sensor_that_stands_looks_again_after_twenty_scans() -> None:
    looks = looked(POSE)
    assert [looks.is_due(POSE, 5) for _ in range(STANDING)] == [False] * (STANDING - 1) + [True]
    looks.take(POSE, 5, 10.0)
    assert (looks.taken, looks.since) == (2, 0)


def test_cells_are_four_to_an_octave_of_ranges_and_15_deg_of_bearings() -> None:
    r, no, yes = np.array([1.0, 2.0**0.26, 2.0, 1e-9, 1e30]), np.zeros(5, bool), np.ones(5, bool)
    np.testing.assert_array_equal(cells_of(r, np.zeros(5), no, yes)[:, 0], [32, 33, 36, 0, RANGES - 1])
    bearing = np.radians([-180.0, -164.0, 0.0, 16.0, 180.0])
    np.testing.assert_array_equal(cells_of(np.ones(5), bearing, no, yes)[:, 1], [0, 1, 12, 13, 0])
    hidden, in_reach = np.array([False, True] * 2), np.array([True, True, False, False])
    np.testing.assert_array_equal(cells_of(np.ones(4), np.zeros(4), hidden, in_reach)[:, 2], [0, 1, 2, 3])


def looked_at(shares: list[tuple[float, float, bool, float]], number: int) -> tuple[Looks, np.ndarray]:
    """Return looks at so many landmarks of each range, bearing, hidden or not, and share seen, and their cells."""
    r, bearing, hidden, share = (np.array(column) for column in zip(*shares, strict=True))
    cells, looks = cells_of(r, bearing, hidden.astype(bool), np.ones(len(r), bool)), Looks(taken=AGAIN)
    for k in range(number):
        looks.count(cells, k < number * share)
    return looks, cells


def test_the_detection_probability_is_a_product_of_what_ranges_bearings_and_hiding_things_leave() -> None:
    """Half of what is in view is hidden, and behind the sensor nothing is seen, however near."""
    places = [(r, b, h) for r in (3.0, 12.0) for b in (0.0, 3.0) for h in (False, True)]
    shares = [(r, b, h, (0.8 if r < 5 else 0.2) * (1.0 if b < 1 else 0.0) * (0.5 if h else 1.0)) for r, b, h in places]
    looks, cells = looked_at(shares, 1000)
    p = looks.detection()[0][tuple(cells.T)]
    np.testing.assert_allclose(p, [share for *_, share in shares], atol=0.01)


def test_a_miss_counts_by_the_share_that_is_seen_there_against_where_most_is_seen() -> None:
    looks, cells = looked_at([(3.0, 0.0, False, 0.8), (12.0, 0.0, False, 0.1)], 1000)
    q = (0.8 * 0.8 + 0.1 * 0.1) / 0.9  # the mean of what is seen
    expected = [1.0, math.log(1 - 0.1) / math.log(1 - q)]  # at most as much as where most is seen
    np.testing.assert_allclose(looks.weights(cells), expected, rtol=0.01)
    assert looks.log_miss == pytest.approx(math.log(1 - q), rel=0.01)
    before = looks.weights(cells)
    looks.taken = AGAIN + 1
    looks.count(cells, np.array([True, True]))
    np.testing.assert_array_equal(looks.weights(cells), before)  # they are estimated again after eight looks


def test_what_is_seen_always_is_taken_to_be_seen_by_98_percent() -> None:
    looks, cells = looked_at([(3.0, 0.0, False, 1.0), (12.0, 0.0, False, 0.0)], 1000)
    near, far = looks.weights(cells)
    assert near == pytest.approx(1.0)
    assert looks.log_miss == pytest.approx(math.log(1 - MOST))
    assert 0.0 < far < 0.001


def test_without_anything_seen_a_miss_counts_in_full() -> None:
    cells, looks = cells_of(np.array([3.0]), np.zeros(1), np.zeros(1, bool), np.ones(1, bool)), Looks(taken=AGAIN)
    looks.count(cells, np.array([False]))
    np.testing.assert_array_equal(looks.weights(cells), [1.0])


def test_arrays_of_another_shape_are_refused() -> None:
    looks = looked(POSE)
    looks.restored()
    for damaged in (replace(looks, counts=looks.counts[:, 1:]), replace(looks, table=looks.table[1:])):
        with pytest.raises(MapError, match="the counts of looks are"):
            damaged.restored()
