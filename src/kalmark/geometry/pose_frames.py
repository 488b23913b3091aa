"""The frames of the plane and of space, by how many numbers a pose has."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from kalmark.arrays import Array
from kalmark.compiled import compiled
from kalmark.geometry import frames, frames3d
from kalmark.geometry.rotations import matrix

FRAMES: dict[int, Any] = {3: frames, 7: frames3d}
ORIGIN = {3: np.zeros(3), 7: np.array([0.0, 0, 0, 0, 0, 0, 1])}


def moved_with(pose: Array, before: Array, after: Array) -> Array:
    """Return a pose, (3,) or (7,), after another one that is rigidly connected with it moves from `before` to `after`.

    >>> km.geometry.pose_frames.moved_with(np.array([3.0, 2.0, 0.0]), np.zeros(3), np.array([1.0, 0.0, 0.0]))
    array([4., 2., 0.])
    """
    of_world = FRAMES[len(pose)]
    moved: Array = of_world.compose(after, of_world.compose(of_world.inverse(before)[0], pose)[0])[0]
    return moved


@compiled
def compose_poses(a: Array, b: Array) -> tuple[Array, Array, Array]:
    """Return c = a o b of poses (3,) or (7,), C_a and C_b (3, 3) or (6, 6); `b` alone has the size of a pose.

    >>> c, C_a, C_b = km.geometry.pose_frames.compose_poses(np.array([1.0, 2.0, 0.0]), np.array([1.0, 0.0, 0.0]))
    >>> c.round(3)
    array([2., 2., 0.])
    """
    return frames.compose(a, b) if len(b) == 3 else frames3d.compose(a, b)


@compiled
def body_axes(state: Array, size: int) -> Array:
    """Return the matrix (size, size) from errors in the frame of a robot to the world's, by its state.

    In the plane (3 or more,), in space (7 or more,): of the position, the orientation and the velocity.  A velocity in
    the plane and the rates of a body are in the robot's frame anyway.
    """
    G = np.eye(size)
    if len(state) < 7:
        G[0, 0] = G[1, 1] = math.cos(state[2])
        G[1, 0] = math.sin(state[2])
        G[0, 1] = -G[1, 0]
        return G
    Q = matrix(state[3:7])
    for at in range(0, min(size, 9), 3):
        for i in range(3):
            for j in range(3):
                G[at + i, at + j] = Q[i, j]
    return G
