"""The history of a run: one row a step, one row an observation, and the map at some sixty instants.

A *step* is one scan and the controls before it; of a log without scans one fix, without fixes too one control.  Plain
arrays, saved as ``history.npz`` without pickle; rows of few are named tuples, each field an array in the file, vectors
and matrices of several sizes padded with NaN.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from itertools import chain, compress
from typing import Annotated, Any, NamedTuple, SupportsIndex, TypeVar, get_type_hints

import numpy as np
import numpy.typing as npt

from kalmark.arrays import Array, Flags, Index
from kalmark.events import Id, list_names
from kalmark.logs.log import Names, SensorKey
from kalmark.report import ELSEWHERE, Gap

__all__ = [
    "Biased", "CalibratedMount", "Camera", "Controlled", "History", "LandmarkChange", "MapSnapshot", "Measuring",
    "Prior", "RelocatedRobot", "Repeated", "RobotStart", "UsedFix",
]  # fmt: skip

Ints = Index
Texts = npt.NDArray[np.str_]
Arrays = dict[str, npt.NDArray[Any]]
Named = Mapping[str, npt.NDArray[Any]]
Vector = Annotated[Array, 1]
Matrix = Annotated[Array, 2]
Size = tuple[float, float]
R = TypeVar("R", bound=tuple[Any, ...])
K = TypeVar("K")
V = TypeVar("V")

TYPES: dict[Any, Any] = {int: np.int64, bool: np.bool_, float: np.float64, str: np.str_}


class Controlled(NamedTuple):
    """A robot's controls: how many, parts of an increment as one, and the times (ns) of the first and the last.

    >>> rover = km.Robot("rover", km.motion.Unicycle(), sensors={"lidar": km.Mount(km.sensors.RangeBearing())})
    >>> scan = km.Scan(0.1, "rover", "lidar", [[4.0, 0.3], [2.0, -1.0]], ids=[7, 8])
    >>> events = [km.Control(0.0, "rover", (0.5, 0.1)), scan]
    >>> run = km.record(km.Slam(rover), events, progress=False)
    >>> run.history.controls["rover"]
    Controlled(number=1, first_ns=0, last_ns=0)
    """

    number: float
    first_ns: int
    last_ns: int


class UsedFix(NamedTuple):
    """A fix that the filter was given: y (d,), innovation z (d,) and its covariance Z (d, d), d = 2 or 3.

    `used`: not rejected.  `moved_m` is how far the robot was moved, as the last fixes agreed that it was elsewhere.

    >>> rover = km.Robot("rover", km.motion.Unicycle(), cov=np.eye(3))
    >>> fix = km.Fix(t_s=0.1, robot="rover", y=(0.2, -0.1), cov=np.eye(2))
    >>> run = km.record(km.Slam(rover), [fix], progress=False)
    >>> run.history.fixes[0].used, run.history.fixes[0].z.round(2)
    (True, array([ 0.2, -0.1]))
    """

    t_ns: int
    robot: str
    used: bool
    y: Vector
    z: Vector
    Z: Matrix
    moved_m: float = 0.0

    @property
    def d2(self) -> float:
        """The normalised innovation squared."""
        return float(self.z @ np.linalg.solve(self.Z, self.z))


class RelocatedRobot(NamedTuple):
    """A robot that readings of a sensor placed elsewhere, as the last ones agreed on it: how far, m.

    `before` are the readings of that sensor that the filter used until then.

    >>> moved = RelocatedRobot(t_ns=12_000_000_000, robot="rover", sensor="receiver", moved_m=4.2, before=17)
    >>> f"{moved.robot} moved by {moved.moved_m} m at {moved.t_ns * 1e-9:g} s, after {moved.before} readings"
    'rover moved by 4.2 m at 12 s, after 17 readings'
    """

    t_ns: int
    robot: str
    sensor: str
    moved_m: float
    before: int


class LandmarkChange(NamedTuple):
    """The end of a landmark after the scan of a step: it was "removed", or "merged" with the one it is now.

    >>> change = LandmarkChange(step=40, landmark="17", what="merged", into="3", reason="d2 1.2")
    >>> f"{change.landmark} {change.what} into {change.into} after step {change.step}"
    '17 merged into 3 after step 40'
    """

    step: int
    landmark: str
    what: str
    into: str
    reason: str


class RobotStart(NamedTuple):
    """A robot before the first event: its name, mean and covariance, and the time of its first event.

    >>> rover = km.Robot("rover", km.motion.Unicycle(), sensors={"lidar": km.Mount(km.sensors.RangeBearing())})
    >>> scan = km.Scan(0.1, "rover", "lidar", [[4.0, 0.3], [2.0, -1.0]], ids=[7, 8])
    >>> events = [km.Control(0.0, "rover", (0.5, 0.1)), scan]
    >>> run = km.record(km.Slam(rover), events, progress=False)
    >>> run.history.starts[0].robot, run.history.starts[0].mean
    ('rover', array([0., 0., 0.]))
    """

    robot: str
    mean: Vector
    covariance: Matrix
    t_ns: int


class Prior(NamedTuple):
    """A landmark of a survey: its name, and its mean and covariance (0: known exactly) before the first event.

    >>> rover = km.Robot("rover", km.motion.Unicycle(), sensors={"lidar": km.Mount(km.sensors.RangeBearing())})
    >>> scan = km.Scan(0.1, "rover", "lidar", [[4.0, 0.3], [2.0, -1.0]], ids=[7, 8])
    >>> events = [km.Control(0.0, "rover", (0.5, 0.1)), scan]
    >>> slam = km.Slam(rover)
    >>> slam.add_landmark(7, mean=(4.0, 1.0), cov=0.01 * np.eye(2))
    >>> run = km.record(slam, events, progress=False)
    >>> [(prior.landmark, prior.mean, float(prior.covariance[0, 0])) for prior in run.history.priors]
    [('7', array([4., 1.]), 0.01)]
    """

    landmark: str
    mean: Vector
    covariance: Matrix


WHOLE = 16  # a correlation of 1 in a map that is kept
NONE: Any = np.zeros((0, 0), dtype=np.int8)


class MapSnapshot(NamedTuple):
    """The landmarks of the map after step `step`: ids, places (K, n) and their covariances (K, q, q), kinds.

    In the plane places are positions.  In space they are positions, endpoints of lines or poses of tags, padded with
    NaN (see `kalmark.results.landmark_table`).  `shape` (K, q, q) are the
    covariances without the motion of the world in common (`kalmark.results.gauge`), `robots` (R, d, d) those of the
    robots' positions, in the order of their starts.  `correlations` (n, n) are those of all numbers of robots and
    landmarks, as parts of `WHOLE`; (0, 0) of a large map.

    >>> rover = km.Robot("rover", km.motion.Unicycle(), sensors={"lidar": km.Mount(km.sensors.RangeBearing())})
    >>> scan = km.Scan(0.1, "rover", "lidar", [[4.0, 0.3], [2.0, -1.0]], ids=[7, 8])
    >>> events = [km.Control(0.0, "rover", (0.5, 0.1)), scan]
    >>> run = km.record(km.Slam(rover), events, progress=False)
    >>> last = run.history.maps[-1]
    >>> last.ids, last.means.shape, last.covariances.shape, last.kinds
    ((7, 8), (2, 2), (2, 2, 2), ('point', 'point'))
    """

    step: int
    t_ns: int
    ids: tuple[Id, ...]
    means: Array
    covariances: Array
    kinds: Names
    shape: Array
    robots: Array
    correlations: Array = NONE


class Camera(NamedTuple):
    """A camera of a robot: its mount (7,), the image's width and height in pixels, and what its rows of y are.

    `corners` (4, 3) are the rays to the image's corners with z = 1, for drawing.

    >>> eye = km.Mount(km.sensors.PinHole(), at=(0, 0, 0, 0, 0, 0, 1))
    >>> slam = km.Slam(km.Robot("drone", km.motion.Odometry3D(), sensors={"eye": eye}))
    >>> run = km.record(slam, [km.Scan(0.0, "drone", "eye", [[320.0, 240.0]], ids=[1])], progress=False)
    >>> run.history.cameras[0].size, run.history.cameras[0].columns
    ((640.0, 480.0), ('u_px', 'v_px'))
    """

    robot: str
    sensor: str
    mount: Vector
    size: Size
    columns: Names
    corners: Matrix


class Measuring(NamedTuple):
    """A sensor of a robot that is no camera, and what its rows of y are.

    >>> rover = km.Robot("rover", km.motion.Unicycle(), sensors={"lidar": km.Mount(km.sensors.RangeBearing())})
    >>> scan = km.Scan(0.1, "rover", "lidar", [[4.0, 0.3], [2.0, -1.0]], ids=[7, 8])
    >>> events = [km.Control(0.0, "rover", (0.5, 0.1)), scan]
    >>> run = km.record(km.Slam(rover), events, progress=False)
    >>> run.history.sensors
    (Measuring(robot='rover', sensor='lidar', columns=('range_m', 'bearing_rad')),)
    """

    robot: str
    sensor: str
    columns: Names


class CalibratedMount(NamedTuple):
    """A sensor that calibrates itself: its name in the map, and its mount (3,) or (7,) at the end.

    `covariance` at the end and `prior`, that before the first event, (3, 3) or (6, 6), are in the robot's frame.  The
    `constants` of the sensor itself follow where they are in the map, too.

    >>> mount = km.Mount(km.sensors.RangeBearing(), at=(0.2, 0.0, 0.0), cov=np.diag([0.01, 0.01, 0.001]))
    >>> slam = km.Slam(km.Robot("rover", km.motion.Unicycle(), sensors={"lidar": mount}))
    >>> run = km.record(slam, [km.Scan(0.1, "rover", "lidar", [[4.0, 0.3]], ids=[7])], progress=False)
    >>> run.history.mounts[0].name, run.history.mounts[0].mean
    ('rover.lidar', array([0.2, 0. , 0. ]))
    """

    name: str
    mean: Vector
    covariance: Matrix
    prior: Matrix
    constants: Names = ()


class Biased(NamedTuple):
    """The constants of a robot's controls at the end: their names `columns`, `mean` (c,) and covariance (c, c).

    >>> rover = km.Robot("rover", km.motion.Unicycle(sigma_v_bias_mps=0.05))
    >>> run = km.record(km.Slam(rover), [km.Control(t, "rover", (0.5, 0.1)) for t in (0.0, 0.1)], progress=False)
    >>> run.history.biases[0].columns, run.history.biases[0].covariance.round(4)
    (('v_mps',), array([[0.0025]]))
    """

    robot: str
    columns: Names
    mean: Vector
    covariance: Matrix


class Repeated(NamedTuple):
    """A pair of landmarks, the older one first, of the repeat `number` in the map at the end: they seem to be one.

    `shift` (2,) [m] and `turn_rad` move the older part of the map onto the newer one, in the middle of them; `score`
    is the log-likelihood ratio of all its pairs against chance, `p` how many such repeats are expected by chance.

    >>> pair = Repeated(1, "3", "41", shift=np.array([0.4, -0.2]), turn_rad=0.02, score=35.0, p=1e-9)
    >>> f"{pair.landmark} and {pair.other} seem to be one, {np.hypot(*pair.shift):.2f} m apart"
    '3 and 41 seem to be one, 0.45 m apart'
    """

    number: int
    landmark: str
    other: str
    shift: Vector
    turn_rad: float
    score: float
    p: float


ROWS: dict[
    str, tuple[str, Any, bool]
] = {  # fields of a history: their prefix in the file, and whether texts are joined
    "changes": ("change", LandmarkChange, False),
    "fixes": ("used_fix", UsedFix, False),
    "placed": ("placed", RelocatedRobot, False),
    "starts": ("start", RobotStart, False),
    "priors": ("prior", Prior, False),
    "cameras": ("camera", Camera, True),
    "sensors": ("measuring", Measuring, True),
    "mounts": ("mount", CalibratedMount, True),
    "biases": ("bias", Biased, True),
    "gaps": ("gap", Gap, False),
    "repeats": ("repeat", Repeated, False),
}


@dataclass(frozen=True, eq=False)
class History:
    """A run's steps (S of them) and observations (O of them).

    Steps: time, robot, its mean (S, n) and covariance (S, q, q) after the scan, its state `dead_reckoned` (S, n) by
    its controls alone, NaN without any, and the wall time in microseconds.
    Observations: `step` is the row of the step, `id`, `landmark` and `true_id`, which the log has and the filter may
    not, are texts ("" for none), `kind` is that of the landmark after the scan, `d2` is NaN where there is none;
    measured `y` and expected `e` (O, m), innovation `z` (O, p) and its covariance `Z` (O, p, p).  All are padded with
    NaN where robots or sensors differ in size.  `late` (O,) marks the tentative ones that were fused when their
    landmark was confirmed.  `left_px` (O,) is the error of the corners of tags after the scan
    (`kalmark.results.filter_description.residual_px`).  `noise` (O, p) are the sigmas stated of z, NaN where they
    are not of its numbers.  `seen_at` (O, d) is the place of each observation without an id by the pose before the
    scan, NaN where its sensor measures none.

    Observations `candidate_row` (C,) were compared with landmarks, `candidate_landmark` (C,), of distance
    `candidate_d2` (C,), that were at `candidate_place` (C, d) in the map; `share_row` (W,) were averaged over landmarks
    `share_landmark` with weights `share_weight`.

    Of some 500 scans spread over the run, `unmeasured_step` (U,) are the steps of landmarks that should be in view
    of the sensor `unmeasured_sensor` and were not measured, at most 32 in a scan, the most certain ones:
    `unmeasured_landmark`, their kinds, expectations `unmeasured_e` (U, m) before the scan and the covariances
    `unmeasured_Z` (U, p, p) that their innovations would have had.

    `stepped` is what ends a step, "scan", or "fix" or "control" of a log without any scan.

    `changes` is what became of landmarks, `fixes` are those used, in the order they came, `controls` those of each
    robot that had any, `gaps` the times without, `repeats` pairs of landmarks that seem to be one.  `priors` are the
    landmarks that were surveyed.

    >>> rover = km.Robot("rover", km.motion.Unicycle(), sensors={"lidar": km.Mount(km.sensors.RangeBearing())})
    >>> scan = km.Scan(0.1, "rover", "lidar", [[4.0, 0.3], [2.0, -1.0]], ids=[7, 8])
    >>> events = [km.Control(0.0, "rover", (0.5, 0.1)), scan]
    >>> run = km.record(km.Slam(rover), events, progress=False)
    >>> run.history.poses.round(3), run.history.outcome.tolist(), run.history.y.shape
    (array([[0.05, 0.  , 0.01]]), ['new', 'new'], (2, 2))
    """

    t_ns: Ints
    robot: Texts
    mean: Array
    covariance: Array
    dead_reckoned: Array
    step_us: Array
    step: Ints
    sensor: Texts
    index: Ints
    id: Texts
    outcome: Texts
    landmark: Texts
    d2: Array
    reason: Texts
    y: Array
    e: Array
    z: Array
    Z: Array
    kind: Texts
    left_px: Array
    true_id: Texts
    late: Flags
    noise: Array
    seen_at: Array
    candidate_row: Ints
    candidate_landmark: Texts
    candidate_d2: Array
    candidate_place: Array
    share_row: Ints
    share_landmark: Texts
    share_weight: Array
    unmeasured_step: Ints
    unmeasured_sensor: Texts
    unmeasured_landmark: Texts
    unmeasured_kind: Texts
    unmeasured_e: Array
    unmeasured_Z: Array
    maps: tuple[MapSnapshot, ...] = ()
    controls: dict[str, Controlled] = field(default_factory=dict)
    changes: tuple[LandmarkChange, ...] = ()
    fixes: tuple[UsedFix, ...] = ()
    starts: tuple[RobotStart, ...] = ()
    priors: tuple[Prior, ...] = ()
    cameras: tuple[Camera, ...] = ()
    sensors: tuple[Measuring, ...] = ()
    mounts: tuple[CalibratedMount, ...] = ()
    biases: tuple[Biased, ...] = ()
    placed: tuple[RelocatedRobot, ...] = ()
    gaps: tuple[Gap, ...] = ()
    repeats: tuple[Repeated, ...] = ()
    stepped: str = "scan"

    def __repr__(self) -> str:
        return f"<History of {list_names(self.robots)}: {len(self.t_ns)} steps, {len(self.outcome)} observations>"

    @property
    def scans(self) -> int:
        """The number of scans."""
        return len(self.t_ns) if self.stepped == "scan" else 0

    @property
    def fused(self) -> Flags:
        """Flags (O,) of the observations that corrected or initialized blocks of the map."""
        return np.isin(self.outcome, ("associated", "new")) | self.late

    @property
    def of_own(self) -> Flags:
        """Flags (O,) of the readings of a robot itself, by a sensor of its state."""
        return np.asarray(self.landmark == self.observers)

    @property
    def observers(self) -> Texts:
        """The robots (O,) that made the observations."""
        return self.robot[self.step]

    def sensor_keys(self) -> list[SensorKey]:
        """Return the robot and the sensor of each observation (O of them)."""
        return list(zip(self.observers.tolist(), self.sensor.tolist(), strict=True))

    def made_by(self, robot: str, sensor: str) -> Flags:
        """Return which observations (O,) a sensor of a robot made."""
        return np.asarray((self.observers == robot) & (self.sensor == sensor))

    def reason_begins(self, starts: Iterable[str]) -> Flags:
        """Return which observations (O,) have a reason that begins with one of these texts."""
        return np.logical_or.reduce([np.char.startswith(self.reason, start) for start in starts])

    @property
    def localizes(self) -> bool:
        """True if each sensor that made observations read its own robot: no landmark is to be expected."""
        return len(self.sensor) > 0 and {*self.sensor.tolist()} == {*self.sensor[self.of_own].tolist()}

    def carried(self, *robots: str) -> list[Gap]:
        """Return when robots, or some of them, were elsewhere than the filter had them, until it found them."""
        return [gap for gap in self.gaps if gap.kind == ELSEWHERE and (not robots or gap.robot in robots)]

    def between(self, robot: str, start_ns: int, end_ns: float) -> Flags:
        """Return which steps (S,) are of a robot from a time on, before another."""
        return (self.robot == robot) & (self.t_ns >= start_ns) & (self.t_ns < end_ns)

    def associated_elsewhere(self) -> Flags:
        """Return at which steps (S,) a robot was not where its scan was associated; the scan that placed it counts."""
        out = np.zeros(len(self.t_ns), dtype=np.bool_)
        for gap in self.carried():
            out |= self.between(gap.robot, gap.start_ns, gap.end_ns + 1)
        return out

    @property
    def in_space(self) -> bool:
        """True if the robots move in space."""
        return self.mean.shape[1] > 6  # in the plane a state may have a velocity or a slip behind its pose

    @property
    def d(self) -> int:
        """The dimensions of the robots' world, 2 or 3."""
        return 3 if self.in_space else 2

    @property
    def poses(self) -> Array:
        """The poses after each scan, (S, 3) in the plane and (S, 7) in space."""
        return self.mean[:, : 7 if self.in_space else 3]

    @property
    def pose_covariances(self) -> Array:
        """The covariances of the poses, (S, 3, 3) or (S, 6, 6)."""
        q = 6 if self.in_space else 3
        return self.covariance[:, :q, :q]

    @property
    def t_s(self) -> Array:
        """The times (S,) of the steps in seconds since the first."""
        return (self.t_ns - self.t_ns[:1].sum()) * 1e-9

    def at_s(self, step: SupportsIndex) -> float:
        """Return the time of a step, s of the log."""
        return float(self.t_ns[step]) * 1e-9

    @property
    def robots(self) -> Names:
        """The robots in the order of their starts, then of their first scans."""
        return tuple(dict.fromkeys([s.robot for s in self.starts] + self.robot.tolist()))

    def map_at(self, step: int) -> MapSnapshot:
        """Return the last map that was kept up to a step; before the first there is nothing in it."""
        d = self.d
        nothing = MapSnapshot(step, 0, (), np.empty((0, d)), np.empty((0, d, d)), (), *np.empty((2, 0, d, d)))
        return next((m for m in reversed(self.maps) if m.step <= step), nothing)

    def robot_shape(self, steps: Ints) -> Array:
        """Return the covariances (K, d, d) of the robots' positions after steps (K,) that are of the shape of the map.

        They are those of the last map that was kept; before the first those in the world.
        """
        out, names = self.covariance[steps, : self.d, : self.d].copy(), [s.robot for s in self.starts]
        at = np.searchsorted([m.step for m in self.maps], steps, side="right") - 1
        for row, (k, step) in enumerate(zip(at.tolist(), steps.tolist(), strict=True)):
            if k >= 0 and self.robot[step] in names:
                out[row] = self.maps[k].robots[names.index(self.robot[step])]
        return out

    def arrays(self) -> Arrays:
        """Return everything as named arrays, those of the contract among them (t in seconds)."""
        named: Arrays = {"t": self.t_ns * 1e-9}
        named |= {name: vars(self)[name] for name in _array_fields()}
        kept: Any = zip(*self.maps, strict=True) if self.maps else [()] * len(MapSnapshot._fields)
        step, t_ns, ids, means, covariances, kinds, shapes, robots, correlations = kept
        sizes, width = [*map(len, ids)], max((block.shape[1] for block in covariances), default=2)
        named |= {
            "map_step": ints(step),
            "map_t_ns": ints(t_ns),
            "map_shape": pad_blocks(shapes, sizes, width, matrices=True),
            "map_robot": np.array(robots).reshape(len(step), -1 if step else 0, self.d, self.d),
            "map_size": ints(sizes),
            "map_landmark": texts([*chain(*ids)]),
            "map_kind": texts([*chain(*kinds)]),
            "map_mean": padded_all([*chain(*means)]),
            "map_covariance": pad_blocks(covariances, sizes, width, matrices=True),
            "map_order": ints([*map(len, correlations)]),
            "map_correlation": np.concatenate([NONE.ravel(), *(each.ravel() for each in correlations)]),
        }
        named["stepped"] = np.array(self.stepped, dtype=np.str_)
        named["control_robot"] = texts(list(self.controls))
        named["control_span"] = np.array(list(self.controls.values()), dtype=np.int64).reshape(-1, 3)
        for name, (prefix, cls, joined) in ROWS.items():
            named |= columns(prefix, cls, vars(self)[name], joined)
        return named

    @classmethod
    def from_arrays(cls, named: Named) -> History:
        """Return the history that `arrays` gave.  Raises KeyError if one is missing."""
        given: dict[str, Any] = {name: named[name] for name in _array_fields()}
        given |= {name: rows_of_arrays(prefix, kind, named, joined) for name, (prefix, kind, joined) in ROWS.items()}
        ends, keys = np.cumsum(named["map_size"])[:-1], ("mean", "covariance", "landmark", "kind", "shape")
        parts = zip(*(np.split(named[f"map_{key}"], ends) for key in keys), strict=True)
        orders = named["map_order"]
        flat = np.split(named["map_correlation"], np.cumsum(orders**2)[:-1])
        correlations = [part.reshape(n, n) for part, n in zip(flat, orders.tolist(), strict=False)]
        kept = named["map_step"].tolist(), named["map_t_ns"].tolist(), parts, named["map_robot"], correlations
        given["maps"] = tuple(
            MapSnapshot(
                step, t_ns, tuple(map(as_id, names.tolist())), means, covariances, tuple(kinds.tolist()), shape, *more
            )
            for step, t_ns, (means, covariances, names, kinds, shape), *more in zip(*kept, strict=False)
        )  # no map: one empty part
        spans = zip(named["control_robot"].tolist(), named["control_span"].tolist(), strict=True)
        given["stepped"] = str(named["stepped"])
        return cls(**given, controls={robot: Controlled(*span) for robot, span in spans})


