"""The command line as a user sees it, and small native logs to run."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

LANDMARKS = {1: (3.0, 1.0), 2: (1.0, -2.0), 3: (4.0, -1.0)}


class Done(NamedTuple):
    status: int
    out: str
    err: str


Kalmark = Callable[..., Done]


def write_log(folder: Path) -> Path:
    """Write a small native log: a robot that drives straight past three landmarks at 0.5 m/s."""
    controls, scans, truth = ["t_s,robot,v_mps,w_radps"], ["t_s,robot,sensor,id,range_m,bearing_rad"], []
    for k in range(20):
        t, x = 0.1 * k, 0.05 * k
        controls.append(f"{t:.1f},rover,0.5,0.0")
        truth.append(f"{t:.1f},rover,{x},0.0,0.0")
        for i, (lx, ly) in LANDMARKS.items():
            scans.append(f"{t:.1f},rover,lidar,{i},{math.hypot(lx - x, ly)},{math.atan2(ly, lx - x)}")
    tables = {
        "controls": controls,
        "scans": scans,
        "truth": ["t_s,robot,x_m,y_m,theta_rad", *truth],
        "landmarks": ["id,x_m,y_m", *(f"{i},{x},{y}" for i, (x, y) in LANDMARKS.items())],
    }
    folder.mkdir()
    for name, lines in tables.items():
        (folder / f"{name}.csv").write_text("\n".join(lines) + "\n")
    return folder


def write_log_of_space(folder: Path) -> Path:
    """Write a small native log of space: a robot climbs and turns past four landmarks, a lidar above it."""
    landmarks = np.array([[3.0, 1.0, 0.5], [1.0, -2.0, 1.0], [4.0, -1.0, -0.5], [2.0, 2.0, 2.0]])
    u = np.array([0.1, 0.0, 0.02, 0.0, 0.01, 0.05])
    position, turn = np.zeros(3), Rotation.identity()
    controls, truth = ["t_s,robot,dx_m,dy_m,dz_m,rx_rad,ry_rad,rz_rad"], ["t_s,robot,x_m,y_m,z_m,qx,qy,qz,qw"]
    scans = ["t_s,robot,sensor,id,range_m,azimuth_rad,elevation_rad"]
    truth.append("0.0,drone,0,0,0,0,0,0,1")
    for k in range(1, 20):
        t = f"{0.1 * k:.1f},drone"
        position, turn = position + turn.apply(u[:3]), turn * Rotation.from_rotvec(u[3:])
        controls.append(",".join([t, *map(repr, u.tolist())]))
        truth.append(",".join([t, *map(repr, [*position.tolist(), *turn.as_quat().tolist()])]))
        for i, (x, y, z) in enumerate(turn.inv().apply(landmarks - position) - [0, 0, 0.5]):
            scans.append(f"{t},lidar,{i},{math.hypot(x, y, z)},{math.atan2(y, x)},{math.atan2(z, math.hypot(x, y))}")
    folder.mkdir()
    named = {"controls": controls, "scans": scans, "truth": truth}
    named["landmarks"] = ["id,x_m,y_m,z_m", *(f"{i},{x},{y},{z}" for i, (x, y, z) in enumerate(landmarks))]
    for name, lines in named.items():
        (folder / f"{name}.csv").write_text("\n".join(lines) + "\n")
    return folder


def refused(done: Done) -> str:
    """Return the one line of a refusal."""
    assert done.status == 2
    assert done.out == ""
    assert done.err.startswith("kalmark: ")
    assert done.err.count("\n") == 1
    return done.err.removeprefix("kalmark: ").strip()
