"""Read a recording of the Matlab SLAM toolbox: NAME.json.gz with its settings, controls and images, NAME.npz beside it.

The control that the toolbox's estimator was given and the pixels its simulator made become events; its settings
describe the robots, cameras and landmarks; its own error and consistency are the log's `reference`.
"""

from __future__ import annotations

import gzip
import json
import math
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from kalmark.arrays import Array
from kalmark.errors import LogError
from kalmark.events import Control, Event, Scan, sort_key
from kalmark.files import read_arrays, unpack_file
from kalmark.geometry.gaussian import sigma_probability
from kalmark.geometry.named_poses import describe_pose
from kalmark.logs.log import Log, Section, Trajectory
from kalmark.logs.source import Format, Request
from kalmark.logs.table_columns import CORNERS, INCREMENT3, TWIST3

NAME = "slamtb"
CONTROLS = {
    "odometry": INCREMENT3,
    "constVel": tuple(f"d{name}" for name in TWIST3),
}
WXYZ_TO_XYZW = [0, 1, 2, 4, 5, 6, 3]
LANDMARKS = {
    "eucPnt": "point", "idpPnt": "inverse_depth", "ahmPnt": "anchored_homogeneous", "hmgPnt": "homogeneous",
    "plkLin": "pluecker_line", "aplLin": "anchored_pluecker_line", "idpLin": "inverse_depth_line",
    "ahmLin": "anchored_homogeneous_line", "hmgLin": "homogeneous_line",
}  # fmt: skip
PLUECKER = ("plkLin", "aplLin")
BORDER = 25.0  # no landmark starts nearer to the image's border than its width / 25
POINTS, SEGMENTS = ("u_px", "v_px"), CORNERS[:4]


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
        content = json.loads(b"".join(unpack_file(path, LogError)))
    except ValueError as error:
        raise LogError(f"{path}: cannot be read ({error}), expected a whole recording") from None
    try:
        return log_of_recording(path, content, request)
    except KeyError as error:
        raise LogError(f"{path}: no {error.args[0]!r} in it, expected a recording of the Matlab toolbox") from None
    except (TypeError, IndexError, ValueError) as error:
        raise LogError(f"{path}: {error}, expected a recording of the Matlab toolbox") from None


def log_of_recording(path: Path, content: Section, request: Request) -> Log:
    """Return the log of a recording that has been parsed."""
    cfg, lines = content["cfg"], is_lines(content["cfg"])
    robots = parts("robot", cfg["Robot"])
    step_ns = round(cfg["Time"]["dt"] * 1e9)
    events: list[Event] = [Control(t_ns=0, robot=robot.name, u=np.zeros(6), cov=np.zeros((6, 6)))
                           for robot in robots if robot.settings["motion"] == "constVel"]  # fmt: skip
    for frame in content["frames"]:
        events += frame_events(frame, frame["frame"] * step_ns, lines)
    seen = {(event.robot, event.sensor) for event in events if isinstance(event, Scan)}
    truth, reference = tracks(path, cfg, robots, step_ns)
    things = cfg["SimLmk"]["segments" if lines else "points"]  # points (3,) or both ends of segments (6,)
    gate = sigma_probability(math.sqrt(cfg["Opt"]["correct"]["MD2th"]), 2)  # the toolbox's is on d^2 of two numbers
    return Log(
        str(cfg["name"]), tuple(robot.name for robot in robots), sorted(events, key=sort_key), NAME, path, truth,
        landmarks=dict(zip(*ids_and_columns(things["id"], things["coord"], 6 if lines else 3), strict=True)),
        skipped=request.skipped, reference=reference,
        control_columns={robot.name: CONTROLS[robot.settings["motion"]] for robot in robots},
        sensor_columns=dict.fromkeys(sorted(seen), SEGMENTS if lines else POINTS),
        describes=configuration(cfg, robots) | {"association": {"type": "identity", "gate": gate}},
    )  # fmt: skip


def frame_events(frame: Section, t_ns: int, lines: bool) -> Iterator[Event]:
    """Yield the control of each robot in one frame, and what each of its sensors saw."""
    for robot in as_list(frame["rob"]):
        name = f"robot{robot['rob']}"
        yield Control(t_ns=t_ns, robot=name, u=robot["u"])
        for sensor in as_list(robot["sen"]):
            kind, size = ("seg", 4) if lines else ("pnt", 2)
            ids, y = ids_and_columns(sensor[f"{kind}_ids"], sensor[kind], size)
            yield Scan(t_ns=t_ns, robot=name, sensor=f"camera{sensor['sen']}", y=y, ids=ids)