def _array_fields() -> list[str]:
    return [f.name for f in fields(History) if f.name not in ("maps", "controls", "stepped", *ROWS)]


def grouped(rows: Iterable[V], key: Callable[[V], K]) -> dict[K, list[V]]:
    """Return rows by their keys, both in their order."""
    found: dict[K, list[V]] = {}
    for row in rows:
        found.setdefault(key(row), []).append(row)
    return found


def as_id(text: str) -> Id:
    """Return a landmark id from a file: a text that is an integer becomes one."""
    try:
        number = int(text)
    except ValueError:
        return text
    return number if str(number) == text else text


def columns(prefix: str, cls: type[R], rows: Sequence[R], joined: bool = False) -> Arrays:
    """Return the fields of named tuples as arrays "prefix_field".

    With `joined` their texts are one array "prefix", the texts of a row on lines, names of a tuple with commas between.
    """
    named: Arrays = {}
    lines: list[list[str]] = [[] for _ in rows]
    for k, (name, hint) in enumerate(get_type_hints(cls, include_extras=True).items()):
        values = [row[k] for row in rows]
        if joined and hint in (str, Names):
            for line, value in zip(lines, values, strict=True):
                line.append(value if hint is str else ",".join(value))
        elif hint in TYPES:
            named[f"{prefix}_{name}"] = np.array(values, dtype=TYPES[hint])
        else:
            dimensions = 1 if hint == Size else hint.__metadata__[0]
            named[f"{prefix}_{name}"] = padded_all([np.asarray(v, dtype=np.float64) for v in values], dimensions)
    return named | ({prefix: texts(["\n".join(line) for line in lines])} if joined else {})


