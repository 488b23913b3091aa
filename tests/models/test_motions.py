"""Motions with a velocity in their state: Jacobians in error coordinates, and where the velocity is."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import kalmark as km
from kalmark.geometry.spaces import Space
from kalmark.models.observe import body_velocity, velocity_of
from kalmark.models.protocols import HasVelocity

Array = np.ndarray[Any, np.dtype[np.float64]]
COASTING: list[Any] = [km.motion.ConstantVelocity3D()]


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
    r, model = drawn(motion.space, np.random.default_rng(13)), velocity_of(motion)
    assert isinstance(model, tuple), "built-in models take the compiled way"
    for ours, written in zip(body_velocity(model, r), motion.body_velocity(r), strict=True):
        np.testing.assert_array_equal(ours, written)


def test_motions_without_a_velocity_in_their_state_do_not_claim_one() -> None:
    for motion in (km.motion.Unicycle(), km.motion.Odometry2D(), km.motion.Velocity3D()):
        assert not isinstance(motion, HasVelocity)
