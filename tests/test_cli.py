"""The command line: what each verb leaves behind, and how it refuses bad input."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from kalmark.cli import main

SHORT = {"kitti": 2}  # of the real logs, what takes long
LANDMARKS = {1: (3.0, 1.0), 2: (1.0, -2.0), 3: (4.0, -1.0)}


class Done(NamedTuple):
    status: int
    out: str
    err: str


Kalmark = Callable[..., Done]


@pytest.fixture
def kalmark(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Kalmark:
    """Run the command line in an empty folder; whether it has to compile first is not what these tests look at."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("kalmark.cli.options.say_compiling", lambda: None)

    def run(*arguments: str | Path) -> Done:
        status = main([str(a) for a in arguments])
        captured = capsys.readouterr()
        return Done(status, captured.out, captured.err)

    return run


def write_log(folder: Path) -> Path:
    """Write a small native log: a robot that drives straight past three landmarks at 0.5 m/s."""
    controls, scans, truth = ["t_s,robot,v_mps,w_radps"], ["t_s,robot,sensor,id,range_m,bearing_rad"], []
    for k in range(20):
        t, x = 0.1 * k, 0.05 * k
        controls.append(f"{t:.1f},rover,0.5,0.0")
        truth.append(f"{t:.1f},rover,{x},0.0,0.0")
        for i, (lx, ly) in LANDMARKS.items():
            scans.append(f"{t:.1f},rover,lidar,{i},{math.hypot(lx - x, ly)},{math.atan2(ly, lx - x)}")
    tables = {
        "controls": controls,
        "scans": scans,
        "truth": ["t_s,robot,x_m,y_m,theta_rad", *truth],
        "landmarks": ["id,x_m,y_m", *(f"{i},{x},{y}" for i, (x, y) in LANDMARKS.items())],
    }
    folder.mkdir()
    for name, lines in tables.items():
        (folder / f"{name}.csv").write_text("\n".join(lines) + "\n")
    return folder


@pytest.fixture
def log(tmp_path: Path) -> Path:
    return write_log(tmp_path / "log")


def write_log_of_space(folder: Path) -> Path:
    """Write a small native log of space: a robot climbs and turns past four landmarks, a lidar above it."""
    landmarks = np.array([[3.0, 1.0, 0.5], [1.0, -2.0, 1.0], [4.0, -1.0, -0.5], [2.0, 2.0, 2.0]])
    u = np.array([0.1, 0.0, 0.02, 0.0, 0.01, 0.05])
    position, turn = np.zeros(3), Rotation.identity()
    controls, truth = ["t_s,robot,dx_m,dy_m,dz_m,rx_rad,ry_rad,rz_rad"], ["t_s,robot,x_m,y_m,z_m,qx,qy,qz,qw"]
    scans = ["t_s,robot,sensor,id,range_m,azimuth_rad,elevation_rad"]
    truth.append("0.0,drone,0,0,0,0,0,0,1")
    for k in range(1, 20):
        t = f"{0.1 * k:.1f},drone"
        position, turn = position + turn.apply(u[:3]), turn * Rotation.from_rotvec(u[3:])
        controls.append(",".join([t, *map(repr, u.tolist())]))
        truth.append(",".join([t, *map(repr, [*position.tolist(), *turn.as_quat().tolist()])]))
        for i, (x, y, z) in enumerate(turn.inv().apply(landmarks - position) - [0, 0, 0.5]):
            scans.append(f"{t},lidar,{i},{math.hypot(x, y, z)},{math.atan2(y, x)},{math.atan2(z, math.hypot(x, y))}")
    folder.mkdir()
    named = {"controls": controls, "scans": scans, "truth": truth}
    named["landmarks"] = ["id,x_m,y_m,z_m", *(f"{i},{x},{y},{z}" for i, (x, y, z) in enumerate(landmarks))]
    for name, lines in named.items():
        (folder / f"{name}.csv").write_text("\n".join(lines) + "\n")
    return folder


def refused(done: Done) -> str:
    """Return the one line of a refusal."""
    assert done.status == 2
    assert done.out == ""
    assert done.err.startswith("kalmark: ")
    assert done.err.count("\n") == 1
    return done.err.removeprefix("kalmark: ").strip()


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


