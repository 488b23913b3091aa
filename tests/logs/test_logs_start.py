"""Where a robot truly is when its log begins."""

from __future__ import annotations

import numpy as np
import pytest

import kalmark as km
from kalmark.config.true_start import true_start
from kalmark.events import Control, Event, Scan
from kalmark.logs import Log, Trajectory
from kalmark.logs.log import begins_at

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
    log = log_of([*INCREMENTS], [0, 1, 2], [[5, 6, 0], [7, 6, np.pi / 2], [7, 7, np.pi / 2]])
    start, cov = true_start(log, "r", km.motion.Odometry2D())
    assert start == pytest.approx([5, 6, 0]) and cov is None
    log.events[:] = [Control(1.0, "r", (2.0, 0.0))]
    assert true_start(log, "r", km.motion.Unicycle())[0] == pytest.approx([7, 6, np.pi / 2])


@pytest.mark.parametrize(("begins", "poses"), [(1, [[7, 6, np.pi / 2], [7, 7, np.pi / 2]]), (2, [[7, 7, np.pi / 2]])])
def test_a_truth_that_begins_later_is_taken_back_by_the_increments(begins: int, poses: list[list[float]]) -> None:
    log = log_of(INCREMENTS, [*range(begins, 3)], poses)
    start, cov = true_start(log, "r", km.motion.Odometry2D())
    assert start == pytest.approx([5, 6, 0])
    assert cov is not None and np.linalg.eigvalsh(cov)[0] > -1e-12 and cov[2, 2] > 0


def test_a_truth_that_begins_later_is_taken_back_along_the_arcs_of_a_unicycle() -> None:
    """By half of the second control; its sigmas are those of a speed and a turn rate held so long, there and back."""
    motion = km.motion.Unicycle(sigma_v_mps=0.1, sigma_w_radps=0.2)
    events: list[Event] = [Control(0.0, "r", (1.0, 0.0)), Control(1.0, "r", (np.pi, np.pi)), Control(2.0, "r", (9, 9))]
    log = log_of(events, [1, 3], [[0, 0, 0]] * 2)
    log.truth["r"] = Trajectory(np.array([SECOND * 3 // 2, 3 * SECOND]), np.array([[4.0, 1.0, np.pi / 2], [9, 9, 0]]))
    start, cov = true_start(log, "r", motion)
    assert start == pytest.approx([2, 0, 0]) and cov is not None
    assert cov[2, 2] == pytest.approx((0.2 * 1.0) ** 2 + (0.2 * 0.5) ** 2)


def test_a_truth_that_begins_later_is_taken_back_in_space() -> None:
    up = [0.0, 0.0, 0.0, 1.0]
    log = log_of([Control(0.0, "r", (1.0, 0, 0, 0, 0, 0))], [2, 3], [[5.0, 6, 7, *up], [6, 6, 7, *up]])
    start, cov = true_start(log, "r", km.motion.Velocity3D())
    assert start == pytest.approx([3, 6, 7, *up]) and cov is not None and cov.shape == (6, 6)


def test_a_robot_without_a_true_pose_or_controls_to_it_has_no_true_start() -> None:
    log = log_of(INCREMENTS, [5, 6], [[7, 6, 0], [7, 7, 0]])
    assert true_start(log, "r", km.motion.Odometry2D()) == (None, None)
    assert true_start(log, "r", km.motion.ConstantVelocity()) == (None, None)
    assert true_start(log, "other", km.motion.Odometry2D()) == (None, None)
