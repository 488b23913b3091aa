"""The command line: what each verb leaves behind."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import kalmark.models.landmarks
import kalmark.models.motion
import kalmark.models.sensors  # noqa: F401 - these register their models
from command_line import Kalmark, refused, write_log_of_space
from kalmark.declare import built_in
from kalmark.results.figure_texts import figure
from kalmark.results.measures import anees_interval


def test_run_writes_the_run_folder_and_prints_its_figures(kalmark: Kalmark, log: Path, tmp_path: Path) -> None:
    done = kalmark("run", "native", "--log", log)
    assert done.status == 0
    assert "landmarks in the map" in done.out
    assert "out/native" in done.out
    folder = tmp_path / "out" / "native"
    summary = json.loads((folder / "summary.json").read_text())
    assert (summary["controls"], summary["scans"], summary["observations"]) == (20, 20, 60)
    assert (summary["associated"], summary["new"], summary["landmarks"]) == (57, 3, 3)
    assert summary["robots"]["rover"]["ate_raw_m"] < 1e-6
    assert summary["landmark_rmse_raw_m"] < 1e-6
    for name in ("config.yaml", "trajectory_rover.tum", "landmarks.csv", "associations.csv", "history.npz", "map.png"):
        assert (folder / name).is_file(), name


def test_run_maps_in_space(kalmark: Kalmark, tmp_path: Path) -> None:
    log = write_log_of_space(tmp_path / "log")
    types = ["robots.each.motion.type=odometry_3d", "robots.each.sensors.lidar.type=range_bearing_3d"]
    settings = [*types, "robots.each.sensors.lidar.mount.z_m=0.5"]
    done = kalmark("run", "native", "--log", log, *(word for s in settings for word in ("--set", s)))
    assert done.status == 0
    folder = tmp_path / "out" / "native"
    summary = json.loads((folder / "summary.json").read_text())
    assert (summary["associated"], summary["new"], summary["landmarks"]) == (72, 4, 4)
    assert summary["robots"]["drone"]["ate_raw_m"] < 1e-6
    assert summary["robots"]["drone"]["heading_rmse_deg"] < 1e-4
    assert summary["landmark_rmse_raw_m"] < 1e-6
    assert (folder / "landmarks.csv").read_text().startswith("id,kind,x_m,y_m,z_m,")
    assert kalmark("run", folder / "config.yaml", "--out", "again").status == 0
    assert (tmp_path / "again" / "landmarks.csv").read_bytes() == (folder / "landmarks.csv").read_bytes()
    assert kalmark("evaluate", folder).status == 0
    assert kalmark("report", folder).status == 0


def test_the_saved_configuration_runs_again_to_the_same_map(kalmark: Kalmark, log: Path, tmp_path: Path) -> None:
    overrides = ["--set", "robots.each.motion.sigma_v_mps=0.3", "--set", "estimator.type=ekf"]
    assert kalmark("run", "native", "--log", log, *overrides, "--out", "first").status == 0
    assert "sigma_v_mps: 0.3" in (tmp_path / "first" / "config.yaml").read_text()
    again = kalmark("run", "first/config.yaml", "--out", "second")
    assert again.status == 0
    assert again.out.startswith("first on log"), "it is called by its folder, not config like all of them"
    first, second = ((tmp_path / name / "landmarks.csv").read_bytes() for name in ("first", "second"))
    assert first == second


def test_a_log_beside_the_configuration_is_found(kalmark: Kalmark, log: Path, tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    log.rename(tmp_path / "mine" / "log")
    config = tmp_path / "mine" / "my.yaml"
    config.write_text("log: {path: log}\nrobots: {rover: {sensors: {lidar: {type: range_bearing}}}}\n")
    assert kalmark("run", config).status == 0
    assert (tmp_path / "out" / "my" / "summary.json").is_file()


def test_evaluate_and_report_work_from_the_folder_alone(kalmark: Kalmark, log: Path, tmp_path: Path) -> None:
    kalmark("run", "native", "--log", log, "--out", "run")
    figures = json.loads(kalmark("evaluate", "run", "--json").out)
    assert figures["landmarks"] == 3
    told = kalmark("evaluate", "run", "--truth", log).out
    most = figure(figures["robots"]["rover"]["pose_nees_most"], 2)
    assert f"consistent pose NEES: 3 averaged over many runs, up to {most} in this one\n" in told
    (heads,) = (line.rstrip() for line in told.splitlines() if "position RMSE" in line)
    assert heads.endswith("pose NEES")
    assert len(heads) <= 80
    (tmp_path / "run" / "map.png").unlink()
    assert kalmark("report", "run").status == 0
    assert (tmp_path / "run" / "map.png").is_file()


def test_simulate_then_run_then_convert(kalmark: Kalmark, tmp_path: Path) -> None:
    assert kalmark("simulate", "cloister", "--out", "log", "--seed", "3", "--set", "steps=30").status == 0
    assert kalmark("convert", "log", "copy").status == 0
    for name in ("controls.csv", "scans.csv", "truth.csv", "landmarks.csv"):
        assert (tmp_path / "log" / name).read_bytes() == (tmp_path / "copy" / name).read_bytes()
    assert kalmark("run", "cloister", "--log", "copy").status == 0
    summary = json.loads((tmp_path / "out" / "cloister" / "summary.json").read_text())
    assert summary["frame"] == "truth"
    assert summary["landmarks"] == 30


def test_the_shipped_cloister_is_what_the_world_is_simulated_with() -> None:
    from kalmark.config import load_config
    from kalmark.simulate import load_world

    (simulated,) = load_world("cloister").config().robots.values()
    each = load_config("cloister").robots["each"]
    assert (each.motion, each.sensors) == (simulated.motion, simulated.sensors)


def test_a_campaign_prints_estimators_side_by_side(kalmark: Kalmark, tmp_path: Path) -> None:
    small = ["--runs", "2", "--jobs", "1", "--set", "steps=10"]
    done = kalmark("campaign", "cloister", *small, "--estimator", "invariant", "--estimator", "ekf", "--out", "mc")
    assert done.status == 0
    assert "joint state" in done.out
    summary = json.loads((tmp_path / "mc" / "summary.json").read_text())
    assert list(summary["estimators"]) == ["invariant", "ekf"]
    low, high = anees_interval(3, 2)
    assert summary["band"]["pose"] == pytest.approx([low, high])
    (pose,) = (line for line in done.out.splitlines() if line.strip().startswith("pose (3)"))
    assert f"{low:.2f} to {high:.2f}" in pose
    for label, key in (("aligned", "landmark_rmse_m"), ("raw", "landmark_rmse_raw_m")):
        (line,) = (line for line in done.out.splitlines() if f"landmark RMSE, {label}, m" in line)
        assert line.split()[-2] == f"{summary['estimators']['invariant'][key]:.3f}"


def test_data_list_names_every_dataset(kalmark: Kalmark) -> None:
    done = kalmark("data", "list")
    assert done.status == 0
    plane = ("lost_in_the_woods", "mrclam/MRCLAM_Dataset6", "victoria_park", "dlr", "freiburg_course")
    for name in (*plane, "kitti_stereo_features", "tagslam", "starry_night", "slamtb"):
        assert name in done.out


SENSOR = """\
import numpy as np

