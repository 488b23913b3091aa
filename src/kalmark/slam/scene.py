"""A sensor on its mount as the filter sees it, and what an association may ask about one of its scans."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from kalmark.errors import ModelError
from kalmark.filter.corrections import innovation, observed_block, residual
from kalmark.filter.map import X_AT, StochasticMap
from kalmark.models.landmarks import Point2D, Point3D, PointSignature2D
from kalmark.models.observe import composed, inverse_expectation, linearize, view_of
from kalmark.models.protocols import FullSensor, Landmark, NonAdditiveSensor
from kalmark.slam.events import Id, Scan
from kalmark.slam.robot import Mount

if TYPE_CHECKING:
    from kalmark.slam.slam import Slam

Array = npt.NDArray[np.float64]

NOTHING = np.zeros((0, 0, 0))


ROBOT = "robot"
SEEN_AS = {
    "point": ("point", "point_signature", ROBOT),
    "point3": ("point3", ROBOT),
}  # kinds of blocks that a view of one kind applies to


class View:
    """A mounted sensor with its landmark type and gate, ready for the kernels."""

    def __init__(self, mount: Mount, landmarks: Landmark | None, slam: Slam) -> None:
        self.sensor = mount.sensor
        self.at: Array = np.array(mount.at)  # writable, like all else: numba compiles per kind of array
        self.landmark: Landmark = mount.landmark or landmarks or _natural(mount)
        slam.refuse_other_world(type(self.sensor).__name__, getattr(self.sensor, "world", ""))
        slam.refuse_other_world(self.landmark.kind, self.landmark.space.world)
        self.look = view_of(self.sensor, self.landmark, self.at)
        self.d = self.landmark.space.size
        self.angular = np.array(self.sensor.angular, dtype=np.bool_)
        self.gate = slam.association.threshold(len(self.angular), slam.estimator.default_gate)
        self.starts = isinstance(self.sensor, FullSensor)
        varies = isinstance(self.sensor, NonAdditiveSensor) and not self.sensor.additive
        self.noise_at = self.sensor.noise_at if varies else None  # type: ignore[attr-defined]
        self.sees = SEEN_AS.get(self.landmark.kind, (self.landmark.kind,))
        numbers = 3 if len(self.at) == 7 or "signature" in self.sensor.columns else 2
        if isinstance(self.look, tuple) and numbers != self.d:
            raise ModelError(
                f"a {type(self.sensor).__name__} finds {numbers} numbers, a {self.landmark.kind} has {self.d}"
            )

    def noise(
        self, map_: StochasticMap, robot: int, slots: npt.NDArray[np.int64], R: Array, event: Scan
    ) -> Array:  # fmt: skip
        """Return the noise of observations of the blocks `slots`: R, unless it depends on where they are  [F]."""
        if self.noise_at is None or event.cov is not None:
            return R
        T, _, _ = composed(map_.mean(robot)[: len(self.at)], self.at)
        l = map_.x[map_.blocks[slots, X_AT][:, None] + np.arange(self.d)]
        return self.noise_at(self.landmark.seen_from(T, l)[0])

    def explain(self, r: Array, y: Array, R: Array, event: Scan) -> tuple[Array, Array, Array]:
        """Return the landmark (n,) that explains y (1, m) from r, L_r (n, 3) and Q = L_y R L_y'.  [S] (32)-(35)."""
        l, L_r, _, L_y = inverse_expectation(r, self.at, self.sensor, self.landmark, y)  # type: ignore[arg-type]
        if self.noise_at is not None and event.cov is None:
            R = self.noise_at(self.sensor.invert(y)[0])[0]  # type: ignore[attr-defined]
        return l[0], L_r[0], L_y[0] @ R @ L_y[0].T


def _natural(mount: Mount) -> Landmark:
    if len(mount.at) == 7:
        return Point3D()
    return PointSignature2D() if "signature" in mount.sensor.columns else Point2D()


class Scene:
    """One scan before it is fused: the association's window on the map."""

    def __init__(self, slam: Slam, view: View, event: Scan, ids: tuple[Id | None, ...], R: Array) -> None:
        self.ids = ids
        self._slam, self._view, self._event, self._R = slam, view, event, R

    def dof(self) -> int:
        """Return the size m of one measurement."""
        return len(self._view.angular)

    def candidates(self) -> list[Id]:
        """Return the ids of the landmarks this sensor could have seen."""
        return self._slam.landmark_ids(self._view.landmark)

    def distances(self, candidates: list[Id]) -> Array:
        """Return the squared Mahalanobis distances (K, L) of the observations from the candidates.  [S] (83)."""
        map_, view = self._slam.map, self._view
        robot = self._slam.slot(self._event.robot)
        slots = np.array([self._slam.slot(name) for name in candidates])
        pose = len(view.at)
        index, _, mean = observed_block(map_.x, map_.blocks, map_.atoms, robot, slots, view.d)
        e, E_r, E_l = linearize(view.look, mean[:pose], mean[pose:].reshape(len(slots), view.d))
        d2 = np.empty((len(self._event.y), len(slots)))
        there = view.noise(map_, robot, slots, NOTHING, self._event)
        for k, y in enumerate(self._event.y):
            z = residual(np.broadcast_to(y, e.shape).copy(), e, view.angular)
            R = np.tile(self._R[k], (len(slots), 1, 1)) if there is NOTHING else there
            _, d2[k], _ = innovation(map_.P, index, E_r, E_l, R, z)
        return d2
