"""The motion of a robot: the control that it holds, cut into parts by the scans between.

A rate acts from its time until the robot's next control, so a scan in between splits its interval.  An increment is the
motion that ended at its time.  A robot that coasts moves without a control, which changes its velocity at its time.

A control's error is white from one control to the next and needs no block of the map.  Two kinds do: the error of a
control whose interval a scan has split, common to both parts until the next control; and the constants by which all
controls are wrong, offsets and scales (`sigma_v_bias_mps`, `sigma_scale` and the like).  Both change the control, and
the scans correct them like all else.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import Any, ClassVar, NamedTuple

import numpy as np

from kalmark.arrays import Array
from kalmark.errors import MapError
from kalmark.events import Control
from kalmark.filter.estimators import Movement
from kalmark.filter.kernels import moved_noise
from kalmark.filter.map import Map
from kalmark.geometry.spaces import Rn, Space
from kalmark.models.observe import step, step_of
from kalmark.models.protocols import (
    HoldsRate,
    Motion,
    SelfCalibrating,
    StateDiffusion,
    coasts,
    has_velocity_state,
    self_calibrating,
    true_control,
    velocity_in,
)
from kalmark.report import Gap
from kalmark.slam.gaps import Gaps
from kalmark.slam.past_motion import PastMotion
from kalmark.slam.relocation_by_fixes import RejectedFix

NO_NOISE = np.zeros((0, 0))
MOST, CHANGED = 30, 4.0  # controls in their mean, and sigmas by which noise alone moves hardly any


class MotionPart(NamedTuple):
    """One piece of motion: the control, the covariance N of its error, and its duration.

    `first` and `last`: whether it begins and ends its control's interval.
    `unknown` (dof, dof) is the covariance of what the robot may have moved besides, without a control.  `usual` is the
    mean of earlier controls like it, None where no constants of controls are in the map.
    """

    u: Array
    N: Array
    dt_s: float
    first: bool
    last: bool
    unknown: Array | None = None
    usual: Array | None = None

    @property
    def shares(self) -> bool:
        """True if other parts of its control's interval have the same error."""
        return not (self.first and self.last)


class RateMean(NamedTuple):
    """The mean (k,) of the last controls or readings, as rates: of a `number` that differ by their noise alone.

    The effect of a constant is proportional to a control, or to a reading as it is expected after one.  Of the measured
    control it would be correlated with the control's noise, and where another sensor shows that noise the constant
    would be wrong: errors in variables.  Earlier ones are as large and have other noise: an instrumental variable
    (Fuller 1987, section 1.4).
    """

    rate: Array
    number: int

    def after(self, rate: Array, sigma: Array) -> RateMean:
        """Return the mean with one more, of a noise sigma (k,); it begins again where the control has changed."""
        if (np.abs(rate - self.rate) > CHANGED * sigma * math.sqrt(1.0 + 1.0 / self.number)).any():
            return RateMean(rate, 1)
        number = min(self.number + 1, MOST)
        return RateMean(self.rate + (rate - self.rate) / number, number)


def control_covariance(motion: Motion, control: Control) -> Array:
    """Return the covariance N (k, k) of a control's error: its own or the model's, of a part its share of that."""
    if control.share == 1.0:
        return motion.control_noise(control.u) if control.cov is None else control.cov
    whole = motion.control_noise(control.u / control.share) if control.cov is None else control.cov
    return control.share * whole + (0.0 if control.uneven is None else np.diag(control.uneven))


