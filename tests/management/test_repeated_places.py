"""A place that was mapped twice is found by its shape; what is built regularly, or at random, is not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hall import hall, mapped, right, slam_of
from repeats import WORLDS, World, empty, part

import kalmark as km
from kalmark.geometry.frames import from_frame
from kalmark.management.repeated_places import FALSE_ALARMS, find_repeats
from kalmark.results.run import Run


def found(slam: km.Slam) -> list[list[tuple[object, object]]]:
    return [each.pairs for each in find_repeats(slam.map, slam.tracks)]


@pytest.mark.parametrize("world", WORLDS.values(), ids=WORLDS.keys())
@pytest.mark.parametrize("seed", range(3))
def test_a_map_without_repeats_has_none(world: World, seed: int) -> None:
    rng, slam = np.random.default_rng(seed), empty()
    part(slam, world(rng), rng)
    assert found(slam) == []


@pytest.mark.parametrize("map_", ["dense", "postponed"])
@pytest.mark.parametrize("share", [1.0, 0.3])
def test_a_place_that_was_mapped_twice_is_found_with_its_shift_and_turn(share: float, map_: str) -> None:
    rng, slam, T = np.random.default_rng(1), empty(map_), np.array([5.0, 3.0, 0.4])
    places = rng.uniform(0, 30, (60, 2))
    again = places[: round(share * len(places))]
    again = places[np.argsort(np.linalg.norm(places - 15.0, axis=1))[: len(again)]]
    true = {tuple(place): name for place, name in zip(places.tolist(), part(slam, places, rng), strict=True)}
    names = part(slam, from_frame(T, again)[0], rng)
    (repeat,) = find_repeats(slam.map, slam.tracks)
    wanted = {(true[tuple(place)], name) for place, name in zip(again.tolist(), names, strict=True)}
    assert {*repeat.pairs} <= wanted
    assert len(repeat.pairs) >= 0.9 * len(wanted)
    np.testing.assert_allclose(repeat.T, T, atol=0.1)
    assert repeat.p < 1e-3 * FALSE_ALARMS
    assert not repeat.agrees, "the map is sure that they are two"
    assert repeat.sure


def test_a_map_is_searched_again_for_repeats_of_its_new_landmarks_only() -> None:
    rng, slam = np.random.default_rng(1), empty()
    places, others = rng.uniform(0, 20, (2, 30, 2))
    for shift in (0.0, 40.0):
        part(slam, places + shift, rng)
    twice = slam.tracks.changes
    for shift in ((0.0, 60.0), (40.0, -60.0)):
        part(slam, others + np.array(shift), rng)
    assert len(found(slam)) == 2
    (repeat,) = find_repeats(slam.map, slam.tracks, twice)
    assert {name for pair in repeat.pairs for name in pair} <= {*list(slam.tracks.confirmed)[60:]}
    assert find_repeats(slam.map, slam.tracks, slam.tracks.changes) == []


def test_a_mirrored_place_is_another_one() -> None:
    rng, slam = np.random.default_rng(1), empty()
    places = rng.uniform(0, 20, (30, 2))
    part(slam, places, rng)
    part(slam, places * np.array([-1.0, 1.0]) - 5.0, rng)
    assert found(slam) == []


def test_landmarks_with_two_ids_are_two() -> None:
    rng, slam = np.random.default_rng(1), empty()
    places = rng.uniform(0, 20, (30, 2))
    names = part(slam, places, rng) + part(slam, places + np.array([25.0, 0.0]), rng)
    assert len(found(slam)) == 1
    slam.tracks.reserve(names)
    assert found(slam) == []


def test_places_of_which_one_has_landmarks_that_the_other_has_not_are_two() -> None:
    rng, slam = np.random.default_rng(1), empty()
    places = rng.uniform(0, 20, (40, 2))
    part(slam, places, rng)
    part(
        slam,
        np.concatenate([places[:12] + np.array([25.0, 0.0]), rng.uniform(0, 20, (28, 2)) + np.array([25.0, 0.0])]),
        rng,
    )
    assert found(slam) == []


@pytest.mark.parametrize(("number", "seed"), [(8, 7), (8, 11), (10, 4)])
def test_places_that_are_only_alike_are_two(number: int, seed: int) -> None:
    """A symmetric circuit: one half has the shape of the other to .2 m, hardly likelier of one place than of two."""
    rng, slam = np.random.default_rng(seed), empty()
    half = rng.uniform(0, 20, (number, 2))
    part(slam, rng.uniform(0, 20, (20, 2)) + np.array([60.0, 0.0]), rng)
    part(slam, half, rng)
    part(slam, -half - 5.0 + 0.2 * rng.normal(size=half.shape), rng)
    assert found(slam) == []


@pytest.mark.usefixtures("never_found")
def test_a_hall_mapped_twice_is_reported_with_its_time_and_drawn(tmp_path: Path) -> None:
    run = mapped(hall(1, gap_s=4.0), gaps="ignore")
    summary = run.evaluate()
    (repeat,), (gap,) = summary["repeats"], summary["gaps"]
    assert len(repeat["landmarks"]) >= 22
    assert gap["end_s"] - 0.1 <= repeat["start_s"] < gap["end_s"] + 2.0
    (line,) = [line for line in summary["warnings"] if line.startswith("the map repeats itself: ")]
    assert f"{len(repeat['landmarks'])} landmarks seem to be mapped twice" in line
    run.save(tmp_path)
    again = Run.load(tmp_path)
    assert again.evaluate()["repeats"] == summary["repeats"]
    assert "landmarks mapped twice" in (tmp_path / "report.html").read_text(encoding="utf-8")


def test_a_hall_mapped_once_has_no_repeats() -> None:
    assert mapped(hall(2)).evaluate()["repeats"] == []


def test_a_robot_that_maps_a_hall_again_is_placed_by_its_shape_where_no_two_places_are_alike() -> None:
    log = hall(5, gap_s=4.0)
    run = mapped(log, gaps="ignore", repeats="merge")
    summary = run.evaluate()
    assert right(run, log)
    assert summary["repeats"] == []
    assert summary["nis_per_dof"] < 1.1
    assert "elsewhere" in [gap["kind"] for gap in summary["gaps"]]


@pytest.mark.parametrize("estimator", [km.estimators.Ekf(), km.estimators.Fej()], ids=["ekf", "fej"])
@pytest.mark.parametrize("map_", ["dense", "postponed"])
def test_a_repeat_is_merged_in_every_map_by_every_estimator(estimator: km.estimators.Estimator, map_: str) -> None:
    log = hall(2, gap_s=4.0)
    run = mapped(log, gaps="ignore", repeats="merge", estimator=estimator, map=map_)
    assert right(run, log)


@pytest.mark.usefixtures("never_found")
def test_a_report_has_the_repeats_that_are_not_merged() -> None:
    log = hall(0, gap_s=4.0)
    slam = slam_of(log, gaps="ignore", upkeep=km.Upkeep(repeats="warn"))
    told = [repeat for event in log.events for repeat in slam.process(event).repeats]
    assert any(repeat.sure for repeat in told)
    assert len(slam.landmarks()) == 48


def test_a_filter_that_places_a_robot_by_a_shape_resumes_bit_for_bit(tmp_path: Path) -> None:
    log = hall(0, gap_s=4.0)
    few = len(log.events) // 4
    slams = [slam_of(log, gaps="ignore", upkeep=km.Upkeep(repeats="merge"))]
    for event in log.events[:few]:
        slams[0].process(event)
    slams[0].save(tmp_path / "map.kmk")
    slams.append(km.Slam.load(tmp_path / "map.kmk"))
    told = [[slam.process(event).gaps for event in log.events[few:]] for slam in slams]
    assert told[0] == told[1]
    assert "elsewhere" in [gap.kind for gaps in told[0] for gap in gaps]
    assert len(slams[0].landmarks()) == 24
    np.testing.assert_array_equal(slams[0].covariance("rover"), slams[1].covariance("rover"))
