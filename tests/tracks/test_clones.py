"""Cloned poses: shared by the channels of one time, kept as long as one of them refers to them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

import kalmark as km
from kalmark.tracks.clones import Clones, Measurement

EYE, RADIO = ("r", "eye"), ("r", "radio")
RANGE = km.sensors.Range(0.1)


def slam_of() -> km.Slam:
    """Return a Slam of a robot with two sensors of ranges on one place."""
    sensors = {name: km.Mount(RANGE) for name in ("eye", "radio")}
    return km.Slam([km.Robot("r", km.motion.Odometry2D(0.01, 0.01, 0.01), sensors=sensors)], map="dense")


def ranges(t: float, sensor: str, i: int, y: float = 5.0) -> km.Scan:
    return km.Scan(t, "r", sensor, [[y]], [i])


def blocks(slam: km.Slam) -> int:
    return sum(space is not None for space in slam.map.spaces)


def test_a_clone_goes_when_the_last_channel_that_refers_to_it_lets_go() -> None:
    clones = Clones()
    numbers = [clones.enter(slot, "r", t) for slot, t in ((7, 0), (8, 10))]
    assert clones.refer(EYE, numbers) == []
    assert clones.refer(RADIO, numbers[:1]) == []
    assert (clones.of(EYE), clones.of(RADIO)) == (numbers, numbers[:1])
    assert clones.refer(EYE, ()) == [8], "the other one is still in use"
    assert clones.users() == [RADIO]
    assert clones.refer(RADIO, ()) == [7]
    assert not clones.clones
    assert clones.enter(7, "r", 20) == 3, "numbers are never used again"


def test_two_channels_share_one_clone_of_one_time() -> None:
    slam = slam_of()
    slam.process(ranges(0.0, "eye", 1))
    slam.process(ranges(0.0, "radio", 2))
    (clone,) = slam.clones.clones.values()
    assert clone.users == {EYE, RADIO}
    assert blocks(slam) == 2, "robot and clone"
    np.testing.assert_array_equal(slam.map.mean(clone.slot), slam.mean("r"))
    slam.process(km.Control(1.0, "r", (1.0, 0.0, 0.0)))
    for sensor, i in (("eye", 1), ("radio", 2)):
        slam.process(ranges(1.0, sensor, i))
    assert len(slam.clones.clones) == 2
    assert blocks(slam) == 3


def test_a_clone_is_not_shared_by_a_robot_that_has_moved_at_the_same_time() -> None:
    slam = slam_of()
    slam.process(ranges(0.0, "eye", 1))
    slam.process(km.Control(0.0, "r", (1.0, 0.0, 0.0)))
    slam.process(ranges(0.0, "radio", 2))
    first, second = (slam.map.mean(clone.slot) for clone in slam.clones.clones.values())
    np.testing.assert_allclose(second - first, [1.0, 0.0, 0.0], atol=1e-12)


def test_a_shared_clone_stays_until_the_landmarks_of_both_channels_have_started() -> None:
    slam, held = slam_of(), list[int]()
    beacons, truth = {1: np.array([6.0, 3.0]), 2: np.array([4.0, -5.0])}, np.zeros(3)
    for t in range(40):
        u = np.array([0.5, 0.0, 0.15])
        truth = km.geometry.compose(truth, u)[0]
        slam.process(km.Control(float(t), "r", u))
        for sensor, i in (("eye", 1), ("radio", 2)):
            if sensor == "eye" or t % 3 == 0:
                slam.process(ranges(float(t), sensor, i, float(np.linalg.norm(beacons[i] - truth[:2]))))
        assert blocks(slam) == 1 + len(slam.landmarks()) + len(slam.clones.clones)
        held.append(len(slam.clones.clones))
    assert set(slam.landmarks().ids) == {1, 2}
    assert max(held) > 3
    assert held[-1] == 0, "nothing is pending"


def test_ranges_of_one_landmark_are_kept_of_one_sensor() -> None:
    slam = slam_of()
    slam.process(ranges(0.0, "eye", 1))
    (seen,) = slam.process(ranges(0.0, "radio", 1)).observations
    assert (seen.outcome, seen.reason) == ("ignored", "another sensor's ranges of it are being kept")
    assert slam.clones.users() == [EYE]


def test_clones_are_saved(tmp_path: Path) -> None:
    slam = slam_of()
    slam.process(ranges(0.0, "eye", 1))
    slam.save(tmp_path / "map.kmk")
    again: Any = km.Slam.load(tmp_path / "map.kmk")
    for one in (slam, again):
        one.process(ranges(0.0, "radio", 2))
        assert len(one.clones.clones) == 1, "the robot has not moved"
    assert [vars(clone) for clone in again.clones.clones.values()] == [vars(c) for c in slam.clones.clones.values()]


def test_the_clone_of_now_is_the_last_one_of_that_time_until_the_robot_moves() -> None:
    clones = Clones()
    assert clones.now("r", 10) is None
    numbers = {name: clones.enter(slot, name, 10) for name, slot in (("r", 7), ("s", 8))}
    assert (clones.now("r", 10), clones.now("s", 10), clones.now("r", 11)) == (numbers["r"], numbers["s"], None)
    assert clones[numbers["s"]] == 8
    clones.forget_current("r")
    assert (clones.now("r", 10), clones.now("s", 10)) == (None, numbers["s"])
    assert clones.refer(EYE, [numbers["r"]]) == [8], "nothing refers to the other one"
    assert clones.now("s", 10) is None


def test_a_measurement_is_named_by_its_place_in_the_log() -> None:
    one = Measurement(3, 10, "r", "eye", 2, np.zeros(1), np.eye(1), False)
    assert one.late == (10, "r", "eye", 2)
