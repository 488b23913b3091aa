"""From a configuration to robots, log and filter."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

import kalmark as km
from kalmark.config import Config, build_slam, config_dict, load_config, open_config_log, slam_from_config
from kalmark.config.opening import open_run
from kalmark.config.sections import section_of
from kalmark.declare import built_in, classes, parameters
from kalmark.errors import ConfigError
from kalmark.logs import Log, Trajectory
from kalmark.results.recording import config_yaml

SECOND = 1_000_000_000


def config_of(text: str, folder: Path, *overrides: str) -> Config:
    path = folder / "my.yaml"
    path.write_text(text)
    return load_config(path, overrides)


def log_of(*robots: str) -> Log:
    """Return a log of robots that drive along x at 1 m/s from (1, 2, 0), truth included."""
    events = [km.Control(float(t), name, (1.0, 0.0)) for t in range(3) for name in robots]
    poses = np.array([[1.0, 2.0, 0.0], [2.0, 2.0, 0.0], [3.0, 2.0, 0.0]])
    truth = {name: Trajectory(np.arange(3) * SECOND, poses) for name in robots}
    columns = {name: ("v_mps", "w_radps") for name in robots}
    return Log("test", robots, events, truth=truth, control_columns=columns)


@pytest.mark.parametrize("role", ["motion", "sensor", "landmark", "association", "estimator", "detector"])
def test_keys_and_defaults_are_those_of_the_models(role: str) -> None:
    for name, models in classes(role).items():
        section = section_of(role, name)()
        own = {parameter.name: parameter for parameter in parameters(models[0])}
        keys = {key: value for key, value in section.model_dump().items() if key in own}
        assert keys.keys() == own.keys(), name
        for key, value in keys.items():
            defaults = {p.default for m in models for p in parameters(m) if p.name == key}
            left_open = len(defaults) > 1
            assert value == (None if left_open else own[key].default), (name, key)


def test_every_parameter_is_documented() -> None:
    for role in ("motion", "sensor", "landmark", "association", "estimator", "detector", "attention", "upkeep"):
        for model in built_in(role):
            assert all(parameter.text.endswith(".") for parameter in parameters(model)), model


def test_a_robot_without_a_start_starts_at_the_truth_exactly(tmp_path: Path) -> None:
    slam = build_slam(config_of("map: {type: auto}", tmp_path), log_of("a", "b"))
    assert list(slam.robots) == ["a", "b"]
    assert slam.mean("b") == pytest.approx([1.0, 2.0, 0.0])
    assert not slam.covariance("b").any()


def test_a_given_start_wins_over_the_truth(tmp_path: Path) -> None:
    text = "robots: {each: {start: {x_m: 5, sigma_xy_m: 2, sigma_theta_rad: 0.1}}}"
    slam = build_slam(config_of(text, tmp_path), log_of("a"))
    assert slam.mean("a") == pytest.approx([5.0, 0.0, 0.0])
    assert slam.covariance("a") == pytest.approx(np.diag([4.0, 4.0, 0.01]))


def test_without_truth_a_robot_starts_at_the_origin(tmp_path: Path) -> None:
    log = dataclasses.replace(log_of("a"), truth={})
    assert build_slam(config_of("map: {type: auto}", tmp_path), log).mean("a") == pytest.approx([0, 0, 0])


def test_a_named_robot_has_its_own_models_beside_those_of_each(tmp_path: Path) -> None:
    text = """\
robots:
  each: {sensors: {lidar: {type: range_bearing}}}
  b:
    motion: {type: unicycle, sigma_v_mps: 7}
    sensors:
      sonar: {type: range, sigma_range_rel: 0.5, mount: {x_m: 1, y_m: 2, theta_rad: 3}}
      tags: {type: range_bearing_signature, landmark: {type: point_signature}}
