"""A landmark that is not seen again where it should be is marked, or removed; one that is there is not."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import kalmark as km
from kalmark.logs.known_map import read_known
from kalmark.management import existence
from kalmark.results.landmark_table import MapLandmarks
from kalmark.tracks.looks import CELLS, Looks, cells_of
from walkers import WALKER, Field, mapped

STEPS = 600
CLEAN = [
    Field(),
    Field(p_detect=0.5),
    Field(p_detect=0.7, fov_rad=0.5 * math.pi),
    Field(p_detect=0.8, stated=False),
    Field(p_detect=0.6, hides=True),
]


def counted(seen: int, absent: float, missed: float) -> Any:
    return SimpleNamespace(seen=seen, absent=absent, missed=missed)


def test_of_the_landmarks_of_somebody_who_walks_nine_in_ten_are_marked_and_of_the_trees_none() -> None:
    ghosts, trees = list[bool](), list[bool]()
    for seed in range(3):
        field = Field(walks=True)
        log, of = field.log(STEPS, seed)
        slam = field.slam()
        what, table = mapped(slam, log.events, of), slam.landmarks()
        ghosts += [i in table.unseen for i in what if what[i] == WALKER and slam.tracks.confirmed[i].missed > 5.0]
        trees += [i in table.unseen for i in what if what[i] != WALKER]
    assert len(ghosts) >= 10 and np.mean(ghosts) >= 0.9
    assert not any(trees)


def test_of_trees_alone_hardly_any_is_marked_whatever_a_sensor_sees_of_them() -> None:
    marked, all_ = 0, 0
    for seed, field in enumerate(CLEAN):
        log, of = field.log(STEPS, seed)
        slam = field.slam()
        mapped(slam, log.events, of)
        marked, all_ = marked + len(slam.landmarks().unseen), all_ + len(slam.landmarks())
    assert all_ > 150 and marked <= 0.01 * all_


def test_marks_change_no_estimate_and_removal_takes_the_marked_out() -> None:
    field = Field(walks=True)
    log, of = field.log(STEPS, 0)
    marking, removing = field.slam(), field.slam(upkeep=km.Upkeep(gone="remove"))
    what, _ = mapped(marking, log.events, of), mapped(removing, log.events, of)
    assert marking.landmarks().unseen and not removing.landmarks().unseen
    assert len(removing.landmarks()) < len(marking.landmarks())
    trees = {i for i in what if what[i] != WALKER}
    assert len(removing.landmarks()) >= len(trees)


def test_a_resumed_filter_counts_on(tmp_path: Path) -> None:
    field = Field(walks=True)
    log, _ = field.log(300, 1)
    one, other = field.slam(), field.slam()
    for k, event in enumerate(log.events):
        one.process(event)
        other.process(event)
        if k == 401:
            other.save(tmp_path / "map.kmk")
            other = km.Slam.load(tmp_path / "map.kmk")
    assert one.landmarks().log_odds == other.landmarks().log_odds
    assert one.landmarks().log_odds


def test_ids_decide_what_was_seen_and_are_not_counted() -> None:
    mount = km.Mount(km.sensors.RangeBearing(range_max_m=9.0))
    slam = km.Slam([km.Robot("r", km.motion.Odometry2D(), sensors={"lidar": mount})])
    for t in range(20):
        seen = 2 if t < 5 else 1
        slam.process(km.Scan(t, "r", "lidar", [[5.0, 0.1], [5.0, 0.2]][:seen], [7, 8][:seen]))
    assert not slam.landmarks().log_odds and not slam.tracks.looks


def test_the_log_odds_are_those_of_the_formulas() -> None:
    upkeep, density = km.Upkeep(), existence.Detection(3.0, 1.0)
    never = existence.log_odds([counted(0, 0.0, 2.0)], density, upkeep)[0]
    # the integral of 3 p^2 (1 - p)^2 is 0.1
    assert never == pytest.approx(math.log(100.0) + math.log(0.1) - math.log(19 / 21))
    assert existence.log_odds([counted(5, 1.0, 0.0)], density, upkeep)[0] == pytest.approx(math.log(100.0))


def test_the_detection_probability_is_found_beside_what_never_was_there() -> None:
    rng = np.random.default_rng(0)
    trees = [counted(k, 60 - k, 0.0) for k in rng.binomial(60, 0.8, 40).tolist()]
    ghosts = [counted(0, 0.0, 20.0) for _ in range(15)]
    a, b = existence.detection([*trees, *ghosts], km.Upkeep())
    assert a / (a + b) == pytest.approx(0.8, abs=0.03) and a + b > 30


def test_a_miss_where_little_is_seen_counts_little() -> None:
    looks, hidden = Looks(), np.array([False])
    near, far = (cells_of(np.array([r]), np.zeros(1), hidden, ~hidden) for r in (3.0, 12.0))
    for k in range(100):
        looks.count(near, np.array([k % 10 > 0]))
        looks.count(far, np.array([k % 10 == 0]))
    w_near, w_far = looks.weights(near)[0], looks.weights(far)[0]
    assert w_near > 5 * w_far
    assert looks.weights(near).shape == (1,) and looks.table.shape == CELLS


def test_a_table_of_landmarks_has_the_marks_and_a_known_map_leaves_them_out(tmp_path: Path) -> None:
    table = MapLandmarks(
        ["a", "b"], ["point"] * 2, [np.zeros(2), np.ones(2)], [np.eye(2)] * 2, [9, 3],
        log_odds={"a": 4.5, "b": -8.0}, unseen=frozenset("b"),
    )  # fmt: skip
    path = tmp_path / "landmarks.csv"
    path.write_text(table.to_csv())
    header, a, b = path.read_text().splitlines()
    assert header.endswith("observations,log_odds,mark")
    assert (a.rpartition("9,")[2], b.rpartition("3,")[2]) == ("4.5,", "-8.0,not seen again")
    back = MapLandmarks.read(path)
    assert (back.log_odds, back.unseen) == (table.log_odds, table.unseen)
    assert [landmark.id for landmark in read_known(path)] == ["a"]


def test_few_posts_at_a_wall_are_marked_from_behind_it_and_all_once_they_are_taken_away() -> None:
    """The wall hides them from the north, six sides of twelve; trees stand about, and are seen from everywhere."""
    rng = np.random.default_rng(3)
    posts = np.column_stack([np.linspace(-6.0, 6.0, 7), np.zeros(7)])
    trees = np.array([(x, y) for x in (-9.0, -3.0, 3.0, 9.0) for y in (-7.0, 7.0)])
    lidar = km.sensors.RangeBearing(0.03, 0.005, range_max_m=12.0)
    for stay in (True, False):
        rover = km.Robot(
            "rover", km.motion.Odometry2D(0.005, 0.005, 0.002), (8.0, 0, np.pi / 2), {"lidar": km.Mount(lidar)}
        )
        slam, pose, marked = km.Slam(rover, association=km.association.Automatic()), np.array([8.0, 0.0, np.pi / 2]), []
        for k in range(1200):
            a = 2.0 * np.pi * k / 200.0  # round the wall, and at last to and fro behind it
            a = np.pi * (0.1 + 0.8 * abs((k - 600) / 100.0 % 2.0 - 1.0)) if stay and k >= 700 else a
            now = np.array([8.0 * np.cos(a), 3.5 * np.sin(a), np.arctan2(3.5 * np.cos(a), -8.0 * np.sin(a))])
            u = km.geometry.compose(km.geometry.inverse(pose)[0], now)[0] if k else np.zeros(3)
            pose = now
            slam.process(km.Control(0.1 * k, "rover", u + rng.normal(0.0, (0.002, 0.002, 0.001))))
            shown = np.concatenate([posts if now[1] < 0.0 and (stay or k < 400) else posts[:0], trees])
            y = km.geometry.observe(now, shown)[0] + rng.normal(0.0, (0.03, 0.005), (len(shown), 2))
            slam.process(km.Scan(0.1 * k, "rover", "lidar", y[y[:, 0] < 12.0]))
        table = slam.landmarks()
        marked = [
            np.abs(mean[1]) < 1.0 for name, mean in zip(table.ids, table.means, strict=True) if name in table.unseen
        ]
        assert len(table) >= len(posts) + len(trees) - 1
        assert len(marked) <= 2 if stay else (all(marked) and len(marked) == 7)
