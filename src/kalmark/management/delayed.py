"""Landmarks started late: when enough past measurements of one, each too little by itself, meet in one place.

[T] 2 (exercise 2); Costa, Kantor and Choset 2004.  What belongs to no landmark is kept with the pose it was seen from.
Two such measurements intersect in a place, with the Gaussian of what both poses and both measurements leave open
(compounded); a place near enough (Bhattacharyya) to a candidate is merged into it and its persistence counted; a
candidate that has persisted, and that all its measurements agree with, becomes a landmark.

The past poses are blocks of the map, copies of the robot's pose at the time, as long as anything waits for them.  So
they stay correlated with all else and go along with every correction, loop closures too; a landmark started from them
has its right covariance with the robot and the map (docs/bearing_only.md).  The candidates themselves correct nothing.

A sensor that can do this says where two of its measurements `meet`; all else is the same for bearings and ranges.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from kalmark.association.protocol import NEW, Decision
from kalmark.errors import MapError, ModelError
from kalmark.events import Id, Scan
from kalmark.geometry.frames import compose
from kalmark.geometry.gaussian import between, bhattacharyya, gate, merge
from kalmark.geometry.spaces import SE2
from kalmark.management.candidates import Candidate, Sight, Solution, Waiting, linearized, mount_of, solved
from kalmark.report import Observation

if TYPE_CHECKING:
    from kalmark.slam.slam import Slam
    from kalmark.tracks.scene import View

Array = npt.NDArray[np.float64]

VAGUE = 0.5  # a place less sure than this part of its distance is no Gaussian: not compared with anything
FITS = 0.999  # probability with which the measurements of a true landmark agree


@dataclass(frozen=True)
class Delayed:
    """Start landmarks when `persistence` intersections of past measurements have been merged into one.

    `distance` is the Bhattacharyya distance up to which two Gaussians are of one landmark.  Poses are kept every
    `spacing_m` of the way, the last `poses` of them.  A candidate starts when its sigma is below `precision` of its
    distance, even without any one of its measurements, and is dropped when at `patience` kept poses in a row it was in
    view and not seen; the best `candidates` are kept.
    """

    persistence: int = 4
    distance: float = 3.0
    spacing_m: float = 0.5
    poses: int = 20
    precision: float = 0.1
    patience: int = 3
    candidates: int = 200

    def __post_init__(self) -> None:
        for name, least in (("persistence", 1), ("poses", 3), ("patience", 1), ("candidates", 1)):
            value = getattr(self, name)
            if type(value) is not int or value < least:
                raise ModelError(f"Delayed: {name} is {value!r}, expected a whole number of at least {least}")
        for name in ("distance", "spacing_m", "precision"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value < np.inf:
                raise ModelError(f"Delayed: {name} is {value!r}, expected a positive number")

    def is_ripe(self, merged: int) -> bool:
        """Return whether a candidate of so many merged intersections has persisted."""
        return merged >= self.persistence


def sightings(
    slam: Slam, view: View, event: Scan, new: Sequence[int], decisions: Sequence[Decision], R: Array
) -> Iterator[tuple[int, Observation]]:
    """Take what belongs to no landmark yet, and yield what became of each observation: still waiting, or a landmark."""
    names = {k: decisions[k][0] for k in new}
    rows = [k for k, n in names.items() if n is NEW or (isinstance(n, int | str) and n not in slam.members.slots)]
    if view.delayed is None or not rows:
        return
    waiting, robot = view.waiting, slam.members.slots[event.robot]
    ids: dict[int, Id | None] = {k: None if names[k] is NEW else names[k] for k in rows}  # type: ignore[misc]
    if waiting.poses and _way(slam, waiting, robot) < view.delayed.spacing_m:
        for k in rows:
            yield k, Observation(k, ids[k], "deferred", None, None, "until the robot has moved on")
        return
    try:
        here = _keep_pose(slam, waiting, robot)
    except MapError as full:
        for k in rows:
            yield k, Observation(k, ids[k], "ignored", None, None, str(full))
        return
    joined = _joined(slam, view, {k: Sight(here, k, event.y[k], R[k]) for k in rows}, ids)
    _forget_hopeless(view)
    for k in rows:
        most = max(joined[k], key=lambda c: len(c.sights))
        landmark, reason = _started(slam, view, most)
        yield k, Observation(k, ids[k], "new" if landmark is not None else "deferred", landmark, None, reason)
    _forget_poses(slam, view)


def _way(slam: Slam, waiting: Waiting, robot: int) -> float:
    """Return how far a robot is from where the last pose was kept."""
    last = next(reversed(waiting.poses.values()))
    return float(np.linalg.norm(slam.map.mean(robot)[:2] - slam.map.mean(last)[:2]))


def _keep_pose(slam: Slam, waiting: Waiting, robot: int) -> int:
    """Copy a robot's pose into a block of its own and return its number.  Raises MapError if the map is full."""
    mean, index = slam.map.mean(robot)[:3], slam.map.index(robot)[:3]
    slot = slam.map.augment(SE2, mean, index, np.eye(3), np.zeros((3, 3)))
    waiting.numbered += 1
    waiting.poses[waiting.numbered] = slot
    return waiting.numbered


