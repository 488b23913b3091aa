"""Whole runs of the shipped worlds of one motion each: gauges, constants in the map, files, steering, refusals."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import kalmark as km
from kalmark.campaign.scoring import score
from kalmark.config.building import build_slam
from kalmark.errors import ConfigError, KalmarkError
from kalmark.geometry import rotation, wrap
from kalmark.logs import open_log, write_native
from kalmark.simulate import load_world, simulate
from kalmark.simulate.robots import simulation
from kalmark.slam.description import describe
from kalmark.slam.held_control import RateMean

CALIBRATED = ("differential_drive", "tricycle", "omnidirectional", "mecanum")
STATES = ("slipping_unicycle", "constant_velocity", "constant_turn_rate")
SHIFT, TURN = np.array([30.0, -20.0]), 1.9


def moved(x: np.ndarray) -> np.ndarray:
    """Return a state (size,) or a point (2,) shifted and turned; what is behind a pose stays as it is."""
    x = np.array(x)
    x[:2] = rotation(TURN) @ x[:2] + SHIFT
    if len(x) > 2:
        x[2] = wrap(x[2] + TURN)
    return x


@pytest.mark.parametrize("estimator", ["invariant", "fej", "ekf"])
@pytest.mark.parametrize("name", [*CALIBRATED, *STATES])
def test_a_run_that_is_shifted_and_turned_gives_the_same_estimate_shifted_and_turned(name: str, estimator: str) -> None:
    world = load_world(name, ["steps=60", f"filter.estimator.type={estimator}"])
    log = simulate(world, 1)
    here, there = build_slam(world.config(), log), build_slam(world.config(), log)
    slot = there.slot("rover")
    there.map.set_predicted(slot, moved(there.map.mean(slot)))
    for event in log:
        one, other = here.process(event), there.process(event)
        assert [seen.outcome for seen in one.observations] == [seen.outcome for seen in other.observations]
    assert len(here.landmarks().ids) > 3
    np.testing.assert_allclose(moved(here.mean("rover")), there.mean("rover"), atol=1e-7)
    for id_ in here.landmarks().ids:
        np.testing.assert_allclose(moved(here.mean(id_)), there.mean(id_), atol=1e-7)
    G = np.eye(len(here.covariance("rover")))
    G[:2, :2] = rotation(TURN)
    P = G @ here.covariance("rover") @ G.T
    np.testing.assert_allclose(P, there.covariance("rover"), atol=1e-7 * np.abs(P).max())


@pytest.mark.parametrize("name", ["constant_velocity", "constant_turn_rate"])
def test_a_robot_that_may_move_does_not_learn_its_heading_from_landmarks(name: str) -> None:
    """A rotation of the world is unobservable, with a velocity in the state, too."""
    world = load_world(name, ["steps=150", "robots.rover.start.sigma_theta_rad=0.35"])
    log = simulate(world, 2)
    slam = build_slam(world.config(), log)
    for event in log:
        slam.process(event)
    (heading,) = slam.covariance("rover")[2:3, 2]
    assert np.sqrt(heading) > 0.35, "what is not measured is not known better"


@pytest.mark.parametrize("name", CALIBRATED)
def test_the_constants_of_the_controls_are_found(name: str) -> None:
    world = load_world(name, ["steps=250"])
    values, before, after = [], 0.0, 0.0
    for seed in range(4):
        simulated = simulation(world, seed)
        slam = build_slam(world.config(), simulated.log)
        for event in simulated.log:
            slam.process(event)
        motion: Any = slam.robots["rover"].motion
        d, P = slam.mean("rover bias") - simulated.constants["rover"], slam.covariance("rover bias")
        values.append(float(d @ np.linalg.solve(P, d)) / len(d))
        before, after = np.linalg.det(motion.calibration_cov), np.linalg.det(P)
    assert np.mean(values) < 2.5, "1 is consistent"
    assert after < 0.1 * before


def test_constants_are_found_beside_a_gyroscope_that_shows_the_noise_of_the_wheels() -> None:
    """Errors in variables: of the measured turns alone the track would come out 30 of its sigmas too large."""
    world, values = load_world("wheels_and_gyro", ["steps=500"]), []
    for seed in range(3):
        simulated = simulation(world, seed)
        slam = build_slam(world.config(), simulated.log)
        for event in simulated.log:
            slam.process(event)
        d, P = slam.mean("rover bias") - simulated.constants["rover"], slam.covariance("rover bias")
        values.append(float(d @ np.linalg.solve(P, d)) / len(d))
    assert np.mean(values) < 2.5, "1 is consistent"


def test_the_mean_of_controls_follows_a_change_at_once_and_noise_slowly() -> None:
    rng, sigma = np.random.default_rng(0), np.array([0.1, 0.02])
    mean = RateMean(np.zeros(2), 1)
    for k in range(1, 200):
        mean = mean.after(sigma * rng.uniform(-1, 1, 2), sigma)
        assert mean.number == min(k + 1, 30)
    assert (np.abs(mean.rate) < 0.5 * sigma).all()
    assert mean.after(np.array([0.0, 0.1]), sigma) == (pytest.approx([0.0, 0.1]), 1)


@pytest.mark.parametrize("name", STATES)
def test_what_is_behind_the_pose_is_scored_too(name: str) -> None:
    world = load_world(name, ["steps=120"])
    simulated = simulation(world, 3)
    slam = build_slam(world.config(), simulated.log)
    series = score(slam, simulated, world.times()).series
    dof = slam.robots["rover"].motion.space.dof
    assert np.nanmax(series["state_dof"]) == dof
    assert 0.4 * dof < np.nanmean(series["state"]) < 1.8 * dof


@pytest.mark.parametrize("name", [*CALIBRATED, *STATES])
def test_a_run_is_written_read_and_resumed(name: str, tmp_path: Path) -> None:
    world = load_world(name, ["steps=30"])
    log = simulate(world, 4)
    write_native(log, tmp_path / "log")
    back = open_log(tmp_path / "log")
    robot = build_slam(world.config()).robots["rover"]
    header = (tmp_path / "log" / "controls.csv").read_text().splitlines()[0]
    assert header == ",".join(("t_s", "robot", *robot.motion.columns))
    run = km.record(build_slam(world.config(), back), back, progress=False, pictures=False)
    assert run.evaluate()["robots"]["rover"]["ate_m"] < 0.3
    run.save(tmp_path / "run")
    again = km.Run.load(tmp_path / "run")
    assert again.evaluate()["robots"] == run.evaluate()["robots"]
    slam, events = build_slam(world.config(), back), [*back]
    for event in events[:40]:
        slam.process(event)
    slam.save(tmp_path / "map.kmk")
    resumed = km.Slam.load(tmp_path / "map.kmk")
    for event in events[40:]:
        slam.process(event)
        resumed.process(event)
    np.testing.assert_array_equal(slam.mean("rover"), resumed.mean("rover"))
    np.testing.assert_array_equal(slam.covariance("rover"), resumed.covariance("rover"))


@pytest.mark.parametrize("kind", [*CALIBRATED, *STATES])
def test_every_motion_of_the_plane_is_steered_through_the_same_places(kind: str) -> None:
    points = "[[10, 5], [10, 10], [5, 10]]"
    route = f"robots.rover.route={{type: waypoints, points_m: {points}, speed_mps: 1.0, turn_radius_m: 0.5}}"
    start = "robots.rover.start={x_m: 5, y_m: 5}"
    path = simulate(load_world(kind, [route, start, "steps=300", "dt_s=0.1"]), 1).truth["rover"].poses
    for point in ((10, 5), (10, 10), (5, 10)):
        assert np.linalg.norm(path[:, :2] - point, axis=1).min() < 1.1


def test_a_postponed_map_moves_a_robot_with_constants_as_a_dense_one_does() -> None:
    for name in ("differential_drive", "constant_velocity"):
        world = load_world(name, ["steps=120", "filter.estimator.type=ekf"])
        log = simulate(world, 6)
        other = load_world(name, ["steps=120", "filter.estimator.type=ekf", "filter.map.type=postponed"])
        dense, postponed = build_slam(world.config(), log), build_slam(other.config(), log)
        for event in log:
            dense.process(event)
            postponed.process(event)
        np.testing.assert_allclose(postponed.mean("rover"), dense.mean("rover"), atol=1e-8)
        np.testing.assert_allclose(postponed.covariance("rover"), dense.covariance("rover"), atol=1e-8)


def test_a_velocity_that_is_not_in_the_state_is_refused_in_a_start() -> None:
    for key, kind in (
        ("vx_mps", "mecanum"),
        ("sigma_v_mps", "tricycle"),
        ("slip", "constant_velocity"),
        ("vy_mps", "constant_turn_rate"),
    ):
        with pytest.raises(ConfigError, match=f"start.{key}: got 0.5, expected 0: {kind} has no .* in its state"):
            load_world(kind, [f"robots.rover.start={{{key}: 0.5}}"])


def test_a_start_is_described_as_it_was_given() -> None:
    for name in STATES:
        slam = build_slam(load_world(name).config())
        start = load_world(name).robots["rover"].start.model_dump(exclude_defaults=True)
        told = describe(slam)["robots"]["rover"]["start"]
        assert {key: told[key] for key in start} == pytest.approx(start)


def test_a_scan_between_two_controls_of_a_robot_at_constant_velocity_changes_nothing_else() -> None:
    motion = km.motion.ConstantVelocity(0.0, 0.0, 0.2, 0.1, 0.1)
    start = (0.0, 0.0, 0.3, 0.8, 0.1, 0.4)
    whole, split = (
        km.Slam([km.Robot("r", motion, start, {"l": km.Mount(km.sensors.RangeBearing())})]) for _ in range(2)
    )
    for slam, times in ((whole, (0.0, 2.0)), (split, (0.0, 0.3, 0.9, 1.7, 2.0))):
        for t in times:
            slam.process(km.Scan(t, "r", "l", np.zeros((0, 2))))
    np.testing.assert_allclose(split.mean("r"), whole.mean("r"), atol=1e-12)
    P = whole.covariance("r")
    np.testing.assert_allclose(split.covariance("r"), P, rtol=1e-6, atol=1e-9 * P.max())


def test_a_control_of_the_wrong_length_is_refused_and_nothing_changes() -> None:
    slam = km.Slam([km.Robot("r", km.motion.DifferentialDrive())])
    with pytest.raises(KalmarkError, match=r"u has shape \(3,\), expected \(left_rad, right_rad\)"):
        slam.process(km.Control(0.0, "r", (0.1, 0.1, 0.1)))
    assert slam.t_ns is None
    assert replace(slam.robots["r"].motion, track_m=0.4).track_m == 0.4  # type: ignore[type-var]