"""
    slam = build_slam(config_of(text, tmp_path), log_of("a", "b"))
    a, b = slam.robots["a"], slam.robots["b"]
    assert (list(a.sensors), list(b.sensors)) == (["lidar"], ["lidar", "sonar", "tags"])
    assert a.motion == km.motion.Unicycle()
    assert b.motion == km.motion.Unicycle(sigma_v_mps=7)
    assert b.sensors["sonar"].sensor == km.sensors.Range(sigma_range_rel=0.5)
    assert tuple(b.sensors["sonar"].at) == (1, 2, 3)
    assert b.sensors["tags"].landmark == km.landmarks.PointSignature2D()


def test_association_estimator_and_landmarks_are_built(tmp_path: Path) -> None:
    text = "association: {type: nearest, gate: 0.9}\nestimator: {type: invariant, iterations: 2}\n"
    slam = build_slam(config_of(text, tmp_path))
    assert slam.association == km.association.NearestNeighbour(gate=0.9)
    assert slam.estimator == km.estimators.Invariant(iterations=2)
    slam = build_slam(config_of("association: {gate: off}\nestimator: {type: fej}\n", tmp_path))
    assert slam.association == km.association.ByIdentity(gate="off")
    assert slam.estimator == km.estimators.Fej()


def test_without_a_log_the_robots_are_those_named(tmp_path: Path) -> None:
    path = tmp_path / "my.yaml"
    path.write_text("robots: {each: {}, a: {}, b: {}}\n")
    assert list(km.Slam.from_config(path).robots) == ["a", "b"]
    path.write_text("robots: {each: {}}\n")
    assert list(slam_from_config(path).robots) == ["robot"]


def test_a_robot_of_the_log_without_an_entry_is_refused(tmp_path: Path) -> None:
    config = config_of("robots: {rover: {}}", tmp_path)
    with pytest.raises(ConfigError, match=r"my.yaml:1:9: robots: got rover, expected 'rover1' of the log, or each"):
        build_slam(config, dataclasses.replace(log_of("rover", "rover1")))


def test_what_a_model_itself_refuses_is_told_with_its_place(tmp_path: Path) -> None:
    config = config_of("robots: {each: {sensors: {s: {type: range}}}}", tmp_path)
    broken = config.robots["each"].sensors["s"].model_copy(update={"sigma_range_m": -1.0})
    robot = config.robots["each"].model_copy(update={"sensors": {"s": broken}})
    with pytest.raises(ConfigError, match=r"my.yaml:1:30: robots.each.sensors.s: Range: sigma_range_m is -1.0"):
        build_slam(config.model_copy(update={"robots": {"each": robot}}))


def test_everything_in_force_is_saved_and_loads_to_the_same(tmp_path: Path) -> None:
    config = load_config("mrclam", ["robots.each.start={x_m: 1.5}", "estimator.iterations=3"])
    saved = tmp_path / "config.yaml"
    saved.write_text(config_yaml(config_dict(config)))
    again = load_config(saved)
    assert again.model_dump(exclude={"version"}) == config.model_dump(exclude={"version"})
    assert again.version == km.__version__
    assert ".inf" in saved.read_text()


def test_a_log_of_a_format_with_options_is_opened_with_them(data: object, tmp_path: Path) -> None:
    data("lost_in_the_woods")  # type: ignore[operator]
    far = open_config_log(load_config("lost_in_the_woods", ["log.to_s=30"]))
    near = open_config_log(load_config("lost_in_the_woods", ["log.to_s=30", "log.r_max=2.0"]))
    assert max(e.y[:, 0].max() for e in far if isinstance(e, km.Scan)) > 2.0
    assert max(e.y[:, 0].max() for e in near if isinstance(e, km.Scan)) <= 2.0


def test_each_lies_below_named_robots_and_sensors_of_a_file_and_of_the_command_line(tmp_path: Path) -> None:
    (tmp_path / "log").mkdir()
    (tmp_path / "log/controls.csv").write_text("t_s,robot,v_mps,w_radps\n0,a,1,0\n0,b,1,0\n")
    (tmp_path / "log/scans.csv").write_text(
        "t_s,robot,sensor,id,range_m,bearing_rad\n.1,a,left,1,2,.1\n.1,a,right,1,2,.1\n.1,b,left,1,2,.1\n"
    )
    path = tmp_path / "mine.yaml"
    path.write_text("""log: {path: log}
robots:
  each: {motion: {type: unicycle, sigma_v_mps: 0.3}, sensors: {each: {type: range_bearing, sigma_range_m: 0.2}}}
  a: {motion: {sigma_w_radps: 0.4}, sensors: {left: {sigma_bearing_rad: 0.5}}}
""")
    overrides = ["robots.each.sensors.each.sigma_range_rel=0.1", "robots.b.sensors.left.sigma_range_m=0.7"]
    config, log = open_run(path, None, overrides)
    slam = build_slam(config, log)
    motion = slam.robots["a"].motion
    assert (motion.sigma_v_mps, motion.sigma_w_radps) == (0.3, 0.4)
    left, right, other = (slam.robots[r].sensors[s].sensor for r, s in (("a", "left"), ("a", "right"), ("b", "left")))
    assert (left.sigma_range_m, left.sigma_bearing_rad, left.sigma_range_rel) == (0.2, 0.5, 0.1)
    assert (right.sigma_range_m, right.sigma_range_rel, other.sigma_range_m) == (0.2, 0.1, 0.7)
    assert list(slam.robots["b"].sensors) == ["left"]
    with pytest.raises(ConfigError, match=r"mine.yaml:3:.*robots.a.sensors.each: got each without a log, expected the"):
        build_slam(load_config(path))
