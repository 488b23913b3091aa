"""Odometry beside the detections: the path of another frame on the rig, as increments of the rig from scan to scan."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from kalmark.events import Control, Scan
from kalmark.geometry.frames3d import compose, inverse
from kalmark.logs.log import Array, Times, Trajectory
from kalmark.logs.ros import components, stamp
from kalmark.logs.tagslam_reference import between, unit
from kalmark.logs.tagslam_rig import Scene, frame_of

SIGMA_M, SIGMA_RAD = 0.005, 0.005
"""Per square root of a second, where tagslam.yaml gives none: the visual-inertial odometry of test 21 has 0.003."""


@dataclass(frozen=True)
class Odometry:
    """Hold the odometry's `path`, its frame `T` on the rig, and its noise per square root of a second."""

    path: Trajectory
    T: Array
    sigma_m: float
    sigma_rad: float

    @property
    def t_ns(self) -> Times:
        """The times of the path."""
        return self.path.t_ns

    def controls(self, robot: str, scans: Sequence[Scan]) -> list[Control]:
        """Return the rig's increments between the times of the scans, on the interpolated path.

        The odometry's frame O moves by D in its own frame, the rig by T D T^-1.  The noise grows with the time.
        """
        t_ns = np.unique([scan.t_ns for scan in scans])
        poses = self.path.at(t_ns, max_gap_s=1e9)
        rig = [compose(pose, inverse(self.T)[0])[0] for pose in poses]
        sigmas = np.array(3 * [self.sigma_m] + 3 * [self.sigma_rad])
        controls = []
        for k in range(1, len(t_ns)):
            step = between(rig[k - 1], rig[k])
            u = np.append(step[:3], Rotation.from_quat(step[3:]).as_rotvec())
            cov = np.diag(sigmas**2) * ((t_ns[k] - t_ns[k - 1]) * 1e-9)
            controls.append(Control(t_ns=int(t_ns[k]), robot=robot, u=u, cov=cov))
        return controls


def read_odometry(scene: Scene, received: list[tuple[str, Any]]) -> Odometry | None:
    """Return the odometry of the rig, None if there is none in the bag."""
    for body in scene.odometry.values():
        rows = [(stamp(m), m.pose.pose) for topic, m in received if topic == body["odom_topic"]]
        if not rows:
            continue
        poses = np.array([unit(components(pose.position, pose.orientation)) for _, pose in rows])
        return Odometry(
            Trajectory(np.array([t for t, _ in rows]), poses),
            frame_of(body["T_body_odom"]),
            float(body.get("odom_translation_noise", SIGMA_M)),
            float(body.get("odom_rotation_noise", SIGMA_RAD)),
        )
    return None