# ---------------------------------------------------------------------- candidates
def _joined(
    slam: Slam, view: View, sights: dict[int, Sight], names: dict[int, Id | None]
) -> dict[int, list[Candidate]]:
    """Add measurements to the candidates they fit, make new ones where they meet single ones; return those of each.

    A candidate takes the nearest one; what joined one starts no others.
    """
    waiting, policy = view.waiting, view.delayed
    assert policy is not None
    joined: dict[int, list[Candidate]] = {k: [] for k in sights}
    made: dict[int, list[Candidate]] = {k: [] for k in sights}
    sensor, here = view.calibrated(slam.map), next(iter(sights.values())).at
    frames: dict[int, tuple[Array, Array]] = {}
    for c in waiting.candidates:
        first, best = c.sights[0], None
        if first.at not in frames:
            frames[first.at] = _relative(slam, view, first.at, here)
        mine = {k: sight for k, sight in sights.items() if names[k] == c.name}
        for k, mean, cov in _places(view, sensor, frames[first.at], first, mine) if mine else ():
            if c.mean is None:
                made[k].append(Candidate(c.name, [first, sights[k]], mean, cov))
                continue
            far = bhattacharyya(c.mean, c.cov, mean, cov)
            if far <= policy.distance and (best is None or far < best[0]):
                best = far, k, mean, cov
        if best is not None:
            c.mean, c.cov = merge(c.mean, c.cov, *best[2:])
            c.sights.append(sights[best[1]])
            c.missed = 0
            joined[best[1]].append(c)
        elif c.mean is not None:
            c.missed += _in_view(view, frames[first.at][0], c.mean)
    for k, sight in sights.items():
        joined[k] = joined[k] or made[k]
        waiting.candidates += [c for c in made[k] if c in joined[k]]
        alone = Candidate(names[k], [sight])
        waiting.candidates.append(alone)
        joined[k] = joined[k] or [alone]
    return joined


def _in_view(view: View, T: Array, p: Array) -> int:
    """Return 1 if the sensor at T should see a point (2,), 0 if not."""
    sensor: Any = view.sensor
    return int(sensor.sees(view.landmark.seen_from(T, p[None])[0])[0])


