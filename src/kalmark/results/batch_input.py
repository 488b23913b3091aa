"""Turn a run and the log it was made from into the least-squares problem of the same data.

The log is replayed through the same clock as in the filter (`kalmark.slam.motion`), and of the observations exactly
those are taken that the filter used: the associated ones, and those that started a landmark.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from kalmark.errors import KalmarkError
from kalmark.events import Control, Event, Fix, Id, Scan
from kalmark.models.landmarks import Point2D, Point3D
from kalmark.models.observe import composed, inverse_expectation, view_of
from kalmark.models.protocols import FullSensor, NonAdditiveSensor, Sensor
from kalmark.results.batch_course import Course
from kalmark.results.batch_factors import Factor, Positions, Sightings, State, block_matrix
from kalmark.results.batch_problem import Problem
from kalmark.results.batch_rows import ORIGIN, SPACES
from kalmark.results.history import History, as_id
from kalmark.slam.prediction import bias_block
from kalmark.tracks.checks import measurements

if TYPE_CHECKING:
    from kalmark.results.run import Run
    from kalmark.tracks.robot import Mount

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Known = Mapping[Id, tuple[Any, Any]]


@dataclass(frozen=True, eq=False)
class Input:
    """A problem, where to start from, the points' ids, and the node (S,) at which each step of the run ended."""

    problem: Problem
    start: State
    ids: list[Id]
    nodes: Ints


def batch_input(run: Run, events: Iterable[Event], known: Known | None = None) -> Input:
    """Return the problem of a run: the motion and fixes of `events`, the observations that the filter used.

    `known` gives the landmarks that were in the map beforehand, id: (mean, covariance or None for exactly).
    Raises KalmarkError for what is not poses and points, or if the events are not those of the run.
    """
    if run.fixes_rejected:
        raise KalmarkError(
            f"batch solution: the filter rejected {run.fixes_rejected} fixes, expected a run that used all"
        )
    replay = _Replay(run, known or {})
    for event in events:
        replay.take(event)
    return replay.input()


