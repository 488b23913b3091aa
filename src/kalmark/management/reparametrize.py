"""Reparametrisation of a landmark that is better known: a Euclidean point, a longer segment.  [TB] 4.4; Civera 2008."""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np

from kalmark.arrays import Array
from kalmark.geometry.frames3d import to_frame_many
from kalmark.models.cameras import project_pinhole
from kalmark.models.landmarks import Point2D, Point3D, PointHeight2D
from kalmark.models.lines import crossing_angles, extend_segments
from kalmark.models.protocols import Landmark, Reparametrizable, Segmented, UnknownDepth
from kalmark.tracks.scan import ScanContext, Start
from kalmark.tracks.track import Track

NO_LENS = np.zeros(0)
POINTS: dict[str, Landmark] = {"plane": Point2D(), "space": Point3D()}


@runtime_checkable
class _PriorDirection(Protocol):
    """A line whose direction in the plane of sight began as a prior: only pixels determine the accuracy of its ends."""

    prior_beta_1: float
    switch_px: float


class Simplified(NamedTuple):
    """The Euclidean point that a landmark becomes, and its block."""

    model: Landmark
    start: Start


def surveyed_type(model: Landmark, mean: Any) -> Landmark:
    """Return the type of a landmark known beforehand: a point, also where a sensor would start one of unknown depth.

    In the plane one with three numbers has a height.
    """
    if model.space.world == "plane" and np.size(mean) == 3 != model.space.size:
        return PointHeight2D()
    if not isinstance(model, UnknownDepth) or np.size(mean) == model.space.size:
        return model
    return POINTS[model.space.world]


def point_if_linear(scan: ScanContext, track: Track, threshold: float) -> Simplified | None:
    """Return the point that a landmark becomes if its linearity index is below the threshold: P_pp = P_l P_ll P_l'."""
    model, map_ = track.model, scan.map
    if not isinstance(model, Reparametrizable):
        return None
    l = map_.mean(track.slot)[None]
    sigmas = np.sqrt(np.maximum(np.diag(map_.covariance([track.slot])), 0.0))[None]
    if not (l[0, -1] > 0 and model.linearity(scan.pose(), l, sigmas)[0] < threshold):
        return None
    p, P_l = model.to_point(l)
    n, point = len(p[0]), Point2D() if len(p[0]) == 2 else Point3D()
    return Simplified(point, Start(point.space, p[0], ((track.slot, P_l.shape[2]),), P_l[0], np.zeros((n, n))))


def extent(scan: ScanContext, track: Track, y: Array) -> Array:
    """Return the abscissas (2,) of the segment known of a line after the observation y (4,) of it.  [TB] extPolicy."""
    sensor, line, t = scan.channel.sensor, track.model, track.extent
    assert isinstance(line, Segmented) and t is not None
    T, l, P = scan.pose(), scan.map.mean(track.slot)[None], scan.map.covariance([track.slot])
    rays, ends = sensor.invert(y[None])[0], t[None]
    p, P_l = line.endpoints(l, ends)
    measured = line.abscissas(T, l, rays)
    if isinstance(line, _PriorDirection):
        worst = np.array([max(_sigma_px(sensor, T, p[0, i], P_l[0, i] @ P @ P_l[0, i].T) for i in range(2))])
        return extend_segments(ends, measured, sigma_px=worst, switch_px=line.switch_px)[0]
    return extend_segments(ends, measured, angles=crossing_angles(T, p, rays))[0]


def _sigma_px(sensor: Any, T: Array, p: Array, P: Array) -> float:
    """Return the largest sigma in the image of a sensor at T of the point p (3,) with covariance P; inf behind it."""
    v, _, V_p = to_frame_many(T, p[None])
    if v[0, 2] <= 0:
        return float("inf")
    E = project_pinhole(v, sensor.parameters, NO_LENS)[1][0] @ V_p[0]
    return float(np.sqrt(np.linalg.eigvalsh(E @ P @ E.T)[-1]))
