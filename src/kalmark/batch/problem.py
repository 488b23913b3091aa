"""The least-squares problem of a whole log: motion between poses, and what the factors say of the state.

The motion is carried as constraints with a covariance that may be singular: a held control has two errors for the three
coordinates of a pose, an exact start has none.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp

from kalmark.batch.factors import Block, Factor, Term
from kalmark.batch.state import ORIGIN, POSE_SPACES, POSES, Array, Flags, Ints, State, beyond
from kalmark.events import Id


@dataclass(frozen=True, eq=False)
class Motions:
    """The errors w (n, q) of the robots' motion as the residuals of `term`, their covariance `Q` (q n, q n)."""

    term: Term
    Q: sp.csr_array


def motions(previous: Ints, step: Array, Q: sp.csr_array) -> Motions:
    """Return the motion of all robots: pose i follows pose `previous[i]` (-1: the origin, for a start) by `step[i]`.

    The steps (n, 3) or (n, 7) are in the frames of the previous poses, and so are their errors, whose covariance Q has
    blocks between steps that share a held control.  None at all: poses without motion.
    """
    started, space = previous >= 0, POSE_SPACES[step.shape[1]]

    def residuals(a: Array, b: Array) -> tuple[Array, Array]:
        w, W = beyond(np.where(started[:, None], a, ORIGIN[space.size]), b, step)
        W[~started, :, : space.dof] = 0.0
        return w, -W

    blocks = Block(POSES, np.where(started, previous, 0), space), Block(POSES, np.arange(len(step)), space)
    return Motions(Term(residuals, blocks), Q)


class Linearized(NamedTuple):
    """A problem at a state: whitened residuals z and H, their `chi2`, the motion's errors w and their Jacobian J."""

    state: State
    z: Array
    H: sp.csr_array
    chi2: float
    w: Array
    J: sp.csr_array


@dataclass(frozen=True, eq=False)
class Problem:
    """Minimise the whitened residuals + w' Q^+ w, w the errors of the motion, which must lie in the range of Q.

    `free` says which numbers of a step are unknown; the others are held.  The search begins at `start`.  `ids` name the
    landmarks, of `kind`, and `nodes` (S,) are the poses at the scans of the log.
    """

    motions: Motions
    factors: tuple[Factor, ...]
    free: Flags
    start: State
    ids: list[Id]
    nodes: Ints
    kind: str

    def at(self, state: State) -> Linearized:
        """Return the problem linearised at a state."""
        rows = [factor.rows(state) for factor in self.factors]
        z = np.concatenate([np.empty(0), *(r.z for r in rows)])
        H = sp.vstack([sp.csr_array((0, state.ends[-1])), *(r.H for r in rows)], format="csr")
        w, E = self.motions.term.at(state)
        J = self.motions.term.jacobian(-E, state)
        return Linearized(state, z, H, sum(r.chi2 for r in rows), w.ravel(), J)

    def hessian(self, state: State, multipliers: Array) -> sp.csr_array:
        """Return the second derivative of the Lagrangian |z|^2 / 2 + m' w."""
        total = self.motions.term.hessian(state, lambda w: multipliers.reshape(w.shape))
        for factor in self.factors:
            total = sp.csr_array(total + factor.hessian(state))
        return total

    def left(self, state: State) -> list[tuple[str, Array]]:
        """Return what a state leaves of each sensor's measurements, (K, p); NaN where a landmark is not in view."""
        return [(factor.sensor, factor.term.at(state)[0]) for factor in self.factors if factor.sensor]
