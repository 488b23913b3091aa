"""Runs of robots whose sensors see no landmark: a path is judged, drawn and printed, and no map is missed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import kalmark as km
from kalmark.diagnosis.trials import MOST
from kalmark.diagnosis.verdict import diagnose
from kalmark.results.evaluate import headline
from kalmark.results.run import Run
from kalmark.results.verdict_text import verdict_lines
from kalmark.results.warnings import autocorrelations

STEPS, DT = 600, 0.1


def run_of(
    sigma_m: float = 0.5, bias_radps: float = 0.0, outliers: int = 0, steps: int = STEPS, seed: int = 1,
    jump_m: float = 0.0,
) -> Run:  # fmt: skip
    """Return the run of a robot with wheels, a gyroscope of a bias and a receiver of 0.5 m, stated as `sigma_m`.

    From 20 to 60 s the receiver is off by `jump_m` on each axis.
    """
    rng, x, events = np.random.default_rng(seed), np.zeros(3), list[Any]()
    for k in range(steps):
        v, w = 1.0, 0.05 + 0.15 * np.sin(k * DT / 9)
        events.append(km.Control(k * DT, "rover", [v + rng.normal(0, 0.1), w + rng.normal(0, 0.1)]))
        x += DT * np.array([v * np.cos(x[2] + w * DT / 2), v * np.sin(x[2] + w * DT / 2), w])
        t_s = round((k + 1) * DT, 6)
        events.append(km.Scan(t_s, "rover", "gyro", [[w + bias_radps + rng.normal(0, 0.005)]]))
        if k % 5 == 4:
            off = 500.0 if k // 5 in range(3, 3 * outliers + 3, 3) else jump_m if 200 <= k < 600 else 0.0
            events.append(km.Scan(t_s, "rover", "receiver", [x[:2] + rng.normal(0, 0.5, 2) + off]))
    sensors = {"gyro": km.Mount(km.sensors.Gyro2D(0.005)), "receiver": km.Mount(km.sensors.Gps2D(sigma_m))}
    slam = km.Slam(km.Robot("rover", motion=km.motion.Unicycle(0.1, 0.1), sensors=sensors))
    return km.record(slam, events, progress=False)


def test_a_path_without_landmarks_is_judged_as_a_path(tmp_path: Path) -> None:
    run = run_of()
    summary = run.evaluate()
    assert summary["warnings"] == [] and summary["landmarks"] == 0
    assert diagnose(run, brief=True).map == "ok"
    assert [*verdict_lines(run.summary["verdict"])] == [
        "the path is ok, by innovations alone, no batch solution: no sensor observes landmarks"
    ]
    assert headline(run)[1][0] == f"{STEPS + STEPS // 5} scans"
    run.save(tmp_path / "out")
    loaded = Run.load(tmp_path / "out")
    assert loaded.evaluate()["warnings"] == [] and loaded.history.localizes


@pytest.mark.parametrize(
    ("keys", "name", "cure", "value"),
    [
        ({"sigma_m": 0.2}, "reading_sigma", "receiver.sigma_m", 0.5),
        ({"bias_radps": 0.03}, "reading_offset", "gyro.bias_radps", 0.03),
    ],
    ids=["noise", "bias"],
)
def test_readings_that_are_off_make_a_path_doubtful_and_say_why(
    keys: dict[str, float], name: str, cure: str, value: float
) -> None:
    verdict = diagnose(run_of(**keys))
    assert (verdict.map, verdict.causes[0].name) == ("doubtful", name)
    key, found = verdict.causes[0].cure.removeprefix("--set robots.rover.sensors.").split("=")
    assert key == cure and float(found) == pytest.approx(value, rel=0.2)


def test_a_few_outliers_do_not_make_a_path_doubtful() -> None:
    run = run_of(outliers=5)
    assert np.sum(run.history.outcome == "rejected") == 5
    assert diagnose(run, brief=True).map == "ok"


def test_single_numbers_that_are_white_make_no_path_doubtful() -> None:
    """Of 40 windows of 60 pairs one has an autocorrelation of .56 by chance: of two numbers that would be none."""
    run = run_of(steps=2400, seed=2)
    assert max(w.value for w in autocorrelations(run.history)) > 0.5
    assert diagnose(run, brief=True).map == "ok"


def test_a_path_that_a_receiver_moved_to_and_fro_is_doubtful_and_says_so(tmp_path: Path) -> None:
    run = run_of(jump_m=20.0, steps=1000)
    run.save(tmp_path)
    for one in (run, Run.load(tmp_path)):
        moved = [(each.robot, each.sensor) for each in one.history.placed]
        assert moved == [("rover", "receiver")] * 2
        assert any("of receiver that agree moved rover by 28, 28 m" in line for line in one.evaluate()["warnings"])
    verdict = diagnose(run, brief=True)
    assert verdict.map == "doubtful"
    (cause,) = (c for c in verdict.causes if c.evidence.startswith("readings of receiver that agree moved rover by"))
    left_out = np.sum(run.history.outcome == "rejected")
    assert cause.score == 0.5 * MOST * 2 * left_out, "no reading counts more than 25 for each number"
