"""Configurations of space, and configurations laid over what a log says of itself."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import kalmark as km
from kalmark.config import Config, build_slam, config_dict, load_config, open_run
from kalmark.config import opening as opening_module
from kalmark.errors import ConfigError
from kalmark.logs import Log, Trajectory
from kalmark.results.recording import config_yaml
from kalmark.simulate import load_world

SECOND = 1_000_000_000
RADAR = {"type": "range_bearing_3d", "sigma_range_m": 0.3, "mount": {"z_m": 0.6, "yaw_deg": 90.0}}
RIG: dict[str, Any] = {
    "robots": {
        "each": {"motion": {"type": "odometry_3d", "sigma_x_m": 0.5, "sigma_y_m": 0.6}},
        "a": {"start": {"x_m": 1.0, "z_m": 3.0}, "sensors": {"radar": RADAR}},
    },
    "landmarks": {"type": "point"},
    "association": {"type": "identity", "gate": 0.9},
}
TRUTH = np.array([[5.0, 6.0, 7.0, 0.0, 0.0, 0.6, 0.8]] * 3)


def log_of(*robots: str, describes: dict[str, Any] | None = None) -> Log:
    """Return a log of robots of space that describes itself."""
    u = (1.0, 0.0, 0.0, 0.0, 0.0, 0.1)
    events = [km.Control(float(t), name, u) for t in range(1, 3) for name in robots]
    truth = {name: Trajectory(np.arange(3) * SECOND, TRUTH) for name in robots}
    columns = {name: km.motion.Odometry3D.columns for name in robots}
    log = Log("test", robots, events, path=Path("rig.json"), truth=truth, control_columns=columns)
    return dataclasses.replace(log, describes=RIG if describes is None else describes)


@pytest.fixture
def opened(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Return what opens a configuration given as text over a log."""

    def opened(text: str, log: Log, *overrides: str) -> tuple[Config, Log]:
        path = tmp_path / "my.yaml"
        path.write_text(text)
        monkeypatch.setattr(opening_module, "open_config_log", lambda _, **__: log)
        return open_run(path, tmp_path, overrides)

    return opened


EMPTY = "map: {type: auto}"


def test_mounts_and_starts_of_space_are_poses(tmp_path: Path) -> None:
    path = tmp_path / "my.yaml"
    path.write_text(
        "robots:\n  each:\n    motion: {type: odometry_3d}\n"
        "    start: {x_m: 1, y_m: 2, z_m: 3, roll_deg: 10, pitch_deg: 20, yaw_deg: 30, sigma_position_m: 2,\n"
        "            sigma_rotation_deg: 1}\n"
        "    sensors: {eye: {type: position_3d, mount: {x_m: 0.5, roll_deg: -90, yaw_deg: -90}}}\n"
    )
    slam = build_slam(load_config(path))
    assert slam.mean("robot")[:3] == pytest.approx([1, 2, 3])
    turn = Rotation.from_euler("xyz", [10, 20, 30], degrees=True)
    assert (Rotation.from_quat(slam.mean("robot")[3:]).inv() * turn).magnitude() < 1e-12
    assert slam.covariance("robot") == pytest.approx(np.diag([4.0] * 3 + [np.radians(1) ** 2] * 3))
    at = slam.robots["robot"].sensors["eye"].at
    assert at[:3].tolist() == [0.5, 0, 0]
    ahead, down = Rotation.from_quat(at[3:]).apply([[0, 0, 1], [0, 1, 0]])
    assert ahead == pytest.approx([1, 0, 0])
    assert down == pytest.approx([0, 0, -1])


def test_a_mount_with_sigmas_is_in_the_map_and_a_sensor_has_its_own_ways(opened: Any) -> None:
    text = """\
robots:
  a:
    sensors:
      camera:
        type: pinhole
        distortion: [-0.3, 0.1]
        mount: {roll_deg: -90, yaw_deg: -90, sigma_position_m: [0.1, 0.2, 0], sigma_rotation_deg: 1.5}
        landmark: {type: inverse_depth, prior_rho_per_m: 0.2}
        association: {type: nearest}
        attention: {updates: 10, first_starts: 5, starts: 1, grid: [8, 6], delete: true}
"""
    slam = build_slam(*opened(text, log_of("a")))
    camera = slam.robots["a"].sensors["camera"]
    assert camera.sensor == km.sensors.PinHole(distortion=(-0.3, 0.1))
    assert camera.landmark == km.landmarks.InverseDepth3D(prior_rho_per_m=0.2)
    assert camera.association == km.association.NearestNeighbour()
    assert camera.attention == km.Attention(updates=10, first_starts=5, starts=1, grid=(8, 6), delete=True)
    assert slam.covariance("a.camera") == pytest.approx(np.diag([0.01, 0.04, 0, *3 * [np.radians(1.5) ** 2]]))
    assert slam.robots["a"].sensors["radar"].cov is None


