"""A log as messages that Foxglove and RViz draw: true paths and landmarks, fixes, velocities.

The world's frame is `map`.  Poses of the plane are at z = 0.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from kalmark.arrays import Array
from kalmark.bags.mcap_writer import MessageFields, Outgoing, header_fields, time_fields
from kalmark.events import Control, Fix
from kalmark.geometry.rotations import from_matrix
from kalmark.logs.log import Log, poses_of_size

MAP = "map"
MOST_POSES = 5000  # of a path that is drawn
SIGMAS = 3.0
THIN_M = 0.02  # of what has no extent
SPHERE, CUBE, LINES, TEXT, DELETE_ALL = 2, 1, 5, 9, 3
TRUTH_COLOUR, MAP_COLOUR = (0.2, 0.6, 0.2, 0.8), (0.1, 0.3, 0.9, 0.5)
LABEL_M = 0.3


def topic(robot: str, *names: str) -> str:
    """Return the name of a robot's topic: of what ROS does not allow in it, `_`."""
    return "/" + "/".join("".join(c if c.isalnum() and c.isascii() else "_" for c in name) for name in (robot, *names))


def pose_fields(pose: Array) -> MessageFields:
    """Return the fields of a geometry_msgs/Pose, of a pose (3,) or (7,)."""
    x, y, z, *q = poses_of_size(pose[None], 7)[0].tolist()
    return {"position": {"x": x, "y": y, "z": z}, "orientation": dict(zip("xyzw", q, strict=True))}


def covariance_fields(cov: Array) -> Array:
    """Return a covariance (36,) row by row, of (x, y), of (x, y, theta) or of a pose of space."""
    rows = {2: [0, 1], 3: [0, 1, 5], 6: [0, 1, 2, 3, 4, 5]}[len(cov)]
    out = np.zeros((6, 6))
    out[np.ix_(rows, rows)] = cov
    return out.ravel()


def path_fields(t_ns: Sequence[int], poses: Array) -> MessageFields:
    """Return the fields of a nav_msgs/Path, thinned where it has very many poses."""
    chosen = np.unique(np.linspace(0, len(t_ns) - 1, min(len(t_ns), MOST_POSES)).astype(int)) if len(t_ns) else ()
    rows = [{"header": header_fields(int(t_ns[k]), MAP), "pose": pose_fields(poses[k])} for k in chosen]
    return {"header": header_fields(int(t_ns[-1]) if len(t_ns) else 0, MAP), "poses": rows}


def marker(
    t_ns: int,
    space: str,
    number: int,
    kind: int,
    at: Any,
    scale: Any,
    colour: Sequence[float],
    text: str = "",
) -> MessageFields:
    """Return the fields of a visualization_msgs/Marker in the map's frame."""
    return {
        "header": header_fields(t_ns, MAP), "ns": space, "id": number, "type": kind, "pose": at, "text": text,
        "scale": dict(zip("xyz", map(float, scale), strict=True)), "color": dict(zip("rgba", colour, strict=True)),
    }  # fmt: skip


def ellipsoid(mean: Array, cov: Array, sigmas: float = SIGMAS) -> tuple[MessageFields, Array] | None:
    """Return pose and axes (3,) (m) of the ellipse or ellipsoid of a Gaussian; None if it has no bounds."""
    if not (np.isfinite(mean).all() and np.isfinite(cov).all()):
        return None
    d = len(mean)
    values, axes = np.linalg.eigh(cov)
    R, scale = np.eye(3), np.full(3, THIN_M)
    R[:d, :d] = axes
    if np.linalg.det(R) < 0:
        R[:, 0] *= -1
    scale[:d] = np.maximum(2 * sigmas * np.sqrt(np.maximum(values, 0.0)), THIN_M)
    at = np.append(np.pad(mean, (0, 3 - d)), from_matrix(R))
    return pose_fields(at), scale


def label(t_ns: int, number: int, text: str, at: Array, colour: Sequence[float]) -> MessageFields:
    """Return a landmark's name, above it."""
    above = pose_of_place(at)
    above[2] += LABEL_M
    return marker(t_ns, "ids", number, TEXT, pose_fields(above), (0, 0, LABEL_M), (*colour[:3], 1.0), text)


def pose_of_place(place: Array) -> Array:
    """Return the pose (7,) of a point (2,) or (3,), the first end of a line (6,) or a tag (7,)."""
    if len(place) == 7:
        return place.copy()
    return np.append(np.pad(place[:3], (0, 3 - len(place[:3]))), [0.0, 0, 0, 1])


def marker_array(t_ns: int, rows: list[MessageFields]) -> MessageFields:
    """Return the fields of a MarkerArray that replaces all markers of its topic."""
    clear = {"header": header_fields(t_ns, MAP), "action": DELETE_ALL, "pose": {"orientation": {"w": 1.0}}}
    return {"markers": [clear, *rows]}


# ------------------------------------------------------------------ a log
def view_messages(log: Log) -> Iterator[Outgoing]:
    """Yield the messages that draw a log, in order of time."""
    if not log.events:
        return
    begin = log.events[0].t_ns
    for robot, path in log.truth.items():
        fields = path_fields(path.t_ns.tolist(), path.poses)  # to be seen from the first moment
        yield Outgoing(topic(robot, "truth"), "nav_msgs/msg/Path", begin, fields)
    if log.landmarks:
        rows = []
        for number, (id_, place) in enumerate(log.landmarks.items()):
            at = pose_fields(pose_of_place(place))
            rows.append(marker(begin, "truth", number, CUBE, at, (0.1, 0.1, 0.1), TRUTH_COLOUR))
            rows.append(label(begin, number, str(id_), place, TRUTH_COLOUR))
        yield Outgoing("/truth/landmarks", "visualization_msgs/msg/MarkerArray", begin, marker_array(begin, rows))
    for event in log.events:
        if isinstance(event, Fix):
            cov = covariance_fields(event.cov if len(event.y) == 2 else np.pad(event.cov, (0, 3)))
            fields = {"pose": pose_fields(pose_of_place(event.y)), "covariance": cov}
            fields = {"header": header_fields(event.t_ns, MAP), "pose": fields}
            kind = "geometry_msgs/msg/PoseWithCovarianceStamped"
            yield Outgoing(topic(event.robot, "fix"), kind, event.t_ns, fields)
        elif isinstance(event, Control) and log.control_columns.get(event.robot) == ("v_mps", "w_radps"):
            v, w = event.u.tolist()
            twist = {"linear": {"x": v, "y": 0.0, "z": 0.0}, "angular": {"x": 0.0, "y": 0.0, "z": w}}
            fields = {"header": header_fields(event.t_ns, event.robot), "twist": twist}
            yield Outgoing(topic(event.robot, "velocity"), "geometry_msgs/msg/TwistStamped", event.t_ns, fields)


def transform_fields(t_ns: int, parent: str, child: str, pose: Array) -> MessageFields:
    """Return the fields of a geometry_msgs/TransformStamped."""
    at = pose_fields(pose)
    moved = {"translation": at["position"], "rotation": at["orientation"]}
    return {"header": {"stamp": time_fields(t_ns), "frame_id": parent}, "child_frame_id": child, "transform": moved}