def rows_of_arrays(prefix: str, cls: type[R], named: Named, joined: bool = False) -> tuple[R, ...]:
    """Return the rows that `columns` gave."""
    told: list[list[Any]] = []
    lines = iter(zip(*(text.split("\n") for text in named[prefix].tolist()), strict=True)) if joined else iter(())
    for name, hint in get_type_hints(cls, include_extras=True).items():
        if joined and hint in (str, Names):
            values: list[Any] = list(next(lines, ()))
            told.append([tuple(text.split(",")) if text else () for text in values] if hint == Names else values)
        elif hint in TYPES:
            told.append(named[f"{prefix}_{name}"].tolist())
        else:
            values = [_cut(value) for value in named[f"{prefix}_{name}"]]
            told.append([tuple(value.tolist()) for value in values] if hint == Size else values)
    return tuple(cls(*row) for row in zip(*told, strict=True))


def ints(values: Sequence[int]) -> Ints:
    """Return integers as an array (N,)."""
    return np.array(values, dtype=np.int64)


def floats(values: Sequence[Any]) -> Array:
    """Return numbers, or lists of so many each, as an array (N, ...), NaN for None."""
    return np.array(values, dtype=np.float64)


def texts(values: Sequence[Any]) -> Texts:
    """Return ids or names as an array of texts (N,), "" for None."""
    return np.array(["" if value is None else str(value) for value in values], dtype=np.str_)


