"""Density of landmarks, in space and per measurement, and what follows from it for pairs and loops."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import kalmark as km
from kalmark.association.posterior import Posterior, posterior
from kalmark.association.query import Candidates, Query
from kalmark.config import build_slam
from kalmark.geometry.gaussian import gate
from kalmark.geometry.landmark_density import log_ball, log_density, log_volume_change
from kalmark.logs.formats import hide_ids
from kalmark.simulate import load_world, simulate
from kalmark.tracks.track import Tracks


def test_the_density_of_a_poisson_process_is_found_in_plane_and_space() -> None:
    rng = np.random.default_rng(1)
    for d, side in ((2, 60.0), (3, 16.0)):
        points = rng.uniform(-side / 2, side / 2, (2000, d))
        places = rng.uniform(-side / 4, side / 4, (400, d))
        gaps = np.sort(np.linalg.norm(places[:, None] - points, axis=2), axis=1)
        found, true = np.exp(log_density(gaps, 1.0, d)), 2000 / side**d
        assert np.median(found) == pytest.approx(1.09 * true, rel=0.1)  # 4 over the median of Gamma(4)


def test_a_landmark_without_others_has_the_space_from_where_it_was_seen() -> None:
    assert np.exp(log_density(np.zeros((1, 0)), 5.0, 2)) == pytest.approx(1 / (np.pi * 25))
    assert np.exp(log_density(np.array([[2.0]]), 5.0, 2)) == pytest.approx(1 / (np.pi * 4))
    assert np.exp(log_ball(3)) == pytest.approx(4 / 3 * np.pi)


def test_a_volume_of_ranges_and_bearings_is_as_large_in_the_plane_as_the_range_says() -> None:
    y, R = np.array([[7.0, 0.4], [20.0, -1.0]]), np.diag([0.05, 0.01]) ** 2
    V_y = km.sensors.RangeBearing(0.05, 0.01).invert(y)[1]
    V = V_y @ R @ V_y.swapaxes(1, 2)
    np.testing.assert_allclose(log_volume_change(V, np.tile(R, (2, 1, 1))), np.log(y[:, 0]))
    R3 = np.zeros((2, 3, 3))
    R3[:, :2, :2], R3[:, 2, 2] = R, 0.3**2  # a range rate determines no place
    np.testing.assert_allclose(
        log_volume_change(V, R3), np.log(y[:, 0]) - np.log(0.3 * np.sqrt(2 * np.pi)), rtol=1e-9
    )  # fmt: skip


ROAD = np.array([[4.0 * k, 5.0 if k % 2 else -5.0] for k in range(-4, 4)])


def asked(sigmas: np.ndarray, sigma_m: float) -> tuple[Candidates, np.ndarray]:
    """Return posts along a road, known to `sigma_m`, and the d2 of what is seen of the two ahead from near there."""
    kept: list[Any] = []

    class Asks(km.association.GlobalAssignment):
        def associate(self, query: Query) -> list[Any]:
            names = query.candidates(8, np.inf)
            kept.append((query.together(names), query.distances(names)))
            return [(None, "")] * len(query.y)

    mount = km.Mount(km.sensors.RangeBearing(0.05, 0.01))
    robot = km.Robot("r", km.motion.Odometry2D(), cov=np.diag(sigmas**2), sensors={"s": mount})
    slam = km.Slam([robot], Asks())
    for i, post in enumerate(ROAD):
        slam.add_landmark(i, post, sigma_m**2 * np.eye(2))
    slam.process(km.Scan(1, "r", "s", km.geometry.observe(np.array([0.3, 0.2, 0.01]), ROAD[5:7])[0]))
    together, d2 = kept[0]
    return together, d2


def test_the_density_is_that_of_the_places_whatever_is_known_of_them() -> None:
    rows = np.arange(2)
    sharp, _ = asked(np.array([1e-3, 1e-3, 1e-4]), 1e-3)
    loose, _ = asked(np.array([2.0, 2.0, 0.1]), 0.5)
    np.testing.assert_allclose(sharp.log_density(rows), loose.log_density(rows), atol=1e-2)
    p = np.array([4.0, 5.0]) - [0.3, 0.2]  # where the first seems to be
    reach = np.sort(np.linalg.norm(ROAD - p, axis=1))[4]
    expected = np.log(4 / (np.pi * reach**2) * np.linalg.norm(p))
    assert sharp.log_density(rows)[0] == pytest.approx(expected, abs=0.1)


def weighed(experience: float, just: bool) -> tuple[Posterior, np.ndarray]:
    """Return the matchings of two observations by a robot that is known to a metre; `just`: of landmarks just seen."""
    together, d2 = asked(np.array([1.0, 1.0, 0.05]), 0.01)
    seen = np.full(d2.shape, just)
    search = 2, 0.99, 100_000, experience
    return posterior(together, np.arange(2), d2, d2 <= gate(0.99, 2), seen, *search), seen


def test_observations_of_landmarks_just_seen_make_more_of_them_likely_and_say_nothing_about_older_ones() -> None:
    neither, old = weighed(0.0, just=False)
    tracked, _ = weighed(30.0, just=False)
    assert tracked.none() == pytest.approx(neither.none()), "what is tracked says nothing about older ones"
    again, just = weighed(30.0, just=True)
    assert (again.none() < neither.none() / 5).all()
    assert neither.again(old) == 0.0
    assert 1.9 < again.again(just) <= 2.0


def test_experience_is_forgotten_where_something_is_learned_and_only_there() -> None:
    tracks = Tracks(["r"])
    tracks.count_reobserved(2.0)
    tracks.count_reobserved(0.0)
    assert tracks.experience == 2.0
    tracks.count_reobserved(1.0)
    assert tracks.experience == pytest.approx(2.8)


def test_a_scan_teaches_how_many_of_its_observations_were_of_landmarks_just_seen() -> None:
    mount = km.Mount(km.sensors.RangeBearing(0.05, 0.01))
    slam = km.Slam([km.Robot("r", km.motion.Odometry2D(), cov=1e-8 * np.eye(3), sensors={"s": mount})],
                   km.association.Automatic())  # fmt: skip
    slam.add_landmark("sharp", [5.0, 0.0], 1e-6 * np.eye(2))
    slam.add_landmark("loose", [0.0, 8.0], 0.3**2 * np.eye(2))
    posts = np.array([[5.0, 0.0], [0.0, 8.0], [-9.0, 0.0]])
    slam.process(km.Scan(1, "r", "s", km.geometry.observe(np.zeros(3), posts)[0]))
    assert slam.state.tracks.experience == pytest.approx(1.0, abs=0.1)


def test_the_only_old_landmark_in_a_gate_is_weighed_against_a_new_one_where_others_were_just_seen() -> None:
    mount = km.Mount(km.sensors.RangeBearing(0.05, 0.01))
    outcomes = {}
    for off_m in (0.2, 1.7):  # d2 .07 and 5
        slam = km.Slam([km.Robot("r", km.motion.Odometry2D(), cov=1e-8 * np.eye(3), sensors={"s": mount})],
                       km.association.Automatic())  # fmt: skip
        for i, place in enumerate([[10.0, 9.0], [10.0, -9.0], [-3.0, 6.0], [-3.0, -6.0]]):
            slam.add_landmark(i, place, 1e-6 * np.eye(2))
        slam.add_landmark("old", [8.0, 0.0], 0.75**2 * np.eye(2))
        y = km.geometry.observe(np.zeros(3), np.array([[10.0, 9.0], [8.0 + off_m, 0.0]]))[0]
        outcomes[off_m] = [o.outcome for o in slam.process(km.Scan(1, "r", "s", y)).observations]
    assert outcomes == {0.2: ["associated", "associated"], 1.7: ["associated", "deferred"]}


@pytest.mark.parametrize("seed", [2, 5])
def test_a_ring_road_without_ids_closes_and_no_pair_is_wrong(seed: int) -> None:
    world = load_world("ring_road", ["ids=true"])
    log = hide_ids(simulate(world, seed))
    summary = km.record(build_slam(world.config(), log), log, progress=False, pictures=False).evaluate()
    assert summary["wrong"] == summary["duplicates"] == 0
    assert 53 <= summary["landmarks"] <= 56
    assert summary["landmark_rmse_m"] < 0.7
    assert summary["robots"]["car"]["pose_nees"] < 8.0
