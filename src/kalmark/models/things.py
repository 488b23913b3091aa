"""Things without a pose: a state of any atoms, moved by one function of your own.  [F] 11.3.  docs/factors.md.

The map has a pose of every robot.  That of a thing is the origin, known exactly, and the state is behind it, so that
each part of kalmark takes a thing as it takes a robot.
"""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np

from kalmark.arrays import Array
from kalmark.geometry.spaces import SE2, SE3, Rn, Space


class Thing:
    """Base of motions of what has no pose: `state` is its space, `step` its motion.  Its `world` is "plane" or "space".

    >>> class Cart(km.motion.Thing):
    ...     state, columns = km.geometry.Rn(2), ("a_mps2",)
    ...
    ...     def step(self, x, u, dt_s):
    ...         F, B = np.array([[1.0, dt_s], [0.0, 1.0]]), np.array([[0.0], [dt_s]])
    ...         return F @ x + B @ u, F, B
    >>> Cart().move(np.array([0.0, 0.0, 0.0, 1.0, 2.0]), np.array([0.5]), 1.0)[0]
    array([0. , 0. , 0. , 3. , 2.5])
    """

    state: ClassVar[Space] = Rn(0)
    world: ClassVar[str] = "plane"
    columns: ClassVar[tuple[str, ...]] = ()
    held: ClassVar[bool] = True
    space: ClassVar[Space] = SE2

    def __init_subclass__(cls, **given: Any) -> None:
        """Put the pose before the state."""
        super().__init_subclass__(**given)
        cls.space = Space(cls.__name__, ((SE3 if cls.world == "space" else SE2).kinds + cls.state.kinds))

    def step(self, x: Array, u: Array, dt_s: float) -> tuple[Array, Array, Array]:
        """Return the state (n,) after a control u (m,) of `dt_s`, X_x (n, n) and X_u (n, m); by default it stays."""
        return x, np.eye(self.state.dof), np.zeros((self.state.dof, len(u)))

    def gathered(self, u: Array, dt_s: float) -> Array | None:
        """Return the covariance (n, n) that the state gathers in `dt_s`; by default None."""
        return None

    def control_noise(self, u: Array) -> Array:
        """Return the covariance N (m, m) of a control; by default 0."""
        return np.zeros((len(u), len(u)))

    def move(self, r: Array, u: Array, dt_s: float) -> tuple[Array, Array, Array]:
        """Return pose and state (size,) after a control u (m,) of `dt_s`, R_r (dof, dof) and R_u (dof, m)."""
        size, n = self.state.size, self.state.dof
        x, X_x, X_u = self.step(r[len(r) - size :], u, dt_s)
        R_r, R_u = np.eye(self.space.dof), np.zeros((self.space.dof, len(u)))
        R_r[-n:, -n:], R_u[-n:] = X_x, X_u
        return np.concatenate([r[: len(r) - size], x]), R_r, R_u

    def diffusion(self, u: Array, dt_s: float) -> Array | None:
        """Return the covariance (dof, dof) gathered in `dt_s`, that of the pose 0."""
        Q, n = self.gathered(u, dt_s), self.state.dof
        if Q is None:
            return None
        out = np.zeros((self.space.dof, self.space.dof))
        out[-n:, -n:] = Q
        return out