def ids_and_columns(ids: Any, matrix: Any, size: int) -> tuple[list[int], Array]:
    """Return K ids and the columns of a recorded matrix (size, K) as (K, size).

    The recording has a bare number and a flat list for K = 1, [] for K = 0.
    """
    rows = np.asarray(matrix, dtype=np.float64).reshape(size, -1).T
    return np.atleast_1d(np.asarray(ids, dtype=np.int64)).tolist(), rows


def tracks(
    path: Path, cfg: Section, robots: list[Part], step_ns: int
) -> tuple[dict[str, Trajectory], dict[str, dict[str, float]]]:
    """Return the true trajectories and the toolbox's own figures, from the file of numbers beside the recording."""
    numbers = path.with_name(path.name.removesuffix(".json.gz") + ".npz")
    if not numbers.is_file():
        return {}, {}
    try:
        arrays = read_arrays(numbers, LogError)
        truth, states, nees = arrays["TRUTH"], arrays["X"], arrays["NEES"].ravel()
    except (OSError, ValueError, KeyError) as error:
        raise LogError(f"{numbers}: cannot be read ({error}), expected TRUTH, X and NEES") from None
    frames = truth.shape[1]
    t_ns = np.arange(frames + 1, dtype=np.int64) * step_ns
    paths, errors = {}, []
    starts = (np.atleast_2d(np.asarray(cfg[key], dtype=np.float64)) for key in ("RobX0", "RobRange"))
    for robot, start, state in zip(robots, *starts, strict=True):
        at = 13 * robot.index
        poses = np.column_stack([start[:7], truth[at : at + 7]]).T
        poses[:, 3:] /= np.linalg.norm(poses[:, 3:], axis=1)[:, None]
        paths[robot.name] = Trajectory(t_ns, poses[:, WXYZ_TO_XYZW])
        estimate = states[state[:3].astype(int) - 1]
        errors.append(np.sum((truth[at : at + 3] - estimate) ** 2, axis=0))
    figures = {"ate_raw_m": float(np.sqrt(np.mean(errors))), "pose_nees": float(np.nanmean(nees))}
    return paths, {NAME: figures | {"pose_nees_median": float(np.nanmedian(nees))}}


def as_list(value: Any) -> list[Any]:
    """Return a list; the recording may have its only element bare."""
    return value if isinstance(value, list) else [value]


# ------------------------------------------------------------------ the settings in the words of a configuration
@dataclass(frozen=True)
class Part:
    """Hold the settings of a robot or sensor, its name here and its index in the recording, from 0."""

    name: str
    index: int
    settings: Section


def parts(word: str, settings: Any) -> list[Part]:
    """Return the robots or sensors of a recording, named by their numbers: robot1, robot2, ..."""
    return [Part(f"{word}{i + 1}", i, one) for i, one in enumerate(as_list(settings))]


def is_lines(cfg: Section) -> bool:
    """Return whether the recording maps lines, not points."""
    return str(cfg["Opt"]["init"]["initType"]).endswith("Lin")


def configuration(cfg: Section, robots: list[Part]) -> Section:
    """Return the configuration with which kalmark repeats a recording, its landmark type included."""
    opt, ends = cfg["Opt"], {}
    if is_lines(cfg):  # what becomes of the segment that is kept beside a line
        lines = opt["correct"]["lines"]
        ends = {"extend": bool(lines["extPolicy"]), "switch_px": float(lines["extSwitch"])}
    return {
        "robots": {robot.name: described_robot(cfg, robot) for robot in robots},
        "landmarks": landmark_type(opt["init"]) | ends,
        "map": {"reparametrize": float(opt["correct"]["linTestIdp"]) if opt["correct"]["reparametrize"] else "off"},
    }


def landmark_type(init: Section) -> Section:
    """Return the landmark type of a recording, with the prior of the numbers that one image does not determine."""
    kind = init["initType"]
    prior = init["plkLin" if kind in PLUECKER else "idpPnt"]
    mean, sigma = as_vector(prior["nonObsMean"]), as_vector(prior["nonObsStd"])
    section: Section = {"type": LANDMARKS[kind]}
    if kind in PLUECKER:
        names = ("prior_beta_1", "prior_beta_2", "sigma_beta_1", "sigma_beta_2")
        return section | dict(zip(names, mean + sigma, strict=True))
    return section if kind == "eucPnt" else section | {"prior_rho_per_m": mean[0], "sigma_rho_per_m": sigma[0]}


