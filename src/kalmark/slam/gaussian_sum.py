"""A Gaussian sum: the pose of a robot as several Gaussians, where one cannot describe it.  Alspach and Sorenson 1972.

With an unknown heading a robot may be anywhere on a circle after its first metre; a range to a known beacon puts it on
another one.  No linearisation holds on either (`tracks/linearity.py`).  So the Gaussian is split along the
axis that bends, each part is corrected alone, and its likelihood is its weight:

    heading:    N(theta) = sum of w_i N(theta_i, PIECE_RAD), the position turned about the place where the heading began
    position:   N(p) L(y | p), L = sum of N(p; b + d u_j, C): a range d to b is a ring of Gaussians of its own

A part that does not explain an observation keeps the likelihood of an outlier.  Beside the parts stands the prior,
which is moved and not corrected, and under which an observation may be any.  Once it is likelier than all parts, which
began at an outlier, then others begin from it.  Each part is a filter of the robot alone, an `Alternative`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from kalmark.arrays import Array, Flags
from kalmark.filter.estimators import Correction, Estimator, Update
from kalmark.filter.map import Map
from kalmark.geometry.angles import rotation, wrap
from kalmark.geometry.gaussian import gate as chi2_gate
from kalmark.geometry.spaces import Space
from kalmark.models.observe import linearize
from kalmark.slam.alternative import Alternative
from kalmark.slam.held_control import MotionPart, Moving
from kalmark.tracks.linearity import SIGMAS, bends, turn_holds, turn_pose
from kalmark.tracks.surveys import SURVEYED

PIECES, PIECE_RAD = 12, 0.3  # of a circle of headings, and the sigma of each: they overlap to a sum that is even
OVERLAP = 1.75  # sigmas of a piece from one to the next, as there
LEAST = 1e-6  # weight that is kept, of the greatest
MOST = 128  # parts that are kept
ALIKE = 0.5  # squared distance up to which two parts are one
SETTLED, STEPS = 1e-6, 20  # m, of the search for the distance that a measurement stands for
VAGUE_RAD = 3.0  # sigma of a heading that may be any
ANYWHERE_M = 1e4  # sigma of a position that may be any
IN_A_ROW = 5  # observations that do not fit the filter of a robot, or over which a sum is linear, decide


class KnownObservation(NamedTuple):
    """An observation of a landmark known exactly at l (2,): `update` has one row; `gate` is that of its d2.

    The sensor is at `at` (3,), unless its mount is in the map.  `is_distance`: it is a distance, or stands for one.
    """

    update: Update
    l: Array
    at: Array
    gate: float
    is_distance: bool

    @property
    def floor(self) -> float:
        """The log-likelihood that an outlier has, whatever the pose."""
        return self.anywhere - 0.25 * self.gate

    @property
    def anywhere(self) -> float:
        """The log-likelihood of an observation that may be any."""
        return -0.25 * self.gate - 0.5 * float(np.linalg.slogdet(self.update.R[0])[1])


def log_likelihood(done: Correction, k: int, seen: KnownObservation) -> float:
    """Return that of the k-th observation of a correction, at least that of an outlier."""
    if not math.isfinite(done.d2[k]):
        return seen.floor
    return max(-0.5 * float(done.d2[k] + np.linalg.slogdet(done.Z[k])[1]), seen.floor)


@dataclass
class GaussianSum:
    """The parts of a robot's pose with their `log_weights` (M,), and the prior with its own.

    `lead` is the log of the odds of the filter that the map has of the robot, -inf where that is none of its own but
    shows the moments of the sum.  Over these the last `linear` observations were as good as linear.
    """

    prior: Alternative
    parts: list[Alternative]
    log_weights: Array
    prior_log: float
    lead: float = -math.inf
    linear: int = 0

    @classmethod
    def of(cls, map_: Map, moving: Moving, blocks: int, t_ns: int, gate: float) -> GaussianSum:
        """Return the Gaussian of a robot in a map with so many blocks that are no landmarks, as one part."""
        first, second = (Alternative.of(map_, moving, blocks, t_ns) for _ in range(2))
        return cls(first, [second], np.zeros(1), -0.25 * gate)

    @classmethod
    def anywhere(cls, map_: Map, moving: Moving, blocks: int, t_ns: int, gate: float) -> GaussianSum:
        """Return the sum of a robot that may be elsewhere than the map has it: without a part yet, and unlikely."""
        prior = Alternative.of(map_, moving, blocks, t_ns)
        rows = prior.map.index(moving.slot)[:3]
        prior.map.predict(rows, np.zeros((3, 3)), np.diag([ANYWHERE_M, ANYWHERE_M, VAGUE_RAD]) ** 2)
        return cls(prior, [], np.zeros(0), 0.0, 0.5 * IN_A_ROW * gate)

    @property
    def shows(self) -> bool:
        """True if the map has no filter of its own of the robot."""
        return self.lead == -math.inf

    @property
    def is_found(self) -> bool:
        """True if its parts explain what was observed better than that it may be any."""
        return _log_sum(self.log_weights) > self.prior_log

    def all(self) -> Iterator[Alternative]:
        """Yield the prior and the parts."""
        yield self.prior
        yield from self.parts

    def move(self, estimator: Estimator, part: MotionPart) -> bool:
        """Move the robot by a part of its control; return whether that leads anywhere."""
        return all([each.move(estimator, part) for each in self.all()])

    def correct(self, estimator: Estimator, update: Update) -> None:
        """Correct by a reading of the robot's own state."""
        seen = KnownObservation(
            update, np.zeros(2), np.zeros(3), chi2_gate(SURVEYED, update.R.shape[1]), is_distance=False
        )
        estimator.correct(self.prior.map, update)
        for i, each in enumerate(self.parts):
            self.log_weights[i] += log_likelihood(estimator.correct(each.map, update), 0, seen)
        self._prune()

    def observe(self, estimator: Estimator, seen: KnownObservation) -> tuple[Correction | None, float]:
        """Correct by an observation of a known landmark; return what the likeliest part expected and the evidence.

        None where all parts begin by it.  The evidence is its log-likelihood under the whole sum.
        """
        before = self._total()
        parts, log_weights, expected = list[Alternative](), list[float](), None
        likeliest = -math.inf
        for each, w in zip(self.parts, self.log_weights.tolist(), strict=True):
            for piece, w_piece, is_done in split_part(each, w, seen):
                if is_done:
                    gain = seen.anywhere
                else:
                    done = estimator.correct(piece.map, seen.update._replace(gate=seen.gate))
                    gain = log_likelihood(done, 0, seen)
                    if w_piece + gain > likeliest:
                        likeliest, expected = w_piece + gain, done
                parts.append(piece)
                log_weights.append(w_piece + gain)
        self.parts, self.log_weights = parts, np.array(log_weights)
        self.prior_log += seen.anywhere
        if not self.is_found:
            self._begin(estimator, seen)
        self._prune()
        return expected, self._total() - before

    def _begin(self, estimator: Estimator, seen: KnownObservation) -> None:
        """Begin parts from the prior, by an observation."""
        first = copy_alternative(self.prior)
        pieces = split_part(first, self.prior_log, seen)
        for piece, _, is_done in pieces:
            if not is_done:
                estimator.correct(piece.map, seen.update._replace(gate=seen.gate))
        self.parts += [piece for piece, _, _ in pieces]
        self.log_weights = np.append(self.log_weights, [w for _, w, _ in pieces])
        self.prior_log -= 0.25 * seen.gate

    def _total(self) -> float:
        return float(np.logaddexp(_log_sum(self.log_weights), self.prior_log))

    def _prune(self) -> None:
        """Remove the parts without weight, and merge those that are alike."""
        keep = np.argsort(-self.log_weights, kind="stable")[:MOST]
        keep = keep[self.log_weights[keep] > self.log_weights.max(initial=-math.inf) + math.log(LEAST)]
        self.parts, self.log_weights = [self.parts[i] for i in keep.tolist()], self.log_weights[keep]
        top = max(self._total(), -1e300)
        self.log_weights, self.prior_log = self.log_weights - top, self.prior_log - top
        if len(self.parts) > 1:
            self._merge()

    def _merge(self) -> None:
        slot = self.prior.moving.slot
        poses = np.array([each.map.mean(slot)[:3] for each in self.parts])
        P = np.array([each.map.covariance([slot])[:3, :3] for each in self.parts])
        left, parts, log_weights = np.arange(len(poses)), list[Alternative](), list[float]()
        while len(left):
            d = poses[left] - poses[left[0]]
            d[:, 2] = wrap(d[:, 2])
            off = np.einsum("ki,ki->k", d, np.linalg.solve(P[left] + P[left[0]], d[:, :, None])[:, :, 0])
            group = left[off < ALIKE]
            left = left[off >= ALIKE]
            w = self.log_weights[group]
            one = self.parts[group[0]]
            if len(group) > 1:
                slots = range(len(one.map.spaces))
                means, cov = moments([self.parts[i] for i in group.tolist()], w, slots, slot)
                write_blocks(one.map, slots, means, cov)
            parts.append(one)
            log_weights.append(_log_sum(w))
        self.parts, self.log_weights = parts, np.array(log_weights)

    def moments(self, slots: Sequence[int]) -> tuple[list[Array], Array]:
        """Return the means of some blocks, the robot's the first, and their joint covariance."""
        return moments(self.parts, self.log_weights, slots, slots[0])


