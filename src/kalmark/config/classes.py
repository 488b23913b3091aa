"""Which class a section of a configuration describes, and the numbers of its poses."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from kalmark import association
from kalmark.config.mounting import PlanePose, SpacePose, SpaceStartConfig
from kalmark.config.sections import Section
from kalmark.detect import corners, reflectors, trunks
from kalmark.filter import estimators
from kalmark.geometry.rotations import from_euler
from kalmark.management import initialization
from kalmark.management.delayed import Delayed
from kalmark.models import landmarks, motion, sensors

Array = npt.NDArray[np.float64]

CLASSES: dict[str, Callable[..., Any]] = {
    "unicycle": motion.Unicycle,
    "odometry_2d": motion.Odometry2D,
    "ackermann": motion.Ackermann,
    "odometry_3d": motion.Odometry3D,
    "velocity_3d": motion.Velocity3D,
    "constant_velocity_3d": motion.ConstantVelocity3D,
    "range_bearing": sensors.RangeBearing,
    "bearing": sensors.Bearing,
    "range": sensors.Range,
    "position": sensors.Position2D,
    "range_bearing_signature": sensors.RangeBearingSignature,
    "range_bearing_3d": sensors.RangeBearing3D,
    "position_3d": sensors.Position3D,
    "pinhole": sensors.PinHole,
    "omnidirectional": sensors.Omnidirectional,
    "stereo": sensors.Stereo,
    "segments": sensors.Segments,
    "tag_pose": sensors.TagPose,
    "tag_corners": sensors.TagCorners,
    "point": landmarks.Point2D,
    "point_signature": landmarks.PointSignature2D,
    "polar": landmarks.Polar2D,
    "inverse_depth": landmarks.InverseDepth2D,
    "anchored_homogeneous": landmarks.AnchoredHomogeneous,
    "homogeneous": landmarks.Homogeneous,
    "tag": landmarks.Tag,
    "pluecker_line": landmarks.PlueckerLine,
    "anchored_pluecker_line": landmarks.AnchoredPlueckerLine,
    "inverse_depth_line": landmarks.InverseDepthLine,
    "anchored_homogeneous_line": landmarks.AnchoredHomogeneousLine,
    "homogeneous_line": landmarks.HomogeneousLine,
    "delayed": Delayed,
    "identity": association.ByIdentity,
    "nearest": association.NearestNeighbour,
    "global": association.GlobalAssignment,
    "jcbb": association.JointCompatibility,
    "trunks": trunks.Trunks,
    "reflectors": reflectors.Reflectors,
    "corners": corners.Corners,
    "clique": association.Cliques,
    "sample": association.Sampled,
    "jpda": association.Averaged,
    "auto": association.Automatic,
    "trilateration": initialization.Trilateration,
    "hypotheses": initialization.Hypotheses,
    "ekf": estimators.Ekf,
    "invariant": estimators.Invariant,
    "fej": estimators.Fej,
}
IN_SPACE: dict[str, Callable[..., Any]] = {"point": landmarks.Point3D, "inverse_depth": landmarks.InverseDepth3D}
MOUNTED = frozenset({"mount", "landmark", "association", "attention", "upkeep", "initialization", "preset", "detector"})


def model_of(section: Section, world: str = "plane") -> Any:
    """Return the model that a section describes, of the plane or of space where its type leaves that open.

    Raises ModelError if the model refuses its parameters.
    """
    keys = {key: value for key, value in section.model_dump(exclude=set(MOUNTED)).items() if value is not None}
    kind = keys.pop("type")
    return (IN_SPACE.get(kind, CLASSES[kind]) if world == "space" else CLASSES[kind])(**keys)


def pose_of(section: PlanePose | SpacePose) -> Array:
    """Return the pose that a mount or a start describes: (3,) in the plane, (7,) in space."""
    if isinstance(section, PlanePose):
        return np.array([section.x_m, section.y_m, section.theta_rad])
    q, _ = from_euler(np.radians([section.roll_deg, section.pitch_deg, section.yaw_deg]))
    return np.array([section.x_m, section.y_m, section.z_m, *q])


def velocity_of(section: SpaceStartConfig) -> Array:
    """Return the velocity in the world and the body rate (6,) at a start."""
    s = section
    return np.array([s.vx_mps, s.vy_mps, s.vz_mps, s.wx_radps, s.wy_radps, s.wz_radps])


def covariance_of(section: PlanePose | SpacePose, dof: int) -> Array | None:
    """Return the covariance (dof, dof) of a mount or a start, None if it is known exactly."""
    if isinstance(section, PlanePose):
        sigmas = [section.sigma_xy_m, section.sigma_xy_m, section.sigma_theta_rad]
    else:
        sigmas = [*_three(section.sigma_position_m), *np.radians(_three(section.sigma_rotation_deg))]
    if isinstance(section, SpaceStartConfig):
        sigmas += [*_three(section.sigma_v_mps), *_three(section.sigma_w_radps)]
    return np.diag(np.square(sigmas[:dof])) if any(sigmas[:dof]) else None


def _three(sigma: float | tuple[float, ...]) -> Array:
    return np.broadcast_to(np.asarray(sigma, dtype=np.float64), 3)
