"""Configuration: what is read, what is refused, and that every refusal names its place."""

from __future__ import annotations

import inspect
import math
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from pydantic import ValidationError

import kalmark as km
from kalmark.config import load_config, open_run, resolve_config, shipped_configs
from kalmark.config.schema import LogConfig, options_of_formats
from kalmark.config.tree import name_of, name_on
from kalmark.errors import ConfigError
from kalmark.logs import known_formats

GOOD = """\
log: {path: my_log, robots: [3]}
robots:
  each:
    motion: {type: unicycle, sigma_v_mps: 0.05, sigma_w_radps: 1e-1}
    start: {x_m: 1, theta_rad: -2.5}
    sensors:
      camera:
        type: range_bearing
        sigma_range_m: 0.15
        mount: {x_m: 0.2}
association: {gate: off}
"""


@pytest.fixture
def good(tmp_path: Path) -> Path:
    path = tmp_path / "good.yaml"
    path.write_text(GOOD)
    return path


def refusal(path: Path, *overrides: str) -> str:
    with pytest.raises(ConfigError) as error:
        load_config(path, overrides)
    message = str(error.value)
    assert "\n" not in message
    return message


def refusal_of(text: str, tmp_path: Path) -> str:
    path = tmp_path / "bad.yaml"
    path.write_text(text)
    message = refusal(path)
    assert message.startswith(f"{path}:")
    return message.removeprefix(f"{path}:")


def test_what_the_file_says_is_in_force_and_the_rest_has_its_default(good: Path) -> None:
    config = load_config(good)
    robot = config.robots["each"]
    camera = robot.sensors["camera"]
    assert config.log.robots == (3,)
    assert robot.motion.sigma_w_radps == 0.1
    assert robot.start is not None
    assert (robot.start.x_m, robot.start.sigma_xy_m) == (1.0, 0.0)
    assert (camera.mount.x_m, camera.mount.theta_rad, camera.range_max_m) == (0.2, 0.0, math.inf)
    assert config.association.gate == "off"
    assert (config.association.type, config.estimator.type, config.map.type) == ("identity", "invariant", "auto")


def test_a_configuration_cannot_be_changed(good: Path) -> None:
    with pytest.raises(ValidationError, match="frozen"):
        load_config(good).seed = 3  # type: ignore[misc]


def test_an_override_replaces_one_value_and_leaves_its_neighbours(good: Path) -> None:
    config = load_config(
        good, ["robots.each.motion.sigma_v_mps=2e-1", "estimator.type=ekf", "robots.each.sensors.camera.mount={y_m: 3}"]
    )
    assert config.robots["each"].motion.sigma_v_mps == 0.2
    assert config.robots["each"].motion.sigma_w_radps == 0.1
    assert config.robots["each"].sensors["camera"].mount.x_m == 0.0
    assert config.robots["each"].sensors["camera"].mount.y_m == 3.0
    assert config.estimator.type == "ekf"


