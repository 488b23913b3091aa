"""A log: events in time order and, where the source has it, the truth to score against."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from kalmark.arrays import Array, Index
from kalmark.errors import LogError
from kalmark.events import Control, Event, Id, Raw, Scan, list_names
from kalmark.geometry.angles import wrap

Times = Index
Names = tuple[str, ...]  # of robots, of sensors, or of the columns of one
Section = dict[str, Any]  # a mapping of plain values, as a part of a configuration or another YAML file
LandmarkPlaces = dict[Id, Array]  # of landmarks
SensorKey = tuple[str, str]  # robot, sensor


@dataclass(frozen=True, eq=False)
class Trajectory:
    """The true poses of one robot; anything else than below raises LogError.

    `t_ns` (N,) is strictly increasing; `poses` is (N, 3) x y theta or (N, 7) x y z qx qy qz qw (m, rad; quaternions
    Hamilton, local to global).

    >>> true = Trajectory([0, 500_000_000], [[0.0, 0.0, 0.0], [1.0, 0.0, 0.2]])
    >>> true.at([250_000_000])
    array([[0.5, 0. , 0.1]])
    """

    t_ns: Times
    poses: Array

    def __post_init__(self) -> None:
        t_ns, poses = np.asarray(self.t_ns, dtype=np.int64), np.asarray(self.poses, dtype=np.float64)
        if poses.ndim != 2 or poses.shape[1] not in (3, 7) or t_ns.shape != poses.shape[:1] or len(t_ns) == 0:
            raise LogError(
                f"trajectory: t_ns has shape {t_ns.shape} and poses {poses.shape}, expected (N,) and (N, 3|7)"
            )
        if not np.isfinite(poses).all():
            raise LogError("trajectory: poses hold a value that is not finite, expected finite numbers")
        if not (np.diff(t_ns) > 0).all():
            first = int(np.argmin(np.diff(t_ns) > 0))
            raise LogError(f"trajectory: t_ns goes from {t_ns[first]} to {t_ns[first + 1]}, expected increasing times")
        object.__setattr__(self, "t_ns", t_ns)
        object.__setattr__(self, "poses", poses)

    @classmethod
    def of(cls, poses: Mapping[int, Any]) -> Trajectory:
        """Return the trajectory of poses (3,) or (7,) by their times (ns), which increase."""
        return cls(np.array([*poses]), np.array([*poses.values()]))

    def __len__(self) -> int:
        return len(self.t_ns)

    def at(self, t_ns: Any, max_gap_s: float = 0.5) -> Array:
        """Return the poses at these times (ns), shape (len(t_ns), 3|7), or one pose for one time.

        Positions are interpolated linearly, angles along the shorter arc, quaternions by slerp.  A row is NaN where
        its time lies outside the trajectory, or inside a gap longer than `max_gap_s`.
        """
        query = np.atleast_1d(np.asarray(t_ns, dtype=np.int64))
        before = np.clip(np.searchsorted(self.t_ns, query, side="right") - 1, 0, len(self) - 1)
        after = np.minimum(before + 1, len(self) - 1)
        exact = self.t_ns[before] == query
        gap = self.t_ns[after] - self.t_ns[before]
        inside = (query > self.t_ns[0]) & (query < self.t_ns[-1]) & (gap <= round(max_gap_s * 1e9))
        a = (query - self.t_ns[before]) / np.maximum(gap, 1)
        poses = interpolate(self.poses[before], self.poses[after], np.where(exact | ~inside, 0.0, a))
        poses[~(exact | inside)] = np.nan
        return poses[0] if np.ndim(t_ns) == 0 else poses


def interpolate(p: Array, q: Array, a: Array) -> Array:
    """Return the poses (N, 3|7) at the fractions `a` (N,) of the way from `p` to `q`; exactly `p` where a = 0."""
    out = p + a[:, None] * (q - p)
    if p.shape[1] == 3:
        out[:, 2] = p[:, 2] + a * wrap(q[:, 2] - p[:, 2])
    else:
        out[:, 3:] = slerp(p[:, 3:], q[:, 3:], a)
    return out


def slerp(p: Array, q: Array, a: Array) -> Array:
    """Return the quaternions (N, 4) at the fractions `a` of the shorter rotation from `p` to `q`."""
    cosine = np.sum(p * q, axis=1) / (np.linalg.norm(p, axis=1) * np.linalg.norm(q, axis=1))
    q = np.where(cosine[:, None] < 0, -q, q)
    angle = np.arccos(np.clip(np.abs(cosine), 0.0, 1.0))
    small = angle < 1e-6
    sine = np.where(small, 1.0, np.sin(angle))
    w_p = np.where(small, 1 - a, np.sin((1 - a) * angle) / sine)
    w_q = np.where(small, a, np.sin(a * angle) / sine)
    out: Array = w_p[:, None] * p + w_q[:, None] * q
    return np.where((a == 0)[:, None], p, out)


def poses_of_size(poses: Array, size: int) -> Array:
    """Return poses (N, 3) or (N, 7) as poses of the plane (size 3: seen from above) or of space (size 7: at z = 0)."""
    if poses.shape[1] == size:
        return poses
    if size == 3:
        x, y, z, w = poses[:, 3:].T
        yaw = np.arctan2(2.0 * (x * y + w * z), 1.0 - 2.0 * (y * y + z * z))  # where their x points
        return np.column_stack([poses[:, :2], yaw])
    flat, half = np.zeros(len(poses)), poses[:, 2] / 2
    return np.column_stack([poses[:, :2], flat, flat, flat, np.sin(half), np.cos(half)])


@dataclass(frozen=True, eq=False)
class PositionTrack:
    """Position fixes that only score a run.

    `t_ns` (N,); `xy` (N, 2) m in a frame of their own, of the antenna at `antenna` (2,) m in the robot's frame.

    >>> track = PositionTrack(t_ns=[0, 1_000_000_000], xy=[[0.0, 0.0], [1.0, 0.0]], antenna=[0.2, 0.0])
    >>> len(track), track.xy.shape
    (2, (2, 2))
    """

    t_ns: Times
    xy: Array
    antenna: Array

    def __post_init__(self) -> None:
        t_ns, xy = np.asarray(self.t_ns, dtype=np.int64), np.asarray(self.xy, dtype=np.float64)
        antenna = np.asarray(self.antenna, dtype=np.float64)
        if xy.shape != (*t_ns.shape, 2) or antenna.shape != (2,):
            raise LogError(
                f"position track: shapes are t_ns {t_ns.shape}, xy {xy.shape}, antenna {antenna.shape}, expected "
                "(N,), (N, 2), (2,)"
            )
        for name, value in (("t_ns", t_ns), ("xy", xy), ("antenna", antenna)):
            object.__setattr__(self, name, value)

    @classmethod
    def of(cls, rows: Sequence[tuple[int, Any]]) -> PositionTrack:
        """Return the track of times (ns) and positions with their antenna (4,), which is that of the first."""
        values = np.array([row for _, row in rows])
        return cls(np.array([t_ns for t_ns, _ in rows]), values[:, :2], values[0, 2:])

    def __len__(self) -> int:
        return len(self.t_ns)


@dataclass(frozen=True, eq=False)
class Log:
    """Hold one log: `events` sorted by `kalmark.events.sort_key`, and what is known to score them against.

    `truth` and `gps` are by robot, `landmarks` are by id: true positions (2,) or (3,) m, both ends of a line (6,) or
    the pose of a tag (7,) (all {} where unknown).  `skipped` has one line for each thing left out; `control_columns`
    (by robot) and `sensor_columns` (by robot and sensor) name what the numbers of a control and an observation are;
    `places` has the file and line where those of a sensor begin (of a robot's controls: sensor ""), if known.
    `describes` is the source's own description of the rig, its calibration, mounts, noise and start, in the shape of
    a configuration, which may overrule it.  `reference` has figures of other programs on this log, by program, named
    as in ``summary.json``.  `true_ids` has the landmarks of scans whose ids are hidden, to score the association.
    `options` are those it was opened with, as the section `log` of a configuration has them.

    >>> controls = {"t_s": [0.0, 0.1], "robot": ["rover"] * 2, "v_mps": [0.5, 0.5], "w_radps": [0.0, 0.1]}
    >>> log = km.log_from(controls=controls)
    >>> len(log), log.control_columns, log.truth
    (2, {'rover': ('v_mps', 'w_radps')}, {})
    >>> [control.u.tolist() for control in log.controls_of("rover")], log.sensors()
    ([[0.5, 0.0], [0.5, 0.1]], [])
    """

    name: str
    robots: Names
    events: list[Event]
    format: str = "native"
    path: Path | None = None
    truth: dict[str, Trajectory] = field(default_factory=dict)
    landmarks: LandmarkPlaces = field(default_factory=dict)
    gps: dict[str, PositionTrack] = field(default_factory=dict)
    skipped: list[str] = field(default_factory=list)
    control_columns: dict[str, Names] = field(default_factory=dict)
    sensor_columns: dict[SensorKey, Names] = field(default_factory=dict)
    places: dict[SensorKey, tuple[Path, int]] = field(default_factory=dict)
    describes: Section = field(default_factory=dict)
    reference: dict[str, dict[str, float]] = field(default_factory=dict)
    true_ids: dict[Scan, tuple[Id | None, ...]] = field(default_factory=dict)
    origin: Array | None = None
    options: Section = field(default_factory=dict)

    def __repr__(self) -> str:
        span = f" in {(self.events[-1].t_ns - self.events[0].t_ns) * 1e-9:.1f} s" if self.events else ""
        truth = ", with truth" if self.truth or self.landmarks else ""
        return f"<Log {self.name!r} of {list_names(self.robots)}: {len(self.events)} events{span}{truth}>"

    def __iter__(self) -> Iterator[Event]:
        return iter(self.events)

    def __len__(self) -> int:
        return len(self.events)

    def controls_of(self, robot: str) -> list[Control]:
        """Return the controls of a robot, in their order."""
        return [event for event in self.events if isinstance(event, Control) and event.robot == robot]

    def sensors(self) -> list[SensorKey]:
        """Return the robot and the sensor of every scan or raw data, each once, in the order of the first."""
        return [*dict.fromkeys((event.robot, event.sensor) for event in self.events if isinstance(event, Scan | Raw))]

    def refuse_columns(
        self, robot: str, sensor: str, columns: Names, of: str, near: Callable[[str, list[str]], str],
        hint: Callable[[Names], str] = lambda given: "",
    ) -> None:  # fmt: skip
        """Refuse other `columns` than those `of` a model, of a robot's controls (sensor "") or of its scans.

        The message ends with a `hint` at the columns given, else at the first missing one that is `near` one of them.
        Raises LogError.
        """
        given = tuple(self.sensor_columns[robot, sensor] if sensor else self.control_columns[robot])
        if given == columns:
            return
        missing = [name for name in columns if name not in given]
        meant = (near(name, missing) for name in given if name not in columns)
        where = f"{self.places[robot, sensor][0]}:1" if (robot, sensor) in self.places else self.path or "log"
        what = f"the scans of {robot} by {sensor}" if sensor else f"the controls of {robot}"
        wanted = f"{', '.join(columns)} of {of}{hint(given) or next(filter(None, meant), '')}"
        raise LogError(f"{where}: {what} have the columns {', '.join(given)}, expected {wanted}")

    def without_truth(self) -> Log:
        """Return the log without all that only scores a run: true poses, landmarks and ids, `gps`, `reference`."""
        return replace(self, truth={}, landmarks={}, gps={}, reference={}, true_ids={})


def begins_at(events: Iterable[Event], robot: str, held: bool) -> int | None:
    """Return the time (ns) at which a robot's first event begins, None if it has none.

    An increment is the motion that ended at its time, and began one interval (that to the next) before it.
    """
    mine = (event for event in events if event.robot == robot)
    first = next(mine, None)
    if first is None or held or not isinstance(first, Control):
        return None if first is None else first.t_ns
    second = next((event for event in mine if isinstance(event, Control)), first)
    return first.t_ns - round((second.t_ns - first.t_ns) * first.share / second.share)
