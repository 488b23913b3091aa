"""The estimators to choose from.  They differ in the correction and in where the motion is linearised.

`Invariant` is the default: its unobservable directions do not depend on the estimate, which keeps it consistent.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Annotated, Any, ClassVar

import numpy as np

from kalmark.arrays import Array, Index
from kalmark.compiled import compile_on_second_core, form_for
from kalmark.declare import Count, Positive, register
from kalmark.filter import corrections, prediction
from kalmark.filter.estimator_protocols import (
    Averaging,
    CompilingEstimator,
    Correction,
    Estimator,
    Initializing,
    Iterating,
    Movement,
    Selective,
    Update,
)
from kalmark.filter.inertial_errors import has_units, turn_own_errors
from kalmark.filter.map import Map, StochasticMap
from kalmark.filter.textbook import Textbook

__all__ = [
    "Averaging", "CompilingEstimator", "Correction", "Ekf", "Estimator", "Fej", "Initializing", "Invariant",
    "Iterating", "Movement", "Selective", "Textbook", "Update",
]  # fmt: skip


TOGETHER = 128  # observations of one correction


def _parts(update: Update) -> Iterator[Update]:
    """Yield a correction by K observations in parts of at most `TOGETHER`.

    Each part is linearised and gated at the estimate after the one before it.  Together they would cost O(K^3), and a
    compressed map would have all of their landmarks active at once.
    """
    for k in range(0, len(update.y), TOGETHER):
        part = slice(k, k + TOGETHER)
        yield update._replace(slots=update.slots[part], y=update.y[part], R=update.R[part])


def _joined(done: list[Correction]) -> Correction:
    """Return the corrections of all parts as one."""
    e, z, Z, d2, fused = (np.concatenate(parts) for parts in list(zip(*done, strict=True))[:-1])
    return Correction(e, z, Z, d2, fused, all(part.valid for part in done))


def _one_by_one(
    fuse: Callable[[corrections.Scan], Correction], scan: corrections.Scan, together: Correction
) -> Correction:
    """Fuse those of a scan one after the other that could not be fused together."""
    robot, mount, slots, d, y, R, gate = scan
    d2, fused = together.d2.copy(), together.fused.copy()
    for k in np.flatnonzero((d2 <= gate) & (d2 < np.inf)).tolist():
        one = slice(k, k + 1)
        done = fuse((robot, mount, slots[one], d, y[one], R[one], gate))
        fused[k] = done.fused[0]
        if not done.valid:
            d2[k] = np.nan
    return together._replace(d2=d2, fused=fused)


class _Estimator:
    """Runs the compiled correction for built-in models and the same source in Python for a user's."""

    coordinates: ClassVar[str] = "world"
    default_gate: ClassVar[float] = math.inf
    compiled: ClassVar[Callable[..., Any]]
    option: ClassVar[str] = "none"  # the type of what `_option` returns
    from_first: ClassVar[bool] = False  # whether displacements count from the first estimates
    transports: ClassVar[bool] = False  # whether a correction turns the coordinates of errors

    def compile_ahead(self, axes: int, inverse_depths: bool, dependent: bool) -> None:
        """Begin to compile the correction of a map of these axes on a second core."""
        job, cls = corrections.compile_correction, type(self)
        needs = axes, inverse_depths, dependent
        compile_on_second_core(corrections.compiled_iterate, job, cls.compiled.__name__, cls.option, *needs)

    def predict(self, map_: Map, movement: Movement) -> bool:
        """Move a robot; return whether all of it is finite: if not, nothing has changed.  [S] (14)-(17)."""
        model, robot, added, *control = movement
        m, robot, _, here = map_.movable(robot, added)
        run: Any = form_for(model, prediction.predict)
        where = m.x, m.x_first, m.P, m.n, m.blocks, m.atoms, corrections.generator_address(m.axes)
        return bool(run(where, (model, robot, here, *control), self.from_first, self.transports and m.axes == 6))

    def correct(self, map_: Map, update: Update) -> Correction:
        """Fuse a scan, where d2 is within the gate.

        Observations whose covariance is not positive definite are left out; if only that of all together is not, they
        are fused one after the other.  A scan of more than `TOGETHER` is fused in parts.
        """
        if len(update.y) > TOGETHER:
            return _joined([self.correct(map_, part) for part in _parts(update)])
        model, robot, mount, slots, d, y, R, gate, parallax = update
        m, robot_here, mount_here, here = map_.opened(robot, mount, slots, self.transports)
        before = m.x.copy() if self.transports and has_units(m) else None
        scan = robot_here, mount_here, here, d, y, R, gate
        run, whole, option = form_for(model, type(self).compiled), m.arrays_for(parallax), self._option(m)
        done = Correction(*run(model, whole, scan, option))
        if not done.valid and not done.fused.any():
            done = _one_by_one(lambda one: Correction(*run(model, whole, one, option)), scan, done)
        if before is not None:
            turn_own_errors(m, robot_here, before)
        map_.finish_correction(robot, self.transports)
        return done

    def average(self, map_: Map, update: Update, pairs: Index, weights: Array) -> tuple[Array, bool]:
        """Fuse the mean over matchings (H, K), numbers of slots or -1, of these weights (H,); nothing is gated.

        Returns d2 (K,) of the pairs of the first one, and whether the covariances are valid.
        """
        model, *scan = update[:-1]
        run: Any = form_for(model, corrections.correct_by_average)
        m, robot_here, _, _ = map_.opened(update.robot, update.mount, update.slots, self.transports)
        before = m.x.copy() if self.transports and has_units(m) else None
        limits = self._option(m) if self.transports else (1, math.inf)
        d2, valid = run(model, m.whole, tuple(scan), limits, pairs, weights, self.transports)
        if before is not None:
            turn_own_errors(m, robot_here, before)
        return d2, bool(valid)

    def _option(self, map_: StochasticMap) -> Any:
        return None

    def for_fixes(self) -> Any:
        """Return the estimator that fuses absolute positions."""
        return self

    def pose_jacobian(self, map_: Map, robot: int, J: Array) -> Array:
        """Return J as it is: everything is linearised at the estimate."""
        return J


