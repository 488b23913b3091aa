"""The report of `Slam.process`: the outcome of each observation and its reason."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import repeat
from typing import Any, NamedTuple

import numpy as np

from kalmark.arrays import Array, Flags, Index
from kalmark.errors import MapError
from kalmark.events import Event, Id, Scan, seconds_text
from kalmark.filter.estimators import Correction
from kalmark.geometry.gaussian import ellipses

__all__ = [
    "OUTCOMES", "Candidate", "Compared", "Expectations", "Gap", "JudgedScan", "LandmarkEstimate", "LandmarkTable",
    "Observation", "Repeat", "Report",
]  # fmt: skip

Late = tuple[int, str, str, int]
OUTCOMES = ("associated", "new", "rejected", "ignored", "deferred", "tentative")
"""Possible outcomes of an observation: `Observation.outcome`."""
ALONE = "measurement alone cannot start a landmark"
INDEFINITE = "the covariance of its innovation is not positive definite"
NOTHING = np.zeros((0, 0))
NOTHING.flags.writeable = False


class Observation(NamedTuple):
    """Result of an observation: `outcome` one of `OUTCOMES`, `landmark` its id in the map, `d2` its squared distance.

    `shares` are the landmarks over which a soft association averaged, each with its weight, the likeliest first.

    >>> rover = km.Robot("rover", km.motion.Unicycle(), sensors={"lidar": km.Mount(km.sensors.RangeBearing())})
    >>> scan = km.Scan(0.1, "rover", "lidar", [[4.0, 0.3], [2.0, -1.0]], ids=[7, 8])
    >>> events = [km.Control(0.0, "rover", (0.5, 0.1)), scan]
    >>> slam = km.Slam(rover)
    >>> reports = [slam.process(event) for event in events]
    >>> reports[-1].observations[0][:4]
    (0, 7, 'new', 7)
    """

    index: int  # type: ignore[assignment]  # of the observation in its scan; hides tuple.index
    id: Id | None
    outcome: str
    landmark: Id | None
    d2: float | None
    reason: str
    shares: tuple[tuple[Id, float], ...] = ()


class Candidate(NamedTuple):
    """A landmark that observation `index` was compared with: its squared distance and its place in the map.

    >>> rover = km.Robot("rover", km.motion.Unicycle(), sensors={"lidar": km.Mount(km.sensors.RangeBearing())})
    >>> slam = km.Slam(rover, association=km.association.NearestNeighbour())
    >>> slam.add_landmark(7, mean=(4.0, 1.0), cov=0.01 * np.eye(2))
    >>> report = slam.process(km.Scan(0.0, "rover", "lidar", [[4.12, 0.24]]))
    >>> [(one.index, one.landmark, round(one.d2, 2)) for one in report.candidates]
    [(0, 7, 0.03)]
    """

    index: int  # type: ignore[assignment]
    landmark: Id
    d2: float
    place: Array


class Compared(NamedTuple):
    """Compared pairs: observations (M,) with the `numbers` (M,) of landmarks (L,), and their squared distances (M,).

    `places` (L, 2 or 3) are those of the landmarks.

    >>> rover = km.Robot("rover", km.motion.Unicycle(), sensors={"lidar": km.Mount(km.sensors.RangeBearing())})
    >>> slam = km.Slam(rover, association=km.association.NearestNeighbour())
    >>> slam.add_landmark(7, mean=(4.0, 1.0), cov=0.01 * np.eye(2))
    >>> compared = slam.process(km.Scan(0.0, "rover", "lidar", [[4.12, 0.24]])).compared
    >>> compared.rows, compared.landmarks, compared.places
    (array([0]), [7], array([[4., 1.]]))
    """

    rows: Index
    numbers: Index
    landmarks: list[Id]
    d2: Array
    places: Array


class JudgedScan(NamedTuple):
    """The observations `rows` of a scan that were compared with landmarks, and what came of it; `ids` of all the scan.

    d2 is NaN where the covariance of the innovation is not positive definite, infinite where nothing can be expected.

    >>> rover = km.Robot("rover", km.motion.Unicycle(), sensors={"lidar": km.Mount(km.sensors.RangeBearing())})
    >>> slam = km.Slam(rover)
    >>> slam.add_landmark(7, mean=(4.0, 1.0), cov=0.01 * np.eye(2))
    >>> report = slam.process(km.Scan(0.0, "rover", "lidar", [[4.12, 0.24]], ids=[7]))
    >>> [(list(one.rows), list(one.names), one.done.fused) for one in report.judged]
    [([0], [7], array([ True]))]
    """

    rows: Sequence[int]
    ids: Sequence[Id | None]
    names: Sequence[Any]
    done: Correction
    gate: float


def outcomes_of(judged: JudgedScan) -> list[Observation]:
    """Return what became of each observation."""
    rows, ids, names, done, gate = judged
    d2, fused = done.d2.tolist(), done.fused.tolist()
    fates = zip(rows, [ids[k] for k in rows], repeat("associated"), names, d2, repeat(""), repeat(()), strict=False)
    outcomes = list(map(tuple.__new__, repeat(Observation), fates))  # several times as fast as by their constructor
    if all(fused):
        return outcomes
    return [seen if used else _rejected(seen, gate, Z) for seen, used, Z in zip(outcomes, fused, done.Z, strict=True)]


def _rejected(seen: Observation, gate: float, Z: Array) -> Observation:
    if seen.d2 is None or math.isnan(seen.d2):
        return seen._replace(outcome="rejected", d2=None, reason=INDEFINITE)
    if not np.isfinite(Z).all():
        return seen._replace(outcome="rejected", reason="nothing can be expected of it from here")
    far = "so far from what is expected that d2 is no number" if gate == math.inf else f"outside the gate of {gate:.2f}"
    return seen._replace(outcome="rejected", reason=far)


ELSEWHERE = "elsewhere"  # the kind of a gap in which a robot was carried


class Gap(NamedTuple):
    """A time in which the motion of a robot is unknown, so far.

    `kind` is "increments" (controls were lost), "held" (a velocity for too long), "ruled_out" (beyond its limits) or
    "elsewhere": its pose was wrong, and is changed by `sigma_m` and `sigma_rad`.

    The standard deviations are those of each coordinate and each angle that the pose was given for it.

    >>> gap = Gap("rover", "held", start_ns=2_000_000_000, end_ns=5_500_000_000, sigma_m=0.4, sigma_rad=0.1)
    >>> gap.lasts_s
    3.5
    """

    robot: str
    kind: str
    start_ns: int
    end_ns: int
    sigma_m: float
    sigma_rad: float

    @property
    def lasts_s(self) -> float:
        """Its duration."""
        return (self.end_ns - self.start_ns) * 1e-9


class Repeat(NamedTuple):
    """Landmarks (a, b) that seem to be one, the first of each pair in the older part: l_b = T l_a, T (3,).

    `middle` (2,) [m] is that of the newer ones, `shift` (2,) [m] what they are off by there.  `score` is the
    log-likelihood ratio of all pairs against chance, `p` how many such repeats are expected by chance in this map.
    `agrees`: the map's own covariance lets them be one.  `sure`: accepted by shape alone.

    >>> pairs = [(1, 21), (2, 22), (3, 23)]
    >>> found = Repeat(pairs, np.zeros(3), np.zeros(2), np.array([2.5, 0.5]), 40.0, 1e-9, True, True)
    >>> found.pairs[0], found.p < 1e-6, found.sure
    ((1, 21), True, True)
    """

    pairs: list[tuple[Id, Id]]
    T: Array
    middle: Array
    shift: Array
    score: float
    p: float
    agrees: bool
    sure: bool


@dataclass(frozen=True, eq=False)
class Expectations:
    """Expected measurements of landmarks (L of them) by a sensor of a robot, measured or not.  [S] 2.4, [TB] Obs.

    `in_view` (L,) marks those observable from its estimated pose, `why` is the reason of the others ("" of
    those in view).  e (L, m) is the expectation h(x), Z (L, p, p) the covariance that an innovation would have, with
    the noise of the sensor.  E_r (L, p, 3 or 6), E_s and E_p are the Jacobians in the robot's pose, in the mount,
    whether it is in the map or not, and in the parameters of the sensor that are in the map (none: 0 columns).  E_l
    (L, p, n) is the Jacobian in the landmark.  Of a sensor that measures its velocity E_s is NaN.  All are padded with
    NaN where landmarks differ in size, and NaN of what cannot be expected.

    >>> rover = km.Robot("rover", km.motion.Unicycle(), sensors={"lidar": km.Mount(km.sensors.RangeBearing())})
    >>> scan = km.Scan(0.1, "rover", "lidar", [[4.0, 0.3], [2.0, -1.0]], ids=[7, 8])
    >>> events = [km.Control(0.0, "rover", (0.5, 0.1)), scan]
    >>> slam = km.Slam(rover)
    >>> reports = [slam.process(event) for event in events]
    >>> expected = slam.expect("rover", "lidar")
    >>> expected.names, expected.e.round(2), expected.in_view
    ((7, 8), array([[ 4. ,  0.3],
           [ 2. , -1. ]]), array([ True,  True]))
    """

    robot: str
    sensor: str
    columns: tuple[str, ...]
    names: tuple[Id, ...]
    kinds: tuple[str, ...]
    in_view: Flags
    why: tuple[str, ...]
    e: Array
    Z: Array
    E_r: Array
    E_s: Array
    E_p: Array
    E_l: Array

    def __len__(self) -> int:
        return len(self.names)

    def row(self, name: Id) -> int:
        """Return the row of a landmark in all arrays.  Raises MapError if it is not among them."""
        if name not in self.names:
            raise MapError(f"{name!r} is not among the {len(self)} landmarks of the query, expected one of them")
        return self.names.index(name)

    def ellipses(self, sigmas: float = 3.0, points: int = 40, axes: tuple[int, int] = (0, 1)) -> Array:
        """Return the n-sigma ellipses (L, points + 1, 2) of Z around e in two columns, closed.  [S] (85)-(87).

        NaN of what cannot be expected.  Of a sensor that measures one number they are intervals: use e and Z.
        """
        a, b = axes
        if not (0 <= a < self.e.shape[1] and 0 <= b < self.e.shape[1] and max(axes) < self.Z.shape[1]):
            raise MapError(f"axes are {axes}, expected two columns among the first {self.Z.shape[1]} of {self.columns}")
        return ellipses(self.e[:, [a, b]], self.Z[:, [a, b]][:, :, [a, b]], sigmas, points)


class Report:
    """The answer to one event.

    `y` and the expectation `e` are (K, m), the innovation `z` (K, p) and its covariance `Z` (K, p, p), with p = m but
    for sensors that measure more than can be innovated; rows of observations that were not compared with a landmark
    are NaN.  `removed` are landmarks given up and tentative ones dropped, each with the reason, and
    `merged` are those that are gone, the ones they turned out to be, and why.  `late` are earlier
    observations, tentative then, that this scan has let be fused: time, robot, sensor and number in its scan of each.
    `compared` are the landmarks that observations were compared with, `seen_at` (K, 2 or 3) is where these seemed to
    come from.  `gaps` are times without controls, up to now, for which the pose was widened.
    `repeats` were found in the map after the scan, and not merged.
    `replaced` is the distance in m by which a robot was moved to the position of the last fixes, which had not fitted.
    `standing` is the reading of zero velocity that was added to the event, of a robot that was detected to stand.

    >>> rover = km.Robot("rover", km.motion.Unicycle(), sensors={"lidar": km.Mount(km.sensors.RangeBearing())})
    >>> report = km.Slam(rover).process(km.Scan(t_s=0.1, robot="rover", sensor="lidar", y=[[4.2, 0.3]], ids=[7]))
    >>> [(one.landmark, one.outcome) for one in report.observations]
    [(7, 'new')]
    """

    judged: tuple[JudgedScan, ...] = ()  # of which `observations` are made when they are needed
    removed: tuple[tuple[Id, str], ...] = ()
    merged: tuple[tuple[Id, Id, str], ...] = ()
    late: tuple[Late, ...] = ()
    gaps: tuple[Gap, ...] = ()
    repeats: tuple[Repeat, ...] = ()
    replaced = 0.0
    standing: Observation | None = None
    compared: Compared | None = None
    seen_at: Array = NOTHING
    e: Array = NOTHING
    z: Array = NOTHING
    Z: Array = NOTHING
    _made: tuple[Observation, ...] = ()

    def __init__(self, event: Event, y: Array = NOTHING) -> None:
        self.event, self.y = event, y

    @property
    def observations(self) -> tuple[Observation, ...]:
        """The outcome of each observation, in their order."""
        if self.judged:
            self._made, self.judged = tuple(sorted(o for group in self.judged for o in outcomes_of(group))), ()
        return self._made

    @observations.setter
    def observations(self, made: Sequence[Observation]) -> None:
        self._made, self.judged = tuple(sorted(made)), ()

    @property
    def t_ns(self) -> int:
        """The event's time in nanoseconds."""
        return self.event.t_ns

    @property
    def robot(self) -> str:
        """The event's robot."""
        return self.event.robot

    @property
    def candidates(self) -> list[Candidate]:
        """The landmarks that observations without an id were compared with."""
        if self.compared is None:
            return []
        rows, numbers, landmarks, d2, places = self.compared
        ids = self.event.ids if isinstance(self.event, Scan) else None
        pairs = zip(rows.tolist(), numbers.tolist(), d2.tolist(), strict=True)
        open_ = [(k, l, d) for k, l, d in pairs if (not ids or ids[k] is None) and math.isfinite(d)]
        return [Candidate(k, landmarks[l], d, places[l]) for k, l, d in open_]

    def blank(self, p: int) -> None:
        """Enter that nothing was predicted of any observation, whose innovations have p numbers."""
        K = len(self.y)
        self.e, self.z, self.Z = np.full(self.y.shape, np.nan), np.full((K, p), np.nan), np.full((K, p, p), np.nan)

    def fill(self, rows: Sequence[int], done: Correction) -> None:
        """Enter what was predicted of the observations `rows`; the others stay as they are."""
        if len(rows) == len(self.y):
            self.e, self.z, self.Z = done.e, done.z, done.Z
        else:
            self.e[rows], self.z[rows], self.Z[rows] = done.e, done.z, done.Z

    def __repr__(self) -> str:
        counts = {o: sum(obs.outcome == o for obs in self.observations) for o in OUTCOMES}
        text = ", ".join(f"{n} {o}" for o, n in counts.items() if n) or "no observations"
        return f"<Report of {type(self.event).__name__} at t={seconds_text(self.event.t_ns)} s: {text}>"


