"""Campaigns in space: how errors are judged, and filters that are as sure as they should be."""

from __future__ import annotations

import math

import numpy as np
import pytest

from kalmark.campaign import run_campaign, scoring
from kalmark.campaign.running import Plan, configs_of
from kalmark.geometry import SE3
from kalmark.geometry.rotations import exp
from kalmark.geometry.spaces import RHO, VECTOR3, Space, retract
from kalmark.simulate import load_world
from space_worlds import faulty, world


@pytest.mark.parametrize("coordinates", ["log", "world"])
def test_an_error_is_what_the_estimator_would_have_to_correct_by(coordinates: str) -> None:
    rng = np.random.default_rng(5)
    for _ in range(50):
        mean, truth = (np.concatenate([rng.normal(size=3), exp(rng.normal(size=3))]) for _ in range(2))
        turn = rng.normal(size=3) * 0.5
        d = scoring.state_error(mean, truth, turn, coordinates)
        x = mean.copy()
        retract(SE3.atoms, x, d, turn if coordinates == "log" else np.zeros(0))
        np.testing.assert_allclose(SE3.minus(x, truth), 0, atol=1e-9)


def test_a_point_whose_depth_is_not_known_yet_is_not_judged() -> None:
    class Ray:
        kind = "ray"
        space = Space("ray", (VECTOR3, VECTOR3, RHO))

        def to_point(self, l: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            P_l = np.zeros((1, 3, 7))
            P_l[0, :, 6] = -l[0, 3:6] / l[0, 6] ** 2
            return l[:, :3] + l[:, 3:6] / l[:, 6:], P_l

        place = to_point

        def linearity(self, T: np.ndarray, l: np.ndarray, sigmas: np.ndarray) -> np.ndarray:
            raise NotImplementedError

    l = np.array([0, 0, 0, 1.0, 0, 0, 0.2])  # five metres ahead
    for sigma, known in ((0.01, True), (0.1, False)):
        P = np.diag([0, 0, 0, 0, 0, 0, sigma**2])
        judged = scoring.judge_landmark(Ray(), l, P, np.array([5.5, 0, 0]), np.zeros(3), "world", np.zeros(3))
        assert (judged is not None) == known
        if judged is not None:
            np.testing.assert_allclose(judged.own, [0.5, 0, 0])


def test_a_line_is_judged_across_itself_where_its_ends_are() -> None:
    class Line:
        kind = "line"
        space = Space("line", (VECTOR3, VECTOR3))
        first_ends = (0.0, 1.0)
        extend = True

        def abscissas(self, T: np.ndarray, l: np.ndarray, rays: np.ndarray) -> np.ndarray:
            raise NotImplementedError

        def endpoints(self, l: np.ndarray, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            a, b = l[:, None, :3], l[:, None, 3:]
            P_l = np.zeros((1, 2, 3, 6))
            for i in range(2):
                P_l[0, i, :, :3], P_l[0, i, :, 3:] = (1 - t[0, i]) * np.eye(3), t[0, i] * np.eye(3)
            return a + t[:, :, None] * (b - a), P_l

    l, P, eye = np.array([1.0, 0, 0, 2, 0, 0]), 1e-4 * np.eye(6), np.array([0.0, 2.0, 0.0])  # along x
    truth = np.array([-3.0, 0.1, 0.2, 4.0, 0.1, -0.2])
    judged = scoring.judge_landmark(Line(), l, P, truth, np.zeros(3), "log", eye)
    assert judged is not None and judged.own.shape == (4,) and judged.F.shape == (4, 6)
    np.testing.assert_allclose(np.linalg.norm(judged.own.reshape(2, 2), axis=1), [math.hypot(0.1, 0.2)] * 2)
    np.testing.assert_allclose(judged.truth - judged.place, [[0, 0.1, 0.2], [0, 0.1, -0.2]], atol=1e-12)
    assert scoring.judge_landmark(Line(), l, 0.1 * np.eye(6), truth, np.zeros(3), "log", eye) is None
    d = np.array([0.0, 0.01, -0.02, 0.0, 0.03, 0.01])
    moved = scoring.judge_landmark(Line(), l + d, P, truth, np.zeros(3), "log", eye)
    assert moved is not None
    lengths = [
        np.linalg.norm((judged.own - judged.F @ d).reshape(2, 2), axis=1),
        np.linalg.norm(moved.own.reshape(2, 2), axis=1),
    ]
    np.testing.assert_allclose(*lengths, atol=2e-3)


def test_in_space_the_invariant_filter_is_as_sure_as_it_should_be_and_the_textbook_surer() -> None:
    keys = {"motion": {"type": "odometry_3d", "sigma_rotation_rad": 0.03}, "start": {"sigma_position_m": 0.1}}
    campaign = run_campaign(
        world(steps=80, robot=keys), 40, ["invariant", "ekf"], seed=4, jobs=1, skip=10, progress=False
    )
    invariant, ekf = campaign.summary()["estimators"].values()
    assert campaign.summary()["dof"] == {"pose": 6, "heading": 3, "landmarks": 3, "joint": 1}
    assert invariant["pose_anees"] == pytest.approx(6.0, abs=0.9)
    assert invariant["pose_inside"] > 0.8
    assert invariant["joint_anees"] == pytest.approx(1.0, abs=0.07)
    assert invariant["landmarks_anees"] == pytest.approx(3.0, rel=0.35)
    assert invariant["nis_per_dof"] == pytest.approx(1.0, abs=0.05)
    assert ekf["joint_anees"] > 1.15 and ekf["joint_inside"] < 0.2
    assert campaign.label("heading") == "orientation (3)"


def test_withheld_ids_and_ghosts_are_scored_by_what_was_really_seen() -> None:
    w = world(steps=30, ids=False, robot=faulty(outliers=0.05))
    score = Plan(w, configs_of(w, None), 0, 10).run(0)["invariant"]
    assert score.landmarks >= 8
    assert np.isfinite(score.series["joint"][0, 29])
    assert score.landmark_rmse_raw_m < 2.0


def test_a_robot_of_constant_velocity_coasts_from_the_start_in_the_filter_too() -> None:
    start = {"vx_mps": 1.0, "wz_radps": 0.3}
    robot = {
        "motion": {"type": "constant_velocity_3d", "sigma_v_mps": 0.02, "sigma_w_radps": 0.01},
        "start": start,
        "route": {"type": "constant", "u": (0.0,) * 6},
    }
    campaign = run_campaign(world(robot=robot, steps=60), 30, ["invariant"], seed=2, jobs=1, skip=10, progress=False)
    f = campaign.summary()["estimators"]["invariant"]
    assert f["state_anees"] == pytest.approx(12.0, abs=1.5)
    assert f["pose_anees"] == pytest.approx(6.0, abs=1.0)
    assert f["joint_anees"] == pytest.approx(1.0, abs=0.1)


def test_a_camera_mount_finds_itself_in_a_world_of_two_robots() -> None:
    world_ = load_world("self_calibration", ["steps=250", "world.count=40"])
    f = run_campaign(world_, 3, ["invariant"], seed=1, jobs=1, progress=False).summary()["estimators"]["invariant"]
    assert f["mount_deg"] < 0.25 and f["mount_m"] < 0.02  # of 2.6 deg and 0.087 m
    assert f["mount_sure"] == 3


def test_a_mount_is_judged_by_what_of_it_is_not_known_exactly() -> None:
    """An antenna has no direction, and behind its place in the map is an error that lasts."""
    world_ = load_world("lever_arm", ["steps=200", "robots.robot.sensors.receiver.sigma_bias_m=0.3"])
    plan = Plan(world_, configs_of(world_, ["invariant"]), 0, 10)
    (scores,) = plan.run(0).values()
    assert scores.series["mount_dof"][0, -1] == 2
    assert 0.0 < scores.series["mount"][0, -1] < 11.8  # of two degrees of freedom, 99.73 %
    assert scores.series["joint_dof"][0, -1] == 3 + 2 + 2 * scores.landmarks
    assert np.isfinite(scores.series["joint"][0, -1])