def test_a_robot_that_coasts_starts_with_its_velocity(tmp_path: Path) -> None:
    path = tmp_path / "my.yaml"
    path.write_text(
        "robots:\n  each:\n    motion: {type: constant_velocity_3d}\n"
        "    start: {z_m: 1, vx_mps: 0.8, wz_radps: 0.1, sigma_v_mps: [0.1, 0, 0], sigma_w_radps: 0.2}\n"
    )
    slam = build_slam(load_config(path))
    assert slam.mean("robot").tolist() == [0, 0, 1, 0, 0, 0, 1, 0.8, 0, 0, 0, 0, 0.1]
    assert slam.covariance("robot") == pytest.approx(np.diag([0.0] * 6 + [0.01, 0, 0] + [0.04] * 3))


@pytest.mark.parametrize(("value", "linearity"), [("0.05", 0.05), ("off", None), (None, 0.03)])
def test_points_become_euclidean_below_the_linearity_index_of_the_map(
    tmp_path: Path, value: str | None, linearity: float | None
) -> None:
    path = tmp_path / "my.yaml"
    path.write_text("seed: 1")
    config = load_config(path, [] if value is None else [f"map.reparametrize={value}"])
    assert build_slam(config).state.settings.reparametrize == linearity
    for bad in ("-1", "true", "on", ".inf"):
        with pytest.raises(ConfigError, match="expected a number of at least 0 or off"):
            load_config(path, [f"map.reparametrize={bad}"])


def test_a_landmark_that_a_sensor_does_not_see_is_refused_by_its_place(opened: Any) -> None:
    with pytest.raises(ConfigError, match=r"robots: a RangeBearing3D does not see .* tag"):
        build_slam(*opened("landmarks: {type: tag}", log_of("a")))


def test_a_point_is_of_the_world_of_the_robots(opened: Any) -> None:
    slam = build_slam(*opened(EMPTY, log_of("a")))
    assert slam.state.settings.landmarks == km.landmarks.Point3D()


def test_a_robot_of_space_without_a_start_starts_at_the_truth(opened: Any) -> None:
    rig = {"robots": {"each": {"motion": {"type": "odometry_3d"}}}}
    slam = build_slam(*opened(EMPTY, log_of("a", describes=rig)))
    assert slam.mean("a") == pytest.approx(TRUTH[0])


def test_what_the_log_describes_is_in_force_where_the_user_says_nothing(opened: Any) -> None:
    config, log = opened(EMPTY, log_of("a", "b"))
    slam = build_slam(config, log)
    assert slam.robots["a"].motion == slam.robots["b"].motion == km.motion.Odometry3D(sigma_x_m=0.5, sigma_y_m=0.6)
    assert slam.robots["a"].sensors["radar"].sensor == km.sensors.RangeBearing3D(sigma_range_m=0.3)
    assert slam.robots["a"].sensors["radar"].at[2] == 0.6
    assert not slam.robots["b"].sensors
    assert slam.mean("a")[:3] == pytest.approx([1, 0, 3])
    assert slam.association == km.association.ByIdentity(gate=0.9)


def test_what_the_user_says_wins_key_by_key_for_robots_and_sensors(opened: Any) -> None:
    text = """\
robots:
  each: {motion: {sigma_y_m: 0.7}}
  a:
    start: {z_m: 4}
    sensors: {radar: {sigma_azimuth_rad: 0.5}, eye: {type: position_3d}}
association: {gate: off}
"""
    slam = build_slam(*opened(text, log_of("a", "b")))
    a, b = slam.robots["a"], slam.robots["b"]
    assert a.motion == b.motion == km.motion.Odometry3D(sigma_x_m=0.5, sigma_y_m=0.7)
    assert slam.mean("a")[:3] == pytest.approx([1, 0, 4])
    assert a.sensors["radar"].sensor == km.sensors.RangeBearing3D(sigma_range_m=0.3, sigma_azimuth_rad=0.5)
    assert a.sensors["eye"].sensor == km.sensors.Position3D()
    assert slam.association == km.association.ByIdentity(gate="off")