def _log_sum(logs: Array) -> float:
    return float(np.logaddexp.reduce(logs)) if len(logs) else -math.inf


def copy_alternative(other: Alternative) -> Alternative:
    """Return the same robot once more."""
    return Alternative.of(other.map, other.moving, len(other.map.spaces), other.since_ns)


def write_blocks(map_: Map, slots: Sequence[int], means: Sequence[Array], cov: Array) -> None:
    """Write blocks of a map and their joint covariance, independent of all else."""
    for slot in slots:
        map_.index(slot)  # to activate a block may move those that are active
    rows = np.concatenate([map_.index(slot) for slot in slots])
    map_.predict(rows, np.zeros_like(cov), cov)
    for slot, mean in zip(slots, means, strict=True):
        map_.set_predicted(slot, mean)


def _spaces(map_: Map, slots: Sequence[int]) -> list[Space]:
    """Return the spaces of blocks."""
    return [space for slot in slots if (space := map_.spaces[slot]) is not None]


def _heading(map_: Map, slots: Sequence[int], robot: int) -> int:
    """Return which row of the joint covariance of blocks is the heading of a robot."""
    return sum(len(map_.rows(slot)) for slot in slots[: [*slots].index(robot)]) + 2


def moments(
    parts: Sequence[Alternative], log_weights: Array, slots: Sequence[int], robot: int
) -> tuple[list[Array], Array]:
    """Return the means of blocks under a sum, and their joint covariance.

    The mean heading and its variance -2 log |E exp(i theta)| are those of a wrapped Gaussian: a heading that may be any
    stays one, however often its moments are taken.
    """
    w = np.exp(log_weights - _log_sum(log_weights))
    spaces, first = _spaces(parts[0].map, slots), [parts[0].map.mean(slot) for slot in slots]
    blocks, t = [*zip(slots, spaces, first, strict=True)], _heading(parts[0].map, slots, robot)
    D = np.array([np.concatenate([of.minus(each.map.mean(slot), x) for slot, of, x in blocks]) for each in parts])
    P = np.array([each.map.covariance(slots) for each in parts])
    mean_turn = w @ np.exp(1j * D[:, t] - 0.5 * P[:, t, t])
    middle = float(np.angle(mean_turn))
    D[:, t] = middle + wrap(D[:, t] - middle)
    d = w @ D
    d[t] = middle
    off = D - d
    cov = np.einsum("k,kij->ij", w, P + off[:, :, None] * off[:, None, :])
    spread = min(-2.0 * math.log(max(float(abs(mean_turn)), 1e-300)), VAGUE_RAD**2)
    cov[t, t] += max(0.0, spread - cov[t, t])
    return retract_blocks(parts[0].map, slots, d), 0.5 * (cov + cov.T)


