"""The iterated correction where whole steps do not settle: bearings of near things, seen from steps as long."""

from __future__ import annotations

import math

import numpy as np
import pytest

import kalmark as km
from kalmark.filter.observed_block import cost_of, least_squares

SIGMAS, BEARING = (0.045, 0.045, 0.014), 0.004
AREA_M, NEAR_M = 12.0, (0.2, 5.0)


def position_error_m(seed: int) -> float:
    """Return the RMS error of a robot that steps a metre, or turns by 90 deg, among things of which it sees bearings.

    Each is within 5 m, some within .5 m: the bearing of a thing changes by up to 180 deg in a step.
    """
    rng = np.random.default_rng(seed)
    things, pose, off = rng.uniform(-AREA_M, AREA_M, (142, 2)), np.zeros(3), []
    eye = km.Mount(km.sensors.Bearing(BEARING))
    slam = km.Slam(km.Robot("bot", km.motion.Odometry2D(*SIGMAS), sensors={"eye": eye}))
    for k in range(101):
        if k:
            ahead = np.abs(km.geometry.compose(pose, np.array([1.0, 0.0, 0.0]))[0][:2]).max()
            turns = rng.random() < 0.25 or ahead > 7.0
            u = np.array([0.0, 0.0, rng.choice([-0.5, 0.5]) * math.pi]) if turns else np.array([1.0, 0.0, 0.0])
            pose = km.geometry.compose(pose, u)[0]
            slam.process(km.Control(float(k), "bot", u + rng.normal(size=3) * SIGMAS))
        r, bearing = km.geometry.observe(pose, things)[0].T
        seen = np.flatnonzero((r > NEAR_M[0]) & (r < NEAR_M[1]) & (np.abs(bearing) < 0.5 * math.pi))
        y = bearing[seen, None] + rng.normal(size=(len(seen), 1)) * BEARING
        slam.process(km.Scan(float(k), "bot", "eye", y, seen.tolist()))
        off.append(np.linalg.norm(slam.mean("bot")[:2] - pose[:2]))
    return float(np.sqrt(np.mean(np.square(off))))


def test_bearings_of_near_things_lead_a_robot_of_long_steps_in_nine_of_ten_worlds() -> None:
    assert sum(position_error_m(seed) < 0.5 for seed in range(10)) >= 9


def test_the_cost_of_a_step_is_that_of_the_scan_and_of_the_prior() -> None:
    rng = np.random.default_rng(0)
    A, H, R = rng.normal(size=(4, 4)), rng.normal(size=(4, 4)), np.tile(0.3 * np.eye(2), (2, 1, 1))
    P, v = A @ A.T, rng.normal(size=4)
    Z = H @ P @ H.T + 0.3 * np.eye(4)
    step, weights = least_squares(H @ P, H, np.linalg.inv(np.linalg.cholesky(Z)), v)
    np.testing.assert_allclose(step, P @ H.T @ np.linalg.solve(Z, v))
    left = (v - H @ step).reshape(2, 2)
    least = cost_of(left, R, step, weights)
    assert least == pytest.approx(np.sum(left**2) / 0.3 + step @ np.linalg.solve(P, step))
    assert least == pytest.approx(v @ np.linalg.solve(Z, v)), "of a linear problem it is d2"
