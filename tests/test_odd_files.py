"""Odd files and configurations: each is refused with one line, or read; none ends in a traceback or takes long."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from fuzz_odd import DIGITS, ODD_CONFIGS, ODD_RIGS

import kalmark as km
from kalmark.config import build_slam, open_run
from kalmark.errors import EventError, KalmarkError, ModelError
from kalmark.logs.source import landmark_id, nanoseconds_of_text

CONTROLS = "t_s,robot,v_mps,w_radps\n0,rover,1,0\n1,rover,1,0\n2,rover,1,0\n"
SCANS = "t_s,robot,sensor,id,range_m,bearing_rad\n0.5,rover,lidar,1,5,0.1\n1.5,rover,lidar,1,4,0.1\n"
CONFIG = """robots:
  rover:
    motion: {type: unicycle, sigma_v_mps: 0.05}
    sensors: {lidar: {type: range_bearing, sigma_range_m: 0.1, sigma_bearing_rad: 0.02}}
"""
SIGMA = "robots: {rover: {motion: {type: unicycle, sigma_v_mps: VALUE}}}"


def outcome(folder: Path, controls: str = "", scans: str = "", config: str = CONFIG, **files: str) -> str:
    """Return what a log and a configuration are refused with, "" if they are run."""
    log = folder / "log"
    log.mkdir()
    (log / "controls.csv").write_text(CONTROLS + controls)
    (log / "scans.csv").write_text(SCANS + scans)
    for name, text in files.items():
        (log / name.replace("_", ".")).write_text(text)
    path = folder / "my.yaml"
    path.write_text(f"log: {{path: {log}}}\n{config}")
    try:
        config_, log_ = open_run(path)
        slam = build_slam(config_, log_)
        for event in log_.events:
            slam.process(event)
    except KalmarkError as error:
        message = str(error)
        assert "\n" not in message
        assert len(message) < 700
        return message
    P = slam.covariance("rover", *slam.tracks.confirmed)
    assert np.isfinite(P).all() and np.linalg.eigvalsh(P)[0] > -1e-9
    return ""


@pytest.mark.parametrize("time", ["1e999", "1e999990", "-1e999990", "1e-999990", DIGITS, "1_0", "nan", "9.3e9", "0x10"])
def test_an_odd_time_is_refused_with_its_line(time: str, tmp_path: Path) -> None:
    message = outcome(tmp_path, controls=f"{time},rover,1,0\n")
    assert "controls.csv:5: t" in message
    assert "expected a finite number of seconds, within 292 years of 0" in message or "run backwards" in message


def test_a_time_of_a_million_digits_is_no_time() -> None:
    for text in ("1e999", "1e999990", "-1e999990", DIGITS, "1_0", "1e19"):
        with pytest.raises(ValueError, match=r"."):
            nanoseconds_of_text(text)
    assert nanoseconds_of_text("1e-999990") == 0


def test_an_id_has_at_most_200_characters(tmp_path: Path) -> None:
    assert "expected at most 200" in outcome(tmp_path, scans=f"1.7,rover,lidar,{DIGITS},4,0.1\n")
    assert landmark_id("7" * 200) == int("7" * 200)
    with pytest.raises(ValueError, match="5000 characters, expected at most 200"):
        landmark_id(DIGITS)


@pytest.mark.parametrize(
    ("files", "message"),
    [
        ({"scans": "1.7,rover,lidar,2,1e155,0.1\n"}, "range_m is '1e155', expected at most 1e+09 m"),
        ({"scans": "1.7,rover,lidar,2,1,1e7\n"}, "bearing_rad is '1e7', expected at most 1e+06 rad"),
        ({"controls": "3,rover,1e155,0\n"}, "v_mps is '1e155', expected at most 1e+06 m/s"),
        ({"landmarks_csv": "id,x_m,y_m\n1,1e300,2\n"}, "x_m is '1e300', expected at most 1e+09 m"),
        ({"landmarks_csv": f"id,x_m,y_m\n{DIGITS},1,2\n"}, "expected at most 200"),
        ({"truth_csv": "t_s,robot,x_m,y_m,theta_rad\n0,rover,1e300,0,0\n"}, "x_m is '1e300', expected at most 1e+09 m"),
        (
            {"fixes_csv": "t_s,robot,x_m,y_m,sigma_x_m,sigma_y_m\n0,rover,1,1,1e300,1\n"},
            "sigma_x_m is '1e300', expected at most 1e+09 m",
        ),
        (
            {"fixes_csv": "t_s,robot,x_m,y_m,cov_xx,cov_xy,cov_yy\n0,rover,1,1,1e300,0,1\n"},
            "cov_xx is '1e300', expected at most 1e+18",
        ),
    ],
)
def test_a_value_beyond_what_means_anything_is_refused(files: dict[str, str], message: str, tmp_path: Path) -> None:
    assert message in outcome(tmp_path, **files)


@pytest.mark.parametrize("rig", ODD_RIGS)
def test_an_odd_rig_is_refused_with_one_line(rig: str, tmp_path: Path) -> None:
    assert outcome(tmp_path, config="", rig_yaml=rig)


@pytest.mark.parametrize("config", ODD_CONFIGS)
def test_an_odd_configuration_is_refused_with_one_line(config: str, tmp_path: Path) -> None:
    assert outcome(tmp_path, config=config).startswith(str(tmp_path / "my.yaml"))


@pytest.mark.parametrize(
    ("key", "message"),
    [
        (SIGMA.replace("VALUE", "1e300"), "sigma_v_mps: got 1e+300, expected a number of at most 1e+06 m/s"),
        (SIGMA.replace("VALUE", DIGITS[:400]), "sigma_v_mps: got 999"),
        ("robots: {rover: {start: {x_m: 1e300}}}", "x_m: got 1e+300, expected a number of at most 1e+09 m"),
        ("robots: {rover: {start: {x_m: -1e300}}}", "x_m: got -1e+300, expected a number of at most 1e+09 m"),
        (
            "robots: {rover: {max_speed_mps: 1e300}}",
            "max_speed_mps: got 1e+300, expected a number of at most 1e+06 m/s",
        ),
        (
            "robots: {rover: {motion: {type: velocity_3d}, start: {sigma_position_m: 1e300}}}",
            "expected a number of at most 1e+09 m, or a list of three",
        ),
    ],
)
def test_a_number_of_a_configuration_means_something(key: str, message: str, tmp_path: Path) -> None:
    assert message in outcome(tmp_path, config=key)


def test_a_landmark_with_the_id_of_an_inner_block_does_not_get_its_name() -> None:
    mount = km.Mount(km.sensors.RangeBearing())
    slam = km.Slam([km.Robot("a", km.motion.Unicycle(sigma_v_mps=0.1), sensors={"lidar": mount})])
    for name in ("a bias", "a.lidar"):
        with pytest.raises(EventError, match="names a robot's bias or mount"):
            slam.process(km.Scan(1.0, "a", "lidar", [[3, 0.1]], [name]))
    with pytest.raises(ModelError, match="has the name of another's bias or mount"):
        km.Slam([km.Robot(name, km.motion.Unicycle()) for name in ("a", "a bias")])
