"""The configuration of an inertial unit: Kalibr's data sheet, the start of its biases and its gravity."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from kalmark.config import build_slam, load_config
from kalmark.config.data_sheets import data_sheet
from kalmark.errors import ConfigError, LogError
from kalmark.logs import open_log
from kalmark.simulate import load_world

SHEET = """# as Kalibr's tutorial has it
rostopic: /imu0
update_rate: 200.0
accelerometer_noise_density: 2.0e-2
accelerometer_random_walk: 3.0e-4
gyroscope_noise_density: 1.7e-03
gyroscope_random_walk: 2e-05
"""
CONFIG = """robots:
  each:
    motion: {type: inertial, data_sheet: imu.yaml, gravity_mps2: 9.8}
    start:
      bias_wx_radps: 0.1
      bias_ay_mps2: 0.2
      sigma_v_mps: [0.1, 0.2, 0.3]
      sigma_bias_w_radps: 0.01
      sigma_bias_a_mps2: [0.04, 0.05, 0.06]
"""


def written(folder: Path, config: str = CONFIG, sheet: str = SHEET) -> Path:
    (folder / "imu.yaml").write_text(sheet)
    (folder / "config.yaml").write_text(config)
    return folder / "config.yaml"


def motion(path: Path, *overrides: str) -> Any:
    return load_config(path, overrides).robots["each"].motion


def test_a_data_sheet_of_kalibr_s_is_read(tmp_path: Path) -> None:
    found = motion(written(tmp_path))
    assert found.gyroscope_noise_density_rad_per_sqrt_s == 1.7e-3
    assert found.gyroscope_random_walk_radps_per_sqrt_s == 2e-5
    assert found.accelerometer_noise_density_mps_per_sqrt_s == 2e-2
    assert found.accelerometer_random_walk_mps2_per_sqrt_s == 3e-4
    assert found.gravity_mps2 == 9.8


def test_what_is_given_beside_a_data_sheet_stays(tmp_path: Path) -> None:
    key = "robots.each.motion.gyroscope_noise_density_rad_per_sqrt_s"
    found = motion(written(tmp_path), f"{key}=0.5")
    assert found.gyroscope_noise_density_rad_per_sqrt_s == 0.5
    assert found.accelerometer_noise_density_mps_per_sqrt_s == 2e-2


def test_the_result_of_a_calibration_has_them_below_the_unit(tmp_path: Path) -> None:
    below = "imu0:\n" + "".join(f"  {line}\n" for line in SHEET.splitlines()[1:])
    assert motion(written(tmp_path, sheet=below)).gyroscope_random_walk_radps_per_sqrt_s == 2e-5


def test_controls_that_are_no_inertial_unit_s_are_refused_before_a_rest_is_sought_in_them(tmp_path: Path) -> None:
    path = written(tmp_path, CONFIG.replace("start:", "start:\n      at_rest: true"))
    rows = "".join(f"{0.01 * k:.2f},r,0,0,0,0,0,1\n" for k in range(100))
    (tmp_path / "controls.csv").write_text(f"t_s,robot,wx_radps,wy_radps,wz_radps,ax_gee,ay_gee,az_gee\n{rows}")
    with pytest.raises(LogError, match=r"the controls of r have the columns .*az_gee, expected wx_radps"):
        build_slam(load_config(path), open_log(tmp_path))


def test_a_world_takes_a_data_sheet(tmp_path: Path) -> None:
    world = tmp_path / "world.yaml"
    shipped = (Path(__file__).parents[1] / "src/kalmark/configs/worlds/inertial.yaml").read_text()
    lines = [line for line in shipped.splitlines() if "noise_density" not in line and "random_walk" not in line]
    world.write_text("\n".join(lines).replace("type: inertial", "type: inertial\n      data_sheet: imu.yaml"))
    (tmp_path / "imu.yaml").write_text(SHEET)
    robot: Any = load_world(world).config().robots["drone"]
    assert robot.motion.accelerometer_noise_density_mps_per_sqrt_s == 2e-2


@pytest.mark.parametrize(
    ("sheet", "what"),
    [
        (SHEET.replace("2e-05", "-1"), "imu.yaml: gyroscope_random_walk: got -1, expected a number of at least 0"),
        (
            SHEET.replace("2e-05", "small"),
            "imu.yaml: gyroscope_random_walk: got 'small', expected a number",
        ),
        (
            SHEET.replace("gyroscope_random", "gyro_random"),
            "gyroscope_random_walk: got nothing, expected a number",
        ),
        ("- 3\n", "imu.yaml:1: holds list, expected a mapping"),
    ],
)
def test_a_bad_data_sheet_is_refused(tmp_path: Path, sheet: str, what: str) -> None:
    with pytest.raises(ConfigError) as refused:
        motion(written(tmp_path, sheet=sheet))
    assert str(refused.value).startswith(f"{tmp_path / 'config.yaml'}:3:42: robots.each.motion.data_sheet: ")
    assert what in str(refused.value)


def test_a_data_sheet_that_is_none_or_not_there_is_refused(tmp_path: Path) -> None:
    path = written(tmp_path)
    for value, what in (("3", "got 3, expected the path of Kalibr's imu.yaml"), ("no.yaml", "no.yaml")):
        with pytest.raises(ConfigError) as refused:
            motion(path, f"robots.each.motion.data_sheet={value}")
        assert what in str(refused.value)
    with pytest.raises(ConfigError) as refused:
        motion(path, "robots.each={motion: {type: unicycle, data_sheet: imu.yaml}}")
    assert "data_sheet: got an unknown key" in str(refused.value)


@pytest.mark.parametrize("kind", ["inertial", "inertial_gravity"])
def test_a_device_is_a_preset_of_the_motion(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "config.yaml"
    path.write_text("robots: {each: {motion: {type: %s, preset: mems_imu, gravity_mps2: 9.8}}}\n" % kind)  # noqa: UP031
    unit: Any = build_slam(load_config(path)).robots["robot"].motion
    assert (unit.accelerometer_noise_density_mps_per_sqrt_s, unit.gravity_mps2) == (2.0e-3, 9.8)
    assert unit.gyroscope_noise_density_rad_per_sqrt_s == 1.6968e-4
    for preset in ("mems", 3, "rtk_receiver"):
        path.write_text("robots: {each: {motion: {type: %s, preset: %s}}}\n" % (kind, preset))  # noqa: UP031
        with pytest.raises(ConfigError, match=r"robots.each.motion.preset: got .*, expected one of mems_imu"):
            load_config(path)


def test_a_data_sheet_is_parameters_of_the_motion_in_python(tmp_path: Path) -> None:
    import kalmark as km

    written(tmp_path)
    unit = km.motion.Inertial(**data_sheet(tmp_path / "imu.yaml"))
    np.testing.assert_allclose(unit.densities, np.repeat([1.7e-3, 2e-2, 2e-5, 3e-4], 3))


def test_a_start_has_biases_and_their_sigmas(tmp_path: Path) -> None:
    slam = build_slam(load_config(written(tmp_path)))
    robot = slam.robots["robot"]
    np.testing.assert_array_equal(robot.start[7:], [0, 0, 0, 0.1, 0, 0, 0, 0.2, 0])
    sigmas = np.repeat([0.0, 0.0, 0.01], [3, 3, 3])
    np.testing.assert_allclose(np.sqrt(np.diag(robot.cov)), [*sigmas[:6], 0.1, 0.2, 0.3, *sigmas[6:], 0.04, 0.05, 0.06])


@pytest.mark.parametrize(
    ("start", "what"),
    [
        ("gravity_z_mps2: -9.81", "expected 0: inertial has no gravity in its state"),
        ("sigma_w_radps: 1", "expected 0: inertial has no velocity like this in its state"),
        ("sigma_gravity_mps2: 1", "expected 0: inertial has no gravity in its state"),
    ],
)
def test_a_start_of_what_its_state_does_not_have_is_refused(tmp_path: Path, start: str, what: str) -> None:
    with pytest.raises(ConfigError) as refused:
        load_config(written(tmp_path, CONFIG + f"      {start}\n"))
    assert what in str(refused.value)
