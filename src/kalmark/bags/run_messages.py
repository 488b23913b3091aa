"""A run as messages of ROS 2, for Foxglove and RViz: docs/bags.md lists them."""

from __future__ import annotations

from collections.abc import Iterator
from heapq import merge
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from kalmark.arrays import Array
from kalmark.bags import tables, view
from kalmark.bags.mcap_writer import MessageFields, Outgoing, header_fields, write_mcap
from kalmark.geometry.named_poses import pose_of
from kalmark.geometry.pose_frames import ORIGIN
from kalmark.geometry.rotations import matrix
from kalmark.results.history import MapSnapshot
from kalmark.results.landmark_table import shapes

if TYPE_CHECKING:
    from kalmark.logs.log import Log
    from kalmark.results.run import Run

PATHS = 20  # so often the path so far is repeated
FULL = 13  # numbers of a state with velocities
OK, WARN = b"\x00", b"\x01"
TAG_M = 0.2  # how large a tag is drawn: its size is not in the map


def export(path: Path, log: Log | None, run: Run | None = None) -> dict[str, int]:
    """Write a log, and the run made of it, into one MCAP file; return the number of messages by topic."""
    streams = [] if log is None else [tables.messages_of_log(log), view.view_messages(log)]
    streams += [] if run is None else [*run_messages(run)]
    return write_mcap(path, merge(*streams, key=lambda message: message.t_ns))


def run_messages(run: Run) -> list[Iterator[Outgoing]]:
    """Return the messages of a run as streams, each in order of time."""
    begin = int(run.history.t_ns[0]) if len(run.history.t_ns) else 0
    robots = [stream(run, robot) for robot in run.history.robots for stream in (pose_messages, paths)]
    return [iter(mount_frames(run, begin)), *robots, maps(run), iter([summary_message(run)] if run.summary else [])]


def pose_messages(run: Run, robot: str) -> Iterator[Outgoing]:
    """Yield a robot's pose with its covariance after each of its scans: Odometry, tf and diagnostics."""
    history = run.history
    for step in np.flatnonzero(history.robot == robot).tolist():
        t_ns, mean, P = int(history.t_ns[step]), history.mean[step], history.covariance[step]
        mean, dof = mean[~np.isnan(mean)], 3 if np.isnan(mean[3:]).all() else 6
        pose = mean[:3] if dof == 3 else mean[:7]
        twist = {"twist": body_twist(mean)} if len(mean) == FULL else {}
        fields = {"header": header_fields(t_ns, view.MAP), "child_frame_id": robot, "twist": twist}
        fields["pose"] = {"pose": view.pose_fields(pose), "covariance": view.covariance_fields(P[:dof, :dof])}
        yield Outgoing(view.topic(robot, "odometry"), "nav_msgs/msg/Odometry", t_ns, fields)
        yield tf("/tf", t_ns, [view.transform_fields(t_ns, view.MAP, robot, pose)])
        yield diagnostics(t_ns, [status(run, robot, step, P[:dof, :dof])])


def body_twist(mean: Array) -> MessageFields:
    """Return the velocity of a state (13,) in the robot's frame; in the state it is in the world's."""
    v, w = matrix(np.ascontiguousarray(mean[3:7])).T @ mean[7:10], mean[10:13]
    return {name: dict(zip("xyz", part.tolist(), strict=True)) for name, part in (("linear", v), ("angular", w))}


def tf(topic: str, t_ns: int, transforms: list[MessageFields]) -> Outgoing:
    """Return a message of frames."""
    return Outgoing(topic, "tf2_msgs/msg/TFMessage", t_ns, {"transforms": transforms})


def paths(run: Run, robot: str) -> Iterator[Outgoing]:
    """Yield a robot's path so far, and its true path once."""
    mine = np.flatnonzero(run.history.robot == robot)
    at, t_ns = run.history.poses[mine], run.history.t_ns[mine].tolist()
    for end in np.unique(np.linspace(1, len(mine), PATHS).astype(int)).tolist() if len(mine) else ():
        fields = view.path_fields(t_ns[:end], at[:end])
        yield Outgoing(view.topic(robot, "path"), "nav_msgs/msg/Path", t_ns[end - 1], fields)


