"""The pose of a sensor among known landmarks, without a prior of it.  [T] exercise 1, [F].

*By ids*: points or directions determine a pose by least squares, with which all have to agree; a tag determines one
alone, that with which most others agree is taken.  *By distances*: two observed places and two landmarks as far from
each other determine a pose of the plane.  Each such pose is tested with all of the scan: how many places are at
landmarks (RANSAC of Fischler and Bolles 1981, but every pair is tried).  The best one is taken if a matching as good is
not expected by chance and none from elsewhere comes near it; else a later scan decides.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import bdtrc, betaincinv

from kalmark.arrays import Array, Flags, Index
from kalmark.association.relocalization import SAME_M, SAME_RAD, align_points, is_same_pose, resect
from kalmark.compiled import compiled
from kalmark.events import Id
from kalmark.geometry import frames3d
from kalmark.geometry.angles import wrap
from kalmark.geometry.gaussian import gate as chi2_gate
from kalmark.geometry.pose_frames import FRAMES
from kalmark.geometry.spaces import SE2, SE3
from kalmark.tracks.known_landmarks import Known
from kalmark.tracks.scan import FEWEST_RANGES

FEWEST = 3  # pairs without ids
FEWEST_NAMED = {2: 2, 3: 3}  # with ids, by the dimensions of the world
FEWEST_RAYS = {2: 3, 3: 4}  # directions with ids
ANY_RAD = math.pi / math.sqrt(3.0)  # sigma of an attitude that may be any, on each axis
STEPS = 5  # of least squares
LOOSE = 2.0  # sigmas of an observation, for what is uncertain between landmarks of the map
SURE = 7.0  # the most that one landmark counts: log odds
BASES = 8  # pairs of observations from which poses are computed
SIGMAS = 3.0  # by which the distances of a pair may differ
REACH = 0.999  # of right pairs pass the gate
AS_GOOD = 2  # a pose with so many pairs less may be the right one
BY_CHANCE = 1e-3  # matchings as good that may be expected by chance
MOST_PAIRS = 2_000_000  # of landmarks


class GlobalPose(NamedTuple):
    """A pose T (3,) or (7,) and the row of the landmark of each observation (K,), -1 for none.

    One observation fits a wrong pose with the probability p, as many as here do so at so many poses by `chance`.
    """

    T: Array
    matched: Index
    p: float = 0.0
    chance: float = 0.0

    @property
    def pairs(self) -> int:
        """Number of observations of landmarks."""
        return int((self.matched >= 0).sum())


class Proposal(NamedTuple):
    """A pose T of a sensor, (3,) or (7,), its covariance, the landmark of each observation (K,) and the log odds.

    These are against chance; a landmark counts at most `SURE`, but for those that determine the pose.  An observation
    without an id is at a landmark from a wrong pose with the probability p.
    """

    T: Array
    cov: Array
    matched: Index
    gain: float
    p: float = 0.0


def locate_points(of: Known, ids: Sequence[Id | None], v: Array, sigma: Array) -> Proposal | str:
    """Return the pose that points v (K, d) with these ids and sigmas (K,) determine, or why they do not."""
    rows, d = rows_of(of, ids), v.shape[1]
    if d == 3 or (rows >= 0).sum() >= FEWEST_NAMED[d]:
        return _by_ids(of, rows, FEWEST_NAMED[d], _Points(v, sigma))
    unnamed = np.array([k for k, i in enumerate(ids) if i is None], dtype=np.int64)
    found = search(of, v[unnamed], sigma[unnamed])
    if isinstance(found, str):
        return found
    matched = np.full(len(v), -1)
    matched[unnamed] = found.matched
    some = np.flatnonzero(matched >= 0)
    cov = _Points(v, sigma).covariance(found.T, of.places()[matched], some)
    gain = min(-math.log(max(found.chance, 1e-300)), SURE * (found.pairs - 2))
    return Proposal(found.T, cov, matched, gain, found.p)


def locate_rays(of: Known, ids: Sequence[Id | None], v: Array, sigma: Array, o: Array | None = None) -> Proposal | str:
    """Return the pose that unit vectors v (K, d) with these ids determine, or why they do not.

    Each sigma (K,) is the root of the mean variance of d axes, of which one, that of the ray, has none.  They are seen
    from the places o (K, d) in the frame of the sensor, from its own if there are none.
    """
    d = v.shape[1]
    seen = _Rays(v, sigma * math.sqrt(d / (d - 1)), np.zeros(v.shape) if o is None else o)
    return _by_ids(of, rows_of(of, ids), FEWEST_RAYS[d], seen)


def locate_ranges(of: Known, ids: Sequence[Id | None], T: Array, r: Array, sigma: Array) -> Proposal | str:
    """Return the place that distances r (K,) with these ids and sigmas (K,) determine, as a pose, or why they do not.

    Of the attitude, that of T (7,), nothing is known.
    """
    return _by_ids(of, rows_of(of, ids), FEWEST_RANGES, _Ranges(T, r, sigma))


class _Points(NamedTuple):
    """Points v (K, d) in the frame of a sensor, with their sigmas (K,)."""

    v: Array
    sigma: Array

    def solve(self, l: Array, some: Index) -> Array:
        """Return the pose by some of the landmarks l (K, d)."""
        return align_points(self.v[some], l[some], self.sigma[some] ** -2)

    def misfits(self, T: Array, l: Array, some: Index) -> Array:
        """Return the squared distances, in sigmas, over their gate."""
        off = (FRAMES[len(T)].from_frame(T, self.v[some])[0] - l[some]) / (LOOSE * self.sigma[some, None])
        return np.sum(off**2, axis=1) / chi2_gate(REACH, off.shape[1])

    def covariance(self, T: Array, l: Array, some: Index) -> Array:
        """Return the covariance of the pose."""
        J = FRAMES[len(T)].from_frame(T, self.v[some])[1]
        return np.linalg.inv(np.einsum("kai,k,kaj->ij", J, (LOOSE * self.sigma[some]) ** -2, J))


class _Rays(NamedTuple):
    """Directions v (K, d) in the frame of a sensor, unit vectors, with their sigmas (K,), rad, from places o (K, d)."""

    v: Array
    sigma: Array
    o: Array

    def solve(self, l: Array, some: Index) -> Array:
        """Return the pose by some of the landmarks l (K, d), that from which most fit, if there is one."""
        found = [self._refined(T, l, some) for T in resect(self.v[some], l[some], self.o[some])]
        found.sort(key=lambda T: float(np.sum(self.misfits(T, l, some))))
        fits = [T for T in found if (self.misfits(T, l, some) <= 1.0).all()]
        if not found or any(not is_same_pose(T, fits[0]) for T in fits):
            raise np.linalg.LinAlgError("no pose, or several")
        return found[0]

    def _refined(self, T: Array, l: Array, some: Index) -> Array:
        """Return the pose of the least squares of the angles, from T on."""
        space = SE2 if len(T) == 3 else SE3
        for _ in range(STEPS):
            off, J, _ = self._angles(T, l, some)
            weights = 1.0 / self.sigma[some, None]
            step = np.linalg.lstsq((J * weights[..., None]).reshape(-1, space.dof), -(off * weights).ravel())[0]
            T = space.plus(T, np.asarray(step, dtype=np.float64))
        return T

    def _angles(self, T: Array, l: Array, some: Index) -> tuple[Array, Array, Flags]:
        """Return how far landmarks are beside their rays (K, d - 1), rad, its Jacobian, and which are ahead (K,)."""
        p, J = FRAMES[len(T)].to_frame(T, l[some])[:2]
        p -= self.o[some]
        across = np.linalg.svd(self.v[some, None, :])[2][:, 1:]
        r = np.linalg.norm(p, axis=1) + 1e-300
        off = np.einsum("kad,kd->ka", across, p) / r[:, None]
        return off, across @ J / r[:, None, None], np.sum(p * self.v[some], axis=1) > 0.0

    def misfits(self, T: Array, l: Array, some: Index) -> Array:
        """Return the squared angles, in sigmas, over their gate; infinite of what is behind."""
        off, _, ahead = self._angles(T, l, some)
        off = off / (LOOSE * self.sigma[some, None])
        return np.where(ahead, np.sum(off**2, axis=1) / chi2_gate(REACH, off.shape[1]), np.inf)

    def covariance(self, T: Array, l: Array, some: Index) -> Array:
        """Return the covariance of the pose."""
        J = self._angles(T, l, some)[1]
        return np.linalg.inv(np.einsum("kai,k,kaj->ij", J, (LOOSE * self.sigma[some]) ** -2, J))


class _Ranges(NamedTuple):
    """Distances r (K,) of a sensor of space with the attitude of T (7,), with their sigmas (K,)."""

    T: Array
    r: Array
    sigma: Array

    def solve(self, l: Array, some: Index) -> Array:
        """Return the pose from which some of the landmarks l (K, 3) are so far.

        With p from the middle m of the landmarks, 2 (l - m)'p = |l - m|^2 - r^2 + |p|^2: their differences determine p,
        but across landmarks in a plane.  The search begins on both sides of it.  Where neither is likelier by `SURE`,
        it is that of T: few robots are carried through a ceiling, or out of the water.
        """
        l, r = l[some], self.r[some]
        m = l.mean(axis=0)
        A, b = l - m, np.sum((l - m) ** 2, axis=1) - r**2
        U, s, Vt = np.linalg.svd(A, full_matrices=False)
        if not s[1] > 0.0:
            raise np.linalg.LinAlgError("they are on a line")
        flat = Vt[:2].T @ ((U.T @ (b - b.mean()))[:2] / (2.0 * s[:2]))
        height = math.sqrt(max(float(-b.mean() - flat @ flat), 0.0))
        found = [self._refined(m + flat + side * height * Vt[2], l, r, some) for side in (1.0, -1.0)]
        (best, least), (other, cost) = sorted(found, key=lambda one: one[1])
        if cost - least < 2.0 * SURE and (other - m) @ Vt[2] * ((self.T[:3] - m) @ Vt[2]) > 0.0:
            best = other
        return np.append(best, self.T[3:])

    def _refined(self, p: Array, l: Array, r: Array, some: Index) -> tuple[Array, float]:
        """Return the place (3,) of least squares from p on, and its chi-square."""
        weights = 1.0 / (LOOSE * self.sigma[some])
        for _ in range(4 * STEPS):
            v = p - l
            d = np.linalg.norm(v, axis=1) + 1e-300
            p = p + np.linalg.lstsq(v / d[:, None] * weights[:, None], (r - d) * weights)[0]
        return p, float(np.sum(((r - np.linalg.norm(p - l, axis=1)) * weights) ** 2))

    def misfits(self, T: Array, l: Array, some: Index) -> Array:
        """Return the squared errors, in sigmas, over their gate."""
        off = (np.linalg.norm(l[some] - T[:3], axis=1) - self.r[some]) / (LOOSE * self.sigma[some])
        return np.asarray(off**2 / chi2_gate(REACH, 1))

    def covariance(self, T: Array, l: Array, some: Index) -> Array:
        """Return the covariance of the pose."""
        v = T[:3] - l[some]
        J = v / (np.linalg.norm(v, axis=1) * LOOSE * self.sigma[some])[:, None]
        cov = ANY_RAD**2 * np.eye(6)
        cov[:3, :3] = np.linalg.inv(J.T @ J)
        return cov


def rows_of(of: Known, ids: Sequence[Id | None]) -> Index:
    """Return the rows (K,) of landmarks with these ids, -1 where there is none."""
    at = {name: row for row, name in enumerate(of.names)}
    return np.array([-1 if name is None else at.get(name, -1) for name in ids], dtype=np.int64)


def _by_ids(of: Known, rows: Index, fewest: int, seen: _Points | _Rays | _Ranges) -> Proposal | str:
    """Return the pose with which all observations of landmarks `rows` (K,) agree; so few of them determine one."""
    some = np.flatnonzero(rows >= 0)
    if len(some) < fewest:
        return f"its scan has {len(some)} landmarks with ids, a pose by these needs {fewest}"
    l = of.places()[rows]
    try:
        T = seen.solve(l, some)
        if (seen.misfits(T, l, some) > 1.0).any():
            return f"its {len(some)} landmarks with ids do not agree on a pose"
        return Proposal(T, seen.covariance(T, l, some), rows, SURE * (len(some) - fewest))
    except np.linalg.LinAlgError:
        return f"its {len(some)} landmarks with ids stand where they determine no pose"


def locate_tags(of: Known, ids: Sequence[Id | None], v: Array, cov: Array) -> Proposal | str:
    """Return the pose by the tag v (K, 7) with the covariance (K, 6, 6) with which most others agree, or why not."""
    rows = rows_of(of, ids)
    seen = np.flatnonzero((rows >= 0) & np.isfinite(v).all(axis=1))
    l, best = of.places()[rows[seen]], Proposal(np.zeros(7), np.eye(6), np.full(len(rows), -1), -math.inf)
    for k in seen.tolist():
        to_sensor, by_v = frames3d.inverse(v[k])
        T, _, by_sensor = frames3d.compose(of.values[rows[k]], to_sensor)
        J = LOOSE * by_sensor @ by_v
        P = J @ cov[k] @ J.T
        p, by_T, by_p = frames3d.from_frame(T, v[seen, :3])
        S = by_T @ P @ by_T.swapaxes(1, 2) + LOOSE**2 * by_p @ cov[seen, :3, :3] @ by_p.swapaxes(1, 2)
        near = np.sum((p - l) * np.linalg.solve(S, (p - l)[..., None])[..., 0], axis=1) <= chi2_gate(REACH, 3)
        if SURE * (near.sum() - 1) > best.gain:
            matched = np.full(len(rows), -1)
            matched[seen[near]] = rows[seen[near]]
            best = Proposal(T, P, matched, SURE * (near.sum() - 1))
    return best if len(seen) else "it sees no tag with the id of one that is known, and of one pose"


def search(of: Known, v: Array, sigma: Array) -> GlobalPose | str:
    """Return the pose that places v (K, 2) with these sigmas (K,) determine, or why they do not."""
    if len(v) < FEWEST:
        return f"its scan has {len(v)} observations, a start needs {FEWEST}"
    tried = [(base, hypotheses(of, v, sigma, *base)) for base in bases(v, sigma)]
    poses = distinct([pose for base, T in tried for pose in supported_poses(of, v, sigma, T, base)])
    if not poses:
        return f"no pose in the known map explains most of its {len(v)} observations"
    number = sum(len(T) for _, T in tried)
    p = chance_of_fit(of, sigma, 0, len(v), number)
    chance = by_chance(p, len(v), poses[0].pairs, number)
    if chance > BY_CHANCE:
        return f"{poses[0].pairs} observations agree, {chance:.1g} poses as good are expected by chance"
    poses = distinct([refine_pose(of, v, sigma, pose) for pose in poses])
    best = poses[0]
    if best.pairs < FEWEST or 2 * best.pairs <= len(v):
        return f"at most {best.pairs} of its {len(v)} observations agree with a pose in the known map"
    if len(poses) > 1 and poses[1].pairs > best.pairs - AS_GOOD:
        return f"its scan fits {poses[1].pairs} landmarks from another pose, and {best.pairs} from this one"
    others = [(base, T[~_are_same(T, best.T)]) for base, T in tried]
    rival = max(int(_supporters(of, v, sigma, T, base, FEWEST)[0].max(initial=0)) for base, T in others)
    p = chance_of_fit(of, sigma, rival, len(v), number)
    return best._replace(p=p, chance=by_chance(p, len(v), best.pairs, number))


def bases(v: Array, sigma: Array) -> list[tuple[int, int]]:
    """Return pairs of observations, those that determine a heading best first; no observation is in most of them."""
    i, j = np.triu_indices(len(v), 1)
    best = np.lexsort((j, i, np.linalg.norm(v[i] - v[j], axis=1) / np.hypot(sigma[i], sigma[j])))[::-1]
    used, found = np.zeros(len(v), dtype=np.int64), list[tuple[int, int]]()
    for one, other in zip(i[best].tolist(), j[best].tolist(), strict=True):
        if max(used[one], used[other]) < 2:
            found.append((one, other))
            used[[one, other]] += 1
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
    """Return of poses (H, 3) from a base those with which most of the scan agrees, or with `AS_GOOD` more would."""
    counts, reach = _supporters(of, v, sigma, T, base, max(FEWEST, len(v) // 2 + 1 - AS_GOOD))
    best = T[(counts > 0) & (counts > counts.max(initial=0) - AS_GOOD)]
    gaps, rows = of.tree().query(points_at_poses(best, v))
    return [GlobalPose(*one) for one in zip(best, np.where(gaps <= reach, rows, -1), strict=True)]


def _supporters(of: Known, v: Array, sigma: Array, T: Array, base: tuple[int, int], least: int) -> tuple[Index, Array]:
    """Return how many of v (K, 2) agree with poses T (H, 3) from a base, 0 of poses with less than `least`, and reach.

    That (K,) is how far each may be from its landmark.
    """
    i, j = base
    turn = np.hypot(sigma[i], sigma[j]) / np.linalg.norm(v[j] - v[i])
    lever = np.linalg.norm(v - (v[i] + v[j]) / 2, axis=1)
    spread = np.sqrt(sigma**2 + (sigma[i] ** 2 + sigma[j] ** 2) / 4 + (turn * lever) ** 2)
    reach, places = math.sqrt(chi2_gate(REACH, 2)) * spread, of.places()
    return count_supporters(T, v, reach, places[np.argsort(places[:, 0], kind="stable")], least), reach


@compiled
def count_supporters(T: Array, v: Array, reach: Array, places: Array, least: int) -> Index:
    """Return how many of v (K, 2) each pose T (H, 3) moves within their `reach` (K,) of one of the places (N, 2).

    These are in the order of x.  It is 0 of a pose with less than `least`, or with `AS_GOOD` less than one before it.
    """
    counts, most, k = np.zeros(len(T), np.int64), least + AS_GOOD - 1, len(v)
    for h in range(len(T)):
        c, s, count, left = math.cos(T[h, 2]), math.sin(T[h, 2]), 0, k
        while left > 0 and count + left > most - AS_GOOD:
            left -= 1
            x, y = c * v[left, 0] - s * v[left, 1] + T[h, 0], s * v[left, 0] + c * v[left, 1] + T[h, 1]
            low, high = 0, len(places)
            while low < high:
                middle = (low + high) // 2
                low, high = (middle + 1, high) if places[middle, 0] < x - reach[left] else (low, middle)
            while low < len(places) and places[low, 0] <= x + reach[left]:
                if (places[low, 0] - x) ** 2 + (places[low, 1] - y) ** 2 <= reach[left] ** 2:
                    count += 1
                    break
                low += 1
        if count > most - AS_GOOD:
            counts[h], most = count, max(most, count)
    return counts


def points_at_poses(T: Array, v: Array) -> Array:
    """Return where v (K, 2) are from each pose T (H, 3): (H, K, 2)."""
    c, s = np.cos(T[:, 2])[:, None], np.sin(T[:, 2])[:, None]
    return np.stack([c * v[:, 0] - s * v[:, 1] + T[:, :1], s * v[:, 0] + c * v[:, 1] + T[:, 1:2]], axis=2)


def refine_pose(of: Known, v: Array, sigma: Array, pose: GlobalPose) -> GlobalPose:
    """Return a pose by least squares of all its pairs, and the pairs from there, of each landmark one."""
    T, matched = pose.T, pose.matched
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
    out, left = list[GlobalPose](), sorted(poses, key=lambda pose: -pose.pairs)
    while left:
        out.append(left[0])
        same = _are_same(np.array([pose.T for pose in left]), left[0].T)
        left = [pose for pose, is_one in zip(left, same.tolist(), strict=True) if not is_one]
    return out


def _are_same(T: Array, one: Array) -> Flags:
    """Return which poses (H, 3) are one with another."""
    off = T - one
    return np.asarray((np.hypot(off[:, 0], off[:, 1]) <= SAME_M) & (np.abs(wrap(off[:, 2])) <= SAME_RAD))


def chance_of_fit(of: Known, sigma: Array, pairs: int, count: int, tried: int) -> float:
    """Return the probability that an observation is at a landmark from a wrong pose.

    It is that of landmarks anywhere, or, if it is larger, that with which one of so many poses is expected to have as
    many pairs of `count` as the best wrong one: landmarks in rows agree with themselves elsewhere.  As in a repeat of
    the map (Desolneux, Moisan and Morel 2008, ch. 3).
    """
    p = min(1.0, of.density() * math.pi * chi2_gate(REACH, 2) * float(np.mean(sigma**2)) * 2.0)
    return max(p, float(betaincinv(pairs - 2, count - pairs + 1, 1.0 / tried))) if pairs > 2 else p


def by_chance(p: float, count: int, pairs: int, tried: int) -> float:
    """Return how many of so many poses, each right for its two pairs, have as many pairs of `count` by chance."""
    return tried * float(bdtrc(pairs - 3, count - 2, p))
