"""Rays that are started again where they are seen: in place of a correction that would take a depth from noise.

A ray is seen along v = h - rho t, t the way from its anchor to the sensor.

*Straight ahead or behind* v, h and t are parallel, and no measurement determines rho.  The estimate of v is off by
noise, and at that estimate the Jacobian finds a depth, in each scan a little more.  So a ray is started again where
rho, with what the measurement adds beyond such noise, still leaves the length of v open: there no linearisation holds.

*A way beyond the nearest landmark of the prior* bends a first correction as much: from a boat that moves by 4 m between
two bearings a landmark that is expected at 2 m, and stands at 300, is seen in another direction altogether.

*A mount in the map* whose camera turns about its robot has its lever arm in t.  While rho is open, too, images measure
the product of two unknowns: their likelihood of the mount then is far from Gaussian, with its rotation it can have two
maxima, and no later image repairs a correction towards the wrong one.  docs/bearing_only.md.
"""

from __future__ import annotations

import numpy as np

from kalmark.arrays import Array, Flags, Index
from kalmark.geometry.rotations import skew
from kalmark.models.landmarks import AnchoredHomogeneous
from kalmark.models.observe import linearize
from kalmark.models.protocols import Reparametrizable
from kalmark.tracks import linearity
from kalmark.tracks.channel import ObservationModel
from kalmark.tracks.scan import ScanContext

SHARE = 0.05  # of the way from its anchor that a mount may leave open


def bent_rays(scan: ScanContext, model: ObservationModel, slots: Index, rows: list[int]) -> tuple[Flags, Array]:
    """Return which observations `rows` (K,), of the blocks `slots`, are of rays along which no linearisation holds.

    With what they add to it, sigma of rho still lets the length of v = h - rho t change by more than a `SHARE`.  They
    add |R^-1/2 E_rho|^2, less what E_rho would be of a ray in the direction of t that is off by their noise, |t| / |v|.
    With them come the ways |t| (K,) of those that sigma of rho moves by more than |h|, 0 of others.
    """
    if not isinstance(model.landmark, Reparametrizable):
        return np.zeros(len(rows), dtype=np.bool_), np.zeros(len(rows))
    map_, d = scan.map, scan.dimensions
    l = map_.means(slots, model.d)
    v, _, V_l = model.landmark.seen_from(scan.pose(), l)
    v, t = v[:, :d], V_l[:, :d, -1]
    along = np.maximum(np.abs(np.sum(v * t, axis=1)), 1e-300)
    least = linearity.SHARE * np.sum(v * v, axis=1) / (linearity.SIGMAS * along)
    dof = model.landmark.space.dof
    variance = map_.covariance(slots.tolist()).diagonal()[dof - 1 :: dof]
    found: Flags = variance > least**2
    if found.any():
        E_rho = linearize(model.model, scan.channel.head(map_, scan.robot), l, scan.y[rows])[3][:, :, -1]
        R_E = np.linalg.solve(scan.noise(model, slots, rows), E_rho[..., None])[..., 0]
        by_noise = linearity.SIGMAS * np.linalg.norm(t, axis=1) / np.linalg.norm(v, axis=1)
        added = np.maximum(np.sqrt(np.sum(E_rho * R_E, axis=1)) - by_noise, 0.0) ** 2
        found = variance > least**2 * (1.0 + variance * added)
    way, h = np.linalg.norm(t, axis=1), np.linalg.norm(v - l[:, -1:] * t, axis=1)
    return found, np.where(linearity.SIGMAS * np.sqrt(variance) * way > h, way, 0.0)


def rays_without_baseline(scan: ScanContext, model: ObservationModel, slots: Index, rows: list[int]) -> Flags:
    """Return which observations `rows` (K,), of the blocks `slots`, are of rays whose way t the mount leaves open.

    With C = P_tm P_mm^-1 P_mt, what the position m of the mount leaves open of t: that moves the ray by more than the
    noise, Var(rho) tr(R^-1 E_h C E_h') > 1, and is more than a share of the way, tr C > SHARE^2 |t|^2.
    """
    if not isinstance(model.landmark, AnchoredHomogeneous):
        return np.zeros(len(rows), dtype=np.bool_)
    channel, map_, found = scan.channel, scan.map, np.zeros(len(rows), dtype=np.bool_)
    T, T_r, T_s = channel.composed(map_, scan.robot)
    l, R = map_.means(slots, model.d), scan.noise(model, slots, rows)
    E_h = linearize(model.model, channel.head(map_, scan.robot), l, scan.y[rows])[3][:, :, 3:6]
    W = E_h.transpose(0, 2, 1) @ np.linalg.solve(R, E_h)  # E_h' R^-1 E_h
    P_m = map_.covariance([channel.mount])[:3, :3]
    most = 4.0 * np.trace(P_m) * np.trace(W, axis1=1, axis2=2)  # two places of the camera, each moved by m
    robot, mount = len(map_.rows(scan.robot)), len(map_.rows(channel.mount))
    for i, slot in enumerate(slots.tolist()):
        variance = map_.covariance([slot])[-1, -1]
        if variance * most[i] < 1.0:
            continue
        t = T[:3] - l[i, :3]
        P = map_.covariance([channel.mount, scan.robot, slot])
        D = np.zeros((3, len(P)))  # t, but for the turn that all of the map has in common
        D[:, :3], D[:, 3:6] = T_s[:3, :3], skew(t) @ T_s[3:, 3:]
        D[:, mount : mount + 6] = T_r[:3] + np.hstack([np.zeros((3, 3)), skew(t)])
        D[:, mount + robot : mount + robot + 3] = -np.eye(3)
        P_tm = D @ P[:, :3]
        C = P_tm @ np.linalg.pinv(P_m, hermitian=True) @ P_tm.T
        found[i] = variance * np.sum(W[i] * C) > 1.0 and np.trace(C) > SHARE**2 * (t @ t)
    return found
