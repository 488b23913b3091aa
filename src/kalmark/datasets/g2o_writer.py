"""A run as a graph that g2o reads: poses and landmarks as estimated, edges of the motion and of what was observed.

Conventions of the lines: `kalmark.datasets.g2o`.  Landmarks have numbers behind those of the poses; a comment has the
id of each.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from kalmark.arrays import Array
from kalmark.batch.motion_chain import Chain
from kalmark.errors import RunError
from kalmark.events import Control, Fix, Raw, Scan
from kalmark.files import write
from kalmark.geometry.pose_frames import FRAMES
from kalmark.geometry.rotations import matrix
from kalmark.logs.increments import cut_increments

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from kalmark.logs.log import Log
    from kalmark.results.run import Run
    from kalmark.slam.robot import Robot

LEAST = 1e-12  # m^2, rad^2: variance of a coordinate without noise, whose information would not be finite
POLAR = (("range_m", "bearing_rad"), ("range_m", "azimuth_rad", "elevation_rad"))
POINTS = (("x_m", "y_m"), ("x_m", "y_m", "z_m"))


def export(path: Path, log: Log | None, run: Run | None) -> dict[str, int]:
    """Write the graph of a run, increments cut as the filter took them; return the number of lines by tag.

    Raises RunError for sensors that do not observe positions, KalmarkError.
    """
    if log is None or run is None:
        raise RunError(f"{path}: no run to write, expected the folder of one: a graph needs estimates and noise")
    whole = (run.config.get("log") or {}).get("increments") == "recorded"
    lines = [*graph(run, log if whole else cut_increments(log), run.final_slam().robots)]
    write(path, "\n".join(lines) + "\n")
    return dict(Counter(line.partition(" ")[0] for line in lines if not line.startswith("#")))


def graph(run: Run, log: Log, robots: Mapping[str, Robot]) -> Iterator[str]:
    """Yield the lines of the graph of a run.  Raises RunError, KalmarkError."""
    chain = Chain(robots, {}, {})
    for name, sensor in log.sensor_columns:
        columns = tuple(robots[name].sensors[sensor].sensor.columns) if name in robots else POINTS[0]
        if columns not in (*POLAR, *POINTS):
            raise RunError(
                f"the scans of {name} by {sensor} have {', '.join(columns)}, expected positions, or ranges with "
                "bearings: g2o has points"
            )
    history, d = run.history, run.history.d
    rows: dict[int, list[int]] = {}
    for row in np.flatnonzero(history.fused & (history.landmark != "")).tolist():
        rows.setdefault(int(history.step[row]), []).append(row)
    nodes: dict[int, Array] = {}
    sights: list[tuple[int, str, Array, Array]] = []
    steps = iter(range(len(history.t_ns)))
    for event in log.events:
        if isinstance(event, Control):
            chain.take(event)
        elif not isinstance(event, Fix) and event.robot in robots and (step := next(steps, None)) is not None:
            node = chain.node_at(event.robot, event.t_ns)
            nodes[node] = history.poses[step]
            sights += [(node, *seen) for seen in _observed(event, robots[event.robot], history, rows.get(step, []))]
    if not nodes:
        raise RunError("the run has no scan, expected some: the graph has a pose for each of them")
    known = dict(zip(map(str, run.landmarks.ids), run.landmarks.means, strict=True))
    number = {name: len(chain.nodes) + k for k, name in enumerate(name for name in known if len(known[name]) == d)}
    yield from _vertices(chain, nodes, robots)
    yield from _landmarks(number, known, d)
    yield from _moves(chain)
    for node, name, p, C in sights:
        if name in number:
            tag, ids = ("EDGE_SE2_XY", []) if len(p) == 2 else ("EDGE_SE3_TRACKXYZ", [0])
            yield _line(tag, [node, number[name], *ids], p, C)


def _observed(event: Scan | Raw, robot: Robot, history: Any, rows: list[int]) -> Iterator[tuple[str, Array, Array]]:
    """Yield landmark, position in the robot's frame (d,) and covariance of the observations that were fused."""
    mount = robot.sensors[event.sensor]
    sensor: Any = mount.sensor  # of points
    at, m = np.array(mount.at), len(sensor.columns)
    own = event.cov if isinstance(event, Scan) and mount.detector is None else None
    for row in rows:
        y = history.y[row, None, :m]
        R = sensor.noise(y)[0] if own is None else own if own.ndim == 2 else own[int(history.index[row])]
        (v,), (V_y,) = sensor.invert(y)
        p, _, P_v = FRAMES[len(at)].from_frame(at, v)
        J = P_v @ V_y
        yield str(history.landmark[row]), p, J @ R @ J.T


def _vertices(chain: Chain, nodes: dict[int, Array], robots: Mapping[str, Robot]) -> Iterator[str]:
    """Yield the poses; those before the first scan are the starts."""
    first: dict[str, int] = {}
    for k, node in enumerate(chain.nodes):
        first.setdefault(node.robot, k)
        pose = nodes.get(k, np.array(robots[node.robot].start))
        yield _line("VERTEX_SE2" if len(pose) == 3 else "VERTEX_SE3:QUAT", [k], pose)
    yield from (f"FIX {k}" for k in list(first.values())[:1])
    if any(len(robot.start) == 7 for robot in robots.values()):
        yield "PARAMS_SE3OFFSET 0 0 0 0 0 0 0 1"


def _landmarks(number: dict[str, int], known: dict[str, Array], d: int) -> Iterator[str]:
    for name, k in number.items():
        yield f"# landmark {k} is {name}"
        yield _line("VERTEX_XY" if d == 2 else "VERTEX_TRACKXYZ", [k], known[name])


def _moves(chain: Chain) -> Iterator[str]:
    """Yield the edges of the motion, with the covariances of errors in the frame where they end."""
    for k, node in enumerate(chain.nodes):
        if node.previous < 0:
            continue
        C = node.Q.sum(axis=0) + sum((S @ S.T for at, _, S in chain.shared if at == k), np.zeros_like(node.Q[0]))
        if len(node.step) == 3:
            c, s = np.cos(node.step[2]), np.sin(node.step[2])
            J = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        else:
            R, J = matrix(node.step[3:].copy()), np.zeros((6, 6))
            J[:3, :3], J[3:, 3:] = R.T, R.T / 2  # of a turn g2o takes the vector part of a quaternion
        tag = "EDGE_SE2" if len(node.step) == 3 else "EDGE_SE3:QUAT"
        yield _line(tag, [node.previous, k], node.step, J @ C @ J.T)


def _line(tag: str, ids: list[int], values: Array, C: Array | None = None) -> str:
    numbers = [*values]
    if C is not None:
        H = np.linalg.inv((C + C.T) / 2 + LEAST * np.eye(len(C)))
        numbers += [*((H + H.T) / 2)[np.triu_indices(len(C))]]
    return " ".join([tag, *map(str, ids), *(repr(float(value)) for value in numbers)])
