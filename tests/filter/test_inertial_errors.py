"""An inertial unit whose heading is found: what it knows of itself turns with it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

import kalmark as km

RATE_S, FOUND_RAD = 0.01, 1.0


def rested(motion: Any, yaw_rad: float, sigma_rad: float, kind: str) -> km.Slam:
    """Return a unit that started at rest with such a heading, moved for 2 s and read a compass at its end."""
    start, cov = np.zeros(motion.space.size), np.zeros((motion.space.dof, motion.space.dof))
    start[5], start[6] = math.sin(yaw_rad / 2), math.cos(yaw_rad / 2)
    cov[5, 5], cov[9:15, 9:15] = sigma_rad**2, 1e-4 * np.eye(6)
    still = np.tile([0.001, 0.002, -0.001, 0.01, -0.02, 9.81], (500, 1))
    rest = km.motion.start_at_rest(motion, RATE_S * np.arange(500), still, start, cov)
    compass = km.Mount(km.sensors.Heading(sigma_heading_rad=1e-3))
    slam = km.Slam(km.Robot("unit", motion, rest.start, cov=rest.cov, sensors={"compass": compass}), map=kind)
    for i in range(200):
        slam.process(km.Control(t_s=RATE_S * i, robot="unit", u=[0.001, 0.002, -0.001, 1.01, -0.02, 9.81]))
    slam.process(km.Scan(t_s=2.0, robot="unit", sensor="compass", y=[[FOUND_RAD]]))
    return slam


@pytest.mark.parametrize("kind", ["dense", "postponed"])
@pytest.mark.parametrize("motion", [km.motion.Inertial(), km.motion.InertialGravity()], ids=["known", "in the state"])
def test_a_heading_found_late_leaves_what_one_found_before_does(motion: Any, kind: str) -> None:
    """Tilt, velocity and gravity are correlated with biases in the body, so that these correlations turn by 1 rad."""
    late, early = rested(motion, 0.0, 1.0, kind), rested(motion, FOUND_RAD, 0.01, "dense")
    own = [k for k in range(motion.space.dof) if k not in (0, 1, 2, 5)]  # but position and heading
    P, expected = (slam.covariance("unit")[np.ix_(own, own)] for slam in (late, early))
    sigma = np.sqrt(np.diag(expected))
    np.testing.assert_allclose((P - expected) / np.outer(sigma, sigma), 0, atol=0.02)
