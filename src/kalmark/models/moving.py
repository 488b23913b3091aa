"""How the filter asks a motion for its step: a built-in one compiled, by its address, a user's in Python.

A built-in motion has a function `moves` of the form MOVE; its `parameters` are the numbers that it takes.
"""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
from numba import types
from numba.extending import overload

from kalmark.arrays import Array
from kalmark.compiled import address_of, by_address, signature_of
from kalmark.declare import built_in
from kalmark.models.protocols import Motion

# of the state r (size,), the control u (m,), parameters and seconds: the new r, R_r (dof, dof), R_u (dof, m)
MOVE = signature_of("Tuple((f8[::1], f8[:, ::1], f8[:, ::1]))(f8[::1], f8[::1], f8[::1], f8)")
call_move = by_address(MOVE)


class Compiled:
    """A motion whose step is compiled."""

    moves: ClassVar[Any]

    @property
    def parameters(self) -> Array:
        """The numbers that `moves` takes."""
        return np.zeros(0)

    def move(self, r: Array, u: Array, dt_s: float) -> tuple[Array, Array, Array]:
        """Return the moved state (size,), R_r (dof, dof) and R_u (dof, m) after the control u (m,).  [S] (1)."""
        return type(self).moves(r, u, self.parameters, dt_s)


def step_of(motion: Motion) -> Any:
    """Return the argument of `step`: address and parameters of a built-in motion, else the motion."""
    if type(motion) in built_in("motion") and isinstance(motion, Compiled):
        return address_of(type(motion).moves, MOVE), motion.parameters
    return motion


def step(model: Any, r: Array, u: Array, dt_s: float) -> tuple[Array, Array, Array]:
    """Return the state (size,) after a control u (m,) of `dt_s` seconds, R_r (dof, dof) and R_u (dof, m)."""
    return call_move(model[0], (r, u, model[1], dt_s)) if isinstance(model, tuple) else model.move(r, u, dt_s)


@overload(step, strict=False)  # type: ignore[untyped-decorator]  # strict: the annotations differ
def _compiled_step(model: Any, r: Any, u: Any, dt_s: Any) -> Any:
    if isinstance(model, types.BaseTuple):
        return lambda model, r, u, dt_s: call_move(model[0], (r, u, model[1], dt_s))
    return None