# ---------------------------------------------------------------------- splitting
def split_part(each: Alternative, w: float, seen: KnownObservation) -> list[tuple[Alternative, float, bool]]:
    """Return a part with its log weight split until an observation is as good as linear over each piece.

    Pieces of a ring have taken the observation: the third of each is then true.
    """
    pieces = [(each, w)]
    if not turn_holds(each.map.covariance([each.moving.slot])[:3, :3]):
        pieces = headings(each, w)
    out: list[tuple[Alternative, float, bool]] = []
    for piece, w_piece in pieces:
        is_bent = seen.is_distance and nonlinear_axes(piece.map, piece.moving.slot, seen)[1:].any()
        around = ring(piece, seen) if is_bent else []
        out += [(one, w_piece + more, True) for one, more in around]
        if not around:
            out.append((piece, w_piece, False))
    rings = np.array([w_piece for _, w_piece, is_done in out if is_done])
    if len(rings):  # their sum has the weight of what they are of: the first observation is no evidence
        down = w - _log_sum(rings)
        out = [(one, w_piece + down if is_done else w_piece, is_done) for one, w_piece, is_done in out]
    return out


def nonlinear_axes(map_: Map, robot: int, seen: KnownObservation) -> Flags:
    """Return along which axes (3,) of a robot's pose no linearisation describes an observation."""
    update = seen.update
    pose = map_.mean(robot)[:3]
    head = pose if update.mount < 0 else np.concatenate([pose, map_.mean(update.mount)])
    return bends(update.model, head, map_.covariance([robot])[:3, :3], update.y, update.R)


