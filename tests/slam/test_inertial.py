"""Whole runs of an inertial unit: gauges, consistency, every kind of sensor with it, files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2

import kalmark as km
from kalmark.campaign.scoring import score
from kalmark.config.building import build_slam
from kalmark.events import Control, Scan
from kalmark.geometry.rotations import exp, matrix
from kalmark.logs import open_log, write_native
from kalmark.simulate import load_world, simulate
from kalmark.simulate.robots import simulation

SHIFT, VERTICAL, ANY = np.array([30.0, -20.0, 5.0]), np.array([0.0, 0.0, 1.9]), np.array([0.7, -1.1, 0.4])
DRONE = "robots.drone."
GRAVITY = (
    f"{DRONE}motion={{type: inertial_gravity}}", f"{DRONE}start.gravity_z_mps2=-9.81",
    f"{DRONE}start.sigma_gravity_mps2=0.1", f"{DRONE}start.sigma_rotation_deg=1.0",
)  # fmt: skip
RADAR = f"{DRONE}sensors.stereo={{type: range_bearing_3d, sigma_range_m: 0.05, sigma_azimuth_rad: 0.005, sigma_elevation_rad: 0.005}}"


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
        ((f"{DRONE}sensors.stereo={{type: pinhole, mount: {{roll_deg: -90, yaw_deg: -90}}}}", "filter.landmarks.type=anchored_homogeneous"), 15),
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
