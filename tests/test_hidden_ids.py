"""A log that hides its ids from the filter still scores what the filter made of it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

import kalmark as km
from kalmark.logs import write_native
from kalmark.results.run import Run

POINTS = {7: (4.0, 1.0), 8: (6.0, -2.0), 9: (5.0, 4.0)}


def garden(tmp_path: Path) -> km.Log:
    rng, events = np.random.default_rng(4), []
    for t in range(12):
        y = km.geometry.observe(np.zeros(3), np.array(list(POINTS.values())))[0] + rng.normal(size=(3, 2)) * 0.01
        order = rng.permutation(3)
        ids = [[*POINTS][i] for i in order]
        if t == 6:
            ids[ids.index(7)], ids[ids.index(8)] = 8, 7  # the log is wrong once, in both
        false = [[9.0, 1.0 + 0.1 * t]]
        events.append(km.Scan(t, "cart", "lidar", np.concatenate([y[order], false]), [*ids, None]))
    landmarks = {i: np.array(p) for i, p in POINTS.items()}
    log = km.Log("garden", ("cart",), events, landmarks=landmarks)
    log = replace(log, sensor_columns={("cart", "lidar"): ("range_m", "bearing_rad")})
    write_native(log, tmp_path / "garden")
    return km.open_log(tmp_path / "garden", ids="hidden")


def run_of(log: km.Log) -> Run:
    lidar = km.Mount(km.sensors.RangeBearing(0.02, 0.01))
    cart = km.Robot("cart", km.motion.Odometry2D(), sensors={"lidar": lidar})
    return km.record(km.Slam([cart], km.association.GlobalAssignment()), log, progress=False)


def test_the_filter_is_not_told_and_the_summary_says_how_often_it_was_wrong(tmp_path: Path) -> None:
    log = garden(tmp_path)
    assert all(e.ids == (None,) * 4 for e in log if isinstance(e, km.Scan))
    run = run_of(log)
    summary = run.evaluate()
    assert summary["landmarks"] == 3
    assert (summary["wrong"], summary["judged"]) == (2, 30)  # twelve scans, two tentative sightings of each
    assert (summary["duplicates"], summary["nameless"], summary["nameless_fused"]) == (0, 12, 0)
    assert summary["landmark_rmse_raw_m"] < 0.02, "landmarks are held against the truth by the log's names"
    run.save(tmp_path / "run")
    assert Run.load(tmp_path / "run").evaluate()["wrong"] == 2


def test_two_landmarks_where_the_log_has_one_are_told(tmp_path: Path) -> None:
    log = garden(tmp_path)
    cart = km.Robot("cart", km.motion.Odometry2D(), sensors={"lidar": km.Mount(km.sensors.RangeBearing(0.02, 0.01))})
    slam = km.Slam([cart], km.association.GlobalAssignment())
    half, jump = log.events[:6], km.Control(5.5, "cart", (0.0, 2.0, 0.0))  # the robot is carried off
    run = km.record(slam, replace(log, events=[*half, jump, *log.events[6:]]), progress=False)
    assert run.evaluate()["duplicates"] == 3


def test_robots_keep_their_names(tmp_path: Path) -> None:
    scans = [km.Scan(0, "a", "eye", [[1.0, 0.0], [2.0, 0.0]], ["b", 4]), km.Scan(0, "b", "eye", [[1.0, 0.0]], ["a"])]
    write_native(
        km.Log("two", ("a", "b"), scans, sensor_columns={(r, "eye"): ("range_m", "bearing_rad") for r in "ab"}),
        tmp_path / "two",
    )
    assert [e.ids for e in km.open_log(tmp_path / "two", ids="hidden")] == [("b", None), ("a",)]
