"""How well the map explains the corners of tags: their distances from where it has them, in pixels."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from kalmark.geometry.frames3d import compose
from kalmark.models.sensors import TagCorners
from kalmark.models.tags import project_corners, tag_seen_from
from kalmark.results.cameras import mount_now
from kalmark.results.columns import Array

if TYPE_CHECKING:
    from kalmark.events import Scan
    from kalmark.report import Report
    from kalmark.slam.slam import Slam

USED = ("associated", "new")


def left_px(slam: Slam, scan: Scan, report: Report) -> Array:
    """Return what a scan's correction leaves of each observation (K,): the RMS of a tag's corners, NaN of all else.

    `slam` is the filter just after the scan; an observation that it did not use has NaN, too.
    """
    left, mount = np.full(len(report.observations), np.nan), slam.robots[scan.robot].sensors[scan.sensor]
    used = [o for o in report.observations if o.outcome in USED]
    if not used or not isinstance(mount.sensor, TagCorners):
        return left
    at = mount_now(slam, scan.robot, scan.sensor, mount.at)
    tags = np.array([slam.mean(o.landmark)[:7] for o in used])  # type: ignore[arg-type]
    v = tag_seen_from(compose(slam.mean(scan.robot)[:7], at)[0], tags)[0]
    rows = [o.index for o in used]
    y, par = scan.y[rows], np.array(mount.sensor.parameters)
    e = project_corners(mount.sensor.code, v, np.ascontiguousarray(y[:, 8]), par)[0]
    left[rows] = np.nan_to_num(rms_of_corners(y[:, :8] - e), nan=np.inf)  # behind the camera
    return left


def rms_of_corners(residuals: Array) -> Array:
    """Return the RMS (K,) of the distances of four corners whose residuals are (K, 8)."""
    return np.sqrt(0.25 * np.sum(residuals**2, axis=1))
