"""A measurement that a sensor gives again counts once; coarse numbers, and a robot at rest, may repeat them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import kalmark as km
from kalmark.arrays import Array
from kalmark.logs.log import Log
from kalmark.slam.held_readings import AGAIN, CHANCE, LastMeasurement

MOTION = km.motion.Odometry2D(0.002, 0.002, 0.001)
GPS = km.sensors.Gps2D(0.5)


def events_of(
    epochs: int, held: int, rng: np.random.Generator, step_m: float = 0.02, kind: str = "gps", x: float = 0.0
) -> list[Any]:
    """Return increments of a robot that drives straight on and, with each, its position of the last of some epochs."""
    events: list[Any] = []
    y = np.zeros((1, 2))
    for k in range(epochs * held):
        t_s = 0.02 * (k + 1)
        x += step_m
        moved = (step_m + 0.002 * rng.normal() * (step_m > 0), 0.0, 0.0)
        events.append(km.Control(t_s, "r", moved))
        if k % held == 0:
            y = np.array([[x, 0.0]]) + 0.5 * rng.normal(size=(1, 2))
        if kind == "fix":
            events.append(km.Fix(t_s, "r", y[0], 0.25 * np.eye(2)))
        else:
            events.append(km.Scan(t_s, "r", "gps", y))
    return events


def slam_of() -> km.Slam:
    return km.Slam([km.Robot("r", MOTION, (0, 0, 0), {"gps": km.Mount(GPS)}, cov=np.diag([1.0, 1.0, 0.01]))])


def outcomes(slam: km.Slam, events: list[Any]) -> list[tuple[str, str]]:
    reports = [slam.process(event) for event in events]
    return [(o.outcome, o.reason) for report in reports for o in report.observations]


@pytest.mark.parametrize("kind", ["gps", "fix"])
def test_a_receiver_that_repeats_its_last_reading_counts_once(kind: str) -> None:
    events = events_of(120, 10, np.random.default_rng(1), kind=kind)
    slam, once = slam_of(), slam_of()
    found = outcomes(slam, events)
    assert found[-1000:].count(("ignored", AGAIN)) == 900
    assert [what for what, _ in found[200::10]] == ["associated"] * 100
    for k, event in enumerate(events):
        if k % 20 == 1 or isinstance(event, km.Control):
            once.process(event)
    ratio = np.sqrt(np.diag(slam.covariance("r")) / np.diag(once.covariance("r")))
    np.testing.assert_allclose(ratio, 1.0, atol=0.1)
    x = slam.mean("r") - (24.0, 0.0, 0.0)
    assert x @ np.linalg.solve(slam.covariance("r"), x) < 11.3


def test_a_robot_at_rest_may_read_the_same_again() -> None:
    rng, slam = np.random.default_rng(1), slam_of()
    outcomes(slam, events_of(60, 1, rng))
    assert {what for what, _ in outcomes(slam, later(events_of(20, 10, rng, step_m=0.0, x=1.2), slam))} == {
        "associated"
    }


def later(events: list[Any], slam: km.Slam) -> list[Any]:
    """Return events after what a filter has taken."""
    at_s = (slam.t_ns or 0) * 1e-9
    return [
        km.Control(e.t_s + at_s, "r", e.u) if isinstance(e, km.Control) else km.Scan(e.t_s + at_s, "r", "gps", e.y)
        for e in events
    ]


@pytest.mark.parametrize(("step_rad", "most"), [(np.radians(1.0), 0), (1e-6, 3)])
def test_a_coarse_compass_repeats_its_numbers_by_chance_and_a_fine_one_does_not(step_rad: float, most: int) -> None:
    rng = np.random.default_rng(2)
    compass = km.Mount(km.sensors.Heading(np.radians(2.0)))
    slam = km.Slam([km.Robot("r", MOTION, (0, 0, 0), {"gps": compass})])
    ignored = 0
    for k in range(400):
        slam.process(km.Control(0.1 * k, "r", (0.1, 0.0, 0.0)))
        y = np.round(np.radians(2.0) * rng.normal(size=(1, 1)) / step_rad) * step_rad
        (seen,) = slam.process(km.Scan(0.1 * k, "r", "gps", y)).observations
        ignored += seen.outcome == "ignored"
    assert ignored <= most
    assert slam.state.given["r", "gps"].number == 400


def test_the_chance_of_equal_numbers_is_that_of_gaussian_noise() -> None:
    rng, q, sigma = np.random.default_rng(3), 0.2, 1.0
    y: Array = np.round(sigma * rng.normal(size=(20000, 1)) / q) * q
    given = LastMeasurement.of(y[:1], None)
    equal = np.mean([given.take(one[None], None) for one in y[1:]])
    assert given.chance() == pytest.approx(q / (2.0 * sigma * np.sqrt(np.pi)), rel=0.2)
    assert given.chance() == pytest.approx(equal, rel=0.2)
    assert pytest.approx(0.2114, abs=1e-4) == CHANCE


@pytest.mark.parametrize("at", [2, 905])
def test_what_was_given_is_saved_and_resumes(tmp_path: Path, at: int) -> None:
    events = events_of(60, 10, np.random.default_rng(1))
    slam = slam_of()
    outcomes(slam, events[:at])
    slam.save(tmp_path / "map.kmk")
    again = km.Slam.load(tmp_path / "map.kmk")
    assert outcomes(slam, events[at:]) == outcomes(again, events[at:])
    np.testing.assert_array_equal(slam.covariance("r"), again.covariance("r"))


def test_scans_with_ids_that_are_given_again_count_once_and_are_named() -> None:
    rng, places, pose = np.random.default_rng(4), np.array([[4.0, 1.0], [5.0, -2.0], [7.0, 0.5]]), np.zeros(3)
    events: list[Any] = []
    y = np.zeros((3, 2))
    for k in range(200):
        events.append(km.Control(0.1 * k, "r", (0.01, 0.0, 0.0)))
        pose[0] += 0.01 + 0.002 * rng.normal()
        if k % 4 == 0:
            y = km.geometry.observe(pose, places)[0] + rng.normal(size=(3, 2)) * (0.05, 0.01)
        events.append(km.Scan(0.1 * k, "r", "lidar", y, [1, 2, 3]))
    lidar = km.Mount(km.sensors.RangeBearing(0.05, 0.01))
    slam = km.Slam([km.Robot("r", MOTION, (0, 0, 0), {"lidar": lidar})])
    run = km.record(slam, Log("held", ("r",), events), progress=False)
    verdict = km.diagnose(run)
    (cause,) = [cause for cause in verdict.causes if cause.name == "copies"]
    assert cause.harmless and "of 200 scans of r.lidar repeat" in cause.evidence
    assert int(cause.evidence.split()[0]) > 130
    assert (run.history.reason == AGAIN).sum() == 3 * int(cause.evidence.split()[0])


def test_scans_of_other_landmarks_each_time_show_what_is_given_again() -> None:
    """No scan has the ids of the one before it: the differences of those in both are counted."""
    rng, places = np.random.default_rng(4), np.random.default_rng(1).uniform(-8.0, 8.0, (12, 2))
    mount = km.Mount(km.sensors.Position2D(0.05, 0.05))
    slam = km.Slam(km.Robot("r", MOTION, sensors={"eye": mount}))
    last: tuple[Any, list[int]] = np.zeros((0, 2)), []
    found = []
    for k in range(40):
        slam.process(km.Control(0.1 * (k + 1), "r", (0.1, 0.0, 0.0)))
        if k not in (30, 31, 32):
            seen = sorted(rng.choice(12, 6 + k % 3, replace=False).tolist())
            last = places[seen] - (0.1 * (k + 1), 0.0) + 0.05 * rng.normal(size=(len(seen), 2)), seen
        report = slam.process(km.Scan(0.1 * (k + 1), "r", "eye", last[0], ids=last[1]))
        found.append({o.reason == AGAIN for o in report.observations})
    assert [k for k, again in enumerate(found) if again == {True}] == [30, 31, 32]
