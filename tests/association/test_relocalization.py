"""Poses of points and of directions in closed form: by hand, against a search, and at the limits of one pose."""

from __future__ import annotations

import math

import numpy as np
import pytest

from kalmark.association.relocalization import SAME_M, SAME_RAD, align_points, is_same_pose, resect
from kalmark.geometry.rotations import from_euler, matrix

V2 = np.array([[1.0, 0.0], [0.0, 2.0], [-1.0, -1.0], [3.0, 1.0]])
V3 = np.array([[1.0, 0, 0], [0, 2, 0], [0, 0, 3], [-1, -1, 1], [2, 1, -2], [0.5, -1, 0.5]])
WEIGHTS = np.array([1.0, 4.0, 0.25, 9.0])


def turn(angle: float) -> np.ndarray:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s], [s, c]])


def cost(T: np.ndarray, v: np.ndarray, l: np.ndarray, weights: np.ndarray) -> float:
    """Return the weighted squares of l - T v, written out."""
    R = turn(T[2]) if len(T) == 3 else matrix(T[3:])
    return float(np.sum(weights * np.sum((l - T[: v.shape[1]] - v @ R.T) ** 2, axis=1)))


def test_two_points_that_were_turned_and_moved_give_that_pose() -> None:
    l = np.array([[5.0, 2.0], [3.0, 1.0]])  # (1, 0) and (0, 2) turned by 90 deg and moved by (5, 1)
    np.testing.assert_allclose(align_points(V2[:2], l, np.ones(2)), [5.0, 1.0, 0.5 * math.pi], atol=1e-12)


def test_the_pose_has_the_least_weighted_squares() -> None:
    noise = np.random.default_rng(1).normal(0.0, 0.2, V2.shape)
    l = V2 @ turn(2.5).T + [3.0, -1.0] + noise
    T = align_points(V2, l, WEIGHTS)
    least = cost(T, V2, l, WEIGHTS)
    for step in (*(1e-3 * np.eye(3)), *(-1e-3 * np.eye(3))):
        assert cost(T + step, V2, l, WEIGHTS) > least
    assert cost(align_points(V2, l, np.ones(4)), V2, l, WEIGHTS) > least, "the weights count"
    np.testing.assert_allclose(align_points(V2, l, 7.0 * WEIGHTS), T, atol=1e-12)


def test_mirrored_points_give_a_rotation_and_no_reflection() -> None:
    l = V2 * [1.0, -1.0]
    T = align_points(V2, l, WEIGHTS)
    angles = np.linspace(-math.pi, math.pi, 3601)
    a, b = WEIGHTS @ V2 / WEIGHTS.sum(), WEIGHTS @ l / WEIGHTS.sum()
    costs = [cost(np.append(b - turn(angle) @ a, angle), V2, l, WEIGHTS) for angle in angles]
    assert abs(T[2] - angles[int(np.argmin(costs))]) < 2e-3
    assert cost(T, V2, l, WEIGHTS) <= min(costs)
    mirrored = align_points(V3, V3 * [1.0, 1.0, -1.0], np.ones(6))
    assert np.linalg.det(matrix(mirrored[3:])) == pytest.approx(1.0)


def test_points_in_space_give_the_pose_with_its_quaternion() -> None:
    q = from_euler(np.array([0.4, -0.3, 2.0]))[0]
    l = V3 @ matrix(q).T + [1.0, -2.0, 0.5]
    T = align_points(V3, l, np.arange(1.0, 7.0))
    np.testing.assert_allclose(T[:3], [1.0, -2.0, 0.5], atol=1e-12)
    np.testing.assert_allclose(matrix(T[3:]), matrix(q), atol=1e-12)


@pytest.mark.parametrize("count", [3, 4])
def test_directions_to_three_landmarks_of_the_plane_give_the_pose(count: int) -> None:
    l, angle, place = V2[:count] * 3.0, -2.0, np.array([0.5, -0.25])
    v = (l - place) @ turn(angle)
    lengths = np.array([1.0, 0.2, 5.0, 3.0])[:count, None]  # only the directions count
    (T,) = resect(lengths * v, l, np.zeros((count, 2)))
    np.testing.assert_allclose(T, [*place, angle], atol=1e-9)


@pytest.mark.parametrize("flat", [False, True])
@pytest.mark.parametrize("count", [3, 6])
def test_of_the_poses_by_three_directions_of_space_one_is_right(count: int, flat: bool) -> None:
    q, place = from_euler(np.array([-0.4, 0.7, -1.0]))[0], np.array([4.0, -3.0, 2.0])
    l = V3[:count] * [1.0, 1.0, 0.0 if flat else 1.0]
    v = (l - place) @ matrix(q)
    poses = resect(v / np.linalg.norm(v, axis=1, keepdims=True), l, np.zeros((count, 3)))
    T = min(poses, key=lambda T: float(np.linalg.norm(T[:3] - place)))
    assert len(poses) <= 4
    np.testing.assert_allclose(T[:3], place, atol=1e-6)
    np.testing.assert_allclose(matrix(T[3:]), matrix(q), atol=1e-6)


def test_of_the_two_solutions_the_one_with_the_landmarks_in_front_is_taken() -> None:
    """All directions reversed fit the same linear equations: their pose is another one, turned by 180 deg."""
    l, place = V2 * 3.0, np.array([0.5, -0.25])
    (T,) = resect(-(l - place) @ turn(0.3), l, np.zeros(l.shape))
    np.testing.assert_allclose(T[:2], place, atol=1e-9)
    assert abs(math.remainder(T[2] - 0.3 - math.pi, 2 * math.pi)) < 1e-9


@pytest.mark.parametrize(("share", "same"), [(0.999, True), (1.001, False)])
def test_poses_of_space_are_one_within_the_same_limits(share: float, same: bool) -> None:
    one = np.array([1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0])
    assert is_same_pose(one, one + share * SAME_M * np.array([0.0, 0.6, 0.8, 0, 0, 0, 0])) is same
    half = 0.5 * share * SAME_RAD
    for sign in (1.0, -1.0):  # both quaternions of a rotation
        turned = np.append(one[:3], sign * np.array([0.0, math.sin(half), 0.0, math.cos(half)]))
        assert is_same_pose(one, turned) is same
