"""Landmarks from ranges alone, by polar hypotheses of the direction that a range does not determine.  [S] 2.3.5.

Each hypothesis is a block of the map: the place of the sensor, the direction from there, the distance.  Until one
position is left none of them corrects anything else: a range corrects each hypothesis as if it were true (Schmidt's
filter), since to correct the pose by all of them would count the range several times, and by a wrong one would falsify
it.

    F = 1 - K H on the hypothesis' rows,   Q = K (R + C) K',   C = (h'' P)^2 / 2

h'' is the second derivative in the direction, whose sigma of some 15 degrees a first order does not bear.  A hypothesis
with a bad prediction loses weight.  A pose error lasts from range to range, so that only the share of white noise in
what the pose and the range leave open counts as evidence.  docs/range_only.md.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Annotated

import numpy as np

from kalmark.arrays import Array
from kalmark.declare import Probability, Within, register
from kalmark.geometry.gaussian import normalized_weights
from kalmark.geometry.spaces import POINT2
from kalmark.management.pending import OTHERS, HypothesisCorrection, Step
from kalmark.models.landmarks import Polar2D
from kalmark.models.observe import linearize
from kalmark.tracks.scan import ScanContext, Start
from kalmark.tracks.track import Pending

POLAR = Polar2D.space
SPREAD = 0.5  # of the hypotheses' means, in units of their covariance: so much may be left of their being several
BULGE = 0.5  # how far the arc may leave its tangent within a sigma, in sigmas of the distance


def to_point(l: Array) -> tuple[Array, Array]:
    """Return the point p (2,) of a polar hypothesis (4,), and P_l (2, 4)."""
    u = np.array([math.cos(l[2]), math.sin(l[2])])
    return l[:2] + l[3] * u, np.array([[1.0, 0.0, -l[3] * u[1], u[0]], [0.0, 1.0, l[3] * u[0], u[1]]])


@register("initialization", "hypotheses")
class Hypotheses:
    """Start hypotheses of the direction at the first range, and weigh them: docs/range_only.md.

    A point follows when one position is left of them.  A hypothesis whose share of the weights falls below `odds` is
    removed.

    >>> beacon = km.Mount(km.sensors.Range(), initialization=km.initialization.Hypotheses(count=8))
    >>> slam = km.Slam(km.Robot("rover", km.motion.Unicycle(), sensors={"radio": beacon}))
    >>> slam.process(km.Scan(0.0, "rover", "radio", [[4.0]], ids=[7])).observations[0].outcome
    'tentative'
    """

    count: Annotated[int, Within(ge=3), "Hypotheses of the direction."] = 12
    odds: Annotated[Probability, "A hypothesis is removed when its share of the weights falls below this."] = 1e-3

    def observe(self, scan: ScanContext, k: int, pending: Pending) -> Step:
        """Start the hypotheses, or correct each of them alone."""
        if pending.channel != scan.key:
            return Step("ignored", OTHERS)
        if pending.hypotheses:
            found = [_corrected(scan, slot, k) for slot in pending.hypotheses]
            w = tuple(w + gain for w, (_, gain) in zip(pending.log_weights, found, strict=True))
            known = replace(pending, log_weights=w, used=pending.used + 1)
            return Step("tentative", "", known, corrections=tuple(correction for correction, _ in found))
        if scan.channel.calibrated(scan.map).distances(scan.y[k : k + 1])[0] <= 0:
            return Step("ignored", "the range is no distance")
        known = replace(pending, log_weights=(0.0,) * self.count, used=1)
        return Step("tentative", "", known, added=tuple(self._starts(scan, k)))

    def solve(self, scan: ScanContext, pending: Pending) -> Step:
        """Remove the unlikely hypotheses; start the landmark if one position is left of them."""
        if pending.used == 1:
            return Step("tentative", f"{self.count} hypotheses of its direction")
        w = normalized_weights(np.array(pending.log_weights))
        keep = w > self.odds
        left = tuple(slot for slot, good in zip(pending.hypotheses, keep.tolist(), strict=True) if good)
        removed = tuple(slot for slot in pending.hypotheses if slot not in left)
        known = replace(pending, hypotheses=left, log_weights=tuple(np.log(w[keep]).tolist()))
        start = _point(scan, known)
        if start is None:
            return Step("tentative", f"{len(left)} hypotheses of its direction", known, removed=removed)
        why, gone = f"from {pending.used} ranges", removed + left
        return Step("new", why, removed=gone, start=start, measurements=pending.used)

    def _starts(self, scan: ScanContext, k: int) -> list[Start]:
        """Return the hypotheses as blocks, evenly spread over all directions."""
        channel, y = scan.channel, scan.y[k : k + 1]
        observer, sensor = channel.observer(scan.map, scan.robot), channel.calibrated(scan.map)
        distance = float(sensor.distances(y)[0])
        Q = np.diag([0.0, 0.0, (math.pi / self.count) ** 2, scan.R[k, 0, 0] / sensor.scale**2])
        T, T_r, T_s = channel.composed(scan.map, scan.robot)
        parts = channel.parts(scan.map, scan.robot)
        G = np.zeros((4, sum(count for _, count in parts)))
        G[:3, :3] = T_r
        if channel.mount >= 0:
            G[:3, 3:6] = T_s
        if len(channel.split(observer)[2]):  # distance = gain range - offset
            G[3, 6:] = y[0, 0], -1.0
        G = scan.estimator.pose_jacobian(scan.map, scan.robot, G)
        turns = T[2] + 2 * math.pi * np.arange(self.count) / self.count
        return [Start(POLAR, np.array([*T[:2], turn, distance]), parts, G, Q) for turn in turns.tolist()]


def _corrected(scan: ScanContext, slot: int, k: int) -> tuple[HypothesisCorrection, float]:
    """Return the correction of one hypothesis alone by a range, and the logarithm of its likelihood."""
    map_, channel, robot = scan.map, scan.channel, scan.robot
    parts = (*channel.parts(map_, robot), (slot, 4))
    l, h = map_.mean(slot), sum(count for _, count in parts[:-1])
    blocks = [robot, channel.mount, slot] if channel.mount >= 0 else [robot, slot]
    S = map_.covariance(blocks)
    if len(S) > h + 4:  # of the robot's state only the pose is observed
        rows = np.concatenate([np.arange(3), np.arange(len(S) - h - 1, len(S))])
        S = S[np.ix_(rows, rows)]
    p, P_l = to_point(l)
    model = channel.models[channel.landmark.kind].model
    _, z, E_h, E_p = linearize(model, channel.observer(map_, robot), p[None], scan.y[k : k + 1])
    H = np.concatenate([scan.estimator.pose_jacobian(map_, robot, E_h[0]), E_p[0] @ P_l], axis=1)
    bent = _second_derivative(scan.pose(), l, E_p[0, 0], P_l) * S[h + 2, h + 2]
    noise = scan.R[k, 0, 0] + 0.5 * bent**2
    Z, v = float((H @ S @ H.T)[0, 0]) + noise, z[0, 0] - 0.5 * bent
    K = (S @ H.T)[h:, 0] / Z
    moved = POLAR.plus(l, K * v)
    F, Q = np.eye(h + 4), np.zeros((h + 4, h + 4))
    F[h:] -= np.outer(K, H[0])
    Q[h:, h:] = np.outer(K, K) * noise
    if scan.estimator.coordinates == "log":  # the correction turns the coordinates of errors
        F[h:, 2:3] += POLAR.generator(moved) - POLAR.generator(l)
    given = S[:h, :h] - S[:h, h:] @ np.linalg.pinv(S[h:, h:], rcond=1e-10, hermitian=True) @ S[h:, :h]
    white = noise / (noise + max(0.0, float(H[0, :h] @ given @ H[0, :h])))
    return HypothesisCorrection(slot, parts, F, Q, moved), -0.5 * white * (v**2 / Z + math.log(Z))


def _second_derivative(T: Array, l: Array, E_p: Array, P_l: Array) -> float:
    """Return d^2 h / d alpha^2 of a range from the pose T to a polar hypothesis l (4,)."""
    t = T[:2] - l[:2]  # from where the hypothesis began to where the sensor is
    scale = float(np.hypot(*E_p))
    p = l[3] * np.array([math.cos(l[2]), math.sin(l[2])])
    distance = max(float(np.hypot(*(p - t))), 1e-9)
    slope = float(E_p @ P_l[:, 2]) / scale
    return scale * (float(t @ p) - slope**2) / distance


def _point(scan: ScanContext, pending: Pending) -> Start | None:
    """Return the one point that the hypotheses are; None if they are several.

    Mean and covariance are those of the mixture, and the bulge of the arcs is added.
    """
    slots, w = pending.hypotheses, normalized_weights(np.array(pending.log_weights))
    l, S, own = np.array([scan.map.mean(slot) for slot in slots]), scan.map.covariance(slots), np.arange(len(slots))
    C, points = S.reshape(len(slots), 4, len(slots), 4)[own, :, own], [*map(to_point, l)]
    q, J = (np.array(each) for each in zip(*points, strict=True))
    p, off = w @ q, q - w @ q
    P, B = np.einsum("k,kij->ij", w, J @ C @ J.swapaxes(1, 2)), (w * off.T) @ off
    if np.trace(np.linalg.solve(P, B)) > SPREAD:
        return None
    u, bulge = J[:, :, 3], 0.5 * l[:, 3] * C[:, 2, 2]  # across the arc
    if (bulge > BULGE * np.sqrt(((u @ P) * u).sum(axis=1))).any():
        return None
    G = np.concatenate(w[:, None, None] * J, axis=1)
    Q = P + B + (2 * w * bulge**2 * u.T) @ u - G @ S @ G.T
    return Start(POINT2, p, tuple((slot, 4) for slot in slots), G, 0.5 * (Q + Q.T))
