"""Read tracked stereo features of a KITTI drive, with the rates of its inertial unit, from one .npz file."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from kalmark.errors import LogError
from kalmark.events import Control, Event, Scan, order
from kalmark.logs.log import Array, Log
from kalmark.logs.rig import frame, placed
from kalmark.logs.source import Format, Request, choice, quantity

ROBOT, SENSOR = "car", "stereo"
NAMES = ("features", "time_stamps", "linear_velocity", "rotational_velocity", "K", "b", "cam_T_imu")
RATES = ("vx_mps", "vy_mps", "vz_mps", "wx_radps", "wy_radps", "wz_radps")
PIXELS = ("ul_px", "vl_px", "ur_px", "vr_px")
SIGMAS = (0.3, 0.3, 0.3, 0.05, 0.05, 0.05)  # of the rates
IMAGE = {"width_px": 1242, "height_px": 375} | {f"sigma_{name}": 0.5 for name in PIXELS}


def find(path: Path) -> Path | None:
    """Return the file, given it or a folder that has one such file."""
    if path.is_dir():
        inside = [file for file in path.glob("*.npz") if find(file)]
        return inside[0] if len(inside) == 1 else None
    try:
        with np.load(path) as file:
            return path if path.suffix == ".npz" and set(NAMES) <= set(file.files) else None
    except (OSError, ValueError, EOFError, AttributeError, zipfile.BadZipFile):
        return None


def read(path: Path, request: Request, min_disparity_px: Any = 1.0, rates: Any = "mean") -> Log:
    """Return the log; observations with a disparity below `min_disparity_px` are left out and counted.

    The rates are instantaneous: `rates="mean"` holds from t_k on the mean of those at t_k and t_{k+1}, `"held"` those
    at t_k alone.
    """
    low = quantity(min_disparity_px, "min_disparity_px")
    with np.load(path) as file:
        data = {name: np.asarray(file[name], dtype=np.float64) for name in NAMES}
    t_ns = checked_times(path, data)
    u = np.vstack([data["linear_velocity"], data["rotational_velocity"]]).T
    if choice(rates, "rates", ("mean", "held")) == "mean":
        u[:-1] = 0.5 * (u[:-1] + u[1:])
    seen = (data["features"] != -1).all(axis=0)
    near = seen & (data["features"][0] - data["features"][2] >= low)
    if (left_out := int(np.count_nonzero(seen & ~near))) > 0:
        request.leave_out(left_out, f"{path}: {left_out} observations with a disparity below {low:g} px")
    events: list[Event] = []
    for k, t in enumerate(t_ns.tolist()):
        ids = np.flatnonzero(near[:, k])
        events.append(Control(t_ns=t, robot=ROBOT, u=u[k]))
        events.append(Scan(t_ns=t, robot=ROBOT, sensor=SENSOR, y=data["features"][:, ids, k].T, ids=ids.tolist()))
    return Log(
        name=f"kitti_{path.stem}",
        format="kitti_stereo_features",
        path=path,
        robots=(ROBOT,),
        events=sorted(events, key=order),
        skipped=request.skipped,
        control_columns={ROBOT: RATES},
        sensor_columns={(ROBOT, SENSOR): PIXELS},
        describes={"robots": {ROBOT: car(data)}, "landmarks": {"type": "point"}},
    )


def checked_times(path: Path, data: dict[str, Array]) -> np.ndarray[Any, np.dtype[np.int64]]:
    """Return the times (N,) in ns.  Raises LogError if something is not finite, of another size or not in order."""
    times = data["time_stamps"].reshape(-1)
    features = data["features"].shape[1] if data["features"].ndim == 3 else 0
    wanted: dict[str, tuple[int, ...]] = {
        "features": (4, features, len(times)), "linear_velocity": (3, len(times)),
        "rotational_velocity": (3, len(times)), "K": (3, 3), "cam_T_imu": (4, 4),
    }  # fmt: skip
    for name, array in data.items():
        if array.shape != wanted.get(name, array.shape):
            raise LogError(f"{path}: {name} has shape {array.shape}, expected {wanted[name]}")
        if not np.isfinite(array).all():
            raise LogError(f"{path}: {name} holds a value that is not finite, expected finite numbers")
    if not (np.diff(times) > 0).all():
        frame_ = int(np.argmin(np.diff(times) > 0)) + 2
        raise LogError(f"{path}: time of frame {frame_} is not after that of frame {frame_ - 1}")
    return np.rint(times * 1e9).astype(np.int64)


def car(data: dict[str, Array]) -> dict[str, Any]:
    """Return the section of the car.

    The translation in `cam_T_imu` is the camera's position in the frame of the inertial unit, as KITTI's own
    calibration confirms: p_c = R (p_i - t), not R p_i + t.
    """
    K, T = data["K"], data["cam_T_imu"]
    camera = {"fx_px": K[0, 0], "fy_px": K[1, 1], "cx_px": K[0, 2], "cy_px": K[1, 2], "baseline_m": data["b"]}
    mount = placed(frame(T[:3, 3], T[:3, :3].T))
    section = {name: float(value) for name, value in camera.items()} | IMAGE
    motion = {f"sigma_{name}": sigma for name, sigma in zip(RATES, SIGMAS, strict=True)}
    return {
        "motion": {"type": "velocity_3d", **motion},
        "sensors": {SENSOR: {"type": "stereo", **section, "mount": mount}},
    }


KITTI_STEREO = Format("kitti_stereo_features", "an .npz file with features, time_stamps, ... or its folder", find, read,
                      options=("min_disparity_px", "rates"))  # fmt: skip
