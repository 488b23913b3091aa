"""Gaps in the controls: detected by their intervals, bridged by the motion that the robot was capable of meanwhile.

A control is late if it comes after more than `TIMES` the longest interval that is usual.  In a gap the motion of the
robot is unknown: its position is anywhere within the distance that its greatest speed allows, its heading turned by
anything that its greatest turn rate allows, both uniformly, and the covariance of the pose grows by theirs.  The
estimate of an increment's robot stays where it is, a held control stays held.

A control of a motion that the limits of the robot rule out is left out, as if it had been lost.
"""

from __future__ import annotations

import math

import numpy as np

from kalmark.arrays import Array
from kalmark.errors import EventError, MapError
from kalmark.events import Control, seconds_text
from kalmark.models.protocols import Motion
from kalmark.report import Gap

TIMES = 5
RECENT = 1000  # intervals from which the usual one is found,
RANK = 5  # of which the longest four may be gaps
HELD_NS = 2_000_000_000  # a velocity or a steering angle may well be held so long
LEARNED = 20  # controls from one update of the usual interval to the next, and before the first
MARGIN = 1.2  # greatest speed over the greatest one in the log so far
NEVER_NS = 2**62
WHOLE = 1.5  # an increment at least so much larger than any before is of the whole gap: its odometry went on
RULED_OUT = 1.5  # times the limits of the robot: no such motion, but a jump of its odometry


