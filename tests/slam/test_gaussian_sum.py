"""Poses that one Gaussian does not describe: unknown headings and places found by ranges to known beacons."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from scipy.stats import chi2

import kalmark as km
from kalmark.arrays import Array
from kalmark.geometry.angles import rotation, wrap
from kalmark.geometry.frames import compose
from kalmark.tracks.linearity import SHARE, SIGMAS, TURN_RAD, bends

HALL = {"n": (0.0, 9.0), "e": (9.0, 9.0), "s": (9.0, 0.0), "w": (0.0, 0.0)}
STEP_S, SPEED_MPS, RANGE_M = 0.1, 0.5, 0.1
ANYWHERE = np.diag([4.0, 4.0, 3.0]) ** 2
MIDDLE = np.array([4.5, 4.5, 0.0])


class Found(NamedTuple):
    """What a run found after each scan: times (N,), errors (N, 3) and NEES (N,); and the share of ranges used."""

    t_s: Array
    error: Array
    nees: Array
    used: float


class Hall:
    """A robot that drives in a hall and hears one beacon after the other, or `all_` at once.

    It rests for `rest_s` first; `outliers` of the ranges are too long.  Ranges are repeats of those `lag_s` old within
    `stale` times.
    """

    def __init__(
        self, seed: int, beacons: str = "nesw", at: tuple[float, float] = (0.0, 0.0), rest_s: float = 0.0,
        outliers: float = 0.0, stale: tuple[tuple[float, float], ...] = (), lag_s: float = 3.0, all_: bool = False,
        sensor: Any = None,
    ) -> None:  # fmt: skip
        self.rng, self.beacons, self.at = np.random.default_rng(seed), beacons, at
        self.rest_s, self.stale = rest_s, stale
        self.outliers, self.lag_s, self.all = outliers, lag_s, all_
        self.x = np.array([*self.rng.uniform(2.5, 6.5, 2), self.rng.uniform(-math.pi, math.pi)])
        self.sensor = km.sensors.Range(RANGE_M) if sensor is None else sensor
        self.places: list[Array] = []

    def slam(self, start: Array, cov: Array, survey_m: float = 0.0) -> km.Slam:
        mount = km.Mount(self.sensor, at=(*self.at, 0.0))
        slam = km.Slam(km.Robot("r", km.motion.Unicycle(0.05, 0.03), start=start, cov=cov, sensors={"radio": mount}))
        for name in self.beacons:
            slam.add_landmark(name, HALL[name], survey_m**2 * np.eye(2) if survey_m else None)
        return slam

    def near(self) -> Array:
        """Return a start near the robot, with any heading."""
        return np.array([*self.x[:2] + self.rng.normal(0.0, 0.3, 2), 0.0])

    def drive(self, slam: km.Slam, end_s: float) -> Found:
        rows, used, total = [], 0, 0
        while (t_s := len(self.places) * STEP_S) < end_s - 1e-9:
            u = np.array([SPEED_MPS, 0.25 + 0.25 * math.sin(0.2 * t_s)]) * (t_s >= self.rest_s)
            noise = self.rng.normal(0.0, [0.05, 0.03]) * (t_s >= self.rest_s)
            slam.process(km.Control(t_s, "r", u + noise))
            report = slam.process(km.Scan(t_s, "r", "radio", *self._heard(t_s)))
            used += sum(o.outcome == "associated" for o in report.observations)
            total += len(report.observations)
            error = slam.mean("r") - self.x
            error[2] = wrap(error[2])
            rows.append((t_s, *error, error @ np.linalg.solve(slam.covariance("r"), error)))
            a = u[1] * STEP_S / 2
            self.x = compose(self.x, np.array([*u[0] * STEP_S * np.array([math.cos(a), math.sin(a)]), 2 * a]))[0]
        found = np.array(rows)
        return Found(found[:, 0], found[:, 1:4], found[:, 4], used / total)

    def _heard(self, t_s: float) -> tuple[list[list[float]], list[str]]:
        k = len(self.places)
        self.places.append(np.array([*self.x[:2] + rotation(self.x[2]) @ self.at, self.x[2]]))
        late = any(begin <= t_s < end for begin, end in self.stale)
        place = self.places[max(0, k - round(self.lag_s / STEP_S)) if late else k]
        names = list(self.beacons) if self.all else [self.beacons[k % len(self.beacons)]]
        v = np.array([rotation(place[2]).T @ (np.array(HALL[name]) - place[:2]) for name in names])
        y = self.sensor.expect(v)[0] + self.rng.normal(
            0.0, math.sqrt(self.sensor.noise(np.ones((1, 1)))[0, 0, 0]), (len(v), 1)
        )
        return (y + (self.rng.random(y.shape) < self.outliers) * self.rng.uniform(2.0, 8.0, y.shape)).tolist(), names


def rmse(found: Found, begin_s: float = 0.0) -> float:
    return float(np.sqrt(np.mean(np.sum(found.error[found.t_s >= begin_s - 1e-9, :2] ** 2, axis=1))))


def assert_consistent(runs: list[Found], *times_s: float) -> None:
    """Assert that the mean NEES of a pose at some times lies within .9998 of what is possible."""
    for t_s in times_s:
        k = round(t_s / STEP_S) - 1
        total = sum(found.nees[k] for found in runs)
        assert chi2.ppf(1e-4, 3 * len(runs)) < total < chi2.ppf(0.9999, 3 * len(runs)), (t_s, total / len(runs))


@pytest.mark.parametrize(
    "keys",
    [{}, {"beacons": "nes", "at": (0.4, 0.3)}, {"outliers": 0.05}],
    ids=["four beacons", "three, and an antenna beside the middle", "outliers"],
)
def test_a_heading_that_may_be_any_is_found_by_ranges_and_its_covariance_is_right(keys: dict[str, Any]) -> None:
    runs = []
    for seed in range(20):
        hall = Hall(seed, **keys)
        runs.append(hall.drive(hall.slam(hall.near(), np.diag([0.3, 0.3, 3.0]) ** 2), 3.0))
        assert runs[-1].used > 0.85
    assert max(rmse(found, 2.0) for found in runs) < 0.15
    assert_consistent(runs, 1.0, 2.0, 3.0)


def test_a_place_that_may_be_any_of_a_hall_is_found_by_ranges_and_its_covariance_is_right() -> None:
    runs = []
    for seed in range(14):
        hall = Hall(seed, beacons="nesw" if seed % 2 else "nes")
        runs.append(hall.drive(hall.slam(MIDDLE, ANYWHERE), 3.0))
        assert runs[-1].used > 0.95
    assert math.sqrt(np.mean([rmse(found, 2.0) ** 2 for found in runs])) < 0.1
    assert_consistent(runs, 1.0, 2.0, 3.0)


def test_ten_seconds_of_rest_say_nothing_of_a_heading_and_driving_does() -> None:
    runs = []
    for seed in range(3):
        hall = Hall(seed, rest_s=10.0)
        slam = hall.slam(hall.near(), np.diag([0.3, 0.3, 3.0]) ** 2)
        runs.append(hall.drive(slam, 10.0))
        assert slam.covariance("r")[2, 2] > 2.0**2
        assert rmse(runs[-1], 5.0) < 0.1
        later = hall.drive(slam, 13.0)
        assert abs(later.error[-1, 2]) < 0.3
        assert later.nees[-1] < chi2.ppf(0.999, 3)
    assert_consistent(runs, 1.0, 5.0, 10.0)


def test_surveys_with_a_covariance_find_a_robot_too() -> None:
    hall = Hall(3)
    slam = hall.slam(MIDDLE, ANYWHERE, survey_m=0.02)
    found = hall.drive(slam, 4.0)
    assert rmse(found, 2.0) < 0.15
    assert found.used > 0.9


def test_strengths_place_a_robot_that_may_be_anywhere() -> None:
    hall = Hall(1, all_=True, sensor=km.sensors.SignalStrength2D(2.0))
    found = hall.drive(hall.slam(MIDDLE, ANYWHERE), 8.0)
    assert rmse(found, 4.0) < 1.0
    assert found.nees[found.t_s > 4.0].mean() < 9.0


def test_bearings_from_a_known_place_find_a_heading_that_may_be_any() -> None:
    hall = Hall(2, sensor=km.sensors.Bearing(0.02))
    slam = hall.slam(hall.near(), np.diag([0.3, 0.3, 3.0]) ** 2)
    found = hall.drive(slam, 3.0)
    assert abs(found.error[-1, 2]) < 0.1
    assert found.nees[-1] < chi2.ppf(0.999, 3)


@pytest.mark.parametrize("all_", [False, True])
def test_two_stale_epochs_move_no_robot(all_: bool) -> None:
    for seed in range(2):
        hall = Hall(seed, stale=((3.0, 3.1), (5.0, 5.1)), lag_s=2.5, all_=all_)
        found = hall.drive(hall.slam(hall.x.copy(), 0.01 * np.eye(3)), 7.0)
        assert rmse(found) < 0.1
        assert found.used > 0.95


@pytest.mark.parametrize("all_", [False, True])
def test_a_robot_comes_back_after_a_second_and_a_half_of_stale_ranges(all_: bool) -> None:
    for seed in range(2):
        hall = Hall(seed, stale=((4.0, 5.5),), all_=all_)
        found = hall.drive(hall.slam(hall.x.copy(), 0.01 * np.eye(3)), 9.0)
        assert rmse(found, 7.5) < 0.1
        assert found.nees[-1] < chi2.ppf(0.999, 3)


def test_a_sum_is_kept_when_a_map_is_saved(tmp_path: Path) -> None:
    whole, resumed = Hall(4), Hall(4)
    one, other = (hall.slam(MIDDLE, ANYWHERE) for hall in (whole, resumed))
    whole.drive(one, 0.7)
    resumed.drive(other, 0.7)
    assert len(other.state.sums["r"].parts.P) > 1
    other.save(tmp_path / "map.kmk")
    other = km.Slam.load(tmp_path / "map.kmk")
    whole.drive(one, 2.0)
    resumed.drive(other, 2.0)
    np.testing.assert_array_equal(one.mean("r"), other.mean("r"))
    np.testing.assert_array_equal(one.covariance("r"), other.covariance("r"))


@pytest.mark.parametrize(
    ("hall", "why"),
    [
        (Hall(0, beacons="n"), "takes two known landmarks"),
        (Hall(0, sensor=km.sensors.Bearing(0.02)), "determines no distance"),
    ],
)
def test_what_cannot_place_a_robot_waits_with_the_reason_and_what_would_help(hall: Hall, why: str) -> None:
    slam = hall.slam(MIDDLE, ANYWHERE)
    (seen,) = slam.process(km.Scan(0.0, "r", "radio", [[1.0]], ["n"])).observations
    assert seen.outcome == "deferred"
    assert why in seen.reason
    assert "a smaller sigma_xy_m" in seen.reason


def test_a_range_at_the_middle_of_a_robot_needs_no_heading_and_one_beside_it_does() -> None:
    P, y, R = np.diag([0.1, 0.1, 3.0]) ** 2, np.array([[5.0, 5.0, 0.0]]), np.array([[[RANGE_M**2]]])
    bent = []
    for at in (0.0, 0.5):
        mount = km.Mount(km.sensors.Range(RANGE_M), at=(at, 0.0, 0.0))
        channel = km.Slam(km.Robot("r", km.motion.Unicycle(), sensors={"radio": mount})).state.channels["r", "radio"]
        bent += bends(channel.models["point"].exactly.model, np.zeros((1, 3)), P[None], y, R).tolist()
    assert bent == [[False, False, False], [True, False, False]]


def test_a_turn_leaves_out_its_share_at_the_sigma_points_of_the_limit() -> None:
    d = SIGMAS * TURN_RAD
    left_out = rotation(d) - np.eye(2) - d * np.array([[0.0, -1.0], [1.0, 0.0]])
    assert float(np.linalg.norm(left_out[:, 0])) == pytest.approx(SHARE * d, rel=0.05)