def headings(each: Alternative, w: float) -> list[tuple[Alternative, float]]:
    """Return a part as pieces of its heading, with their log weights."""
    slots, robot = range(len(each.map.spaces)), each.moving.slot
    P, t = each.map.covariance(slots), _heading(each.map, slots, robot)
    g, place = P[:, t] / P[t, t], slice(t - 2, t)
    left = P - np.outer(g, P[:, t])
    turns = wrap(2 * math.pi * np.arange(PIECES) / PIECES)
    wraps = (turns[:, None] + 2 * math.pi * np.arange(-3, 4)) ** 2 / (P[t, t] - PIECE_RAD**2)
    logs = np.logaddexp.reduce(-0.5 * wraps, axis=1)
    out = []
    for turn, more in zip(turns.tolist(), (logs - _log_sum(logs)).tolist(), strict=True):
        means, own = retract_blocks(each.map, slots, g * turn), g.copy()
        means[robot][:3] = turn_pose(each.map.mean(robot)[:3], g[t - 2 : t + 1] * turn)
        own[place] = rotation(turn) @ g[place]
        piece = copy_alternative(each)
        write_blocks(piece.map, slots, means, left + PIECE_RAD**2 * np.outer(own, own))
        out.append((piece, w + more))
    return out


def ring(each: Alternative, seen: KnownObservation) -> list[tuple[Alternative, float]]:
    """Return a part, corrected by a distance, as pieces of the ring about a landmark, with their log likelihoods."""
    slots, robot, mount = range(len(each.map.spaces)), each.moving.slot, seen.update.mount
    r, own = each.map.mean(robot), np.zeros(0) if mount < 0 else each.map.mean(mount)
    found = measured_distance(seen, own)
    if found is None:
        return []
    d, sigma = found
    P, t = each.map.covariance(slots), _heading(each.map, slots, robot)
    arm = rotation(r[2]) @ (own if len(own) else seen.at)[:2]
    H = np.zeros((2, len(P)))
    H[:, t - 2 : t], H[:, t] = np.eye(2), [-arm[1], arm[0]]
    across = math.sqrt(2.0 * sigma * d) / SIGMAS  # the tangent leaves the ring by a sigma at the sigma points
    count = max(PIECES, math.ceil(2 * math.pi * d / (OVERLAP * across)))
    angles = 2 * math.pi * np.arange(count) / count
    u = np.column_stack([np.cos(angles), np.sin(angles)])
    C = across**2 * np.eye(2) + (sigma**2 - across**2) * u[:, :, None] * u[:, None, :]
    z, S, to_all = seen.l + d * u - r[:2] - arm, H @ P @ H.T + C, P @ H.T
    toward, log_S = np.linalg.solve(S, z[:, :, None])[:, :, 0], np.linalg.slogdet(S)[1]
    logs, out = -0.5 * (np.einsum("ki,ki->k", z, toward) + log_S), []
    for k in np.flatnonzero(logs > logs.max() + math.log(LEAST)).tolist():
        piece, cov = copy_alternative(each), P - to_all @ np.linalg.solve(S[k], to_all.T)
        write_blocks(piece.map, slots, retract_blocks(each.map, slots, to_all @ toward[k]), 0.5 * (cov + cov.T))
        out.append((piece, float(logs[k])))
    return out


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


def retract_blocks(map_: Map, slots: Sequence[int], step: Array) -> list[Array]:
    """Return the means of blocks after an error of all of them, one after the other."""
    spaces = _spaces(map_, slots)
    parts = np.split(step, np.cumsum([space.dof for space in spaces])[:-1])
    return [space.plus(map_.mean(slot), part) for slot, space, part in zip(slots, spaces, parts, strict=True)]
