"""Read "Starry Night" (T. Barfoot, University of Toronto): a stereo camera moved by hand above 20 reflectors.

The vehicle's x axis points back and its z axis down: the mount, which the log describes, takes care of it.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from kalmark.errors import LogError
from kalmark.events import Control, Event, Scan, order
from kalmark.logs.log import Array, Log, Trajectory
from kalmark.logs.matlab import arrays, column, variables
from kalmark.logs.rig import frame, named, placed
from kalmark.logs.source import Format, Request

ROBOT, SENSOR, FILE = "robot", "stereo", "vincentive_dataset3.mat"
NAMES = (
    "t", "w_vk_vk_i", "v_vk_vk_i", "y_k_j", "rho_i_pj_i", "theta_vk_i", "r_i_vk_i",
    "C_c_v", "rho_v_c_v", "fu", "fv", "cu", "cv", "b", "w_var", "v_var", "y_var",
)  # fmt: skip
RATES = ("vx_mps", "vy_mps", "vz_mps", "wx_radps", "wy_radps", "wz_radps")
PIXELS = ("ul_px", "vl_px", "ur_px", "vr_px")
IMAGE = {"width_px": 640, "height_px": 480}


def find(path: Path) -> Path | None:
    """Return the MATLAB file, given it or its folder."""
    file = path / FILE if path.is_dir() else path
    return file if file.suffix == ".mat" and variables(file) >= set(NAMES) else None


def read(path: Path, request: Request) -> Log:
    """Return the log.  The rates at t act from t on and the scan at t is of the same instant; -1 is "not seen".

    Barfoot's C_vi = C(theta) maps the world to the vehicle, so theta is the rotation vector of ours, local to global,
    and his C_{k+1} = C(w dt) C_k is R_{k+1} = R_k Exp(w dt): rates and poses need no change.
    """
    data = arrays(path, NAMES)
    t_ns = checked_times(path, data)
    rates = np.vstack([data["v_vk_vk_i"], data["w_vk_vk_i"]]).T
    events: list[Event] = []
    for k, t in enumerate(t_ns.tolist()):
        events.append(Control(t_ns=t, robot=ROBOT, u=rates[k]))
        y = data["y_k_j"][:, k]
        seen = np.flatnonzero((y >= 0).all(axis=0))
        events.append(Scan(t_ns=t, robot=ROBOT, sensor=SENSOR, y=y[:, seen].T, ids=(seen + 1).tolist()))
    turns = Rotation.from_rotvec(data["theta_vk_i"].T).as_quat()
    return Log(
        name="starry_night",
        format="starry_night",
        path=path,
        robots=(ROBOT,),
        events=sorted(events, key=order),
        truth={ROBOT: Trajectory(t_ns, np.column_stack([data["r_i_vk_i"].T, turns]))},
        landmarks={i + 1: position for i, position in enumerate(data["rho_i_pj_i"].T)},
        skipped=request.skipped,
        control_columns={ROBOT: RATES},
        sensor_columns={(ROBOT, SENSOR): PIXELS},
        describes=rig(data),
    )


def checked_times(path: Path, data: dict[str, Array]) -> np.ndarray[Any, np.dtype[np.int64]]:
    """Return the times (N,) in ns.  Raises LogError if they do not increase or another variable has other sizes."""
    t_ns = np.rint(column(data["t"]) * 1e9).astype(np.int64)
    steps, landmarks = len(t_ns), data["rho_i_pj_i"].shape[-1]
    wanted: dict[str, tuple[int, ...]] = {
        name: (3, steps) for name in ("w_vk_vk_i", "v_vk_vk_i", "theta_vk_i", "r_i_vk_i")
    }
    wanted |= {"y_k_j": (4, steps, landmarks), "rho_i_pj_i": (3, landmarks), "C_c_v": (3, 3), "rho_v_c_v": (3, 1)}
    wanted |= {"w_var": (3, 1), "v_var": (3, 1), "y_var": (4, 1)} | {name: (1, 1) for name in ("fu", "fv", "cu", "cv")}
    for name, shape in wanted.items():
        if data[name].shape != shape:
            raise LogError(f"{path}: {name} has shape {data[name].shape}, expected {shape}")
    if not (np.diff(t_ns) > 0).all():
        step = int(np.argmin(np.diff(t_ns) > 0)) + 2
        raise LogError(f"{path}: t of step {step} is not after that of step {step - 1}, expected increasing times")
    return t_ns


def rig(data: dict[str, Array]) -> dict[str, Any]:
    """Return the configuration that the file's calibration and variances give."""
    camera = {"fx_px": "fu", "fy_px": "fv", "cx_px": "cu", "cy_px": "cv", "baseline_m": "b"}
    stereo = {key: data[name].item() for key, name in camera.items()} | IMAGE
    noise = np.sqrt(column(data["y_var"]))
    stereo |= {f"sigma_{name}": float(sigma) for name, sigma in zip(PIXELS, noise, strict=True)}
    mount = placed(frame(data["rho_v_c_v"], data["C_c_v"].T))
    motion = {
        **named("sigma_v", "xyz", "_mps", np.sqrt(column(data["v_var"]))),
        **named("sigma_w", "xyz", "_radps", np.sqrt(column(data["w_var"]))),
    }
    robot = {
        "motion": {"type": "velocity_3d", **motion},
        "sensors": {SENSOR: {"type": "stereo", **stereo, "mount": mount}},
    }
    return {"robots": {ROBOT: robot}, "landmarks": {"type": "point"}}


STARRY_NIGHT = Format("starry_night", f"{FILE} or its folder", find, read)
