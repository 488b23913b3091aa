"""The estimators to choose from.  They differ in the correction alone; prediction and augmentation are the textbook's.

`Invariant` is the default: its unobservable directions do not depend on the estimate, which keeps it consistent.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from kalmark.errors import ModelError
from kalmark.filter import corrections
from kalmark.filter.map import StochasticMap
from kalmark.filter.postponed import PostponedMap

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]

Map = StochasticMap | PostponedMap


class Correction(NamedTuple):
    """What K known landmarks said: expectation, innovation and its covariance, squared distance, fused, health."""

    e: Array
    z: Array
    Z: Array
    d2: Array
    fused: npt.NDArray[np.bool_]
    healthy: bool


class Estimator(Protocol):
    """How a scan corrects the map."""

    coordinates: ClassVar[str]
    default_gate: ClassVar[float]

    def correct(
        self, map_: Map, view: Any, robot: int, mount: int, slots: Index, d: int, y: Array, R: Array,
        gate: float,
    ) -> Correction:  # fmt: skip
        """Fuse y (K, m), noise R (K, p, p), of the first d numbers of the blocks `slots`, where d2 <= gate.

        `mount` is the slot of the sensor's mount, -1 if it is not in the map.
        """

    def average(
        self, map_: StochasticMap, view: Any, robot: int, mount: int, slots: Index, d: int, y: Array, R: Array,
        pairs: Index, weights: Array,
    ) -> tuple[Array, bool]:  # fmt: skip
        """Fuse the mean over matchings; only `km.association.Averaged` asks for it."""

    def for_fixes(self) -> Estimator:
        """Return the estimator that fuses absolute positions."""

    def pose_jacobian(self, map_: Map, robot: int, J: Array) -> Array:
        """Return the Jacobian J (., 3 or more) in the robot's state, taken where this estimator linearises."""


class _Estimator:
    """Runs the compiled correction for built-in models and the same source in Python for a user's."""

    source: ClassVar[Callable[..., Any]]
    compiled: ClassVar[Callable[..., Any]]
    transports: ClassVar[bool] = False  # whether a correction turns the coordinates of errors

    def correct(
        self, map_: Map, view: Any, robot: int, mount: int, slots: Index, d: int, y: Array, R: Array,
        gate: float,
    ) -> Correction:  # fmt: skip
        """Fuse y (K, m), noise R (K, p, p), of the first d numbers of the blocks `slots`, where d2 <= gate."""
        run = type(self).compiled if isinstance(view, tuple) else type(self).source
        m, *here = map_.opened(robot, mount, slots, self.transports)
        scan = (*here, d, y, R, gate)
        done = Correction(*run(view, (m.x, m.P, m.n, m.blocks, m.atoms, m.axes), scan, self._option(m)))
        map_.corrected(robot, self.transports)
        return done

    def average(
        self, map_: StochasticMap, view: Any, robot: int, mount: int, slots: Index, d: int, y: Array, R: Array,
        pairs: Index, weights: Array,
    ) -> tuple[Array, bool]:  # fmt: skip
        """Correct by the mean over matchings (H, K), numbers of slots or -1, of these weights (H,).

        Returns d2 (K,) of the first one's pairs, and whether the filter can go on.
        """
        run = corrections.compiled_averaged if isinstance(view, tuple) else corrections.averaged
        scan = robot, mount, slots, d, y, R, math.inf
        where = map_.x, map_.P, map_.n, map_.blocks, map_.atoms, map_.axes
        d2, healthy = run(view, where, scan, self._limits(), pairs, weights, self.transports)
        return d2, bool(healthy)

    def _option(self, map_: StochasticMap) -> Any:
        return None

    def _limits(self) -> tuple[int, float]:
        return 1, math.inf

    def for_fixes(self) -> Any:
        """Return the estimator that fuses absolute positions."""
        return self

    def pose_jacobian(self, map_: Map, robot: int, J: Array) -> Array:
        """Return J as it is: everything is linearised at the estimate."""
        return J


@dataclass(frozen=True)
class Ekf(_Estimator):
    """The textbook filter, landmark by landmark, gate 3 sigma.  [S] (26)-(30), C.3.  Overconfident: for comparison."""

    coordinates: ClassVar[str] = "world"
    default_gate: ClassVar[float] = 9.0
    source = corrections.textbook
    compiled = corrections.compiled_textbook


@dataclass(frozen=True)
class Invariant(_Estimator):
    """The iterated right-invariant filter: honest about what cannot be observed (docs/invariant.md).

    A scan is linearised at most so many times, until nothing seen moves by more than `tolerance` of its sigma; the next
    time would change about a thousandth of that.  Once is enough for small corrections by relative measurements; fixes
    are always iterated, and so should be landmarks known beforehand.
    """

    iterations: int = 30
    tolerance: float = 1e-3

    coordinates: ClassVar[str] = "log"
    transports: ClassVar[bool] = True
    default_gate: ClassVar[float] = math.inf
    source = corrections.invariant
    compiled = corrections.compiled_invariant

    def __post_init__(self) -> None:
        if self.iterations < 1:
            raise ModelError(f"Invariant: iterations is {self.iterations}, expected at least 1")
        if not 0 < self.tolerance < math.inf:
            raise ModelError(f"Invariant: tolerance is {self.tolerance}, expected a positive number of sigmas")

    def _limits(self) -> tuple[int, float]:
        return self.iterations, float(self.tolerance)

    def _option(self, map_: StochasticMap) -> tuple[int, float]:
        return self._limits()

    def for_fixes(self) -> Invariant:
        """Return the estimator that fuses absolute positions: a large step must be iterated."""
        return Invariant(max(30, self.iterations), self.tolerance)


@dataclass(frozen=True)
class Fej(_Estimator):
    """First-estimates Jacobians: consistent while the first estimates are good, lost when they are not."""

    coordinates: ClassVar[str] = "world"
    default_gate: ClassVar[float] = math.inf
    source = corrections.first_estimates
    compiled = corrections.compiled_first_estimates

    def _option(self, map_: StochasticMap) -> Array:
        return map_.x_first

    def pose_jacobian(self, map_: Map, robot: int, J: Array) -> Array:
        """Return J (I + (generator(x) - generator(x_first)) e_theta'): displacements counted from x_first."""
        space = map_.spaces[robot]
        assert space is not None
        dof, axes = J.shape[1], space.axes
        now, first = (space.generator(x)[:dof] for x in (map_.mean(robot), map_.first(robot)))
        J, theta = J.copy(), 2 if axes == 1 else 3
        J[:, theta : theta + axes] += J @ (now - first)
        return J
