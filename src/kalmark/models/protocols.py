"""What a motion, a sensor and a landmark must offer.  N + M, not N x M: a sensor knows a point in its own frame only.

Models are batched: K landmarks at once, values (K, d), Jacobians (K, m, d).  `pointwise` lifts one-point functions.
"""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

from kalmark.geometry.spaces import Space

Array = npt.NDArray[np.float64]


@runtime_checkable
class Motion(Protocol):
    """How a robot moves.  [S] (1), (14)-(17)."""

    @property
    def space(self) -> Space:
        """The space of the robot's state; its first coordinates are the pose."""

    @property
    def columns(self) -> tuple[str, ...]:
        """Names, with units, of the control's components: the columns of a native log."""

    @property
    def held(self) -> bool:
        """True for a rate held until the next control, False for an increment that ended at its time."""

    def move(self, r: Array, u: Array, dt_s: float) -> tuple[Array, Array, Array]:
        """Return the moved state, R_r and R_u."""

    def control_noise(self, u: Array) -> Array:
        """Return the covariance N (k, k) of the control's error, which is held as long as the control is."""

    def diffusion(self, u: Array, dt_s: float) -> Array | None:
        """Return the covariance (3, 3) gathered in `dt_s`, in the robot's frame, or None for none at all."""


@runtime_checkable
class Sensor(Protocol):
    """What a sensor measures of something at v in its own frame.  [S] (2), (18)."""

    @property
    def columns(self) -> tuple[str, ...]:
        """Names, with units, of the measurement's m components."""

    @property
    def angular(self) -> tuple[bool, ...]:
        """Which components are angles, whose differences are wrapped."""

    def expect(self, v: Array) -> tuple[Array, Array]:
        """Return the expected measurements (K, m) of v (K, d), and E_v (K, m, d)."""

    def noise(self, y: Array) -> Array:
        """Return the measurement noise R (K, m, m) of measurements y (K, m)."""


@runtime_checkable
class FullSensor(Sensor, Protocol):
    """A sensor that measures everything a landmark has, so that it can start one.  [S] (3)."""

    def invert(self, y: Array) -> tuple[Array, Array]:
        """Return what is at v (K, d) in the sensor's frame when y (K, m) is measured, and V_y (K, d, m)."""


@runtime_checkable
class NonAdditiveSensor(Sensor, Protocol):
    """A sensor whose noise depends on what it looks at, or enters inside the measurement, y = g(v, n)  [F].

    The measured values must not weigh themselves: a range noise that grows with the range, taken at the measured range,
    trusts the short ones more and pulls every landmark nearer.
    """

    @property
    def additive(self) -> bool:
        """Return True if `noise` says it all."""

    def noise_at(self, v: Array) -> Array:
        """Return E_n N E_n' (K, m, m) at v (K, d)."""


@runtime_checkable
class Landmark(Protocol):
    """How a landmark looks from a pose: v, the landmark in the frame T of the sensor."""

    @property
    def kind(self) -> str:
        """The name of this type in configurations and tables."""

    @property
    def space(self) -> Space:
        """The space of the landmark's state."""

    def seen_from(self, T: Array, l: Array) -> tuple[Array, Array, Array]:
        """Return v (K, d) of landmarks l (K, n) seen from the pose T, V_T (K, d, 3) and V_l (K, d, n)."""

    def from_view(self, T: Array, v: Array) -> tuple[Array, Array, Array]:
        """Return landmarks l (K, n) that look like v (K, d) from the pose T, L_T (K, n, 3) and L_v (K, n, d)."""
