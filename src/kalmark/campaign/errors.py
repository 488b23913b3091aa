"""What the truth says of the blocks of a map: their errors in the estimator's coordinates, and of what part of them.

The error d of an estimate x is what the estimator would have to correct it by: in "log" coordinates its retraction
(`kalmark.geometry.spaces.retract`) by the error `turn` of the observing robot's orientation gives the truth, in "world"
coordinates plain plus does.  A landmark is judged by what of it has a truth, whatever its state in the map is:

=======  ====================================================================  ===
point    its Euclidean position                                                2|3
line     across itself, where the true ends are: along it, nothing is known    4
tag      its pose                                                              6
=======  ====================================================================  ===
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from kalmark.geometry.angles import wrap
from kalmark.geometry.rotations import conjugate, exp, log, multiply
from kalmark.models.landmarks import Polar2D
from kalmark.models.protocols import Pointed, Segmented, place_of
from kalmark.results.consistency import point_error, pose_error, rotation_error

Array = npt.NDArray[np.float64]

FAR = 3.0  # a point of unknown depth is judged once its depth exceeds so many of its sigmas


class Judged(NamedTuple):
    """A block's error d (f,) in own and in world coordinates, and its Jacobian F (f, dof) in the block's error.

    `place` (k, 2|3) and `truth` (k, 2|3) are the points of it to align maps by.
    """

    own: Array
    world: Array
    F: Array
    place: Array
    truth: Array


def state_error(mean: Array, truth: Array, turn: Any, coordinates: str) -> Array:
    """Return the error of a robot's state: pose (3,) or (7,), or pose, velocity and body rate (13,)."""
    if len(mean) == 3:
        return np.append(point_error(mean[:2], truth[:2], turn, coordinates), wrap(truth[2] - mean[2]))
    parts = [point_error(mean[:3], truth[:3], turn, coordinates), orientation_error(mean, truth, turn, coordinates)]
    if len(mean) == 13:
        parts += [point_error(mean[7:10], truth[7:10], turn, coordinates), truth[10:] - mean[10:]]
    return np.concatenate(parts)


def orientation_error(mean: Array, truth: Array, turn: Array, coordinates: str) -> Array:
    """Return the error (3,) of a pose's orientation: after the turn about the observing robot's, what is its own."""
    if coordinates == "world":
        return rotation_error(mean[3:7], truth[3:7])
    back = conjugate(exp(np.ascontiguousarray(turn)))
    own: Array = log(multiply(back, multiply(truth[3:7].copy(), conjugate(mean[3:7].copy()))))
    return own + turn


def robot_turn(mean: Array, truth: Array) -> Any:
    """Return the error of a robot's orientation: of its heading, or a rotation vector (3,)."""
    return wrap(truth[2] - mean[2]) if len(mean) == 3 else rotation_error(mean[3:7], truth[3:7])


def robot(mean: Array, truth: Array, turn: Any, coordinates: str, dof: int) -> Judged:
    """Compare the mean (size,) of a robot with its truth (size,)."""
    own, world = (state_error(mean, truth, turn, c) for c in (coordinates, "world"))
    return Judged(own, world, np.eye(dof), np.empty((0, 0)), np.empty((0, 0)))


def mount(mean: Array, truth: Array) -> Judged:
    """Compare the mean (7,) of a mount with its truth (7,): rotations of the world frame do not change it."""
    d = pose_error(mean, truth, "world")
    return Judged(d, d, np.eye(len(d)), np.empty((0, 0)), np.empty((0, 0)))


def landmark(model: Any, mean: Array, P: Array, truth: Array, turn: Any, coordinates: str, eye: Array) -> Judged | None:
    """Judge a landmark seen from `eye` (2|3,); None while its depth is all but unknown, or it is of another kind."""
    if len(truth) == 6:
        return line(model, mean, P, truth, turn, coordinates, eye) if isinstance(model, Segmented) else None
    if len(truth) == 7:
        if len(mean) != 7:
            return None
        own, world = (state_error(mean, truth, turn, c) for c in (coordinates, "world"))
        return Judged(own, world, np.eye(6), mean[None, :3], truth[None, :3])
    point, F = position(model, mean, len(truth))
    if isinstance(model, Pointed) and len(mean) > len(truth) and not is_known(point, F @ P @ F.T, eye):
        return None
    own, world = (point_error(point, truth, turn, c) for c in (coordinates, "world"))
    if isinstance(model, Polar2D):  # its Gaussian is on an arc: so is its error
        return Judged(unrolled(mean, own), unrolled(mean, world), F, point[None], truth[None])
    return Judged(own, world, F, point[None], truth[None])


def unrolled(l: Array, error: Array) -> Array:
    """Return the error (2,) of a polar point l (4,) with its way along the arc about the anchor unrolled."""
    u, d = np.array([np.cos(l[2]), np.sin(l[2])]), l[3]
    n, w = np.array([-u[1], u[0]]), d * u + error
    return d * np.arctan2(w @ n, w @ u) * n + (np.linalg.norm(w) - d) * u


def is_known(point: Array, P: Array, eye: Array) -> bool:
    """Return whether all sigmas of a point (d,), covariance P (d, d), are below a third of its distance."""
    return bool(np.isfinite(P).all() and FAR**2 * np.linalg.norm(P, 2) < np.sum((point - eye) ** 2))


def position(model: Any, mean: Array, d: int) -> tuple[Array, Array]:
    """Return the Euclidean position (d,) of a landmark's state, and its Jacobian (d, dof)."""
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        found = place_of(model, mean[None])
    if found is None or found[0].shape[1] != d:
        return mean[:d], np.eye(d, len(mean))
    return found[0][0], found[1][0]


def line(model: Any, mean: Array, P: Array, truth: Array, turn: Array, coordinates: str, eye: Array) -> Judged | None:
    """Judge a line by how far it passes, in two directions across it, from the two true ends (6,): four numbers."""
    l = mean[None]
    base, _ = model.endpoints(l, np.array([[0.0, 1.0]]))
    a, along = base[0, 0], base[0, 1] - base[0, 0]
    ends = truth.reshape(2, 3)
    t = (ends - a) @ along / (along @ along)
    q, Q_l = model.endpoints(l, t[None])
    across = np.linalg.svd(along[None])[2][1:]  # (2, 3): at right angles to the line
    to_eye = np.eye(3) - np.outer(along, along) / (along @ along)
    if not all(is_known(to_eye @ q[0, i], to_eye @ Q_l[0, i] @ P @ Q_l[0, i].T @ to_eye, to_eye @ eye) for i in (0, 1)):
        return None
    own, world = (point_error(q[0], ends, turn, c) @ across.T for c in (coordinates, "world"))
    F = (across @ Q_l[0]).reshape(4, -1)
    return Judged(own.ravel(), world.ravel(), F, q[0], q[0] + world @ across)
