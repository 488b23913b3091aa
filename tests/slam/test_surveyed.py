"""Surveyed landmarks that stand elsewhere do not pull the map; a robot that is elsewhere still finds back to it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import kalmark as km
from kalmark.arrays import Array
from kalmark.slam.surveyed_corrections import ELSEWHERE

PLACES = {1: (3.0, 1.0), 2: (4.0, -2.0), 3: (6.0, 2.0), 4: (2.0, -3.0)}
WRONG = {3: (5.0, 3.5)}  # where the survey has it


def surveyed(cov: Any, wrong: dict[int, tuple[float, float]], gate: Any = "default", **of_robot: Any) -> km.Slam:
    """Return a filter with surveyed landmarks, some of them at wrong places."""
    laser = km.Mount(km.sensors.RangeBearing(0.05, 0.01), association=km.association.ByIdentity(gate=gate))
    slam = km.Slam([km.Robot("r", km.motion.Unicycle(0.05, 0.05), sensors={"l": laser}, **of_robot)])
    for name, place in (PLACES | wrong).items():
        slam.add_landmark(name, place, cov)
    return slam


def scan(t_s: float, pose: Array, ids: list[int], rng: np.random.Generator) -> km.Scan:
    y = km.geometry.observe(pose, np.array([PLACES[i] for i in ids]))[0]
    return km.Scan(t_s, "r", "l", y + rng.normal(size=y.shape) * (0.05, 0.01), ids)


def drive(slam: km.Slam, steps: int, start: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> tuple[Array, list[Any]]:
    """Drive straight on and look at all landmarks; return where the robot is and what was removed."""
    rng, pose, removed = np.random.default_rng(1), np.array(start), []
    for k in range(steps):
        slam.process(km.Control(0.2 * k, "r", (0.2, 0.0)))
        pose = km.motion.Unicycle().move(pose, np.array([0.2, 0.0]), 0.2)[0]
        report = slam.process(scan(0.2 * (k + 1), pose, [*PLACES], rng))
        removed += [(name, why, k) for name, why in report.removed]
    return pose, removed


@pytest.mark.parametrize("gate", ["default", 0.99])
@pytest.mark.parametrize("cov", [None, 1e-4 * np.eye(2)])
def test_a_wrong_survey_is_left_out_with_a_reason_then_mapped_anew(cov: Any, gate: Any) -> None:
    slam, right = surveyed(cov, WRONG, gate), surveyed(cov, {}, gate)
    pose, removed = drive(slam, 20)
    drive(right, 20)
    assert removed == [(3, ELSEWHERE, 4)]  # five observations
    assert not slam.is_known(3)
    assert np.linalg.norm(slam.mean(3) - PLACES[3]) < 4 * np.sqrt(np.trace(slam.covariance(3))) < 0.5
    assert np.linalg.norm(slam.mean("r")[:2] - pose[:2]) < 0.1
    np.testing.assert_allclose(slam.mean("r"), right.mean("r"), atol=0.05)


def test_what_is_left_out_says_why() -> None:
    slam, rng = surveyed(None, WRONG), np.random.default_rng(1)
    fates = slam.process(scan(0.0, np.zeros(3), [1, 2, 3], rng)).observations
    assert [o.outcome for o in fates] == ["associated", "associated", "rejected"]
    assert fates[2].reason == "outside the gate of 18.42"


@pytest.mark.parametrize("cov", [None, 1e-4 * np.eye(2)])
def test_a_robot_that_is_elsewhere_is_brought_back_and_no_survey_is_given_up(cov: Any) -> None:
    slam = surveyed(cov, {}, start=(0.5, -0.4, 0.2))
    pose, removed = drive(slam, 20)
    assert removed == []
    assert np.linalg.norm(slam.mean("r")[:2] - pose[:2]) < 0.15


def test_what_is_outside_the_gate_of_the_association_is_not_taken_but_places_the_robot() -> None:
    slam, rng, there = surveyed(None, {}, 0.99), np.random.default_rng(1), np.array([0.8, -0.7, 0.1])
    reports = [slam.process(scan(0.1 * k, there, [*PLACES], rng)) for k in range(6)]
    assert {o.outcome for o in reports[0].observations} == {"rejected"}
    assert not any(report.removed for report in reports)
    assert [gap.kind for report in reports for gap in report.gaps] == ["elsewhere"]
    np.testing.assert_allclose(slam.mean("r")[:3], there, atol=0.1)


def test_one_landmark_alone_is_left_out_until_others_say_the_same() -> None:
    slam, rng, there = surveyed(None, {}), np.random.default_rng(1), np.array([0.8, -0.7, 0.1])
    fates = [slam.process(scan(0.1 * k, there, [name], rng)).observations[0].outcome for k, name in enumerate(PLACES)]
    assert fates == ["rejected"] * 3 + ["associated"] * (len(PLACES) - 3)
    np.testing.assert_allclose(slam.mean("r")[:3], there, atol=0.3)


def test_a_survey_on_trial_is_trusted_after_five_observations_that_fit_and_kept_in_a_file(tmp_path: Path) -> None:
    slam = surveyed(0.01 * np.eye(2), {})
    drive(slam, 4)
    assert slam.state.surveys.trial == dict.fromkeys(PLACES, 4)
    slam.save(tmp_path / "map.kmk")
    again = km.Slam.load(tmp_path / "map.kmk")
    assert vars(again.state.surveys) == vars(slam.state.surveys)
    drive(surveyed(0.01 * np.eye(2), {}), 6)
    slam.process(scan(1.0, slam.mean("r")[:3], [*PLACES], np.random.default_rng(0)))
    assert slam.state.surveys.trial == {}


def test_the_gate_can_be_chosen_or_left_away() -> None:
    for gate, fate in (("off", "associated"), (0.9999, "rejected")):
        laser = km.Mount(km.sensors.RangeBearing(0.05, 0.01), association=km.association.ByIdentity(gate=gate))
        slam = km.Slam([km.Robot("r", km.motion.Unicycle(), sensors={"l": laser})])
        slam.add_landmark(3, WRONG[3])
        report = slam.process(scan(0.0, np.zeros(3), [3], np.random.default_rng(0)))
        assert report.observations[0].outcome == fate


def test_what_was_mapped_from_a_wrong_start_does_not_speak_against_surveys_that_come_one_at_a_time() -> None:
    rng, start = np.random.default_rng(4), np.array([0.0, 0.0, 0.0])
    trees = dict(enumerate(rng.uniform((-4, -6), (40, 6), (60, 2))))
    trees |= {100: (10.0, 4.0), 101: (18.0, -4.0), 102: (25.0, 4.0)}
    laser = km.Mount(km.sensors.RangeBearing(0.05, 0.01))
    stated, cov = (4.0, -3.0, 0.4), np.diag((0.1, 0.1, 0.02)) ** 2
    slam = km.Slam([km.Robot("r", km.motion.Unicycle(0.05, 0.03), stated, {"l": laser}, cov=cov)])
    for name in (100, 101, 102):
        slam.add_landmark(name, trees[name])
    pose, removed = start, []
    for k in range(150):
        slam.process(km.Control(0.2 * k, "r", (1.0, 0.0) + rng.normal(size=2) * (0.05, 0.03)))
        pose = km.motion.Unicycle().move(pose, np.array([1.0, 0.0]), 0.2)[0]
        y = km.geometry.observe(pose, np.array([*trees.values()]))[0]
        near = np.flatnonzero((y[:, 0] < 7.0) & (np.abs(y[:, 1]) < 2.0))
        seen = y[near] + rng.normal(size=(len(near), 2)) * (0.05, 0.01)
        report = slam.process(km.Scan(0.2 * (k + 1), "r", "l", seen, [[*trees][i] for i in near]))
        removed += [name for name, why in report.removed if why == ELSEWHERE]
    assert removed == []
    assert np.linalg.norm(slam.mean("r")[:2] - pose[:2]) < 0.5