def columns_of(rows: Sequence[tuple[Any, ...]], **kinds: Callable[[Sequence[Any]], Any]) -> dict[str, Any]:
    """Return the columns of rows by their names, each as the array that its kind makes of it."""
    values = zip(*rows, strict=True) if rows else [()] * len(kinds)
    return {name: kind(column) for (name, kind), column in zip(kinds.items(), values, strict=True)}


def pad_blocks(blocks: Sequence[Array], counts: list[int], width: int, matrices: bool = False) -> Array:
    """Stack blocks (K, m) or (K, m, m) of several sizes m, K by `counts`, padded with NaN; an empty one is all NaN."""
    out = np.full((sum(counts), width, width) if matrices else (sum(counts), width), np.nan)
    whole = [len(block) == count and block.size > 0 for block, count in zip(blocks, counts, strict=True)]
    for shape in {block.shape[1:] for block in compress(blocks, whole)}:
        mine = [use and block.shape[1:] == shape for block, use in zip(blocks, whole, strict=True)]
        rows: tuple[Any, ...] = (np.repeat(mine, counts), *(slice(m) for m in shape))
        out[rows] = np.concatenate([*compress(blocks, mine)])
    return out


def padded_all(values: Sequence[Array], dimensions: int = 1) -> Array:
    """Stack vectors or matrices of several sizes to (N, n) or (N, n, n), padded with NaN."""
    shape = [max(sizes) for sizes in zip(*(value.shape for value in values), strict=True)] or [2] * dimensions
    out = np.full((len(values), *shape), np.nan)
    for k, value in enumerate(values):
        out[k][tuple(slice(m) for m in value.shape)] = value
    return out


def _cut(value: Array) -> Array:
    """Return a vector or a matrix without the NaN it was padded with."""
    known = ~np.isnan(value)
    return value[known] if value.ndim == 1 else value[np.ix_(known.any(axis=1), known.any(axis=0))]