class LandmarkEstimate(NamedTuple):
    """One landmark of the map.

    >>> rover = km.Robot("rover", km.motion.Unicycle(), sensors={"lidar": km.Mount(km.sensors.RangeBearing())})
    >>> slam = km.Slam(rover)
    >>> report = slam.process(km.Scan(0.0, "rover", "lidar", [[4.0, 0.0]], ids=[7]))
    >>> [(one.id, one.kind, one.mean.round(2), one.observations) for one in slam.landmarks()]
    [(7, 'point', array([4., 0.]), 1)]
    """

    id: Id
    kind: str
    mean: Array
    covariance: Array
    observations: int


@dataclass(frozen=True)
class LandmarkTable:
    """All landmarks of a map, column by column; iterate for `LandmarkEstimate` rows.

    `log_odds` are those that a landmark exists, of the landmarks that were looked at again; `unseen` are those that are
    not seen again where they should be (docs/association.md).

    >>> rover = km.Robot("rover", km.motion.Unicycle(), sensors={"lidar": km.Mount(km.sensors.RangeBearing())})
    >>> scan = km.Scan(0.1, "rover", "lidar", [[4.0, 0.3], [2.0, -1.0]], ids=[7, 8])
    >>> events = [km.Control(0.0, "rover", (0.5, 0.1)), scan]
    >>> slam = km.Slam(rover)
    >>> reports = [slam.process(event) for event in events]
    >>> slam.landmarks().ids, [len(one.mean) for one in slam.landmarks()]
    ([7, 8], [2, 2])
    """

    ids: list[Id]
    kinds: list[str]
    means: list[Array]
    covariances: list[Array]
    observations: list[int]
    log_odds: Mapping[Id, float] = field(default_factory=dict)
    unseen: frozenset[Id] = frozenset()

    def __len__(self) -> int:
        return len(self.ids)

    def __iter__(self) -> Iterator[LandmarkEstimate]:
        columns: Any = (self.ids, self.kinds, self.means, self.covariances, self.observations)
        return (LandmarkEstimate(*row) for row in zip(*columns, strict=True))
