"""Simulated scan matching: readings since the last scan and since older ones near by, loops, dropouts, refusals."""

from __future__ import annotations

import numpy as np
import pytest

from kalmark.campaign import run_campaign
from kalmark.errors import ConfigError
from kalmark.events import Scan
from kalmark.geometry.angles import wrap
from kalmark.geometry.frames import compose, inverse
from kalmark.logs.log import Log
from kalmark.simulate import load_world, simulate

REACH_M, S = 0.5, 10**9
MATCHER, KEEP = "robots.rover.sensing.matcher", "robots.rover.sensors.matcher.keep"


def errors(log: Log) -> np.ndarray:
    """Return how far the readings of the matcher (N, 3) are from the true changes of its pose."""
    found, last = [], None
    for scan in (e for e in log if isinstance(e, Scan)):
        for y, begin in zip(scan.y, scan.ids or [None] * len(scan.y), strict=True):
            from_ns = last if begin is None else round(float(begin) * S)
            if from_ns is None:
                continue  # the first scan of all
            a, b = (log.truth["rover"].at(t_ns) for t_ns in (from_ns, scan.t_ns))
            d = y - compose(inverse(a)[0], b)[0]
            found.append([*d[:2], wrap(d[2])])
        last = scan.t_ns
    return np.array(found)


@pytest.mark.parametrize("dropouts", [0.0, 0.3])
@pytest.mark.parametrize("loops", [True, False])
def test_readings_are_of_the_scans_that_they_count_from(loops: bool, dropouts: float) -> None:
    keys = f"every: 10, dropouts: {dropouts}, loop_reach_m: {REACH_M if loops else 'null'}"
    log = simulate(load_world("scan_matching", [f"{MATCHER}={{{keys}}}"]), 1)
    off = errors(log) / [0.02, 0.02, 0.01]
    assert len(off) > 40 and np.abs(off).max() < 4.5
    assert 0.65 < np.mean(off**2) < 1.35


def test_a_loop_counts_from_a_scan_that_the_robot_has_left_and_is_near_again() -> None:
    log = simulate(load_world("scan_matching"), 1)
    closed = [(e.t_ns, round(float(i) * S)) for e in log if isinstance(e, Scan) for i in e.ids or () if i is not None]
    path = log.truth["rover"]
    assert len(closed) > 50
    for now, then in closed:
        between = np.array([path.at(t_ns)[:2] for t_ns in range(then, now, S // 10)])
        assert np.linalg.norm(path.at(now)[:2] - path.at(then)[:2]) <= REACH_M
        assert np.linalg.norm(between - path.at(then)[:2], axis=1).max() > REACH_M


def test_a_campaign_with_loops_is_consistent_and_better_than_one_without() -> None:
    with_, without = (
        run_campaign(load_world("scan_matching", ["steps=600", f"{MATCHER}.loop_reach_m={reach}"]), 12).summary()
        for reach in ("0.5", "null")
    )
    both = [summary["estimators"]["invariant"] for summary in (with_, without)]
    assert 2.0 < both[0]["pose_anees"] < 4.0 and both[0]["position_rmse_m"] < 0.8 * both[1]["position_rmse_m"]


def test_loops_of_a_matcher_that_keeps_no_earlier_poses_are_refused() -> None:
    with pytest.raises(
        ConfigError, match="loop_reach_m of an odometer whose keep is 0, or 2 or more, not of 'matcher'"
    ):
        load_world("scan_matching", [f"{KEEP}=1"])


def test_a_filter_that_foresees_the_loops_of_a_campaign_keeps_no_other_poses_and_finds_the_same() -> None:
    all_, needed = (
        run_campaign(load_world("scan_matching", ["steps=600", f"{KEEP}={keep}"]), 2).summary() for keep in (100, 0)
    )
    both = [summary["estimators"]["invariant"] for summary in (all_, needed)]
    assert both[1]["pose_anees"] == pytest.approx(both[0]["pose_anees"], rel=1e-6)
