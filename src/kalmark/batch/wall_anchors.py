"""Walls in the batch problem: the position of each anchor along its line, which no observation measures.

A wall is a point on its line and the direction of its normal.  As in the filter (docs/walls.md) the point is at a
definite abscissa in the view from the pose of its first observation.
"""

from __future__ import annotations

import numpy as np

from kalmark.arrays import Array
from kalmark.batch.batch_state import LANDMARKS, POSES, Ints
from kalmark.batch.problem import Block, Factor, Term
from kalmark.geometry.frames import compose
from kalmark.geometry.spaces import SE2, Space
from kalmark.models.walls import axes


def anchors(node: Ints, wall: Ints, space: Space, mount: Array, normal: Array, t: Array, R: Array) -> Factor:
    """Return the factor of anchors at the abscissas t (K,), seen from poses `node` (K,) by sensors at `mount` (K, 3).

    An abscissa counts from the foot of the perpendicular on, along the line whose normal has the direction `normal`
    (K,) in the frame of the sensor.  R (K, 1, 1) is small.
    """

    def residuals(poses: Array, walls: Array) -> tuple[Array, Array]:
        z, E = np.empty((len(t), 1)), np.zeros((len(t), 1, 6))
        for k, (pose, l) in enumerate(zip(poses, walls, strict=True)):
            T, T_r, _ = compose(pose, mount[k])
            n, tau = axes(T[2] + normal[k])
            far = l[:2] - T[:2]
            z[k, 0] = t[k] - tau @ far
            E[k, 0, :3] = np.array([*-tau, -n @ far]) @ T_r
            E[k, 0, 3:5] = tau
        return z, E

    blocks = Block(POSES, node, SE2), Block(LANDMARKS, wall, space)
    return Factor(Term(residuals, blocks), t[:, None], R)
