"""The choice of a map by the counted costs of its corrections."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import kalmark as km
from kalmark.filter.compressed.compressed_map import CompressedMap
from kalmark.filter.map import StochasticMap
from kalmark.filter.maps import COUNTED, DENSE, MOST

SIDE, APART_M, STEP_M, SEEN = 20, 2.0, 0.05, 10


def field_slam(count: int = SIDE**2) -> tuple[km.Slam, np.ndarray]:
    """Return a Slam that knows a square field of landmarks, and their places (count, 2)."""
    lidar = km.Mount(km.sensors.RangeBearing(0.1, 0.02))
    slam = km.Slam(km.Robot("r", km.motion.Odometry2D(0.01, 0.01, 0.001), sensors={"lidar": lidar}))
    side = int(np.ceil(np.sqrt(count)))
    places = np.array([(APART_M * (k % side), APART_M * (k // side)) for k in range(count)]) - 0.4 * APART_M * side
    for k, place in enumerate(places):
        slam.add_landmark(k, place, 0.01 * np.eye(2))
    return slam, places


def drive(slam: km.Slam, places: np.ndarray, steps: range, wide: bool) -> None:
    """Drive straight on and see ten landmarks at a time, the nearest ones or any."""
    for k in steps:
        rng = np.random.default_rng(k)
        pose = np.array([STEP_M * (k + 1), 0.0, 0.0])
        near = np.argsort(np.hypot(*(places - pose[:2]).T))[:SEEN]
        ids = rng.choice(len(places), SEEN, replace=False) if wide else near
        y = km.geometry.observe(pose, places[ids])[0] + rng.normal(size=(SEEN, 2)) * (0.1, 0.02)
        y[:, 0] = np.abs(y[:, 0])
        slam.process(km.Control(0.1 * k, "r", (STEP_M, 0.0, 0.0)))
        slam.process(km.Scan(0.1 * k, "r", "lidar", y, ids.tolist()))


def test_a_large_map_of_which_little_is_seen_is_compressed_and_one_that_is_seen_all_over_is_not() -> None:
    for wide, kind in ((False, CompressedMap), (True, StochasticMap)):
        slam, places = field_slam()
        drive(slam, places, range(2 * COUNTED), wide)
        assert type(slam.map) is kind


def test_a_small_map_stays_dense() -> None:
    slam, places = field_slam(DENSE - 10)
    drive(slam, places, range(3 * COUNTED), False)
    assert type(slam.map) is StochasticMap


def test_a_map_whose_covariance_would_be_large_is_compressed_before_anything_is_seen() -> None:
    slam, _ = field_slam(MOST + 1)
    assert type(slam.map) is CompressedMap


@pytest.mark.parametrize("at", [COUNTED + 50])
def test_the_count_is_saved(tmp_path: Path, at: int) -> None:
    slam, places = field_slam()
    drive(slam, places, range(at), False)
    slam.save(tmp_path / "map.kmk")
    again = km.Slam.load(tmp_path / "map.kmk")
    assert again.state.balance == slam.state.balance
    for one in (slam, again):
        drive(one, places, range(at, 2 * COUNTED), False)
        assert type(one.map) is CompressedMap
    np.testing.assert_array_equal(slam.covariance("r"), again.covariance("r"))
