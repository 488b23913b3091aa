"""A place that was mapped twice is found by its shape; what is built regularly, or at random, is not."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hall import hall, mapped

import kalmark as km
from kalmark.geometry.frames import from_frame
from kalmark.management.repeats import FALSE_ALARMS, repeats
from kalmark.results.run import Run

REACH_M, SIGMA_M = 8.0, 0.03
World = Callable[[np.random.Generator], np.ndarray]


def part(slam: km.Slam, places: np.ndarray, rng: np.random.Generator) -> list[str]:
    """Map places (N, 2) as if observed from everywhere among them; return their names."""
    first = len(slam.landmarks())
    names = [f"u{first + i + 1}" for i in range(len(places))]
    for name, place in zip(names, places + SIGMA_M * rng.normal(size=places.shape), strict=True):
        slam.add_landmark(name, place, SIGMA_M**2 * np.eye(2))
    slam.tracks.reserved.clear()  # as if all had been made up
    low, high = places.min(axis=0), places.max(axis=0)
    for pose in rng.uniform(low, high, (int(np.prod((high - low) / REACH_M * 2)) + 10, 2)):
        slam.tracks.note_scan([names[i] for i in np.flatnonzero(np.linalg.norm(places - pose, axis=1) < REACH_M)])
    return names


def empty(map_: str = "dense") -> km.Slam:
    laser = {"laser": km.Mount(km.sensors.RangeBearing(0.03, 0.01))}
    return km.Slam(km.Robot("cart", km.motion.Odometry2D(), sensors=laser), map=map_)


def found(slam: km.Slam) -> list[list[tuple[object, object]]]:
    return [each.pairs for each in repeats(slam.map, slam.tracks)]


def orchard(columns: int, rows: int, off_m: float, gone: float) -> World:
    def trees(rng: np.random.Generator) -> np.ndarray:
        places = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).reshape(-1, 2) * (4.0, 3.0)
        places = places[rng.random(len(places)) >= gone]
        return places + off_m * rng.normal(size=places.shape)

    return trees


def clusters(rng: np.random.Generator) -> np.ndarray:
    return (rng.uniform(0, 60, (12, 1, 2)) + 1.5 * rng.normal(size=(12, 8, 2))).reshape(-1, 2)


def pallets(rng: np.random.Generator) -> np.ndarray:
    feet = np.array([[-0.6, -0.4], [0.6, -0.4], [0.6, 0.4], [-0.6, 0.4]])
    return (rng.uniform(0, 60, (30, 1, 2)) + feet).reshape(-1, 2)


WORLDS: dict[str, World] = {
    "at random": lambda rng: rng.uniform(0, 40, (120, 2)),
    "many at random": lambda rng: rng.uniform(0, 120, (800, 2)),
    "an orchard": orchard(12, 8, 0.0, 0.0),
    "an orchard with trees off their places": orchard(12, 8, 0.1, 0.0),
    "an orchard with gaps": orchard(14, 10, 0.05, 0.1),
    "an orchard with many gaps": orchard(14, 10, 0.05, 0.3),
    "an avenue": orchard(40, 2, 0.05, 0.1),
    "clusters": clusters,
    "pallets": pallets,
}


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
    (repeat,) = repeats(slam.map, slam.tracks)
    wanted = {(true[tuple(place)], name) for place, name in zip(again.tolist(), names, strict=True)}
    assert {*repeat.pairs} <= wanted
    assert len(repeat.pairs) >= 0.9 * len(wanted)
    np.testing.assert_allclose(repeat.T, T, atol=0.1)
    assert repeat.p < 1e-3 * FALSE_ALARMS
    assert not repeat.agrees, "the map is sure that they are two"
    assert not repeat.rivals


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


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_hall_mapped_twice_is_reported_with_its_time_and_drawn(seed: int, tmp_path: Path) -> None:
    run = mapped(hall(seed, gap_s=4.0), gaps="ignore")
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
    for seed in range(3):
        assert mapped(hall(seed)).evaluate()["repeats"] == []
