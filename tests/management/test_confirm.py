"""Confirmation: observations of tentative landmarks are kept with their poses, and fused when one is confirmed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import kalmark as km
from kalmark.filter.compressed.compressed_map import CompressedMap

WORLD = np.random.default_rng(3).uniform([-2, -3], [22, 3], (40, 2))
KEEPS = km.Upkeep(confirm=5, within=10, keep_poses=20)


def slam_of(upkeep: km.Upkeep, view_m: float = 4.0) -> km.Slam:
    """Return a Slam of a robot that is not told which landmark is which."""
    camera = km.Mount(km.sensors.Position2D(0.03, 0.03, range_max_m=view_m))
    robot = km.Robot("r", km.motion.Odometry2D(0.02, 0.02, 0.01), sensors={"camera": camera})
    return km.Slam([robot], km.association.GlobalAssignment(), upkeep=upkeep, map="dense")


def drive(
    steps: int, seed: int = 0, hidden: bool = True, spurious: bool = False, view_m: float = 4.0
) -> tuple[list[Any], np.ndarray]:
    """Return the events of a robot that goes straight ahead, and where it ends; with ids if not `hidden`."""
    rng, truth, events = np.random.default_rng(seed), np.zeros(3), []
    for t in range(1, steps + 1):
        u = np.array([0.15, 0.0, 0.0])
        truth = km.geometry.compose(truth, u)[0]
        events.append(km.Control(float(t), "r", u + rng.normal(size=3) * [0.02, 0.02, 0.01]))
        near = np.flatnonzero(np.hypot(*(WORLD - truth[:2]).T) < view_m - 0.1)
        y = km.geometry.to_frame(truth, WORLD[near])[0] + rng.normal(size=(len(near), 2)) * 0.03
        if spurious:  # a mark that wanders
            y, near = np.vstack([y, rng.uniform(1.0, 2.5, 2)]), np.append(near, 99)
        events.append(km.Scan(float(t), "r", "camera", y, None if hidden else near.tolist()))
    return events, truth


def run(slam: km.Slam, events: list[Any]) -> list[Any]:
    """Process events and return the reports."""
    return [slam.process(event) for event in events]


def nearest(slam: km.Slam, p: np.ndarray) -> Any:
    """Return the landmark nearest to a place."""
    return min(slam.landmarks().ids, key=lambda name: float(np.linalg.norm(slam.mean(name) - p)))


@pytest.mark.parametrize("postponed", [False, True])
def test_a_map_that_waited_is_that_of_one_that_was_told_from_the_start(postponed: bool) -> None:
    told, figures = slam_of(KEEPS), {}
    run(told, drive(14, hidden=False, view_m=30.0)[0])
    P = told.covariance("r")
    for poses in (20, 0):
        slam = slam_of(km.Upkeep(confirm=12, within=14, keep_poses=poses), view_m=30.0)
        if postponed:
            slam.state.map = CompressedMap.from_dense(slam.map, most=60)
        run(slam, drive(14, view_m=30.0)[0])
        e = slam.mean("r") - told.mean("r")
        worse = [np.trace(C) / np.trace(told.covariance(nearest(told, p))) for _, _, p, C, _ in slam.landmarks()]
        figures[poses] = float(np.median(worse)), float(e @ np.linalg.solve(P, e))
    assert figures[20][0] == pytest.approx(1.0, abs=0.005)
    assert figures[20][1] < 0.05, "a tenth of a sigma: it is linearised later"
    assert figures[0][0] > 1.02, "the observations between the first and the last are lost"


def test_poses_stay_honest_with_observations_that_were_kept() -> None:
    nees = []
    for seed in range(20):
        slam, (events, truth) = slam_of(KEEPS), drive(60, seed)
        run(slam, events)
        e = slam.mean("r") - truth
        nees.append(float(e @ np.linalg.solve(slam.covariance("r"), e)))
    assert 1.5 < np.mean(nees) < 5.0, "3 is consistent"


def test_what_is_tentative_does_not_pull_the_pose() -> None:
    slam = slam_of(KEEPS)
    alone = slam_of(KEEPS)
    for event in drive(4)[0]:
        slam.process(event)
        if isinstance(event, km.Control):
            alone.process(event)
    assert not slam.landmarks().ids
    np.testing.assert_allclose(slam.mean("r"), alone.mean("r"), atol=1e-12)
    np.testing.assert_allclose(slam.covariance("r"), alone.covariance("r"), atol=1e-12)


def test_poses_are_removed_when_nothing_waits_and_when_they_are_too_many() -> None:
    slam, (events, _) = slam_of(km.Upkeep(confirm=5, within=10, keep_poses=3)), drive(60, spurious=True)
    most = 0
    for event in events:
        slam.process(event)
        poses = slam.clones.of(("r", "camera"))
        kept = {m.clone for track in slam.tracks.tentative.values() for m in track.measurements}
        assert kept == set(poses), "no pose without an observation, no observation without its pose"
        most = max(most, len(poses))
    assert most == 3


def test_a_report_says_what_was_fused_late_and_the_run_counts_it() -> None:
    slam, (events, _) = slam_of(KEEPS), drive(30)
    late = [one for report in run(slam, events) for one in report.late]
    assert len(late) == len(set(late)) == 4 * len(slam.landmarks().ids), "all but the confirming one"
    recorded = km.record(slam_of(KEEPS), events, progress=False, pictures=False)
    assert recorded.history.late.sum() == len(late)
    assert set(recorded.history.outcome[recorded.history.late]) == {"tentative"}


def test_what_is_kept_resumes_bit_for_bit(tmp_path: Path) -> None:
    slam, (events, _) = slam_of(KEEPS), drive(40)
    run(slam, events[:27])
    assert any(track.measurements for track in slam.tracks.tentative.values())
    slam.save(tmp_path / "map.kmk")
    again = km.Slam.load(tmp_path / "map.kmk")
    run(slam, events[27:])
    run(again, events[27:])
    names = ("r", *slam.landmarks().ids)
    assert again.landmarks().ids == slam.landmarks().ids
    assert np.array_equal(slam.covariance(*names), again.covariance(*names))
    assert all(np.array_equal(slam.mean(name), again.mean(name)) for name in names)


def test_a_wrong_number_of_poses_is_refused() -> None:
    with pytest.raises(km.KalmarkError, match="keep_poses is -1, expected a whole number of at least 0"):
        km.Upkeep(keep_poses=-1)
