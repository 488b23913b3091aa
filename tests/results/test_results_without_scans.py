"""Runs of logs without scans: the path is kept after each fix, without fixes after each control."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import kalmark as km
from kalmark.logs import log_from
from kalmark.results.run import Run

T = np.arange(0, 10, 0.1)


def run_of(fixes: bool) -> Run:
    """Return the run of a robot that drives straight on, with the truth of its path."""
    controls = {"t_s": T, "robot": "rover", "v_mps": 1.0, "w_radps": 0.0}
    truth = {"t_s": T, "robot": "rover", "x_m": T, "y_m": 0.0, "theta_rad": 0.0}
    places = {"t_s": T[5::10], "robot": "rover", "x_m": T[5::10], "y_m": 0.05, "sigma_x_m": 0.1, "sigma_y_m": 0.1}
    log = log_from(controls=controls, truth=truth, fixes=places if fixes else None)
    return km.record(km.Slam(km.Robot("rover", km.motion.Unicycle(0.1, 0.05))), log, progress=False)


@pytest.mark.parametrize(("fixes", "steps"), [(True, 10), (False, 100)])
def test_a_run_without_scans_has_a_path_that_is_scored_saved_and_drawn(fixes: bool, steps: int, tmp_path: Path) -> None:
    run = run_of(fixes)
    history = run.history
    assert history.stepped == ("fix" if fixes else "control") and history.scans == 0
    np.testing.assert_array_equal(history.t_ns, np.round(T[5::10] * 1e9) if fixes else np.round(T * 1e9))
    np.testing.assert_allclose(history.poses[:, 0], history.t_s + history.t_ns[0] * 1e-9, atol=0.05)
    summary = run.evaluate()
    figures = summary["robots"]["rover"]
    assert (summary["scans"], summary["fixes"], figures["scans"]) == (0, 10 if fixes else 0, 0)
    assert summary["events"] == 100 + summary["fixes"] and figures["ate_raw_m"] < 0.1
    assert not [line for line in summary["warnings"] if "map" in line]
    run.save(tmp_path / "out")
    assert len((tmp_path / "out" / "trajectory_rover.tum").read_text().splitlines()) == steps + 1
    loaded = Run.load(tmp_path / "out")
    assert loaded.history.stepped == history.stepped and loaded.evaluate()["robots"] == summary["robots"]
    np.testing.assert_array_equal(loaded.history.mean, history.mean)


def test_a_fix_corrects_the_pose_that_is_kept() -> None:
    with_, without = run_of(True), run_of(False)
    assert np.trace(with_.history.covariance[-1]) < np.trace(without.history.covariance[-1])
