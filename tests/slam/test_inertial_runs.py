"""Whole runs of an inertial unit: gauges, consistency, every kind of sensor with it, files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2

import kalmark as km
from kalmark.campaign.scoring import score
from kalmark.config.building import build_slam
from kalmark.config.sections import model_of
from kalmark.errors import KalmarkError
from kalmark.events import Control, Scan
from kalmark.geometry.rotations import exp, matrix
from kalmark.logs import open_log, write_native
from kalmark.simulate import load_world, simulate
from kalmark.simulate.robots import simulation
from resumed import ends_alike

SHIFT, VERTICAL, ANY = np.array([30.0, -20.0, 5.0]), np.array([0.0, 0.0, 1.9]), np.array([0.7, -1.1, 0.4])
DRONE = "robots.drone."
GRAVITY = (
    f"{DRONE}motion={{type: inertial_gravity}}", f"{DRONE}start.gravity_z_mps2=-9.81",
    f"{DRONE}start.sigma_gravity_mps2=0.1", f"{DRONE}start.sigma_rotation_deg=1.0",
)  # fmt: skip
ANGLES = "sigma_azimuth_rad: 0.005, sigma_elevation_rad: 0.005"
RADAR = f"{DRONE}sensors.stereo={{type: range_bearing_3d, sigma_range_m: 0.05, {ANGLES}}}"
CAMERA = f"{DRONE}sensors.stereo={{type: pinhole, mount: {{roll_deg: -90, yaw_deg: -90}}}}"


def world(*keys: str, steps: int = 200) -> Any:
    return load_world("inertial", [f"steps={steps}", *keys])


def moved(slam: km.Slam, name: Any, turn: np.ndarray) -> np.ndarray:
    """Return the mean of a block shifted, then turned: with its point or its pose, which comes first."""
    x = slam.mean(name).copy()
    x[:3] += SHIFT
    return np.asarray(slam.map.spaces[slam.slot(name)].rotated(x, turn))


@pytest.mark.parametrize(
    ("turn", "keys"),
    [
        (VERTICAL, ("filter.estimator.type=invariant",)),
        (VERTICAL, ("filter.estimator.type=invariant", "filter.landmarks.type=anchored_homogeneous")),
        (VERTICAL, ("filter.estimator.type=fej",)),
        (VERTICAL, ("filter.estimator.type=ekf",)),
        (ANY, ("filter.estimator.type=invariant", *GRAVITY)),
    ],
    ids=str,
)
def test_a_run_that_is_shifted_and_turned_gives_the_same_estimate(turn: np.ndarray, keys: tuple[str, ...]) -> None:
    """Turned about the gravity; with the gravity in the state, about any axis."""
    scene = world(*keys)
    log, Q = simulate(scene, 1), matrix(exp(turn))
    here, there = build_slam(scene.config(), log), build_slam(scene.config(), log)
    there.map.set_predicted(there.slot("drone"), moved(there, "drone", turn))
    for event in log:
        one, other = here.process(event), there.process(event)
        assert [seen.outcome for seen in one.observations] == [seen.outcome for seen in other.observations]
    names = ["drone", *here.landmarks().ids]
    assert len(names) > 10
    for name in names:
        space = here.map.spaces[here.slot(name)]
        d = space.minus(moved(here, name, turn), there.mean(name))
        np.testing.assert_allclose(d, 0.0, atol=1e-6, err_msg=str(name))
    G = np.eye(len(here.covariance("drone")))
    for at in (0, 3, 6, 15)[: len(G) // 5 + (len(G) == 18)]:
        G[at : at + 3, at : at + 3] = Q
    P = G @ here.covariance("drone") @ G.T
    scale = np.sqrt(np.outer(np.diag(P), np.diag(P))) + 1e-12
    np.testing.assert_allclose(P / scale, there.covariance("drone") / scale, atol=1e-5)


def information(slam: km.Slam) -> np.ndarray:
    """Return the information (4, 4) about shifts and turns about the gravity, of the robot and its points."""
    names, parts = ["drone", *slam.landmarks().ids], []
    for name in names:
        space: Any = slam.map.spaces[slam.slot(name)]
        parts.append(np.column_stack([np.eye(space.dof, 3), space.generator(slam.mean(name))[:, 2]]))
    N = np.concatenate(parts)
    return np.asarray(N.T @ np.linalg.solve(slam.covariance(*names), N))


@pytest.mark.parametrize("route", ["flies", "stands"])
def test_shifts_and_turns_about_the_gravity_stay_as_uncertain_as_they_were(route: str) -> None:
    lost = (
        f"{DRONE}start.sigma_position_m=1.0",
        f"{DRONE}start.sigma_rotation_deg=[1, 1, 20]",
        f"{DRONE}start.sigma_v_mps=0.01",
    )
    stands = f"{DRONE}route={{type: constant, u: [0, 0, 0, 0, 0, 9.81]}}"
    biases = (f"{DRONE}start.sigma_bias_w_radps=1e-4", f"{DRONE}start.sigma_bias_a_mps2=0.01")
    scene = world(RADAR, *lost, *((stands, *biases) if route == "stands" else ()), steps=600)
    log = simulate(scene, 2)
    slam, least = build_slam(scene.config(), log), []
    root = np.linalg.inv(np.linalg.cholesky(information(slam)))
    for event in log:
        slam.process(event)
        if isinstance(event, Scan):
            values = np.linalg.eigvalsh(root @ information(slam) @ root.T)
            assert values[-1] < 1.0 + 1e-6, "nothing tells where the world is, nor which way is north"
            least.append(values[0])
    assert least[-1] > 1.0 - 1e-3, "what is lost is that the landmarks are not known exactly"
    assert np.sqrt(slam.covariance("drone")[3, 3]) < np.radians(0.6), "the gravity shows roll and pitch"


@pytest.mark.parametrize(
    ("keys", "dof"),
    [
        ((), 15),
        ((RADAR,), 15),
        ((RADAR, "filter.map.type=postponed"), 15),
        ((CAMERA, "filter.landmarks.type=anchored_homogeneous"), 15),
        (GRAVITY, 18),
    ],
    ids=str,
)  # fmt: skip
def test_the_estimate_is_as_far_from_the_truth_as_it_says(keys: tuple[str, ...], dof: int) -> None:
    scene, values = world(*keys, steps=1000), []
    for seed in range(4):
        simulated = simulation(scene, seed)
        slam = build_slam(scene.config(), simulated.log)
        found = score(slam, simulated, scene.times(), map_every=scene.steps)
        values.append(found.series["state"][0][-1])
        assert found.series["state_dof"][0][-1] == dof
        before, after = (np.sqrt(np.diag(P))[9:15] for P in (slam.robots["drone"].cov, slam.covariance("drone")))
        assert (after[:3] < 0.2 * before[:3]).all(), "the biases of the rate are found"
    low, high = chi2.ppf([0.0005, 0.9995], dof * len(values))
    assert low < sum(values) < high


AHEAD = "mount: {roll_deg: -90, yaw_deg: -90}"
HOUSE = (
    "world={type: house, x_m: -2.5, y_m: -2.5}", f"{DRONE}start.x_m=6.0",
    f"{DRONE}route.points_m=[[6, 2, 2.5], [4, 6, 1], [0, 7, 2], [-6, 4, 2]]",
    f"{DRONE}sensors.stereo={{type: segments, min_length_px: 10, mount: {{roll_deg: -90}}}}",
    "filter.landmarks={type: anchored_homogeneous_line, prior_rho_per_m: 0.25, sigma_rho_per_m: 0.125}",
    "filter.estimator.iterations=1", f"{DRONE}start.sigma_bias_a_mps2=0.005", f"{DRONE}start.sigma_bias_w_radps=0.001",
    f"{DRONE}start.sigma_rotation_deg=0.1",
)  # fmt: skip
TAGS = (
    "world={type: tag_room, length_m: 10, width_m: 10, size_m: 0.5}",
    f"{DRONE}sensors.stereo={{type: tag_corners, fx_px: 500, fy_px: 500, {AHEAD}}}", "filter.landmarks.type=tag",
)  # fmt: skip


@pytest.mark.parametrize(
    "keys",
    [
        *((CAMERA, f"filter.landmarks.type={kind}") for kind in ("inverse_depth", "homogeneous")),
        (f"{DRONE}sensors.stereo={{type: omnidirectional, {AHEAD}}}", "filter.landmarks.type=anchored_homogeneous"),
        (f"{DRONE}sensors.stereo={{type: position_3d}}",),
        HOUSE,
        TAGS,
    ],
    ids=str,
)
def test_landmarks_and_cameras_of_any_kind_work_with_it(keys: tuple[str, ...]) -> None:
    scene = world(*keys, steps=300)
    simulated = simulation(scene, 5)
    slam = build_slam(scene.config(), simulated.log)
    found = score(slam, simulated, scene.times(), map_every=scene.steps)
    assert len(slam.landmarks().ids) > 3
    assert not found.diverged
    values = found.series["state"][0]
    assert values[np.isfinite(values)][-1] < chi2.ppf(0.99999, 15)


STATE_SENSORS = {
    "gps": "{type: gps, sigma_m: 0.05, mount: {x_m: 0.3}}",
    "mocap": "{type: absolute_pose, sigma_m: 0.02, sigma_rotation_rad: 0.01}",
    "barometer": "{type: height, sigma_z_m: 0.05, sigma_bias_m: 0.1}",
    "compass": "{type: heading, sigma_heading_rad: 0.05}",
    "flow": "{type: body_velocity, sigma_mps: 0.02}",
    "speed": "{type: speed, sigma_mps: 0.02, mount: {x_m: 0.1, y_m: 0.3}}",
    "gyro": "{type: gyro, sigma_radps: 0.002}",
    "wheels": "{type: odometer, sigma_m: 0.01, sigma_rad: 0.01}",
}


@pytest.mark.parametrize("name", STATE_SENSORS)
def test_sensors_of_the_state_work_with_it(name: str) -> None:
    sensors = f"{DRONE}sensors.{name}={STATE_SENSORS[name]}", f"{DRONE}sensing.{name}={{every: 10}}"
    scene, values = world(RADAR, *sensors, f"{DRONE}start.sigma_position_m=0.1", steps=400), []
    for seed in range(3):
        simulated = simulation(scene, seed)
        slam = build_slam(scene.config(), simulated.log)
        found = score(slam, simulated, scene.times(), map_every=scene.steps)
        values.append(found.series["state"][0][-1])
    low, high = chi2.ppf([0.0005, 0.9995], 15 * len(values))
    assert low < sum(values) < high


def test_a_scan_of_nothing_between_two_readings_changes_nothing() -> None:
    """The noise of a reading is white: its parts have none in common."""
    scene = world(steps=40)
    log = simulate(scene, 3)
    whole, parted = build_slam(scene.config(), log), build_slam(scene.config(), log)
    for event in log:
        whole.process(event)
        parted.process(event)
        if isinstance(event, Control) and event.t_ns % 50_000_000:
            parted.process(Scan(t_ns=event.t_ns + 2_000_000, robot="drone", sensor="stereo"))
    np.testing.assert_allclose(parted.mean("drone"), whole.mean("drone"), atol=1e-10)
    P = whole.covariance("drone")
    scale = np.sqrt(np.outer(np.diag(P), np.diag(P))) + 1e-30
    np.testing.assert_allclose(parted.covariance("drone") / scale, P / scale, atol=1e-7)


def test_a_log_of_it_is_written_read_and_resumed(tmp_path: Path) -> None:
    scene = world(steps=60)
    log = simulate(scene, 4)
    write_native(log, tmp_path / "log")
    again = open_log(tmp_path / "log")
    assert again.control_columns["drone"] == ("wx_radps", "wy_radps", "wz_radps", "ax_mps2", "ay_mps2", "az_mps2")
    slams = build_slam(scene.config(), log), build_slam(scene.config(), again)
    ends_alike(slams, log.events, again.events, 40, tmp_path / "map.kmk")


# ---------------------------------------------------------------------- at rest
REST_NS = 2_000_000_000


def rested(log: km.Log, state: np.ndarray, motion: Any, rng: np.random.Generator) -> km.Log:
    """Return a log, from a true state (16,) without velocity on, with a rest before it: readings and empty scans."""
    white = motion.densities[:6] / np.sqrt(0.005)
    still = np.concatenate([state[10:13], state[13:16] + matrix(state[3:7].copy()).T @ [0, 0, 9.81]])
    begin: list[Any] = [
        Control(t_ns=t, robot="drone", u=still + rng.normal(size=6) * white) for t in range(0, REST_NS, 5_000_000)
    ]
    later: list[Any] = []
    for event in log:
        key = {"t_ns": event.t_ns + REST_NS, "robot": "drone"}
        is_scan = isinstance(event, Scan)
        later.append(Scan(**key, sensor="stereo", y=event.y, ids=event.ids) if is_scan else Control(**key, u=event.u))
    return replace(log, events=begin + later, truth={})


def test_a_start_at_rest_is_found_in_the_log_and_is_consistent() -> None:
    """Tilted by some degrees, with biases of which nothing is known: the filter starts from its first readings."""
    tilted = f"{DRONE}start.sigma_rotation_deg=[5, 5, 0]"
    found = "filter.robots.drone.start={at_rest: true, sigma_rotation_deg: [0, 0, 0.5]}"
    scene, values = world(RADAR, tilted, found, steps=600), []
    motion = model_of(scene.config().robots["drone"].motion)
    for seed in range(4):
        simulated = simulation(scene, seed)
        states, rng = simulated.states["drone"], np.random.default_rng(seed)
        log = rested(simulated.log, states[0], motion, rng)
        slam = build_slam(scene.config(), log)
        robot = slam.robots["drone"]
        assert 0.8 * REST_NS < robot.rests_until_ns < REST_NS + 5e7
        for event in log:
            slam.process(event)
        d = robot.motion.space.minus(states[-1], slam.mean("drone"))
        values.append(float(d @ np.linalg.solve(slam.covariance("drone"), d)))
    low, high = chi2.ppf([0.0005, 0.9995], 15 * len(values))
    assert low < sum(values) < high


@pytest.mark.parametrize(
    ("start", "what"),
    [
        ("{at_rest: true, sigma_bias_a_mps2: 0.0}", "sigma_bias_a_mps2: got 0.0, expected a positive number"),
        ("{at_rest: 1}", "at_rest: got 1, expected true or false"),
    ],
)
def test_a_start_at_rest_that_cannot_be_found_is_refused(start: str, what: str) -> None:
    with pytest.raises(KalmarkError) as refused:
        world(f"filter.robots.drone.start={start}")
    assert what in str(refused.value)


def test_a_start_at_rest_is_refused_of_a_log_that_begins_with_a_motion() -> None:
    scene = world(RADAR, "filter.robots.drone.start={at_rest: true}")
    with pytest.raises(KalmarkError) as refused:
        build_slam(scene.config(), simulate(scene, 1))
    assert "robots.drone.start: the unit begins with" in str(refused.value)
    assert "Begin where it stands, by log.from_s; or state a start without at_rest" in str(refused.value)
    with pytest.raises(KalmarkError) as refused:
        build_slam(scene.config())
    assert "expected a log that begins at rest" in str(refused.value)
    assert "state a start without at_rest" in str(refused.value)
