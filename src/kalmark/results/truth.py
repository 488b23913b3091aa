"""The truth that a run is scored by: poses at its steps, landmarks, position fixes, and their frame."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from kalmark.arrays import Array
from kalmark.events import Id
from kalmark.geometry.angles import wrap
from kalmark.geometry.pose_frames import ORIGIN
from kalmark.geometry.rotations import from_matrix, matrix
from kalmark.logs.log import LandmarkPlaces, Log, Names, PositionTrack, poses_of_size
from kalmark.results.history import Arrays, History, Named, RobotStart, as_id, ints, padded_all, texts
from kalmark.results.landmark_table import TAG
from kalmark.results.measures import Rigid, pose_error, sigmas

SAME_FRAME_M, SAME_FRAME_RAD, SAME_FRAME_SIGMAS = 0.05, 0.02, 4.0


@dataclass(frozen=True, eq=False)
class Truth:
    """True poses (S, 3) or, in space, (S, 7) at the steps of a run, NaN where unknown, in the frame of the truth.

    `landmarks` are true places: positions (2,) or (3,), endpoints of a line (6,), the pose of a tag (7,). `offset`
    is the pose of the truth's frame in the map's. It is the origin when the robots started at the truth (or the map
    is `anchored`: tied to the world otherwise, by known landmarks or fixes); else it is what brings the first
    robot's true start to its start, or, where the truth begins later, its first true pose to the estimate at that step.
    `fixes` are used only for scoring, `robots` are those whose truth the log has.
    """

    poses: Array
    landmarks: LandmarkPlaces = field(default_factory=dict)
    fixes: dict[str, PositionTrack] = field(default_factory=dict)
    offset: Array = field(default_factory=lambda: ORIGIN[3])
    anchored: bool = False
    robots: Names = ()

    @classmethod
    def of(cls, log: Log, history: History, anchored: bool = False) -> Truth:
        """Return the truth of a log at the steps of a history; a log without truth gives none."""
        size = 7 if history.in_space else 3
        poses = np.full((len(history.t_ns), size), np.nan)
        for robot, trajectory in log.truth.items():
            mine = history.robot == robot
            if mine.any():
                poses[mine] = poses_of_size(trajectory.at(history.t_ns[mine]), size)
        offset = ORIGIN[size] if anchored else frame_offset(log.truth, _known(history, poses), size)
        landmarks = landmarks_of_size(log.landmarks, size)
        return cls(poses, landmarks, dict(log.gps), offset, anchored, tuple(log.truth))

    def __bool__(self) -> bool:
        return bool(self.landmarks) or bool(np.isfinite(self.poses).any())

    @property
    def frame(self) -> str:
        """True if the map is in the frame of the truth ("truth") or in that of the first robot's start ("start")."""
        return "truth" if np.array_equal(self.offset, ORIGIN[len(self.offset)]) else "start"

    def to_map(self) -> Rigid:
        """Return the transform from the truth's frame to the map's."""
        return as_rigid(self.offset)

    def poses_in_map(self) -> Array:
        """Return the true poses (S, 3 or 7) in the frame of the map."""
        return self.to_map().poses(self.poses)

    def landmarks_in_map(self) -> LandmarkPlaces:
        """Return the true landmarks in the frame of the map."""
        return move_landmarks(self.to_map(), self.landmarks)

    def arrays(self) -> Arrays:
        """Return everything as named arrays for ``history.npz``."""
        tracks = [*self.fixes.values()]
        return {
            "truth": self.poses,
            "truth_offset": self.offset,
            "truth_anchored": np.array(self.anchored),
            "truth_robot": texts(list(self.robots)),
            "truth_landmark": texts(list(self.landmarks)),
            "truth_landmark_mean": padded_all(list(self.landmarks.values())),
            "fix_robot": texts(list(self.fixes)),
            "fix_size": ints([*map(len, tracks)]),
            "fix_t_ns": np.concatenate([ints(()), *(track.t_ns for track in tracks)]),
            "fix_mean": np.concatenate([np.empty((0, 2)), *(track.xy for track in tracks)]),
            "fix_antenna": np.array([track.antenna for track in tracks], dtype=np.float64),
        }

    @classmethod
    def from_arrays(cls, named: Named) -> Truth:
        """Return the truth that `arrays` gave."""
        landmarks = {
            as_id(text): mean[~np.isnan(mean)]
            for text, mean in zip(named["truth_landmark"].tolist(), named["truth_landmark_mean"], strict=True)
        }
        parts = (np.split(named[key], np.cumsum(named["fix_size"])[:-1]) for key in ("fix_t_ns", "fix_mean"))
        tracks = zip(
            named["fix_robot"].tolist(), *parts, named["fix_antenna"], strict=False
        )  # no robot: one empty part
        fixes = {robot: PositionTrack(t_ns, xy, antenna) for robot, t_ns, xy, antenna in tracks}
        robots = tuple(named["truth_robot"].tolist())
        return cls(named["truth"], landmarks, fixes, named["truth_offset"], bool(named["truth_anchored"]), robots)


