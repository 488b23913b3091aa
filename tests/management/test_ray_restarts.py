"""Rays are started again where their depth is not linear, and while a mount leaves open how far its camera went."""

from __future__ import annotations

import numpy as np
import pytest

import kalmark as km
from kalmark.geometry.rotations import exp, matrix, multiply
from kalmark.slam.starting import AGAIN

FORWARD = np.array([-0.5, 0.5, -0.5, 0.5])
POINTS = np.array([[6.0, -0.5, 0.4], [5.0, 1.0, -0.3], [7.0, 0.3, 0.8], [4.0, -1.0, 0.2]])
AHEAD, TURN = np.array([0.4, 0, 0, 0, 0, 0]), np.array([0.0, 0, 0, 0, 0, 0.3])
CAMERA = km.sensors.PinHole()


def slam_of(sigma_m: float) -> km.Slam:
    at, none = np.concatenate([[0.3, 0.0, 0.2], FORWARD]), sigma_m == 0.0
    cov = None if none else np.diag([sigma_m**2] * 3 + [0.01**2] * 3)
    mount = km.Mount(CAMERA, at=at, cov=cov, landmark=km.landmarks.AnchoredHomogeneous())
    return km.Slam([km.Robot("r", km.motion.Odometry3D(), (0, 0, 0, 0, 0, 0, 1), {"camera": mount})])


def seen_after(slam: km.Slam, u: np.ndarray) -> km.Report:
    """Return what becomes of a second scan after a step u of the robot."""
    pose = np.concatenate([u[:3], exp(u[3:])])
    for t, T in ((0, np.array([0.0, 0, 0, 0, 0, 0, 1])), (1, pose)):
        if t:
            slam.process(km.Control(t, "r", u))
        s = np.concatenate([T[:3] + matrix(T[3:]) @ [0.3, 0, 0.2], multiply(T[3:], FORWARD)])
        y = CAMERA.expect(np.array([matrix(s[3:]).T @ (p - s[:3]) for p in POINTS]))[0]
        report = slam.process(km.Scan(t, "r", "camera", y, range(len(y))))
    return report


@pytest.mark.parametrize(
    ("sigma_m", "step", "again"),
    [(0.05, TURN, True), (0.05, AHEAD, False), (0.0005, TURN, False), (0.0, TURN, False)],
    ids=["turn about the arm", "straight way", "mount nearly known", "mount known"],
)
def test_a_ray_whose_way_the_mount_leaves_open_is_started_again(sigma_m: float, step: np.ndarray, again: bool) -> None:
    slam, before = slam_of(sigma_m), slam_of(sigma_m)
    report = seen_after(slam, step)
    assert [o.outcome for o in report.observations] == ["new" if again else "associated"] * 4
    if again:
        assert {o.reason for o in report.observations} == {AGAIN}
        assert list(slam.landmarks().ids) == [0, 1, 2, 3], "under their own ids"
        camera = np.concatenate([step[:3], exp(step[3:])])
        place = camera[:3] + matrix(camera[3:]) @ [0.3, 0, 0.2]
        np.testing.assert_allclose(slam.landmarks().means[0][:3], place, atol=1e-9)  # anchored where the camera is now
        np.testing.assert_allclose(slam.covariance("r.camera"), before.covariance("r.camera"), atol=1e-12)


@pytest.mark.parametrize("lateral_m", [0.3, 0.5])
def test_a_depth_that_a_robot_driving_towards_a_landmark_cannot_know_stays_open(lateral_m: float) -> None:
    place, sigmas, worst = np.array([20.0, lateral_m]), np.array([0.01, 0.01, 0.002]), 0.0
    for seed in range(6):
        rng = np.random.default_rng(seed)
        eye = km.Mount(km.sensors.Bearing(0.02))
        slam = km.Slam(km.Robot("car", km.motion.Odometry2D(*sigmas), sensors={"eye": eye}))
        for k in range(70):
            if k:
                slam.process(km.Control(0.1 * k, "car", [0.2, 0.0, 0.0] + sigmas * rng.normal(size=3)))
            ahead = np.arctan2(lateral_m, 20.0 - 0.2 * k) + 0.02 * rng.normal()
            slam.process(km.Scan(0.1 * k, "car", "eye", [[ahead]], [7]))
        assert slam.landmark_model(7).kind == "inverse_depth_2d"
        ray, P = slam.mean(7), slam.covariance(7)
        off = ray[3] - 1.0 / np.linalg.norm(place - ray[:2])
        worst = max(worst, abs(off) / np.sqrt(P[3, 3]))
    assert worst < 3.0, "sigmas of the inverse depth"
