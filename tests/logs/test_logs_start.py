"""Where a robot truly is when its log begins."""

from __future__ import annotations

import numpy as np
import pytest

from kalmark.events import Control, Event, Scan
from kalmark.logs import Log, Trajectory
from kalmark.logs.log import begins_at, true_start

SECOND = 1_000_000_000
INCREMENTS: list[Event] = [Control(1.0, "r", (2.0, 0.0, np.pi / 2)), Control(2.0, "r", (1.0, 0.0, 0.0))]


def log_of(events: list[Event], t_s: list[int], poses: list[list[float]]) -> Log:
    truth = {"r": Trajectory(np.array(t_s) * SECOND, np.array(poses))}
    return Log("test", ("r",), events, truth=truth)


def test_a_velocity_begins_at_its_time_and_an_increment_one_interval_before() -> None:
    assert begins_at(INCREMENTS, "r", held=True) == 1 * SECOND
    assert begins_at(INCREMENTS, "r", held=False) == 0
    assert begins_at([Scan(0.5, "r", "s"), *INCREMENTS], "r", held=False) == SECOND // 2
    assert begins_at(INCREMENTS, "other", held=False) is None


def test_a_robot_starts_at_the_truth_before_its_first_increment() -> None:
    log = log_of(INCREMENTS, [0, 1, 2], [[5, 6, 0], [7, 6, np.pi / 2], [7, 7, np.pi / 2]])
    assert true_start(log, "r", held=False) == pytest.approx([5, 6, 0])
    assert true_start(log, "r", held=True) == pytest.approx([7, 6, np.pi / 2])


def test_a_truth_that_begins_after_the_first_increment_is_taken_back_by_it() -> None:
    log = log_of(INCREMENTS, [1, 2], [[7, 6, np.pi / 2], [7, 7, np.pi / 2]])
    assert true_start(log, "r", held=False) == pytest.approx([5, 6, 0])


def test_a_robot_whose_truth_begins_later_has_no_true_start() -> None:
    log = log_of(INCREMENTS, [2, 3], [[7, 6, 0], [7, 7, 0]])
    assert true_start(log, "r", held=False) is None
    assert true_start(log, "r", held=True) is None
    assert true_start(log, "other", held=True) is None