def test_the_saved_configuration_runs_again_to_the_same_map(kalmark: Kalmark, log: Path, tmp_path: Path) -> None:
    overrides = ["--set", "robots.each.motion.sigma_v_mps=0.3", "--set", "estimator.type=ekf"]
    assert kalmark("run", "native", "--log", log, *overrides, "--out", "first").status == 0
    assert "sigma_v_mps: 0.3" in (tmp_path / "first" / "config.yaml").read_text()
    assert kalmark("run", "first/config.yaml", "--out", "second").status == 0
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
    assert "position RMSE" in kalmark("evaluate", "run", "--truth", log).out
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


def test_data_list_names_every_dataset(kalmark: Kalmark) -> None:
    done = kalmark("data", "list")
    assert done.status == 0
    for name in ("lost_in_the_woods", "mrclam/MRCLAM_Dataset6", "victoria_park", "dlr", "freiburg_course"):
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


BUILT_IN = [
    *(f"motion:{name}" for name in ("Odometry2D", "Unicycle", "Ackermann")),
    *(f"sensors:{name}" for name in ("RangeBearing", "Bearing", "Range", "Position2D", "RangeBearingSignature")),
    *(f"landmarks:{name}" for name in ("Point2D", "PointSignature2D")),
]


@pytest.mark.parametrize("name", BUILT_IN)
def test_check_passes_what_kalmark_brings(kalmark: Kalmark, name: str) -> None:
    done = kalmark("check", f"kalmark.models.{name}")
    assert (done.status, done.err) == (0, "")


# ---------------------------------------------------------------------- bad input
BAD_ROWS = [
    ("not a number", "scans.csv", 5, "0.1,rover,lidar,1,nan,0.1", "nan"),
    ("infinite", "controls.csv", 5, "0.3,rover,inf,0.0", "inf"),
    ("a text", "controls.csv", 5, "0.3,rover,fast,0.0", "fast"),
    ("a negative range", "scans.csv", 5, "0.1,rover,lidar,1,-2.5,0.1", "-2.5"),
    ("a cell too few", "scans.csv", 5, "0.1,rover,lidar,1,2.5", "5"),
    ("a cell too many", "controls.csv", 5, "0.3,rover,0.5,0.0,7", "5"),
    ("a truncated row", "controls.csv", 21, "1.9,rov", "2"),
    ("a landmark twice in a scan", "scans.csv", 6, "0.1,rover,lidar,1,2.5,0.1", "1"),
    ("time running backwards", "truth.csv", 5, "0.05,rover,0,0,0", "0.05"),
    ("no time", "scans.csv", 5, ",rover,lidar,1,2.5,0.1", "t_s"),
    ("no robot", "scans.csv", 5, "0.1,,lidar,1,2.5,0.1", "robot"),
]


@pytest.mark.parametrize(("name", "line", "row", "value"), [b[1:] for b in BAD_ROWS], ids=[b[0] for b in BAD_ROWS])
def test_a_bad_row_is_refused_by_file_and_line(
    kalmark: Kalmark, log: Path, tmp_path: Path, name: str, line: int, row: str, value: str
) -> None:
    lines = (log / name).read_text().splitlines()
    lines[line - 1] = row
    (log / name).write_text("\n".join(lines) + "\n")
    message = refused(kalmark("run", "native", "--log", log))
    assert message.startswith(f"{log / name}:{line}:")
    assert value in message
    assert "expected" in message
    assert not (tmp_path / "out").exists()


def with_columns(log: Path, name: str, header: str, cells: str) -> None:
    first, *rows = (log / name).read_text().splitlines()
    (log / name).write_text("\n".join([first + header, *(row + cells for row in rows)]) + "\n")