def _places(
    view: View, sensor: Any, frame: tuple[Array, Array], first: Sight, others: dict[int, Sight]
) -> Iterator[tuple[int, Array, Array]]:
    """Yield the Gaussians (2,), (2, 2) of where measurements meet a first one, in the frame of the first one's sensor.

    The first measurement is of the place itself, the other one of it as seen from T, both poses being uncertain: the
    Jacobians follow from those of what is expected, F p_x = -F_x.
    """
    T, C = frame
    y = np.array([sight.y for sight in others.values()])
    p = sensor.meet(T, np.tile(first.y, (len(y), 1)), y)
    rows, which = np.nonzero(np.isfinite(p).all(axis=2))
    p = p[rows, which]
    if not len(p):
        return
    v, V_T, V_p = view.landmark.seen_from(T, p)
    E, F_p = sensor.expect(p)[1], sensor.expect(v)[1]
    F, F_T, m = np.concatenate([E, F_p @ V_p], axis=1), F_p @ V_T, len(first.y)
    seen, reach = sensor.sees(p) & sensor.sees(v), np.minimum(np.linalg.norm(p, axis=1), np.linalg.norm(v, axis=1))
    ks = list(others)
    for i in np.flatnonzero(seen).tolist():
        k, S = ks[rows[i]], np.zeros((2 * m, 2 * m))
        S[:m, :m], S[m:, m:] = first.R, others[k].R + F_T[i] @ C @ F_T[i].T
        back = np.linalg.pinv(F[i])
        cov = back @ S @ back.T
        if np.linalg.norm(cov, 2) < (VAGUE * reach[i]) ** 2:
            yield k, p[i], (cov + cov.T) / 2


def _relative(slam: Slam, view: View, a: int, b: int) -> tuple[Array, Array]:
    """Return the pose of the sensor at b as seen from that at a, (3,), and its covariance (3, 3)."""
    slots = [view.waiting.poses[a], view.waiting.poses[b]]
    (S, S_a, _), (T, T_b, _) = (compose(slam.map.mean(slot), mount_of(slam, view)) for slot in slots)
    c, C_S, C_T = between(S, T)
    J = np.hstack([C_S @ S_a, C_T @ T_b])
    return c, J @ slam.map.covariance(slots) @ J.T


def _forget_hopeless(view: View) -> None:
    """Drop the candidates that were looked for and not found, and the least of too many."""
    waiting, policy = view.waiting, view.delayed
    assert policy is not None
    alone = [c for c in waiting.candidates if c.mean is None]
    several = [c for c in waiting.candidates if c.mean is not None and c.missed < policy.patience]
    several.sort(key=lambda c: (len(c.sights), -c.missed), reverse=True)
    waiting.candidates = several[: policy.candidates] + alone


# ---------------------------------------------------------------------- landmarks
def _started(slam: Slam, view: View, c: Candidate) -> tuple[Id | None, str]:
    """Make a landmark of a candidate that is ripe; return its name, or None, and why."""
    policy, waiting, merged = view.delayed, view.waiting, len(c.sights) - 1
    assert policy is not None
    if not policy.is_ripe(merged):
        return None, f"{merged} of {policy.persistence} intersections agree"
    found = solved(slam, view, c)
    if not found.chi2 <= gate(FITS, found.dof):
        waiting.candidates = [other for other in waiting.candidates if other is not c]
        return None, f"its {len(c.sights)} measurements do not agree: chi-square {found.chi2:.1f} of {found.dof}"
    if not found.vagueness < policy.precision:
        return None, f"without one of its measurements its place is not known to {policy.precision:.0%}"
    found, gap = _filled(slam, view, c, found)
    if gap >= policy.patience:
        return None, f"in view and not seen at {gap} kept poses in a row"
    try:
        slot = slam.map.augment(view.landmark.space, found.p, found.rows, found.G, found.Q)
    except MapError as full:
        return None, str(full)
    name = slam.members.new_name() if c.name is None else c.name
    slam.members.start(name, slot, view.landmark)
    slam.members.seen[name] = len(c.sights)
    used = {(sight.at, sight.k) for sight in c.sights} | _explained(slam, view, c.name, slot)
    waiting.candidates = [
        other for other in waiting.candidates
        if not used & {(sight.at, sight.k) for sight in other.sights} and (c.name is None or other.name != c.name)
    ]  # fmt: skip
    return name, f"{merged} intersections agree"


