"""Read logs of a stereo camera with the rates of its motion: "Starry Night", and tracked features of a KITTI drive.

Starry Night (T. Barfoot, University of Toronto) is moved by hand above 20 reflectors.  The vehicle's x axis points back
and its z axis down: the mount, which the log describes, takes care of it.  KITTI's rates are of its inertial unit.
"""

from __future__ import annotations

import zipfile
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np

from kalmark.arrays import Array
from kalmark.datasets.array_files import arrays, events_of, find_variables, refuse_shapes, times
from kalmark.declare import Number
from kalmark.errors import LogError
from kalmark.files import read_arrays
from kalmark.geometry.named_poses import describe_pose
from kalmark.logs.log import Log, Section, Trajectory
from kalmark.logs.source import Format, Request, frame, one_robot
from kalmark.logs.table_columns import TWIST3

SENSOR = "stereo"
PIXELS = ("ul_px", "vl_px", "ur_px", "vr_px")
SIGMAS_OF_KITTI = (0.3, 0.3, 0.3, 0.05, 0.05, 0.05)  # of the rates

FILE = "vincentive_dataset3.mat"
STARRY = (
    "t", "w_vk_vk_i", "v_vk_vk_i", "y_k_j", "rho_i_pj_i", "theta_vk_i", "r_i_vk_i",
    "C_c_v", "rho_v_c_v", "fu", "fv", "cu", "cv", "b", "w_var", "v_var", "y_var",
)  # fmt: skip
KITTI = ("features", "time_stamps", "linear_velocity", "rotational_velocity", "K", "b", "cam_T_imu")


def robot_section(camera: tuple[Any, ...], size: tuple[int, int], pixels: Any, mount: Array, rates: Any) -> Section:
    """Return the section of a robot: `camera` has fx, fy, cx, cy and the baseline, `pixels` and `rates` the sigmas."""
    names = ("fx_px", "fy_px", "cx_px", "cy_px", "baseline_m")
    stereo = {"type": "stereo"} | dict(zip(names, map(float, camera), strict=True))
    stereo |= dict(zip(("width_px", "height_px"), size, strict=True))
    stereo |= {f"sigma_{name}": float(sigma) for name, sigma in zip(PIXELS, pixels, strict=True)}
    motion = {f"sigma_{name}": float(sigma) for name, sigma in zip(TWIST3, rates, strict=True)}
    return {"motion": {"type": "velocity_3d"} | motion, "sensors": {SENSOR: stereo | {"mount": describe_pose(mount)}}}


def log_of_features(
    format: str, path: Path, request: Request, robot: str, t_ns: Any, u: Array, y: Array, seen: Any, section: Any,
    first: int = 0, **rest: Any
) -> Log:  # fmt: skip
    """Return the log of features y (4, M, N), observed where `seen` (M, N); their ids count from `first`."""
    each = ((y[:, ids, k].T, (ids + first).tolist()) for k, ids in enumerate(map(np.flatnonzero, seen.T)))
    rig = {"robots": {robot: section}, "landmarks": {"type": "point"}}
    events = events_of(robot, SENSOR, t_ns, u, each)
    return one_robot(format, path, request, robot, events, TWIST3, {SENSOR: PIXELS}, describes=rig, **rest)


