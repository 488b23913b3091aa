"""A reader: a sensor that measures its own robot, on its mount, as the filter uses it."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from decimal import Decimal
from typing import Any

import numpy as np

from kalmark.arrays import Array
from kalmark.errors import EventError, ModelError
from kalmark.events import Scan, label_of_event
from kalmark.filter.estimators import Estimator, Iterating, Update
from kalmark.filter.map import Map
from kalmark.geometry.gaussian import gate
from kalmark.models import protocols
from kalmark.models.observe import view_of
from kalmark.models.protocols import CHANGE, POSE, HoldsRate, Motion, OfState
from kalmark.models.state_view import sees_state
from kalmark.slam.checks import measurements
from kalmark.slam.held_control import Moving, RateMean
from kalmark.slam.rests import Standing

POSITIONS = ("x_m", "y_m"), ("x_m", "y_m", "z_m")  # columns of sensors of an antenna's position
LEAST_S = 1e-6  # between two readings that determine a motion


def _time(event: Scan, k: int) -> int:
    """Return the time that the id of a row is, in ns.  Raises EventError."""
    name = None if event.ids is None else event.ids[k]
    try:
        return int((Decimal(str(name)) * 10**9).to_integral_value())
    except ArithmeticError:
        raise EventError(f"{label_of_event(event)}: id {name!r}, expected the time in s of an earlier scan") from None


class StateReader:
    """A sensor of the state of a robot that moves by `motion`; `mount` is the slot of its mount, -1 for none.

    `counts`: what it measures counts from its last scan, where a clone of the robot's pose was left, or, by an id that
    is its time, from another of the last `keep`, or of those that it has to `prepare_for` where that is 0.  `standing`
    is the detector of rest of a `zero_velocity`.
    `is_position`: like a fix it determines where a lost robot is.
    """

    t_ns: int | None  # of its last reading
    standing: Standing | None
    mean: RateMean | None  # of its readings, where its scale is estimated from the robot's controls,
    sigma: Array  # and what the last was uncertain by, as a rate
    until: dict[int, int] | None  # of a scan that readings of a log count from, the time of the last

    def __init__(
        self, sensor: OfState, motion: Motion, at: Array, mount: int, standing: Standing | None = None
    ) -> None:  # fmt: skip
        self.sensor: Any = sensor
        self.at: Array = np.array(at)
        self.mount, self.motion, self.standing = mount, motion, standing
        self.of_state = sees_state(sensor, motion)
        self.counts = sensor.views != POSE and not self.of_state
        self.keep = protocols.poses_kept(sensor)
        self.t_ns = self.mean = self.until = None
        self.is_position = tuple(sensor.columns) in POSITIONS
        scales = protocols.parameter_covariance(sensor) is not None and "gain" in protocols.parameter_names(sensor)
        self.scales, self.sigma = self.counts and scales, np.zeros(len(sensor.columns))
        if self.of_state and not np.diagonal(sensor.noise(np.zeros((1, len(sensor.columns))))[0]).all():
            name, wanted = type(sensor).__name__, "a positive number for each component"
            raise ModelError(f"{name}: the noise of one reading is 0, expected {wanted}: the state has the velocity")
        self.check = sensor.check if isinstance(sensor, protocols.Checked) else None
        self.gate = gate(self.sensor.pass_share, protocols.innovation_size(sensor))
        self._view: Any = None

    @property
    def view(self) -> Any:
        """The view for `linearize`; made when it is first needed, as compiled code is."""
        if self._view is None:
            self._view = view_of(self.sensor, None, self.at, self.motion)
        return self._view

    def noise(self, event: Scan) -> Array:
        """Return the noise R (1, p, p) of a reading, refusing what its sensor cannot have made.  Raises EventError."""
        if len(event.y) > 1 and self.keep == 1:
            name = type(self.sensor).__name__
            raise EventError(
                f"{label_of_event(event)}: y has {len(event.y)} rows, expected one: a {name} measures its robot"
            )
        odd = [i for i in event.ids or () if i not in (None, event.robot)]
        if odd and self.keep == 1:
            raise EventError(
                f"{label_of_event(event)}: id {odd[0]!r}, expected none: {event.sensor!r} measures its robot"
            )
        return measurements(event, self.sensor, self.check)

    def begins_ns(self, event: Scan) -> list[int | None]:
        """Return the time of the scan that each row counts from, the last one where it has no id; None for the first.

        Raises EventError where that is too short ago.
        """
        begins = [_time(event, k) if self.is_loop(event, k) else self.t_ns for k in range(len(event.y))]
        last = [self.t_ns] if self.counts and self.keep == 1 else []
        if self.counts and any(t_ns is not None and (event.t_ns - t_ns) * 1e-9 < LEAST_S for t_ns in [*begins, *last]):
            raise EventError(
                f"{label_of_event(event)}: {event.sensor!r} was read at that time already, expected one reading"
            )
        return begins

    def prepare_for(self, scans: Iterable[Scan]) -> None:
        """Note until when the readings of a whole log refer to each pose: it is kept until then, if `keep` is 0.

        The estimates are those that any other number of poses gives.
        """
        if self.keep:
            return
        self.until, last = {}, None
        for scan in scans:
            for k in range(len(scan.y)):
                with suppress(EventError):  # `begins_ns` raises it
                    from_ns = _time(scan, k) if self.is_loop(scan, k) else last
                    self.until |= {} if from_ns is None else {from_ns: scan.t_ns}
            last = scan.t_ns

    def kept(self, clones: dict[int, int], t_ns: int) -> list[int]:
        """Return which clones, by the times of their scans, later readings may count from."""
        if self.until is None:
            return [*clones.values()][-(self.keep or 1) :]
        return [number for from_ns, number in clones.items() if self.until.get(from_ns, t_ns) > t_ns]

    def is_loop(self, event: Scan, k: int) -> bool:
        """Return whether a row of a scan names by its id the earlier one from which it counts."""
        return event.ids is not None and event.ids[k] not in (None, event.robot)

    def constants(self, map_: Map) -> tuple[Array, Array] | None:
        """Return the sensor's own constants (c,) in the map and their covariance (c, c), None where it has none."""
        own = 0 if self.mount < 0 else len(map_.mean(self.mount)) - len(self.at)
        if own == 0:
            return None
        return map_.mean(self.mount)[-own:], map_.covariance([self.mount])[-own:, -own:]

    def drift(self, t_ns: int, *maps: Map) -> None:
        """Let the sensor's constants in some maps walk from its last scan to the one at `t_ns`."""
        since_s, self.t_ns = 0.0 if self.t_ns is None else (t_ns - self.t_ns) * 1e-9, t_ns
        if self.mount < 0 or not isinstance(self.sensor, protocols.Drifting):
            return
        Q = self.sensor.drift(since_s)
        for map_ in maps if Q.any() else ():
            rows = map_.index(self.mount)[-len(Q) :]
            map_.predict(rows, np.eye(len(Q)), np.diag(Q))

    def update(self, map_: Map, moving: Moving, clone: int, event: Scan, k: int, R: Array, since_s: float) -> Update:
        """Return the correction by a row of a scan with the noise R (1, p, p); `clone` is where it counts from."""
        robot = moving.slot
        if event.cov is None and isinstance(self.sensor, protocols.TimedNoise) and since_s > 0:
            R = self.sensor.noise_since(since_s)
        slot, d = (clone, len(self.at)) if self.counts else (robot, len(map_.mean(robot)) if self.of_state else 0)
        y = event.y[k : k + 1]
        usual = [] if self.is_loop(event, k) else self._usual(y, since_s)
        given = np.column_stack([y, *usual, [since_s], *self._held(moving)])
        return Update(self.view, robot, self.mount, np.array([slot]), d, given, np.ascontiguousarray(R), self.gate)

    def _held(self, moving: Moving) -> list[Array]:
        """Return the control in force (1, k), where the turn rate is of it."""
        return [moving.held.in_force[None]] if self.of_state and isinstance(self.motion, HoldsRate) else []

    def _usual(self, y: Array, since_s: float) -> list[Array]:
        """Return the mean (1, m) of earlier readings like y; none where y has changed, or none is needed."""
        unit_s = since_s if self.sensor.views == CHANGE else 1.0
        if self.mean is None or self.mean.after(y[0] / unit_s, self.sigma).number == 1:
            return []
        return [self.mean.rate[None] * unit_s]

    def take(self, y: Array, Z: Array, since_s: float) -> None:
        """Take a reading y (1, m) with the innovation covariance Z (1, m, m) into their mean."""
        if self.scales:
            unit_s = since_s if self.sensor.views == CHANGE else 1.0
            rate, self.sigma = y[0] / unit_s, np.sqrt(np.diag(Z[0])) / unit_s
            self.mean = RateMean(rate, 1) if self.mean is None else self.mean.after(rate, self.sigma)

    def estimator(self, estimator: Estimator, is_loop: bool) -> Estimator:
        """Return how a reading is fused: absolute poses and loops with iterations, how the robot moved without.

        The motion of a step is a new unknown each time, constants of the sensor are not.  The iterated estimate is the
        mode of all of them together, which is no mode of the constants (docs/state_sensors.md).
        """
        if self.sensor.views == POSE:
            return estimator.for_fixes()
        many = is_loop and not self.scales
        return estimator.once() if isinstance(estimator, Iterating) and not many else estimator
