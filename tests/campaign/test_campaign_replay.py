"""Replays of a log's route and observations with new noise: consistent where the filter is, the same for a seed."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import kalmark as km
from kalmark.campaign import Replay, open_scene, run_campaign
from kalmark.campaign.replay import LEAST, ReplayedScan, Steer, steer_to_path
from kalmark.campaign.scoring import SERIES
from kalmark.cli import main
from kalmark.cli.logs import fitting_config
from kalmark.config import build_slam, open_run
from kalmark.errors import ConfigError, KalmarkError, LogError
from kalmark.logs import write_native
from kalmark.simulate import World, load_world, simulate

FIELD = "world: {type: list, points_m: [[3, 1], [3, -2], [6, 2], [7, -2], [-2, 2], [-2, -3], [2, 4], [9, 1]]}\n"
ODOMETRY = """\
robots:
  rover:
    route: {type: constant, u: [0.1, 0.0, 0.03]}
    motion: {type: odometry_2d, sigma_x_m: 0.01, sigma_y_m: 0.005, sigma_theta_rad: 0.01}
    sensors: {lidar: {type: range_bearing, sigma_range_m: 0.05, sigma_bearing_rad: 0.02, mount: {x_m: 0.2}}}
max_per_scan: 4
steps: 120
"""
UNICYCLE = """\
robots:
  rover:
    start: {x_m: 1.0, sigma_xy_m: 0.1, sigma_theta_rad: 0.05}
    route: {type: wander, speed_mps: 0.5, turn_radius_m: 1.0}
    motion:
      {type: unicycle, sigma_v_mps: 0.05, sigma_w_radps: 0.1, sigma_theta_rad_per_sqrt_s: 0.02,
       sigma_along_m_per_sqrt_s: 0.01}
    sensors: {lidar: {type: range_bearing, sigma_range_m: 0.05, sigma_bearing_rad: 0.02}}
max_per_scan: 4
steps: 120
"""
FIRM = "association={type: identity, gate: off}"
WORLDS = {"odometry": ODOMETRY, "unicycle": UNICYCLE}


def world_of(text: str, folder: Path, *overrides: str) -> World:
    (folder / "world.yaml").write_text(FIELD + text)
    return load_world(folder / "world.yaml", overrides)


def logged(text: str, folder: Path, *overrides: str) -> Path:
    """Write the log of a world, and return the configuration that fits it."""
    folder.mkdir(exist_ok=True)
    world = world_of(text, folder, *overrides)
    write_native(simulate(world, 3), folder)
    (folder / "config.yaml").write_text(fitting_config(world, 3))
    return folder / "config.yaml"


def replay(config: Path, *overrides: str) -> Replay:
    scene = open_scene(config, overrides, progress=False)
    assert isinstance(scene, Replay)
    return scene


@pytest.fixture(scope="module", params=[*WORLDS])
def scene(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Replay:
    return replay(logged(WORLDS[request.param], tmp_path_factory.mktemp("log")), FIRM)


def test_the_invariant_filter_is_consistent_on_the_replay_of_a_log(scene: Replay) -> None:
    figures = run_campaign(scene, 40, ["invariant"], seed=2, jobs=1, progress=False).summary()["estimators"][
        "invariant"
    ]
    assert figures["diverged"] == 0
    assert figures["pose_anees"] == pytest.approx(3.0, rel=0.15)
    assert figures["joint_anees"] == pytest.approx(1.0, rel=0.1)
    assert figures["nis_per_dof"] == pytest.approx(1.0, rel=0.03)


def test_a_replay_keeps_to_the_logs_route_and_looks_at_what_the_log_looked_at(scene: Replay) -> None:
    simulated = scene.simulation(4)
    truth = simulated.log.truth["rover"]
    goals = {e.event.t_ns + (round(e.dt_s * 1e9) if scene.config().robots["rover"].motion.type == "unicycle" else 0): e
             for e in scene.recorded.events if isinstance(e, Steer) and e.dt_s}  # fmt: skip
    away = [np.linalg.norm(truth.at(t)[:2] - goal.goal[:2]) for t, goal in goals.items() if t in truth.t_ns]
    assert len(away) > 100 and np.median(away) < 0.1 and max(away) < 0.4
    looks = [e for e in scene.recorded.events if isinstance(e, ReplayedScan)]
    scans = [e for e in simulated.log.events if isinstance(e, km.Scan)]
    assert [scan.t_ns for scan in scans] == [look.event.t_ns for look in looks] == [*scene.times()]
    assert [scan.ids for scan in scans] == [look.event.ids for look in looks]
    assert not any(np.array_equal(scan.y, look.event.y) for scan, look in zip(scans, looks, strict=True))


def test_the_same_seed_gives_the_same_numbers_and_another_seed_others(scene: Replay) -> None:
    one, same, more, other = (
        run_campaign(scene, runs, ["ekf"], seed=seed, jobs=1, progress=False).scores["ekf"]
        for runs, seed in ((1, 1), (1, 1), (2, 1), (1, 2))
    )
    first, again, elsewhere, longer, second = (
        b"".join(score.series[key].tobytes() for key in SERIES) for score in (*one, *same, *other, *more)
    )
    assert first == again == longer
    assert elsewhere != first != second


def test_a_replay_goes_to_other_processes_whole(tmp_path: Path) -> None:
    scene = replay(logged(ODOMETRY, tmp_path, "steps=20"))
    one, two = (run_campaign(scene, 2, seed=1, jobs=jobs, progress=False) for jobs in (1, 2))
    assert json.dumps(one.summary()) == json.dumps(two.summary())


def test_a_replay_draws_from_the_configured_models_whatever_made_the_log(tmp_path: Path) -> None:
    """Half the noise in the configuration: the log's own NIS tells, the replay is as good as its models."""
    sure = [f"robots.rover.sensors.lidar.{key}" for key in ("sigma_range_m=0.025", "sigma_bearing_rad=0.01")]
    config = logged(ODOMETRY, tmp_path)
    opened, log = open_run(config, None, [*sure, FIRM])
    run = km.record(build_slam(opened, log), log, progress=False)
    assert run.evaluate()["nis_per_dof"] > 2
    figures = run_campaign(replay(config, *sure, FIRM), 5, jobs=1, progress=False).summary()["estimators"]["invariant"]
    assert figures["nis_per_dof"] == pytest.approx(1.0, rel=0.1)


