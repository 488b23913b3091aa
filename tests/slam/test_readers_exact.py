"""Wheels, a gyroscope and an antenna, with hardly any noise: the filter against the Kalman filter of their errors."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

import kalmark as km
from kalmark.config.building import build_slam
from kalmark.simulate import load_world, simulate
from kalmark.slam.held_control import bias_name

SMALL, STEPS, DT_S = 1e-3, 150, 0.1


def small(tree: dict[str, Any], path: str) -> Iterator[str]:
    """Yield the overrides that make all sigmas small, so that what is of second order is smaller still."""
    for key, value in tree.items():
        if isinstance(value, dict):
            yield from small(value, f"{path}.{key}")
        elif key.startswith("sigma_"):
            yield f"{path}.{key}={SMALL * value!r}"


def corrected(P: np.ndarray, H: np.ndarray, R: np.ndarray) -> np.ndarray:
    """Return the covariance after a correction, [S] (28)-(30)."""
    return P - P @ H.T @ np.linalg.solve(H @ P @ H.T + R, H @ P)


def test_covariances_are_those_of_a_kalman_filter_of_pose_wheels_gyroscope_and_antenna() -> None:
    robots = load_world("wheels_and_gyro").model_dump(exclude_none=True)["robots"]
    world = load_world("wheels_and_gyro", [f"steps={STEPS}", *small(robots, "robots")])
    log = simulate(world, 1)
    slam = build_slam(world.config(), log)
    rover, truth = slam.robots["rover"], log.truth["rover"]
    motion: Any = rover.motion
    gyro, receiver = (rover.sensors[name] for name in ("gyro", "receiver"))
    arm = np.array(receiver.at[:2])
    e = np.zeros((9, 9))  # errors of pose, radii and track, bias, lever arm
    e[:3, :3], e[3:6, 3:6] = rover.cov, motion.calibration_cov
    e[6:7, 6:7], e[7:, 7:] = gyro.sensor.parameter_cov, receiver.cov[:2, :2]
    both = np.zeros((10, 10))  # and the heading before
    for event in log:
        report = slam.process(event)
        if isinstance(event, km.Control):
            before = truth.at(np.array([event.t_ns - round(DT_S * 1e9)]))[0]
            moved, F_r, F_u = motion.move(before, event.u, DT_S)
            turn = np.eye(3)
            turn[:2, :2] = [[np.cos(moved[2]), -np.sin(moved[2])], [np.sin(moved[2]), np.cos(moved[2])]]
            F = np.vstack([np.eye(9), np.eye(9)[2]])
            F[:3, :3], F[:3, 3:6] = F_r, F_u @ motion.calibrated(event.u, np.zeros(3), DT_S)[1]
            both = F @ e @ F.T
            both[:3, :3] += F_u @ motion.control_noise(event.u) @ F_u.T
            both[:3, :3] += turn @ motion.diffusion(event.u, DT_S) @ turn.T
            e = both[:9, :9]
        elif report.observations[0].outcome == "ignored":  # the first reading: none to count from
            continue
        elif event.sensor == "gyro":  # the mean rate since the last reading
            H = np.zeros((1, 10))
            H[0, [2, 9, 6]] = 1 / DT_S, -1 / DT_S, 1.0
            e = corrected(both, H, gyro.sensor.noise(event.y)[0])[:9, :9]
        else:
            c, s = np.cos(moved[2]), np.sin(moved[2])
            H = np.zeros((2, 9))
            H[:, :2], H[:, 7:] = np.eye(2), [[c, -s], [s, c]]
            H[:, 2] = [-s * arm[0] - c * arm[1], c * arm[0] - s * arm[1]]
            e = corrected(e, H, receiver.sensor.noise(event.y)[0])
    kept = [slam.covariance("rover"), slam.covariance(bias_name("rover")), slam.covariance("rover.gyro")[-1:, -1:]]
    for P, at in zip([*kept, slam.covariance("rover.receiver")[:2, :2]], (0, 3, 6, 7), strict=True):
        n = len(P)
        share = np.linalg.solve(e[at : at + n, at : at + n], P)
        assert np.allclose(share, np.eye(n), atol=1e-3), (at, share)