@pytest.mark.parametrize(
    ("name", "header", "cells", "value"),
    [
        ("scans.csv", ",sigma_range_m,sigma_bearing_rad", ",0.1,0", "definite"),
        ("scans.csv", ",sigma_range_m,sigma_bearing_rad", ",-0.1,0.1", "-0.1"),
        ("scans.csv", ",cov_00,cov_01,cov_11", ",1,2,1", "definite"),
        ("controls.csv", ",cov_00,cov_01,cov_11", ",1,2,1", "semidefinite"),
    ],
)
def test_noise_that_is_no_covariance_is_refused(
    kalmark: Kalmark, log: Path, tmp_path: Path, name: str, header: str, cells: str, value: str
) -> None:
    with_columns(log, name, header, cells)
    message = refused(kalmark("run", "native", "--log", log))
    assert value in message
    assert "expected" in message
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", ["controls.csv", "scans.csv"])
@pytest.mark.parametrize("text", ["", "t_s\n", "\x00\x01"], ids=["empty", "header cut off", "binary"])
def test_an_empty_or_truncated_file_is_refused(
    kalmark: Kalmark, log: Path, tmp_path: Path, name: str, text: str
) -> None:
    (log / name).write_text(text)
    message = refused(kalmark("run", "native", "--log", log))
    assert message.startswith(str(log / name))
    assert "expected" in message
    assert not (tmp_path / "out").exists()


def test_a_robot_or_sensor_without_configuration_is_refused(kalmark: Kalmark, log: Path, tmp_path: Path) -> None:
    config = tmp_path / "my.yaml"
    config.write_text("log: {path: log}\nrobots:\n  rovr: {motion: {type: unicycle}}\n")
    message = refused(kalmark("run", config))
    assert message == (
        f"{config}:3:9: robots.rovr: got a robot that the log does not have, expected one of rover; did you mean rover?"
    )
    config.write_text("log: {path: log}\nrobots:\n  each: {sensors: {radar: {type: range_bearing}}}\n")
    message = refused(kalmark("run", config))
    assert message == (
        f"{log}: rover has scans of the sensor 'lidar', expected one of radar; add robots.each.sensors.lidar"
    )
    assert not (tmp_path / "out").exists()


def test_a_motion_that_does_not_fit_the_controls_is_refused(kalmark: Kalmark, log: Path) -> None:
    message = refused(kalmark("run", "native", "--log", log, "--set", "robots.each.motion.type=odometry_2d"))
    assert message == (
        f"{log}: the controls of rover have the columns v_mps, w_radps, expected dx_m, dy_m, dtheta_rad of its motion "
        "odometry_2d; try --set robots.each.motion.type=unicycle"
    )
    controls = (log / "controls.csv").read_text()
    (log / "controls.csv").write_text(controls.replace("v_mps", "v", 1))
    message = refused(kalmark("run", "native", "--log", log))
    assert message == (
        f"{log}: the controls of rover have the columns w_radps, v, expected v_mps, w_radps of its motion unicycle"
    )


@pytest.mark.parametrize(
    ("arguments", "what"),
    [
        (["run", "mrclm"], "did you mean mrclam?"),
        (["run", "native"], "log.path: got nothing, expected the path of a log"),
        (["run", "native", "--log", "nowhere"], "log 'nowhere' not found, expected it at"),
        (
            ["run", "native", "--log", "log", "--set", "log.r_max=1"],
            "log.r_max: got 1.0, which logs of format native do",
        ),
        (
            ["run", "native", "--log", "log", "--set", "log.format=nativ"],
            "log.format: got 'nativ', expected one of nati",
        ),
        (
            ["run", "native", "--log", "log", "--set", "robots.each.motion.sigma_v_mps=-1"],
            "got -1, expected a number >=",
        ),
        (["run", "native", "--log", "log", "--set", "robots.each.start.sigma_xy_m=.nan"], "got nan, expected a finite"),
        (
            ["run", "native", "--log", "log", "--set", "log.from_s=1", "--set", "log.to_s=0"],
            "no event from 1.0 to 0.0 s",
        ),
        (["run", "native", "--log", "log", "--out", "log/scans.csv"], "scans.csv is a file, expected a folder"),
        (["run", "native", "--on-error", "ignore"], "'ignore'"),
        (["run", "native", "--lgo", "log"], "No such option: --lgo"),
        (["run"], "Missing argument 'CONFIG'"),
        (["evaluate", "log"], "summary.json: no such file, expected the folder of a complete run"),
        (["report", "nowhere"], "summary.json: no such file, expected the folder of a complete run"),
        (["simulate", "cloistr", "--out", "x"], "did you mean cloister?"),
        (
            ["simulate", "cloister", "--out", "x", "--set", "steps=0"],
            "--set steps=0: steps: got 0, expected a number >= 1",
        ),
        (["campaign", "cloister", "--runs", "1", "--estimator", "efk"], "did you mean ekf?"),
        (["convert", "nowhere", "x"], "log 'nowhere' not found"),
        (["data", "fetch", "mrclm"], "dataset 'mrclm' is unknown, expected one of"),
        (["nonsense"], "No such command 'nonsense'"),
        *[([verb, "x"], f"{verb} is not available yet") for verb in ("view", "diagnose", "explain", "tune", "live")],
    ],
)
def test_bad_arguments_are_refused_in_one_line(
    kalmark: Kalmark, log: Path, tmp_path: Path, arguments: list[str], what: str
) -> None:
    assert what in refused(kalmark(*arguments))
    assert [path.name for path in tmp_path.iterdir()] == ["log"]


