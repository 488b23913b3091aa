"""A Gaussian sum: the pose of a robot as several Gaussians, where one cannot describe it.  Alspach and Sorenson 1972.

With an unknown heading a robot may be anywhere on a circle after its first metre; a range to a known beacon puts it on
another one.  No linearisation holds on either (`tracks/linearity.py`).  So the Gaussian is split along the
axis that bends, each part is corrected alone, and its likelihood is its weight:

    heading:    N(theta) = sum of w_i N(theta_i, PIECE_RAD), the position turned about the place where the heading began
    position:   N(p) L(y | p), L = sum of N(p; b + d u_j, C): a range d to b is a ring of Gaussians of its own

A part that does not explain an observation keeps the likelihood of an outlier.  Beside the parts stands the prior,
which is moved and not corrected, and under which an observation may be any.  Once it is likelier than all parts, which
began at an outlier, then others begin from it.  Each part is a filter of the robot alone, a `PoseHypothesis`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple, cast

import numpy as np

from kalmark.arrays import Array, Index
from kalmark.errors import MapError
from kalmark.filter.estimators import Correction, Estimator, Update
from kalmark.filter.map import NO_SLOTS, Map, StochasticMap
from kalmark.filter.observed_block import squared_distances
from kalmark.geometry.angles import rotation, wrap
from kalmark.geometry.gaussian import gate as chi2_gate
from kalmark.geometry.spaces import ANGLE, HEADING
from kalmark.models.observe import linearize
from kalmark.slam.held_control import MotionPart, Moving
from kalmark.slam.pose_hypothesis import PoseHypothesis, write_robot
from kalmark.tracks.linearity import SIGMAS, TURN_RAD, bends, turn_pose
from kalmark.tracks.survey_checks import SURVEYED

PIECES, PIECE_RAD = 12, 0.3  # of a circle of headings, and the sigma of each: they overlap to a sum that is even
OVERLAP = 1.75  # sigmas of a piece from one to the next, as there
LEAST = 1e-6  # weight that is kept, of the greatest
MOST = 128  # parts that are kept
ALIKE = 0.5  # squared distance up to which two parts are one
SETTLED, STEPS = 1e-6, 20  # m, of the search for the distance that a measurement stands for
VAGUE_RAD = 3.0  # sigma of a heading that may be any
ANYWHERE_M = 1e4  # sigma of a position that may be any
IN_A_ROW = 5  # observations that do not fit the filter of a robot, or over which a sum is linear, decide


NOWHERE = np.full(2, np.nan)


class KnownObservation(NamedTuple):
    """An observation of a landmark known exactly: `update` has one row; `gate` is that of its d2.

    The landmark of one that is a distance, or stands for one, is at l (2,).  The sensor is at `at` (3,), unless its
    mount is in the map.
    """

    update: Update
    gate: float
    l: Array = NOWHERE
    at: Array = NOWHERE

    @property
    def anywhere(self) -> float:
        """The log-likelihood of an observation that may be any."""
        return -0.25 * self.gate - 0.5 * float(np.linalg.slogdet(self.update.R[0])[1])


def log_likelihood(d2: Any, Z: Array, seen: KnownObservation) -> Any:
    """Return those of innovations of squared distances d2 (M,), NaN of none, and covariances Z (M, p, p).

    They are at least that of an outlier.
    """
    return np.fmax(-0.5 * (d2 + np.linalg.slogdet(Z)[1]), seen.anywhere - 0.25 * seen.gate)


class Parts(NamedTuple):
    """Gaussians of all blocks of a map of the plane: means and first estimates (M, n), lower triangles P (M, n, n)."""

    x: Array
    x_first: Array
    P: Array
    log_weights: Array

    @classmethod
    def joined(cls, several: Sequence[Parts]) -> Parts:
        """Return several sums as one."""
        return cls(*map(np.concatenate, zip(*several, strict=True)))

    def take(self, rows: Any) -> Parts:
        """Return some of them."""
        return Parts(*(array[rows] for array in self))

    def whole(self) -> Parts:
        """Return them with both triangles of P."""
        return self._replace(P=np.tril(self.P) + np.tril(self.P, -1).swapaxes(1, 2))


@dataclass
class GaussianSum:
    """The parts of a robot's pose, and the prior with its own log weight.

    `lead` is the log of the odds of the filter that the map has of the robot, -inf where that is none of its own but
    shows the moments of the sum.  Over these the last `linear` observations were as good as linear.
    """

    prior: PoseHypothesis
    parts: Parts
    prior_log: float
    lead: float = -math.inf
    linear: int = 0

    @classmethod
    def of(cls, map_: Map, moving: Moving, blocks: int, t_ns: int, gate: float) -> GaussianSum:
        """Return the Gaussian of a robot in a map with so many blocks that are no landmarks, as one part."""
        prior = PoseHypothesis.of(map_, moving, blocks, t_ns)
        return cls(prior, as_part(prior.map, 0.0), -0.25 * gate)

    @classmethod
    def anywhere(cls, map_: Map, moving: Moving, blocks: int, t_ns: int, gate: float) -> GaussianSum:
        """Return the sum of a robot that may be elsewhere than the map has it: without a part yet, and unlikely."""
        prior = PoseHypothesis.of(map_, moving, blocks, t_ns)
        pose, sigmas = prior.map.mean(moving.slot)[:3], np.array([ANYWHERE_M, ANYWHERE_M, VAGUE_RAD])
        write_robot(prior.map, moving, pose, np.diag(sigmas**2))
        return cls(prior, as_part(prior.map, 0.0).take(slice(0)), 0.0, 0.5 * IN_A_ROW * gate)

    def restored(self) -> None:
        """Check the arrays of a file.  Raises MapError."""
        m, n = len(self.parts.log_weights), self.prior.map.n
        if [array.shape for array in self.parts] != [(m, n), (m, n), (m, n, n), (m,)]:
            raise MapError(f"the parts of a sum do not fit its map of {n} numbers")

    @property
    def shows(self) -> bool:
        """True if the map has no filter of its own of the robot."""
        return self.lead == -math.inf

    @property
    def is_found(self) -> bool:
        """True if its parts explain what was observed better than that it may be any."""
        return np.logaddexp.reduce(self.parts.log_weights) > self.prior_log

    @cached_property
    def pose(self) -> slice:
        """The rows of the robot's pose."""
        first = int(self.prior.map.rows(self.prior.moving.slot)[0])
        return slice(first, first + 3)

    def all(self) -> list[PoseHypothesis]:
        """Return the prior and the parts."""
        return [self.prior, *self._filters(self.parts)]

    def _filters(self, parts: Parts) -> list[PoseHypothesis]:
        """Return filters that move and correct the numbers of parts."""
        return [
            replace(self.prior, map=cast(StochasticMap, self.prior.map).with_numbers(*part))
            for part in zip(*parts[:3], strict=True)
        ]

    def move(self, estimator: Estimator, part: MotionPart) -> bool:
        """Move the robot by a part of its control; return whether that leads anywhere."""
        return all([each.move(estimator, part) for each in self.all()])

    def correct(self, estimator: Estimator, update: Update) -> None:
        """Correct by a reading of the robot's own state."""
        estimator.correct(self.prior.map, update)
        seen = KnownObservation(update, chi2_gate(SURVEYED, update.R.shape[1]))
        self.parts.log_weights[:] += self._correct_parts(estimator, self.parts, seen)[1]
        self._prune()

    def _correct_parts(
        self, estimator: Estimator, parts: Parts, seen: KnownObservation
    ) -> tuple[list[Correction], Array]:
        """Correct parts by an observation; return how, and its log-likelihoods (M,)."""
        done = [estimator.correct(each.map, seen.update) for each in self._filters(parts)]
        Z = np.reshape([one.Z[0] for one in done], (-1, *seen.update.R.shape[1:]))
        return done, log_likelihood(np.array([one.d2[0] for one in done]), Z, seen)

    def observe(self, estimator: Estimator, seen: KnownObservation) -> tuple[Correction | None, float]:
        """Correct by an observation of a known landmark; return what the likeliest part expected and the evidence.

        None where all parts begin by it.  The evidence is its log-likelihood under the whole sum.
        """
        before = self._total()
        linear, rings = self._split(self.parts, seen)
        done, gains = self._correct_parts(estimator, linear, seen)
        linear.log_weights[:] += gains
        rings.log_weights[:] += seen.anywhere
        self.parts, self.prior_log = Parts.joined([linear, rings]), self.prior_log + seen.anywhere
        if not self.is_found:  # parts begin from the prior
            linear_too, rings = self._split(as_part(self.prior.map, self.prior_log), seen)
            self._correct_parts(estimator, linear_too, seen)
            self.parts = Parts.joined([self.parts, linear_too, rings])
            self.prior_log -= 0.25 * seen.gate
        self._prune()
        return done[int(linear.log_weights.argmax())] if done else None, self._total() - before

    def _total(self) -> float:
        return float(np.logaddexp(np.logaddexp.reduce(self.parts.log_weights), self.prior_log))

    def _prune(self) -> None:
        """Remove the parts without weight, and merge those that are alike."""
        w = self.parts.log_weights
        keep = np.argsort(-w, kind="stable")[:MOST]
        self.parts = self.parts.take(keep[w[keep] > w.max(initial=-math.inf) + math.log(LEAST)])
        top = max(self._total(), -1e300)
        self.parts.log_weights[:] -= top
        self.prior_log -= top
        parts = self.parts.whole()
        r, P = parts.x[:, self.pose], parts.P[:, self.pose, self.pose]
        of, (i, j) = np.arange(len(r)), np.triu_indices(len(r), 1)
        d = r[j] - r[i]
        d[:, 2] = wrap(d[:, 2])
        near = squared_distances(P[i] + P[j], d)[0] < ALIKE
        for one, other in np.column_stack([i, j])[near].tolist():
            if of[one] == one and of[other] == other:
                of[other] = one
        order = np.argsort(of, kind="stable")
        starts = np.flatnonzero(np.diff(of[order], prepend=-1))
        first, merged = parts.take(order[starts]), self._moments(parts.take(order), starts)
        is_one = np.diff(starts, append=len(r)) == 1
        for after, before in zip(merged[:3], first[:3], strict=True):
            after[is_one] = before[is_one]
        self.parts = merged

    def moments(self, slots: Sequence[int]) -> tuple[list[Array], Array]:
        """Return the means of some blocks, and their joint covariance."""
        one, rows = self._moments(self.parts, np.array([0])), [self.prior.map.rows(of) for of in slots]
        return [one.x[0, of] for of in rows], one.P[0][np.ix_(*[np.concatenate(rows)] * 2)]

    def _moments(self, parts: Parts, starts: Index) -> Parts:
        """Return the moments of sums, one of the parts from each of `starts` (G,) on.

        The mean heading and its variance -2 log |E exp(i theta)| are those of a wrapped Gaussian: a heading that may be
        any stays one, however often its moments are taken.
        """
        log_sums, t, x, P = np.logaddexp.reduceat(parts.log_weights, starts), self.pose.stop - 1, parts.x, parts.P
        of = np.repeat(np.arange(len(starts)), np.diff(starts, append=len(x)))
        w = np.exp(parts.log_weights - log_sums[of])
        D = self._plus(x, -x[starts][of])
        mean_turn = np.add.reduceat(w * np.exp(1j * D[:, t] - 0.5 * P[:, t, t]), starts)
        middle = np.angle(mean_turn)
        D[:, t] = middle[of] + wrap(D[:, t] - middle[of])
        d = np.add.reduceat(w[:, None] * D, starts)
        d[:, t] = middle
        off = D - d[of]
        cov = np.add.reduceat(w[:, None, None] * (P + off[:, :, None] * off[:, None, :]), starts)
        spread = np.minimum(-2.0 * np.log(np.maximum(np.abs(mean_turn), 1e-300)), VAGUE_RAD**2)
        cov[:, t, t] += np.maximum(0.0, spread - cov[:, t, t])
        means = self._plus(x[starts], d)
        return Parts(means, means.copy(), cov, log_sums)

    def _plus(self, x: Array, d: Array) -> Array:
        """Return means x (M, n) after errors d (M, n)."""
        moved, atoms = x + d, self.prior.map.atoms
        angles = atoms[np.isin(atoms[:, 0], (HEADING, ANGLE)), 2]
        moved[:, angles] = wrap(moved[:, angles])
        return moved

    # ------------------------------------------------------------------ splitting
    def _split(self, parts: Parts, seen: KnownObservation) -> tuple[Parts, Parts]:
        """Return parts split until an observation is as good as linear over each, and those that have taken it.

        These are pieces of rings.
        """
        if not len(parts.P):
            return parts, parts
        parts, t = parts.whole(), self.pose.stop - 1
        is_wide = parts.P[:, t, t] > TURN_RAD**2
        narrow, wide = np.flatnonzero(~is_wide), np.flatnonzero(is_wide)
        pieces = Parts.joined([parts.take(narrow), *(self._headings(parts, i) for i in wide.tolist())])
        of = np.append(narrow, np.repeat(wide, PIECES))
        mount = seen.update.mount
        own = pieces.x[:, self.prior.map.rows(mount) if mount >= 0 else NO_SLOTS]
        heads, P = np.hstack([pieces.x[:, self.pose], own]), pieces.P[:, self.pose, self.pose]
        bent = bends(seen.update.model, heads, P, seen.update.y, seen.update.R)
        is_bent = np.isfinite(seen.l[0]) & bent[:, 1:].any(axis=1)
        rings = {i: self._ring(pieces, i, seen, own[i]) for i in np.flatnonzero(is_bent).tolist()}
        taken, done = [parts.take(slice(0))], [i for i, ring in rings.items() if len(ring.P)]
        for k in np.unique(of[[*rings]]):
            ring = Parts.joined([ring for i, ring in rings.items() if of[i] == k])
            w = ring.log_weights
            w += parts.log_weights[k] - np.logaddexp.reduce(w)  # the first one is no evidence
            taken.append(ring)
        return pieces.take(np.delete(np.arange(len(of)), done)), Parts.joined(taken)

    def _headings(self, parts: Parts, i: int) -> Parts:
        """Return a part as pieces of its heading."""
        x, P, t, pose = parts.x[i], parts.P[i], self.pose.stop - 1, self.pose
        g, place = P[:, t] / P[t, t], slice(t - 2, t)
        turns = wrap(2 * math.pi * np.arange(PIECES) / PIECES)
        wraps = (turns[:, None] + 2 * math.pi * np.arange(-3, 4)) ** 2 / (P[t, t] - PIECE_RAD**2)
        logs = np.logaddexp.reduce(-0.5 * wraps, axis=1)
        steps, own = turns[:, None] * g, np.tile(g, (PIECES, 1))
        means = self._plus(x, steps)
        means[:, pose] = turn_pose(x[pose], steps[:, pose])
        own[:, place] = [rotation(turn) @ g[place] for turn in turns.tolist()]
        cov = P - np.outer(g, P[:, t]) + PIECE_RAD**2 * own[:, :, None] * own[:, None, :]
        return Parts(means, means.copy(), cov, parts.log_weights[i] + logs - np.logaddexp.reduce(logs))

    def _ring(self, parts: Parts, i: int, seen: KnownObservation, own: Array) -> Parts:
        """Return a part, corrected by a distance, as pieces of the ring about a landmark; none without a distance.

        `own` is the mount as it is in the map.
        """
        x, P, t = parts.x[i], parts.P[i], self.pose.stop - 1
        found = measured_distance(seen, own)
        if found is None:
            return parts.take(slice(0))
        d, sigma = found
        arm = rotation(x[t]) @ (own if len(own) else seen.at)[:2]
        H = np.zeros((2, len(P)))
        H[:, t - 2 : t], H[:, t] = np.eye(2), [-arm[1], arm[0]]
        across = math.sqrt(2.0 * sigma * d) / SIGMAS  # the tangent leaves the ring by a sigma at the sigma points
        count = max(PIECES, math.ceil(2 * math.pi * d / (OVERLAP * across)))
        angles = 2 * math.pi * np.arange(count) / count
        u = np.column_stack([np.cos(angles), np.sin(angles)])
        C = across**2 * np.eye(2) + (sigma**2 - across**2) * u[:, :, None] * u[:, None, :]
        z, S, to_all = seen.l + d * u - x[t - 2 : t] - arm, H @ P @ H.T + C, P @ H.T
        toward, log_S = np.linalg.solve(S, z[:, :, None])[:, :, 0], np.linalg.slogdet(S)[1]
        logs = -0.5 * (np.einsum("ki,ki->k", z, toward) + log_S)
        keep = logs > logs.max() + math.log(LEAST)
        cov = P - to_all @ np.linalg.solve(S[keep], to_all.T)
        means = self._plus(x, toward[keep] @ to_all.T)
        return Parts(means, means.copy(), cov, parts.log_weights[i] + logs[keep])


def as_part(map_: Map, log_weight: float) -> Parts:
    """Return the present state of a map as the only part of a sum."""
    slots = range(len(map_.spaces))
    mean = np.concatenate([map_.mean(slot) for slot in slots])[None]
    return Parts(mean, mean.copy(), map_.covariance(slots)[None], np.array([log_weight]))


def measured_distance(seen: KnownObservation, own: Array) -> tuple[float, float] | None:
    """Return the distance that a measurement stands for and its sigma, None where none does.

    `own` is the mount with the constants of the sensor, as they are in the map.
    """
    update, d = seen.update, 1.0
    at = (own if len(own) else seen.at)[:2]
    for _ in range(STEPS):
        head = np.array([seen.l[0] + d - at[0], seen.l[1] - at[1], 0.0, *own])
        _, z, E_h, _ = linearize(update.model, head, np.zeros((1, 0)), update.y)
        slope = float(E_h[0, 0, 0])
        step = float(z[0, 0]) / slope if slope else math.nan
        if not math.isfinite(step):
            return None
        d, before = max(d + step, 0.5 * d), d
        if abs(d - before) < SETTLED:
            return d, math.sqrt(float(update.R[0, 0, 0])) / abs(slope)
    return None