@register("estimator", "ekf")
class Ekf(_Estimator):
    """The textbook filter, landmark by landmark.

    Gate 3 sigma.  [S] (26)-(30), C.3.  Overconfident: for comparison.

    >>> rover = km.Robot("rover", km.motion.Unicycle(), sensors={"lidar": km.Mount(km.sensors.RangeBearing())})
    >>> slam = km.Slam(rover, estimator=km.estimators.Ekf())
    >>> slam.process(km.Scan(0.0, "rover", "lidar", [[4.0, 0.3]], ids=[7])).observations[0].outcome
    'new'
    """

    default_gate = 9.0
    compiled = corrections.textbook


@register("estimator", "invariant")
class Invariant(_Estimator):
    """The iterated invariant filter.

    Its unobservable directions are exact (docs/invariant.md).  A scan is linearised at most so many times, until
    nothing seen moves by more than `tolerance` of its sigma; the next time would change about a thousandth of that.
    Once is enough for small corrections by relative measurements; fixes are always iterated, and so should be landmarks
    known beforehand.

    >>> rover = km.Robot("rover", km.motion.Unicycle(), sensors={"lidar": km.Mount(km.sensors.RangeBearing())})
    >>> slam = km.Slam(rover, estimator=km.estimators.Invariant(iterations=1))
    >>> slam.process(km.Scan(0.0, "rover", "lidar", [[4.0, 0.3]], ids=[7])).observations[0].outcome
    'new'
    """

    iterations: Annotated[Count, "At most this many linearisations of a scan."] = 30
    tolerance: Annotated[Positive, "No more once nothing moves by more than this many of its sigmas."] = 1e-3

    coordinates = "log"
    option = "Tuple((i8, f8))"
    transports = True
    compiled = corrections.invariant

    def _option(self, map_: StochasticMap) -> tuple[int, float]:
        return self.iterations, float(self.tolerance)

    def for_fixes(self) -> Invariant:
        """Return the estimator that fuses absolute positions: a large step must be iterated."""
        return Invariant(max(30, self.iterations), self.tolerance)

    def once(self) -> Invariant:
        """Return the estimator that linearises everything at the prediction."""
        return Invariant(1, self.tolerance)


@register("estimator", "fej")
class Fej(_Estimator):
    """First-estimates Jacobians.

    Consistent while the first estimates are good, diverged when they are not.

    >>> rover = km.Robot("rover", km.motion.Unicycle(), sensors={"lidar": km.Mount(km.sensors.RangeBearing())})
    >>> slam = km.Slam(rover, estimator=km.estimators.Fej())
    >>> slam.process(km.Scan(0.0, "rover", "lidar", [[4.0, 0.3]], ids=[7])).observations[0].outcome
    'new'
    """

    option = "f8[::1]"
    from_first = True
    compiled = corrections.first_estimates

    def _option(self, map_: StochasticMap) -> Array:
        return map_.x_first

    def pose_jacobian(self, map_: Map, robot: int, J: Array) -> Array:
        """Return J (I + (generator(x) - generator(x_first)) e_theta'): displacements counted from x_first."""
        space = map_.spaces[robot]
        assert space is not None
        axes = space.axes
        theta, dof = (2, 3) if axes == 1 else (3, 6)  # a mount, whose columns follow, does not turn with the world
        now, first = (space.generator(x)[:dof] for x in (map_.mean(robot), map_.first(robot)))
        J = J.copy()
        J[:, theta : theta + axes] += J[:, :dof] @ (now - first)
        return J


register("estimator", "textbook")(Textbook)  # here: a copy of its file registers under no name of kalmark's