def _filled(slam: Slam, view: View, c: Candidate, found: Solution) -> tuple[Solution, int]:
    """Join what was seen of a candidate at poses between its own; return its solution and the longest gap that is left.

    Where two landmarks were in line for a while and something else across, there was nothing to be seen in between.
    """
    waiting, gap, longest = view.waiting, 0, 0
    own, size = {sight.at for sight in c.sights}, len(found.rows) - 3 * (len(c.sights) - 1)
    sights = {(s.at, s.k): s for other in waiting.candidates if other.name == c.name for s in other.sights}
    for at in [n for n in waiting.poses if c.sights[0].at < n < c.sights[-1].at]:
        T = view.pose(slam.map, waiting.poses[at])
        if at in own or not _in_view(view, T, found.p):
            gap = 0
            continue
        gap, here = gap + 1, [s for s in sights.values() if s.at == at]
        off = [linearized(slam, view, Candidate(c.name, [s]), found.p, size)[0] for s in here]
        for i in np.argsort([np.linalg.norm(z) for z in off])[:1].tolist():
            more = Candidate(c.name, sorted([*c.sights, here[i]], key=lambda s: s.at), c.mean, c.cov)
            better = solved(slam, view, more)
            if better.chi2 - found.chi2 <= gate(FITS, len(here[i].y)):
                c.sights, found, gap = more.sights, better, 0
        longest = max(longest, gap)
    return found, longest


def _explained(slam: Slam, view: View, name: Id | None, slot: int) -> set[tuple[int, int]]:
    """Return which measurements that wait fit a new landmark: they are no evidence of another one."""
    look, map_ = view.looks[view.landmark.kind], slam.map
    sights = {(s.at, s.k): s for c in view.waiting.candidates if c.name == name for s in c.sights}
    found = set()
    for key, sight in sights.items():
        pose = view.waiting.poses[sight.at]
        d2 = view.predict(map_, pose, look, np.array([slot]), sight.y[None], sight.R[None])[1][0]
        if d2 <= gate(FITS, len(sight.y)):
            found.add(key)
    return found


# ---------------------------------------------------------------------- kept poses
def _forget_poses(slam: Slam, view: View) -> None:
    """Remove the oldest of too many poses, and those that nothing waits for any more, but for the last one."""
    waiting, most = view.waiting, view.delayed.poses  # type: ignore[union-attr]
    for number in list(waiting.poses)[:-most]:
        _drop_pose(slam, view, number)
    used = {sight.at for c in waiting.candidates for sight in c.sights}
    for number in [n for n in list(waiting.poses)[:-1] if n not in used]:
        slam.map.remove(waiting.poses.pop(number))


def _drop_pose(slam: Slam, view: View, number: int) -> None:
    """Remove a kept pose with the measurements made there."""
    waiting, kept = view.waiting, []
    for c in waiting.candidates:
        if c.sights[0].at == number and len(c.sights) > 1:
            _lean_on_the_next(slam, view, c)
        c.sights = [sight for sight in c.sights if sight.at != number]
        if c.sights and (c.mean is None or len(c.sights) > 1):
            kept.append(c)
    waiting.candidates = kept
    slam.map.remove(waiting.poses.pop(number))


def _lean_on_the_next(slam: Slam, view: View, c: Candidate) -> None:
    """Move a candidate's Gaussian from the frame of its first measurement to that of its second: compounded.  [T] 2."""
    T, C = _relative(slam, view, c.sights[0].at, c.sights[1].at)
    p, P_T, P_p = view.landmark.seen_from(T, c.mean[None])  # type: ignore[index]
    c.mean, c.cov = p[0], P_T[0] @ C @ P_T[0].T + P_p[0] @ c.cov @ P_p[0].T
