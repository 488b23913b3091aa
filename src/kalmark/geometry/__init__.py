"""Geometry of the plane and of space with Jacobians, spaces of the map's blocks, and Gaussians."""

from kalmark.geometry import directions, frames3d, rotations
from kalmark.geometry.angles import V, V_inverse, rotation, wrap
from kalmark.geometry.frames import compose, from_frame, inv_observe, inv_scan, inverse, move, observe, scan, to_frame
from kalmark.geometry.gaussian import (
    bhattacharyya,
    compound,
    ellipse,
    gate,
    intersection,
    mahalanobis,
    merge,
    relative_frame,
    sigma_probability,
    sigma_table,
)
from kalmark.geometry.spaces import POINT2, POINT3, SE2, SE3, Rn, Space

__all__ = [
    "POINT2",
    "POINT3",
    "SE2",
    "SE3",
    "Rn",
    "Space",
    "V",
    "V_inverse",
    "bhattacharyya",
    "compose",
    "compound",
    "directions",
    "ellipse",
    "frames3d",
    "from_frame",
    "gate",
    "intersection",
    "inv_observe",
    "inv_scan",
    "inverse",
    "mahalanobis",
    "merge",
    "move",
    "observe",
    "relative_frame",
    "rotation",
    "rotations",
    "scan",
    "sigma_probability",
    "sigma_table",
    "to_frame",
    "wrap",
]  # fmt: skip