def described_robot(cfg: Section, robot: Part) -> Section:
    """Return the section of one robot."""
    sensors = [one for one in parts("camera", cfg["Sensor"]) if one.settings["robot"] == robot.index + 1]
    return {
        "motion": motion(robot.settings["motion"], np.array(cfg["RobU"][robot.index])),
        "start": start_section(robot.settings, np.array(cfg["RobX0"][robot.index], dtype=np.float64)),
        "sensors": {sensor.name: camera_section(cfg, sensor) for sensor in sensors},
    }


def motion(kind: str, noise: Array) -> Section:
    """Return the motion model; `noise` (6, 6) is the covariance of one control."""
    sigmas = np.sqrt(np.diag(noise)).tolist()
    turn = root_mean_square(sigmas[3:])
    if kind == "constVel":
        return {"type": "constant_velocity_3d", "sigma_v_mps": root_mean_square(sigmas[:3]), "sigma_w_radps": turn}
    along = dict(zip(("sigma_x_m", "sigma_y_m", "sigma_z_m"), sigmas, strict=False))
    return {"type": "odometry_3d", **along, "sigma_rotation_rad": turn}


def start_section(settings: Section, state: Array) -> Section:
    """Return the start of a robot; standard deviations of roll, pitch and yaw are taken about x, y and z."""
    section: Section = describe_pose(state[WXYZ_TO_XYZW]) | {
        "sigma_position_m": as_vector(settings["positionStd"]),
        "sigma_rotation_deg": as_vector(settings["orientationStd"]),
    }
    if len(state) == 13:
        section |= dict(zip(TWIST3, state[7:].tolist(), strict=True))
        section |= {"sigma_v_mps": as_vector(settings["velStd"])}
        section |= {"sigma_w_radps": np.radians(settings["angVelStd"]).tolist()}
    return section


def camera_section(cfg: Section, sensor: Part) -> Section:
    """Return the section of one camera: its model, mount, and which landmarks of an image it takes."""
    settings, opt = sensor.settings, cfg["Opt"]
    width, height = settings["imageSize"]
    k = np.asarray(settings["intrinsic"], dtype=np.float64).tolist()
    section: Section = {"type": "pinhole", "cx_px": k[0], "cy_px": k[1]}
    if settings["type"] == "omniCam":
        section |= {"type": "omnidirectional", "c": k[2], "d": k[3], "e": k[4]}
        section["projection"] = as_vector(settings["distortion"])
        section["back_projection"] = as_vector(settings["invDistortion"])
    else:
        section |= {"fx_px": k[2], "fy_px": k[3]}
        if is_lines(cfg):
            section |= {"type": "segments", "min_length_px": float(opt["obs"]["lines"]["minLength"])}
        else:
            section |= {"lens": "radial", "distortion": as_vector(settings["distortion"])}
    section |= {"width_px": int(width), "height_px": int(height), "sigma_px": float(settings["pixErrorStd"])}
    mount: Section = describe_pose(np.array(cfg["SenFrame"][sensor.index], dtype=np.float64)[WXYZ_TO_XYZW])
    if settings["frameInMap"]:
        mount |= {"sigma_position_m": as_vector(settings["positionStd"])}
        mount |= {"sigma_rotation_deg": as_vector(settings["orientationStd"])}
    first, later = opt["init"]["nbrInits"]
    attention = {  # which landmarks of an image the toolbox corrects, starts and gives up
        "updates": int(opt["correct"]["nUpdates"]), "starts": int(later), "first_starts": int(first),
        "margin_px": 0.0 if is_lines(cfg) else float(width) / BORDER,
        "searches": 10, "match_ratio": 0.1, "inlier_ratio": 0.5, "delete": True,
    }  # fmt: skip
    return section | {"mount": mount, "attention": attention}


def as_vector(value: Any) -> list[float]:
    """Return a vector, which the recording has bare if it is of one element."""
    return np.atleast_1d(np.asarray(value, dtype=np.float64)).tolist()


def root_mean_square(sigmas: Any) -> float:
    """Return the standard deviation of an axis, if the three differ that of the mean variance."""
    return float(np.sqrt(np.mean(np.square(sigmas))))


SLAMTB = Format(NAME, "a recording NAME.json.gz of the Matlab toolbox", find, read)