@pytest.mark.parametrize(
    ("override", "what"),
    [
        ("log.robot=3", "log.robot: got an unknown key (value 3), expected one of path, format, robots, "),
        (
            "robots.each.motion.sigma_v_mps=-1",
            "robots.each.motion.sigma_v_mps: got -1, expected a number of at least 0",
        ),
        (
            "robots.each.motion.sigma_v_mps=.nan",
            "robots.each.motion.sigma_v_mps: got nan, expected a finite number",
        ),
        ("robots.each.motion.sigma_v_mps=true", "robots.each.motion.sigma_v_mps: got true, expected a number"),
        ("robots.each.motion.sigma_v_mps='1'", "robots.each.motion.sigma_v_mps: got '1', expected a number"),
        (
            "robots.each.motion.type=unicicle",
            "got 'unicicle', expected one of unicycle, odometry_2d, ackermann, differential_drive",
        ),
        ("robots.each.motion=3", "robots.each.motion: got 3, expected a mapping with a type: one of unicycle, od"),
        ("robots.each.start.x_m=.inf", "robots.each.start.x_m: got inf, expected a finite number"),
        (
            "robots.each.sensors.camera.detector=x",
            "sensors.camera.detector: got 'x', expected one of corners, ",
        ),
        ("robots.each.sensors.camera.type=sonar", "robots.each.sensors.camera.type: got 'sonar', expected one of "),
        ("robots.each.sensors=[1]", "robots.each.sensors: got [1], expected a mapping of keys"),
        ("association.gate=2", "association.gate: got 2, expected a probability between 0 and 1, off or default"),
        ("map.type=sparse", "map.type: got 'sparse', expected one of auto, dense, postponed"),
        ("estimator.iterations=2.5", "estimator.iterations: got 2.5, expected a whole number"),
        ("estimator.iterations=0", "estimator.iterations: got 0, expected a whole number of at least 1"),
        ("log.on_error=skp", "log.on_error: got 'skp', expected one of raise, skip; did you mean skip?"),
        ("log.robots=3", "log.robots: got 3, expected a list"),
        ("log.robots=[1.5]", "log.robots.0: got 1.5, expected a robot's name or number"),
        ("log.path.x=3", "log.path: got 'my_log', expected a mapping of keys"),
        ("robots.each.sensors.range={type: range, range: 5}", "robots.each.sensors.range.range: got an unknown key"),
        ("log={path: [", "expected the node content"),
        ("estimator", "got no key and value, expected key.path=value"),
    ],
)
def test_a_bad_override_is_refused_by_its_own_text(good: Path, override: str, what: str) -> None:
    message = refusal(good, override)
    assert message.startswith(f"--set {override}:")
    assert what in message


@pytest.mark.parametrize(
    ("line", "replacement", "where", "what"),
    [
        (4, "    motion: {type: unicycle, sigma_v: 0.05}", "4:30", "motion.sigma_v: got an unknown key (value 0.05)"),
        (
            4,
            "    motion: {type: unicycle, sigma_v_mps: -2}",
            "4:43",
            "sigma_v_mps: got -2, expected a number of at least 0",
        ),
        (4, "    motion: {type: car}", "4:20", "motion.type: got 'car', expected one of unicycle"),
        (4, "    motoin: {type: unicycle}", "4:5", "robots.each.motoin: got an unknown key"),
        (9, "        sigma_range_m: .nan", "9:24", "camera.sigma_range_m: got nan, expected a finite number"),
        (9, "        sigma_range_m: 0,15", "9:24", "camera.sigma_range_m: got '0,15', expected a number"),
        (11, "association: {gate: of}", "11:21", "association.gate: got 'of', expected a probability"),
        (11, "log: {path: again}", "11:1", "log: got this key a second time, expected each key once"),
        (11, "association: {gate: off", "12:1", "expected ',' or '}'"),
        (11, "\tassociation: off", "11:1", "cannot start any token"),
    ],
)
def test_a_bad_line_is_refused_by_file_line_and_column(
    tmp_path: Path, line: int, replacement: str, where: str, what: str
) -> None:
    lines = GOOD.splitlines()
    lines[line - 1] = replacement
    message = refusal_of("\n".join(lines) + "\n", tmp_path)
    assert message.startswith(f"{where}: ")
    assert what in message


def test_an_unknown_key_is_told_the_nearest_one(tmp_path: Path) -> None:
    message = refusal_of("robots:\n  each: {motion: {type: unicycle, sigma_w_rads: 1}}\n", tmp_path)
    assert message.endswith("; did you mean sigma_w_radps?")


def test_the_first_of_several_mistakes_is_named(tmp_path: Path) -> None:
    message = refusal_of("map: {type: auto}\nassociation: {gate: 5}\nlog: {form: 3}\n", tmp_path)
    assert message.startswith("2:21: association.gate: ")


@pytest.mark.parametrize("text", ["", "3", "[1, 2]", "# nothing\n", "{}", "''"])
def test_a_file_that_is_no_mapping_is_refused(tmp_path: Path, text: str) -> None:
    assert refusal_of(text, tmp_path).startswith("1:1: got ")


def test_a_file_that_is_no_text_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "bad.yaml"
    path.write_bytes(b"log: \xff\xfe")
    assert refusal(path) == f"{path}: byte 5 is not UTF-8, expected a YAML text file"
    assert refusal_of("log: \x01", tmp_path) == "1:6: got '\\x01', expected printable text"


