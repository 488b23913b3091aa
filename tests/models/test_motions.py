"""Motions of the plane and with a velocity in their state: Jacobians in error coordinates, noise, calibration."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import kalmark as km
from kalmark.compiled import address_of
from kalmark.filter.prediction import noise_in_world
from kalmark.geometry.spaces import Rn, Space
from kalmark.models.observe import step, step_of
from kalmark.models.protocols import HasVelocity, coasts, diffusion_of, true_control
from kalmark.models.state_view import VELOCITY, call_velocity

Array = np.ndarray[Any, np.dtype[np.float64]]
COASTING: list[Any] = [km.motion.ConstantVelocity3D(), km.motion.ConstantVelocity(), km.motion.ConstantTurnRate()]


def drawn(space: Space, rng: np.random.Generator) -> Array:
    """Return a state (size,) of a space that begins with a pose."""
    origin = np.zeros(space.size)
    if space.world == "space":
        origin[6] = 1.0
    return space.plus(origin, rng.normal(size=space.dof) * 2)


def slope(function: Callable[[Array], Array], x: Array, space: Space, out: Space | None = None) -> Array:
    """Return the derivative of a function of a state x (size,), to the fourth order, in error coordinates."""
    h, columns, at = 1e-3, [], function(x)
    minus = np.subtract if out is None else out.minus
    for d in np.eye(space.dof):
        one, two = (minus(function(space.plus(x, k * h * d)), at) for k in (1, 2))
        back, far = (minus(function(space.plus(x, -k * h * d)), at) for k in (1, 2))
        columns.append((8 * (one - back) - (two - far)) / (12 * h))
    return np.stack(columns, axis=-1)


@pytest.mark.parametrize("motion", COASTING, ids=lambda motion: type(motion).__name__)
def test_the_velocity_in_a_state_has_the_jacobian_of_its_differences(motion: Any) -> None:
    rng = np.random.default_rng(11)
    assert isinstance(motion, HasVelocity)
    for _ in range(50):
        r = drawn(motion.space, rng)
        np.testing.assert_allclose(
            motion.body_velocity(r)[1], slope(lambda x: motion.body_velocity(x)[0], r, motion.space), atol=1e-8
        )


@pytest.mark.parametrize("motion", COASTING, ids=lambda motion: type(motion).__name__)
def test_the_velocity_in_a_state_is_that_at_which_the_robot_moves(motion: Any) -> None:
    """Seen from the robot, the way and the turn of a short time are its velocity."""
    rng, dt = np.random.default_rng(12), 1e-6
    pose = km.geometry.SE2 if motion.space.world == "plane" else km.geometry.SE3
    frame = (lambda r: r[:3]) if pose.size == 3 else (lambda r: r[:7])
    for _ in range(20):
        r = drawn(motion.space, rng)
        moved = motion.move(r, np.zeros(len(motion.columns)), dt)[0]
        way = pose.minus(frame(moved), frame(r)) / dt
        turn = np.linalg.inv(turning(r))
        np.testing.assert_allclose(turn @ way, motion.body_velocity(r)[0], atol=1e-4)


def turning(r: Array) -> Array:
    """Return the matrix from the robot's frame to the world's, of a pose's errors (3, 3) or (6, 6)."""
    if len(r) < 7:
        G = np.eye(3)
        G[:2, :2] = km.geometry.rotation(r[2])
        return G
    Q: Array = np.kron(np.eye(2), km.geometry.rotations.matrix(r[3:7].copy()))
    return Q


@pytest.mark.parametrize("motion", COASTING, ids=lambda motion: type(motion).__name__)
def test_the_velocity_of_a_state_is_called_by_address(motion: Any) -> None:
    r, address = drawn(motion.space, np.random.default_rng(13)), address_of(type(motion).velocity, VELOCITY)
    for ours, written in zip(call_velocity(address, (r, np.zeros(0))), motion.body_velocity(r), strict=True):
        np.testing.assert_array_equal(ours, written)


