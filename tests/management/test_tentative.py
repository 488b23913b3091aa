"""A landmark without an id is tentative until it was observed several times, and does not pull the pose before."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import kalmark as km
from kalmark.errors import ModelError

METHODS = (
    km.association.NearestNeighbour(),
    km.association.GlobalAssignment(),
    km.association.JointCompatibility(),
)
TREES = np.array([[6.0, 1.0], [7.0, -3.0], [4.0, 4.0], [9.0, 2.0], [3.0, -4.0]])


def orchard(
    association: object = METHODS[1], map_: str = "auto", upkeep: km.Upkeep | None = None, **sensor: float
) -> km.Slam:
    lidar = km.Mount(km.sensors.RangeBearing(0.05, 0.01, **sensor), upkeep=upkeep)
    cart = km.Robot("cart", km.motion.Odometry2D(0.02, 0.02, 0.01), sensors={"lidar": lidar})
    return km.Slam([cart], association, map=map_)  # type: ignore[arg-type]


def drive(
    slam: km.Slam, steps: range, clutter: float = 0.0, seed: int = 0
) -> list[tuple[list[tuple[str, int | str | None]], list[bool]]]:
    """Drive slowly ahead; return for each scan what became of each observation, and which were clutter."""
    told = []
    for t in steps:
        rng = np.random.default_rng([seed, t])
        truth = np.array([0.1 * t, 0.0, 0.0])
        slam.process(km.Control(t, "cart", np.array([0.1, 0.0, 0.0]) + rng.normal(size=3) * [0.02, 0.02, 0.01]))
        seen = TREES[rng.random(len(TREES)) < 0.9]
        y = km.geometry.observe(truth, seen)[0] + rng.normal(size=(len(seen), 2)) * [0.05, 0.01]
        false = rng.uniform([1.0, -3.0], [15.0, 3.0], (rng.poisson(clutter), 2))
        report = slam.process(km.Scan(t, "cart", "lidar", np.concatenate([y, false])))
        told.append(([(o.outcome, o.landmark) for o in report.observations], [False] * len(y) + [True] * len(false)))
    return told


def test_a_landmark_is_one_when_it_has_been_seen_three_times() -> None:
    slam = orchard()
    outcomes = []
    for t in range(4):
        report = slam.process(km.Scan(t, "cart", "lidar", [[5.0, 0.2]]))
        outcomes.append((report.observations[0].outcome, report.observations[0].landmark))
        assert slam.landmarks().ids == ([] if t < 2 else ["u1"])
    assert outcomes == [("tentative", "u1"), ("tentative", "u1"), ("new", "u1"), ("associated", "u1")]


@pytest.mark.parametrize("map_", ["dense", "postponed"])
def test_a_tentative_landmark_does_not_pull_the_pose(map_: str) -> None:
    slam, blind = orchard(map_=map_), orchard(map_=map_)
    for t in range(2):
        for each in (slam, blind):
            each.process(km.Control(t, "cart", (0.5, 0.0, 0.1)))
        y = km.geometry.observe(slam.mean("cart"), TREES[:3])[0] + 0.03 * t
        assert {o.outcome for o in slam.process(km.Scan(t, "cart", "lidar", y)).observations} == {"tentative"}
    np.testing.assert_array_equal(slam.mean("cart"), blind.mean("cart"))
    np.testing.assert_array_equal(slam.covariance("cart"), blind.covariance("cart"))


def test_no_observation_is_counted_twice() -> None:
    """The covariance is what two observations tell, the first one and the one that confirmed it."""
    slam, plain = orchard(), orchard()
    y = [[[5.0, 0.2]], [[5.04, 0.21]], [[4.97, 0.19]]]
    for t, each in enumerate(y):
        slam.process(km.Scan(t, "cart", "lidar", each))
        if t != 1:
            plain.process(km.Scan(t, "cart", "lidar", each, ids=["u1"]))
    np.testing.assert_array_equal(slam.covariance("cart", "u1"), plain.covariance("cart", "u1"))
    np.testing.assert_array_equal(slam.mean("u1"), plain.mean("u1"))


def test_what_is_seen_once_is_dropped_with_its_reason() -> None:
    slam = orchard(upkeep=km.Upkeep(confirm=2, within=3))
    slam.process(km.Scan(0, "cart", "lidar", [[5.0, 0.2]]))
    reports = [slam.process(km.Scan(t, "cart", "lidar", ())) for t in (1, 2)]
    assert [r.removed for r in reports] == [(), (("u1", "tentative: seen in 1 of 3 scans"),)]
    assert slam.map.covariance([slam.slot("cart")]).shape == (3, 3)
    assert sum(space is not None for space in slam.map.spaces) == 1, "its block is gone"


def test_out_of_view_it_may_be_unseen() -> None:
    slam = orchard(upkeep=km.Upkeep(confirm=2, within=3), fov_rad=np.pi, range_max_m=10.0)
    slam.process(km.Scan(0, "cart", "lidar", [[1.0, 0.0]]))
    slam.process(km.Control(1, "cart", (3.0, 0.0, 0.0)))
    for t in range(1, 6):  # behind the robot
        assert slam.process(km.Scan(t, "cart", "lidar", ())).removed == ()
    slam.process(km.Control(7, "cart", (-3.0, 0.0, 0.0)))
    report = slam.process(km.Scan(7, "cart", "lidar", [[1.0, 0.0]]))
    assert report.observations[0].outcome == "new"


@pytest.mark.parametrize("association", METHODS, ids=lambda m: type(m).__name__)
def test_clutter_does_not_get_into_the_map(association: object) -> None:
    slam = orchard(association)
    told = drive(slam, range(60), clutter=1.0)
    false = [outcome for said, wrong in told for (outcome, _), is_ in zip(said, wrong, strict=True) if is_]
    assert len(false) > 40
    assert sum(outcome in ("tentative", "ignored", "rejected") for outcome in false) >= 0.95 * len(false)
    assert len(slam.landmarks()) == len(TREES)
    found = np.array(slam.landmarks().means)
    assert np.linalg.norm(found[:, None] - TREES, axis=2).min(axis=1).max() < 0.3
    once = orchard(association, upkeep=km.Upkeep(confirm=1))
    drive(once, range(60), clutter=1.0)
    assert len(once.landmarks()) > 2 * len(TREES), "without it there is much that is not there"


def test_a_known_id_is_a_landmark_at_once_beside_observations_without_one() -> None:
    slam = orchard()
    report = slam.process(km.Scan(0, "cart", "lidar", [[5.0, 0.2], [7.0, -0.4]], ids=[17, None]))
    assert [(o.outcome, o.landmark) for o in report.observations] == [("new", 17), ("tentative", "u1")]


@pytest.mark.parametrize("by", ["scan", "survey"])
def test_a_tentative_landmark_gives_way_to_one_that_is_called_like_it(by: str, tmp_path: Path) -> None:
    slam = orchard()
    for t in range(5):
        slam.process(km.Scan(t, "cart", "lidar", [[5.0, 0.2]]))
        if t == 1 and by == "survey":
            slam.add_landmark("u1", [-7.0, 7.0], 0.01 * np.eye(2))
        elif t >= 1 and by == "scan":
            slam.process(km.Scan(t, "cart", "lidar", [[9.9, 2.356]], ids=["u1"]))
    assert sorted(slam.landmarks().ids) == ["u1", "u2"]
    np.testing.assert_allclose(slam.mean("u1"), [-7.0, 7.0], atol=0.02)
    np.testing.assert_allclose(slam.mean("u2"), 5.0 * np.array([np.cos(0.2), np.sin(0.2)]), atol=0.02)
    slam.save(tmp_path / "map.kmk")
    assert km.Slam.load(tmp_path / "map.kmk").landmarks().ids == slam.landmarks().ids


@pytest.mark.parametrize("map_", ["dense", "postponed"])
def test_tentative_landmarks_are_saved(map_: str, tmp_path: Path) -> None:
    straight = orchard(map_=map_, upkeep=km.Upkeep(confirm=3, within=7))
    drive(straight, range(2), clutter=1.0)
    assert straight.tracks.tentative
    straight.save(tmp_path / "map.kmk")
    resumed = km.Slam.load(tmp_path / "map.kmk")
    assert drive(straight, range(2, 20), clutter=1.0) == drive(resumed, range(2, 20), clutter=1.0)
    assert straight.landmarks().ids == resumed.landmarks().ids
    everything = ["cart", *straight.landmarks().ids]
    np.testing.assert_array_equal(straight.covariance(*everything), resumed.covariance(*everything))
    for name in everything:
        np.testing.assert_array_equal(straight.mean(name), resumed.mean(name))


def test_a_bad_setting_is_refused() -> None:
    with pytest.raises(ModelError, match="Upkeep: confirm is 0, expected a whole number of at least 1"):
        km.Upkeep(confirm=0)
    with pytest.raises(ModelError, match="Upkeep: within is 2, expected at least confirm, 3"):
        km.Upkeep(within=2)


# ---------------------------------------------------------------------- existence
SIGHT = {"fov_rad": np.pi, "range_max_m": 20.0}
WATCHED = km.Upkeep(p_detect=0.9)


def watch(slam: km.Slam, trees: np.ndarray, steps: range) -> list[tuple[object, str]]:
    removed = []
    for t in steps:
        rng = np.random.default_rng([7, t])
        y = km.geometry.observe(np.zeros(3), trees)[0] + rng.normal(size=(len(trees), 2)) * [0.05, 0.01]
        removed += slam.process(km.Scan(t, "cart", "lidar", y)).removed
    return removed


@pytest.mark.parametrize("map_", ["dense", "postponed"])
def test_a_tree_that_was_felled_is_removed_with_its_reason_and_the_others_stay(map_: str) -> None:
    slam = orchard(map_=map_, upkeep=WATCHED, **SIGHT)
    assert watch(slam, TREES, range(10)) == []
    (gone, why), *more = watch(slam, TREES[1:], range(10, 40))
    assert more == []
    assert why == "should be in view and was not seen, 5 scans in a row"
    assert gone not in slam.landmarks().ids
    assert len(slam.landmarks()) == len(TREES) - 1
    never = orchard(map_=map_, **SIGHT)
    assert watch(never, TREES, range(10)) + watch(never, TREES[1:], range(10, 40)) == []


def test_what_is_out_of_view_or_hidden_is_not_missed() -> None:
    slam = orchard(upkeep=WATCHED, fov_rad=1.0, range_max_m=20.0)
    trees = np.array([[6.0, 1.0], [12.0, 2.05], [5.0, -1.0]])  # the second one stands behind the first
    watch(slam, trees, range(6))
    assert watch(slam, trees[[0, 2]], range(6, 40)) == []
    slam.process(km.Control(40, "cart", (0.0, 0.0, np.pi)))
    for t in range(40, 60):  # looking the other way
        assert slam.process(km.Scan(t, "cart", "lidar", ())).removed == ()
    assert len(slam.landmarks()) == 3


def test_how_long_a_landmark_was_missed_is_saved(tmp_path: Path) -> None:
    slam = orchard(upkeep=WATCHED, **SIGHT)
    watch(slam, TREES, range(6))
    watch(slam, TREES[1:], range(6, 9))
    slam.save(tmp_path / "map.kmk")
    again = km.Slam.load(tmp_path / "map.kmk")
    told = watch(slam, TREES[1:], range(9, 20))
    assert told == watch(again, TREES[1:], range(9, 20))
    assert len(told) == 1


def test_the_probabilities_must_tell() -> None:
    with pytest.raises(ModelError, match=r"p_detect is 0.04, expected a probability between p_false, 0.05, and 1"):
        km.Upkeep(p_detect=0.04)