def test_an_alias_to_itself_is_refused(tmp_path: Path) -> None:
    assert "robots.a.motion" in refusal_of("robots:\n  a: &a {motion: {type: unicycle, sigma_v_mps: *a}}\n", tmp_path)
    assert "log.robots" in refusal_of("log:\n  robots: &a [1, [*a]]\n", tmp_path)


def test_anchors_and_merge_keys_work(tmp_path: Path) -> None:
    path = tmp_path / "merge.yaml"
    path.write_text(
        "robots:\n  a: &a {motion: &m {type: unicycle, sigma_v_mps: 3}}\n  b: *a\n"
        "  c: {motion: {<<: *m, sigma_w_radps: 2}}\n"
    )
    config = load_config(path)
    assert config.robots["b"].motion.sigma_v_mps == 3
    assert (config.robots["c"].motion.sigma_v_mps, config.robots["c"].motion.sigma_w_radps) == (3, 2)


def test_numbers_as_robot_names_are_names(tmp_path: Path) -> None:
    path = tmp_path / "numbers.yaml"
    path.write_text("robots: {3: {motion: {type: unicycle}}}\n")
    assert list(load_config(path).robots) == ["3"]


def test_the_page_of_the_documentation_is_in_step_with_the_model() -> None:
    page = Path(__file__).parent.parent / "docs" / "configuration.md"
    command = [sys.executable, "-m", "kalmark.config.documentation"]  # without the models that other tests register
    assert page.read_text() == subprocess.run(command, check=True, capture_output=True, text=True).stdout


LOGS = {  # which describe the cameras
    "visual": "visual/tum_fr1_xyz", "visual_depth": "visual/tum_fr1_xyz", "visual_inertial": "visual/euroc_v101_micro"
}  # fmt: skip


@pytest.mark.parametrize("name", sorted(shipped_configs()))
def test_every_shipped_configuration_loads(name: str, data: Callable[[str], Path]) -> None:
    config = open_run(name, data(LOGS[name]))[0] if name in LOGS else load_config(name)
    assert config.name == name


def test_a_missing_path_with_a_shipped_name_means_the_shipped_one(tmp_path: Path) -> None:
    shipped = shipped_configs()["mrclam"]
    assert resolve_config("mrclam") == shipped
    assert resolve_config("configs/mrclam.yaml") == shipped
    own = tmp_path / "mrclam.yaml"
    own.write_text(GOOD)
    assert resolve_config(own) == own


def test_a_name_that_means_nothing_is_told_the_nearest(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"mrclm: no such file.*; did you mean mrclam\?$"):
        resolve_config("mrclm")
    with pytest.raises(ConfigError, match="got a folder, expected a configuration"):
        resolve_config(tmp_path)