class Gaps:
    """Detector of gaps in the controls of one robot, by their usual intervals, and bound of its motion in them.

    `max_speed_mps` and `max_turn_radps` are its limits; None: `MARGIN` times the largest so far.
    """

    last_ns: int | None  # time of the last control
    since_ns: int | None  # from when on the motion is unknown,
    until_ns: int  # and up to when the pose has been widened for it
    left_out_ns: int | None  # since when controls are left out
    usual_ns: int
    bound_ns: int | None  # what is later is a gap, None: not known yet
    intervals: tuple[int, ...]
    pending: tuple[tuple[int, Array], ...]
    largest: Array  # of an increment: per second
    adrift: bool  # whether the pose may be anywhere since a gap

    def __init__(
        self, robot: str, motion: Motion, action: str, max_speed_mps: float | None, max_turn_radps: float | None
    ) -> None:
        self.robot, self.motion, self.action = robot, motion, action
        self.max_speed_mps, self.max_turn_radps = max_speed_mps, max_turn_radps
        self.limited = action != "ignore" and (max_speed_mps, max_turn_radps) != (None, None)
        self.last_ns = self.since_ns = self.left_out_ns = self.bound_ns = None
        self.until_ns, self.usual_ns, self.intervals, self.pending, self.adrift = 0, 0, (), (), False
        self.largest = np.zeros(len(motion.columns))
        self.late_ns = NEVER_NS  # after which the next is late
        self.noticed: Gap | None = None

    def restored(self) -> None:
        """Expect the next control by what a file has.  Raises MapError for controls of another length."""
        if {len(u) for u in (self.largest, *(u for _, u in self.pending))} != {len(self.motion.columns)}:
            raise MapError(f"controls of {self.robot!r} are no arrays of {len(self.motion.columns)} numbers")
        if self.last_ns is not None and self.bound_ns is not None:
            self.late_ns = self.last_ns + self.bound_ns
        if self.since_ns is not None:
            self.late_ns = min(self.late_ns, self.since_ns)

    def take(self, control: Control) -> None:
        """Count the interval of a control, which ends a gap."""
        if self.last_ns is not None:
            self.pending = (*self.pending, (control.t_ns - self.last_ns, control.u))
            if len(self.pending) == LEARNED:
                self._update_intervals()
        self._go_on(control.t_ns)

    def _go_on(self, t_ns: int) -> None:
        self.last_ns, self.since_ns, self.left_out_ns = t_ns, None, None
        if self.bound_ns is not None:
            self.late_ns = t_ns + self.bound_ns

    def rules_out(self, control: Control) -> bool:
        """Return whether a control is of a motion far beyond the limits that the robot was given."""
        if not self.limited or (self.usual_ns == 0 and not self.motion.held):
            return False
        limits = self.max_speed_mps, self.max_turn_radps
        rates = self._rates(control.u, self.usual_ns if self.last_ns is None else control.t_ns - self.last_ns)
        return any(limit is not None and rate > RULED_OUT * limit for rate, limit in zip(rates, limits, strict=True))

    def leave_out(self, control: Control) -> Array | None:
        """Take a control that is ruled out for lost; return the covariance of what has been moved, of an increment.

        A held control stays held, and the motion is unknown from then on.  Raises EventError where that is refused.
        """
        if self.action == "refuse":
            what = f"{self.robot!r}: u is {control.u.tolist()} at t={seconds_text(control.t_ns)} s"
            raise EventError(f"{what}, expected at most {self.max_speed_mps} m/s and {self.max_turn_radps} rad/s")
        begin = control.t_ns if self.motion.held or self.last_ns is None else self.last_ns
        if self.since_ns is None:
            self.since_ns = self.until_ns = begin
        self.left_out_ns = begin if self.left_out_ns is None else self.left_out_ns
        self.late_ns = min(self.late_ns, begin)
        if self.motion.held:
            return None
        D = self.unknown(control.t_ns)
        self._go_on(control.t_ns)
        return D

    def _update_intervals(self) -> None:
        times = np.array([dt for dt, _ in self.pending])
        kept = times if self.bound_ns is None else np.minimum(times, self.bound_ns)  # a gap changes little
        self.intervals = (*self.intervals, *kept.tolist())[-RECENT:]
        ordered = sorted(self.intervals)
        least = HELD_NS if self.motion.held else 0
        self.usual_ns, self.bound_ns = ordered[len(ordered) // 2], max(TIMES * ordered[-RANK], least)
        sizes = np.abs([u for _, u in self.pending])
        if not self.motion.held:
            sizes /= np.maximum(times, max(self.usual_ns, 1))[:, None] * 1e-9
        self.largest, self.pending = np.maximum(self.largest, sizes.max(axis=0)), ()

    def located(self, t_ns: int, is_heading_known: bool) -> None:
        """Take note that the pose was corrected: the motion is unknown from then on, the pose if its heading is."""
        if self.since_ns is not None:
            self.since_ns = self.until_ns = t_ns
        self.adrift = self.adrift and not is_heading_known

    def unknown(self, t_ns: int, u: Array | None = None) -> Array | None:
        """Return the covariance (dof, dof) of the motion that is unknown up to a time, None if it is known.

        `u` is the increment that ends then.  Raises EventError for a gap that is refused.
        """
        if t_ns <= self.late_ns or self.last_ns is None or self._is_of_all(t_ns, u):
            return None
        if self.action == "refuse" and self.left_out_ns is None:
            gap_s, usual_s = (t_ns - self.last_ns) * 1e-9, self.usual_ns * 1e-9
            what = f"{self.robot!r} had no control for {gap_s:.3g} s from t={seconds_text(self.last_ns)} s on"
            raise EventError(f"{what}, expected one every {usual_s:.3g} s; gaps: widen bridges that")
        if self.since_ns is None:
            self.since_ns = self.until_ns = self.last_ns + (self.usual_ns if self.motion.held else 0)
        ends_ns = t_ns if u is None else max(t_ns - self.usual_ns, self.until_ns)
        D, self.until_ns = self._reached(ends_ns) - self._reached(self.until_ns), ends_ns
        if self.action == "ignore":
            D[:] = 0.0
        self.adrift = self.adrift or bool(D.any())
        kind, start_ns = "held" if self.motion.held else "increments", self.last_ns
        if self.left_out_ns is not None:
            kind, start_ns = "ruled_out", self.left_out_ns
        sigmas = np.sqrt(D.diagonal()[[0, self.motion.space.pose.dof - 1]]).tolist()
        self.noticed = Gap(self.robot, kind, start_ns, t_ns, *sigmas)
        return D if D.any() else None

    def _is_of_all(self, t_ns: int, u: Array | None) -> bool:
        """Return whether an increment is of the whole gap: far larger than any usual one, yet possible in that time.

        All of N usual intervals are N times as large as one, and sqrt(N) lies between: a robot that has driven straight
        ahead until then may be turning when its odometry comes back.
        """
        if u is None or self.last_ns is None or self.since_ns is not None:
            return False
        usual_s, gap_s = max(self.usual_ns, 1) * 1e-9, (t_ns - self.last_ns) * 1e-9
        larger = (np.abs(u) > max(WHOLE, math.sqrt(gap_s / usual_s)) * self.largest * usual_s).any()
        return bool(larger and (np.abs(u) <= MARGIN * self.largest * gap_s).all())

    def _reached(self, t_ns: int) -> Array:
        """Return the covariance of what it may have moved by since its motion is unknown."""
        assert self.since_ns is not None
        after_s, space = (t_ns - self.since_ns) * 1e-9, self.motion.space
        u = self.largest if self.motion.held else self.largest * self.usual_ns * 1e-9
        speed, turn = self._rates(u, self.usual_ns)
        speed, turn = self.max_speed_mps or MARGIN * speed, self.max_turn_radps or MARGIN * turn
        d, D = space.d, np.zeros((space.dof, space.dof))
        D[np.arange(d), np.arange(d)] = (speed * after_s) ** 2 / (d + 2)
        angles = np.arange(d, d + space.axes)
        D[angles, angles] = min(turn * after_s, math.pi) ** 2 / (space.axes + 2)
        return D

    def _rates(self, u: Array, dt_ns: int) -> tuple[float, float]:
        """Return the speed and the turn rate of a control that lasts so long, and at least the usual time."""
        space, dt_s = self.motion.space, max(dt_ns, self.usual_ns, 1) * 1e-9
        origin = np.zeros(space.size)
        if space.axes > 1:
            origin[6] = 1.0
        moved = self.motion.move(origin, u, dt_s)[0]
        if space.axes == 1:
            turned = abs(float(moved[2]))
        else:
            turned = 2.0 * math.atan2(float(np.linalg.norm(moved[3:6])), abs(float(moved[6])))
        return float(np.linalg.norm(moved[: space.d])) / dt_s, turned / dt_s
