"""The motion of all robots between nodes, as the filter predicts it, and what its errors come from: [S] (14)-(17)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import scipy.sparse as sp

from kalmark.arrays import Array
from kalmark.batch.batch_state import Ints, unsolvable_problem
from kalmark.batch.problem import Motions, motions
from kalmark.events import Control
from kalmark.geometry import frames, frames3d
from kalmark.geometry.pose_frames import ORIGIN
from kalmark.models.observe import sensor_pose
from kalmark.models.protocols import Motion, SelfCalibrating, self_calibrating, true_control
from kalmark.slam.held_control import HeldInput, MotionPart

if TYPE_CHECKING:
    from kalmark.slam.robot import Robot

Starts = Mapping[str, tuple[Array, Array]]
ANYWHERE = 1e3  # m and rad, sigmas of a motion that is not known at all
ZERO = 1e-14  # of a covariance's largest eigenvalue
OTHER, START, UNKNOWN = "", "start", "unknown"  # errors that are of no component of a control
TURNING = "turns"  # of a robot on wheels, of which no component of a control is one


class Systematic(NamedTuple):
    """An error of a robot's controls that stays: its `kind`, the column it is of, its unit.

    An "offset" is added to the column; of increments it is the part gathered in a second.  A "scale" is the share of
    the column itself, or of all `TURNING` of a robot on wheels; "per_way" is what is added for each metre.
    """

    robot: str
    column: str
    kind: str
    unit: str


def systematic_errors(robot: str, motion: Motion) -> list[Systematic]:
    """Return the errors that the controls of a motion may have all the time."""
    columns = tuple(motion.columns)
    units = [column.rsplit("_", 1)[-1].replace("ps", "/s") for column in columns]
    rates = units if motion.held else [f"{unit}/s" for unit in units]
    found = [Systematic(robot, column, "offset", unit) for column, unit in zip(columns, rates, strict=True)]
    found += [Systematic(robot, column, "scale", "") for column in columns]
    found += [Systematic(robot, columns[j], "per_way", "rad/m") for j in _turns(columns)]
    return found + [Systematic(robot, TURNING, "scale", "")] * _on_wheels(motion)


def _on_wheels(motion: Motion) -> bool:
    """Return whether the controls are rotations of wheels in the plane: no ways, and no turns of the robot."""
    columns = tuple(motion.columns)
    return 1 < len(columns) == len(_turns(columns)) and motion.space.axes == 1


def _turns(columns: tuple[str, ...]) -> list[int]:
    return [j for j, name in enumerate(columns) if name.endswith(("_rad", "_radps"))]


class Course:
    """One robot's motion since its last node, in that node's frame, and the errors it gathered.

    `Q` (k + 2, dof, dof) are the covariances by the k components of the control, by gaps in the controls and by
    everything else, `T` (dof, K) the derivative by the systematic errors.
    """

    def __init__(self, robot: Robot, node: int, bias: Array | None = None) -> None:
        self.motion, self.columns = robot.motion, tuple(robot.motion.columns)
        self.robot, self.drive = robot, HeldInput(robot.motion, robot.watch())
        self.bias = bias
        self.held = -1  # which of the split controls is in force
        self.turns, self.on_wheels = _turns(self.columns), _on_wheels(robot.motion)
        self.lengths = [j for j in range(len(self.columns)) if j not in self.turns]
        self.N, self.root = np.zeros(0), np.zeros(0)  # of the last control
        self.reset(node)

    def reset(self, node: int) -> None:
        """Start from a node."""
        self.node, self.moves, self.known = node, 0, True
        space = self.motion.space
        self.moved, self.Q = ORIGIN[space.size], np.zeros((len(self.columns) + 2, space.dof, space.dof))
        self.T = np.zeros((space.dof, 2 * len(self.columns) + len(self.turns) + self.on_wheels))
        self.shared: dict[int, Array] = {}

    def forget(self) -> None:
        """Allow any motion since the node; the control in force stays."""
        self.reset(self.node)
        self.moves, self.known = 1, False
        self.Q[-1] = ANYWHERE**2 * np.eye(len(self.T))

    def add(self, part: MotionPart, roots: list[Array]) -> None:
        """Move by one part.  The error of a control that scans split is kept out of Q, with a root of N in `roots`."""
        self.moves, before = self.moves + 1, self.moved
        self.moved, F, R_u = self.motion.move(before, self._control(part), part.dt_s)
        self.Q = F @ self.Q @ F.T
        self._stay(part, F, R_u, float(self.moved[-1] - before[-1]))
        self.shared = {key: F @ S for key, S in self.shared.items()}
        if part.N is not self.N:
            self.N, self.root = part.N, root(part.N)
        if part.first and part.last:
            G = (R_u @ self.root).T
            self.Q[:-2] += G[:, :, None] * G[:, None, :]
        else:
            if part.first:
                self.held = len(roots)
                roots.append(self.root)
            self.shared[self.held] = self.shared.get(self.held, 0.0) + R_u @ roots[self.held]
        for k, D in enumerate((part.unknown, self.motion.diffusion(part.u, part.dt_s)), -2):
            if D is not None:
                axes = sensor_pose(self.moved, ORIGIN[len(self.moved)])[2]  # of the robot
                self.Q[k] += axes @ D @ axes.T

    def _control(self, part: MotionPart) -> Array:
        """Return the control of a part, as it is with the constants that are known."""
        if self.bias is None or not isinstance(self.motion, SelfCalibrating):
            return part.u
        return true_control(self.motion, part.u, self.bias, part.dt_s)[0]

    def _stay(self, part: MotionPart, F: Array, R_u: Array, turned: float) -> None:
        """Carry the systematic errors on, in the order of `systematic_errors`; the part `turned` the robot, rad.

        The scale of the turns acts as if a part turned at its end: that is exact for short parts.
        """
        k, T = len(part.u), F @ self.T
        self.T = T
        if part.unknown is not None:  # in a gap no control was measured
            return
        T[:, :k] += R_u if self.motion.held else R_u * part.dt_s
        T[:, k : 2 * k] += R_u * part.u
        if self.turns:
            way = part.u[self.lengths]
            T[:, 2 * k : 2 * k + len(self.turns)] += R_u[:, self.turns] * math.sqrt(way @ way)
        if self.on_wheels:
            T[-1, -1] += math.remainder(turned, 2.0 * math.pi)


class Node(NamedTuple):
    """A pose of a robot: it follows node `previous` (-1: the origin) by a step with its errors, if that is `known`."""

    robot: str
    previous: int
    step: Array
    Q: Array
    T: Array
    known: bool


class Chain:
    """The nodes of all robots: each follows one of its robot by a step with its errors, the first the origin.

    `starts` are the means and covariances of the robots' starts, where they are not those that the robots state, and
    `biases` the constants of their controls.  Raises KalmarkError for a robot with more than a pose, or with a bias in
    the map that is not given.
    """

    def __init__(self, robots: Mapping[str, Robot], starts: Starts, biases: Mapping[str, Array]) -> None:
        self.nodes: list[Node] = []
        self.shared: list[tuple[int, int, Array]] = []  # node, number of the split control, d w / d root
        self.roots: list[Array] = []
        self.courses: dict[str, Course] = {}
        for name, robot in robots.items():
            space = robot.motion.space
            if space.size not in ORIGIN:
                raise unsolvable_problem(f"robot {name!r} has {space.size} state coordinates, expected a pose alone")
            if self_calibrating(robot.motion) is not None and name not in biases:
                raise unsolvable_problem(f"the bias of {name!r} is in the map, expected controls without one")
            mean, P = starts.get(name, (robot.start, np.zeros((space.dof,) * 2) if robot.cov is None else robot.cov))
            course = self.courses[name] = Course(robot, len(self.nodes), biases.get(name))
            course.Q[-1] = P
            self._enter(name, -1, np.array(mean), course)

    def take(self, control: Control) -> None:
        """Move a robot by a control; one that does not fit its motion is left out, as in the filter."""
        course = self.courses[control.robot]
        if control.u.shape == (len(course.motion.columns),):
            for part in course.drive.accept(control):
                course.add(part, self.roots)

    def lose(self, robot: str) -> None:
        """Drop the motion of a robot from its last node on, until now."""
        self.courses[robot].forget()

    def node_at(self, robot: str, t_ns: int) -> int:
        """Move a robot up to a time and return its node there."""
        course = self.courses[robot]
        part = course.drive.advance(t_ns)
        if part is not None:
            course.add(part, self.roots)
        if course.moves:
            self._enter(robot, course.node, course.moved, course)
            course.drive.located(t_ns, False)
        return course.node

    def _enter(self, robot: str, previous: int, step: Array, course: Course) -> None:
        self.shared += [(len(self.nodes), key, S) for key, S in course.shared.items()]
        self.nodes.append(Node(robot, previous, step, course.Q, course.T, course.known))
        course.reset(len(self.nodes) - 1)

    def motions(self, poses: Array) -> Motions:
        """Return the steps of all nodes; those that share a held control's error have columns of the root in common.

        A step that is not known is the one between the initial `poses` (n, size).
        """
        n, q = len(self.nodes), len(self.nodes[0].T)
        columns = _Columns()
        for name, course in self.courses.items():
            of = [i for i, node in enumerate(self.nodes) if node.robot == name]
            Q = root(np.array([self.nodes[i].Q for i in of]))
            kinds = [*(f"{name}.{column}" for column in course.columns), UNKNOWN, f"{name}.{OTHER}"]
            for c, kind in enumerate(kinds):
                for i, G in zip(of, Q[:, c], strict=True):
                    columns.add(q * i, G, self._kind(i, kind))
        owners = {key: self.nodes[i].robot for i, key, _ in self.shared}
        held = {
            key: [columns.new(f"{robot}.{c}") for c in self.courses[robot].columns] for key, robot in owners.items()
        }
        for i, key, S in self.shared:
            columns.put(q * i, S, held[key])
        errors = [error for name, course in self.courses.items() for error in systematic_errors(name, course.motion)]
        T = np.zeros((n, q, len(errors)))
        for i, node in enumerate(self.nodes):
            mine = [j for j, error in enumerate(errors) if error.robot == node.robot]
            T[i][:, mine] = node.T
        previous, steps = (
            np.array(column) for column in ([x.previous for x in self.nodes], [x.step for x in self.nodes])
        )
        for i in (i for i, node in enumerate(self.nodes) if not node.known and node.previous >= 0):
            steps[i] = relative_pose(poses[previous[i]], poses[i])
        return motions(previous, steps, columns.matrix(q * n), columns.kinds, T.reshape(q * n, -1), tuple(errors))

    def _kind(self, node: int, kind: str) -> str:
        """Return the kind of the errors before a node, which is `kind` between two of them."""
        return START if self.nodes[node].previous < 0 else kind if self.nodes[node].known else UNKNOWN

    def poses(self, nodes: Ints, known: Array) -> Array:
        """Return the poses `known` (S, size) of some nodes (S,), and those of all others chained on from them."""
        poses = np.full((len(self.nodes), known.shape[1]), np.nan)
        poses[nodes] = known
        for i, node in enumerate(self.nodes):
            if np.isnan(poses[i, 0]):
                poses[i] = sensor_pose(
                    ORIGIN[known.shape[1]] if node.previous < 0 else poses[node.previous], node.step
                )[0]
        return poses


class _Columns:
    """Gathers the columns of a sparse root, each with the kind of error that it is."""

    def __init__(self) -> None:
        self.kinds: list[str] = []
        self.entries: list[tuple[int, int, float]] = []

    def new(self, kind: str) -> int:
        self.kinds.append(kind)
        return len(self.kinds) - 1

    def put(self, row: int, G: Array, columns: list[int]) -> None:
        self.entries += [(row + i, columns[j], G[i, j]) for i, j in np.argwhere(G).tolist()]

    def add(self, row: int, G: Array, kind: str) -> None:
        some = np.flatnonzero(G.any(axis=0))
        self.put(row, G[:, some], [self.new(kind) for _ in some])

    def matrix(self, rows: int) -> sp.csr_array:
        row, column, value = zip(*self.entries, strict=True) if self.entries else ((), (), ())
        return sp.csr_array(sp.coo_array((value, (row, column)), shape=(rows, len(self.kinds))))


def relative_pose(a: Array, b: Array) -> Array:
    """Return the pose b in the frame of a."""
    back = frames.inverse(a) if len(a) == 3 else frames3d.inverse(a)
    return sensor_pose(back[0], b)[0]


def root(N: Array) -> Array:
    """Return G (..., k, k) with G G' = N, of a diagonal N its root, columns of zeros for errors that are zero."""
    if N.ndim == 2 and not (N - np.diag(N.diagonal())).any():
        return np.diag(np.sqrt(N.diagonal()))
    values, vectors = np.linalg.eigh(N)
    values[values <= ZERO * values.max(axis=-1, keepdims=True, initial=0.0)] = 0.0
    return np.asarray(vectors * np.sqrt(values)[..., None, :])