def test_ids_are_withheld_where_the_log_withholds_them(tmp_path: Path) -> None:
    scene = replay(logged(ODOMETRY, tmp_path, "ids=false"))
    simulated = scene.simulation(1)
    assert not any(any(e.ids or ()) for e in simulated.log.events if isinstance(e, km.Scan))
    assert {i for real in simulated.origins.values() for i in real} <= {*scene.recorded.landmarks}
    score = run_campaign(scene, 1, jobs=1, progress=False).scores["invariant"][0]
    assert score.landmarks >= 5 and score.landmark_rmse_raw_m < 0.5


def test_robots_that_see_each_other_see_each_other_again(tmp_path: Path) -> None:
    write_native(simulate(load_world("two_robots", ["steps=60", "sight_robots=true"]), 1), tmp_path)
    (tmp_path / "config.yaml").write_text(fitting_config(load_world("two_robots", ["sight_robots=true"]), 1))
    scene = replay(tmp_path / "config.yaml", FIRM)
    simulated = scene.simulation(0)
    assert {"alpha", "beta"} <= {i for real in simulated.origins.values() for i in real}
    f = run_campaign(scene, 10, jobs=1, progress=False).summary()["estimators"]["invariant"]
    assert f["nis_per_dof"] == pytest.approx(1.0, rel=0.1) and f["diverged"] == 0


def write(folder: Path, scans: list[str], fixes: str = "") -> Path:
    folder.mkdir(exist_ok=True)
    controls = ["t_s,robot,v_mps,w_radps", *(f"{0.1 * k:.1f},r,{0.5 if k > 5 else 0},0" for k in range(20))]
    (folder / "controls.csv").write_text("\n".join(controls) + "\n")
    (folder / "scans.csv").write_text("\n".join(scans) + "\n")
    if fixes:
        (folder / "fixes.csv").write_text(fixes)
    (folder / "config.yaml").write_text("""\
log: {path: .}
robots:
  r:
    motion: {type: unicycle, sigma_v_mps: 0.0, sigma_w_radps: 0.0, sigma_along_m_per_sqrt_s: 0.05}
    sensors: {lidar: {type: range_bearing}}
association: {type: identity, gate: 0.9973}
""")
    return folder / "config.yaml"


ROWS = [f"{0.1 * k:.1f},r,lidar,7,{3 - 0.05 * max(0, k - 6):.3f},0.0,0.2,0.1" for k in range(20)]
SCANS = ["t_s,robot,sensor,id,range_m,bearing_rad,sigma_range_m,sigma_bearing_rad", *ROWS]


def test_noise_of_the_logs_own_fixes_and_rejected_observations_are_the_logs(tmp_path: Path) -> None:
    scans = [*SCANS, "1.9,r,lidar,8,2.0,1.0,0.2,0.1"]
    scans[15] = "1.4,r,lidar,7,30.0,0.0,0.2,0.1"  # far outside the gate
    fixes = "t_s,robot,x_m,y_m,cov_xx,cov_xy,cov_yy\n1.0,r,0.2,0.0,0.04,0.0,0.04\n"
    scene = replay(write(tmp_path, scans, fixes))
    events = scene.simulation(0).log.events
    seen = {round(e.t_s, 1): e for e in events if isinstance(e, km.Scan)}
    assert len(seen) == 19 and 1.4 not in seen
    assert np.allclose(seen[1.9].cov, np.diag([0.04, 0.01])) and len(seen[1.9].y) == 2
    (fix,) = [e for e in events if isinstance(e, km.Fix)]
    assert 0 < np.linalg.norm(fix.y - [0.2, 0.0]) < 1.0
    ranges = np.array([run.y[0, 0] for seed in range(60) for run in [_first_scan(scene, seed)]])
    assert np.std(ranges) == pytest.approx(0.2, rel=0.3)


