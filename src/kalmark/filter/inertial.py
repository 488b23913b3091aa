"""What the invariant filter does besides for an inertial unit: errors of its own turn with its heading.

A correction of the heading by psi is a motion of the world, x = S(psi) x_hat.  Biases, and what they did to tilt and
velocity, are the unit's own: R = S(psi) Exp(tau) R_hat, and tau = M R_hat d_b of a bias in the body, whatever psi is.
So the error that is left after the correction is S(psi) (tau - tau_hat), and likewise that of a velocity: the errors
turn by as much as the heading.  Without it the covariance of tilt and bias stays where the heading was.
docs/inertial.md.
"""

from __future__ import annotations

import math

import numpy as np

from kalmark.arrays import Array
from kalmark.filter.map import StochasticMap
from kalmark.geometry.rotations import exp, matrix, skew
from kalmark.geometry.spaces import OWN, ROTATION, SCALAR, VECTOR3, Space

UNIT = VECTOR3, ROTATION, OWN, *(SCALAR,) * 6  # pose, velocity, biases; what follows is the gravity


def turn_own_errors(map_: StochasticMap, before: Array) -> None:
    """Let the errors of each inertial unit turn as it did in a correction of the whole mean `before`."""
    for slot, space in enumerate(map_.spaces):
        if space is not None and space.kinds[: len(UNIT)] == UNIT:
            T = carried(space, before[map_.numbers(slot)], map_.mean(slot))
            map_.predict(map_.index(slot), T, np.zeros((space.dof, space.dof)))


def carried(space: Space, before: Array, after: Array) -> Array:
    """Return T (dof, dof): the errors d (dof,) of an inertial unit, corrected from `before` to `after`, become T d.

    Attitude, velocity and gravity turn as the attitude did, about the vertical alone where that is known, so that the
    heading stays as unobservable as it was.  What turns is xi = d - generator d_theta: to E xi + generator E d_theta.
    """
    E, T = matrix(after[3:7]) @ matrix(before[3:7]).T, np.eye(space.dof)
    if space.kinds == UNIT:
        E = matrix(exp(np.array([0.0, 0.0, math.atan2(E[1, 0] - E[0, 1], E[0, 0] + E[1, 1])])))
    T[3:6, 3:6] = E
    for kind, at, k in space.atoms[2:]:
        if kind == OWN:
            g = -skew(after[at : at + 3])
            T[k : k + 3, k : k + 3], T[k : k + 3, 3:6] = E, g @ E - E @ g
    return T
