"""The type of landmark that a sensor starts by itself."""

from __future__ import annotations

from typing import Any

import numpy as np

from kalmark.models import landmarks as kinds
from kalmark.models.landmarks import InverseDepth2D, Point2D, Point3D, PointSignature2D, Polar2D, Tag
from kalmark.models.protocols import Landmark
from kalmark.models.sensors import RangeBearing
from kalmark.tracks.robot import Mount


def natural(mount: Mount) -> Landmark:
    """Return the type of landmark that a sensor starts if nobody says which.

    Homogeneous points go along with steps of the robot (`generator`), not with those of a mount: a mount's place that
    cannot be observed would seem to be.
    """
    if "size_m" in mount.sensor.columns or "qw" in mount.sensor.columns:
        return Tag()
    if len(mount.at) == 3:
        if not getattr(mount.sensor, "finds_depth", True) and mount.initialization is None:
            return InverseDepth2D()
        if "signature" in mount.sensor.columns:
            return PointSignature2D()
        return Polar2D() if _sees_arcs(mount.sensor) else Point2D()
    seen = getattr(mount.sensor, "sees_kinds", ("point3",))
    if "point3" not in seen:
        return kinds.AnchoredHomogeneousLine()
    if getattr(mount.sensor, "finds_depth", True):
        return Point3D()
    return kinds.Homogeneous() if mount.cov is None else kinds.AnchoredHomogeneous()


def _sees_arcs(sensor: Any) -> bool:
    """Return whether the arc of a bearing's sigma leaves its tangent by half a sigma of the range, far away."""
    if not isinstance(sensor, RangeBearing) or np.isinf(sensor.range_max_m):
        return False
    d = sensor.range_max_m
    return bool(d * sensor.sigma_bearing_rad**2 > np.sqrt(sensor.range_variance(np.array([[d]]))[0]))
