"""Estimators as a `Slam` uses them: what they are given, what they return, what they can do."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, NamedTuple, Protocol, runtime_checkable

from kalmark.arrays import Array, Flags, Index
from kalmark.filter.map import Map
from kalmark.geometry.spaces import Space


class Update(NamedTuple):
    """One correction: y (K, m) with noise R (K, p, p), of the first d numbers of the K blocks `slots`.

    `model` is the observation model, compiled (a tuple) or in Python; `robot` and `mount` are slots, `mount` -1 if it
    is not in the map.  Observations with d2 > gate are not fused.  With `parallax`, inverse distances are corrected by
    the parallax that they stand for, if the estimator iterates; a sensor that finds depth measures the distances.

    >>> y, R = np.array([[4.0, 0.3]]), np.diag([0.01, 0.0004])[None]
    >>> one = Update(km.sensors.RangeBearing(), robot=0, mount=-1, slots=np.array([1]), d=2, y=y, R=R)
    >>> one.gate, one.parallax
    (inf, True)
    """

    model: Any
    robot: int
    mount: int
    slots: Index
    d: int
    y: Array
    R: Array
    gate: float = math.inf
    parallax: bool = True


class Movement(NamedTuple):
    """One part of a robot's motion: the control u (m,), held for `dt_s` seconds, with the covariance N of its error.

    `model` is the motion, compiled (a tuple) or in Python; `added` are the slots of constant blocks that change the
    control: their numbers (c,), one after the other, add B (m, c) times them to it.  The first has its error (m,) where
    that is `shared` with other parts; where it `begins`, it is 0 with the covariance N, whatever it was before.  D is
    the noise gathered in the robot's frame, (0, 0) for none.

    >>> rover = km.motion.Unicycle()
    >>> u = np.array([0.5, 0.1])
    >>> N, none = rover.control_noise(u), np.zeros((0, 0))
    >>> one = Movement(rover, 0, [], False, False, np.zeros((2, 0)), u, N, none, dt_s=0.1)
    >>> one.model.move(np.zeros(3), one.u, one.dt_s)[0].round(3)
    array([0.05, 0.  , 0.01])
    """

    model: Any
    robot: int
    added: Sequence[int]
    shared: bool
    begins: bool
    B: Array
    u: Array
    N: Array
    D: Array
    dt_s: float


class Correction(NamedTuple):
    """Of K observations: expectation, innovation and its covariance, squared distance, and which were fused.

    Where the correction is not `valid`, some could not be fused: d2 is infinite of those of which nothing can be
    expected, NaN of those whose covariance is not positive definite.

    >>> rover = km.Robot("rover", km.motion.Unicycle(), sensors={"lidar": km.Mount(km.sensors.RangeBearing())})
    >>> slam = km.Slam(rover)
    >>> slam.add_landmark(7, mean=(4.0, 1.0), cov=0.01 * np.eye(2))
    >>> done = slam.process(km.Scan(0.0, "rover", "lidar", [[4.12, 0.24]], ids=[7])).judged[0].done
    >>> done.e.round(3), done.z.round(3), done.d2.round(2), done.fused, done.valid
    (array([[4.123, 0.245]]), array([[-0.003, -0.005]]), array([0.03]), array([ True]), True)
    """

    e: Array
    z: Array
    Z: Array
    d2: Array
    fused: Flags
    valid: bool


class Estimator(Protocol):
    """Prediction and correction of the map by motions and scans.

    >>> km.estimators.Ekf().coordinates, km.estimators.Ekf().default_gate, km.estimators.Invariant().coordinates
    ('world', 9.0, 'log')
    """

    coordinates: ClassVar[str]
    default_gate: ClassVar[float]

    def predict(self, map_: Map, movement: Movement) -> bool:
        """Move a robot; return whether all of it is finite: if not, nothing has changed.  [S] (14)-(17)."""

    def correct(self, map_: Map, update: Update) -> Correction:
        """Fuse a scan."""

    def for_fixes(self) -> Estimator:
        """Return the estimator that fuses absolute positions."""

    def pose_jacobian(self, map_: Map, robot: int, J: Array) -> Array:
        """Return the Jacobian J (., 3 or more) in the robot's state, and a mount's behind it, where it linearises."""


@runtime_checkable
class CompilingEstimator(Protocol):
    """An estimator that is compiled, and can begin with that before it is needed.

    >>> [isinstance(one, CompilingEstimator) for one in (km.estimators.Ekf(), km.estimators.Textbook())]
    [True, False]
    """

    def compile_ahead(self, axes: int, inverse_depths: bool, dependent: bool) -> None:
        """Begin to compile the correction of a map of these axes, as `corrections.routines`, on a second core."""


@runtime_checkable
class Iterating(Protocol):
    """An estimator that linearises an observation more than once.

    >>> [isinstance(one, Iterating) for one in (km.estimators.Ekf(), km.estimators.Invariant())]
    [False, True]
    >>> km.estimators.Invariant().once()
    Invariant(iterations=1, tolerance=0.001)
    """

    def once(self) -> Estimator:
        """Return the estimator that linearises everything at the prediction."""


@runtime_checkable
class Averaging(Protocol):
    """An estimator that can fuse the mean over matchings, as `km.association.Averaged` requires.

    >>> isinstance(km.estimators.Invariant(), Averaging), isinstance(km.estimators.Textbook(), Averaging)
    (True, False)
    """

    def average(self, map_: Map, update: Update, pairs: Index, weights: Array) -> tuple[Array, bool]:
        """Fuse the mean over matchings (H, K), numbers of slots or -1, of these weights (H,).

        Returns d2 (K,) of the pairs of the first one, and whether the covariances are valid.
        """


@runtime_checkable
class Initializing(Protocol):
    """An estimator that adds a landmark, seen for the first time, by its own equations.

    >>> [isinstance(one, Initializing) for one in (km.estimators.Ekf(), km.estimators.Textbook())]
    [False, True]
    """

    def initialize(self, map_: Map, robot: int, space: Space, l: Array, L_r: Array, Q: Array) -> int:
        """Add a landmark l (n,) with L_r (n, d) by the robot's first d errors and noise Q (n, n); return its slot."""


@runtime_checkable
class Selective(Protocol):
    """An estimator of some robots, sensors and landmarks only.

    >>> [isinstance(one, Selective) for one in (km.estimators.Ekf(), km.estimators.Textbook())]
    [False, True]
    """

    def refuse_misfits(
        self, robots: Mapping[str, Any], channels: Mapping[Any, Any], policies: Mapping[Any, Any]
    ) -> None:
        """Raise ModelError if it cannot estimate these; channels and policies are by robot and sensor."""