def test_motions_without_a_velocity_in_their_state_do_not_claim_one() -> None:
    for motion in (km.motion.Unicycle(), km.motion.Odometry2D(), km.motion.Velocity3D()):
        assert not isinstance(motion, HasVelocity)


# ---------------------------------------------------------------------- motions of the plane
PLANAR: list[Any] = [
    km.motion.DifferentialDrive(0.1, 0.12, 0.4),
    km.motion.Tricycle(0.8),
    km.motion.Omnidirectional(),
    km.motion.Mecanum(0.1, 0.5, 0.4),
    km.motion.SlippingUnicycle(),
    km.motion.ConstantVelocity(),
    km.motion.ConstantTurnRate(),
]


def named(motion: Any) -> str:
    return type(motion).__name__


@pytest.mark.parametrize("motion", PLANAR, ids=named)
def test_a_motion_of_the_plane_has_the_jacobians_of_its_differences(motion: Any) -> None:
    rng, k = np.random.default_rng(1), len(motion.columns)
    for i in range(60):
        r, u = drawn(motion.space, rng), rng.normal(size=k)
        u[i % k] *= 10.0 ** -(i % 9)  # towards the limits of the arc
        _, R_r, R_u = motion.move(r, u, 0.7)
        R_r_d = slope(lambda x, u=u: motion.move(x, u, 0.7)[0], r, motion.space, motion.space)
        R_u_d = slope(lambda x, r=r: motion.move(r, x, 0.7)[0], u, Rn(k), motion.space)
        np.testing.assert_allclose(R_r, R_r_d, rtol=1e-6, atol=1e-7)
        np.testing.assert_allclose(R_u, R_u_d, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("motion", PLANAR, ids=named)
def test_a_motion_of_the_plane_is_compiled_and_turns_with_the_world(motion: Any) -> None:
    rng, model = np.random.default_rng(2), step_of(motion)
    assert isinstance(model, tuple), "built-in models take the compiled way"
    for _ in range(20):
        r, u = drawn(motion.space, rng), rng.normal(size=len(motion.columns))
        moved, R_r, R_u = step(model, r, u, 0.4)
        for ours, written in zip((moved, R_r, R_u), motion.move(r, u, 0.4), strict=True):
            np.testing.assert_array_equal(ours, written)
        there = motion.move(motion.space.rotated(r, 1.1), u, 0.4)[0]
        np.testing.assert_allclose(motion.space.minus(there, motion.space.rotated(moved, 1.1)), 0.0, atol=1e-12)


@pytest.mark.parametrize("motion", PLANAR, ids=named)
def test_a_motion_of_the_plane_moves_in_two_parts_as_in_one(motion: Any) -> None:
    """A held control and a velocity in the state go on; an increment is divided."""
    rng = np.random.default_rng(3)
    for _ in range(20):
        r, u = drawn(motion.space, rng), rng.normal(size=len(motion.columns))
        if coasts(motion):
            u = 0 * u
        part = u if motion.held or coasts(motion) else 0.3 * u
        halfway = motion.move(r, part, 0.3)[0]
        apart = motion.move(halfway, u if motion.held or coasts(motion) else u - part, 0.7)[0]
        np.testing.assert_allclose(motion.space.minus(apart, motion.move(r, u, 1.0)[0]), 0.0, atol=1e-12)


def gathered(motion: Any, r: Array, controls: list[tuple[Array, float]]) -> tuple[Array, Array]:
    """Return the state (size,) after some controls, and the covariance of the noise, as the filter predicts both."""
    P = np.zeros((motion.space.dof,) * 2)
    for u, dt in controls:
        D = diffusion_of(motion, r, u, dt)
        r, R_r, R_u = motion.move(r, u, dt)
        P = R_r @ P @ R_r.T
        if not motion.held:
            P += R_u @ motion.control_noise(u) @ R_u.T
        if D is not None:
            P[: len(D), : len(D)] += noise_in_world(r, D)
    return r, P


WHITE: list[Any] = [
    km.motion.DifferentialDrive(0.1, 0.12, 0.4, sigma_way_m_per_sqrt_m=0.05),
    km.motion.SlippingUnicycle(sigma_slip_per_sqrt_s=0.1),
    km.motion.ConstantVelocity(0.0, 0.0, 0.3, 0.2, 0.1),
    km.motion.ConstantTurnRate(0.0, 0.0, 0.3, 0.2),
]


@pytest.mark.parametrize("motion", WHITE, ids=named)
def test_white_noise_along_an_arc_does_not_depend_on_how_it_is_divided(motion: Any) -> None:
    rng = np.random.default_rng(4)
    for _ in range(10):
        r, u = drawn(motion.space, rng), rng.normal(size=len(motion.columns)) * (2.0 + 4.0 * (not motion.held))
        u = 0 * u if coasts(motion) else u
        whole, P = gathered(motion, r, [(u, 1.3)])
        for shares in ((0.5, 0.5), (0.1, 0.2, 0.3, 0.4)):
            parts = [(u if motion.held else share * u, share * 1.3) for share in shares]
            there, P_parts = gathered(motion, r, parts)
            np.testing.assert_allclose(motion.space.minus(there, whole), 0.0, atol=1e-12)
            np.testing.assert_allclose(P_parts, P, rtol=1e-6, atol=1e-8 * np.abs(P).max())


@pytest.mark.parametrize("motion", WHITE, ids=named)
def test_white_noise_along_an_arc_is_the_sum_of_that_of_many_small_steps(motion: Any) -> None:
    """Each of them is disturbed at its end only: what is white in between is left out, and does not matter any more."""
    r, u = drawn(motion.space, np.random.default_rng(5)), np.array([1.0, 2.0, 0.0][: len(motion.columns)])
    u = 0 * u if coasts(motion) else u
    q = diffusion_of(motion, r, u, 1.0)
    assert q is not None
    pose, n, steps = 3, motion.space.dof, 4000
    P, x = np.zeros((n, n)), r
    for _ in range(steps):
        part = u if motion.held else u / steps
        x, R_r, R_u = motion.move(x, part, 1.0 / steps)
        P = R_r @ P @ R_r.T
        if motion.held or coasts(motion):
            P[pose:, pose:] += q[pose:, pose:] / steps
        else:
            P += R_u @ motion.control_noise(part) @ R_u.T
    np.testing.assert_allclose(gathered(motion, r, [(u, 1.0)])[1], P, rtol=5e-3, atol=1e-3 * np.abs(P).max())


def test_the_noise_of_a_wheel_grows_with_the_way_that_it_has_rolled() -> None:
    motion = km.motion.DifferentialDrive(0.1, 0.1, 0.5, sigma_way_m_per_sqrt_m=0.02)
    np.testing.assert_allclose(motion.control_noise(np.array([10.0, -40.0])), np.diag([4e-4, 16e-4]) / 0.1**2)
    assert not motion.control_noise(np.zeros(2)).any()
    assert motion.diffusion(np.zeros(2), 1.0) is None, "a robot that stands does not wander"
    ahead, P = gathered(motion, np.zeros(3), [(np.array([100.0, 100.0]), 1.0)])  # 10 m
    np.testing.assert_allclose(ahead, [10.0, 0.0, 0.0], atol=1e-12)
    turn = 2 * 4e-4 * 10 / 0.5**2
    np.testing.assert_allclose(np.diag(P), [4e-4 * 10 / 2, turn * 10**2 / 3, turn])


def test_two_wheels_turn_and_drive_as_their_radii_and_track_say() -> None:
    motion = km.motion.DifferentialDrive(0.1, 0.2, 0.5)
    np.testing.assert_allclose(motion.move(np.zeros(3), np.array([2.0, 1.0]), 0.1)[0], [0.2, 0, 0], atol=1e-15)
    np.testing.assert_allclose(motion.move(np.zeros(3), np.array([-1.0, 0.5]), 0.1)[0], [0, 0, 0.4], atol=1e-15)


def test_other_radii_and_another_track_are_another_control() -> None:
    motion = km.motion.DifferentialDrive(0.1, 0.12, 0.5, sigma_radius_m=0.01, sigma_track_m=0.05)
    rng = np.random.default_rng(6)
    for _ in range(20):
        u, a, r = rng.normal(size=2), rng.normal(size=3) * [0.01, 0.01, 0.05], rng.normal(size=3)
        other = km.motion.DifferentialDrive(0.1 + a[0], 0.12 + a[1], 0.5 + a[2])
        true, U_a = true_control(motion, u, a, 0.1)
        np.testing.assert_allclose(motion.move(r, true, 0.1)[0], other.move(r, u, 0.1)[0], atol=1e-13)
        np.testing.assert_allclose(U_a, slope(lambda x, u=u: motion.calibrated(u, x, 0.1)[0], a, Rn(3)), atol=1e-7)
    track = km.motion.DifferentialDrive(0.1, 0.12, 0.5, sigma_track_m=0.05)
    np.testing.assert_allclose(track.calibrated(u, a[2:], 0.1)[1], motion.calibrated(u, [0, 0, a[2]], 0.1)[1][:, 2:])


def test_a_tricycle_turns_about_the_point_on_its_rear_axle() -> None:
    v, steering, L = 0.5, 0.3, 0.8
    moved = km.motion.Tricycle(L).move(np.zeros(3), np.array([v, steering]), 1e-6)[0] / 1e-6
    np.testing.assert_allclose(moved, [v * np.cos(steering), 0.0, v * np.sin(steering) / L], atol=1e-6)
    turned = km.motion.Tricycle(L).move(np.zeros(3), np.array([v, np.pi / 2]), 1.0)[0]
    np.testing.assert_allclose(turned, [0, 0, v / L], atol=1e-12)


def test_mecanum_wheels_drive_in_all_directions() -> None:
    motion = km.motion.Mecanum(0.1, 0.6, 0.4)
    for u, v in (
        ([1, 1, 1, 1], [0.1, 0, 0]),
        ([-1, 1, 1, -1], [0, 0.1, 0]),
        ([-1, 1, -1, 1], [0, 0, 0.1 / 0.5]),
        ([1, -1, -1, 1], [0, -0.1, 0]),
    ):
        there = km.motion.Omnidirectional().move(np.zeros(3), np.array(v, dtype=float), 0.5)[0]
        np.testing.assert_allclose(motion.move(np.zeros(3), np.array(u, dtype=float), 0.5)[0], there, atol=1e-15)
    scaled = km.motion.Mecanum(0.1, 0.6, 0.4, sigma_v_scale=1, sigma_w_scale=1)
    u, a = np.array([1.0, 2.0, -0.5, 3.0]), np.array([0.1, -0.2])
    b, W = np.array(scaled.parameters).reshape(3, 4) @ true_control(scaled, u, a, 0.1)[0], scaled.parameters
    np.testing.assert_allclose(b, W.reshape(3, 4) @ u * [1.1, 1.1, 0.8])


def test_a_robot_that_slips_goes_beside_its_heading() -> None:
    moved = km.motion.SlippingUnicycle().move(np.array([0.0, 0.0, 0.0, 0.1]), np.array([2.0, 0.0]), 0.5)[0]
    np.testing.assert_allclose(moved, [1.0, 0.1, 0.0, 0.1])


def test_a_robot_at_constant_velocity_goes_on_its_circle_and_impulses_change_it() -> None:
    motion = km.motion.ConstantVelocity()
    r = np.array([0.0, 0.0, 0.0, 1.0, 0.0, np.pi])  # radius 1 / pi
    np.testing.assert_allclose(motion.move(r, np.zeros(3), 1.0)[0], [0, 2 / np.pi, np.pi, 1, 0, np.pi], atol=1e-12)
    np.testing.assert_allclose(motion.move(r, np.array([0.5, 0.1, -1]), 0.0)[0], r + np.array([0, 0, 0, 0.5, 0.1, -1]))
