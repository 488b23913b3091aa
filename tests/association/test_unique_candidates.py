"""Scans whose observations have one candidate each: the associations are those of the general way."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import kalmark as km
from kalmark.association.query import Query
from kalmark.filter.compressed.compressed_map import CompressedMap

START = np.array([2.0, 2.0, 0.3])


def steps(rng: np.random.Generator, marks: np.ndarray, count: int = 300) -> list[tuple[km.Control, km.Scan]]:
    """Return rounds on a ring among landmarks, of which the robot sees those within 3 m."""
    truth, out = START.copy(), []
    for t in range(count):
        u = np.array([0.25, 0.0, 0.25 / 4.0])
        truth = km.geometry.compose(truth, u)[0]
        near = np.flatnonzero(np.linalg.norm(marks - truth[:2], axis=1) < 3.0)
        y = km.geometry.observe(truth, marks[near])[0] + rng.normal(size=(len(near), 2)) * [0.1, 0.03]
        y[:, 0] = np.abs(y[:, 0])
        noisy = u + rng.normal(size=3) * [0.02, 0.005, 0.02]
        out.append((km.Control(float(t), "r", noisy), km.Scan(t + 0.5, "r", "lidar", y)))
    return out


def slam_of(association: Any, map_: str, mount: km.Mount | None = None) -> km.Slam:
    mount = mount or km.Mount(km.sensors.RangeBearing(0.1, 0.03))
    motion = km.motion.Odometry2D(0.02, 0.005, 0.02)
    return km.Slam([km.Robot("r", motion, START, {"lidar": mount})], association=association, map=map_)


MOUNTED = km.Mount(km.sensors.RangeBearing(0.1, 0.03), at=(0.2, 0.0, 0.1), cov=np.diag([0.05, 0.05, 0.02]) ** 2)


@pytest.mark.parametrize("map_", ["dense", "postponed"])
@pytest.mark.parametrize("mount", [None, MOUNTED])
@pytest.mark.parametrize("association", [km.association.NearestNeighbour(), km.association.GlobalAssignment()])
def test_the_answers_are_those_of_all_questions(
    association: Any, mount: km.Mount | None, map_: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(4)
    log = steps(rng, rng.uniform(-6, 10, (90, 2)))
    short, long = slam_of(association, map_, mount), slam_of(association, map_, mount)
    asked, ask = list[bool](), Query.nearest
    for control, scan in log:
        for slam in (short, long):
            slam.process(control)

        def counted(query: Query, *which: Any) -> Any:
            asked.append((found := ask(query, *which)) is not None)
            return found

        monkeypatch.setattr(Query, "nearest", counted)
        one = short.process(scan)
        monkeypatch.setattr(Query, "nearest", lambda *_: None)
        other = long.process(scan)
        assert [o[:4] for o in one.observations] == [o[:4] for o in other.observations]
        near = {(c.index, c.landmark): c.d2 for c in other.candidates}
        for c in one.candidates:
            assert c.d2 == pytest.approx(near.get((c.index, c.landmark), c.d2), rel=1e-6, abs=1e-6)
    assert 50 < sum(asked) < len(asked)
    for name in ("r", *(each.id for each in long.landmarks())):
        assert short.mean(name) == pytest.approx(long.mean(name), abs=1e-8)
        assert short.covariance(name) == pytest.approx(long.covariance(name), abs=1e-9)


def test_a_block_that_is_not_read_and_may_be_nearer_is_read() -> None:
    """Beside the landmark that was seen last stands one that is inactive: what is seen between them asks for both."""
    slam = slam_of(km.association.NearestNeighbour(), "postponed")
    marks = np.array([[4.0, 2.0], [4.3, 2.0], [2.0, 5.0], [5.0, 5.0]])
    for k, mark in enumerate(marks):
        slam.add_landmark(k, mark, 0.01 * np.eye(2))

    def seen(t: float, place: Any, ids: Any = None) -> Any:
        y = km.geometry.observe(slam.mean("r"), np.array([place]))[0]
        return slam.process(km.Scan(t, "r", "lidar", y, ids))

    assert isinstance(slam.map, CompressedMap)
    slam.map.full_update()  # all are inactive,
    seen(1.0, marks[0], [0])  # then all but this one
    assert [o.landmark for o in seen(2.0, [4.28, 2.0]).observations] == [1]


def test_a_landmark_that_is_new_in_its_interval_bounds_nothing() -> None:
    """The robot's drift is in what it maps now, and not in an inactive landmark beside it, which may be nearer."""
    robot = km.Robot(
        "r", km.motion.Odometry2D(0.02, 0.005, 0.02), START, {"lidar": km.Mount(km.sensors.RangeBearing(0.1, 0.03))},
        cov=np.diag([1.0, 1.0, 1e-4]),
    )  # fmt: skip
    slam = km.Slam([robot], association=km.association.NearestNeighbour(), map="postponed")
    slam.add_landmark("old", [4.5, 2.0], 1e-4 * np.eye(2))
    assert isinstance(slam.map, CompressedMap)
    slam.map.full_update()  # it is inactive

    def seen(t: float, place: Any, ids: Any = None) -> Any:
        y = km.geometry.observe(slam.mean("r"), np.array([place]))[0]
        return slam.process(km.Scan(t, "r", "lidar", y, ids))

    seen(1.0, [4.0, 2.0], ["new"])
    assert [o.landmark for o in seen(2.0, [4.2, 2.0]).observations] == ["old"]
