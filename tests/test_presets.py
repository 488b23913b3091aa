"""Ready sensors: each number of theirs that is no default names its source."""

from __future__ import annotations

import dataclasses
import io
from pathlib import Path
from statistics import NormalDist
from typing import Any

import pytest
from ruamel.yaml import YAML

import kalmark as km
from kalmark import presets
from kalmark.config.building import build_slam, config_dict
from kalmark.config.reading import load_config
from kalmark.errors import ConfigError
from kalmark.simulate import load_world, simulate


def yaml_text(content: dict[str, Any]) -> str:
    out = io.StringIO()
    YAML().dump(content, out)
    return out.getvalue()


@pytest.mark.parametrize("name", presets.ALL)
def test_every_number_of_a_preset_names_its_source(name: str) -> None:
    preset = presets.ALL[name]
    sensor = preset.in_space or preset.sensor
    plain = type(sensor)()
    own = {f.name for f in dataclasses.fields(plain) if getattr(sensor, f.name) != getattr(plain, f.name)}
    assert set(preset.sources) == own | {"rate_hz", "dropouts"}
    assert all(len(source) > 20 for source in preset.sources.values())
    assert 0 <= preset.dropouts < 1
    assert (preset.dropouts > 0) == (name in (*presets.TABLE_2, "laser_scanner"))
    km.Slam([km.Robot("r", km.motion.Odometry2D(), sensors={"s": km.Mount(preset.sensor)})])


def test_a_configuration_takes_what_it_does_not_say_from_a_preset(tmp_path: Path) -> None:
    path = tmp_path / "preset.yaml"
    path.write_text("robots: {each: {sensors: {s: {type: range_bearing, preset: sonar, range_max_m: 3.0}}}}\n")
    config = load_config(path)
    sensor = build_slam(config).robots["robot"].sensors["s"].sensor
    assert sensor == dataclasses.replace(presets.SONAR.sensor, range_max_m=3.0)
    (tmp_path / "again.yaml").write_text(yaml_text(config_dict(config)))
    assert build_slam(load_config(tmp_path / "again.yaml")).robots["robot"].sensors["s"].sensor == sensor


DEVICES = "{imu: {type: gyro, preset: mems_imu}, rtk: {type: gps, preset: rtk_receiver, sigma_m: 0.1}}"


@pytest.mark.parametrize(("motion", "world"), [("unicycle", "plane"), ("velocity_3d", "space")])
def test_devices_are_those_of_the_plane_and_of_space(motion: str, world: str, tmp_path: Path) -> None:
    path = tmp_path / "preset.yaml"
    path.write_text(f"robots: {{each: {{motion: {{type: {motion}}}, sensors: {DEVICES}}}}}\n")
    robot = build_slam(load_config(path)).robots["robot"]
    imu, rtk = robot.sensors["imu"].sensor, robot.sensors["rtk"].sensor
    assert imu.world == rtk.world == world
    assert (imu.sigma_rad_per_sqrt_s, rtk.sigma_m) == (presets.MEMS_IMU.sensor.sigma_rad_per_sqrt_s, 0.1)
    if world == "space":
        assert NormalDist(sigma=rtk.sigma_z_m).cdf(0.01) == pytest.approx(0.75)


@pytest.mark.parametrize(
    ("type_", "preset"),
    [("bearing", "sonar"), ("range", "rfid"), ("position", "laser"), ("gyro", "laser_scanner")],
)
def test_a_preset_of_another_type_of_sensor_is_refused(type_: str, preset: str, tmp_path: Path) -> None:
    path = tmp_path / "preset.yaml"
    path.write_text(f"robots: {{each: {{sensors: {{s: {{type: {type_}, preset: {preset}}}}}}}}}\n")
    with pytest.raises(ConfigError, match=rf"preset.yaml:1:.*{preset} is a range_bearing"):
        load_config(path)


def test_ranges_alone_do_not_make_a_sensor_of_ranges_and_bearings(tmp_path: Path) -> None:
    path = tmp_path / "preset.yaml"
    path.write_text("robots: {each: {sensors: {s: {type: range_bearing, preset: arva}}}}\n")
    with pytest.raises(ConfigError, match=r"preset.yaml:1:.*arva is a range$"):
        load_config(path)


def test_a_world_takes_rate_and_dropouts_from_a_preset_unless_it_says_otherwise() -> None:
    log = simulate(load_world("rfid", ["steps=100"]), seed=1)
    scans = [event for event in log.events if isinstance(event, km.Scan)]
    assert {scan.t_ns % 1_000_000_000 for scan in scans} == {0}  # once a second, of steps of 0.1 s
    keys = ["steps=100", "robots.robot.sensing={rfid: {every: 1, dropouts: 0.0}}"]
    every = [event for event in simulate(load_world("rfid", keys), seed=1).events if isinstance(event, km.Scan)]
    there = {event.t_ns: len(event.y) for event in every}
    assert len(there) == 100
    reported = sum(len(scan.y) for scan in scans) / sum(there[scan.t_ns] for scan in scans)
    assert reported == pytest.approx(1 - presets.RFID.dropouts, abs=0.12)


@pytest.mark.parametrize("name", presets.TABLE_2)
def test_every_preset_has_its_world(name: str) -> None:
    world = load_world(name)
    sensor = build_slam(world.config(), simulate(world, seed=0)).robots["robot"].sensors[name].sensor
    assert sensor == presets.ALL[name].sensor