def test_another_type_drops_what_the_log_says_of_the_section_but_for_a_mount(opened: Any) -> None:
    text = "robots: {a: {sensors: {radar: {type: position_3d, sigma_x_m: 0.2}}}}"
    slam = build_slam(*opened(text, log_of("a")))
    assert slam.robots["a"].sensors["radar"].sensor == km.sensors.Position3D(sigma_x_m=0.2)
    assert slam.robots["a"].sensors["radar"].at[2] == 0.6


def test_an_override_needs_no_type_where_the_log_has_one(opened: Any) -> None:
    config, _ = opened(EMPTY, log_of("a"), "robots.each.sensors.radar.sigma_range_m=0.4")
    assert config.robots["a"].sensors["radar"].sigma_range_m == 0.4


def test_what_was_in_force_is_saved_whole_and_says_the_same_again(opened: Any) -> None:
    config, log = opened("robots: {a: {start: null, motion: {sigma_z_m: 0.9}}}", log_of("a", "b"))
    saved = config_yaml(config_dict(config))
    assert "sigma_range_m: 0.3" in saved
    again, _ = opened(saved, log)
    assert again.model_dump(exclude={"version", "log"}) == config.model_dump(exclude={"version", "log"})
    assert again.robots["a"].start is None
    silent, _ = opened(saved, dataclasses.replace(log, describes={}))
    assert silent.robots == again.robots


def test_a_configuration_read_without_its_log_is_laid_over_it_when_built(tmp_path: Path) -> None:
    path = tmp_path / "my.yaml"
    path.write_text("association: {gate: off}")
    slam = build_slam(load_config(path), log_of("a"))
    assert slam.robots["a"].sensors["radar"].sensor == km.sensors.RangeBearing3D(sigma_range_m=0.3)
    assert slam.association == km.association.ByIdentity(gate="off")


@pytest.mark.parametrize(
    ("text", "rig", "message"),
    [
        (
            EMPTY,
            {"robots": {"a": {"motion": {"type": "odometry_3d", "sigma_x_m": -1.0}}}},
            "rig.json: robots.a.motion.s",
        ),
        (
            EMPTY,
            {"robots": {"a": {"motion": {"type": "odometry_4d"}}}},
            "rig.json: robots.a.motion.type: got 'odometry_4",
        ),
        (EMPTY, {"robots": {"a": {"wheels": 3}}}, "rig.json: robots.a.wheels: got an unknown key (value 3)"),
        (
            "robots:\n  each: {motion: {sigma_x_m: -1}}",
            RIG,
            "my.yaml:2:30: robots.a.motion.sigma_x_m: got -1",
        ),
        ("robots:\n  each: {motoin: {sigma_x_m: 1}}", RIG, "my.yaml:2:10: robots.a.motoin: got an unknown key"),
        ("robots:\n  c: {}", RIG, "my.yaml:2:6: robots.c: got a robot that the log does not have"),
        ("robots: 3", RIG, "my.yaml:1:9: robots: got 3, expected a mapping of keys"),
        ("robots: {each: 3}", RIG, "my.yaml:1:16: robots.a: got 3, expected a mapping of keys"),
    ],
)
def test_an_error_points_to_the_user_s_place_or_to_the_log(
    opened: Any, text: str, rig: dict[str, Any], message: str
) -> None:
    with pytest.raises(ConfigError) as error:
        build_slam(*opened(text, log_of("a", describes=rig)))
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_robots_of_the_plane_and_of_space_in_one_map_are_refused_by_their_place(opened: Any) -> None:
    log = dataclasses.replace(log_of("a", "b"), control_columns={})
    with pytest.raises(ConfigError, match=r"robots: robot 'b' is of the plane, expected one of the space"):
        build_slam(*opened("robots: {a: {}, b: {motion: {type: unicycle}}}", log))


def test_an_unknown_motion_of_a_robot_of_space_is_the_error_not_its_start() -> None:
    with pytest.raises(ConfigError, match=r"robots\.robot\.motion\.type: got 'hover', expected one of .*odometry_3d"):
        load_world("thick_cloister", ["robots.robot.motion.type=hover"])
