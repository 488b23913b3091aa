"""Homogeneous points of unknown depth, seen again after a motion with noise."""

from __future__ import annotations

import numpy as np

import kalmark as km
from kalmark.filter.estimators import Movement
from kalmark.filter.map import StochasticMap
from kalmark.geometry.spaces import SE3
from kalmark.models.landmarks3d import homogeneous_seen_from
from kalmark.models.observe import step_of

RHO, SIGMA_RHO, SIGMA_M, STEPS = 0.1, 0.5, 0.05, 12
RAY = np.array([0.36, 0.48, 0.8])


def moved(estimator: km.estimators.Invariant | km.estimators.Ekf) -> StochasticMap:
    """Return a map of a robot that saw a point of this direction where it started, and has gone on since."""
    point, m = km.landmarks.Homogeneous(), StochasticMap()
    robot = m.add(SE3, np.array([0, 0, 0, 0, 0, 0, 1.0]))
    m.add(point.space, np.append(RAY, RHO), np.diag([0.0, 0.0, 0.0, SIGMA_RHO**2]))
    N, none = np.diag([SIGMA_M**2] * 3 + [0.0] * 3), np.zeros((0, 0))
    model, u = step_of(km.motion.Odometry3D()), np.array([0.1, 0, 0, 0, 0, 0])
    for _ in range(STEPS):
        assert estimator.predict(m, Movement(model, robot, (), False, False, np.zeros((6, 0)), u, N, none, 1.0))
    return m


def ray_covariance(m: StochasticMap) -> np.ndarray:
    """Return the covariance (3, 3) of the ray to the point from the robot."""
    _, V_T, V_l = homogeneous_seen_from(m.mean(0), m.mean(1)[None])
    J = np.hstack([V_T[0], V_l[0]])
    return J @ m.covariance([0, 1]) @ J.T


def test_the_ray_to_a_point_of_unknown_depth_is_as_uncertain_as_noise_and_depth_together_make_it() -> None:
    rng = np.random.default_rng(0)
    rho = rng.normal(RHO, SIGMA_RHO, 400_000)
    way = np.array([0.1 * STEPS, 0, 0]) + np.sqrt(STEPS) * SIGMA_M * rng.normal(size=(len(rho), 3))
    sampled = np.cov((RAY - rho[:, None] * way).T)
    assert np.allclose(ray_covariance(moved(km.estimators.Invariant())), sampled, rtol=0.01, atol=0.01 * sampled[1, 1])
    textbook = ray_covariance(moved(km.estimators.Ekf()))[1, 1]
    assert textbook < 0.05 * sampled[1, 1], "the textbook has the first order only"