class HeldInput:
    """The control in force of one robot and how far it has been acted upon.

    `put_back` undoes what a control that turns out to be impossible has changed.  `gaps` watches for controls that
    stop.  Controls up to `rests_until_ns` are those of a robot that stands: its start was found from them.
    """

    t_ns: int | None
    u: Array | None
    N: Array | None
    usual: Array | None  # of earlier controls,
    mean: RateMean | None  # which is their mean
    fresh: bool
    gaps: Gaps | None

    def __init__(self, motion: Motion, gaps: Gaps | None = None, rests_until_ns: int | None = None) -> None:
        self.motion, self.coasts, self.calibrates = motion, coasts(motion), self_calibrating(motion) is not None
        self.t_ns = self.u = self.N = self.usual = self.mean = None
        self.fresh, self.gaps = True, None if self.coasts else gaps
        self.rests_until_ns = -math.inf if rests_until_ns is None else rests_until_ns

    def restored(self) -> None:
        """Check the arrays of a file.  Raises MapError."""
        k = len(self.motion.columns)
        rate = None if self.mean is None else self.mean.rate
        for array, shape in ((self.u, (k,)), (self.N, (k, k)), (self.usual, (k,)), (rate, (k,))):
            if array is not None and array.shape != shape:
                raise MapError(f"a control has an array {array.shape}, expected {shape}")

    def snapshot(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """Return what it is now, for `put_back`: its own attributes, and those of its `gaps`."""
        return vars(self).copy(), {} if self.gaps is None else vars(self.gaps).copy()

    def put_back(self, before: tuple[dict[str, Any], dict[str, Any]]) -> None:
        """Make it what it was at a `snapshot`."""
        own, watched = before
        vars(self).update(own)
        if self.gaps is not None:
            vars(self.gaps).update(watched)

    @property
    def in_force(self) -> Array:
        """The control (k,) that it is moved by, NaN before the first."""
        return np.full(len(self.motion.columns), np.nan) if self.u is None else self.u

    def stays(self, to_ns: int) -> bool:
        """Return whether the robot is at that time where it was, and no gap is to be reported."""
        gaps = self.gaps
        on_time = gaps is None or (to_ns <= gaps.late_ns and gaps.noticed is None)
        return on_time and not (self.motion.held or self.coasts)

    def advance(self, to_ns: int, last: bool = False) -> MotionPart | None:
        """Return the part from where the robot stands to `to_ns`, or None if it does not move."""
        if self.coasts:
            return self._coast(to_ns)
        if not self.motion.held:
            return self._lost(to_ns)
        if self.u is None or self.N is None or self.t_ns is None or to_ns <= self.t_ns:
            return None
        unknown = None if self.gaps is None or to_ns <= self.gaps.late_ns else self.gaps.unknown(to_ns)
        part = MotionPart(self.u, self.N, (to_ns - self.t_ns) * 1e-9, self.fresh, last, unknown, self.usual)
        self.t_ns, self.fresh = to_ns, False
        return part

    def _lost(self, to_ns: int, u: Array | None = None) -> MotionPart | None:
        """Return what is unknown of the motion up to a time, of increments that are late; u (k,) ends then."""
        unknown = None if self.gaps is None else self.gaps.unknown(to_ns, u)
        return None if unknown is None else self._uncontrolled(0.0, unknown)

    def _uncontrolled(self, dt_s: float, unknown: Array | None = None) -> MotionPart:
        """Return a part of its motion without a control."""
        k = len(self.motion.columns)
        return MotionPart(np.zeros(k), np.zeros((k, k)), dt_s, True, True, unknown)

    def noticed(self) -> tuple[Gap, ...]:
        """Return the gap that was detected since the last call, if any."""
        if self.gaps is None or self.gaps.noticed is None:
            return ()
        gap, self.gaps.noticed = self.gaps.noticed, None
        return (gap,)

    def located(self, t_ns: int, is_heading_known: bool) -> None:
        """Take note that the pose was corrected, and whether its heading is known again."""
        if self.gaps is not None:
            self.gaps.located(t_ns, is_heading_known)

    @property
    def is_adrift(self) -> bool:
        """True if its pose may be anywhere since a gap."""
        return self.gaps is not None and self.gaps.adrift

    def lags(self, t_ns: int) -> bool:
        """Return whether the pose of a robot is still that before a time: nothing has read it since."""
        moves = self.coasts or self.u is not None
        return moves and self.t_ns is not None and t_ns > self.t_ns

    def _coast(self, to_ns: int) -> MotionPart | None:
        """Return the part of a robot that needs no control to move, from the first event on."""
        t_ns, self.t_ns = self.t_ns, to_ns
        return None if t_ns is None or to_ns <= t_ns else self._uncontrolled((to_ns - t_ns) * 1e-9)

    def accept(self, control: Control) -> list[MotionPart]:
        """Take a new control; return the parts of motion it closes."""
        if control.t_ns <= self.rests_until_ns:
            return []
        if self.gaps is not None and self.gaps.limited and self.gaps.rules_out(control):
            return self._left_out(control, self.gaps)
        N = control_covariance(self.motion, control)
        if not self.motion.held:
            dt_s = 0.0 if self.t_ns is None else (control.t_ns - self.t_ns) * 1e-9
            part = self._lost(control.t_ns, control.u)
            closing = [MotionPart(control.u, N, dt_s, True, True, None, self._usual(control.u, N, dt_s))]
            self.t_ns = control.t_ns
        else:
            part, closing = self.advance(control.t_ns, last=True), []
            self.t_ns, self.u, self.N, self.fresh = control.t_ns, control.u, N, True
            self.usual = self._usual(control.u, N, 1.0)
        if self.gaps is not None:
            self.gaps.take(control)
        return closing if part is None else [part, *closing]

    def _usual(self, u: Array, N: Array, dt_s: float) -> Array | None:
        """Return the mean (k,) of earlier controls like u, and take u into it; u itself where it has changed."""
        if not self.calibrates or dt_s <= 0.0:
            return None
        rate, before = u / dt_s, self.mean
        self.mean = RateMean(rate, 1) if before is None else before.after(rate, np.sqrt(np.diag(N)) / dt_s)
        return u if before is None or self.mean.number == 1 else before.rate * dt_s

    def _left_out(self, control: Control, gaps: Gaps) -> list[MotionPart]:
        """Leave out a control that is ruled out; return the motion up to then."""
        if self.motion.held:
            part = self.advance(control.t_ns, last=True)
            gaps.leave_out(control)
            self.fresh = True
            return [] if part is None else [part]
        unknown, self.t_ns = gaps.leave_out(control), control.t_ns
        return [] if unknown is None else [self._uncontrolled(0.0, unknown)]


@dataclass
class Moving:
    """A robot in the map: its motion, its slot, the control it holds.

    `bias` and `error` are the slots of the constants of its controls and of the error that parts of a control share,
    None where there is none.
    `left_out` are the last fixes, if they were outside the gate.  `past` are its last motions, where a sensor lags.
    `fastest` are the greatest speed and turn rate, m/s and rad/s, that a state with a velocity has had.
    `constants` are the slots of the bias and of its mounts, each with the mean and the covariance that were stated.
    """

    motion: Motion
    slot: int
    bias: int | None
    held: HeldInput
    error: int | None = None
    left_out: list[RejectedFix] = field(default_factory=list)
    past: PastMotion | None = None
    fastest: tuple[float, float] = 0.0, 0.0
    constants: list[tuple[int, Array, Array]] = field(default_factory=list)
    SAVED: ClassVar = ("slot", "bias", "held", "error", "left_out", "past", "fastest")

    @cached_property
    def moves_itself(self) -> bool:
        """True if its diffusion depends on its state."""
        return isinstance(self.motion, StateDiffusion)

    @cached_property
    def has_velocity(self) -> bool:
        """True if the velocity of the robot is in its state."""
        return has_velocity_state(self.motion)

    def velocity(self, r: Array) -> tuple[Array, Array]:
        """Return the velocity b of a state r (size,) in the frame of the robot, (3 or 6,), and its Jacobian.

        Of an inertial unit it is (3,), without the turn rate, which is that of its control.
        """
        b, B = velocity_in(self.motion, r, np.zeros(len(self.motion.columns)))
        return (b[: len(b) // 2], B[: len(b) // 2]) if isinstance(self.motion, HoldsRate) else (b, B)

    def note_speed(self, map_: Map) -> None:
        """Take note of how fast it is."""
        b = self.velocity(map_.mean(self.slot))[0]
        d = self.motion.space.d
        speeds = math.hypot(*b[:d].tolist()), math.hypot(*b[d:].tolist())
        self.fastest = max(self.fastest[0], speeds[0]), max(self.fastest[1], speeds[1])

    @cached_property
    def model(self) -> Any:
        """The motion as the filter takes it."""
        return step_of(self.motion)

    def added(self, map_: Map, part: MotionPart, shared: bool) -> tuple[list[int], Array, Array]:
        """Return the slots of the blocks that change a control, how, B (m, c) by their numbers b, and u with u + B b.

        That holds at the means of the constants, and B is that of the control as it usually is.  The first is the error
        of the control where that is `shared`.
        """
        u, slots = part.u, [self.error] if shared and self.error is not None else []
        B = identity_effect(len(u)) if slots else no_effect(len(u))
        if self.bias is None or not isinstance(self.motion, SelfCalibrating):
            return slots, B, u
        a = map_.mean(self.bias)
        true, U_a = true_control(self.motion, u, a, part.dt_s)
        if part.usual is not None:
            U_a = true_control(self.motion, part.usual, a, part.dt_s)[1]
        return [*slots, self.bias], np.hstack([B, U_a]), true - U_a @ a

    def leads_somewhere(self, map_: Map, parts: Sequence[MotionPart]) -> bool:
        """Return whether parts of its controls, one after the other, lead to finite places, with finite covariances."""
        r = map_.mean(self.slot)
        for part in parts:
            slots, B, u = self.added(map_, part, self.error is not None and part.shares and not part.first)
            u = u + (B @ np.concatenate([map_.mean(block) for block in slots]) if slots else 0.0)
            moved = step(self.model, r, u, part.dt_s)
            if not moved_noise(*moved, part.N)[1]:
                return False
            r = moved[0]
        return True

    def movement(self, map_: Map, part: MotionPart) -> Movement:
        """Return what one part of its control does to the robot in a map."""
        u, N, dt_s, first, _last, unknown, _usual = part
        motion: Any = self.motion
        D = motion.diffusion_at(map_.mean(self.slot), u, dt_s) if self.moves_itself else motion.diffusion(u, dt_s)
        if unknown is not None:
            D = unknown if D is None else unknown + D
        shared = self.error is not None and part.shares  # with other parts: it is a block of the map
        slots, B, u = self.added(map_, part, shared)
        D = NO_NOISE if D is None else D
        return Movement(self.model, self.slot, slots, shared, shared and first, B, u, N, D, dt_s)


def bias_name(robot: str) -> str:
    """Return the name of the constants of a robot's controls in the map."""
    return f"{robot} bias"


def bias_block(motion: Motion) -> tuple[Space, Array, Array] | None:
    """Return the space, the mean (c,) and the covariance (c, c) of the constants of a motion's controls, or None."""
    model = self_calibrating(motion)
    return (
        None if model is None else (Rn(len(model.calibration)), np.zeros(len(model.calibration)), model.calibration_cov)
    )


@lru_cache
def identity_effect(size: int) -> Array:
    """Return the effect (size, size) of an error of the control itself."""
    return np.eye(size)


@lru_cache
def no_effect(size: int) -> Array:
    """Return the effect (size, 0) of no constants."""
    return np.zeros((size, 0))
