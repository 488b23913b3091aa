"""The start of a robot in a first configuration, by its fixes."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from kalmark.bags.first_text import GUESS, Entry
from kalmark.bags.survey import Poses, Survey, TopicSummary, yaw
from kalmark.logs.geodesy import to_tangent_plane
from kalmark.logs.log import poses_of_size
from kalmark.results.measures import rigid

NEAR_NS = 500_000_000
LEAST_WAY_M = 2.0
POSE_M, POSE_RAD = 0.5, 0.2  # sigmas of positions and headings that come without a covariance


@dataclass
class EstimatedStart:
    """Start of a robot: x, y, heading, their two sigmas, and the source.

    `north`: the map's axes are east and north; `known`: the heading has a source.
    """

    at: list[float]
    sigmas: list[float]
    why: str
    north: bool = False
    known: bool = True


def start_of(found: Survey, control: Any, used: Mapping[str, Entry], space: bool) -> EstimatedStart | None:
    """Return a robot's start in the frame of its fixes, None if nothing or a true path in that frame determines it."""
    if control is None or space:
        return None
    fixes, true = ([found.named(name) for name, (entry, _) in used.items() if entry["type"] == kind]
                   for kind in ("fix", "truth"))  # fmt: skip
    of_poses = [topic for topic in true if topic.offers.pose is not None]
    if not fixes or any(topic.frame == fixes[0].frame or not topic.frame for topic in of_poses):
        return None
    fix, poses = fixes[0], control.poses if isinstance(control, TopicSummary) else found.pairs[control]
    if fix.offers.pose is not None:
        cov = np.diag([POSE_M**2] * 3 + [POSE_RAD**2] * 3) if fix.poses.cov is None else fix.poses.cov
        sigmas = [math.sqrt(max(cov[0, 0], cov[1, 1], 1e-4)), math.sqrt(max(cov[5, 5], 1e-4))]
        first = fix.poses.frames[0]
        at = [float(first[0]), float(first[1]), yaw(first)]
        return EstimatedStart(at, sigmas, f"{GUESS} the first pose of {fix.name}")
    if (laid := align_odometry(poses, fix)) is not None:
        return EstimatedStart(*laid, f"{GUESS} the way by odometry laid upon that by {fix.name}", north=True)
    return EstimatedStart([0.0] * 3, [5.0, 1.5], f"{GUESS} its heading, from east to the left", north=True, known=False)


def align_odometry(odometry: Poses, fixes: TopicSummary) -> tuple[list[float], list[float]] | None:
    """Return the start (x, y, heading) that lays a way by odometry upon satellite fixes, and its sigmas.

    By least squares; None where they have too little way in common.
    """
    if not odometry.moves:
        return None
    t_ns, frames = np.array(odometry.t_ns), np.array(odometry.frames)
    lla = np.array([frame[:3] for frame in fixes.poses.frames])
    enu = to_tangent_plane(lla, fixes.origin)[:, :2]
    after = np.clip(np.searchsorted(t_ns, fixes.poses.t_ns), 1, len(t_ns) - 1)
    near = np.abs(t_ns[after] - np.array(fixes.poses.t_ns)) < NEAR_NS
    p, q = frames[after[near], :2], enu[near]
    if len(p) < 3 or np.ptp(p, axis=0).max() < LEAST_WAY_M:
        return None
    fit, (begin,) = rigid(p, q), poses_of_size(frames[:1], 3)
    x, y, heading = fit.poses(begin[None])[0].tolist()
    spread, reach = math.sqrt(float(np.mean((q - fit(p)) ** 2))) + 0.05, float(np.linalg.norm(p - p.mean(axis=0)))
    return [x, y, math.remainder(heading, 2 * math.pi)], [spread, max(spread / reach, 0.05)]
