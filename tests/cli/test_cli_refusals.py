"""Bad input on the command line: one line, status 2, nothing left behind."""

from __future__ import annotations

import errno
import json
import re
import shutil
from pathlib import Path

import pytest

from command_line import Kalmark, refused

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
        f"{config}:3:27: robots.each.sensors.radar: the log has no scans by it, expected 'lidar' as in "
        f"{log / 'scans.csv'}:2; if that is another sensor, add robots.each.sensors.lidar"
    )
    assert not (tmp_path / "out").exists()


def test_a_motion_that_does_not_fit_the_controls_is_refused(kalmark: Kalmark, log: Path) -> None:
    message = refused(kalmark("run", "native", "--log", log, "--set", "robots.each.motion.type=odometry_2d"))
    assert message == (
        f"{log / 'controls.csv'}:1: the controls of rover have the columns v_mps, w_radps, expected dx_m, dy_m, "
        "dtheta_rad of its motion odometry_2d; try --set robots.each.motion.type=unicycle"
    )
    controls = (log / "controls.csv").read_text()
    (log / "controls.csv").write_text(controls.replace("v_mps", "v_mp", 1))
    message = refused(kalmark("run", "native", "--log", log))
    assert message == (
        f"{log / 'controls.csv'}:1: the controls of rover have the columns w_radps, v_mp, expected v_mps, w_radps of "
        "its motion unicycle; did you mean v_mps?"
    )


def test_scans_that_do_not_fit_their_sensor_are_refused_not_taken_in_another_order(kalmark: Kalmark, log: Path) -> None:
    message = refused(kalmark("run", "native", "--log", log, "--set", "robots.each.sensors.lidar.type=range"))
    assert message == (
        f"{log / 'scans.csv'}:1: the scans of rover by lidar have the columns range_m, bearing_rad, expected range_m "
        "of its type range; try --set robots.each.sensors.lidar.type=range_bearing"
    )
    scans = (log / "scans.csv").read_text()
    (log / "scans.csv").write_text(scans.replace("range_m", "rage_m", 1))
    message = refused(kalmark("run", "native", "--log", log))
    assert message == (
        f"{log / 'scans.csv'}:1: the scans of rover by lidar have the columns bearing_rad, rage_m, expected range_m, "
        "bearing_rad of its type range_bearing; did you mean range_m?"
    )


def test_a_misspelt_sensor_in_one_line_is_refused_by_file_and_line(kalmark: Kalmark, log: Path) -> None:
    lines = (log / "scans.csv").read_text().splitlines()
    lines[7] = lines[7].replace("lidar", "lidr")
    (log / "scans.csv").write_text("\n".join(lines) + "\n")
    assert refused(kalmark("run", "native", "--log", log)) == (
        f"{log / 'scans.csv'}:8: rover has scans of the sensor 'lidr', expected one of lidar; "
        "if it is another one, add robots.each.sensors.lidr"
    )


@pytest.mark.parametrize(("name", "line"), [("controls.csv", 5), ("scans.csv", 8)])
def test_a_misspelt_robot_in_one_line_is_refused_or_left_out(
    kalmark: Kalmark, log: Path, tmp_path: Path, name: str, line: int
) -> None:
    lines = (log / name).read_text().splitlines()
    lines[line - 1] = lines[line - 1].replace("rover", "rovr")
    (log / name).write_text("\n".join(lines) + "\n")
    told = (
        f"{log / name}:{line}: robot 'rovr' is in no other file of the log, expected 'rover'; "
        "if both are robots, ask for them: log.robots=[rover,rovr]"
    )
    assert refused(kalmark("run", "native", "--log", log)) == told
    assert not (tmp_path / "out").exists()
    done = kalmark("run", "native", "--log", log, "--on-error", "skip")
    assert (done.status, done.out.count(told)) == (0, 1)
    assert [*json.loads((tmp_path / "out" / "native" / "summary.json").read_text())["robots"]] == ["rover"]
    assert kalmark("run", "native", "--log", log, "--set", "log.robots=[rover,rovr]").status == 0


