"""Scans whose stamps are late: the lag is estimated with the map, kept in files, and refused where it means nothing."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2

import kalmark as km
from kalmark.config import build_slam
from kalmark.errors import ModelError
from kalmark.simulate import load_world, simulate

LATE_S = 0.06
TRUE = "robots.car.sensing.lidar.late_s"


def driven(*over: str, seed: int = 0) -> km.Slam:
    """Return the filter of a lap of the race track."""
    exact = [
        "robots.car.sensors.lidar.lag_s=0",
        "filter.robots.car.sensors.lidar.lag_s=0",
        "robots.car.sensors.lidar.sigma_lag_s=0",
    ]
    sigma = "filter.robots.car.sensors.lidar.sigma_lag_s=0.1"
    world = load_world("race_track", ["steps=600", f"{TRUE}={LATE_S}", *exact, sigma, *over])
    log = simulate(world, seed)
    slam = build_slam(world.config(), log)
    for event in log:
        slam.process(event)
    return slam


def test_a_lag_is_estimated_as_well_as_it_says() -> None:
    d2 = []
    for seed in range(10):
        slam = driven("ids=true", "filter.association={type: identity}", seed=seed)
        d2.append((slam.mean("car.lidar")[3] - LATE_S) ** 2 / slam.covariance("car.lidar")[3, 3])
    assert sum(d2) < chi2.ppf(0.999, len(d2)), np.sqrt(d2)
    assert slam.covariance("car.lidar")[3, 3] ** 0.5 < 0.004


def test_cones_without_ids_are_mapped_twice_by_late_scans_unless_the_lag_is_in_the_map() -> None:
    keys = [f"filter.robots.car.sensors.lidar.sigma_lag_s={sigma_s}" for sigma_s in (0.1, 0.0)]
    known, late = (len(driven(key, "steps=1600", f"{TRUE}=0.1", seed=1).landmarks()) for key in keys)
    assert known == 160
    assert late > 180


def test_a_known_lag_is_taken_out_of_increments_too() -> None:
    """A robot on a circle, increments of .1 s, scans that show where it was .15 s ago."""
    lag_s, w, rng = 0.15, 0.8, np.random.default_rng(1)
    places = rng.uniform(-8.0, 8.0, (12, 2))
    lidar = km.Mount(km.sensors.RangeBearing(0.02, 0.005), lag_s=lag_s, at=(0.2, 0.1, 0.3))
    slam = km.Slam(km.Robot("r", km.motion.Odometry2D(1e-3, 1e-4, 1e-3), sensors={"lidar": lidar}))
    for k in range(1, 60):
        slam.process(km.Control(0.1 * k, "r", (*(np.sin([0.1 * w]) / w), (1 - np.cos(0.1 * w)) / w, 0.1 * w)))
        a = w * (0.1 * k - lag_s)
        T = km.geometry.compose(np.array([np.sin(a) / w, (1 - np.cos(a)) / w, a]), lidar.at)[0]
        slam.process(km.Scan(0.1 * k, "r", "lidar", km.geometry.observe(T, places)[0], range(12)))
    here = np.array([np.sin(w * 5.9) / w, (1 - np.cos(w * 5.9)) / w])
    assert np.linalg.norm(slam.mean("r")[:2] - here) < 0.02
    found = np.array([slam.mean(i) for i in range(12)])
    assert np.abs(found - places).max() < 0.06


def test_a_scan_before_any_motion_is_left_out_with_its_reason() -> None:
    lidar = km.Mount(km.sensors.RangeBearing(), sigma_lag_s=0.1)
    slam = km.Slam(km.Robot("r", km.motion.Unicycle(), sensors={"lidar": lidar}))
    report = slam.process(km.Scan(0.0, "r", "lidar", [[4.0, 0.3]], [7]))
    assert [(o.outcome, "no motion" in o.reason) for o in report.observations] == [("ignored", True)]
    slam.process(km.Control(0.0, "r", (1.0, 0.1)))
    assert slam.process(km.Scan(0.5, "r", "lidar", [[4.0, 0.3]], [7])).observations[0].outcome == "new"


def test_a_saved_filter_goes_on_bit_for_bit(tmp_path: Path) -> None:
    log = simulate(load_world("race_track", ["steps=120"]), 3)
    slam = build_slam(load_world("race_track").config(), log)
    for event in log.events[:90]:
        slam.process(event)
    slam.save(tmp_path / "map.kmk")
    other = km.Slam.load(tmp_path / "map.kmk")
    for event in log.events[90:]:
        slam.process(event)
        other.process(event)
    assert other.robots["car"].sensors["lidar"].sigma_lag_s == 0.03
    np.testing.assert_array_equal(slam.mean("car.lidar"), other.mean("car.lidar"))
    np.testing.assert_array_equal(slam.mean("car"), other.mean("car"))


@pytest.mark.parametrize(
    ("sensor", "given", "why"),
    [
        (km.sensors.RangeBearing(), {"lag_s": "late"}, "lag_s is 'late', expected a number"),
        (
            km.sensors.RangeBearing(),
            {"sigma_lag_s": -0.1},
            "sigma_lag_s is -0.1, expected a number of at least 0 up to 2",
        ),
        (km.sensors.RangeBearing(), {"lag_s": 100.0}, "lag_s is 100.0, expected a number of at least -2 up to 2"),
        (km.sensors.Gyro2D(), {"sigma_lag_s": 0.1}, "a Gyro2D measures its robot"),
    ],
)
def test_a_lag_that_means_nothing_is_refused(sensor: Any, given: dict[str, Any], why: str) -> None:
    with pytest.raises(ModelError, match=why):
        km.Mount(sensor, **given)


@pytest.mark.parametrize("way", [None, km.initialization.Hypotheses()])
def test_a_sensor_that_starts_landmarks_late_has_no_lag(way: Any) -> None:
    mount = km.Mount(km.sensors.Range(), sigma_lag_s=0.1, initialization=way)
    with pytest.raises(ModelError, match="a Range whose lag is in the map starts landmarks at first sight"):
        km.Slam(km.Robot("r", km.motion.Unicycle(), sensors={"radio": mount}))
