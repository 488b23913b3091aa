"""What is ambiguous is held back; two landmarks that turn out to be one are merged."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import kalmark as km
from garden import GARDEN, look, slam_of
from kalmark.association.ratio import doubtful_pairs, log_ratios
from kalmark.errors import MapError
from kalmark.management import merge
from kalmark.tracks.track import Tracks

ESTIMATORS = [km.estimators.Ekf(), km.estimators.Invariant()]  # for `Fej` the first estimates must be good


def carried_off(
    slam: km.Slam, points: np.ndarray = GARDEN, sigma: float = 1.0, off: float = 0.8
) -> tuple[km.Slam, list[km.Report]]:
    """Map the garden, lose the way by less than is believed, and look at some of it again."""
    for t in range(6):
        look(slam, t, GARDEN)
    assert len(slam.landmarks()) == len(GARDEN)
    cov = np.diag([sigma, sigma, 0.05]) ** 2
    slam.process(km.Control(6, "cart", (off, -off, 0.03), cov))
    return slam, [look(slam, t, points) for t in range(7, 20)]


def test_what_pairs_gain_depends_on_those_before_them() -> None:
    shift, own = 4.0 * np.eye(2), 1e-3 * np.eye(2)  # two pairs whose pose error is common
    Z = np.kron(np.ones((2, 2)), shift) + np.kron(np.eye(2), own)
    found = log_ratios(np.array([[1.0, 1.0], [1.02, 1.0]]), Z, np.log([0.5, 0.5]))
    assert found.order == [0, 1]
    told = found.ratio
    assert told[0] < 0, "the first tells nothing"
    assert told[1] > 2, "the second that it fits the first"
    alone = -0.5 * 2 / 4.001 - np.log(4.001) - np.log(2 * np.pi) - np.log(0.5)
    assert told[0] == pytest.approx(alone)
    assert doubtful_pairs(found, 0, 1e3) == [0, 1]
    assert doubtful_pairs(found, 0, 2.0) == []


def test_one_observation_of_a_place_long_unseen_is_held_back_and_several_together_are_not() -> None:
    _, reports = carried_off(slam_of(), GARDEN[:1])
    first = reports[0].observations[0]
    assert first.outcome == "deferred"
    assert "or a new landmark: the odds are" in first.reason
    _, reports = carried_off(slam_of(), GARDEN[:5], sigma=0.5, off=0.1)
    assert {o.outcome for o in reports[0].observations} == {"associated"}


def test_what_is_held_back_does_not_pull_the_pose() -> None:
    slam = slam_of()
    for t in range(6):
        look(slam, t, GARDEN)
    slam.process(km.Control(6, "cart", (0.8, -0.8, 0.03), np.diag([1.0, 1.0, 0.05]) ** 2))
    slam.process(km.Scan(6, "cart", "lidar", ()))
    before = slam.mean("cart"), slam.covariance("cart")
    look(slam, 7, GARDEN[:1])
    np.testing.assert_array_equal(slam.mean("cart"), before[0])
    np.testing.assert_array_equal(slam.covariance("cart"), before[1])


@pytest.mark.parametrize("estimator", ESTIMATORS, ids=lambda e: type(e).__name__)
def test_a_robot_that_has_lost_its_way_is_found_before_it_maps_a_garden_twice(estimator: object) -> None:
    slam, _ = carried_off(slam_of(estimator), sigma=3.0, off=2.5)
    assert len(slam.landmarks()) == len(GARDEN)
    assert np.linalg.norm(slam.mean("cart")) < 0.2


@pytest.mark.usefixtures("never_found")
@pytest.mark.parametrize("map_", ["dense", "postponed"])
@pytest.mark.parametrize("estimator", ESTIMATORS, ids=lambda e: type(e).__name__)
def test_a_garden_mapped_twice_becomes_one(estimator: object, map_: str) -> None:
    slam, reports = carried_off(slam_of(estimator, map_), sigma=3.0, off=2.5)
    merged = [m for r in reports for m in r.merged]
    assert all(reason.startswith(f"merged into {kept!r}: d2 ") for _, kept, reason in merged)
    table = slam.landmarks()
    assert len(table) == len(GARDEN)
    assert merged
    assert {gone for gone, _, _ in merged}.isdisjoint(table.ids)
    assert np.linalg.norm(slam.mean("cart")) < 0.2, "the robot has found its way again"
    gaps = np.linalg.norm(np.array(table.means)[:, None] - GARDEN, axis=2).min(axis=1)
    assert gaps.max() < 0.2
    sigma = np.sqrt([np.trace(P) / 2 for P in table.covariances])
    assert sigma.max() < 0.1


def test_landmarks_that_were_seen_in_one_scan_are_never_merged() -> None:
    slam = slam_of()
    pair = np.array([[4.0, 0.0], [4.3, 0.0]])  # within each other's gates, if the bearing were the only clue
    for t in range(40):
        report = look(slam, t, pair)
        assert report.merged == ()
    assert len(slam.landmarks()) == 2


@pytest.mark.usefixtures("never_found")
def test_a_merge_resumes_bit_for_bit(tmp_path: Path) -> None:
    slam = slam_of(confirm=2)
    for t in range(6):
        look(slam, t, GARDEN)
    slam.process(km.Control(6, "cart", (2.5, -2.5, 0.03), np.diag([3.0, 3.0, 0.05]) ** 2))
    for t in range(7, 10):
        look(slam, t, GARDEN)
    slam.save(tmp_path / "map.kmk")
    again = km.Slam.load(tmp_path / "map.kmk")
    told = [[look(each, t, GARDEN).merged for t in range(10, 20)] for each in (slam, again)]
    assert told[0] == told[1]
    assert any(told[0])
    everything = ["cart", *slam.landmarks().ids]
    np.testing.assert_array_equal(slam.covariance(*everything), again.covariance(*everything))


def test_a_landmark_seen_without_any_other_may_still_be_one_of_the_map() -> None:
    slam = slam_of()
    for name, x in (("u1", 5.0), ("u2", 5.05)):
        slam.add_landmark(name, [x, 0.0], 0.01 * np.eye(2))
        slam.tracks.confirmed[name].covisible = {name}
    slam.tracks.recent = ["u2"]
    slam.tracks.reserved.clear()  # as if both had been made up
    assert may_be(slam, "u2") == [[("u2", "u1")]]


def may_be(slam: km.Slam, name: Any) -> list[list[merge.Pair]]:
    """Return what a landmark and others may be."""
    look = merge._Reading(slam.map, slam.tracks, slam.slot("cart"), 2, merge.EQUAL_M)
    return list(merge._hypotheses(look, name, slam.mean(name)))


def named_again(slam: km.Slam) -> list[str]:
    """Map the garden without ids, then by ids in scans that also show something without one."""
    for t in range(6):
        look(slam, t, GARDEN)
    ids = [f"tree{i}" for i in range(len(GARDEN))]
    y = km.geometry.observe(np.zeros(3), np.vstack([GARDEN, [-5.0, -5.0]]))[0]
    for t in range(6, 9):
        slam.process(km.Scan(t, "cart", "lidar", y, ids=[*ids, None]))
    assert set(ids) < set(slam.landmarks().ids)
    return ids


@pytest.mark.parametrize("map_", ["dense", "postponed"])
def test_a_landmark_with_an_id_of_the_log_keeps_it_when_it_is_merged(map_: str) -> None:
    slam = slam_of(km.estimators.Invariant(), map_)
    ids = named_again(slam)
    merged = [pair for t in range(10, 40) for pair in look(slam, t, GARDEN).merged]
    assert {kept for _, kept, _ in merged} == set(ids)
    assert {gone for gone, _, _ in merged}.isdisjoint(ids)
    y = km.geometry.observe(np.zeros(3), GARDEN)[0]
    report = slam.process(km.Scan(40, "cart", "lidar", y, ids=ids))
    assert {o.outcome for o in report.observations} == {"associated"}


def test_two_ids_of_the_log_are_two_landmarks_wherever_they_are() -> None:
    slam = slam_of()
    for t, ids in ((0, [1, None]), (1, [2, None])):
        slam.process(km.Scan(t, "cart", "lidar", [[5.0, 0.1], [6.0, 1.5]], ids=ids))
    assert may_be(slam, 2) == []
    slam.add_landmark("u9", slam.mean(1), 0.01 * np.eye(2))
    slam.tracks.confirmed["u9"].covisible = {"u9"}
    assert may_be(slam, 2) == [], "a survey gave it that name"
    slam.tracks.reserved.clear()
    assert {pair for pairs in may_be(slam, 2) for pair in pairs} == {(2, "u9")}


def seen(slam: km.Slam, t: int, y: list[list[float]], ids: list[Any]) -> list[tuple[str, Any]]:
    report = slam.process(km.Scan(t, "cart", "lidar", y, ids))
    return [(o.outcome, o.landmark) for o in report.observations]


def test_an_id_of_the_log_is_never_taken_for_a_name_made_up(tmp_path: Path) -> None:
    slam = slam_of(confirm=1)
    assert seen(slam, 0, [[5.0, 0.1]], ["u1"]) == [("new", "u1")]
    assert seen(slam, 1, [[6.0, 1.5], [7.0, -1.5]], ["u3", None]) == [("new", "u3"), ("new", "u2")]
    slam.remove("u3")
    assert seen(slam, 2, [[7.0, 2.5]], [None]) == [("new", "u4")], "u3 may come again"
    slam.save(tmp_path / "map.kmk")
    for one in (slam, km.Slam.load(tmp_path / "map.kmk")):
        assert [one.tracks.is_invented(name) for name in ("u1", "u2", "u3", "u4", 1, "tree")] == [
            False, True, False, True, False, False,
        ]  # fmt: skip
        at = km.geometry.scan(one.mean("u2")[:2])[0]
        assert seen(one, 3, [at], ["u2"]) == [("associated", "u2")], "whoever feeds it may use its names"
        assert seen(one, 3, [[6.0, 1.5], [9.0, 0.5]], ["u3", None]) == [("new", "u3"), ("new", "u5")]


def test_a_run_makes_up_no_name_that_comes_later_in_its_log() -> None:
    slam = slam_of(confirm=1)
    events = [km.Scan(t, "cart", "lidar", [[5.0, 0.1 * t]], [i]) for t, i in ((0, None), (20, "u1"), (21, "u1"))]
    km.record(slam, events, progress=False, pictures=False)
    assert slam.landmarks().ids == ["u2", "u1"]


def test_in_a_full_map_nothing_is_merged_and_nothing_lost(tmp_path: Path) -> None:
    slam = slam_of(km.estimators.Invariant(), "postponed")
    named_again(slam)
    slam.map.storage.limit_bytes = slam.map.storage.nbytes  # type: ignore[union-attr]
    for i in range(1000):
        try:
            slam.add_landmark(f"far{i}", [1000.0 + i, 0.0], np.zeros((2, 2)))
        except MapError:
            break
    before = slam.landmarks().ids
    for t in range(10, 40):
        report = look(slam, t, GARDEN)
        assert report.merged == ()
        assert len(report.observations) == len(GARDEN)
    assert slam.landmarks().ids == before
    slam.save(tmp_path / "map.kmk")
    assert km.Slam.load(tmp_path / "map.kmk").landmarks().ids == before


def test_a_landmark_given_again_by_hand_does_not_disturb_the_merging_of_others() -> None:
    slam = slam_of(km.estimators.Invariant())
    ids = named_again(slam)
    mean, cov = slam.mean(ids[0]), slam.covariance(ids[0])
    slam.remove(ids[0])
    slam.add_landmark(ids[0], mean, cov)
    assert any(look(slam, t, GARDEN[1:]).merged for t in range(10, 40))


def test_a_landmark_is_looked_at_again_where_something_is_new_and_ever_less_often_elsewhere(tmp_path: Path) -> None:
    slam, asked = slam_of(), []
    proposed = merge.proposal

    def counted(map_: object, tracks: Tracks, name: Any, *rest: object) -> object:
        asked.append(tracks.confirmed[name].observations)
        return proposed(map_, tracks, name, *rest)  # type: ignore[arg-type]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(merge, "proposal", counted)
        for t in range(100):
            look(slam, t, GARDEN[:1])
            if t == 12:
                slam.add_landmark("far", (100.0, 0.0), 0.01 * np.eye(2))
            if t == 60:
                slam.save(tmp_path / "state.kalmark")
                slam = km.Slam.load(tmp_path / "state.kalmark")
    assert asked == [5, 10, 15, 30, 60]


@pytest.mark.parametrize(("off", "is_one"), [(0.1, True), (1.0, False)])
def test_landmarks_nearer_than_the_covariance_allows_are_one_where_that_is_little_of_their_spacing(
    off: float, is_one: bool
) -> None:
    slam, ring = slam_of(), 5.0 * np.exp(1j * np.arange(6))
    places = [*zip(ring.real, ring.imag, strict=True), (0.0, 0.0), (off, 0.0)]
    names = [f"u{k}" for k in range(1, 9)]
    for name, place in zip(names, places, strict=True):
        slam.add_landmark(name, place, 1e-4 * np.eye(2))
    slam.tracks.reserved.clear()  # as if all had been made up
    slam.tracks.note_scan(names[:7])
    slam.tracks.note_scan([*names[:6], names[7]])
    found = merge.proposal(slam.map, slam.tracks, "u8", slam.slot("cart"), np.zeros(3), 100.0)
    assert (found is not None and found.pairs == [("u8", "u7")]) is is_one