@pytest.mark.parametrize(
    ("arguments", "what"),
    [
        (["run", "mrclm"], "did you mean mrclam?"),
        (["run", "native"], "log.path: got nothing, expected the path of a log"),
        (["run", "native", "--log", "nowhere"], "log 'nowhere' not found, expected it at"),
        (
            ["run", "native", "--log", "log", "--set", "log.r_max=1"],
            "log.r_max: got 1, which logs of format native do",
        ),
        (
            ["run", "native", "--log", "log", "--set", "log.format=nativ"],
            "log.format: got 'nativ', expected one of nati",
        ),
        (
            ["run", "native", "--log", "log", "--set", "robots.each.motion.sigma_v_mps=-1"],
            "got -1, expected a number of at least 0",
        ),
        (["run", "native", "--log", "log", "--set", "robots.each.start.sigma_xy_m=.nan"], "got nan, expected a finite"),
        (
            ["run", "native", "--log", "log", "--set", "log.from_s=1", "--set", "log.to_s=0"],
            "no event from 1 to 0 s",
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
            "--set steps=0: steps: got 0, expected a whole number of at least 1",
        ),
        (["campaign", "cloister", "--runs", "1", "--estimator", "efk"], "did you mean ekf?"),
        (["convert", "nowhere", "x"], "log 'nowhere' not found"),
        (["data", "fetch", "mrclm"], "dataset 'mrclm' is unknown, expected one of"),
        (["nonsense"], "No such command 'nonsense'"),
        (["view", "nowhere"], "summary.json: no such file, expected the folder of a complete run"),
        (["live", "nowhere.yaml"], "nowhere.yaml"),
        (["live", "map.kmk", "--set", "a.b=1"], "--set changes a configuration, and a saved map has its own"),
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
    assert "2 records left out:" in done.out
    assert f"{log / 'scans.csv'}:5:" in done.out
    assert "radar" in done.out
    summary = json.loads((tmp_path / "out" / "native" / "summary.json").read_text())
    assert (summary["skipped"], summary["observations"]) == (2, 58)


def test_run_prints_what_to_look_at_twice_after_the_table(kalmark: Kalmark, log: Path, tmp_path: Path) -> None:
    scans = (log / "scans.csv").read_text().splitlines()
    nameless = [scans[0], *(",".join([*line.split(",")[:3], "", *line.split(",")[4:]]) for line in scans[1:])]
    (log / "scans.csv").write_text("\n".join(nameless) + "\n")
    done = kalmark("run", "native", "--log", log)
    assert done.status == 0
    line = "60 observations have no id and were ignored; try --set association.type=auto"
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


NAMED = "robots: {rover: {motion: {type: unicycle}, sensors: {lidar: {type: range_bearing}}}}\n"


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        (
            "robots.rovre.motion.sigma_v_mps=.3",
            "robots.rovre: got a robot that is not in this log or run, expected one of rov",
        ),
        (
            "robots.rover.sensors.lidra.sigma_range_m=.3",
            "robots.rover.sensors.lidra: got {'sigma_range_m': 0.3}, expected ",
        ),
    ],
)
def test_what_is_set_and_nothing_takes_is_refused(
    kalmark: Kalmark, log: Path, tmp_path: Path, setting: str, message: str
) -> None:
    (tmp_path / "named.yaml").write_text(NAMED)
    for more in ((), ("--set", "log.robots=[rover]")):
        said = refused(kalmark("run", tmp_path / "named.yaml", "--log", log, "--set", setting, *more))
        assert said.startswith(f"--set {setting}: {message}")
        assert said.endswith("; did you mean rover?" if "rovre" in setting else "; did you mean the sensor lidar?")


def test_a_robot_that_is_set_alone_leaves_no_warning_of_each(kalmark: Kalmark, log: Path, tmp_path: Path) -> None:
    (tmp_path / "each.yaml").write_text(NAMED.replace("rover:", "each:"))
    lines = kalmark("run", tmp_path / "each.yaml", "--log", log, "--set", "robots.rover.gaps=ignore").out.splitlines()
    assert [line for line in lines if "robots.each" in line] == []


def test_what_is_configured_and_serves_nothing_is_said_in_one_line(kalmark: Kalmark, log: Path, tmp_path: Path) -> None:
    (tmp_path / "named.yaml").write_text(NAMED)
    run = ("run", tmp_path / "named.yaml", "--log", log)
    lines = kalmark(*run, "--set", "robots.rover.sensors.lidra.type=range").out.splitlines()
    assert [line for line in lines if line.startswith("warning")] == [
        "warning: no observation is by the sensor lidra of rover, which is configured; did you mean lidar?",
    ]


def test_a_full_disk_gets_one_line(kalmark: Kalmark, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("kalmark.config.load_config", full)
    monkeypatch.setattr("kalmark.config.open_run", full)
    done = kalmark("run", "native", "--log", ".")
    assert done.status == 2 and done.err == "kalmark: No space left on device; what was being written is not complete\n"


def test_the_result_of_another_log_is_replaced_only_where_the_folder_is_named(
    kalmark: Kalmark, log: Path, tmp_path: Path
) -> None:
    folder, summary = tmp_path / "out" / "native", tmp_path / "out" / "native" / "summary.json"
    assert kalmark("run", "native", "--log", log).status == 0
    other = shutil.copytree(log, tmp_path / "other")
    before = summary.read_bytes()
    said = refused(kalmark("run", "native", "--log", other))
    assert re.search(r"out/native has the result of .*, expected that of .*/other: --out DIR names another", said)
    assert summary.read_bytes() == before
    assert kalmark("run", "native", "--log", log).status == 0
    assert kalmark("run", "native", "--log", other, "--out", folder).status == 0
    assert json.loads(summary.read_text())["log"]["path"] == str(other.resolve())
