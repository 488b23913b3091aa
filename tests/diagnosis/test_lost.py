"""A robot that nothing places any more at the end of a run is lost: its path is wrong."""

from __future__ import annotations

import numpy as np
import pytest

import kalmark as km
from kalmark.diagnosis.verdict import diagnose
from kalmark.results.run import Run


def run_of(begin: int, end: int, every: int = 1, fixes: bool = False) -> Run:
    """Return the run of a robot with a receiver, each of so many of whose readings in an interval, s, are anywhere."""
    rng, x, events = np.random.default_rng(5), np.zeros(3), list[km.Control | km.Scan | km.Fix]()
    for t_s in range(100):
        events.append(km.Control(t_s, "r", [1.0 + rng.normal(0.0, 0.05), 0.1 + rng.normal(0.0, 0.02)]))
        x += [np.cos(x[2] + 0.05), np.sin(x[2] + 0.05), 0.1]
        y = x[:2] + rng.normal(0.0, 0.5, 2)
        if begin <= t_s < end and t_s % every == 0:
            y = rng.uniform(-2000.0, 2000.0, 2)
        events.append(km.Fix(t_s + 1, "r", y, 0.25 * np.eye(2)) if fixes else km.Scan(t_s + 1, "r", "gps", y[None]))
    sensors = {"gps": km.Mount(km.sensors.Gps2D(0.5))}
    return km.record(km.Slam(km.Robot("r", km.motion.Unicycle(0.05, 0.02), sensors=sensors)), events, progress=False)


@pytest.mark.parametrize("fixes", [False, True], ids=["readings", "fixes"])
def test_a_robot_whose_last_positions_are_all_left_out_is_lost(fixes: bool) -> None:
    verdict = diagnose(run_of(50, 100, fixes=fixes))
    assert verdict.map == "wrong"
    (lost,) = (cause for cause in verdict.causes if cause.name == "lost")
    assert lost.since_s == 51.0
    assert "the last 50 " + ("fixes" if fixes else "readings of gps") + " of r" in lost.evidence


@pytest.mark.parametrize("wrong", [(50, 70, 1), (0, 100, 3), (80, 100, 1)], ids=["some time", "outliers", "the end"])
def test_a_robot_that_is_placed_until_shortly_before_the_end_is_not_lost(wrong: tuple[int, int, int]) -> None:
    verdict = diagnose(run_of(*wrong))
    assert verdict.map != "wrong" and "lost" not in [cause.name for cause in verdict.causes]
