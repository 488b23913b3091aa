"""A landmark with an id that an outlier began is begun again where later observations have it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import kalmark as km
from kalmark.arrays import Array
from kalmark.geometry import SE3
from kalmark.geometry.frames3d import compose, inverse
from kalmark.slam.tentative import ELSEWHERE

PLACES = {1: (3.0, 1.0), 2: (4.0, -2.0), 3: (6.0, 2.0), 4: (5.0, -3.0), 5: (7.0, 0.5), 6: (2.0, 2.5)}
SIGMAS = np.array([0.05, 0.01])
MISSES = np.array([[-1.5, 0.4]])  # of an outlier
GATED: dict[str, Any] = {"association": km.association.ByIdentity(gate=0.9999)}
WAYS = [{"robust": "student"}, {"robust": "huber"}, GATED]


def slam_of(sensor: Any = None, **how: Any) -> km.Slam:
    sensor = sensor or km.sensors.RangeBearing(*SIGMAS)
    return km.Slam([km.Robot("r", km.motion.Unicycle(0.02, 0.01), sensors={"l": km.Mount(sensor, **how)})])


def drive(slam: km.Slam, steps: int, wrong: dict[tuple[int, int], Array], moved: Any = (), seed: int = 1) -> list[Any]:
    """Drive straight on and look at all landmarks, `wrong` by step and id; return what was removed, and when."""
    rng, pose, removed = np.random.default_rng(seed), np.zeros(3), []
    first = 0 if slam.t_ns is None else round(slam.t_ns * 1e-9 / 0.2)
    for k in range(first + steps):
        pose = km.motion.Unicycle().move(pose, np.array([0.2, 0.0]), 0.2)[0]
        noise = rng.normal(size=(len(PLACES), 2)) * SIGMAS
        if k < first:
            continue
        slam.process(km.Control(0.2 * k, "r", (0.2, 0.0)))
        places = PLACES | dict(moved[1] if moved and k >= moved[0] else ())
        y = km.geometry.observe(pose, np.array([*places.values()]))[0] + noise
        for row, name in enumerate(places):
            y[row] += wrong.get((k, name), np.zeros((1, 2)))[0]
        report = slam.process(km.Scan(0.2 * (k + 1), "r", "l", y, [*places]))
        removed += [(name, why, k) for name, why in report.removed]
    return removed


def errors(slam: km.Slam) -> dict[int, float]:
    return {name: float(np.linalg.norm(slam.mean(name) - place)) for name, place in PLACES.items()}


@pytest.mark.parametrize("how", WAYS, ids=["student", "huber", "gate"])
@pytest.mark.parametrize("wrong", [[5], [3, 5]])
def test_an_outlier_at_first_sight_costs_three_observations(how: dict[str, Any], wrong: list[int]) -> None:
    slam = slam_of(**how)
    removed = drive(slam, 20, {(0, name): MISSES for name in wrong})
    assert sorted(removed) == [(name, ELSEWHERE, 3) for name in wrong]
    assert max(errors(slam).values()) < 0.15
    assert not slam.state.tracks.tentative
    assert np.linalg.norm(slam.mean("r")[:2] - (0.8, 0.0)) < 0.1


@pytest.mark.parametrize("how", WAYS, ids=["student", "huber", "gate"])
def test_outliers_later_begin_nothing(how: dict[str, Any]) -> None:
    slam, rng = slam_of(**how), np.random.default_rng(0)
    wrong = {(k, int(name)): MISSES * rng.uniform(0.5, 1.5) for k in range(2, 30) for name in rng.choice([*PLACES], 1)}
    assert drive(slam, 32, wrong) == []
    assert max(errors(slam).values()) < 0.15
    assert not slam.state.tracks.tentative


def test_a_landmark_that_was_moved_is_where_most_of_its_observations_have_it() -> None:
    there = {5: (5.5, -0.6)}
    slam = slam_of(**GATED)
    assert drive(slam, 25, {}, (15, there)) == []
    assert errors(slam)[5] < 0.15
    slam = slam_of(**GATED)
    assert [what[:2] for what in drive(slam, 40, {}, (10, there))] == [(5, ELSEWHERE)]
    assert np.linalg.norm(slam.mean(5) - there[5]) < 0.15


def test_a_robot_that_was_carried_away_moves_no_landmark() -> None:
    slam = slam_of(**GATED)
    drive(slam, 5, {})
    moving = slam.state.moving["r"]
    slam.state.map.set_predicted(moving.slot, slam.mean("r") + np.array([1.0, -2.0, 0.3]))
    assert drive(slam, 20, {}) == []


def test_what_is_contested_is_saved_and_resumes_bit_for_bit(tmp_path: Path) -> None:
    slam = slam_of(**GATED)
    drive(slam, 3, {(0, 5): MISSES})
    (rival,) = slam.state.tracks.tentative.values()
    assert (rival.of, rival.hits) == (5, 2)
    slam.save(tmp_path / "map.kmk")
    again = km.Slam.load(tmp_path / "map.kmk")
    assert [drive(one, 5, {}) for one in (slam, again)] == [[(5, ELSEWHERE, 3)]] * 2
    for name in ("r", *PLACES):
        np.testing.assert_array_equal(slam.mean(name), again.mean(name))
        np.testing.assert_array_equal(slam.covariance(name), again.covariance(name))


@pytest.mark.parametrize("how", WAYS[::2], ids=["student", "gate"])
def test_a_tag_that_an_outlier_began_is_begun_again(how: dict[str, Any]) -> None:
    sensor = km.sensors.TagPose()
    mount = km.Mount(sensor, np.eye(7)[6], **how)
    slam = km.Slam([km.Robot("r", km.motion.Odometry3D(0.01, 0.01, 0.01, 0.01), sensors={"l": mount})])
    rng, pose = np.random.default_rng(1), np.eye(7)[6]
    tags = {i: SE3.plus(np.eye(7)[6], np.array([3.0, i - 1.0, 0.5, 0.1 * i, 0.2, 0.0])) for i in range(3)}
    step, removed = np.array([0.05, 0.0, 0.0, 0.0, 0.0, 0.02]), []
    for k in range(12):
        pose = SE3.plus(pose, step) if k else pose
        slam.process(km.Control(k, "r", step if k else np.zeros(6)))
        seen = [compose(inverse(pose)[0], tag)[0] for tag in tags.values()]
        y = np.array([SE3.plus(T, 0.02 * rng.normal(size=6)) for T in seen])
        if k == 0:
            y[1, :3] += 1.0
        removed += slam.process(km.Scan(k, "r", "l", y, [*tags])).removed
    assert removed == [(1, ELSEWHERE)]
    assert np.linalg.norm(slam.mean(1)[:3] - tags[1][:3]) < 0.15
