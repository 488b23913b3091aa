"""Turn a log and the associations that a filter made in it into the least-squares problem of the same data.

The log is replayed through the same clock as in the filter (`kalmark.slam.held_control`).  Derivation and figures:
docs/batch.md.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, NamedTuple, TypeGuard

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

from kalmark.arrays import Array, Flags
from kalmark.batch.batch_state import FIRST_MOUNT, LANDMARKS, POSE_SPACES, POSES, BatchState, Ints, unsolvable_problem
from kalmark.batch.motion_chain import Chain, Starts
from kalmark.batch.problem import Block, Factor, Problem, between, motionless, observation_factor, positions
from kalmark.batch.wall_anchors import anchors
from kalmark.events import Control, Event, Fix, Id, Raw, Scan, kind_of, label_of_event, sort_events
from kalmark.geometry.frames import compose
from kalmark.geometry.spaces import mount_space
from kalmark.models.landmarks import Point2D, Wall2D
from kalmark.models.observe import inverse_expectation, view_of
from kalmark.models.protocols import (
    FullSensor,
    Landmark,
    NonAdditiveSensor,
    Ranging,
    Sensor,
    measures_blocks,
    sees_kinds,
)
from kalmark.models.walls import axes
from kalmark.slam.checks import measurements
from kalmark.slam.sources import RawDetector
from kalmark.tracks.channel import huber_length

if TYPE_CHECKING:
    from kalmark.slam.robot import Robot

Texts = npt.NDArray[np.str_]
Known = Mapping[Id, tuple[Any, Any]]
NONE = np.zeros(0, dtype=np.int64)
FIRMLY = 0.1  # of the noise of its distance is the sigma of where a wall is anchored


class BatchObservation(NamedTuple):
    """An observation: its node, what it is of (a landmark, None, or the node of a robot), y, R, and its number."""

    node: int
    target: Id | None
    y: Array
    R: Array
    row: int


class BetweenBlocks(NamedTuple):
    """An observation y (m,) of a sensor of blocks, noise R (m, m), `of` nodes of robots and landmarks, by group."""

    sensor: Any
    of: tuple[tuple[int, Any], ...]
    y: Array
    R: Array


@dataclass(frozen=True, eq=False)
class Associations:
    """The observations (O,) that count: number `index` of scan `scan` by `sensor`, of the landmark or robot `landmark`.

    One that is of None is read and not used.  `e` (O, m) is what was expected of it, NaN for nothing.
    """

    scan: Ints
    sensor: Texts
    index: Ints
    landmark: Sequence[Id | None]
    e: Array


@dataclass(frozen=True, eq=False)
class BatchInput:
    """Inputs of a batch solution beside the events: robots and their starts, associations, initial values.

    The S scans have the times `t_ns` (S,) and are of the `robot` (S,), `poses` (S, 3) or (S, 7) are the initial poses
    there.  `landmarks` has the initial means, of the type `landmark`, and covariances of those in the map.  Of the
    fixes the first `fixes` count, but for those `left_out`, by number.  `known` has what was in the map beforehand:
    (mean, covariance or None for exactly).

    Without `motion` each pose is on its own, but for those that share landmarks: of each such part without a landmark
    that is known exactly the first pose is held.  `mounts`, by robot and sensor, are the means of those that are not
    known: solved for where another sensor has observations at the same pose, else held.  Observations with whitened
    residuals beyond `huber` count less.

    `biases` are the constants (c,) of the controls of a robot.

    With `segments` (J, 2), from and to in ns, the events between them are left out, and so is how a robot came from one
    to the next.  Of sensors of blocks the observations `between` count, by time in ns, robot, sensor and number;
    landmarks that are `merged` are others.  `carried` are the times, in ns, by which a robot had come elsewhere in an
    unknown way.
    """

    robots: Mapping[str, Robot]
    landmark: Landmark
    t_ns: Ints
    robot: Texts
    poses: Array
    associations: Associations
    landmarks: Mapping[Id, tuple[Array, Array]]
    known: Known = field(default_factory=dict)
    starts: Starts = field(default_factory=dict)
    fixes: int = 0
    left_out: frozenset[int] = frozenset()
    motion: bool = True
    mounts: Mapping[tuple[str, str], Array] = field(default_factory=dict)
    huber: float = np.inf
    biases: Mapping[str, Array] = field(default_factory=dict)
    segments: Ints | None = None
    carried: Mapping[str, tuple[int, ...]] = field(default_factory=dict)
    between: frozenset[tuple[int, str, str, int]] = frozenset()
    merged: Mapping[str, Id] = field(default_factory=dict)

    def seen_by(self, sensor: Sensor) -> Landmark:
        """Return what a landmark is to a sensor: in a map with walls a point is the first two of three numbers."""
        beside = isinstance(self.landmark, Wall2D) and self.landmark.kind not in (sees_kinds(sensor) or ())
        return Point2D() if beside else self.landmark


def replay_events(given: BatchInput, events: Iterable[Event]) -> Problem:
    """Return the problem of the motion and fixes of `events` and the observations that are associated.

    Raises KalmarkError for what cannot be solved for, or if the events are not those of the associations.
    """
    return BatchReplay.of(given, events).problem()


def without_lags(given: BatchInput, events: Iterable[Event]) -> tuple[BatchInput, Iterable[Event]]:
    """Return scans with the times of what they show, where the stamps of their sensors are late by a known lag.

    Raises KalmarkError if a lag is not known, or if they have another order then.
    """
    mounts = {(name, key): mount for name, robot in given.robots.items() for key, mount in robot.sensors.items()}
    lags = {key: round(mount.lag_s * 1e9) for key, mount in mounts.items() if mount.lags}
    for robot, sensor in (key for key in lags if mounts[key].sigma_lag_s):
        raise unsolvable_problem(f"the lag of '{robot}.{sensor}' is in the map, expected lags that are known")
    if not lags:
        return given, events
    events, at = list(events), dict[tuple[int, str], list[int]]()
    for event in events:
        if isinstance(event, Scan | Raw):
            at.setdefault((event.t_ns, event.robot), []).append(lags.get((event.robot, event.sensor), 0))
    of_steps = [at[key].pop(0) if at.get(key) else 0 for key in zip(given.t_ns.tolist(), given.robot, strict=True)]
    t_ns = given.t_ns - np.array(of_steps, dtype=np.int64)
    if (np.diff(t_ns) < 0).any():
        raise unsolvable_problem("without their lags the scans have another order, expected the same")
    earlier = [
        replace(event, t_ns=event.t_ns - lags[kind_of(event)[1:]]) if kind_of(event)[1:] in lags else event
        for event in events
    ]
    return replace(given, t_ns=t_ns), sort_events(earlier)


class BatchReplay:
    """Replays the events and gathers nodes, motions and observations."""

    def __init__(self, given: BatchInput) -> None:
        self.given, self.known = given, given.known
        self.chain = Chain(given.robots if given.motion else {}, given.starts, given.biases)
        self.apart: dict[tuple[str, int], int] = {}  # nodes without motion, by robot and time
        self.observed: dict[tuple[str, str, int], list[BatchObservation]] = {}  # by robot, sensor and group
        self.fixes: list[tuple[int, Array, Array]] = []
        self.between: list[BetweenBlocks] = []
        self.fixed = 0  # fixes so far, with those that do not count
        self.nodes: list[int] = []
        self.segment: dict[str, int] = {}  # that a robot is in
        self.moved: dict[str, int] = {}  # how often it was carried until now
        self.varies: dict[tuple[str, str], bool] = {}  # whether the noise of a sensor does
        self.rows: dict[int, list[int]] = {}
        for row, scan in enumerate(given.associations.scan.tolist()):
            self.rows.setdefault(scan, []).append(row)

    @classmethod
    def of(cls, given: BatchInput, events: Iterable[Event]) -> BatchReplay:
        """Return the events replayed.  Raises KalmarkError if they are not those of the associations."""
        given, events = without_lags(given, events)
        replay = cls(given)
        for event in events:
            replay.take(event)
        if len(replay.nodes) < len(given.t_ns):
            t_s = given.t_ns[len(replay.nodes)] * 1e-9
            raise unsolvable_problem(f"the log has no scan at t={t_s:.9g} s, expected the log of the run")
        return replay

    def reassociated(
        self, landmark: Sequence[Id | None], poses: Array, landmarks: Mapping[Id, tuple[Array, Array]]
    ) -> BatchReplay:
        """Return it with other landmarks of the observations, and other initial poses (S, .) and landmarks."""
        other = copy(self)
        associations = replace(self.given.associations, landmark=landmark)
        other.given = replace(self.given, associations=associations, poses=poses, landmarks=landmarks)
        other.observed = {
            key: [one._replace(target=landmark[one.row]) for one in seen] if key[2] == LANDMARKS else seen
            for key, seen in self.observed.items()
        }
        return other

    def take(self, event: Event) -> None:
        """Replay one event; scans that are none of the given ones change nothing."""
        step, given = len(self.nodes), self.given
        if event.robot not in given.robots:
            return
        counts = self._counts(event)
        if isinstance(event, Control):  # it is in force where the next segment begins, too
            self.chain.take(event)
        elif not counts:
            return
        elif isinstance(event, Fix):
            self.fixed += 1
            if self.fixed <= given.fixes and self.fixed - 1 not in given.left_out:
                self.fixes.append((self._node(event.robot, event.t_ns), event.y, event.cov))
        elif step < len(given.t_ns) and (event.t_ns, event.robot) == (given.t_ns[step], given.robot[step]):
            self.nodes.append(self._node(event.robot, event.t_ns))
            if isinstance(event, Scan) and measures_blocks(given.robots[event.robot].sensors[event.sensor].sensor):
                self._between(event)
            if step in self.rows:
                self._scan(self._found(event), self.rows[step])

    def _between(self, scan: Scan) -> None:
        """Take the observations of a sensor of blocks that the filter used."""
        sensor: Any = self.given.robots[scan.robot].sensors[scan.sensor].sensor
        R = measurements(scan, sensor)
        for k, names in enumerate(scan.of or ((scan.robot,),) * len(scan.y)):
            if (scan.t_ns, scan.robot, scan.sensor, k) in self.given.between:
                of = tuple(
                    (POSES, self._node(str(name), scan.t_ns))
                    if name in self.given.robots
                    else (LANDMARKS, self.given.merged.get(str(name), name))
                    for name in names
                )
                self.between.append(BetweenBlocks(sensor, of, scan.y[k], R[k]))

    def _counts(self, event: Event) -> bool:
        """Return whether an event is in one of the segments; where a robot comes to the next one it is lost."""
        segments = self.given.segments
        moved = sum(t_ns <= event.t_ns for t_ns in self.given.carried.get(event.robot, ()))
        if self.moved.get(event.robot, 0) != moved:
            self.moved[event.robot] = moved
            self.chain.lose(event.robot)
        if segments is None:
            return True
        at = int(np.searchsorted(segments[:, 0], event.t_ns, side="right")) - 1
        if at < 0 or event.t_ns > segments[at, 1]:
            return False
        if self.segment.setdefault(event.robot, 0) != at:
            self.segment[event.robot] = at
            self.chain.lose(event.robot)
        return True

    def _node(self, robot: str, t_ns: int) -> int:
        if self.given.motion:
            return self.chain.node_at(robot, t_ns)
        return self.apart.setdefault((robot, t_ns), len(self.apart))

    def _found(self, event: Scan | Raw) -> Scan:
        """Return the scan of what the detector of a sensor, if it has one, found."""
        detector = self.given.robots[event.robot].sensors[event.sensor].detector
        if isinstance(event, Scan):
            return event if detector is None else detector(event)
        if not isinstance(detector, RawDetector):
            why = f"{event.sensor!r} searched its data where the filter expected landmarks"
            raise unsolvable_problem(
                f"{label_of_event(event)}: {why}, expected scans, or a detector that searches each by itself"
            )
        return detector.scan_of(event)

    def _scan(self, scan: Scan, rows: list[int]) -> None:
        used, node = self.given.associations, self.nodes[-1]
        mount, index = self.given.robots[scan.robot].sensors[scan.sensor], used.index[rows]
        if (used.sensor[rows] != scan.sensor).any() or (index >= len(scan.y)).any():
            raise unsolvable_problem(f"scan at t={scan.t_s:.9g} s is not the one of the run, expected its log")
        R = self._noise(scan, mount.sensor, rows)
        for row, y, R_row in zip(rows, scan.y[index], R, strict=True):
            target, group = used.landmark[row], LANDMARKS
            if isinstance(target, str) and target in self.given.robots:
                target, group = self._node(target, scan.t_ns), POSES
            self.observed.setdefault((scan.robot, scan.sensor, group), []).append(
                BatchObservation(node, target, y, R_row, row)
            )

    def _noise(self, scan: Scan, sensor: Sensor, rows: list[int]) -> Array:
        """Return the noise R of a scan's rows as in the filter: where it varies, that of what was expected."""
        used = self.given.associations
        R, y = measurements(scan, sensor)[used.index[rows]], scan.y[used.index[rows]]
        if scan.cov is not None or not self._varies(sensor, scan):
            return R
        e = used.e[rows][:, : len(sensor.columns)]
        e = np.where(np.isnan(e), y, e)  # a new landmark is expected where it is seen
        if isinstance(sensor, FullSensor):
            return sensor.noise_at(sensor.invert(e)[0])
        if isinstance(sensor, Ranging):
            return sensor.noise(e)
        raise unsolvable_problem(f"the noise of {type(sensor).__name__} is not additive, expected one that is")

    def _varies(self, sensor: Sensor, scan: Scan) -> TypeGuard[NonAdditiveSensor]:
        """Return whether the noise of a scan's sensor varies with the measurement; O(1) after its first scan."""
        key = scan.robot, scan.sensor
        if key not in self.varies:
            self.varies[key] = isinstance(sensor, NonAdditiveSensor) and not sensor.additive
        return self.varies[key]

    # ------------------------------------------------------------------ the problem
    def problem(self) -> Problem:
        """Return the problem of all that was replayed."""
        given, nodes = self.given, np.array(self.nodes, dtype=np.int64)
        size, space, names = given.poses.shape[1], given.landmark.space, self._names()
        if given.motion:
            poses = self.chain.poses(nodes, given.poses)
            motion = self.chain.motions(poses)
        else:
            poses, motion = np.empty((len(self.apart), size)), motionless(size)
            poses[nodes] = given.poses
        values = np.array([self._value(name, poses) for name in names]).reshape(-1, space.size)
        seen, mounts = self._observations({name: k for k, name in enumerate(names)})
        spaces = (POSE_SPACES[size], space, *(mount_space(size) for _ in mounts))
        state = BatchState(spaces, (poses, values, *(mean[None] for mean in mounts)))
        exactly = np.array([name in self.known and self.known[name][1] is None for name in names], dtype=np.bool_)
        held = NONE if given.motion else _first_poses(seen, len(poses), exactly)
        free = np.ones(state.ends[-1], dtype=np.bool_)
        for group, rows in ((POSES, held), (LANDMARKS, np.flatnonzero(exactly))):
            free[state.columns(group, rows)[:, None] + np.arange(state.spaces[group].dof)] = False
        if isinstance(given.landmark, Wall2D):
            anchored, points = self._anchors(seen, state)
            free[state.columns(LANDMARKS, points) + 2] = False
            seen += anchored
        kind = "tag" if given.landmark.kind == "tag" else "landmark"
        robots = [node.robot for node in self.chain.nodes] if given.motion else [robot for robot, _ in self.apart]
        others = *self._positions(names), *self._between_factors(names, state)
        return Problem(motion, (*seen, *others), free, state, names, nodes, robots, kind)

    def _names(self) -> list[Id]:
        """Return the landmarks.  One that was measured by fewer numbers than it has is left out."""
        numbers: dict[Id, int] = {}
        for (_, _, group), seen in self.observed.items():
            for one in seen if group == LANDMARKS else ():
                if one.target is not None:
                    numbers[one.target] = numbers.get(one.target, 0) + len(one.R)
        named = (name for one in self.between for group, name in one.of if group == LANDMARKS)
        numbers |= {name: 0 for name in named if name not in numbers}
        walls = isinstance(self.given.landmark, Wall2D)  # two numbers are measured of a wall, and two of a point
        least = 2 if walls else self.given.landmark.space.dof
        return [name for name, k in numbers.items() if k >= least or name in self.known]

    def _observations(self, at: Mapping[Id | None, int]) -> tuple[list[Factor], list[Array]]:
        """Return what each sensor saw and the means of the mounts to be solved for, in the order of their groups."""
        given, kept = self.given, {}
        for (robot, sensor, group), seen in self.observed.items():
            if given.robots[robot].sensors[sensor].cov is not None and (robot, sensor) not in given.mounts:
                raise unsolvable_problem(f"mount '{robot}.{sensor}' is in the map, expected mounts that are known")
            rows = [(*one[:1], at.get(one.target, -1) if group == LANDMARKS else one.target, *one[2:4]) for one in seen]
            columns = [np.array(column) for column in zip(*(row for row in rows if row[1] != -1), strict=True)]
            if columns:
                kept[robot, sensor, group] = columns
        at_once = np.bincount(np.concatenate([NONE, *(np.unique(node) for node, *_ in kept.values())]))
        free = [key[:2] for key, (node, *_) in kept.items() if key[:2] in given.mounts and (at_once[node] > 1).any()]
        groups = {name: FIRST_MOUNT + k for k, name in enumerate(dict.fromkeys(free))}
        factors, size = [], given.poses.shape[1]
        for (robot, sensor, group), (node, target, y, R) in kept.items():
            mount = given.robots[robot].sensors[sensor]
            mean = np.array(given.mounts.get((robot, sensor), mount.at), dtype=np.float64)
            landmark = given.seen_by(mount.sensor)
            blocks = [Block(POSES, node, POSE_SPACES[size]), Block(group, target, landmark.space)]
            if (robot, sensor) in groups:
                blocks.insert(1, Block(groups[robot, sensor], np.zeros_like(node), mount_space(size)))
            view = view_of(mount.sensor, landmark, mean)
            huber = given.huber if mount.robust is None else min(given.huber, huber_length(R.shape[1]))
            factors.append(observation_factor(view, tuple(blocks), y, R, huber, (robot, sensor)))
        return factors, [np.array(given.mounts[name], dtype=np.float64) for name in groups]

    def _anchors(self, seen: list[Factor], state: BatchState) -> tuple[list[Factor], Ints]:
        """Return the factors of where the anchors of walls are along them, and which landmarks are points.

        It is where the start has them, from the pose of their first observation.
        """
        found, points = [], np.ones(len(state.groups[LANDMARKS]), dtype=np.bool_)
        for factor in seen:
            of_pose, *_, of_wall = factor.term.blocks
            mount = self.given.robots[factor.sensor[0]].sensors[factor.sensor[1]]
            if of_wall.group != LANDMARKS or self.given.seen_by(mount.sensor) is not self.given.landmark:
                continue
            wall, first = np.unique(of_wall.rows, return_index=True)
            new = points[wall]
            wall, first = wall[new], first[new]
            points[wall] = False
            node, normal, at = of_pose.rows[first], factor.y[first, 1], np.tile(mount.at, (len(wall), 1))
            T = np.array([compose(pose, mount.at)[0] for pose in state.groups[POSES][node]]).reshape(-1, 3)
            along = axes(T[:, 2] + normal)[1]
            t = np.einsum("ki,ki->k", along, state.groups[LANDMARKS][wall, :2] - T[:, :2])
            R = (FIRMLY**2 * factor.R[first, 0, 0])[:, None, None]
            found.append(anchors(node, wall, self.given.landmark.space, at, normal, t, R))
        return found, np.flatnonzero(points)

    def _positions(self, names: list[Id]) -> list[Factor]:
        """Return the factors of the fixes and of the landmarks known with a covariance."""
        known = [(k, *self.known[name]) for k, name in enumerate(names) if name in self.known]
        given = ((POSES, self.fixes), (LANDMARKS, [row for row in known if row[2] is not None]))
        return [positions(group, *(np.array(c) for c in zip(*rows, strict=True))) for group, rows in given if rows]

    def _between_factors(self, names: list[Id], state: BatchState) -> list[Factor]:
        """Return the factors of sensors of blocks, one of each sensor and kinds of blocks."""
        at, found = {name: k for k, name in enumerate(names)}, dict[Any, list[Any]]()
        for sensor, of, y, R in self.between:
            rows = [at.get(target, -1) if group == LANDMARKS else target for group, target in of]
            if -1 not in rows:
                groups = tuple(group for group, _ in of)
                found.setdefault((id(sensor), groups), [sensor, []])[1].append((rows, y, R))
        factors = []
        for (_, groups), (sensor, seen) in found.items():
            of_rows, y, R = (np.array(part) for part in zip(*seen, strict=True))
            blocks = tuple(Block(g, of_rows[:, i], state.spaces[g]) for i, g in enumerate(groups))
            models = [self.given.landmark if g == LANDMARKS else None for g in groups]
            factors.append(between(sensor, blocks, models, y, R))
        return factors

    def _value(self, name: Id, poses: Array) -> Array:
        """Return where the map, or else its first observation, puts a landmark."""
        if name in self.known or name in self.given.landmarks:
            mean = np.asarray((self.known if name in self.known else self.given.landmarks)[name][0], dtype=np.float64)
            size = self.given.landmark.space.size
            if isinstance(self.given.landmark, Wall2D) and mean.shape == (2,):
                mean = np.append(mean, 0.0)  # a point
            if mean.shape != (size,) or not np.isfinite(mean).all():
                raise unsolvable_problem(
                    f"landmark {str(name)!r} is at {mean.tolist()}, expected a point of {size} finite numbers"
                )
            return mean
        for (robot, sensor, _), seen in self.observed.items():
            mount = self.given.robots[robot].sensors[sensor]
            for node, landmark, y, *_ in seen:
                if landmark == name and isinstance(mount.sensor, FullSensor):
                    at = np.array(mount.at)
                    seen_as = self.given.seen_by(mount.sensor)
                    place = inverse_expectation(poses[node], at, mount.sensor, seen_as, y[None])[0][0]
                    return np.append(place, np.zeros(self.given.landmark.space.size - len(place)))
        raise unsolvable_problem(f"landmark {str(name)!r} is not in the map, expected a place to start from")


def _first_poses(seen: list[Factor], n: int, exactly: Flags) -> Ints:
    """Return the first pose of each part of the observations that no landmark connects with the others, or the world.

    Landmarks known `exactly` (m,) are of the world.
    """
    node, target = (np.concatenate([f.term.blocks[k].rows for f in seen]) for k in (0, -1))
    links = sp.coo_array((np.ones(len(node)), (node, n + target)), shape=(n + len(exactly),) * 2)
    part = connected_components(links, directed=False)[1]
    found, first = np.unique(part[:n], return_index=True)
    return np.asarray(first[~np.isin(found, part[n:][exactly])], dtype=np.int64)
