"""Read a recording of the Matlab SLAM toolbox: NAME.json.gz with its settings, controls and images, NAME.npz beside it.

The control that the toolbox's estimator was given and the pixels its simulator made become events; its settings
describe the robots, cameras and landmarks; its own error and consistency are the log's `reference`.
"""

from __future__ import annotations

import gzip
import json
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import chi2

from kalmark.errors import LogError
from kalmark.events import Control, Event, Id, Scan, order
from kalmark.logs.log import Array, Log, Trajectory
from kalmark.logs.slamtb_rig import WXYZ_TO_XYZW, Part, described, is_lines, parts
from kalmark.logs.source import Format, Request

NAME = "slamtb"
CONTROLS = {
    "odometry": ("dx_m", "dy_m", "dz_m", "rx_rad", "ry_rad", "rz_rad"),
    "constVel": ("dvx_mps", "dvy_mps", "dvz_mps", "dwx_radps", "dwy_radps", "dwz_radps"),
}
POINTS, SEGMENTS = ("u_px", "v_px"), ("u1_px", "v1_px", "u2_px", "v2_px")


def find(path: Path) -> Path | None:
    """Return the recording, if this is one."""
    if not path.is_file() or not path.name.endswith(".json.gz"):
        return None
    try:
        with gzip.open(path) as file:
            return path if file.read(8).startswith(b'{"cfg":') else None
    except (OSError, EOFError, zlib.error):
        return None


def read(path: Path, request: Request) -> Log:
    """Return the log.  Frame k is at k dt, its control before its scans; the robots start at 0.

    Raises LogError if the file is cut or something is missing in it.
    """
    try:
        with gzip.open(path, "rt", encoding="utf-8") as file:
            content = json.load(file)
    except (OSError, EOFError, ValueError, zlib.error) as error:
        raise LogError(f"{path}: cannot be read ({error}), expected a whole recording") from None
    try:
        return recording(path, content, request)
    except KeyError as error:
        raise LogError(f"{path}: no {error.args[0]!r} in it, expected a recording of the Matlab toolbox") from None
    except (TypeError, IndexError, ValueError) as error:
        raise LogError(f"{path}: {error}, expected a recording of the Matlab toolbox") from None


def recording(path: Path, content: dict[str, Any], request: Request) -> Log:
    """Return the log of a recording that has been parsed."""
    cfg = content["cfg"]
    lines = is_lines(cfg)
    robots = parts("robot", cfg["Robot"])
    step_ns = round(cfg["Time"]["dt"] * 1e9)
    events: list[Event] = [Control(t_ns=0, robot=robot.name, u=np.zeros(6), cov=np.zeros((6, 6)))
                           for robot in robots if robot.settings["motion"] == "constVel"]  # fmt: skip
    for frame in content["frames"]:
        events += frame_events(frame, frame["frame"] * step_ns, lines)
    seen = {(event.robot, event.sensor) for event in events if isinstance(event, Scan)}
    truth, reference = tracks(path, cfg, robots, step_ns)
    return Log(
        name=str(cfg["name"]),
        format=NAME,
        path=path,
        robots=tuple(robot.name for robot in robots),
        events=sorted(events, key=order),
        truth=truth,
        landmarks=true_landmarks(cfg["SimLmk"], lines),
        skipped=request.skipped,
        control_columns={robot.name: CONTROLS[robot.settings["motion"]] for robot in robots},
        sensor_columns=dict.fromkeys(sorted(seen), SEGMENTS if lines else POINTS),
        describes=described(cfg, robots) | {"association": {"type": "identity", "gate": gate(cfg)}},
        reference=reference,
    )


def frame_events(frame: dict[str, Any], t_ns: int, lines: bool) -> Iterator[Event]:
    """Yield the control of each robot in one frame, and what each of its sensors saw."""
    for robot in listed(frame["rob"]):
        name = f"robot{robot['rob']}"
        yield Control(t_ns=t_ns, robot=name, u=robot["u"])
        for sensor in listed(robot["sen"]):
            y, ids = observations(sensor, "seg" if lines else "pnt")
            yield Scan(t_ns=t_ns, robot=name, sensor=f"camera{sensor['sen']}", y=y, ids=ids)


def observations(sensor: dict[str, Any], kind: str) -> tuple[Array, list[int]]:
    """Return the pixels (K, 2|4) of the points or segments in one image, and their ids."""
    ids = np.atleast_1d(np.asarray(sensor[f"{kind}_ids"], dtype=np.int64)).tolist()
    size = 4 if kind == "seg" else 2
    return columns(sensor[kind], size), ids


def true_landmarks(simulated: dict[str, Any], lines: bool) -> dict[Id, Array]:
    """Return the true points (3,) or both ends of the true segments (6,), by id."""
    things = simulated["segments" if lines else "points"]
    ids = np.atleast_1d(np.asarray(things["id"], dtype=np.int64)).tolist()
    return dict(zip(ids, columns(things["coord"], 6 if lines else 3), strict=True))


def tracks(
    path: Path, cfg: dict[str, Any], robots: list[Part], step_ns: int
) -> tuple[dict[str, Trajectory], dict[str, dict[str, float]]]:
    """Return the true trajectories and the toolbox's own figures, from the file of numbers beside the recording."""
    numbers = path.with_name(path.name.removesuffix(".json.gz") + ".npz")
    if not numbers.is_file():
        return {}, {}
    try:
        with np.load(numbers) as file:
            truth, states, nees = file["TRUTH"], file["X"], file["NEES"].ravel()
    except Exception as error:  # the reader has no common error for damaged files
        raise LogError(f"{numbers}: cannot be read ({error}), expected TRUTH, X and NEES") from None
    frames = truth.shape[1]
    t_ns = np.arange(frames + 1, dtype=np.int64) * step_ns
    paths, errors = {}, []
    for robot, start, state in zip(robots, listed_rows(cfg["RobX0"]), listed_rows(cfg["RobRange"]), strict=True):
        at = 13 * robot.index
        poses = np.column_stack([start[:7], truth[at : at + 7]]).T
        poses[:, 3:] /= np.linalg.norm(poses[:, 3:], axis=1)[:, None]
        paths[robot.name] = Trajectory(t_ns, poses[:, WXYZ_TO_XYZW])
        estimate = states[state[:3].astype(int) - 1]
        errors.append(np.sum((truth[at : at + 3] - estimate) ** 2, axis=0))
    figures = {"ate_raw_m": float(np.sqrt(np.mean(errors))), "pose_nees": float(np.nanmean(nees))}
    return paths, {NAME: figures | {"pose_nees_median": float(np.nanmedian(nees))}}


def gate(cfg: dict[str, Any]) -> float:
    """Return the probability inside the toolbox's gate on the squared Mahalanobis distance, of 2 numbers."""
    return float(chi2.cdf(cfg["Opt"]["correct"]["MD2th"], 2))


def columns(matrix: Any, rows: int) -> Array:
    """Return a recorded matrix (rows, K) as (K, rows); the recording has [] for K = 0 and a flat list for K = 1."""
    return np.asarray(matrix, dtype=np.float64).reshape(rows, -1).T


def listed(value: Any) -> list[Any]:
    """Return a list; the recording may have its only element bare."""
    return value if isinstance(value, list) else [value]


def listed_rows(value: Any) -> list[Array]:
    """Return a list of vectors; the recording may have the only one bare."""
    return list(np.atleast_2d(np.asarray(value, dtype=np.float64)))


SLAMTB = Format(NAME, "a recording NAME.json.gz of the Matlab toolbox", find, read)
