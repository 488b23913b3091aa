"""A robot's motion from one node of the batch problem to the next, as the filter predicts it.  [S] (14)-(17)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from kalmark.errors import KalmarkError
from kalmark.models.observe import composed
from kalmark.results.batch_rows import ORIGIN
from kalmark.slam.motion import Drive, Part

if TYPE_CHECKING:
    from kalmark.tracks.robot import Robot

Array = npt.NDArray[np.float64]


class Course:
    """One robot's motion since its last node, in that node's frame, and the errors it gathered."""

    def __init__(self, robot: Robot, node: int) -> None:
        if robot.motion.space.size not in ORIGIN:
            size = robot.motion.space.size
            raise KalmarkError(
                f"batch solution: robot {robot.name!r} has {size} state coordinates, expected a pose alone"
            )
        self.motion = robot.motion
        self.drive = Drive(robot.motion)
        self.held = -1  # which of the split controls is in force
        self.reset(node)

    def reset(self, node: int) -> None:
        """Start from a node."""
        self.node, self.moves = node, 0
        space = self.motion.space
        self.moved, self.Q = ORIGIN[space.size], np.zeros((space.dof, space.dof))
        self.shared: dict[int, Array] = {}

    def add(self, part: Part, roots: list[Array]) -> None:
        """Move by one part.  The error of a control that scans split is kept out of Q, with a root of N in `roots`."""
        self.moves += 1
        self.moved, F, R_u = self.motion.move(self.moved, part.u, part.dt_s)
        self.Q = F @ self.Q @ F.T
        self.shared = {key: F @ S for key, S in self.shared.items()}
        if part.first and part.last:
            self.Q += R_u @ part.N @ R_u.T
        else:
            if part.first:
                self.held = len(roots)
                roots.append(_root(part.N))
            self.shared[self.held] = self.shared.get(self.held, 0.0) + R_u @ roots[self.held]
        D = self.motion.diffusion(part.u, part.dt_s)
        if D is not None:
            axes = composed(self.moved, ORIGIN[len(self.moved)])[2]  # of the robot
            self.Q += axes @ D @ axes.T


def _root(N: Array) -> Array:
    """Return G (k, j) with G G' = N, without columns for errors that are zero."""
    values, vectors = np.linalg.eigh(N)
    some = values > 1e-14 * max(values.max(initial=0.0), 0.0)
    return vectors[:, some] * np.sqrt(values[some])
