"""A log that hides its ids from the filter still scores what the filter made of it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

import kalmark as km
from kalmark.logs import write_native
from kalmark.results.association_errors import by_position
from kalmark.results.evaluate import headline
from kalmark.results.landmark_table import MapLandmarks
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
    return km.record(km.Slam([cart], km.association.GlobalAssignment()), log, progress=False, pictures=False)


def test_the_filter_is_not_told_and_the_summary_says_how_often_it_was_wrong(tmp_path: Path) -> None:
    log = garden(tmp_path)
    assert all(e.ids == (None,) * 4 for e in log if isinstance(e, km.Scan))
    run = run_of(log)
    summary = run.evaluate()
    assert summary["landmarks"] == 3
    assert (summary["wrong"], summary["judged"]) == (2, 30)  # twelve scans, two tentative observations of each
    assert (summary["duplicates"], summary["nameless"], summary["nameless_fused"]) == (0, 12, 0)
    assert summary["landmark_rmse_raw_m"] < 0.02, "landmarks are held against the truth by the log's names"
    run.save(tmp_path / "run")
    assert Run.load(tmp_path / "run").evaluate()["wrong"] == 2


def test_two_landmarks_where_the_log_has_one_are_told(tmp_path: Path) -> None:
    log = garden(tmp_path)
    cart = km.Robot("cart", km.motion.Odometry2D(), sensors={"lidar": km.Mount(km.sensors.RangeBearing(0.02, 0.01))})
    slam = km.Slam([cart], km.association.GlobalAssignment())
    half, jump = log.events[:6], km.Control(5.5, "cart", (0.0, 2.0, 0.0))  # the robot is carried off
    run = km.record(slam, replace(log, events=[*half, jump, *log.events[6:]]), progress=False, pictures=False)
    assert run.evaluate()["duplicates"] == 3


def test_robots_keep_their_names(tmp_path: Path) -> None:
    scans = [km.Scan(0, "a", "eye", [[1.0, 0.0], [2.0, 0.0]], ["b", 4]), km.Scan(0, "b", "eye", [[1.0, 0.0]], ["a"])]
    write_native(
        km.Log("two", ("a", "b"), scans, sensor_columns={(r, "eye"): ("range_m", "bearing_rad") for r in "ab"}),
        tmp_path / "two",
    )
    assert [e.ids for e in km.open_log(tmp_path / "two", ids="hidden")] == [("b", None), ("a",)]


def without_ids(log: km.Log, **changes: object) -> km.Log:
    """Return a log that does not know itself which landmark is which."""
    return replace(log, true_ids={}, **changes)  # type: ignore[arg-type]


def test_without_any_id_true_landmarks_are_matched_by_position_and_the_summary_says_so(tmp_path: Path) -> None:
    run = run_of(without_ids(garden(tmp_path)))
    summary = run.evaluate()
    assert summary["landmarks_matched"] == "3 of 3 by position, of 3 true"
    assert summary["landmarks_compared"] == 3
    assert summary["landmark_rmse_raw_m"] < 0.02
    assert "matched by position" in " ".join(headline(run)[1])
    assert "landmarks_matched" not in run_of(garden(tmp_path / "again")).evaluate(), "there its ids are known"


def test_a_true_map_in_another_frame_is_not_scored_by_position(tmp_path: Path) -> None:
    elsewhere = {i: np.add(p, (30.0, -12.0)) for i, p in POINTS.items()}
    summary = run_of(without_ids(garden(tmp_path), landmarks=elsewhere)).evaluate()
    assert "landmarks_matched" not in summary
    assert summary["landmark_rmse_m"] is None
    assert [line for line in summary["warnings"] if line.startswith("the landmarks are not scored: no ids tie them")]


def test_positions_pair_only_what_is_nearest_to_each_other_and_nearer_than_half_way_to_the_next() -> None:
    true = {f"t{i}": np.array([4.0 * i, 0.0]) for i in range(6)}
    at = [(0.1, 0), (4.2, 0), (4.4, 0), (8, 1.9), (12, 2.1), (16, 0)]
    means = [np.array(p, dtype=np.float64) for p in at]
    table = MapLandmarks([*"abcdef"], ["point"] * 6, means, [0.01 * np.eye(2)] * 6, [3] * 6)
    assert by_position(table, true) == {"a": "t0", "b": "t1", "d": "t2", "f": "t4"}
    assert by_position(table, {i: np.add(p, (0.0, 3.0)) for i, p in true.items()}) == {}
