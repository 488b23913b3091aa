"""The linearity of observations over the uncertainty of a pose: sigma points, arcs, and what bends."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import kalmark as km
from kalmark.tracks.channel import ObservationModel
from kalmark.tracks.linearity import SIGMAS, bends, sigma_point_steps, turn_holds, turn_pose

POINT, ORIGIN = km.landmarks.Point2D(), np.zeros(3)


def test_turns_hold_up_to_a_sigma_of_half_a_radian_about_any_axis() -> None:
    assert turn_holds(np.diag([9.0, 9.0, 0.25])) and not turn_holds(np.diag([0.0, 0.0, 0.2501]))
    assert turn_holds(np.diag([9.0, 9.0, 9.0, 0.25, 0.25, 0.25]))
    for k in (3, 4, 5):
        assert not turn_holds(np.diag(0.2501 * np.eye(6)[k]))


def test_the_squares_of_sigma_points_add_up_to_the_covariance() -> None:
    A = np.random.default_rng(0).normal(size=(3, 3))
    P = 0.05 * A @ A.T
    (steps,) = sigma_point_steps(P[None])
    np.testing.assert_allclose(steps.T @ steps, SIGMAS**2 * P, atol=1e-12)
    assert (steps[1:, 2] == 0.0).all(), "only the first one turns"


def test_a_heading_that_is_unknown_is_looked_at_half_a_turn_away() -> None:
    (steps,) = sigma_point_steps(np.diag([4.0, 1.0, 2.0**2])[None])
    assert steps[0].tolist() == [0.0, 0.0, np.pi]
    np.testing.assert_allclose(np.abs(steps[1:]), [[0.0, 2.0, 0.0], [4.0, 0.0, 0.0]], atol=1e-12)


def test_a_step_that_turns_follows_its_arc() -> None:
    np.testing.assert_allclose(
        turn_pose(ORIGIN, np.array([np.pi / 2, 0.0, np.pi / 2])), [1.0, 1.0, np.pi / 2], atol=1e-12
    )
    np.testing.assert_allclose(turn_pose(ORIGIN, np.array([2.0, 1.0, 0.0])), [2.0, 1.0, 0.0])
    about = turn_pose(np.array([5.0, 1.0, 3.0]), np.array([0.0, 0.0, 1.0]))
    np.testing.assert_allclose(about, [5.0, 1.0, 4.0 - 2 * np.pi])


@pytest.mark.parametrize(
    ("sensor", "at_m", "sigma_theta", "bent"),
    [
        (km.sensors.Range(0.1), 0.0, 3.0, [False, False, False]),  # at the middle of the robot it needs no heading
        (km.sensors.Range(0.1), 2.0, 3.0, [True, False, False]),
        (km.sensors.Position2D(0.1), 0.0, 0.05, [False, False, False]),  # off by 10 m (1 - cos .1) = half a sigma
        (km.sensors.Position2D(0.1), 0.0, 1.0, [True, False, False]),
    ],
    ids=["range", "range on an arm", "position", "position, heading unknown"],
)
def test_an_observation_bends_along_the_axes_that_it_is_not_linear_in(
    sensor: Any, at_m: float, sigma_theta: float, bent: list[bool]
) -> None:
    model = ObservationModel(POINT, sensor, np.array([at_m, 0.0, 0.0])).exactly
    l = np.array([[10.0, 3.0]])
    v = POINT.seen_from(np.array([at_m, 0.0, 0.0]), l)[0]
    y = np.concatenate([sensor.expect(v)[0], l], axis=1)
    P, R = np.diag([1e-4, 1e-4, sigma_theta**2]), sensor.noise(sensor.expect(v)[0])
    assert bends(model.model, ORIGIN[None], P[None], y, R).tolist() == [bent]


def test_a_range_bends_over_a_position_that_is_known_worse_than_the_landmark_is_far() -> None:
    model, l = ObservationModel(POINT, km.sensors.Range(0.1), ORIGIN).exactly, np.array([[1.0, 0.0]])
    y = np.array([[1.0, *l[0]]])
    for sigma_m, bent in ((0.1, False), (2.0, True)):
        P = np.diag([sigma_m**2, sigma_m**2, 1e-6])
        assert bends(model.model, ORIGIN[None], P[None], y, 0.01 * np.ones((1, 1, 1)))[0, 1:].any() == bent
