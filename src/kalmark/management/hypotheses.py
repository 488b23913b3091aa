"""Landmarks from ranges alone, by polar hypotheses of the direction that a range does not tell.  [S] 2.3.5.

Each hypothesis is a block of the map: where the sensor was, the direction from there, the distance.  Until one position
is left none of them corrects anything else: a range corrects each hypothesis as if it were true (Schmidt's filter),
since to correct the pose by all of them would count the range several times, and by a wrong one would spoil it.

    F = 1 - K H on the hypothesis' rows,   Q = K (R + C) K',   C = (h'' P)^2 / 2

h'' is the second derivative in the direction, whose sigma of some 15 degrees a first order does not bear.  What was
predicted badly loses weight.  A pose error lasts from range to range, so that only the share of white noise in what the
pose and the range leave open counts as evidence.  docs/range_only.md.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from kalmark.errors import MapError, ModelError
from kalmark.events import Id, Scan
from kalmark.geometry.spaces import POINT2
from kalmark.models.landmarks import Polar2D
from kalmark.models.observe import composed, linearize
from kalmark.report import Observation

if TYPE_CHECKING:
    from kalmark.slam.slam import Slam
    from kalmark.tracks.scene import View

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]

POLAR = Polar2D.space
SPREAD = 0.5  # of the hypotheses' means, in units of their covariance: so much may be left of their being several
BULGE = 0.5  # how far the arc may leave its tangent within a sigma, in sigmas of the distance


@dataclass
class Ring:
    """The hypotheses left of one landmark, the logarithms of their weights, and how many ranges they have seen."""

    robot: str
    sensor: str
    slots: list[int]
    log_weights: Array
    seen: int = 1

    @property
    def weights(self) -> Array:
        """The weights, whose sum is 1."""
        w = np.exp(self.log_weights - self.log_weights.max())
        return np.asarray(w / w.sum())


def to_point(l: Array) -> tuple[Array, Array]:
    """Return the point p (2,) of a polar hypothesis (4,), and P_l (2, 4)."""
    u = np.array([math.cos(l[2]), math.sin(l[2])])
    return l[:2] + l[3] * u, np.array([[1.0, 0.0, -l[3] * u[1], u[0]], [0.0, 1.0, l[3] * u[0], u[1]]])


@dataclass(frozen=True)
class Hypotheses:
    """Start `count` hypotheses of the direction at the first range; a point when one position is left of them.

    A hypothesis whose share of the weights falls below `odds` is removed.
    """

    count: int = 12
    odds: float = 1e-3

    def __post_init__(self) -> None:
        if type(self.count) is not int or self.count < 3:
            raise ModelError(f"Hypotheses: count is {self.count!r}, expected a whole number of at least 3")
        if not 0 < self.odds < 1:
            raise ModelError(f"Hypotheses: odds is {self.odds!r}, expected a number between 0 and 1")

    def observe(self, slam: Slam, view: View, event: Scan, k: int, id_: Id | None, name: Id, R: Array) -> Observation:
        """Take a range of a landmark that is not in the map yet.  Raises MapError where no other block fits in."""
        unlocated = slam.members.unlocated
        ring = unlocated.get(name)
        if ring is None:
            if view.calibrated(slam.map).distances(event.y[k : k + 1])[0] <= 0:
                return Observation(k, id_, "ignored", None, None, "the range is no distance")
            unlocated[name] = Ring(
                event.robot, event.sensor, self._started(slam, view, event, k, R), np.zeros(self.count)
            )
            return Observation(k, id_, "tentative", None, None, f"{self.count} hypotheses of its direction")
        if not isinstance(ring, Ring) or (ring.robot, ring.sensor) != (event.robot, event.sensor):
            return Observation(k, id_, "ignored", None, None, "another sensor's ranges of it are being kept")
        robot = slam.members.slots[event.robot]
        gains = [_corrected(slam, view, robot, slot, event.y[k : k + 1], R) for slot in ring.slots]
        ring.log_weights, ring.seen = ring.log_weights + np.array(gains), ring.seen + 1
        self._prune(slam, ring)
        found = _point(slam, ring)
        if found is None:
            why = f"{len(ring.slots)} hypotheses of its direction"
            return Observation(k, id_, "tentative", None, None, why)
        slot = slam.map.augment(POINT2, *found)
        for old in ring.slots:
            slam.map.remove(old)
        del unlocated[name]
        slam.members.start(name, slot, view.landmark)
        slam.members.seen[name] = ring.seen
        return Observation(k, id_, "new", name, None, f"from {ring.seen} ranges")

    def _started(self, slam: Slam, view: View, event: Scan, k: int, R: Array) -> list[int]:
        """Add the hypotheses; return their slots."""
        map_, robot, size = slam.map, slam.members.slots[event.robot], len(view.at)
        sensor, y, slots = view.calibrated(map_), event.y[k : k + 1], []
        distance = float(sensor.distances(y)[0])
        Q = np.diag([0.0, 0.0, (math.pi / self.count) ** 2, R[0, 0] / sensor.scale**2])
        for j in range(self.count):
            head, index = view.head(map_, robot), view.head_index(map_, robot)
            T, T_r, T_s = composed(head[:size], head[size : 2 * size] if view.mount >= 0 else view.at)
            G = np.zeros((4, len(index)))
            G[:3, :3] = T_r
            if view.mount >= 0:
                G[:3, 3:6] = T_s
            if len(head) > 2 * size:  # distance = gain range - offset
                G[3, 6:] = y[0, 0], -1.0
            l = np.array([*T[:2], T[2] + 2 * math.pi * j / self.count, distance])
            try:
                slots.append(map_.augment(POLAR, l, index, slam.estimator.pose_jacobian(map_, robot, G), Q))
            except MapError:
                for slot in slots:
                    map_.remove(slot)
                raise
        return slots

    def _prune(self, slam: Slam, ring: Ring) -> None:
        """Remove the hypotheses that have lost their weight."""
        keep = ring.weights > self.odds
        for slot, good in zip(ring.slots, keep.tolist(), strict=True):
            if not good:
                slam.map.remove(slot)
        ring.slots = [slot for slot, good in zip(ring.slots, keep.tolist(), strict=True) if good]
        ring.log_weights = np.log(ring.weights[keep])


def _corrected(slam: Slam, view: View, robot: int, slot: int, y: Array, R: Array) -> float:
    """Correct one hypothesis alone by a range y (1, 1); return the logarithm of how well it predicted it."""
    map_, transports = slam.map, getattr(slam.estimator, "transports", False)
    index = np.concatenate([view.head_index(map_, robot), map_.index(slot)])
    index = np.concatenate([view.head_index(map_, robot), map_.index(slot)])  # both are active now
    l, h = map_.mean(slot), len(index) - 4
    blocks = [robot, view.mount, slot] if view.mount >= 0 else [robot, slot]
    S = map_.covariance(blocks)
    if len(S) > len(index):  # of the robot's state only the pose is seen
        rows = np.concatenate([np.arange(3), np.arange(len(S) - len(index) + 3, len(S))])
        S = S[np.ix_(rows, rows)]
    p, P_l = to_point(l)
    _, z, E_h, E_p = linearize(view.looks[view.landmark.kind].view, view.head(map_, robot), p[None], y)
    H = np.concatenate([slam.estimator.pose_jacobian(map_, robot, E_h[0]), E_p[0] @ P_l], axis=1)
    bent = _second_derivative(view, map_, robot, l, E_p[0, 0], P_l) * S[h + 2, h + 2]
    noise = R[0, 0] + 0.5 * bent**2
    Z, v = float((H @ S @ H.T)[0, 0]) + noise, z[0, 0] - 0.5 * bent
    K = (S @ H.T)[h:, 0] / Z
    moved = POLAR.plus(l, K * v)
    F, Q = np.eye(len(index)), np.zeros((len(index), len(index)))
    F[h:] -= np.outer(K, H[0])
    Q[h:, h:] = np.outer(K, K) * noise
    if transports:
        F[h:, 2:3] += POLAR.generator(moved) - POLAR.generator(l)
    given = S[:h, :h] - S[:h, h:] @ np.linalg.pinv(S[h:, h:], rcond=1e-10, hermitian=True) @ S[h:, :h]
    white = noise / (noise + max(0.0, float(H[0, :h] @ given @ H[0, :h])))
    map_.predict(index, F, Q)
    map_.set_predicted(slot, moved)
    return -0.5 * white * (v**2 / Z + math.log(Z))


def _second_derivative(view: View, map_: Any, robot: int, l: Array, E_p: Array, P_l: Array) -> float:
    """Return d^2 h / d alpha^2 of a range to a polar hypothesis."""
    t = view.pose(map_, robot)[:2] - l[:2]  # from where the hypothesis began to where the sensor is
    scale = float(np.hypot(*E_p))
    p = l[3] * np.array([math.cos(l[2]), math.sin(l[2])])
    distance = max(float(np.hypot(*(p - t))), 1e-9)
    slope = float(E_p @ P_l[:, 2]) / scale
    return scale * (float(t @ p) - slope**2) / distance


def _point(slam: Slam, ring: Ring) -> tuple[Array, Index, Array, Array] | None:
    """Return the one point that the hypotheses are, the rows it depends on, G and Q; None if they are several.

    Mean and covariance are those of the mixture, and the bulge of the arcs is added.
    """
    map_, w = slam.map, ring.weights
    means, covs = [map_.mean(slot) for slot in ring.slots], [map_.covariance([slot]) for slot in ring.slots]
    points = [to_point(l) for l in means]
    p = sum(a * q for a, (q, _) in zip(w, points, strict=True))
    P = sum(a * (J @ C @ J.T) for a, (_, J), C in zip(w, points, covs, strict=True))
    B = sum(a * np.outer(q - p, q - p) for a, (q, _) in zip(w, points, strict=True))
    if np.trace(np.linalg.solve(P, B)) > SPREAD:
        return None
    for a, l, C in zip(w, means, covs, strict=True):
        u, bulge = np.array([math.cos(l[2]), math.sin(l[2])]), 0.5 * l[3] * C[2, 2]
        if bulge > BULGE * math.sqrt(float(u @ P @ u)):
            return None
        B = B + a * 2 * bulge**2 * np.outer(u, u)
    for _ in range(2):  # to ask for a block may move those asked for before
        index = np.concatenate([map_.index(slot) for slot in ring.slots])
    G = np.concatenate([a * J for a, (_, J) in zip(w, points, strict=True)], axis=1)
    Q = P + B - G @ map_.covariance(ring.slots) @ G.T
    return np.asarray(p), index, G, 0.5 * (Q + Q.T)
