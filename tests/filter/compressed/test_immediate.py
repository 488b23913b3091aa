"""A correction that turns the world leaves what is inactive where the dense filter would have it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import kalmark as km
from kalmark.filter.compressed import immediate
from kalmark.filter.compressed.compressed_map import CompressedMap
from kalmark.filter.map import StochasticMap

WORLD = np.column_stack([np.arange(0.0, 40.0, 2.0), np.tile([1.5, -1.5], 10)])


def robot_of(cov: Any) -> km.Robot:
    """Return a robot that sees landmarks well and drives straight ahead."""
    lidar = km.Mount(km.sensors.RangeBearing(0.02, 0.005, range_max_m=4.0))
    return km.Robot("r", km.motion.Odometry2D(0.01, 0.0, 0.002), sensors={"lidar": lidar}, cov=cov)


def passes(slam: km.Slam, most: int | None) -> km.Slam:
    """Drive 20 m among WORLD from an uncertain start, learning then by two fixes where that was, turned by .2 rad."""
    if most is not None:
        slam.state.map = CompressedMap.from_dense(slam.map, most=most)
    rng, truth = np.random.default_rng(4), np.zeros(3)
    for t in range(1, 101):
        u = np.array([0.2, 0.0, 0.0])
        truth = km.geometry.compose(truth, u)[0]
        slam.process(km.Control(float(t), "r", u))
        near = np.flatnonzero(np.hypot(*(WORLD - truth[:2]).T) < 4.0)
        y = km.geometry.observe(truth, WORLD[near])[0] + rng.normal(size=(len(near), 2)) * [0.02, 0.005]
        slam.process(km.Scan(float(t), "r", "lidar", y, near.tolist()))
        if t in (1, 100):
            slam.process(km.Fix(float(t), "r", km.geometry.rotation(0.2) @ truth[:2], np.eye(2) * 1e-4))
    return slam


@pytest.mark.parametrize("most", [25, 60])
def test_landmarks_inactive_turn_with_a_large_correction_as_in_the_dense_map(most: int) -> None:
    cov = np.diag([5.0, 5.0, 0.15]) ** 2
    dense = passes(km.Slam([robot_of(cov)], km.association.ByIdentity("off"), map="dense"), None)
    compressed = passes(km.Slam([robot_of(cov)], km.association.ByIdentity("off"), map="dense"), most)
    assert isinstance(compressed.map, CompressedMap)
    off = [np.abs(dense.mean(i) - compressed.mean(i)).max() for i in ("r", *dense.landmarks().ids)]
    assert max(off) < 1e-3, "they are known from each other to 2 cm"
    turned = WORLD @ km.geometry.rotation(0.2).T
    wrong = [np.linalg.norm(compressed.mean(i) - turned[i]) for i in compressed.landmarks().ids]
    assert max(wrong) < 0.15


def test_immediate_corrections_do_not_pile_up_in_an_interval(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(immediate.Points, "parted", lambda *_: True)
    cov, intervals = np.diag([5.0, 5.0, 0.15]) ** 2, []
    for most in (20, 2):
        monkeypatch.setattr(immediate, "MOST", most)
        slam = passes(km.Slam([robot_of(cov)], km.association.ByIdentity("off"), map="dense"), 25)
        assert isinstance(slam.map, CompressedMap)
        intervals.append(slam.map.interval)
        assert len(slam.map._immediate.rows) < most or slam.map._job is not None
    assert intervals[1] > intervals[0] > 1


def test_where_nothing_is_inactive_no_correction_is_immediate() -> None:
    cov = np.diag([5.0, 5.0, 0.15]) ** 2
    slam = passes(km.Slam([robot_of(cov)], km.association.ByIdentity("off"), map="dense"), 200)
    assert isinstance(slam.map, CompressedMap)
    assert not slam.map._immediate
    assert slam.map.interval == 1


def test_a_correction_is_judged_by_what_it_separates_and_not_by_how_far_it_goes() -> None:
    map_ = StochasticMap()
    robot = map_.add(km.geometry.SE2, [3.0, 1.0, 0.1], np.diag([2.0, 2.0, 0.1]) ** 2)
    rows = map_.index(robot)
    point = map_.augment(km.landmarks.Point2D().space, np.array([4.0, 1.0]), rows, np.eye(2, 3), np.eye(2) * 0.01**2)
    straight, turned, little = np.array([0.0, 1.0, 0.1]), np.array([0.0, 1.0, 0.3]), np.array([2.999, 1.0, 0.101])
    points = immediate.Points()
    told = [points.parted(map_, robot, np.concatenate([before, map_.x[3:]])) for before in (straight, turned, little)]
    assert told == [False, True, False], "3 m without a turn part nothing, 3 m and .2 rad .3 m, 1 mm and 1 mrad .5 um"
    map_.remove(point)
    points.reset()
    assert not points.parted(map_, robot, np.concatenate([turned, map_.x[3:]])), "nothing is known from the robot"


def test_a_map_that_remembers_an_immediate_correction_and_a_removal_can_be_saved_and_resumes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cov = np.diag([5.0, 5.0, 0.15]) ** 2
    slam = passes(km.Slam([robot_of(cov)], km.association.ByIdentity("off"), map="dense"), 25)
    assert isinstance(slam.map, CompressedMap)
    monkeypatch.setattr(immediate.Points, "parted", lambda *_: True)
    monkeypatch.setattr(CompressedMap, "_far", lambda *_: False)
    seen = [slam.landmarks().ids[-1], slam.landmarks().ids[0]]
    for t in (101.0, 102.0):
        y = km.geometry.observe(slam.mean("r"), np.array([slam.mean(name) for name in seen]))[0] + [0.01, 0.002]
        slam.process(km.Scan(t, "r", "lidar", y, seen))
    assert slam.map._immediate
    slam.remove(seen.pop())
    assert slam.map.departed, "its auxiliary state is still needed"
    slam.save(tmp_path / "map.kmk")
    again = km.Slam.load(tmp_path / "map.kmk")
    for each in (slam, again):
        each.add_landmark("new", [3.0, 4.0], np.zeros((2, 2)))
        each.process(km.Scan(103.0, "r", "lidar", y[:1], seen))
    names = ["r", *slam.landmarks().ids]
    assert again.landmarks().ids == slam.landmarks().ids
    for name in names:
        np.testing.assert_array_equal(again.mean(name), slam.mean(name))
    np.testing.assert_array_equal(again.covariance(*names), slam.covariance(*names))
