"""The batch solution of a run of one rig that saw tags' corners, and how far the filter is from it.

Needs no log: what was measured is in the run's history.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from kalmark.errors import KalmarkError
from kalmark.events import Id
from kalmark.geometry.frames3d import from_frame, minus
from kalmark.models.sensors import TagCorners
from kalmark.models.tags import corners
from kalmark.results.align import rigid, rmse
from kalmark.results.batch_tags import Sightings, Tags, adjust, look, parts, together
from kalmark.results.corners import USED

if TYPE_CHECKING:
    from kalmark.results.run import Run

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class TagBatch:
    """The optimum of a run's corners beside what the filter has: path at `t_ns` (n,), tags of `ids`, residuals.

    `filtered` is the filter's path as it was then, with the map that the run ended with.
    """

    optimum: Tags
    filtered: Tags
    seen: Sightings
    t_ns: Ints
    ids: list[Id]

    def compare(self) -> dict[str, Any]:
        """Return the RMS of the corners, and how far apart path and map are when the tags' corners are aligned rigidly.

        `median_px`: of the corners' distances.  `sigma_ratio`: median over the tags of the filter's sigma of position
        over the batch's, which knows nothing of the motion: expect it below 1 where tags are seen briefly.
        """
        onto = rigid(self._corners(self.optimum), self._corners(self.filtered))
        path, tags = onto.poses(self.optimum.poses), onto.poses(self.optimum.tags)
        apart = np.array([minus(a, b) for a, b in zip(self.filtered.tags, tags, strict=True)])
        mine, theirs = (np.trace(x.covariances[:, :3, :3], axis1=1, axis2=2) for x in (self.optimum, self.filtered))
        return {
            "rms_px": self.optimum.rms_px,
            "median_px": float(np.median(self.optimum.errors_px)),
            "filter_rms_px": self.filtered.rms_px,
            "filter_median_px": float(np.median(self.filtered.errors_px)),
            "map_difference_m": rmse(apart[:, :3]),
            "map_difference_deg": float(np.degrees(rmse(apart[:, 3:]))),
            "path_difference_m": rmse(self.filtered.poses[:, :3] - path[:, :3]),
            "sigma_ratio": float(np.median(np.sqrt(theirs / mine))),
            "tags": len(self.ids),
            "sightings": len(self.seen.y),
            "iterations": self.optimum.iterations,
        }

    def _corners(self, at: Tags) -> Array:
        """Return the places (4 m, 3) of the corners of all tags."""
        size = np.empty(len(at.tags))
        size[self.seen.tag] = self.seen.size
        return np.concatenate([from_frame(l, corners(s))[0] for l, s in zip(at.tags, size, strict=True)])


def adjust_run(run: Run, huber_px: float = np.inf) -> TagBatch:
    """Adjust the path and tags of a run to the corners that its filter used, from where the filter has them.

    The first pose is held, of each part of the path that shares no tag with the others; mounts that the filter
    calibrates are adjusted where another camera saw a tag at the same time.  Raises KalmarkError unless one robot alone
    saw tags.
    """
    history, slam = run.history, run.final_slam()
    rows = np.flatnonzero(np.isin(history.outcome, USED))
    robots = {str(history.robot[step]) for step in history.step[rows]}
    if len(robots) != 1:
        raise KalmarkError(f"tags: sightings of {len(robots)} robots, expected of one")
    name = robots.pop()
    mounted = slam.robots[name].sensors
    cameras = {n: m.sensor for n, m in mounted.items() if isinstance(m.sensor, TagCorners)}
    rows = rows[np.isin(history.sensor[rows], list(cameras))]
    if not len(rows):
        raise KalmarkError(f"tags: no camera of robot {name!r} saw a tag's corners, expected sightings of TagCorners")
    seen_ids = set(history.landmark[rows].tolist())
    ids = [id_ for id_ in slam.landmarks().ids if str(id_) in seen_ids]
    rows = rows[np.isin(history.landmark[rows], [str(id_) for id_ in ids])]
    t_ns, pose = np.unique(history.t_ns[history.step[rows]], return_inverse=True)
    poses = np.empty((len(t_ns), 7))
    poses[pose] = history.mean[history.step[rows], :7]
    calibrated = [n for n in cameras if mounted[n].cov is not None]
    mounts = [slam.mean(f"{name}.{n}") if n in calibrated else mounted[n].at for n in cameras]
    seen = Sightings(
        pose=pose,
        camera=_places(list(cameras), history.sensor[rows]),
        tag=_places([str(id_) for id_ in ids], history.landmark[rows]),
        y=np.ascontiguousarray(history.y[rows, :8]),
        size=np.ascontiguousarray(history.y[rows, 8]),
        lenses=[(sensor.lens_code, np.array(sensor.parameters)) for sensor in cameras.values()],
    )
    tags = np.array([slam.mean(id_) for id_ in ids])
    filtered, _ = look(seen, poses, tags, np.array(mounts, dtype=np.float64))
    filtered.covariances[:] = [slam.covariance(id_) for id_ in ids]
    optimum = adjust(
        seen,
        *(filtered.poses, filtered.tags, filtered.mounts),
        hold_pose=parts(seen).tolist(),
        free_mounts=[k for k in together(seen) if list(cameras)[k] in calibrated],
        sigma_px=next(iter(cameras.values())).sigma_px,
        huber_px=huber_px,
    )
    return TagBatch(optimum, filtered, seen, t_ns, ids)


def _places(names: list[str], of: npt.NDArray[np.str_]) -> Ints:
    """Return the places of texts in a list."""
    at = {name: k for k, name in enumerate(names)}
    return np.array([at[text] for text in of.tolist()], dtype=np.int64)
