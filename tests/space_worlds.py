"""Small worlds of space, and what is asked of noise simulated in them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from kalmark.events import Scan
from kalmark.logs.log import Log
from kalmark.simulate import World


def world(**keys: Any) -> World:
    """Return a small world: a box of points, a robot that climbs a helix and measures ranges and angles."""
    robot = {
        "motion": {"type": "odometry_3d", "sigma_rotation_rad": 0.01},
        "route": {"type": "constant", "u": (0.1, 0.0, 0.01, 0.0, 0.01, 0.05)},
        "sensors": {"lidar": {"type": "range_bearing_3d", "mount": {"x_m": 0.2, "z_m": 0.3, "pitch_deg": 20.0}}},
    } | keys.pop("robot", {})
    box = {"type": "random_box", "count": 12, "min_m": (-6.0, -6.0, -2.0), "max_m": (6.0, 6.0, 4.0)}
    return World(**({"world": box, "robots": {"r": robot}, "steps": 60} | keys))


def scans(log: Log) -> list[Scan]:
    return [e for e in log if isinstance(e, Scan)]


def assert_sigma(sample: np.ndarray, sigma: float) -> None:
    n = len(sample)
    assert abs(sample.mean()) < 4 * sigma / math.sqrt(n)
    assert abs(sample.std() / sigma - 1) < 4 / math.sqrt(2 * n)


def faulty(**keys: Any) -> dict[str, Any]:
    return {"sensing": {"lidar": keys}}