class Sensor:
    columns = ("x_m",)
    angular = (False,)
    def expect(self, v):
        E_v = np.zeros((len(v), 1, 2)); E_v[:, 0, 0] = {slope}
        return 2 * v[:, :1], E_v
    def noise(self, y):
        return np.ones((len(y), 1, 1))
"""


def test_check_passes_a_right_model_and_names_a_wrong_jacobian(kalmark: Kalmark, tmp_path: Path) -> None:
    (tmp_path / "right.py").write_text(SENSOR.format(slope=2))
    (tmp_path / "wrong.py").write_text(SENSOR.format(slope=3))
    assert kalmark("check", "right.py:Sensor").status == 0
    done = kalmark("check", "wrong.py:Sensor")
    assert done.status == 2
    assert done.err.startswith("kalmark: wrong.py:Sensor: E_v differs by 0.33 at v = (")
    for name, what in (
        ("right.py", "expected module:Class"),
        ("right.py:No", "has no No"),
        ("nix:No", "cannot be imp"),
    ):
        assert what in refused(kalmark("check", name))


BUILT_IN = [f"{own.__module__}:{own.__name__}" for role in ("motion", "sensor", "landmark") for own in built_in(role)]


@pytest.mark.parametrize("name", BUILT_IN)
def test_check_passes_what_kalmark_brings(kalmark: Kalmark, name: str) -> None:
    done = kalmark("check", name)
    assert (done.status, done.err) == (0, "")