class _Replay:
    """Replays the events and gathers nodes, motions and sightings."""

    def __init__(self, run: Run, known: Known) -> None:
        self.run, self.history = run, run.history
        slam = run.final_slam()
        self.robots = slam.robots
        self.previous: list[int] = []
        self.steps: list[Array] = []
        self.Q: list[Array] = []
        self.shared: list[tuple[int, int, Array]] = []  # node, number of the split control, d w / d root
        self.roots: list[Array] = []
        self.sighted: dict[tuple[str, str], list[tuple[int, str, Array, Array]]] = {}
        self.fixes: list[tuple[int, Fix]] = []
        self.nodes = np.full(len(self.history.t_ns), -1, dtype=np.int64)
        self.step = 0
        self.size = 7 if self.history.in_space else 3
        self.q, self.point = SPACES[self.size].dof, Point3D() if self.history.in_space else Point2D()
        self.used = _used(self.history)
        self.points = {str(i): mean for i, mean in zip(run.landmarks.ids, run.landmarks.means, strict=True)}
        self.priors = {str(name): prior for name, prior in known.items()}
        self.fresh: set[str] = set()
        starts = {s.robot: (s.mean, s.covariance) for s in self.history.starts}
        self.courses: dict[str, Course] = {}
        for name, robot in self.robots.items():
            if bias_block(robot.motion) is not None:
                raise KalmarkError(f"batch solution: the bias of {name!r} is in the map, expected controls without one")
            exactly = np.zeros((robot.motion.space.dof,) * 2)
            mean, P = starts.get(name, (robot.start, exactly if robot.cov is None else robot.cov))
            self.courses[name] = Course(robot, self._new_node(-1, np.array(mean), np.array(P)))

    def take(self, event: Event) -> None:
        """Replay one event; scans that are no step of the run (refused, or after it stopped) change nothing."""
        if event.robot not in self.courses:
            return
        if isinstance(event, Control):
            course = self.courses[event.robot]
            if event.u.shape == (len(course.motion.columns),):
                for part in course.drive.accept(event):
                    course.add(part, self.roots)
        elif isinstance(event, Fix):
            if len(self.fixes) < self.run.fixes:
                self.fixes.append((self._node_at(event.robot, event.t_ns), event))
        elif self.step < len(self.nodes) and (event.t_ns, event.robot) == (
            self.history.t_ns[self.step],
            self.history.robot[self.step],
        ):
            self._scan(event)

    def _scan(self, scan: Scan) -> None:
        node = self._node_at(scan.robot, scan.t_ns)
        self.nodes[self.step] = node
        rows = self.used.get(self.step, [])
        self.step += 1
        if not rows:
            return
        mount = self.robots[scan.robot].sensors[scan.sensor]
        R = self._noise(scan, mount.sensor, rows)
        for k, row in enumerate(rows):
            index, landmark = int(self.history.index[row]), str(self.history.landmark[row])
            if landmark in self.courses:
                self._node_at(landmark, scan.t_ns)
                landmark = f"\0{self.courses[landmark].node}"  # no id begins so
            else:
                self._check(landmark, self.history.outcome[row] != "associated")
            if self.history.sensor[row] != scan.sensor or index >= len(scan.y):
                raise KalmarkError(
                    f"batch solution: scan at t={scan.t_s:.9g} s is not the one of the run, expected its log"
                )
            seen = self.sighted.setdefault((scan.robot, scan.sensor), [])
            seen.append((node, landmark, scan.y[index], R[k]))

    def _noise(self, scan: Scan, sensor: Sensor, rows: list[int]) -> Array:
        """Return the noise R of a scan's used rows as in the filter: where it varies, that of what was expected."""
        index = self.history.index[rows]
        R = measurements(scan, sensor)
        if scan.cov is not None or not isinstance(sensor, NonAdditiveSensor) or sensor.additive:
            return R[index]
        y, e = scan.y[index], self.history.e[rows][:, : len(sensor.columns)]
        e = np.where(np.isnan(e), y, e)  # a new landmark is expected where it is seen
        if isinstance(sensor, FullSensor):
            return sensor.noise_at(sensor.invert(e)[0])
        if hasattr(sensor, "code"):
            return sensor.noise(e)
        raise KalmarkError(
            f"batch solution: the noise of {type(sensor).__name__} is not additive, expected one that is"
        )

    def _check(self, landmark: str, new: bool) -> None:
        """Refuse a landmark that was in the map beforehand with a covariance nobody tells."""
        if new:
            self.fresh.add(landmark)
        elif landmark not in self.fresh and landmark not in self.priors:
            known = dict(zip(map(str, self.run.landmarks.ids), self.run.landmarks.covariances, strict=True))
            if known.get(landmark, np.ones(1)).any():
                raise KalmarkError(
                    f"batch solution: landmark {landmark!r} was in the map beforehand, expected its mean and covariance"
                    " in `known`"
                )
            self.priors[landmark] = (self.points[landmark], None)

    def _node_at(self, robot: str, t_ns: int) -> int:
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

    def _new_node(self, previous: int, step: Array, Q: Array) -> int:
        self.previous.append(previous)
        self.steps.append(step)
        self.Q.append(Q)
        return len(self.steps) - 1

    # ------------------------------------------------------------------ the problem
    def input(self) -> Input:
        """Return the problem of all that was replayed."""
        if self.step < len(self.nodes):
            t_s = self.history.t_ns[self.step] * 1e-9
            raise KalmarkError(f"batch solution: the log has no scan at t={t_s:.9g} s, expected the log of the run")
        names = self._names()
        n, d = len(self.steps), self.point.space.dof
        place = {name: n + k for k, name in enumerate(names)} | {f"\0{k}": k for k in range(n)}
        factors: list[Factor] = []
        for (robot, sensor), seen in self.sighted.items():
            kept = [s for s in seen if s[1] in place]
            if kept:
                factors.append(self._sightings(f"{robot}.{sensor}", self.robots[robot].sensors[sensor], kept, place))
        factors += self._positions(place)
        fixed = np.array([name in self.priors and self.priors[name][1] is None for name in names], dtype=np.bool_)
        Q = self._covariance()
        problem = Problem(np.array(self.previous), np.array(self.steps), Q, tuple(factors), fixed)
        poses = self._start()
        ids = {str(i): i for i in self.run.landmarks.ids}
        points = np.array([self._point(name, poses) for name in names]).reshape(-1, d)
        return Input(problem, State(poses, points), [ids.get(name, as_id(name)) for name in names], self.nodes)

    def _names(self) -> list[str]:
        """Return the landmarks.  One that was measured by fewer numbers than it has says nothing and is left out."""
        numbers: dict[str, int] = {}
        for _, name, y, _ in (s for seen in self.sighted.values() for s in seen):
            numbers[name] = numbers.get(name, 0) + len(y)
        least = self.point.space.dof
        return [l for l, k in numbers.items() if not l.startswith("\0") and (k >= least or l in self.priors)]

    def _sightings(
        self, name: str, mount: Mount, seen: list[tuple[int, str, Array, Array]], place: dict[str, int]
    ) -> Sightings:
        if mount.cov is not None:
            raise KalmarkError(f"batch solution: mount {name!r} is in the map, expected mounts that are known")
        view = view_of(mount.sensor, self.point, np.array(mount.at, dtype=np.float64))
        node, target = np.array([s[0] for s in seen]), np.array([place[s[1]] for s in seen])
        return Sightings(view, node, target, np.array([s[2] for s in seen]), np.array([s[3] for s in seen]))

    def _positions(self, place: dict[str, int]) -> list[Factor]:
        """Return the factors of the fixes and of the landmarks known with a covariance."""
        given = [(node, fix.y, fix.cov) for node, fix in self.fixes]
        given += [
            (place[name], np.asarray(mean, dtype=np.float64), np.asarray(cov, dtype=np.float64))
            for name, (mean, cov) in self.priors.items()
            if name in place and cov is not None
        ]
        if not given:
            return []
        target, y, R = zip(*given, strict=True)
        return [Positions(np.array(target), np.array(y), np.array(R))]

    def _covariance(self) -> sp.csr_array:
        """Return Q of all steps, with the blocks between those that share a held control's error."""
        n, q = len(self.steps), self.q
        Q = block_matrix([(q * np.arange(n), q * np.arange(n), np.array(self.Q))], (q * n, q * n))
        if not self.shared:
            return Q
        first = np.cumsum([0, *(root.shape[1] for root in self.roots)])
        blocks = [(np.array([q * node]), first[[key]], S[None]) for node, key, S in self.shared]
        G = block_matrix(blocks, (q * n, int(first[-1])))
        return sp.csr_array(Q + G @ G.T)

    def _start(self) -> Array:
        """Return the filter's poses at the nodes, chained on where a robot had no scan of its own."""
        poses = np.full((len(self.steps), self.size), np.nan)
        poses[self.nodes] = self.history.poses
        for i, previous in enumerate(self.previous):
            if np.isnan(poses[i, 0]):
                poses[i] = composed(ORIGIN[self.size] if previous < 0 else poses[previous], self.steps[i])[0]
        return poses

    def _point(self, name: str, poses: Array) -> Array:
        """Return where the run's map, or else its first sighting, puts a landmark."""
        if name in self.priors:
            return np.asarray(self.priors[name][0], dtype=np.float64)
        if name in self.points:
            size = self.point.space.size
            if self.points[name].shape != (size,) or not np.isfinite(self.points[name]).all():
                what = f"landmark {name!r} is at {self.points[name].tolist()}"
                raise KalmarkError(f"batch solution: {what}, expected a point of {size} finite numbers")
            return self.points[name]
        for (robot, sensor), seen in self.sighted.items():
            mount = self.robots[robot].sensors[sensor]
            for node, landmark, y, _ in seen:
                if landmark == name and isinstance(mount.sensor, FullSensor):
                    return inverse_expectation(poses[node], np.array(mount.at), mount.sensor, self.point, y[None])[0][0]
        raise KalmarkError(f"batch solution: landmark {name!r} is not in the run's map, expected a place to start from")


def _used(history: History) -> dict[int, list[int]]:
    """Return the rows of the observations that the filter used, by step."""
    rows: dict[int, list[int]] = {}
    for row in np.flatnonzero(history.fused):
        rows.setdefault(int(history.step[row]), []).append(int(row))
    return rows
