"""Read a graph of poses and landmarks as g2o writes it: the chain of its odometry, and the observations of landmarks.

======================  =====================================================  =====================================
line                    numbers                                                in the log
======================  =====================================================  =====================================
`VERTEX_SE2`            id x y theta                                           a pose; with `vertices: truth` true
`VERTEX_SE3:QUAT`       id x y z qx qy qz qw                                   the same in space
`VERTEX_XY`             id x y                                                 a landmark; the same
`VERTEX_TRACKXYZ`       id x y z                                               the same in space
`EDGE_SE2`              i j dx dy dtheta, 6 of information                     the increment to the next pose; a loop
`EDGE_SE3:QUAT`         i j x y z qx qy qz qw, 21 of information               the same in space
`EDGE_SE2_XY`           i l x y, 3 of information                              an observation, x and y in pose i
`EDGE_SE3_TRACKXYZ`     i l p x y z, 6 of information                          the same in space, sensor offset p
`EDGE_BEARING_SE2_XY`   i l bearing, 1 of information                          a bearing in pose i
`PARAMS_SE3OFFSET`      p x y z qx qy qz qw                                    the mount of the sensor
======================  =====================================================  =====================================

Poses have no times: in the order of their ids they are one second apart.  An edge between poses that do not follow each
other, a loop that something else has closed, is a reading of an `odometer` at the later one, of the way from the other.

TORO's `VERTEX2` and `EDGE2` (.graph, .toro) are those of the plane with the information in another order: xx, xy, yy,
tt, xt, yt.

Information matrices are upper triangles.  g2o's errors of an edge are in the frame where it ends, and those of a turn
in space the vector part of a quaternion, half an angle (`EdgeSE3::computeError`).  So the covariance of an increment u
is J C J^T, J = [R(u) 0; 0 1] in the plane, [R(u) 0; 0 2 Jr(u)^-1] in space, with the right Jacobian Jr of its rotation.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np

from kalmark.arrays import Array
from kalmark.datasets.text_logs import STEP_NS
from kalmark.errors import LogError
from kalmark.events import Control, Event, Id, Scan, short_text, unit_quaternion
from kalmark.geometry import frames, frames3d
from kalmark.geometry.named_poses import describe_pose
from kalmark.geometry.rotations import left_jacobian_inverse, log, matrix, skew
from kalmark.logs.known_map import from_triangle
from kalmark.logs.log import LandmarkPlaces, Log, Section, Trajectory
from kalmark.logs.source import (
    Format,
    Request,
    landmark_id,
    number_of_text,
    one_robot,
    reason_of,
    text_rows,
)
from kalmark.logs.table_columns import BEAM, INCREMENT2, INCREMENT3, POSITION

ROBOT, SENSOR, LOOPS = "robot", "sensor", "loops"
BEARINGS, BEARING = "bearings", "EDGE_BEARING_SE2_XY"
TORO = {"VERTEX2": "VERTEX_SE2", "EDGE2": "EDGE_SE2"}
TORO_ORDER = (0, 1, 4, 2, 5, 3)  # where TORO has xx, xy, xt, yy, yt, tt
POSES = {"VERTEX_SE2": 3, "VERTEX_SE3:QUAT": 7}
PLACES = {"VERTEX_XY": 2, "VERTEX_TRACKXYZ": 3}
EDGES = {"EDGE_SE2": (3, 3), "EDGE_SE3:QUAT": (7, 6)}  # numbers, and the size of their information
SIGHTS = {"EDGE_SE2_XY": 2, "EDGE_SE3_TRACKXYZ": 3, BEARING: 1}
OFFSET = "PARAMS_SE3OFFSET"
IGNORED = ("FIX",)
TAGS = (*POSES, *PLACES, *EDGES, *SIGHTS, OFFSET, *IGNORED)


@dataclass
class Graph:
    """Content of a file: poses, places and edges, by ids."""

    poses: dict[int, Array] = field(default_factory=dict)
    places: LandmarkPlaces = field(default_factory=dict)
    moves: dict[tuple[int, int], tuple[Array, Array]] = field(default_factory=dict)
    sights: dict[tuple[str, int], list[tuple[Id, Array, Array]]] = field(default_factory=dict)
    offset: Array | None = None
    left_out: Counter[str] = field(default_factory=Counter)


def information(cells: list[str], size: int) -> Array:
    """Return the covariance (size, size) whose inverse has this upper triangle.  Raises ValueError."""
    if len(cells) != size * (size + 1) // 2:
        raise ValueError(f"{len(cells)} numbers of information, expected {size * (size + 1) // 2}")
    H = from_triangle([number_of_text(cell) for cell in cells])
    np.linalg.cholesky(H)  # its LinAlgError is a ValueError
    C = np.linalg.inv(H)
    return np.asarray((C + C.T) / 2)


def pose(cells: list[str], size: int) -> Array:
    """Return a pose (3,) or (7,), its quaternion normalised.  Raises ValueError."""
    if len(cells) != size:
        raise ValueError(f"{len(cells)} numbers of a pose, expected {size}")
    values = np.array([number_of_text(cell) for cell in cells])
    if len(values) == 7:
        values[3:] = unit_quaternion(values[3:], ValueError)
    return values


def pose_id(text: str) -> int:
    """Return the id of a pose, by which they are in order.  Raises ValueError."""
    found = landmark_id(text)
    if not isinstance(found, int):
        raise ValueError(f"id {short_text(text)} of a pose, expected a whole number")
    return found


def increment_of_edge(step: Array, C: Array) -> tuple[Array, Array]:
    """Return the increment of an edge (3,) or (7,), and its covariance from that of the edge's errors."""
    if len(step) == 3:
        c, s = np.cos(step[2]), np.sin(step[2])
        J = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        return step, J @ C @ J.T
    turn, J = log(step[3:].copy()), np.zeros((6, 6))
    J[:3, :3], J[3:, 3:] = matrix(step[3:].copy()), 2 * left_jacobian_inverse(-turn)
    return np.append(step[:3], turn), J @ C @ J.T


