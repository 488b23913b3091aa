"""Association does not look at the whole map, and finds what a look at the whole map would find."""

from __future__ import annotations

import numpy as np
import pytest

import kalmark as km
from kalmark.slam.scene import View

SPACING = 2.0
ONCE = km.Upkeep(confirm=1)  # a sighting is a landmark


def garden(side: int) -> np.ndarray:
    """Return landmarks (side^2, 2) about 2 m from each other."""
    rng = np.random.default_rng(0)
    grid = np.stack(np.meshgrid(np.arange(side), np.arange(side)), -1).reshape(-1, 2)
    return grid * SPACING + rng.uniform(-0.4, 0.4, (side * side, 2))


def driven(map_: str, steps: int = 150, side: int = 12) -> tuple[km.Slam, list[list[tuple[str, object]]], int]:
    """Map a garden by nearest neighbour; return the slam, what it said, and how many landmarks are really there."""
    rng, points = np.random.default_rng(1), garden(side)
    lidar = km.Mount(km.sensors.RangeBearing(0.02, 0.01))
    start = np.array([side, SPACING, 0.0])
    robot = km.Robot("r", km.motion.Odometry2D(0.005, 0.005, 0.002), start=start, sensors={"lidar": lidar})
    slam, truth, said, seen = km.Slam([robot], km.association.NearestNeighbour(), map=map_), start, [], set()
    for t in range(steps):
        u = np.array([0.4, 0.0, 2 * np.pi / 75])
        truth = km.geometry.compose(truth, u)[0]
        near = np.flatnonzero(np.linalg.norm(points - truth[:2], axis=1) < 5.0)
        seen |= set(near.tolist())
        y = km.geometry.observe(truth, points[near])[0] + rng.normal(size=(len(near), 2)) * [0.02, 0.01]
        slam.process(km.Control(t, "r", u + rng.normal(size=3) * [0.005, 0.005, 0.002]))
        report = slam.process(km.Scan(t, "r", "lidar", y))
        said.append([(o.outcome, o.landmark) for o in report.observations])
    return slam, said, len(seen)


@pytest.mark.parametrize("map_", ["dense", "postponed"])
def test_the_near_landmarks_are_found_that_a_look_at_the_whole_map_finds(
    map_: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    slam, near, count = driven(map_)
    monkeypatch.setattr(View, "places", lambda *_: None)
    _, whole, _ = driven(map_)
    assert near == whole
    assert len(slam.landmarks()) == count, "a landmark was taken for a new one, or for another"


def test_a_landmark_that_is_only_looked_at_stays_at_rest() -> None:
    rng, points = np.random.default_rng(3), garden(10)
    lidar = km.Mount(km.sensors.RangeBearing(0.02, 0.01))
    robot = km.Robot("r", km.motion.Odometry2D(0.01, 0.01, 0.01), start=(9.0, 9.0, 0.0), sensors={"lidar": lidar})
    slam = km.Slam([robot], km.association.NearestNeighbour(new_gate=0.9999), map="postponed", upkeep=ONCE)
    for i, point in enumerate(points):
        slam.add_landmark(i, point, 1e-4 * np.eye(2))
    slam.map.flush()
    stays = km.Scan(1, "r", "lidar", [[SPACING / 2, 0.3]])  # between the landmarks
    report = slam.process(stays)
    assert report.observations[0].outcome == "new"
    assert {slam.members.names.get(slot) for slot in slam.map._owners} == {None, report.observations[0].landmark}
    y = km.geometry.observe(np.array([9.0, 9.0, 0.0]), points[[44, 45]])[0] + rng.normal(size=(2, 2)) * 0.01
    assert [o.landmark for o in slam.process(km.Scan(2, "r", "lidar", y)).observations] == [44, 45]


def test_a_sensor_that_does_not_tell_where_things_are_could_have_seen_any() -> None:
    robot = km.Robot("r", km.motion.Odometry2D(), sensors={"sonar": km.Mount(km.sensors.Range(0.1))})
    slam = km.Slam([robot], km.association.NearestNeighbour())
    for i in range(20):
        slam.add_landmark(i, (3.0 + i, 0.5), 1e-2 * np.eye(2))
    assert slam.process(km.Scan(1, "r", "sonar", [[17.0]])).observations[0].landmark == 14