def read_starry_night(path: Path, request: Request) -> Log:
    """Return the log.  The rates at t act from t on and the scan at t is of the same instant; -1 is "not seen".

    Barfoot's C_vi = C(theta) maps the world to the vehicle, so theta is the rotation vector of ours, local to global,
    and his C_{k+1} = C(w dt) C_k is R_{k+1} = R_k Exp(w dt): rates and poses need no change.
    """
    from scipy.spatial.transform import Rotation

    data = arrays(path, STARRY)
    steps, landmarks = data["t"].size, data["rho_i_pj_i"].shape[-1]
    shapes: dict[str, tuple[int, ...]] = dict.fromkeys(("w_vk_vk_i", "v_vk_vk_i", "theta_vk_i", "r_i_vk_i"), (3, steps))
    shapes |= {"y_k_j": (4, steps, landmarks), "rho_i_pj_i": (3, landmarks), "C_c_v": (3, 3), "rho_v_c_v": (3, 1)}
    shapes |= {"w_var": (3, 1), "v_var": (3, 1), "y_var": (4, 1)} | dict.fromkeys(("fu", "fv", "cu", "cv"), (1, 1))
    refuse_shapes(path, data, shapes)
    t_ns = times(path, data["t"], "t of step {row} is not after that of step {before}, expected increasing times")
    turns = Rotation.from_rotvec(data["theta_vk_i"].T).as_quat()
    camera = tuple(data[name].item() for name in ("fu", "fv", "cu", "cv", "b"))
    mount, sigmas = frame(data["rho_v_c_v"], data["C_c_v"].T), np.vstack([data["v_var"], data["w_var"]])
    section = robot_section(camera, (640, 480), np.sqrt(data["y_var"].reshape(-1)), mount, np.sqrt(sigmas.reshape(-1)))
    u, y = np.vstack([data["v_vk_vk_i"], data["w_vk_vk_i"]]).T, data["y_k_j"].swapaxes(1, 2)
    return log_of_features(
        "starry_night", path, request, "robot", t_ns, u, y, (y >= 0).all(axis=0), section, 1,
        truth={"robot": Trajectory(t_ns, np.column_stack([data["r_i_vk_i"].T, turns]))},
        landmarks={i + 1: position for i, position in enumerate(data["rho_i_pj_i"].T)},
    )  # fmt: skip


def find_kitti(path: Path) -> Path | None:
    """Return the file, given it or a folder that has one such file."""
    if path.is_dir():
        inside = [file for file in path.glob("*.npz") if find_kitti(file)]
        return inside[0] if len(inside) == 1 else None
    try:
        with np.load(path) as file:
            return path if path.suffix == ".npz" and set(KITTI) <= set(file.files) else None
    except (OSError, ValueError, EOFError, AttributeError, zipfile.BadZipFile):
        return None


def read_kitti(
    path: Path,
    request: Request,
    min_disparity_px: Annotated[Number, "Drop observations with a smaller disparity; negative: none."] = 1.0,
    rates: Annotated[Literal["mean", "held"], "Hold the mean of two rates between them, or the first."] = "mean",
) -> Log:
    """Return the log; observations with a disparity below `min_disparity_px` are left out and counted.

    The rates are instantaneous: `rates="mean"` holds from t_k on the mean of those at t_k and t_{k+1}, `"held"` those
    at t_k alone.  The translation in `cam_T_imu` is the camera's position in the frame of the inertial unit, as KITTI's
    own calibration confirms: p_c = R (p_i - t), not R p_i + t.
    """
    found = read_arrays(path, LogError)
    data = {name: np.asarray(found[name], dtype=np.float64) for name in KITTI}
    y, steps, K, T = data["features"], data["time_stamps"].size, data["K"], data["cam_T_imu"]
    velocities = dict.fromkeys(("linear_velocity", "rotational_velocity"), (3, steps))
    refuse_shapes(path, data, {"features": (4, y.shape[1] if y.ndim == 3 else 0, steps), **velocities,
                               "K": (3, 3), "cam_T_imu": (4, 4)})  # fmt: skip
    for name, array in data.items():
        if not np.isfinite(array).all():
            raise LogError(f"{path}: {name} holds a value that is not finite, expected finite numbers")
    t_ns = times(path, data["time_stamps"], "time of frame {row} is not after that of frame {before}")
    u = np.vstack([data["linear_velocity"], data["rotational_velocity"]]).T
    if rates == "mean":
        u[:-1] = 0.5 * (u[:-1] + u[1:])
    seen = (y != -1).all(axis=0)
    near = seen & (y[0] - y[2] >= min_disparity_px)
    if (left_out := int(np.count_nonzero(seen & ~near))) > 0:
        request.leave_out(left_out, f"{path}: {left_out} observations with a disparity below {min_disparity_px:g} px")
    camera = K[0, 0], K[1, 1], K[0, 2], K[1, 2], data["b"]
    mount = frame(T[:3, 3], T[:3, :3].T)
    section = robot_section(camera, (1242, 375), [0.5] * 4, mount, SIGMAS_OF_KITTI)
    return log_of_features(
        "kitti_stereo_features", path, request, "car", t_ns, u, y, near, section, name=f"kitti_{path.stem}"
    )


STARRY_NIGHT = Format("starry_night", f"{FILE} or its folder", partial(find_variables, FILE, STARRY), read_starry_night)
KITTI_STEREO = Format("kitti_stereo_features", "an .npz file with features, time_stamps, ... or its folder", find_kitti,
                      read_kitti)  # fmt: skip
