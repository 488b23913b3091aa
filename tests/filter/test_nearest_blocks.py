"""Landmarks near a place: the same, wherever the map keeps them."""

from __future__ import annotations

import numpy as np
import pytest

import kalmark as km
from kalmark.filter.compressed.compressed_map import CompressedMap
from kalmark.filter.map import Pairs
from kalmark.filter.nearest_blocks import distances, nearest_pairs


def field(map_: str) -> tuple[km.Slam, np.ndarray]:
    """Return 400 surveyed landmarks, of which a robot has seen some; in a compressed map the others are inactive."""
    rng = np.random.default_rng(0)
    points = rng.uniform(0, 40, (400, 2))
    robot = km.Robot("r", km.motion.Odometry2D(), sensors={"s": km.Mount(km.sensors.RangeBearing())})
    slam = km.Slam([robot], map=map_)
    for i, p in enumerate(points):
        slam.add_landmark(i, p, 0.01 * np.eye(2))
    if isinstance(slam.map, CompressedMap):
        slam.map.full_update()
    near = np.argsort(np.linalg.norm(points, axis=1))[:20].tolist()
    for t in range(3):
        slam.process(km.Scan(t, "r", "s", km.geometry.observe(np.zeros(3), points[near])[0], near))
    return slam, points


def pairs(slam: km.Slam, p: np.ndarray, nearest: int, farther: float) -> Pairs:
    """Return the landmarks near places."""
    sorts = slam.tracks.sorts_of(frozenset({"point"}), len(slam.map.blocks))
    return slam.map.pairs(sorts, slam.slot("r"), -1, p, nearest, farther)


@pytest.mark.parametrize("map_", ["dense", "postponed"])
def test_the_nearest_are_found_active_or_inactive(map_: str) -> None:
    slam, _ = field(map_)
    p = np.array([[3.0, 4.0], [20.0, 20.0], [np.nan, 0.0], [39.0, 1.0]])
    found = pairs(slam, p, 4, 3.0)
    names = [slam.tracks.names[slot] for slot in found.slots[found.numbers].tolist()]
    means = np.array([slam.mean(i) for i in range(400)])
    for k in range(len(p)):
        gaps = np.linalg.norm(means - p[k], axis=1)
        near = [i for i in np.argsort(gaps)[:4].tolist() if gaps[i] <= 3.0 * gaps.min()]
        assert {names[m] for m in np.flatnonzero(found.rows == k)} == set(near)
    np.testing.assert_allclose(found.places[found.numbers], means[names], atol=1e-12)
    m, robot, mount, here = found.marginal or (None, 0, 0, np.zeros(0))
    assert m is not None and mount == -1
    np.testing.assert_allclose(m.means(here, 2), found.places, atol=1e-12)
    for slot, at in zip(found.slots.tolist(), here.tolist(), strict=True):
        wanted = slam.map.covariance([slam.slot("r"), slot])
        np.testing.assert_allclose(m.covariance([robot, at]), wanted, atol=1e-12)
    gaps = np.linalg.norm(means - p[1], axis=1)
    sorts = slam.tracks.sorts_of(frozenset({"point"}), len(slam.map.blocks))
    around = [slam.tracks.names[slot] for slot in slam.map.around(sorts, p[1], 30).tolist()]
    assert around == np.argsort(gaps)[:30].tolist()


@pytest.mark.parametrize("nearest", [1, 3, 30, 50])
def test_the_least_of_each_row_are_told(nearest: int) -> None:
    rng = np.random.default_rng(1)
    p, places = rng.uniform(0, 9, (5, 3)), rng.uniform(0, 9, (40, 3))
    gaps = np.linalg.norm(p[:, None] - places, axis=2)
    np.testing.assert_allclose(distances(p, places), gaps)
    rows, numbers, used = nearest_pairs(p, places, nearest, 2.0)
    columns = used[numbers]
    for k in range(5):
        wanted = [i for i in np.argsort(gaps[k])[:nearest].tolist() if gaps[k, i] <= 2.0 * gaps[k].min()]
        assert sorted(columns[rows == k].tolist()) == sorted(wanted)


