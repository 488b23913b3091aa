"""The start of a robot in a known map by one scan, without a prior of its pose.  [T] exercise 1, [F].

Two observed places and two landmarks as far from each other determine a pose.  Each such pose is tested with all of the
scan: how many places are at landmarks (RANSAC of Fischler and Bolles 1981, but every pair is tried).  The best one is
taken if a matching as good is not expected by chance and none from elsewhere comes near it; else a later scan decides.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np

from kalmark.arrays import Array, Flags, Index
from kalmark.association.protocol import NEW, Decision
from kalmark.association.query import Query
from kalmark.association.relocalization import align_points, is_same_pose
from kalmark.events import Id
from kalmark.geometry.gaussian import gate as chi2_gate
from kalmark.report import Observation
from kalmark.tracks.known_landmarks import Known

FEWEST, FEWEST_NAMED = 3, 2  # pairs without and with ids
BASES = 8  # pairs of observations from which poses are computed
SIGMAS = 3.0  # by which the distances of a pair may differ
REACH = 0.999  # of right pairs pass the gate
AS_GOOD = 2  # a pose with so many pairs less may be the right one
BY_CHANCE = 1e-3  # matchings as good that may be expected by chance
MOST_PAIRS = 2_000_000  # of landmarks
AT_ONCE = 20_000  # poses tested at once


class Located(NamedTuple):
    """The pose T (3,) of the sensor, and what each observation is of; or, without them, why it is not known yet.

    `fates` (K,) are those of observations that have corrected what is known of the pose, and do not determine it.
    """

    T: Array | None
    decisions: list[Decision] | None
    why: str
    fates: Sequence[Observation] = ()


class GlobalPose(NamedTuple):
    """A pose T (3,) and the landmark of each observation (K,), -1 for none."""

    T: Array
    matched: Index

    @property
    def pairs(self) -> int:
        """Number of observations of landmarks."""
        return int((self.matched >= 0).sum())


def locate_sensor(query: Query) -> Located:
    """Return where the sensor of a scan is in the known map, if the scan determines it."""
    scan, channel = query.scan, query.scan.channel
    of = next((known for kind, known in scan.tracks.known.of_kind.items() if kind in channel.models), None)
    if of is None or not channel.gives_places or scan.dimensions != 2:
        return Located(None, None, "its sensor does not find the places of known landmarks")
    v, V_y = (a[:, :2] for a in channel.calibrated(scan.map).invert(scan.y))
    sigma = np.sqrt(np.trace(V_y @ scan.R @ V_y.swapaxes(1, 2), axis1=1, axis2=2) / 2)
    named = [k for k, i in enumerate(query.ids) if i is not None and i in scan.tracks.known]
    if len(named) >= FEWEST_NAMED:
        l = np.array([scan.tracks.known.mean(i)[:2] for i in (query.ids[k] for k in named) if i is not None])
        return Located(align_points(v[named], l, sigma[named] ** -2), None, "")
    unnamed = np.array([k for k, i in enumerate(query.ids) if i is None], dtype=np.int64)
    found = search(of, v[unnamed], sigma[unnamed])
    if isinstance(found, str):
        return Located(None, None, found)
    why = f"found in the known map: {found.pairs} of {len(unnamed)} observations agree"
    decisions: list[Decision] = [(i, "") if i is not None else (NEW, "") for i in query.ids]
    for k, row in zip(unnamed.tolist(), found.matched.tolist(), strict=True):
        name: Id | None = of.names[row] if row >= 0 else None
        decisions[k] = (name, why if name is not None else "not of the known map from where the others are")
    return Located(found.T, decisions, why)


def search(of: Known, v: Array, sigma: Array) -> GlobalPose | str:
    """Return the pose that places v (K, 2) with these sigmas (K,) determine, or why they do not."""
    if len(v) < FEWEST:
        return f"its scan has {len(v)} observations, a start needs {FEWEST}"
    poses: list[GlobalPose] = []
    tried = 0
    for i, j in bases(v, sigma):
        T = hypotheses(of, v, sigma, i, j)
        tried += len(T)
        poses += supported_poses(of, v, sigma, T, (i, j))
    poses = distinct([refine_pose(of, v, sigma, pose) for pose in poses])
    if not poses:
        return "no pose in the known map explains its scan"
    best = poses[0]
    if best.pairs < FEWEST or 2 * best.pairs <= len(v):
        return f"at most {best.pairs} of its {len(v)} observations agree with a pose in the known map"
    if len(poses) > 1 and poses[1].pairs > best.pairs - AS_GOOD:
        return f"its scan fits {poses[1].pairs} landmarks from another pose, and {best.pairs} from this one"
    chance = by_chance(of, v, sigma, best.pairs, tried)
    if chance > BY_CHANCE:
        return f"{best.pairs} observations agree, {chance:.1g} poses as good are expected by chance"
    return best


def bases(v: Array, sigma: Array) -> list[tuple[int, int]]:
    """Return pairs of observations, those that determine a heading best first; no observation is in most of them."""
    pairs = [(float(np.linalg.norm(v[i] - v[j]) / np.hypot(sigma[i], sigma[j])), i, j)
             for i, j in combinations(range(len(v)), 2)]  # fmt: skip
    used, found = np.zeros(len(v), dtype=np.int64), list[tuple[int, int]]()
    for _, i, j in sorted(pairs, reverse=True):
        if max(used[i], used[j]) < 2:
            found.append((i, j))
            used[[i, j]] += 1
        if len(found) == BASES:
            break
    return found


def hypotheses(of: Known, v: Array, sigma: Array, i: int, j: int) -> Array:
    """Return the poses (H, 3) from which the observations i and j are of two landmarks."""
    d, tolerance = float(np.linalg.norm(v[j] - v[i])), SIGMAS * float(np.hypot(sigma[i], sigma[j]))
    a, b = of.pairs(d - tolerance, d + tolerance, MOST_PAIRS).T
    one, other = (np.concatenate(ends) for ends in ((a, b), (b, a)))
    p = of.places()
    ahead, seen = p[other] - p[one], v[j] - v[i]
    theta = np.arctan2(ahead[:, 1], ahead[:, 0]) - math.atan2(seen[1], seen[0])
    middle, c, s = (v[i] + v[j]) / 2, np.cos(theta), np.sin(theta)
    turned = np.stack([c * middle[0] - s * middle[1], s * middle[0] + c * middle[1]], axis=1)
    return np.column_stack([(p[one] + p[other]) / 2 - turned, theta])


def supported_poses(of: Known, v: Array, sigma: Array, T: Array, base: tuple[int, int]) -> list[GlobalPose]:
    """Return of poses (H, 3) from a base those that most of the scan agrees with."""
    i, j = base
    turn = np.hypot(sigma[i], sigma[j]) / np.linalg.norm(v[j] - v[i])
    lever = np.linalg.norm(v - (v[i] + v[j]) / 2, axis=1)
    spread = np.sqrt(sigma**2 + (sigma[i] ** 2 + sigma[j] ** 2) / 4 + (turn * lever) ** 2)
    found: list[GlobalPose] = []
    for at in range(0, len(T), AT_ONCE):
        some = T[at : at + AT_ONCE]
        gaps, rows = of.tree().query(points_at_poses(some, v))
        near: Flags = gaps**2 <= chi2_gate(REACH, 2) * spread**2
        counts = near.sum(axis=1)
        for h in np.flatnonzero((counts >= FEWEST) & (counts >= counts.max() - AS_GOOD)).tolist():
            found.append(GlobalPose(some[h], np.where(near[h], rows[h], -1)))
    most = max((pose.pairs for pose in found), default=0)
    return [pose for pose in found if pose.pairs > most - AS_GOOD]


def points_at_poses(T: Array, v: Array) -> Array:
    """Return where v (K, 2) are from each pose T (H, 3): (H, K, 2)."""
    c, s = np.cos(T[:, 2])[:, None], np.sin(T[:, 2])[:, None]
    return np.stack([c * v[:, 0] - s * v[:, 1] + T[:, :1], s * v[:, 0] + c * v[:, 1] + T[:, 1:2]], axis=2)


def refine_pose(of: Known, v: Array, sigma: Array, pose: GlobalPose) -> GlobalPose:
    """Return a pose by least squares of all its pairs, and the pairs from there, of each landmark one."""
    T, matched = pose
    for _ in range(2):
        rows = np.flatnonzero(matched >= 0)
        if len(rows) < FEWEST:
            break
        T = align_points(v[rows], of.places()[matched[rows]], sigma[rows] ** -2)
        gaps, nearest = of.tree().query(points_at_poses(T[None], v)[0])
        misfit = gaps / sigma
        # the pose has an error of its own: three numbers, from as many pairs
        near = misfit**2 <= chi2_gate(REACH, 2) * (1.0 + 3.0 / len(rows))
        matched = np.where(near, nearest, -1)
        for landmark in set(matched[near].tolist()):
            mine = np.flatnonzero(matched == landmark)
            matched[np.delete(mine, np.argmin(misfit[mine]))] = -1
    return GlobalPose(T, matched)


def distinct(poses: list[GlobalPose]) -> list[GlobalPose]:
    """Return poses that are different ones, those with most pairs first."""
    out: list[GlobalPose] = []
    for pose in sorted(poses, key=lambda pose: -pose.pairs):
        if not any(is_same_pose(pose.T, other.T) for other in out):
            out.append(pose)
    return out


def by_chance(of: Known, v: Array, sigma: Array, count: int, tried: int) -> float:
    """Return how many of so many poses, each right for its two pairs, have as many pairs by chance."""
    area = math.pi * chi2_gate(REACH, 2) * float(np.mean(sigma**2)) * 2.0
    p = min(1.0, of.density() * area)
    more = range(count - 2, len(v) - 1)
    return tried * float(sum(math.comb(len(v) - 2, k) * p**k * (1 - p) ** (len(v) - 2 - k) for k in more))