def mount_frames(run: Run, t_ns: int) -> list[Outgoing]:
    """Return the frames of the sensors as configured, in those of their robots."""
    frames = [
        view.transform_fields(t_ns, robot, f"{robot}/{sensor}", pose_of(section.get("mount") or {}))
        for robot in run.history.robots
        for sensor, section in run.sections(robot).items()
    ]
    return [tf("/tf_static", t_ns, frames)] if frames else []


def maps(run: Run) -> Iterator[Outgoing]:
    """Yield the map at the instants at which it was kept: ellipsoids of 3 sigma, lines, tags, ids."""
    for kept in run.history.maps:
        rows = landmark_markers(kept)
        yield Outgoing(
            "/landmarks", "visualization_msgs/msg/MarkerArray", kept.t_ns, view.marker_array(kept.t_ns, rows)
        )


def landmark_markers(kept: MapSnapshot) -> list[MessageFields]:
    """Return the markers of one map."""
    if not len(kept.ids):
        return []
    t_ns, d = kept.t_ns, 2 if kept.means.shape[1] == 2 else 3
    drawn, colour = shapes(kept.means, kept.covariances, kept.kinds, d), view.MAP_COLOUR
    out = []
    for number, (row, mean, P) in enumerate(zip(drawn.row.tolist(), drawn.means, drawn.covariances, strict=True)):
        found = view.ellipsoid(mean, P)
        if found is not None:
            out.append(view.marker(t_ns, "landmarks", number, view.SPHERE, *found, colour))
            out.append(view.label(t_ns, number, str(kept.ids[row]), mean, colour))
    for number, ends in enumerate(drawn.lines):
        if np.isfinite(ends).all():
            here = view.pose_fields(ORIGIN[7])
            one = view.marker(t_ns, "lines", number, view.LINES, here, (view.THIN_M, 0, 0), colour)
            out.append(one | {"points": [dict(zip("xyz", end.tolist(), strict=True)) for end in ends]})
    for number, pose in enumerate(drawn.tags):
        size = (TAG_M, TAG_M, view.THIN_M)
        out.append(view.marker(t_ns, "tags", number, view.CUBE, view.pose_fields(pose), size, colour))
    return out


def status(run: Run, robot: str, step: int, P: Array) -> MessageFields:
    """Return the fields of a DiagnosticStatus: numbers of observations by outcome, and the uncertainty of the pose."""
    history = run.history
    first, last = np.searchsorted(history.step, [step, step + 1])
    outcomes, counts = np.unique(history.outcome[first:last], return_counts=True)
    d2 = history.d2[first:last]
    values = {str(name): str(count) for name, count in zip(outcomes, counts, strict=True)}
    values["largest squared distance"] = f"{np.nanmax(d2):.3g}" if np.isfinite(d2).any() else "-"
    values["position sigma (m)"] = f"{np.sqrt(np.linalg.eigvalsh(P[:2, :2])[-1]):.4g}"
    values["heading sigma (rad)"] = f"{np.sqrt(P[-1, -1]):.4g}"
    rejected = int(counts[outcomes == "rejected"].sum())
    told = f"{rejected} rejected" if rejected else f"{last - first} observations"
    pairs = [{"key": key, "value": value} for key, value in values.items()]
    return {"level": (WARN if rejected else OK)[0], "name": f"kalmark/{robot}", "message": told, "values": pairs}


def summary_message(run: Run) -> Outgoing:
    """Return the figures and warnings of a run as its last diagnostics."""
    warnings = [str(line) for line in run.summary.get("warnings", ())]
    plain = {key: value for key, value in run.summary.items() if isinstance(value, int | float | str)}
    pairs = [{"key": key, "value": str(value)} for key, value in plain.items()]
    pairs += [{"key": f"warning {number}", "value": line} for number, line in enumerate(warnings, 1)]
    told = {"level": (WARN if warnings else OK)[0], "name": "kalmark/run", "values": pairs}
    told["message"] = f"{len(warnings)} warnings" if warnings else "ok"
    return diagnostics(int(run.history.t_ns[-1]) if len(run.history.t_ns) else 0, [told])


def diagnostics(t_ns: int, told: list[MessageFields]) -> Outgoing:
    """Return a message of diagnostics."""
    fields = {"header": header_fields(t_ns), "status": told}
    return Outgoing("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray", t_ns, fields)
