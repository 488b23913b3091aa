"""Parts that attacks share: right files to begin with, and what counts as broken."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from kalmark.errors import KalmarkError

LONGEST_MESSAGE, LONGEST_INPUT = 1500, 20_000
CONTROLS = b"t_s,robot,v_mps,w_radps\n0,rover,1,0\n1,rover,1,0.1\n2,rover,1,-0.1\n"
SCANS = (
    b"t_s,robot,sensor,id,range_m,bearing_rad\n0.5,rover,lidar,1,5,0.1\n1.5,rover,lidar,1,4,0.1\n1.5,rover,lidar,,3,1\n"
)
TABLES = {
    "controls.csv": (CONTROLS, b"t_ms;robot;v_kmh;w_degps;sigma_v_mps;sigma_w_radps\n0;rover;1,5;0;0,1;0,1\n"),
    "scans.csv": (
        SCANS, b"t_s,robot,sensor,id,range_mm,bearing_deg,cov_00,cov_01,cov_11\n1,rover,lidar,x,5,1,1,0,1\n"),
    "measurements.csv": (b"t_s,robot,sensor,heading_rad\n0.5,rover,compass,0.1\n",),
    "fixes.csv": (b"t_s,robot,x_m,y_m,cov_xx,cov_xy,cov_yy\n1,rover,1,2,1,0,1\n",),
    "truth.csv": (b"t_s,robot,x_m,y_m,theta_rad\n0,rover,0,0,0\n1,rover,1,0,0\n",
                  b"t_s,robot,x_m,y_m,z_m,qx,qy,qz,qw\n0,rover,0,0,0,0,0,0,1\n"),
    "landmarks.csv": (b"id,x_m,y_m\n1,5,0\n", b"id,x_m,y_m,z_m,x2_m,y2_m,z2_m\n1,5,0,1,2,3,4\n"),
    "gps.csv": (b"t_s,robot,x_m,y_m,antenna_x_m,antenna_y_m\n1,rover,1,2,0,0\n",),
    "rig.yaml": (b"robots: {rover: {motion: {type: unicycle}, sensors: {lidar: {type: range_bearing}}}}\n",),
}  # fmt: skip
CONFIG = b"""log: {path: log, to_s: 10, on_error: skip}
robots:
  each:
    motion: {type: unicycle, sigma_v_mps: 0.05}
    start: {x_m: 1.0, sigma_xy_m: 0.1}
    sensors: {lidar: {type: range_bearing, sigma_range_m: 0.1, mount: {x_m: 0.3}, association: {type: auto}}}
landmarks: {type: point}
association: {type: identity}
estimator: {type: invariant, iterations: 3}
map: {type: dense}
upkeep: {confirm: 3}
"""


class Broken(Exception):
    """A fault that an input has found."""


@dataclass(frozen=True)
class Target:
    """What is attacked: inputs that are right, and what takes an input; that raises KalmarkError or Broken at most."""

    seeds: tuple[bytes, ...]
    take: Callable[[bytes, Path], None]
    longest: int = LONGEST_INPUT  # bytes


def written(folder: Path, files: dict[str, bytes]) -> Path:
    """Write files into an empty folder."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    for name, content in files.items():
        (folder / name).write_bytes(content)
    return folder


def plain(error: KalmarkError) -> None:
    """Raise Broken if an error's message is not one plain line."""
    message = str(error)
    if "\n" in message or not message or len(message) > LONGEST_MESSAGE:
        raise Broken(f"message {message[:300]!r}") from None


def report(told: str, error: Exception | str) -> int:
    """Print what was broken; return 1."""
    print(f"  {told}: {type(error).__name__}: {' '.join(str(error).split())[:300]}", flush=True)
    return 1