def landmarks_of_size(landmarks: Mapping[Id, Any], size: int) -> LandmarkPlaces:
    """Return true landmarks as they are among robots of the plane (size 3), or of space (size 7: points at z = 0)."""
    arrays = {i: np.asarray(l, dtype=np.float64) for i, l in landmarks.items()}
    return {i: np.append(l, 0.0) if size == 7 and len(l) == 2 else l for i, l in arrays.items()}


def as_rigid(pose: Array) -> Rigid:
    """Return the transform from the frame that a pose (3,) or (7,) is, to the frame that it is given in."""
    if len(pose) == 7:
        return Rigid(matrix(np.ascontiguousarray(pose[3:])), pose[:3])
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return Rigid(np.array([[c, -s], [s, c]]), pose[:2])


def move_landmarks(rigid: Rigid, landmarks: Mapping[Id, Array]) -> LandmarkPlaces:
    """Return landmarks rotated and shifted: positions (attributes are kept), endpoints (4|6,), in space poses (7,)."""
    d = len(rigid.shift)
    out = {}
    for i, l in landmarks.items():
        if len(l) == 2 * d:  # a line, in the plane a wall
            out[i] = rigid(l.reshape(2, d)).ravel()
        else:
            out[i] = rigid.poses(l[None])[0] if d == 3 and len(l) == TAG else np.append(rigid(l[:d]), l[d:])
    return out


def _known(history: History, poses: Array) -> list[RobotStart]:
    """Return the starts of robots; of those whose truth (S, 3 or 7) begins later, also their first step that has it."""
    there, first = np.isfinite(poses).all(axis=1), list[RobotStart]()
    for start in history.starts:
        steps = np.flatnonzero(there & (history.robot == start.robot))
        first.append(start)
        if len(steps):
            k = int(steps[0])
            at, P = history.poses[k], history.pose_covariances[k]
            first.append(RobotStart(start.robot, at, P, int(history.t_ns[k])))
    return first


def frame_offset(trajectories: Mapping[str, Any], starts: Sequence[RobotStart], size: int) -> Array:
    """Return the pose of the truth's frame in the map's: the origin if the first robot with truth started there."""
    for start in starts:
        if start.robot not in trajectories:
            continue
        true = poses_of_size(trajectories[start.robot].at(np.array([start.t_ns])), size)[0]
        if not np.isfinite(true).all():
            continue
        n = 2 if size == 3 else 3
        d = pose_error(start.mean[:size], true)
        sigma = sigmas(start.covariance)[: len(d)]
        slack = np.repeat([SAME_FRAME_M, SAME_FRAME_RAD], [n, len(d) - n])
        if (np.abs(d) <= SAME_FRAME_SIGMAS * sigma + slack).all():
            break
        here, there = as_rigid(start.mean[:size]), as_rigid(true)
        turn = here.rotation @ there.rotation.T
        shift = here.shift - turn @ there.shift
        if size == 3:
            return np.append(shift, wrap(start.mean[2] - true[2]))
        return np.concatenate([shift, from_matrix(np.ascontiguousarray(turn))])
    return ORIGIN[size]
