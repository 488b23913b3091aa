"""The state of a landmark of each kind in space at given points."""

from __future__ import annotations

from typing import Any

import numpy as np

from kalmark.geometry.rotations import exp, from_euler, matrix, multiply


def placed(landmark: Any, T: np.ndarray, p: np.ndarray, q: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return a landmark of a kind at p (a line: from p to q) in the frame T."""
    a, b = (T[:3] + matrix(T[3:]) @ x for x in (p, q))
    anchor = rng.normal(size=3) * 3
    if landmark.kind == "tag":
        facing = multiply(T[3:], multiply(from_euler(np.array([np.pi, 0.0, 0.0]))[0], exp(rng.normal(size=3) * 0.4)))
        return np.concatenate([a, facing])
    m, n = a - anchor, b - anchor
    rho, s = 1 / np.linalg.norm(m), 1 / np.linalg.norm(n)

    def angles(w: np.ndarray) -> list[float]:
        return [np.arctan2(w[1], w[0]), np.arctan2(w[2], np.hypot(w[0], w[1]))]

    states: dict[str, Any] = {
        "point3": a,
        "inverse_depth": [*anchor, *angles(m), rho],
        "anchored_homogeneous": [*anchor, *(m * rho), rho],
        "homogeneous": [*(a * 0.3), 0.3],
        "pluecker_line": [*np.cross(a, b - a), *(b - a)],
        "anchored_pluecker_line": [*anchor, *np.cross(m, n - m), *(n - m)],
        "inverse_depth_line": [*anchor, *angles(m), rho, *angles(n), s],
        "anchored_homogeneous_line": [*anchor, *(m * rho), rho, *(n * s), s],
        "homogeneous_line": [*(a * 0.3), 0.3, *(b * 0.1), 0.1],
    }
    return np.array(states[landmark.kind], dtype=np.float64)
