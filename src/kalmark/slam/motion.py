"""A robot's clock: cuts its controls into the parts by which the robot is moved.

A rate acts from its time until the robot's next control, so a scan in between splits its interval.  The error of the
control is common to both parts.  An increment is the motion that ended at its time.  A robot that coasts moves without
a control, which changes its velocity at its time.
"""

from __future__ import annotations

from typing import Any, NamedTuple, Self

import numpy as np
import numpy.typing as npt

from kalmark.errors import EventError
from kalmark.events import Control
from kalmark.geometry.angles import rotation
from kalmark.geometry.rotations import matrix
from kalmark.models.protocols import Motion

Array = npt.NDArray[np.float64]


class Part(NamedTuple):
    """One piece of motion: the control, the covariance N of its error, and its duration.

    `first` and `last` say whether it begins and ends its control's interval: if not both, the error is shared.
    """

    u: Array
    N: Array
    dt_s: float
    first: bool
    last: bool


class Drive:
    """The control in force of one robot and how far it has been acted upon.

    As a context manager it puts the clock back if what the robot is told turns out to be impossible.
    """

    def __init__(self, motion: Motion) -> None:
        self.motion = motion
        self.coasts = bool(getattr(motion, "coasts", False))
        self.t_ns: int | None = None
        self.u: Array | None = None
        self.N: Array | None = None
        self.fresh = True
        self._before: tuple[Any, ...] = ()

    def __enter__(self) -> Self:
        self._before = self.t_ns, self.u, self.N, self.fresh
        return self

    def __exit__(self, kind: Any, *_: object) -> None:
        if kind is not None and issubclass(kind, EventError):
            self.t_ns, self.u, self.N, self.fresh = self._before

    def advance(self, to_ns: int, last: bool = False) -> Part | None:
        """Return the part from where the robot stands to `to_ns`, or None if it does not move."""
        if self.coasts:
            return self._coast(to_ns)
        if self.u is None or self.N is None or self.t_ns is None or to_ns <= self.t_ns:
            return None
        part = Part(self.u, self.N, (to_ns - self.t_ns) * 1e-9, self.fresh, last)
        self.t_ns, self.fresh = to_ns, False
        return part

    def lags(self, t_ns: int) -> bool:
        """Return whether a robot is still where it was before a time: nothing has asked for it yet."""
        moves = self.coasts or self.u is not None
        return moves and self.t_ns is not None and t_ns > self.t_ns

    def _coast(self, to_ns: int) -> Part | None:
        """Return the part of a robot that needs no control to move, from the first event on."""
        t_ns, self.t_ns = self.t_ns, to_ns
        if t_ns is None or to_ns <= t_ns:
            return None
        k = len(self.motion.columns)
        return Part(np.zeros(k), np.zeros((k, k)), (to_ns - t_ns) * 1e-9, True, True)

    def accept(self, control: Control) -> list[Part]:
        """Take a new control; return the parts of motion it closes."""
        N = self.motion.control_noise(control.u) if control.cov is None else control.cov
        if not self.motion.held:
            dt_s = 0.0 if self.t_ns is None else (control.t_ns - self.t_ns) * 1e-9
            self.t_ns = control.t_ns
            return [Part(control.u, N, dt_s, True, True)]
        part = self.advance(control.t_ns, last=True)
        self.t_ns, self.u, self.N, self.fresh = control.t_ns, control.u, N, True
        return [] if part is None else [part]


def body_axes(state: Array) -> Array:
    """Return what turns an error from the robot's frame into the world's: (3, 3) in the plane, (6 or more) in space."""
    if len(state) == 3:
        G = np.eye(3)
        G[:2, :2] = rotation(state[2])
        return G
    G = np.eye(len(state) - 1)
    turned = min(9, len(G))  # position, orientation and velocity; a body rate is in the robot's frame anyway
    G[:turned, :turned] = np.kron(np.eye(turned // 3), matrix(state[3:7]))
    return G
