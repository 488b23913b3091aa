"""The errors of an inertial unit that turn with its heading, in the invariant filter.

A correction of the heading by psi is a motion of the world, x = S(psi) x_hat.  Biases, and what they did to tilt and
velocity, are the unit's own: R = S(psi) Exp(tau) R_hat, and tau = M R_hat d_b of a bias in the body, whatever psi is.
So the error that is left after the correction is S(psi) (tau - tau_hat), and likewise that of a velocity: the errors
turn by as much as the heading.  Without it the covariance of tilt and bias stays where the heading was.
docs/inertial.md.
"""

from __future__ import annotations

import numpy as np

from kalmark.arrays import Array
from kalmark.filter.gauge_transport import about_vertical
from kalmark.filter.map import StochasticMap
from kalmark.geometry.rotations import matrix, skew
from kalmark.geometry.spaces import OWN, ROTATION, SCALAR, VECTOR3, Space

UNIT = VECTOR3, ROTATION, OWN, *(SCALAR,) * 6  # pose, velocity, biases; what follows is the gravity


def has_units(map_: StochasticMap) -> bool:
    """Return whether there is an inertial unit in a map."""
    return map_.axes > 1 and bool((map_.atoms[:, 0] == OWN).any())


def turn_own_errors(map_: StochasticMap, robot: int, before: Array) -> None:
    """Let the errors of each inertial unit turn as it did in a correction, by `robot`, of the whole mean `before`."""
    for slot, space in enumerate(map_.spaces):
        if space is not None and space.kinds[: len(UNIT)] == UNIT:
            T = error_transport(space, before[map_.numbers(slot)], map_.mean(slot), slot == robot)
            map_.predict(map_.index(slot), T, np.zeros((space.dof, space.dof)))


def error_transport(space: Space, before: Array, after: Array, observes: bool) -> Array:
    """Return T (dof, dof): the errors d (dof,) of an inertial unit, corrected from `before` to `after`, become T d.

    Attitude, velocity and gravity turn as the attitude did, about the vertical alone where that is known, so that the
    heading stays as unobservable as it was.  The turn is one of xi = d - generator d_theta: to E xi + generator E
    d_theta.  Where the vertical is known, d_theta of the unit that `observes` has turned in the correction.
    """
    E, T, M = matrix(after[3:7]) @ matrix(before[3:7]).T, np.eye(space.dof), np.eye(3)
    if space.kinds == UNIT:
        E = about_vertical(E)
        M = E.T if observes else M
    T[3:6, 3:6] = M @ E  # what has turned stays
    for kind, at, k in space.atoms[2:]:
        if kind == OWN:
            g = -skew(after[at : at + 3])
            T[k : k + 3, k : k + 3], T[k : k + 3, 3:6] = E, g @ T[3:6, 3:6] - E @ g @ M
    return T