def turned_round(step: Array, C: Array) -> tuple[Array, Array]:
    """Return the edge (3,) or (7,) from its end to its beginning, and the covariance J C J^T of its errors there.

    J = -Ad(Z): (Z o d)^-1 = Z^-1 o (Z o d^-1 o Z^-1).
    """
    if len(step) == 3:
        (x, y, a), back = step, frames.inverse(step)[0]
        J = -np.array([[np.cos(a), -np.sin(a), y], [np.sin(a), np.cos(a), -x], [0.0, 0.0, 1.0]])
        return back, J @ C @ J.T
    R, J = matrix(step[3:].copy()), np.zeros((6, 6))
    J[:3, :3], J[:3, 3:], J[3:, 3:] = -R, -2.0 * skew(step[:3]) @ R, -R
    return frames3d.inverse(step)[0], J @ C @ J.T


def take(graph: Graph, tag: str, cells: list[str]) -> None:
    """Take one line.  Raises ValueError."""
    if tag == "EDGE2" and len(cells) == 11:
        cells = [*cells[:5], *(cells[5 + k] for k in TORO_ORDER)]
    tag = TORO.get(tag, tag)
    if tag in POSES or tag in PLACES:
        size = POSES.get(tag) or PLACES[tag]
        if len(cells) != size + 1:
            raise ValueError(f"{len(cells)} cells, expected an id and {size} numbers")
        if tag in POSES:
            graph.poses[pose_id(cells[0])] = pose(cells[1:], size)
        else:
            graph.places[landmark_id(cells[0])] = np.array([number_of_text(cell) for cell in cells[1:]])
    elif tag in EDGES:
        _take_edge(graph, tag, cells)
    elif tag in SIGHTS:
        size, first = SIGHTS[tag], 3 if tag == "EDGE_SE3_TRACKXYZ" else 2
        y = np.array([number_of_text(cell) for cell in cells[first : first + size]])
        C = information(cells[first + size :], size)
        if len(y) != size:
            raise ValueError(f"{len(cells)} cells, expected {first} ids, {size} numbers and their information")
        key = BEARINGS if tag == BEARING else SENSOR, pose_id(cells[0])
        graph.sights.setdefault(key, []).append((landmark_id(cells[1]), y, C))
    elif tag == OFFSET:
        offset = pose(cells[1:], 7)
        if graph.offset is not None and not np.array_equal(graph.offset, offset):
            raise ValueError("a second offset, expected one sensor")
        graph.offset = offset
    elif tag not in IGNORED:
        graph.left_out[f"{tag} lines, which are not read"] += 1


def _take_edge(graph: Graph, tag: str, cells: list[str]) -> None:
    """Take an edge between poses, from the one of the smaller id.  Raises ValueError."""
    size, errors = EDGES[tag]
    a, b = map(pose_id, cells[:2])
    step, C = pose(cells[2 : 2 + size], size), information(cells[2 + size :], errors)
    if a == b:
        raise ValueError(f"an edge from pose {a} to itself")
    if a > b:
        (a, b), (step, C) = (b, a), turned_round(step, C)
    if (a, b) in graph.moves:
        graph.left_out[f"{tag} lines of a pair of poses that has one already"] += 1
    graph.moves.setdefault((a, b), increment_of_edge(step, C))