def test_on_error_skip_counts_and_lists_what_it_leaves_out(kalmark: Kalmark, log: Path, tmp_path: Path) -> None:
    lines = (log / "scans.csv").read_text().splitlines()
    lines[4] = "0.1,rover,lidar,1,nan,0.1"
    lines[7] = "0.2,rover,radar,1,2.5,0.1"
    (log / "scans.csv").write_text("\n".join(lines) + "\n")
    done = kalmark("run", "native", "--log", log, "--on-error", "skip")
    assert done.status == 0
    assert "3 left out:" in done.out
    assert f"{log / 'scans.csv'}:5:" in done.out
    assert "radar" in done.out
    summary = json.loads((tmp_path / "out" / "native" / "summary.json").read_text())
    assert (summary["skipped"], summary["observations"]) == (3, 56)


# ---------------------------------------------------------------------- the door itself
def test_version_and_help(kalmark: Kalmark) -> None:
    assert kalmark("--version").out.startswith("kalmark ")
    done = kalmark("--help")
    assert done.status == 0
    for verb in ("demo", "run", "simulate", "evaluate", "report", "view", "campaign", "diagnose", "explain", "tune"):
        assert verb in done.out
    assert kalmark().status == 2


def test_help_does_not_wait_for_the_numerical_libraries() -> None:
    program = (
        "import sys; from kalmark.cli import main; main(['--help']); "
        "sys.exit(any(m in sys.modules for m in ('numpy', 'scipy', 'numba', 'matplotlib', 'pydantic')))"
    )
    assert subprocess.run([sys.executable, "-c", program], capture_output=True, check=False).returncode == 0


def test_a_bug_exits_with_1_and_its_traceback() -> None:
    program = (
        "import sys, kalmark.cli.app as app, kalmark.cli.run as run\n"
        "def bug(*a, **k): raise ZeroDivisionError('a bug')\n"
        "run.run_log = bug\n"
        "sys.exit(app.main(['run', 'native']))\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "Traceback" in done.stderr
    assert done.stderr.endswith("ZeroDivisionError: a bug\n")


def test_an_interrupt_is_one_line(kalmark: Kalmark, monkeypatch: pytest.MonkeyPatch) -> None:
    import kalmark.cli.run

    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(kalmark.cli.run, "run_log", interrupt)
    assert main(["run", "native"]) == 130


def test_run_prints_what_to_look_at_twice_after_the_table(kalmark: Kalmark, log: Path, tmp_path: Path) -> None:
    scans = (log / "scans.csv").read_text().splitlines()
    nameless = [scans[0], *(",".join([*line.split(",")[:3], "", *line.split(",")[4:]]) for line in scans[1:])]
    (log / "scans.csv").write_text("\n".join(nameless) + "\n")
    done = kalmark("run", "native", "--log", log)
    assert done.status == 0
    line = "60 observations have no id and were ignored; try --set association.type=nearest"
    assert f"warning: {line}" in done.out.splitlines()
    assert line in json.loads((tmp_path / "out" / "native" / "summary.json").read_text())["warnings"]


def test_a_filter_that_stops_leaves_its_folder_and_status_2(
    kalmark: Kalmark, log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from kalmark.errors import DivergedError
    from kalmark.slam.slam import Slam

    def refuse(slam: Slam, event: object) -> None:
        raise DivergedError("the innovation is absurd")

    monkeypatch.setattr(Slam, "process", refuse)
    done = kalmark("run", "native", "--log", log)
    assert done.status == 2
    assert "warning: the filter stopped: the innovation is absurd" in done.out.splitlines()
    assert (tmp_path / "out" / "native" / "summary.json").is_file()
