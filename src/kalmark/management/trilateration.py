"""Landmarks from ranges alone, or from strengths: kept with the poses they were made from until a position follows.

The poses are clones in the map, so that they are corrected with everything else and their errors are correlated as
they are.  The position l minimises the chi-square of all ranges kept, y_i = h(l - s_i), whose errors are those of the
places s of the sensor, of the sensor's own parameters and of the ranges, marginalised: Sigma = H_x P H_x' + R.  The
search starts in every direction; it ends when one minimum alone is left whose chi-square is that of its covariance
within a sigma.  Then the landmark is a function of the map, l = g(x, y), and enters as any other does.  [S] (32)-(38);
docs/range_only.md.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated

import numpy as np

from kalmark.arrays import Array
from kalmark.declare import Probability, Within, register
from kalmark.geometry.gaussian import gate as chi2_gate
from kalmark.geometry.spaces import POINT2
from kalmark.management.pending import OTHERS, Step
from kalmark.models.observe import sensor_pose
from kalmark.models.range_fit import Fits, RangeProblem, model_of
from kalmark.tracks.clones import Measurement
from kalmark.tracks.scan import ScanContext, Start
from kalmark.tracks.track import Pending

ROUGH, SETTLED = 1e-6, 1e-12  # a search is over when the next step changes chi-square by less; rough while many compete
OUTLIER = 0.9999  # a set of ranges that fits worse than this probability has one that is wrong
BULGE = 0.03  # how far a circle may leave its tangent within a sigma of the position, in sigmas of the range
OUT = 3.0  # sigmas from the minimum at which its shape is tested,
AROUND = 2 * np.pi * np.arange(24) / 24  # in these directions (0: the longest axis),
SHAPE = 2.0  # and by how much less the likelihood may fall off there than a Gaussian's, OUT^2


@register("initialization", "trilateration")
class Trilateration:
    """Keep ranges until the position that they determine is unique, then start a point.

    `poses` is the number of ranges kept of a landmark: of more, every other one is given up.  The search starts in
    `directions` directions; a second answer whose odds are above `odds` means to wait.

    >>> beacon = km.Mount(km.sensors.Range(), initialization=km.initialization.Trilateration())
    >>> slam = km.Slam(km.Robot("rover", km.motion.Unicycle(), sensors={"radio": beacon}))
    >>> slam.process(km.Scan(0.0, "rover", "radio", [[4.0]], ids=[7])).observations[0].outcome
    'deferred'
    """

    poses: Annotated[int, Within(ge=4), "Ranges kept of one landmark; of more, every other one is given up."] = 24
    directions: Annotated[int, Within(ge=3), "Directions in which the search for the position starts."] = 12
    odds: Annotated[Probability, "A second position with better odds than this means to wait."] = 1e-3

    def observe(self, scan: ScanContext, k: int, pending: Pending) -> Step:
        """Keep a range, unless it was made from where the last one was."""
        if pending.channel != scan.key:
            return Step("ignored", OTHERS)
        if not pending.measurements:
            return Step("deferred", "", replace(pending, spacing_m=float(scan.distances()[1][k])), keep=True)
        last = scan.channel.pose(scan.map, scan.clones[pending.measurements[-1].clone])[:2]
        if np.linalg.norm(scan.pose()[:2] - last) < pending.spacing_m:
            return Step("deferred", f"within {pending.spacing_m:.2f} m of where the last range kept was taken")
        return Step("deferred", "", keep=True)

    def solve(self, scan: ScanContext, pending: Pending) -> Step:
        """Start the landmark if its ranges determine it; of too many ranges drop every other one."""
        if len(pending.measurements) < 3:
            return Step("deferred", "it takes three ranges to determine a position")
        found = self._answer(scan, pending)
        left = pending if found.pending is None else found.pending
        if found.start is not None or len(left.measurements) < self.poses:
            return found
        thinned = replace(left, measurements=left.measurements[::2], spacing_m=2 * left.spacing_m)
        return found._replace(pending=thinned)

    def _answer(self, scan: ScanContext, pending: Pending) -> Step:
        """Return the step that starts the landmark, or why it cannot start yet."""
        kept = pending.measurements
        problem = _problem(scan, kept)
        distances = scan.channel.calibrated(scan.map).distances(np.array([m.y for m in kept]))
        nearest = int(np.argmin(distances))  # two positions that fit are mirror images there
        heading = scan.pose()[2]  # whatever it is, it rotates with the world frame
        angles = heading + 2 * np.pi * np.arange(self.directions) / self.directions
        starts = problem.places[nearest] + distances[nearest] * np.column_stack([np.cos(angles), np.sin(angles)])
        bent = problem.own > 0 or any(_varies(scan, each) for each in kept)
        now, damping = problem.fit(starts), np.full(len(starts), 1e-3)
        most = chi2_gate(OUTLIER, max(1, len(kept) - 2))
        for all_ in (False, True):  # where the likeliest minimum does not determine it, the others are not sought
            now, damping = problem.search(now, damping, ROUGH, all_)
            best = now.of(int(np.argmin(now.cost)))
            if best.chi2 <= most and not _is_determined(problem, best, bent):
                return Step("deferred", f"{len(kept)} ranges do not determine yet where it is")
        if best.chi2 > most:
            worst = int(np.argmax((best.inverse @ best.z) ** 2 / np.diag(best.inverse)))
            why = f"a range of {kept[worst].y[0]:.2f} m does not fit the others and is left out"
            return Step("deferred", why, replace(pending, measurements=(*kept[:worst], *kept[worst + 1 :])))
        information = best.information
        gaps = now.l - best.l
        apart = np.einsum("ji,ik,jk->j", gaps, information, gaps) > 1.0
        if (apart & (now.cost - best.cost < -2 * math.log(self.odds))).any():
            return Step("deferred", f"{len(kept)} ranges fit two positions")
        first = np.argmin(now.cost, keepdims=True)
        best = problem.search(now.of(first), damping[first], SETTLED)[0].of(0)
        W = np.linalg.solve(best.information, best.H.T @ best.inverse)
        parts = tuple((slot, len(scan.map.rows(slot))) for slot in problem.slots)
        H_x = np.einsum("iw,iwx->ix", best.H_w, problem.S_x)
        start = Start(POINT2, best.l, parts, -W @ H_x, (W * best.R) @ W.T)
        return Step("new", f"from {len(kept)} ranges", start=start, measurements=len(kept))


def _varies(scan: ScanContext, m: Measurement) -> bool:
    """Return whether the variance of a range is that of a range like it: the distance will determine it."""
    return scan.channel.noise_at is not None and not m.own_noise


def _problem(scan: ScanContext, kept: Sequence[Measurement]) -> RangeProblem:
    """Return the problem whose solution is the position of the landmark."""
    map_, channel, n = scan.map, scan.channel, len(kept)
    sensor, clones = channel.calibrated(map_), [scan.clones[m.clone] for m in kept]
    slots = clones if channel.mount < 0 else [channel.mount, *clones]
    P, first = map_.covariance(slots), 0 if channel.mount < 0 else len(map_.rows(channel.mount))
    own = max(first - 3, 0)
    places, S_x = np.empty((n, 2)), np.zeros((n, own + 2, len(P)))
    S_x[:, :own, 3:first] = np.eye(own)
    for i, slot in enumerate(clones):
        r, mount, _ = channel.split(channel.observer(map_, slot))
        T, T_r, T_s = sensor_pose(r, mount)
        places[i] = T[:2]
        S_x[i, own:, first + 3 * i : first + 3 * i + 3] = scan.estimator.pose_jacobian(map_, slot, T_r[:2])
        if channel.mount >= 0:
            S_x[i, own:, :3] = T_s[:2]
    X = S_x.reshape(n * (own + 2), -1)
    S = (X @ P @ X.T).reshape(n, own + 2, n, own + 2)
    y, variance = np.array([m.y[0] for m in kept]), np.array([m.R[0, 0] for m in kept])
    varies = np.array([_varies(scan, m) for m in kept])
    return RangeProblem(slots, S_x, S, places, (y, variance, varies), model_of(sensor, own > 0, bool(varies.any())))


def _is_determined(problem: RangeProblem, best: Fits, bent: bool) -> bool:
    """Return whether the likelihood about a minimum is that of a Gaussian."""
    return _flat(best, problem) and _gaussian(problem, best, best.information, bent)


def _flat(best: Fits, problem: RangeProblem) -> bool:
    """Return whether circles are as good as straight within a sigma of the position, as seen from the places.

    An error that all places have in common does not bend a circle: the position is taken relative to them, its errors
    those of the ranges and of the sensor's parameters alone.
    """
    own = problem.own
    H_w = best.H_w[:, :own]
    information = best.H.T @ np.linalg.solve(H_w @ problem.S[0, :own, 0, :own] @ H_w.T + np.diag(best.R), best.H)
    values = np.linalg.eigvalsh(information)
    if not np.isfinite(values).all() or values[0] <= 0:
        return False
    bulge = 0.5 / values[0] / np.hypot(*(best.l - problem.places).T)
    return bool(np.median(bulge * np.hypot(*best.H.T) / np.sqrt(best.R)) < BULGE)


def _gaussian(problem: RangeProblem, best: Fits, information: Array, bent: bool) -> bool:
    """Return whether the likelihood falls off at least as that of a Gaussian does.

    An unknown scale, and noise that grows with the range, make valleys that are `bent`: they leave the longest axis and
    are found beside it only.
    """
    values, vectors = np.linalg.eigh(information)
    angles = AROUND if bent else AROUND[[0, len(AROUND) // 2]]
    steps = OUT * np.column_stack([np.cos(angles), np.sin(angles)]) / np.sqrt(values)
    return bool((problem.fit(best.l + steps @ vectors.T).cost - best.cost > OUT**2 - SHAPE).all())
