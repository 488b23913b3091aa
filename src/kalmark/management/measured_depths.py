"""Landmarks of unknown depth whose distance another sensor measures.

A range is not linear in an inverse distance that is uncertain by its own size: from a prior of one, a step towards the
range passes zero.  The inverse of the range is linear in it.  So where range and expectation are far apart, the map is
first corrected by inverse ranges, of a hundredth of their information; the ranges themselves follow.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kalmark.arrays import Array, Index
from kalmark.filter.estimators import Update
from kalmark.models.landmark_views import residual
from kalmark.models.landmarks import AsPoint
from kalmark.models.observe import PythonView
from kalmark.tracks.channel import ObservationModel
from kalmark.tracks.scan import ScanContext

FAR, SIGMAS = 0.1, 3.0  # relative difference of distances, and by how many sigmas, beyond which one is far
SHARE = 100.0  # inverse ranges have a hundredth of their information: enough to relinearise, and the ranges count again
SCALES = np.geomspace(1e-2, 1e2, 81)  # of the expected distance, among which the measured one is searched
TINY = 1e-12  # information below which a measurement does not determine a distance
STEPS = 5  # of Gauss-Newton from the best of them


@dataclass(frozen=True)
class InverseRange:
    """The observation model of inverse distances, negative where the estimate of a landmark is: in front it is not.

    `E_p` (K, 1, p): what they change by with the parameters of the sensor in the map, if it has any.
    """

    landmark: AsPoint
    mount: Array
    E_p: Array

    def linearize(self, head: Array, l: Array, y: Array) -> tuple[Array, Array, Array, Array]:
        """Return e (K, 1), z = y - e, E_h (K, 1, h) and E_l (K, 1, n) of landmarks l (K, n), whose last is rho."""
        view, pose = PythonView(Inverse(), self.landmark, self.mount, np.zeros(1, dtype=np.bool_)), 2 * len(self.mount)
        sign = np.where(l[:, -1] < 0, -1.0, 1.0)[:, None]
        e, _, E_h, E_l = view.linearize(head[:pose], l, y)
        E_h = np.concatenate([sign[:, None] * E_h, self.E_p], axis=2)
        return sign * e, y - sign * e, E_h, sign[:, None] * E_l


class Inverse:
    """A sensor of the inverse distance of a point."""

    angular = (False,)
    columns = ("inverse_range_per_m",)

    def expect(self, v: Array) -> tuple[Array, Array]:
        """Return 1 / |v| (K, 1) of points v (K, d), and E_v (K, 1, d)."""
        distance = np.linalg.norm(v, axis=1)
        return 1.0 / distance[:, None], -(v / distance[:, None] ** 3)[:, None]

    def noise(self, y: Array) -> Array:
        """Return the noise (K, 1, 1) of inverse distances known exactly: every measurement comes with its own."""
        return np.zeros((len(y), 1, 1))


def correct_by_inverse_ranges(
    scan: ScanContext, model: ObservationModel, slots: Index, rows: list[int]
) -> Update | None:
    """Return the correction by the inverse ranges of the observations `rows` that are far; None if none is.

    `slots` (K,) are the blocks of their landmarks.
    """
    if not isinstance(model.landmark, AsPoint):
        return None
    l = scan.map.means(slots, model.d)
    behind = l[:, -1] < 0
    l[:, -1] = np.abs(l[:, -1])
    v = model.landmark.seen_from(scan.pose(), l)[0]
    log_scale, variance, by = _scales(scan, v, scan.y[rows], scan.noise(model, slots, rows))
    P = scan.map.covariance([scan.channel.mount])[scan.channel.pose_dof :, scan.channel.pose_dof :] if by.size else None
    open_ = variance if P is None else variance + np.einsum("kp,pq,kq->k", by, P, by)
    far = np.flatnonzero(behind | ((np.abs(log_scale) > FAR) & (log_scale**2 > SIGMAS**2 * open_)))
    if not len(far):
        return None
    inverse = np.exp(-log_scale[far, None]) / np.linalg.norm(v[far], axis=1)[:, None]
    R_far = SHARE * (variance[far, None] * inverse**2)[:, None]
    view = InverseRange(model.landmark, scan.channel.at, (inverse * by[far])[:, None])
    return Update(view, scan.robot, scan.channel.mount, slots[far], model.d, inverse, R_far, scan.channel.gate, False)


def _scales(scan: ScanContext, v: Array, y: Array, R: Array) -> tuple[Array, Array, Array]:
    """Return by what factor points v (K, d) are farther for measurements y (K, m) with the noise R (K, m, m).

    The logarithms (K,) of the likeliest factors, their variances (K,), and what they change by with the sensor's
    parameters in the map (K, p).
    """
    sensor, W = scan.channel.calibrated(scan.map), np.linalg.inv(R)
    angular, d = np.array(sensor.angular, dtype=np.bool_), v.shape[1]
    velocity = np.tile(scan.channel.velocity(scan.map, scan.robot), (len(v), 1))  # of a sensor that measures it

    def compared(scales: Array) -> tuple[Array, Array]:
        """Return innovations z (K, m) and their derivatives (K, m) in the logarithms of the scales (K,)."""
        far = scales[:, None] * v
        e, E_v = sensor.expect(np.concatenate([far, velocity], axis=1))
        return residual(y, e, angular), -np.einsum("kmd,kd->km", E_v[:, :, :d], far)

    costs = []
    for scale in SCALES:
        z, _ = compared(np.full(len(v), scale))
        costs.append(np.einsum("km,kmn,kn->k", z, W, z))
    best = np.log(SCALES[np.argmin(costs, axis=0)])
    for _ in range(STEPS):
        z, Z_s = compared(np.exp(best))
        information = np.einsum("km,kmn,kn->k", Z_s, W, Z_s)
        best = best - np.einsum("km,kmn,kn->k", Z_s, W, z) / np.maximum(information, TINY)
    variance = 1.0 / np.maximum(information, TINY)
    if sensor is scan.channel.sensor:
        return best, variance, np.zeros((len(v), 0))
    E_p = sensor.parameters_jacobian(np.exp(best)[:, None] * v)
    return best, variance, variance[:, None] * np.einsum("km,kmn,knp->kp", Z_s, W, E_p)