def read(
    path: Path,
    request: Request,
    vertices: Annotated[
        Literal["none", "truth"], "`truth` takes the vertices as true poses and landmarks; else they are not used."
    ] = "none",
) -> Log:
    """Return the log."""
    graph = Graph()
    for line, (tag, *cells) in text_rows(path):
        try:
            take(graph, tag, cells)
        except (ValueError, IndexError) as error:
            request.refuse(f"{path}:{line}: {tag}: {reason_of(error)}, expected {WHAT}")
    ids = sorted({*graph.poses, *(at for _, at in graph.sights), *(one for pair in graph.moves for one in pair)})
    for reason, count in sorted(graph.left_out.items()):
        request.leave_out(count, f"{path}: {count} {reason}")
    return _log(path, request, graph, ids, vertices == "truth")


def _log(path: Path, request: Request, graph: Graph, ids: list[int], true: bool) -> Log:
    """Return the log of a graph whose poses have these ids, in order."""
    space = any(len(u) == 6 for u, _ in graph.moves.values()) or any(len(p) == 7 for p in graph.poses.values())
    size = 6 if space else 3
    t_ns = {one: k * STEP_NS for k, one in enumerate(ids)}
    if any(len(u) != size for u, _ in graph.moves.values()):
        raise LogError(f"{path}: edges of the plane and of space, expected one kind")
    events: list[Event] = []
    for a, b in pairwise(ids):
        if (a, b) not in graph.moves:
            raise LogError(f"{path}: no edge from pose {a} to pose {b}, expected one from each pose to the next")
        u, C = graph.moves[a, b]
        events.append(Control(t_ns=t_ns[b], robot=ROBOT, u=u, cov=C))
    scans = [*_loops(graph, ids, t_ns), *_sights(path, request, graph, t_ns, space)]
    steps = INCREMENT3 if space else INCREMENT2
    columns = {SENSOR: POSITION[: 3 if space else 2], BEARINGS: BEAM[1:], LOOPS: steps}
    sections: dict[str, Section] = {
        SENSOR: {"type": "position_3d" if space else "position"},
        BEARINGS: {"type": "bearing", "initialization": {"type": "delayed"}},
        LOOPS: {"type": "odometer", "keep": 0},
    }
    if graph.offset is not None:
        sections[SENSOR]["mount"] = describe_pose(graph.offset)
    for name in {*columns} - {scan.sensor for scan in scans}:
        del columns[name], sections[name]
    told = {"motion": {"type": "odometry_3d" if space else "odometry_2d"}, "sensors": sections}
    rest: dict[str, Any] = {"describes": {"robots": {ROBOT: told}}, "name": path.stem}
    if true and graph.poses:
        path_ = Trajectory.of({t_ns[one]: graph.poses[one] for one in sorted(graph.poses)})
        rest |= {"truth": {ROBOT: path_}, "landmarks": graph.places}
    return one_robot("g2o", path, request, ROBOT, [*events, *scans], steps, columns, **rest)


def _sights(path: Path, request: Request, graph: Graph, t_ns: dict[int, int], space: bool) -> Iterator[Scan]:
    """Yield the observations of landmarks, of each landmark one at a pose.  Raises LogError."""
    for (name, at), seen in graph.sights.items():
        first = {one: (y, C) for one, y, C in reversed(seen)}
        if len(first) < len(seen):
            twice = len(seen) - len(first)
            request.leave_out(twice, f"{path}: {twice} observations of a landmark that pose {at} has already")
        y, cov = zip(*first.values(), strict=True)
        if {*map(len, y)} != {3 if space else 1 if name == BEARINGS else 2}:
            world = "space" if space else "the plane"
            raise LogError(f"{path}: pose {at} has observations of another world, expected those of {world}")
        yield Scan(t_ns=t_ns[at], robot=ROBOT, sensor=name, y=y, ids=[*first], cov=cov)


def _loops(graph: Graph, ids: list[int], t_ns: dict[int, int]) -> list[Scan]:
    """Return the edges between poses that do not follow each other as readings; if any, a scan at each pose."""
    rows: dict[int, list[int]] = {one: [] for one in ids}
    for a, b in sorted({*graph.moves} - {*pairwise(ids)}):
        rows[b].append(a)
    scans = list[Scan]()
    for b, begins in rows.items() if any(rows.values()) else ():
        y, cov = [[graph.moves[a, b][k] for a in begins] for k in (0, 1)]
        times = [t_ns[a] // STEP_NS for a in begins]
        scans.append(Scan(t_ns=t_ns[b], robot=ROBOT, sensor=LOOPS, y=y, ids=times, cov=cov if begins else None))
    return scans


def find(path: Path) -> Path | None:
    """Return the file if it is one of g2o or TORO: by its ending."""
    return path if path.is_file() and path.suffix in (".g2o", ".graph", ".toro") else None


WHAT = "a line of g2o with poses, landmarks or edges between them, information matrices positive definite"
G2O = Format(
    "g2o",
    "a graph of poses and landmarks, .g2o; of TORO .graph, .toro",
    find,
    read,
    describes_all=True,
)
