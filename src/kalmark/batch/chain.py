"""The robots' motion from one node of the batch problem to the next, as the filter predicts it.  [S] (14)-(17)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
import scipy.sparse as sp

from kalmark.batch.problem import Motions, motions
from kalmark.batch.state import ORIGIN, Array, Ints
from kalmark.errors import KalmarkError
from kalmark.events import Control
from kalmark.models.observe import composed
from kalmark.models.protocols import bias_covariance
from kalmark.slam.motion import HeldInput, Part

if TYPE_CHECKING:
    from kalmark.slam.robot import Robot

Starts = Mapping[str, tuple[Array, Array]]


class Course:
    """One robot's motion since its last node, in that node's frame, and the errors it gathered."""

    def __init__(self, robot: Robot, node: int) -> None:
        self.motion = robot.motion
        self.drive = HeldInput(robot.motion)
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


class Chain:
    """The nodes of all robots: each follows one of its robot by a step with its errors, the first the origin.

    `starts` are the means and covariances of the robots' starts, where they are not those that the robots state.
    Raises KalmarkError for a robot with more than a pose, or with a bias.
    """

    def __init__(self, robots: Mapping[str, Robot], starts: Starts) -> None:
        self.previous: list[int] = []
        self.steps: list[Array] = []
        self.Q: list[Array] = []
        self.shared: list[tuple[int, int, Array]] = []  # node, number of the split control, d w / d root
        self.roots: list[Array] = []
        self.courses: dict[str, Course] = {}
        for name, robot in robots.items():
            space = robot.motion.space
            if space.size not in ORIGIN:
                what = f"robot {name!r} has {space.size} state coordinates"
                raise KalmarkError(f"batch solution: {what}, expected a pose alone")
            if bias_covariance(robot.motion) is not None:
                raise KalmarkError(f"batch solution: the bias of {name!r} is in the map, expected controls without one")
            mean, P = starts.get(name, (robot.start, np.zeros((space.dof,) * 2) if robot.cov is None else robot.cov))
            self.courses[name] = Course(robot, self._new_node(-1, np.array(mean), np.array(P)))

    def take(self, control: Control) -> None:
        """Move a robot by a control; one that does not fit its motion is left out, as in the filter."""
        course = self.courses[control.robot]
        if control.u.shape == (len(course.motion.columns),):
            for part in course.drive.accept(control):
                course.add(part, self.roots)

    def node_at(self, robot: str, t_ns: int) -> int:
        """Move a robot up to a time and return its node there."""
        course = self.courses[robot]
        part = course.drive.advance(t_ns)
        if part is not None:
            course.add(part, self.roots)
        if course.moves:
            node = self._new_node(course.node, course.moved, course.Q)
            self.shared += [(node, key, S) for key, S in course.shared.items()]
            course.reset(node)
        return course.node

    def motions(self) -> Motions:
        """Return the steps of all nodes; those that share a held control's error have blocks of Q between them."""
        n, q = len(self.steps), len(self.Q[0])
        Q = sp.block_diag(self.Q, format="csr")
        if self.shared:
            first = np.cumsum([0, *(root.shape[1] for root in self.roots)])
            G = sp.lil_array((q * n, int(first[-1])))
            for node, key, S in self.shared:
                G[q * node : q * node + q, first[key] : first[key + 1]] = S
            G = sp.csr_array(G)
            Q = sp.csr_array(Q + G @ G.T)
        return motions(np.array(self.previous), np.array(self.steps), Q)

    def poses(self, nodes: Ints, known: Array) -> Array:
        """Return the poses `known` (S, size) of some nodes (S,), and those of all others chained on from them."""
        poses = np.full((len(self.steps), known.shape[1]), np.nan)
        poses[nodes] = known
        for i, previous in enumerate(self.previous):
            if np.isnan(poses[i, 0]):
                poses[i] = composed(ORIGIN[known.shape[1]] if previous < 0 else poses[previous], self.steps[i])[0]
        return poses

    def _new_node(self, previous: int, step: Array, Q: Array) -> int:
        self.previous.append(previous)
        self.steps.append(step)
        self.Q.append(Q)
        return len(self.steps) - 1


def _root(N: Array) -> Array:
    """Return G (k, j) with G G' = N, without columns for errors that are zero."""
    values, vectors = np.linalg.eigh(N)
    some = values > 1e-14 * max(values.max(initial=0.0), 0.0)
    return vectors[:, some] * np.sqrt(values[some])
