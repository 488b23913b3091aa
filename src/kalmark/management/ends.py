"""The ends of the segments seen of lines: kept beside the filter, which knows endless lines only.  [TB] extPolicy."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from kalmark.geometry.frames3d import to_frame_many
from kalmark.models.cameras import project_pinhole
from kalmark.models.segments import crossing_angles, extended

Array = npt.NDArray[np.float64]

NO_LENS = np.zeros(0)


def extended_ends(sensor: Any, kind: Any, T: Array, l: Array, P: Array, t: Array, y: Array) -> Array:
    """Return the abscissas (2,) of a segment t on the line l (n,), covariance P, after a sensor at T saw y (4,)."""
    rays = sensor.invert(y[None])[0]
    line, ends = l[None], t[None]
    p, P_l = kind.endpoints(line, ends)
    measured = kind.abscissas(T, line, rays)
    if hasattr(kind, "prior_beta_1"):
        worst = np.array([max(sigma_px(sensor, T, p[0, i], P_l[0, i] @ P @ P_l[0, i].T) for i in range(2))])
        return extended(ends, measured, sigma_px=worst, switch_px=kind.switch_px)[0]
    return extended(ends, measured, angles=crossing_angles(T, p, rays))[0]


def sigma_px(sensor: Any, T: Array, p: Array, P: Array) -> float:
    """Return the largest sigma in the image of a sensor at T of the point p (3,) with covariance P; inf behind it."""
    v, _, V_p = to_frame_many(T, p[None])
    if v[0, 2] <= 0:
        return float("inf")
    E = project_pinhole(v, sensor.parameters, NO_LENS)[1][0] @ V_p[0]
    return float(np.sqrt(np.linalg.eigvalsh(E @ P @ E.T)[-1]))
