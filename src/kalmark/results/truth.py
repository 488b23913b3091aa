"""What a run is judged by: true poses at its steps, true landmarks, position fixes, and the frame they are in."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from kalmark.geometry.angles import wrap
from kalmark.results.align import Rigid
from kalmark.results.history import Array, History, Start, as_id, texts
from kalmark.slam.events import Id

SAME_FRAME_M, SAME_FRAME_RAD, SAME_FRAME_SIGMAS = 0.05, 0.02, 4.0


@dataclass(frozen=True, eq=False)
class Fixes:
    """Position fixes of one robot used only for scoring: times, positions (N, 2), antenna (2,) in the robot's frame."""

    t_ns: npt.NDArray[np.int64]
    xy: Array
    antenna: Array


@dataclass(frozen=True, eq=False)
class Truth:
    """True poses (S, 3) at the steps of a run, NaN where unknown, in the frame of the truth.

    `offset` (3,) is the pose of the truth's frame in the map's.  It is zero when the robots started at the truth (or
    the map is `anchored`: tied to the world otherwise, by known landmarks or fixes); else it is what brings the first
    robot's true start to its start.  `robots` are those whose truth the log has.
    """

    poses: Array
    landmarks: dict[Id, Array] = field(default_factory=dict)
    fixes: dict[str, Fixes] = field(default_factory=dict)
    offset: Array = field(default_factory=lambda: np.zeros(3))
    anchored: bool = False
    robots: tuple[str, ...] = ()

    @classmethod
    def of(cls, log: Any, history: History, anchored: bool = False) -> Truth:
        """Return the truth of a log at the steps of a history; a log without truth, or a list of events, gives none."""
        trajectories = getattr(log, "truth", None) or {}
        poses = np.full((len(history.t_ns), 3), np.nan)
        for robot, trajectory in trajectories.items():
            mine = history.robot == robot
            if mine.any():
                poses[mine] = trajectory.at(history.t_ns[mine])[:, :3]
        fixes = {
            robot: Fixes(track.t_ns, np.asarray(track.xy), np.asarray(track.antenna))
            for robot, track in (getattr(log, "gps", None) or {}).items()
        }
        offset = np.zeros(3) if anchored else _offset(trajectories, history.starts)
        return cls(poses, dict(getattr(log, "landmarks", None) or {}), fixes, offset, anchored, tuple(trajectories))

    def __bool__(self) -> bool:
        return bool(self.landmarks) or bool(np.isfinite(self.poses).any())

    @property
    def frame(self) -> str:
        """Whether the map is in the frame of the truth ("truth") or in that of the first robot's start ("start")."""
        return "start" if self.offset.any() else "truth"

    def to_map(self) -> Rigid:
        """Return what takes positions from the truth's frame to the map's."""
        c, s = np.cos(self.offset[2]), np.sin(self.offset[2])
        return Rigid(np.array([[c, -s], [s, c]]), self.offset[:2])

    def poses_in_map(self) -> Array:
        """Return the true poses (S, 3) in the frame of the map."""
        return self.to_map().poses(self.poses)

    def landmarks_in_map(self) -> dict[Id, Array]:
        """Return the true landmarks in the frame of the map."""
        to_map = self.to_map()
        return {i: np.append(to_map(l[:2]), l[2:]) for i, l in self.landmarks.items()}

    def arrays(self) -> dict[str, npt.NDArray[Any]]:
        """Return everything as named arrays for ``history.npz``."""
        robots = list(self.fixes)
        return {
            "truth": self.poses,
            "truth_offset": self.offset,
            "truth_anchored": np.array(self.anchored),
            "truth_robot": texts(list(self.robots)),
            "truth_landmark": texts(list(self.landmarks)),
            "truth_landmark_mean": np.array(list(self.landmarks.values()), dtype=np.float64),
            "fix_robot": texts(robots),
            "fix_size": np.array([len(self.fixes[r].t_ns) for r in robots], dtype=np.int64),
            "fix_t_ns": np.concatenate([self.fixes[r].t_ns for r in robots] or [np.empty(0, dtype=np.int64)]),
            "fix_mean": np.concatenate([self.fixes[r].xy for r in robots] or [np.empty((0, 2))]),
            "fix_antenna": np.array([self.fixes[r].antenna for r in robots], dtype=np.float64),
        }

    @classmethod
    def from_arrays(cls, named: Mapping[str, npt.NDArray[Any]]) -> Truth:
        """Return the truth that `arrays` gave."""
        landmarks = {
            as_id(text): mean
            for text, mean in zip(named["truth_landmark"].tolist(), named["truth_landmark_mean"], strict=True)
        }
        ends = np.cumsum(named["fix_size"])
        fixes = {
            str(robot): Fixes(named["fix_t_ns"][end - size : end], named["fix_mean"][end - size : end], antenna)
            for robot, size, end, antenna in zip(
                named["fix_robot"], named["fix_size"], ends, named["fix_antenna"], strict=True
            )
        }
        robots = tuple(named["truth_robot"].tolist()) if "truth_robot" in named else ()
        return cls(named["truth"], landmarks, fixes, named["truth_offset"], bool(named["truth_anchored"]), robots)


def _offset(trajectories: Mapping[str, Any], starts: tuple[Start, ...]) -> Array:
    """Return the pose of the truth's frame in the map's: zero if the first robot with truth started there."""
    for start in starts:
        if start.robot not in trajectories:
            continue
        true = trajectories[start.robot].at(np.array([start.t_ns]))[0][:3]
        if not np.isfinite(true).all():
            continue
        d = np.append(true[:2] - start.mean[:2], wrap(true[2] - start.mean[2]))
        sigma = np.sqrt(np.maximum(np.diagonal(start.covariance)[:3], 0.0))
        slack = np.array([SAME_FRAME_M, SAME_FRAME_M, SAME_FRAME_RAD])
        if (np.abs(d) <= SAME_FRAME_SIGMAS * sigma + slack).all():
            return np.zeros(3)
        angle = -d[2]
        c, s = np.cos(angle), np.sin(angle)
        return np.append(start.mean[:2] - np.array([[c, -s], [s, c]]) @ true[:2], wrap(angle))
    return np.zeros(3)
