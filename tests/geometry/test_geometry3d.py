"""Geometry of space: every Jacobian against differences, group laws, and SciPy's rotations."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from differences import agree, batched, derivative, frames, rotation_vectors
from kalmark.geometry import directions, frames3d, rotations

Array = np.ndarray[Any, np.dtype[np.float64]]


def same_rotation(a: Array, b: Array, atol: float = 1e-12) -> None:
    """Assert that quaternions agree up to their sign."""
    np.testing.assert_allclose(np.abs(np.sum(a * b, axis=-1)), 1, atol=atol)
    sign = np.sign(np.sum(a * b, axis=-1, keepdims=True))
    np.testing.assert_allclose(a * sign, b, atol=atol)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(7)


def test_quaternions_matrices_and_rotation_vectors_are_scipys(rng: np.random.Generator) -> None:
    v = rotation_vectors(rng)
    q = batched(rotations.exp)(v)
    theirs = Rotation.from_rotvec(v)
    same_rotation(q, theirs.as_quat())
    np.testing.assert_allclose(batched(rotations.matrix)(q), theirs.as_matrix(), atol=1e-14)
    same_rotation(batched(rotations.from_matrix)(theirs.as_matrix()), q)
    other = theirs[rng.permutation(len(v))]
    same_rotation(batched(rotations.multiply)(q, other.as_quat()), (theirs * other).as_quat())


def test_log_undoes_exp_up_to_half_a_turn_and_is_the_shorter_way_beyond(rng: np.random.Generator) -> None:
    v = rotation_vectors(rng)
    inside = np.linalg.norm(v, axis=1) < np.pi
    again = batched(rotations.log)(batched(rotations.exp)(v))
    np.testing.assert_allclose(again[inside], v[inside], atol=1e-12)
    np.testing.assert_allclose(batched(rotations.log)(-batched(rotations.exp)(v))[inside], v[inside], atol=1e-12)
    long = v[inside] * 1.5
    short = batched(rotations.log)(batched(rotations.exp)(long))
    assert np.linalg.norm(short, axis=1).max() <= np.pi + 1e-15
    same_rotation(batched(rotations.exp)(short), batched(rotations.exp)(long))


def test_log_keeps_the_last_digit_of_small_rotations() -> None:
    for size in (1e-300, 1e-160, 1e-13, 1e-12, 1.1e-12, 1e-8, 1e-5):
        v = size * np.array([0.6, -0.48, 0.64])
        np.testing.assert_allclose(rotations.log(rotations.exp(v)), v, rtol=1e-14, atol=0)


def test_the_left_jacobian_is_the_derivative_of_exp_and_its_inverse_that_of_log(rng: np.random.Generator) -> None:
    for v in rotation_vectors(rng):
        V, V_inverse = rotations.left_jacobian(v), rotations.left_jacobian_inverse(v)
        agree(V, derivative(rotations.exp, v, out="quaternion"))
        np.testing.assert_allclose(V_inverse @ V, np.eye(3), atol=1e-12)
        if np.linalg.norm(v) < 3:
            agree(V_inverse, derivative(rotations.log, rotations.exp(v), into="quaternion"))


def test_the_left_jacobian_carries_a_points_way_along_a_turn(rng: np.random.Generator) -> None:
    for v in rotation_vectors(rng):
        p = rng.normal(size=3)
        turned = rotations.matrix(rotations.exp(v)) @ p - p
        np.testing.assert_allclose(rotations.left_jacobian(v) @ np.cross(v, p), turned, atol=1e-14)


def test_euler_angles_are_scipys_and_have_the_jacobians_of_their_differences(rng: np.random.Generator) -> None:
    for i in range(200):
        e = rng.uniform(-np.pi, np.pi, 3)
        e[1] /= 2
        if i % 5 == 0:
            e[1] = (np.pi / 2 - 10.0 ** -(i % 4)) * (-1) ** i  # near the singular pitch
        q, Q_e = rotations.from_euler(e)
        same_rotation(q, Rotation.from_euler("ZYX", e[::-1]).as_quat())
        agree(Q_e, derivative(lambda x: rotations.from_euler(x)[0], e, out="quaternion"))
        again, E_q = rotations.to_euler(q)
        np.testing.assert_allclose(np.sin((again - e) / 2), 0, atol=1e-12)
        step = 0.02 * np.cos(e[1])
        agree(E_q, derivative(lambda x: rotations.to_euler(x)[0], q, "quaternion", "angles", first=step))


@pytest.mark.parametrize("pitch", [np.pi / 2, -np.pi / 2, np.pi / 2 - 1e-15, np.pi / 2 - 1e-9])
def test_euler_angles_of_a_vertical_pitch_give_the_rotation_back(pitch: float, rng: np.random.Generator) -> None:
    for _ in range(20):
        q, _ = rotations.from_euler(np.array([rng.uniform(-3, 3), pitch, rng.uniform(-3, 3)]))
        again, _ = rotations.from_euler(rotations.to_euler(q)[0])
        np.testing.assert_allclose(rotations.matrix(again), rotations.matrix(q), atol=1e-14)


def test_compose_and_inverse_have_the_jacobians_of_their_differences(rng: np.random.Generator) -> None:
    for a, b in zip(frames(rng), frames(rng), strict=True):
        _, C_a, C_b = frames3d.compose(a, b)
        agree(C_a, derivative(lambda x: frames3d.compose(x, b)[0], a, "frame", "frame"))
        agree(C_b, derivative(lambda x: frames3d.compose(a, x)[0], b, "frame", "frame"))
        agree(frames3d.inverse(a)[1], derivative(lambda x: frames3d.inverse(x)[0], a, "frame", "frame"))


def test_frames_form_a_group(rng: np.random.Generator) -> None:
    one = np.array([0.0, 0, 0, 0, 0, 0, 1])
    for a, b, c in zip(frames(rng), frames(rng), frames(rng), strict=True):
        left = frames3d.compose(frames3d.compose(a, b)[0], c)[0]
        right = frames3d.compose(a, frames3d.compose(b, c)[0])[0]
        np.testing.assert_allclose(frames3d.minus(left, right), 0, atol=1e-12)
        back = frames3d.inverse(a)[0]
        for product in (frames3d.compose(a, back)[0], frames3d.compose(back, a)[0]):
            np.testing.assert_allclose(frames3d.minus(product, one), 0, atol=1e-12)
        np.testing.assert_allclose(frames3d.minus(frames3d.compose(one, a)[0], a), 0, atol=1e-14)


def test_plus_and_minus_are_inverse(rng: np.random.Generator) -> None:
    for a, turn in zip(frames(rng), rotation_vectors(rng), strict=True):
        d = np.concatenate([rng.normal(size=3), turn * 0.999])
        np.testing.assert_allclose(frames3d.minus(frames3d.plus(a, d), a), d, atol=1e-11)


def test_to_frame_and_from_frame_undo_each_other_with_the_jacobians_of_their_differences(
    rng: np.random.Generator,
) -> None:
    for f in frames(rng):
        p = rng.normal(size=3) * 4
        np.testing.assert_allclose(frames3d.from_frame(f, frames3d.to_frame(f, p)[0])[0], p, atol=1e-12)
        for function in (frames3d.to_frame, frames3d.from_frame):
            _, out_f, out_p = function(f, p)
            agree(out_f, derivative(lambda x: function(x, p)[0], f, "frame"))
            agree(out_p, derivative(lambda x: function(f, x)[0], p))


def test_many_points_at_once_equal_one_by_one(rng: np.random.Generator) -> None:
    f, p = frames(rng, 1)[0], rng.normal(size=(5, 3))
    for function in (frames3d.to_frame, frames3d.from_frame):
        for together, *single in zip(function(f, p), *(function(f, one) for one in p), strict=True):
            np.testing.assert_array_equal(together, np.array(single))


def test_move_has_the_jacobians_of_its_differences_and_turns_about_the_robots_axes(rng: np.random.Generator) -> None:
    for f, turn in zip(frames(rng), rotation_vectors(rng), strict=True):
        u = np.concatenate([rng.normal(size=3), turn])
        b, B_f, B_u = frames3d.move(f, u)
        agree(B_f, derivative(lambda x: frames3d.move(x, u)[0], f, "frame", "frame"))
        agree(B_u, derivative(lambda x: frames3d.move(f, x)[0], u, "plain", "frame"))
        turned = rotations.matrix(f[3:]) @ rotations.matrix(rotations.exp(turn))
        np.testing.assert_allclose(rotations.matrix(b[3:]), turned, atol=1e-13)


def test_euler_poses_undo_each_other_and_have_inverse_jacobians(rng: np.random.Generator) -> None:
    for f in frames(rng):
        e, E_f = frames3d.to_euler_pose(f)
        again, F_e = frames3d.from_euler_pose(e)
        np.testing.assert_allclose(frames3d.minus(again, f), 0, atol=1e-12)
        np.testing.assert_allclose(F_e @ E_f, np.eye(6), atol=1e-9)


def points_near_the_axis_too(rng: np.random.Generator) -> Array:
    p = rng.normal(size=(200, 3)) * 5
    p[::5, :2] *= 10.0 ** -rng.integers(1, 6, size=(40, 1))  # near the z axis
    return p


def test_directions_and_spherical_coordinates_have_the_jacobians_of_their_differences(rng: np.random.Generator) -> None:
    p = points_near_the_axis_too(rng)
    (y, Y_p), (m, M_v) = directions.spherical_many(p), directions.unit_many(p)
    again, P_y = directions.inv_spherical_many(y)
    np.testing.assert_allclose(again, p, atol=1e-13)
    np.testing.assert_allclose(m, p / np.linalg.norm(p, axis=1)[:, None], atol=1e-15)
    d, D_a = directions.direction_many(y[:, 1:])
    np.testing.assert_allclose(d, m, atol=1e-14)
    for i in range(len(p)):
        one, step = p[i], min(0.02, 0.1 * np.hypot(*p[i, :2]))
        agree(Y_p[i], derivative(lambda x: directions.spherical_many(x[None])[0][0], one, out="angles", first=step))
        agree(M_v[i], derivative(lambda x: directions.unit_many(x[None])[0][0], one))
        agree(P_y[i], derivative(lambda x: directions.inv_spherical_many(x[None])[0][0], y[i]))
        agree(D_a[i], derivative(lambda x: directions.direction_many(x[None])[0][0], y[i, 1:]))
