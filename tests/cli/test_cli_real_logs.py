"""Shipped configurations run the real logs and the recordings of the toolbox without another word."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from command_line import Kalmark

SHORT = {"kitti": 2}  # of the real logs, what takes long


@pytest.mark.parametrize(
    ("name", "log"),
    [
        ("lost_in_the_woods", "lost_in_the_woods"),
        ("mrclam", "mrclam/MRCLAM_Dataset6"),
        ("victoria_park_known", "victoria_park"),
        ("dlr", "dlr"),
        ("freiburg_course", "freiburg_course"),
        ("starry_night", "starry_night"),
        ("kitti", "kitti_stereo_features"),
        ("tagslam", "tagslam_test/test_1"),
    ],
)
def test_a_shipped_configuration_runs_its_log_without_another_word(
    kalmark: Kalmark, data: Callable[[str], Path], tmp_path: Path, name: str, log: str
) -> None:
    data(log)
    done = kalmark("run", name, "--set", f"log.to_s={SHORT.get(name, 60)}")
    assert done.status == 0
    summary = json.loads((tmp_path / "out" / name / "summary.json").read_text())
    assert summary["landmarks"] >= 4
    assert summary["associated"] > 10 * summary["rejected"]
    assert not summary["diverged"]


@pytest.mark.parametrize(
    ("name", "log"),
    [
        ("slamtb", "a_idpPnt_odo_small"),
        ("slamtb", "a3_hmgPnt_odo"),
        ("slamtb", "c_plkLin_small"),
        ("slamtb", "e_omni_ahmPnt"),
    ],
)
def test_a_recording_of_the_toolbox_runs_without_another_word(
    kalmark: Kalmark, oracle: Callable[[str], Path], tmp_path: Path, name: str, log: str
) -> None:
    path = oracle(f"{log}.json.gz")
    done = kalmark("run", name, "--log", f"{path.parent.name}/{path.name}", "--set", "log.to_s=1")
    assert done.status == 0
    assert "(slamtb)" in done.out
    summary = json.loads((tmp_path / "out" / name / "summary.json").read_text())
    assert summary["slamtb"]["ate_raw_m"] < 0.1
    assert summary["robots"]["robot1"]["ate_raw_m"] < 0.2
    assert summary["associated"] > 10 * summary["rejected"]
    assert kalmark("run", f"out/{name}/config.yaml", "--out", "again").status == 0
    again = json.loads((tmp_path / "again" / "summary.json").read_text())
    assert again["robots"] == summary["robots"]


def test_a_converted_recording_describes_its_rig_as_before(
    kalmark: Kalmark, oracle: Callable[[str], Path], tmp_path: Path
) -> None:
    recording = oracle("b2_idpPnt_constVel_small.json.gz")
    assert kalmark("convert", recording, "copy").status == 0
    for run, log in (("native", "copy"), ("direct", recording)):
        assert kalmark("run", "slamtb", "--log", log, "--set", "log.to_s=1", "--out", run).status == 0
    native, direct = (json.loads((tmp_path / run / "summary.json").read_text()) for run in ("native", "direct"))
    assert native["robots"] == direct["robots"]