def test_another_type_replaces_its_section(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(
        "estimator: {type: invariant, iterations: 3}\n"
        "robots: {each: {motion: {type: unicycle, sigma_v_mps: 0.2}, sensors: {s: {type: range, sigma_range_m: 1.0,"
        " mount: {x_m: 0.5}}}}}\n"
    )
    overrides = ["estimator.type=ekf", "robots.each.motion.type=odometry_2d", "robots.each.sensors.s.type=bearing"]
    config = load_config(path, overrides)
    assert config.estimator.type == "ekf"
    each = config.robots["each"]
    assert each.motion.type == "odometry_2d"
    assert each.sensors["s"].type == "bearing"
    assert each.sensors["s"].mount.x_m == 0.5


SPACE = """\
robots:
  each:
    motion: {type: odometry_3d, sigma_z_m: 0.02}
    start: {x_m: 1, y_m: 2, z_m: 3, roll_deg: 10, pitch_deg: 20, yaw_deg: 30, sigma_rotation_deg: 1}
    sensors:
      radar:
        type: range_bearing_3d
        mount: {z_m: 0.6, yaw_deg: 90}
"""


def test_a_robot_of_space_has_the_keys_of_space(tmp_path: Path) -> None:
    path = tmp_path / "space.yaml"
    path.write_text(SPACE)
    robot = load_config(path).robots["each"]
    assert (robot.motion.type, robot.motion.sigma_z_m) == ("odometry_3d", 0.02)
    assert robot.start is not None
    assert (robot.start.z_m, robot.start.yaw_deg, robot.start.sigma_rotation_deg) == (3, 30, 1)
    assert (robot.sensors["radar"].mount.z_m, robot.sensors["radar"].mount.roll_deg) == (0.6, 0)


@pytest.mark.parametrize(
    ("text", "line", "replacement", "where", "what"),
    [
        (SPACE, 4, "    start: {theta_rad: 1}", "4:13", "start.theta_rad: got a key of the plane for a rob"),
        (SPACE, 8, "        mount: {theta_rad: 1}", "8:17", "mount.theta_rad: got a key of the plan"),
        (SPACE, 8, "        mount: {yaw_rad: 1}", "8:17", "got an unknown key (value 1), expected one"),
        (SPACE, 7, "        type: range_bearing", "7:15", "a sensor of the plane on a robot of space,"),
        (SPACE, 4, "    start: {vx_mps: 1}", "4:21", "start.vx_mps: got 1, expected 0: odometry_3d has no vel"),
        (GOOD, 5, "    start: {z_m: 1}", "5:13", "start.z_m: got a key of space for a robot of the plane (value 1)"),
        (GOOD, 10, "        mount: {yaw_deg: 1}", "10:17", "yaw_deg: got a key of space for a robot of the plane"),
        (GOOD, 8, "        type: position_3d", "8:15", "got 'position_3d', a sensor of space on a robot of the p"),
    ],
)
def test_what_is_of_the_other_world_is_refused_by_its_place(
    tmp_path: Path, text: str, line: int, replacement: str, where: str, what: str
) -> None:
    lines = text.splitlines()
    lines[line - 1] = replacement
    message = refusal_of("\n".join(lines) + "\n", tmp_path)
    assert message.startswith(f"{where}: ")
    assert what in message


def test_a_start_of_space_may_have_a_sigma_for_each_axis(tmp_path: Path) -> None:
    path = tmp_path / "space.yaml"
    path.write_text(SPACE.replace("sigma_rotation_deg: 1", "sigma_rotation_deg: [1, 2, 0]"))
    start = load_config(path).robots["each"].start
    assert start is not None
    assert start.sigma_rotation_deg == (1, 2, 0)  # type: ignore[union-attr]
    least, finite = "a number of at least 0", "a finite number"
    wanted = {"[1, 2]": least, "-1": least, "[1, -2, 3]": least, "no": "a number", "[1, .inf, 3]": finite}
    for bad, what in wanted.items():
        message = refusal(path, f"robots.each.start.sigma_rotation_deg={bad}")
        assert message.endswith(f"expected {what}, or a list of three: one for each axis")


def test_every_option_of_a_log_format_is_a_key_with_its_line_of_documentation() -> None:
    options = {option for entry in known_formats().values() for option in entry.options}
    assert options <= set(options_of_formats(tuple(known_formats().values())).model_fields)
    assert all(option.text for entry in known_formats().values() for option in entry.options.values())


def test_a_file_is_called_by_its_name_or_by_its_folder_if_all_such_files_have_that_name() -> None:
    assert name_of(Path("runs/woods/config.yaml"), "config") == "woods"
    assert name_of(Path("runs/woods/fast.yaml"), "config") == "fast"
    assert name_of(Path("worlds/config.yaml"), "world") == "config"
    assert (name_of(Path("/config.yaml"), "config"), name_of(None, "world")) == ("config", "world")
    assert (name_on("woods", "log"), name_on("log", "log")) == ("woods on log", "log")


def test_the_options_of_any_log_are_those_of_open_log() -> None:
    parameters = inspect.signature(km.open_log).parameters.values()
    options = {each.name: each.default for each in parameters if each.kind is each.KEYWORD_ONLY} | {"format": None}
    declared = {name: field.default for name, field in LogConfig.model_fields.items()}
    assert options.keys() - {"progress"} == declared.keys() - {"path", "without_events"}
    assert {name for name in declared.keys() & options.keys() if declared[name] != options[name]} == {"increments"}