def _first_scan(scene: Replay, seed: int) -> km.Scan:
    return next(e for e in scene.simulation(seed).log.events if isinstance(e, km.Scan))


def test_a_robot_told_to_stand_stands_and_what_diffuses_is_steered_against(tmp_path: Path) -> None:
    scene = replay(write(tmp_path, SCANS))
    states = np.array([scene.simulation(seed).states["r"] for seed in range(20)])
    assert (states[:, :7] == 0).all()
    assert 0.001 < states[:, -1, 0].std() < 0.1


def test_a_car_beside_its_path_comes_back_to_it() -> None:
    car = km.motion.Ackermann(sigma_v_mps=0.2, sigma_steering_rad=0.05)
    for speed in (2.0, -2.0):
        r, u = np.array([0.0, 1.0, 0.0]), np.array([speed, 0.0])
        for k in range(1, 201):
            goal = np.array([0.1 * speed * k, 0.0, 0.0])
            steer = Steer(km.Control(t_s=0, robot="car", u=u), 0.1, goal, 25 * LEAST)
            r, *_ = car.move(r, steer_to_path(car, r, steer, car.control_noise(u)), 0.1)
        assert np.abs(r - goal).max() < 0.05


def test_without_noise_the_control_is_the_logs() -> None:
    still = km.motion.Unicycle(sigma_v_mps=0.0, sigma_w_radps=0.0)
    steer = Steer(km.Control(t_s=0, robot="r", u=(0.5, 0.1)), 0.1, np.array([1.0, 1.0, 0.0]))
    assert steer_to_path(still, np.zeros(3), steer, still.control_noise(steer.event.u)) is steer.event.u


def test_the_command_line_replays_a_configuration_and_saves_it_to_be_run(tmp_path: Path, capsys: Any) -> None:
    config, out = logged(ODOMETRY, tmp_path / "log", "steps=20"), tmp_path / "out"
    assert main(["campaign", str(config), "--runs", "2", "--jobs", "1", "--out", str(out), "--estimator", "ekf"]) == 0
    assert capsys.readouterr().out.startswith("log: 2 runs, seed 0"), "by the folder of the log and its config.yaml"
    summary = json.loads((out / "summary.json").read_text())
    assert summary["config"] == "log" and [*summary["estimators"]] == ["ekf"]
    assert main(["run", str(out / "config.yaml"), "--out", str(tmp_path / "run")]) == 0
    config.write_text(config.read_text().replace("path:", "#"))
    again = "--log", str(config.parent), "--runs", "1", "--jobs", "1", "--out", str(tmp_path / "again")
    assert main(["campaign", str(config), *again]) == 0


def test_what_cannot_be_replayed_is_refused_with_its_place(tmp_path: Path) -> None:
    plane = logged(ODOMETRY, tmp_path / "plane", "steps=5")
    with pytest.raises(KalmarkError, match="plane: no observation is of a landmark of the map, expected some to repl"):
        (tmp_path / "plane" / "scans.csv").write_text("t_s,robot,sensor,id,range_m,bearing_rad\n0,rover,lidar,,1,0\n")
        open_scene(plane, progress=False)
    (tmp_path / "space").mkdir()
    columns = km.motion.Odometry3D.columns
    (tmp_path / "space" / "controls.csv").write_text(f"t_s,robot,{','.join(columns)}\n0,r{',0' * len(columns)}\n")
    (tmp_path / "space.yaml").write_text("log: {path: space}\nrobots: {each: {motion: {type: odometry_3d}}}\n")
    with pytest.raises(
        ConfigError, match=r"space.yaml:2:.*motion: got odometry_3d, a motion of space, expected one of"
    ):
        open_scene(tmp_path / "space.yaml", progress=False)
    config = write(tmp_path / "raw", SCANS)
    with pytest.raises(ConfigError, match=r"--set .*lidar.detector: got a detector, expected scans of landmarks"):
        open_scene(config, ["robots.r.sensors.lidar.detector={type: reflectors}"], progress=False)


def test_worlds_and_configurations_are_told_apart(tmp_path: Path) -> None:
    assert isinstance(open_scene("cloister"), World)
    (tmp_path / "my.yaml").write_text(FIELD + ODOMETRY)
    assert isinstance(open_scene(tmp_path / "my.yaml"), World)
    with pytest.raises(ConfigError, match=r"--log x: .*my.yaml is a world, expected a configuration to use it in"):
        open_scene(tmp_path / "my.yaml", log="x")
    with pytest.raises(LogError, match="'nowhere' not found"):
        open_scene("cloister", log="nowhere")
    with pytest.raises(
        ConfigError, match=r"expected a world or a configuration: .*mrclam.*two_robots.*did you mean mrclam"
    ):
        open_scene("mrclm")
