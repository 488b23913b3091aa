"""The seam: where a sensor on a robot and a landmark of the map meet, the chain rule written out.  [S] A.5, (63), (64).

`expectation` is the readable form and serves any models.  `linearize` is how the filter's kernels ask for it: plain
Python for a model written in Python, the compiled twin below for the built-in ones.  Both are tested to be equal.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from numba import types
from numba.extending import overload

from kalmark.compiled import compiled
from kalmark.geometry import frames3d
from kalmark.geometry.frames import compose
from kalmark.models import landmarks, sensors
from kalmark.models.landmarks import seen_from
from kalmark.models.landmarks3d import chained
from kalmark.models.protocols import FullSensor, Landmark, Sensor
from kalmark.models.sensors import POSITION_FIX, expect, expect3d

Array = npt.NDArray[np.float64]


def composed(r: Array, mount: Array) -> tuple[Array, Array, Array]:
    """Return the sensor's pose T = r o mount with T_r and T_s, in the plane (3,) or in space (7,)."""
    return compose(r, mount) if len(r) == 3 else frames3d.compose(r, mount)


def expectation(r: Array, mount: Array, sensor: Sensor, landmark: Landmark, l: Array) -> tuple[Array, ...]:
    """Return e = h(v) (K, m) and E_r, E_s, E_l, v being landmarks l (K, n) seen from T = r o mount.  [S] (63)."""
    T, T_r, T_s = composed(r, mount)
    v, V_T, V_l = landmark.seen_from(T, l)
    e, E_v = sensor.expect(v)
    return e, E_v @ V_T @ T_r, E_v @ V_T @ T_s, E_v @ V_l  # E_s calibrates the mount, for free


def inverse_expectation(r: Array, mount: Array, sensor: FullSensor, landmark: Landmark, y: Array) -> tuple[Array, ...]:
    """Return the landmarks l (K, n) that explain y (K, m), with L_r, L_s and L_y.  [S] (64), (31)-(34)."""
    T, T_r, T_s = composed(r, mount)
    v, V_y = sensor.invert(y)
    l, L_T, L_v = landmark.from_view(T, v)
    return l, L_T @ T_r, L_T @ T_s, L_v @ V_y


@dataclass(frozen=True)
class PythonView:
    """A sensor on its mount looking at one type of landmark, evaluated in Python."""

    sensor: Sensor
    landmark: Landmark
    mount: Array

    def linearize(self, r: Array, l: Array) -> tuple[Array, Array, Array]:
        """Return e (K, m), E_r (K, m, 3), E_l (K, m, n)."""
        e, E_r, _, E_l = expectation(r, self.mount, self.sensor, self.landmark, l)
        return e, E_r, E_l


def fix_view(antenna: Array) -> tuple[int, Array]:
    """Return the view of an absolute position fix whose antenna sits at `antenna` (3,) in the robot's frame."""
    return POSITION_FIX, antenna


def view_of(sensor: Sensor, landmark: Landmark, mount: Array) -> Any:
    """Return what `linearize` takes: (code, mount) for the compiled models, a `PythonView` for others."""
    if type(sensor) in sensors.BUILT_IN and type(landmark) in landmarks.BUILT_IN:  # not a user's subclass of them
        return int(sensor.code), mount  # type: ignore[attr-defined]
    return PythonView(sensor, landmark, mount)


def linearize(view: Any, r: Array, l: Array) -> tuple[Array, Array, Array]:
    """Return the expectations e (K, m) of landmarks l (K, n) from robot pose r, E_r (K, m, 3), E_l (K, m, n)."""
    return linearize_built_in(view, r, l) if isinstance(view, tuple) else view.linearize(r, l)


@overload(linearize, strict=False)  # type: ignore[untyped-decorator]  # strict: the annotations differ
def _compiled_linearize(view: Any, r: Any, l: Any) -> Any:
    if isinstance(view, types.BaseTuple):
        return lambda view, r, l: linearize_built_in(view, r, l)  # noqa: PLW0108 - numba compares the arguments
    return None


@compiled
def linearize_built_in(view: tuple[int, Array], r: Array, l: Array) -> tuple[Array, Array, Array]:
    """`expectation`, compiled."""
    code, mount = view
    if len(r) == 3:
        T, T_r, _ = compose(r, mount)
        if code == POSITION_FIX:  # an absolute position fix looks at no landmark
            return T[:2].copy().reshape(1, 2), T_r[:2].copy().reshape(1, 2, 3), np.zeros((1, 2, l.shape[1]))
        v, V_T, V_l = seen_from(T, l)
        e, E_v = expect(code, v)
    else:
        T, T_r, _ = frames3d.compose(r, mount)
        if code == POSITION_FIX:
            return T[:3].copy().reshape(1, 3), T_r[:3].copy().reshape(1, 3, 6), np.zeros((1, 3, l.shape[1]))
        v, V_T, V_l = frames3d.to_frame_many(T, l)
        e, E_v = expect3d(code, v)
    return e, turned(chained(E_v, V_T), T_r), chained(E_v, V_l)


@compiled
def turned(E_T: Array, T_r: Array) -> Array:
    """Return E_T @ T_r in place: T_r is the identity but for how a turn of the robot moves the sensor."""
    k, m, n = E_T.shape
    first = 2 if n == 3 else 3
    for i in range(k):
        for a in range(m):
            for c in range(first, n):
                for b in range(first):
                    E_T[i, a, c] += E_T[i, a, b] * T_r[b, c]
    return E_T
