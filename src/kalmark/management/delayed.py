"""Landmarks started late: when enough past measurements of one, each too little by itself, meet in one place.

[T] 2 (exercise 2); Costa, Kantor and Choset 2004.  A measurement of no landmark is kept with a clone of the pose it was
made from.  Two such measurements intersect in a place, with the Gaussian of what both poses and both measurements leave
open (compounded); a place near enough (Bhattacharyya) to a candidate is merged into it and its persistence counted; a
candidate that has persisted, and that all its measurements agree with, becomes a landmark.

The clones are blocks of the map, so that they stay correlated with all else and take part in every correction, loop
closures too; a landmark started from them has its right covariance with the robot and the map
(docs/bearing_only.md).  The candidates themselves correct nothing.

A sensor that can do this computes where two of its measurements `meet`; all else is the same for bearings and ranges.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Annotated, NamedTuple

import numpy as np

from kalmark.arrays import Array
from kalmark.declare import Count, Positive, Within, register
from kalmark.events import Id
from kalmark.geometry.frames import compose
from kalmark.geometry.gaussian import bhattacharyya, gate, merge, relative_frame
from kalmark.models.observe import linearize
from kalmark.tracks.clones import Measurement
from kalmark.tracks.scan import ScanContext, Start
from kalmark.tracks.track import Pending

VAGUE = 0.5  # a place less certain than this part of its distance is no Gaussian: not compared with anything
FITS = 0.999  # probability with which the measurements of a true landmark agree


@register("initialization", "delayed")
class Delayed:
    """Start landmarks when intersections of past measurements have persisted: docs/bearing_only.md.

    `distance` is the Bhattacharyya distance up to which two Gaussians are of one landmark.  Poses are cloned every
    `spacing_m` of the way, the last `poses` of them kept.  A candidate starts when its sigma is below `precision` of
    its distance, even without any one of its measurements, and is dropped when at `patience` clones in a row it was in
    view and not observed; the best `candidates` are kept.

    >>> camera = km.Mount(km.sensors.Bearing(), initialization=km.Delayed(spacing_m=0.2))
    >>> slam = km.Slam(km.Robot("rover", km.motion.Unicycle(), sensors={"camera": camera}))
    >>> slam.process(km.Scan(0.0, "rover", "camera", [[0.5]], ids=[7])).observations[0].outcome
    'deferred'
    """

    persistence: Annotated[Count, "Intersections that must have been merged into one."] = 4
    distance: Annotated[Positive, "Bhattacharyya distance up to which two Gaussians are of one landmark."] = 3.0
    spacing_m: Annotated[Positive, "Poses are kept every so many m of the way."] = 0.5
    poses: Annotated[int, Within(ge=3), "So many of them, the last ones."] = 20
    precision: Annotated[Positive, "A landmark starts when its sigma is below this part of its distance."] = 0.1
    patience: Annotated[
        Count, "A candidate is dropped when it was in view and not seen at so many kept poses in a row."
    ] = 3
    candidates: Annotated[Count, "At most so many candidates, the most persistent ones."] = 200


Candidates = list[Pending]


def has_moved(scan: ScanContext, last: int | None, policy: Delayed) -> bool:
    """Return whether the robot is far enough from where its pose was cloned last, the number of that clone."""
    here = scan.map.mean(scan.robot)[:2]
    return last is None or bool(np.linalg.norm(here - scan.map.mean(scan.clones[last])[:2]) >= policy.spacing_m)


# ---------------------------------------------------------------------- candidates
def extend_candidates(
    scan: ScanContext, policy: Delayed, candidates: Candidates, new: Mapping[int, Measurement],
    names: Mapping[int, Id | None],
) -> tuple[Candidates, dict[int, Pending]]:  # fmt: skip
    """Add measurements to the candidates they fit, make new ones where they meet single ones.

    A candidate takes the nearest one; what joined one starts no others.  Returns the candidates left and, of each
    measurement, the candidate with most measurements that it is in.
    """
    joined_: dict[int, Candidates] = {k: [] for k in new}
    made: dict[int, Candidates] = {k: [] for k in new}
    here = next(iter(new.values())).clone
    frames: dict[int, tuple[Array, Array]] = {}
    kept: Candidates = []
    for c in candidates:
        first, best = c.measurements[0], None
        if first.clone not in frames:
            frames[first.clone] = _relative(scan, first.clone, here)
        mine = {k: m for k, m in new.items() if names[k] == c.name}
        for k, mean, cov in _places(scan, frames[first.clone], first, mine) if mine else ():
            if c.mean is None:
                made[k].append(Pending(scan.key, c.name, (first, new[k]), mean, cov))
                continue
            far = bhattacharyya(c.mean, c.cov, mean, cov)
            if far <= policy.distance and (best is None or far < best[0]):
                best = far, k, mean, cov
        if best is not None:
            mean, cov = merge(c.mean, c.cov, *best[2:])
            more = replace(c, mean=mean, cov=cov, measurements=(*c.measurements, new[best[1]]), missed=0)
            joined_[best[1]].append(more)
            kept.append(more)
        elif c.mean is not None:
            kept.append(replace(c, missed=c.missed + _in_view(scan, frames[first.clone][0], c.mean)))
        else:
            kept.append(c)
    for k, m in new.items():
        if not joined_[k]:
            joined_[k] = made[k]
            kept += made[k]
        alone = Pending(scan.key, names[k], (m,))
        kept.append(alone)
        joined_[k] = joined_[k] or [alone]
    several = [c for c in kept if c.mean is not None and c.missed < policy.patience]
    several.sort(key=lambda c: (len(c.measurements), -c.missed), reverse=True)
    left = several[: policy.candidates] + [c for c in kept if c.mean is None]
    return left, {k: max(mine, key=lambda c: len(c.measurements)) for k, mine in joined_.items()}


def without_clone(scan: ScanContext, candidates: Candidates, number: int) -> Candidates:
    """Return the candidates without the measurements made from a clone that is to go."""
    kept: Candidates = []
    for c in candidates:
        if c.measurements[0].clone == number and len(c.measurements) > 1:
            c = _seen_from_the_next(scan, c)  # noqa: PLW2901
        left = tuple(m for m in c.measurements if m.clone != number)
        if left and (c.mean is None or len(left) > 1):
            kept.append(replace(c, measurements=left))
    return kept


def _in_view(scan: ScanContext, T: Array, p: Array) -> int:
    """Return 1 if the sensor at T should observe a point (2,), 0 if not."""
    return int(scan.channel.sensor.sees(scan.channel.landmark.seen_from(T, p[None])[0])[0])


def _places(
    scan: ScanContext, frame: tuple[Array, Array], first: Measurement, others: dict[int, Measurement]
) -> Iterator[tuple[int, Array, Array]]:
    """Yield the Gaussians (2,), (2, 2) of where measurements meet a first one, in the frame of the first one's sensor.

    The first measurement is of the place itself, the other one of it as seen from T, both poses being uncertain: the
    Jacobians follow from those of what is expected, F p_x = -F_x.
    """
    (T, C), landmark, s = frame, scan.channel.landmark, scan.channel.calibrated(scan.map)
    y = np.array([m.y for m in others.values()])
    p = s.meet(T, np.tile(first.y, (len(y), 1)), y)
    rows, which = np.nonzero(np.isfinite(p).all(axis=2))
    p = p[rows, which]
    if not len(p):
        return
    v, V_T, V_p = landmark.seen_from(T, p)
    E, F_p = s.expect(p)[1], s.expect(v)[1]
    F, F_T, m = np.concatenate([E, F_p @ V_p], axis=1), F_p @ V_T, len(first.y)
    seen, reach = s.sees(p) & s.sees(v), np.minimum(np.linalg.norm(p, axis=1), np.linalg.norm(v, axis=1))
    ks = list(others)
    for i in np.flatnonzero(seen).tolist():
        k, S = ks[rows[i]], np.zeros((2 * m, 2 * m))
        S[:m, :m], S[m:, m:] = first.R, others[k].R + F_T[i] @ C @ F_T[i].T
        back = np.linalg.pinv(F[i])
        cov = back @ S @ back.T
        if np.linalg.norm(cov, 2) < (VAGUE * reach[i]) ** 2:
            yield k, p[i], (cov + cov.T) / 2


def _relative(scan: ScanContext, a: int, b: int) -> tuple[Array, Array]:
    """Return the pose of the sensor at clone b as seen from that at a, (3,), and its covariance (3, 3)."""
    slots = [scan.clones[a], scan.clones[b]]
    (S, S_a, _), (T, T_b, _) = (compose(scan.map.mean(slot), _mount(scan)) for slot in slots)
    c, C_S, C_T = relative_frame(S, T)
    J = np.hstack([C_S @ S_a, C_T @ T_b])
    return c, J @ scan.map.covariance(slots) @ J.T


def _seen_from_the_next(scan: ScanContext, c: Pending) -> Pending:
    """Return a candidate with its Gaussian in the frame of its second measurement: compounded.  [T] 2."""
    assert c.mean is not None
    T, C = _relative(scan, c.measurements[0].clone, c.measurements[1].clone)
    p, P_T, P_p = scan.channel.landmark.seen_from(T, c.mean[None])
    return replace(c, mean=p[0], cov=P_T[0] @ C @ P_T[0].T + P_p[0] @ c.cov @ P_p[0].T)


# ---------------------------------------------------------------------- landmarks
class Outcome(NamedTuple):
    """The outcome of a candidate: the candidates left, why, and the landmark it starts, from which measurements."""

    candidates: Candidates
    reason: str
    start: Start | None = None
    used: Pending | None = None


class Solution(NamedTuple):
    """A point p (2,) with covariance G P G' + Q, P of the `slots`; its chi-square.

    `relative_sigma` is its sigma by its distance, seen from the last pose, without that measurement that would be
    missed most: two landmarks seen in one direction for a while, and once something else across, are none.
    """

    p: Array
    G: Array
    Q: Array
    slots: list[int]
    chi2: float
    dof: int
    relative_sigma: float

    def start(self, scan: ScanContext) -> Start:
        """Return the landmark as a block."""
        parts = tuple((slot, len(scan.map.rows(slot))) for slot in self.slots)
        return Start(scan.channel.landmark.space, self.p, parts, self.G, self.Q)


def start_landmark(scan: ScanContext, policy: Delayed, candidates: Candidates, c: Pending) -> Outcome:
    """Return the landmark that a candidate starts, or why not yet."""
    merged = len(c.measurements) - 1
    if merged < policy.persistence:
        return Outcome(candidates, f"{merged} of {policy.persistence} intersections agree")
    found = solve_candidate(scan, c)
    if not found.chi2 <= gate(FITS, found.dof):
        left = [other for other in candidates if other is not c]
        return Outcome(left, f"its {merged + 1} measurements do not agree: chi-square {found.chi2:.1f} of {found.dof}")
    if not found.relative_sigma < policy.precision:
        return Outcome(candidates, f"without one of its measurements its place is not known to {policy.precision:.0%}")
    found, filled, gap = _filled(scan, candidates, c, found)
    if gap >= policy.patience:
        left = [filled if other is c else other for other in candidates]
        return Outcome(left, f"in view and not seen at {gap} kept poses in a row")
    return Outcome(candidates, f"{merged} intersections agree", found.start(scan), filled)


def drop_explained(scan: ScanContext, candidates: Candidates, used: Pending, slot: int) -> Candidates:
    """Return the candidates without the measurements that a new landmark on a slot explains."""
    model = scan.channel.models[scan.channel.landmark.kind]
    gone = {(m.clone, m.k) for m in used.measurements}
    waiting = {(m.clone, m.k): m for c in candidates if c.name == used.name for m in c.measurements}
    for key, m in waiting.items():
        pose = scan.clones[m.clone]
        d2 = scan.channel.predict(scan.map, pose, model, np.array([slot]), m.y[None], m.R[None])[1][0]
        if d2 <= gate(FITS, len(m.y)):
            gone.add(key)
    return [
        other for other in candidates
        if not gone & {(m.clone, m.k) for m in other.measurements} and (used.name is None or other.name != used.name)
    ]  # fmt: skip


def solve_candidate(scan: ScanContext, c: Pending) -> Solution:
    """Return the point that fits all measurements of a candidate best.

    Least squares weighted by S = H P H' + R, P of the poses: with W = (E' S^-1 E)^-1 E' S^-1 the point errs by
    -W (H d + v), d the error of the poses and v that of the measurements, so that G = -W H and Q = W R W'.
    """
    from scipy.linalg import block_diag

    map_, slots, n, m = scan.map, _slots(scan, c), len(c.measurements), len(c.measurements[0].y)
    P, R = map_.covariance(slots), block_diag(*(measurement.R for measurement in c.measurements))
    assert c.mean is not None
    p: Array = scan.channel.landmark.from_view(scan.channel.pose(map_, slots[0]), c.mean[None])[0][0]
    for _ in range(10):
        z, E, H = _linearized(scan, c, p, len(P))
        W = _weights(E, H @ P @ H.T + R)
        step = W @ z
        p = p + step
        if not np.linalg.norm(step) >= 1e-9 * (1 + np.linalg.norm(p)):
            break
    z = z - E @ step
    chi2 = float(z @ np.linalg.solve(H @ P @ H.T + R, z)) if np.isfinite(z).all() else math.inf
    if not math.isfinite(chi2):
        return Solution(p, -W @ H, W @ R @ W.T, slots, math.inf, n * m - 2, math.inf)
    last = scan.channel.pose(map_, slots[n - 1])
    v, V_T, V_p = (a[0] for a in scan.channel.landmark.seen_from(last, p[None]))
    V_P = np.zeros((2, len(P)))
    V_P[:, 3 * (n - 1) : 3 * n] = V_T @ compose(map_.mean(slots[n - 1]), _mount(scan))[1]
    worst = 0.0
    for i in range(n):
        keep = np.repeat(np.arange(n) != i, m)
        W_i = _weights(E[keep], (H @ P @ H.T + R)[np.ix_(keep, keep)])
        J = V_P - V_p @ W_i @ H[keep]
        cov = J @ P @ J.T + V_p @ W_i @ R[np.ix_(keep, keep)] @ W_i.T @ V_p.T
        worst = max(worst, float(np.linalg.norm(cov, 2)) if np.isfinite(cov).all() else math.inf)
    return Solution(p, -W @ H, W @ R @ W.T, slots, chi2, n * m - 2, math.sqrt(worst) / float(np.linalg.norm(v)))


def _filled(
    scan: ScanContext, candidates: Candidates, c: Pending, found: Solution
) -> tuple[Solution, Pending, int]:  # fmt: skip
    """Join what was measured of a candidate at clones between its own; return solution, candidate and longest gap left.

    Where two landmarks were in line for a while and something else across, there was nothing to be seen in between.
    """
    gap, longest, size = 0, 0, sum(len(scan.map.rows(slot)) for slot in found.slots) - 3 * (len(c.measurements) - 1)
    own = {m.clone for m in c.measurements}
    others = {(m.clone, m.k): m for other in candidates if other.name == c.name for m in other.measurements}
    first, last = c.measurements[0].clone, c.measurements[-1].clone
    for at in [n for n in scan.clones.of(scan.key) if first < n < last]:
        if at in own or not _in_view(scan, scan.channel.pose(scan.map, scan.clones[at]), found.p):
            gap = 0
            continue
        gap, here = gap + 1, [m for m in others.values() if m.clone == at]
        off = [_linearized(scan, Pending(scan.key, c.name, (m,)), found.p, size)[0] for m in here]
        for i in np.argsort([np.linalg.norm(z) for z in off])[:1].tolist():
            more = replace(c, measurements=tuple(sorted([*c.measurements, here[i]], key=lambda m: m.clone)))
            better = solve_candidate(scan, more)
            if better.chi2 - found.chi2 <= gate(FITS, len(here[i].y)):
                c, found, gap = more, better, 0
        longest = max(longest, gap)
    return found, c, longest


def _linearized(scan: ScanContext, c: Pending, p: Array, size: int) -> tuple[Array, Array, Array]:
    """Return the innovations z (n m,) of a point p and their Jacobians E (n m, 2) in it and H (n m, size) in poses."""
    model, n, m = scan.channel.models[scan.channel.landmark.kind], len(c.measurements), len(c.measurements[0].y)
    z, E, H = np.empty(n * m), np.empty((n * m, 2)), np.zeros((n * m, size))
    for i, measurement in enumerate(c.measurements):
        rows, pose = slice(i * m, (i + 1) * m), scan.clones[measurement.clone]
        observer = scan.channel.observer(scan.map, pose)
        _, z_i, E_h, E_l = linearize(model.model, observer, p[None], measurement.y[None])
        E_i = scan.estimator.pose_jacobian(scan.map, pose, E_h[0])
        z[rows], E[rows], H[rows, 3 * i : 3 * i + 3] = z_i[0], E_l[0], E_i[:, :3]
        H[rows, 3 * n :] = E_i[:, 3:]
    return z, E, H


def _weights(E: Array, S: Array) -> Array:
    """Return W = (E' S^-1 E)^-1 E' S^-1, NaN where there is none: where the measurements do not meet."""
    try:
        S_E = np.linalg.solve(S, E)
        return np.linalg.solve(E.T @ S_E, S_E.T)
    except np.linalg.LinAlgError:
        return np.full(E.T.shape, np.nan)


def _slots(scan: ScanContext, c: Pending) -> list[int]:
    """Return the slots that a candidate's measurements depend on: the clones and, if it is in the map, the mount."""
    slots = [scan.clones[m.clone] for m in c.measurements]
    return slots if scan.channel.mount < 0 else [*slots, scan.channel.mount]


def _mount(scan: ScanContext) -> Array:
    """Return where the sensor sits on its robot, as it is estimated."""
    return scan.channel.at if scan.channel.mount < 0 else scan.map.mean(scan.channel.mount)[:3]
