"""Derivatives from differences, extrapolated until they hold (Ridders), in the error coordinates of each argument."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from kalmark.geometry import frames3d, rotations, wrap

Array = np.ndarray[Any, np.dtype[np.float64]]


def turned(q: Array, d: Array) -> Array:
    return rotations.multiply(rotations.exp(d), q)


def turn_between(q2: Array, q1: Array) -> Array:
    return rotations.log(rotations.multiply(q2, rotations.conjugate(q1)))


PLUS = {"plain": np.add, "frame": frames3d.plus, "quaternion": turned}
MINUS = {
    "plain": np.subtract,
    "frame": frames3d.minus,
    "quaternion": turn_between,
    "angles": lambda a, b: wrap(a - b),
}


def derivative(
    function: Callable[[Array], Array], x: Array, into: str = "plain", out: str = "plain", first: float = 0.02
) -> Array:
    """Return d function / d x; `first` is the largest step, the error of an argument is of the kind `into`."""
    dof = {"frame": 6, "quaternion": 3}.get(into, len(x))
    columns = []
    for i in range(dof):
        step = np.zeros(dof)
        step[i] = first
        best, error, row = np.zeros(0), np.zeros(0), []
        for level in range(6):
            above, below = (function(PLUS[into](x, sign * step)) for sign in (1.0, -1.0))
            new = [MINUS[out](above, below) / (2 * step[i])]
            for order, old in enumerate(row[:4]):
                new.append(new[-1] + (new[-1] - old) / (9.0 ** (order + 1) - 1))
            for order in range(1, len(new)):
                change = np.maximum(abs(new[order] - new[order - 1]), abs(new[order] - row[order - 1]))
                if level == 1 and order == 1:
                    best, error = new[1], change
                better = change < error
                best, error = np.where(better, new[order], best), np.where(better, change, error)
            row, step = new, step / 3
        columns.append(best)
    return np.stack(columns, axis=-1)


def agree(analytic: Array, numeric: Array) -> None:
    """Assert relative 1e-6, row by row."""
    assert analytic.shape == numeric.shape
    size = abs(numeric).max(axis=-1, keepdims=True)
    worst = (abs(analytic - numeric) / (size + 1e-4)).max()
    assert worst < 1e-6, f"off by {worst:.2g}\n{analytic}\n{numeric}"


def rotation_vectors(rng: np.random.Generator, count: int = 200) -> Array:
    """Draw rotation vectors, every fourth one near zero, pi or no rotation at all."""
    v = rng.normal(size=(count, 3))
    v /= np.linalg.norm(v, axis=1, keepdims=True)
    angle = rng.uniform(0, np.pi, count)
    special = [0.0, 1e-12, 1e-9, 1e-6, 1e-4, 0.0999, 0.1001, np.pi, np.pi - 1e-12, np.pi - 1e-9, np.pi - 1e-6, 3.1]
    angle[::4] = np.resize(special, len(angle[::4]))
    return v * angle[:, None]


def batched(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return `function`, made for single rotations or frames, for K of them: arguments (K, n), outputs stacked."""

    def over(*arguments: Any) -> Any:
        rows = [np.ascontiguousarray(a, dtype=np.float64) for a in arguments]
        outputs = [function(*one) for one in zip(*rows, strict=True)]
        if outputs and isinstance(outputs[0], tuple):
            return tuple(np.array(each) for each in zip(*outputs, strict=True))
        return np.array(outputs)

    return over


def frames(rng: np.random.Generator, count: int = 200) -> Array:
    """Draw frames (count, 7), near-singular rotations among them."""
    return np.hstack([rng.normal(size=(count, 3)) * 3, batched(rotations.exp)(rotation_vectors(rng, count))])