def test_without_landmarks_none_is_near() -> None:
    assert not any(len(found) for found in nearest_pairs(np.zeros((3, 2)), np.zeros((0, 2)), 4, 10.0))


@pytest.mark.parametrize("slots", [[5, 0], [0, 399, 5, 200], [300, 301], [7, 7, 250]])
def test_covariances_of_active_and_inactive_blocks_are_the_dense_ones(slots: list[int]) -> None:
    (dense, _), (compressed, _) = field("dense"), field("postponed")
    pairs = [(slam.map.covariance([slam.slot(i) for i in slots])) for slam in (dense, compressed)]
    np.testing.assert_allclose(pairs[1], pairs[0], rtol=1e-9, atol=1e-12)


def test_slots_are_told_by_the_kind_of_their_landmark() -> None:
    slam = km.Slam([km.Robot("r", km.motion.Odometry2D(), sensors={"s": km.Mount(km.sensors.RangeBearing())})])
    for i in range(200):
        slam.add_landmark(i, (float(i), 0.0), 0.01 * np.eye(2))
        slots = np.array([slam.slot("r"), -1, slam.slot(i), slam.slot(i) + 1, slam.slot(0)])
        sort_at, wanted = slam.tracks.sorts_of(frozenset({"point"}), len(slam.map.blocks) + 1)
        assert wanted[sort_at[slots]].tolist() == [False, False, True, False, True]
    slam.remove(7)
    sort_at, wanted = slam.tracks.sorts_of(frozenset({"point"}), 0)
    assert not wanted[sort_at[8]]


@pytest.mark.parametrize("association", [km.association.NearestNeighbour(), km.association.Automatic()])
def test_what_is_seen_without_ids_is_told_alike_in_both_maps(association: km.association.Association) -> None:
    runs = []
    for map_ in ("dense", "postponed"):
        rng = np.random.default_rng(2)
        points = 2.0 * np.stack(np.meshgrid(np.arange(9), np.arange(9)), -1).reshape(-1, 2) + rng.uniform(
            0, 0.8, (81, 2)
        )
        sensor, motion = km.sensors.RangeBearing(0.05, 0.01), km.motion.Odometry2D(0.01, 0.0, 0.01)
        robot = km.Robot("r", motion, sensors={"s": km.Mount(sensor)})
        slam, pose, run = km.Slam([robot], association, km.estimators.Ekf(), map=map_), np.zeros(3), []
        if isinstance(slam.map, CompressedMap):
            slam.map.most = 40
        for t in range(200):
            u = np.array([0.4, 0.0, (-1) ** (t // 50) * np.pi / 8 if t % 50 in range(36, 44) else 0.0])
            pose = km.geometry.compose(pose, u)[0]
            near = points[np.linalg.norm(points - pose[:2], axis=1) < 3.5]
            y = km.geometry.observe(pose, near)[0] + rng.normal(size=near.shape) * (0.05, 0.01)
            slam.process(km.Control(t, "r", u + rng.normal(size=3) * (0.01, 0.0, 0.01)))
            run.append(slam.process(km.Scan(t, "r", "s", y)))
        runs.append(run)
        assert not isinstance(slam.map, CompressedMap) or slam.map.interval > 10
    for dense, compressed in zip(*runs, strict=True):
        assert [(o.outcome, o.landmark) for o in dense.observations] == [
            (o.outcome, o.landmark) for o in compressed.observations
        ]
        told = [{(c.index, c.landmark): c.d2 for c in report.candidates} for report in (dense, compressed)]
        assert told[0] == pytest.approx(told[1], rel=1e-6)


def test_many_inactive_ones_are_found_but_not_read_jointly() -> None:
    slam, points = field("postponed")
    p = np.array([[20.0, 20.0]])
    found = pairs(slam, p, 60, np.inf)
    wanted = np.argsort(np.linalg.norm(points - p, axis=1))[:60]
    assert {slam.tracks.names[slot] for slot in found.slots.tolist()} == set(wanted.tolist())
    assert found.marginal is None
