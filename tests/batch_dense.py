"""The batch solution in its plainest form: all errors and landmarks in one dense least-squares problem.

The poses follow from the errors (a standard normal each) by composing the steps, so a singular covariance needs no
special treatment: an error that is zero is no unknown.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from kalmark.geometry.angles import wrap
from kalmark.geometry.frames import compose

Array = np.ndarray


@dataclass
class Link:
    """Node `node` follows node `previous` (-1: the origin) by `step` + `G` g, g being the errors numbered `errors`."""

    previous: int
    step: Array
    G: Array
    errors: list[int]


@dataclass
class Sight:
    """Range and bearing `y` with sigmas of landmark `landmark` (or of node `-1 - landmark`) from a mount on a node."""

    node: int
    landmark: int
    y: Array
    sigma: Array
    mount: Array


def link(previous: int, motion: Callable[[Array], Array], errors: list[int]) -> Link:
    """Return the link of a motion(g) -> step, linearised by differences about no error."""
    h, k = 1e-5, len(errors)
    G = np.array([(motion(h * e) - motion(-h * e)) / (2 * h) for e in np.eye(k)]).reshape(k, 3).T
    return Link(previous, motion(np.zeros(k)), G, errors)


def optimum(
    links: list[Link], sights: list[Sight], landmarks: Array, positions: Sequence[tuple[int, Array, float]] = ()
) -> tuple[Array, Array, Array, float]:
    """Return poses (n, 3), landmarks (m, 2), their joint covariance and chi2; `positions` are (node, xy, sigma)."""
    count = 1 + max((e for l in links for e in l.errors), default=-1)

    def poses(g: Array) -> Array:
        out: list[Array] = []
        for l in links:
            before = np.zeros(3) if l.previous < 0 else out[l.previous]
            out.append(compose(before, l.step + l.G @ g[l.errors])[0])
        return np.array(out)

    def residuals(x: Array) -> Array:
        path, points = poses(x[:count]), x[count:].reshape(-1, 2)
        out = [x[:count]]
        for s in sights:
            T = compose(path[s.node], s.mount)[0]
            d = (points[s.landmark] if s.landmark >= 0 else path[-1 - s.landmark, :2]) - T[:2]
            e = np.array([np.hypot(*d), np.arctan2(d[1], d[0]) - T[2]])
            out.append(np.array([s.y[0] - e[0], wrap(s.y[1] - e[1])]) / s.sigma)
        out += [(path[node, :2] - xy) / sigma for node, xy, sigma in positions]
        return np.concatenate(out)

    x = np.concatenate([np.zeros(count), landmarks.ravel()])
    found = least_squares(residuals, x, jac="3-point", x_scale="jac", xtol=1e-15, ftol=1e-15, gtol=1e-12)
    P = np.linalg.inv(found.jac.T @ found.jac)[count:, count:]
    return poses(found.x[:count]), found.x[count:].reshape(-1, 2), P, float(2 * found.cost)
