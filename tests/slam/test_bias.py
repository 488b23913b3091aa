"""What of a control's error does not average out is a block of the map, and is estimated."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import kalmark as km
from kalmark.config import build_slam, load_config, open_config_log
from kalmark.filter.compressed.compressed_map import CompressedMap
from kalmark.results.record import record
from kalmark.simulate import load_world
from kalmark.simulate.robots import simulation

WORLD = np.random.default_rng(1).uniform(-8, 8, (60, 2))
START = (5.0, 0.0, np.pi / 2)
SIGMAS = {"sigma_v_mps": 0.05, "sigma_w_radps": 0.02}
PRIOR = {"sigma_v_bias_mps": 0.1, "sigma_w_bias_radps": 0.03}
EKF = km.estimators.Ekf()
BIAS = np.array([0.12, -0.02])


def slam_of(prior: dict[str, float], **options: Any) -> km.Slam:
    """Return a Slam of a robot whose odometry may have a bias."""
    lidar = km.Mount(km.sensors.RangeBearing(0.1, 0.02))
    robot = km.Robot("r", km.motion.Unicycle(**SIGMAS, **prior), START, {"lidar": lidar})
    return km.Slam([robot], km.association.ByIdentity("off"), **options)


def drive(steps: int, seed: int, bias: np.ndarray) -> tuple[list[Any], np.ndarray]:
    """Return the events of a robot that goes round, its odometry saying `bias` too little, and where it ends."""
    rng, events, truth = np.random.default_rng(seed), [], np.array(START)
    for t in range(steps):
        u = np.array([1.0, 0.2])
        noise = rng.normal(size=2) * [*SIGMAS.values()]
        events.append(km.Control(t * 0.1, "r", u - bias + noise))
        for after in (0.05, 0.07):  # scans split the control's interval
            seen = km.geometry.compose(truth, arc(u, after))[0]
            near = np.flatnonzero(np.hypot(*(WORLD - seen[:2]).T) < 4.0)[:6]
            y = km.geometry.observe(seen, WORLD[near])[0] + rng.normal(size=(len(near), 2)) * [0.1, 0.02]
            events.append(
                km.Scan(t * 0.1 + after, "r", "lidar", np.column_stack([np.abs(y[:, 0]), y[:, 1]]), near.tolist())
            )
        truth = km.geometry.compose(truth, arc(u, 0.1))[0]
    return events, seen


def arc(u: np.ndarray, dt: float) -> np.ndarray:
    """Return the pose to which speed and turn rate lead in `dt` s."""
    a = u[1] * dt
    return np.array([u[0] / u[1] * np.sin(a), u[0] / u[1] * (1 - np.cos(a)), a])


def run(slam: km.Slam, events: list[Any]) -> km.Slam:
    """Process events and return the Slam."""
    for event in events:
        slam.process(event)
    return slam


def test_a_bias_is_found_and_its_sigma_says_how_well() -> None:
    nees, sigmas = [], []
    for seed in range(20):
        bias = np.random.default_rng(seed).normal(size=2) * [*PRIOR.values()]
        events, _ = drive(300, seed, bias)
        slam = run(slam_of(PRIOR), events)
        e, P = slam.mean("r bias") - bias, slam.covariance("r bias")
        nees.append(float(e @ np.linalg.solve(P, e)))
        sigmas.append(np.sqrt(np.diag(P)))
    assert 1.0 < np.mean(nees) < 3.2, "2 is consistent; 99.7 % of means of 20 are within"
    assert (np.mean(sigmas, axis=0) < [0.02, 0.006]).all(), "it is found to a fifth of what was known before"


def test_a_robot_with_a_bias_is_tracked_consistently_only_if_the_bias_is_in_the_map() -> None:
    nees: dict[bool, list[float]] = {True: [], False: []}
    for seed in range(12):
        events, truth = drive(200, seed, BIAS)
        for known in (True, False):
            slam = run(slam_of(PRIOR if known else {}), events)
            e = slam.mean("r") - truth
            nees[known].append(float(e @ np.linalg.solve(slam.covariance("r"), e)))
    assert np.mean(nees[True]) < 6.0, "3 is consistent"
    assert np.mean(nees[False]) > 2 * np.mean(nees[True])


INCREMENTS = {
    "sigma_scale": 0.05,
    "sigma_turn_scale": 0.05,
    "sigma_turn_bias_radps": 0.02,
    "sigma_turn_rad_per_m": 0.02,
}
CALIBRATING = [
    km.motion.Unicycle(
        sigma_v_bias_mps=1, sigma_w_bias_radps=1, sigma_v_scale=1, sigma_w_scale=1, sigma_turn_rad_per_m=1
    ),
    km.motion.Ackermann(sigma_v_bias_mps=1, sigma_steering_bias_rad=1, sigma_v_scale=1, sigma_steering_scale=1),
    km.motion.Odometry2D(**dict.fromkeys(INCREMENTS, 1.0)),
    km.motion.Odometry3D(sigma_scale=1, sigma_turn_scale=1, sigma_turn_bias_radps=1),
    km.motion.Velocity3D(sigma_v_bias_mps=1, sigma_w_bias_radps=1, sigma_v_scale=1, sigma_w_scale=1),
]


@pytest.mark.parametrize("motion", CALIBRATING, ids=lambda m: type(m).__name__)
def test_constants_of_a_control_change_it_as_they_are_named(motion: Any) -> None:
    u, dt = np.random.default_rng(2).uniform(0.5, 1.0, len(motion.columns)), 0.2
    B, names = motion.calibration_effect(u, dt), motion.calibration
    assert B.shape == (len(u), len(names)) == (len(u), len(motion.calibration_cov))
    for column, name in zip(B.T, names, strict=True):
        changed = np.flatnonzero(column)
        turns = [j for j, of in enumerate(motion.columns) if of.endswith(("_rad", "_radps"))]
        if name in ("scale", "v_scale"):
            assert [*changed] == [j for j in range(len(u)) if j not in turns]
            np.testing.assert_allclose(column[changed], u[changed])
        elif name in ("turn_scale", "w_scale", "steering_scale"):
            assert [*changed] == turns
            np.testing.assert_allclose(column[changed], u[changed])
        elif name == "turn_rad_per_m":
            way = np.linalg.norm(np.delete(u, turns))
            assert column[turns] == pytest.approx(way)
        else:
            assert len(changed) == 1
            assert column[changed] == pytest.approx(1.0 if motion.held else dt)


def test_increments_calibrate_themselves_consistently() -> None:
    nees = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        constants, truth, events = rng.normal(size=4) * [*INCREMENTS.values()], np.array(START), []
        motion, noise = km.motion.Odometry2D(0.01, 0.0, 0.005, **INCREMENTS), np.array([0.01, 0.0, 0.005])
        for t in range(1, 400):
            u = np.array([0.1, 0.0, 0.05 * np.sin(t / 20)]) if t % 50 > 10 else np.array([0.0, 0.0, 0.1])
            truth = km.geometry.compose(truth, u)[0]
            told = u
            for _ in range(5):  # until u = told + B(told) constants
                told = u - motion.calibration_effect(told, 0.1) @ constants
            events.append(km.Control(t * 0.1, "r", told + rng.normal(size=3) * noise))
            near = np.flatnonzero(np.hypot(*(WORLD - truth[:2]).T) < 5.0)[:6]
            y = km.geometry.observe(truth, WORLD[near])[0] + rng.normal(size=(len(near), 2)) * [0.05, 0.01]
            events.append(km.Scan(t * 0.1, "r", "lidar", np.abs(y) * [1, 0] + y * [0, 1], near.tolist()))
        lidar = km.Mount(km.sensors.RangeBearing(0.05, 0.01))
        slam = run(km.Slam([km.Robot("r", motion, START, {"lidar": lidar})], km.association.ByIdentity("off")), events)
        e, P = slam.mean("r bias") - constants, slam.covariance("r bias")
        nees.append(float(e @ np.linalg.solve(P, e)))
    assert 2.5 < np.mean(nees) < 6.0, "4 is consistent; 99.7 % of means of 20 are within 2.3 and 6.1"
    assert (np.sqrt(np.diag(P)) < 0.5 * np.array([*INCREMENTS.values()])).all()


def test_a_bias_stays_right_in_a_postponed_map() -> None:
    events, _ = drive(300, 3, BIAS)
    dense, postponed = (
        slam_of(PRIOR, estimator=EKF, map="dense"),
        slam_of(PRIOR, estimator=EKF),
    )
    postponed.state.map = CompressedMap.from_dense(postponed.map, most=40)
    for slam in (dense, postponed):
        run(slam, events)
    np.testing.assert_allclose(postponed.mean("r bias"), dense.mean("r bias"), atol=1e-9)
    P = dense.covariance("r", "r bias", 0)
    np.testing.assert_allclose(postponed.covariance("r", "r bias", 0), P, atol=1e-9)


def test_a_robot_of_space_finds_the_bias_of_its_velocity() -> None:
    rng, motion = (
        np.random.default_rng(5),
        km.motion.Velocity3D(*6 * [0.02], sigma_v_bias_mps=0.1, sigma_w_bias_radps=0.05),
    )
    bias = np.array([0.1, -0.05, 0.08, 0.02, -0.03, 0.04])
    world = rng.uniform(-6, 6, (40, 3))
    robot = km.Robot("r", motion, sensors={"lidar": km.Mount(km.sensors.Position3D(0.05))})
    slam, truth = km.Slam([robot], km.association.ByIdentity("off")), np.array([0.0, 0, 0, 0, 0, 0, 1])
    u = np.array([0.5, 0, 0, 0, 0, 0.3])
    for t in range(300):
        slam.process(km.Control(t * 0.1, "r", u - bias + rng.normal(size=6) * 0.02))
        truth = motion.move(truth, u, 0.1)[0]
        v = km.landmarks.Point3D().seen_from(truth, world[:20])[0]
        slam.process(km.Scan((t + 1) * 0.1, "r", "lidar", v + rng.normal(size=v.shape) * 0.05, range(20)))
    e, P = slam.mean("r bias") - bias, slam.covariance("r bias")
    assert e @ np.linalg.solve(P, e) < 22.5, "99.9 % of 6"
    assert np.sqrt(np.diag(P)).max() < 0.02


def test_a_map_with_a_bias_resumes_bit_for_bit(tmp_path: Path) -> None:
    events, _ = drive(60, 2, BIAS)
    slam = run(slam_of(PRIOR), events[:100])
    slam.save(tmp_path / "map.kmk")
    again = km.Slam.load(tmp_path / "map.kmk")
    for each in (slam, again):
        run(each, events[100:])
    names = ("r", "r bias", *slam.landmarks().ids)
    assert np.array_equal(slam.covariance(*names), again.covariance(*names))
    assert all(np.array_equal(slam.mean(name), again.mean(name)) for name in names)


def test_what_was_found_is_in_the_summary_of_a_run_and_of_one_that_is_read_again(tmp_path: Path) -> None:
    events, _ = drive(60, 2, BIAS)
    recorded = km.record(slam_of(PRIOR), events, progress=False, pictures=False)
    told = recorded.evaluate()["biases"]["r"]
    assert told["v_mps"] == pytest.approx(recorded.slam.mean("r bias")[0])
    assert 0 < told["sigma_w_radps"] < PRIOR["sigma_w_bias_radps"]
    recorded.save(tmp_path)
    assert km.Run.load(tmp_path).evaluate()["biases"]["r"] == pytest.approx(told)


def test_of_wheels_the_summary_has_radii_and_track_not_by_what_they_are_off() -> None:
    simulated = simulation(load_world("differential_drive", ["steps=100"]), 1)
    run = record(
        build_slam(load_world("differential_drive").config(), simulated.log),
        simulated.log,
        progress=False,
        pictures=False,
    )
    told, stated = run.evaluate()["biases"]["rover"], {"left_radius_m": 0.1, "right_radius_m": 0.1, "track_m": 0.5}
    for (name, value), off in zip(stated.items(), simulated.constants["rover"], strict=True):
        assert abs(told[name] - (value + off)) < 4.0 * told[f"sigma_{name}"] < 0.5 * value


def test_a_bias_cannot_be_removed() -> None:
    with pytest.raises(km.KalmarkError, match="a control's bias, expected a landmark"):
        slam_of(PRIOR).remove("r bias")


def test_bearings_tell_a_robot_that_stands_from_one_that_its_odometry_lets_creep() -> None:
    """Standing, the odometry creeps eight of its sigmas; the landmarks seen by bearings alone stay where they are."""
    rng, world = np.random.default_rng(0), np.array([[2.0, 3.0], [4.0, -2.0], [6.0, 1.0], [1.0, -4.0], [-3.0, 2.0]])
    motion = km.motion.Unicycle(0.05, 0.02, sigma_v_bias_mps=0.05, sigma_w_bias_radps=0.02)
    robot = km.Robot("r", motion, sensors={"camera": km.Mount(km.sensors.Bearing(0.02))})
    slam, truth = km.Slam([robot], km.association.ByIdentity("off")), np.zeros(3)
    for t in range(900):
        u = np.array([0.0, 0.0]) if t < 600 else np.array([0.4, 0.3])
        slam.process(km.Control(t * 0.1, "r", u - [0.02, 0.0] + rng.normal(size=2) * [0.005, 0.005]))
        truth = truth if t < 600 else km.geometry.compose(truth, arc(u, 0.1))[0]
        y = km.geometry.observe(truth, world)[0][:, 1:] + rng.normal(size=(5, 1)) * 0.02
        slam.process(km.Scan((t + 1) * 0.1, "r", "camera", y, range(5)))
        if t == 599:
            assert np.linalg.norm(slam.mean("r")[:2]) < 0.2, "it would have crept 1.2 m"
    assert np.linalg.norm(slam.mean("r")[:2] - truth[:2]) < 0.3


def test_lost_in_the_woods_by_bearings_alone_keeps_its_scale(data: Callable[[str], Path]) -> None:
    data("lost_in_the_woods")
    config = load_config("lost_in_the_woods_bearing")
    log = open_config_log(config)
    summary = record(build_slam(config, log), log, progress=False, pictures=False).evaluate()
    assert summary["robots"]["robot"]["ate_m"] < 0.132, "twice the error with ranges"
    assert summary["landmarks"] == 17
    assert summary["mounts"]["robot.laser"]["theta_rad"] == pytest.approx(0.082, abs=0.002), "as with ranges"
