"""The columns of logs: what several formats have, the order of all that are known, and their units."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable

POSITION = ("x_m", "y_m", "z_m")
POSE2, POSE3 = (*POSITION[:2], "theta_rad"), (*POSITION, "qx", "qy", "qz", "qw")
INCREMENT2, INCREMENT3 = ("dx_m", "dy_m", "dtheta_rad"), ("dx_m", "dy_m", "dz_m", "rx_rad", "ry_rad", "rz_rad")
TWIST3 = ("vx_mps", "vy_mps", "vz_mps", "wx_radps", "wy_radps", "wz_radps")
INERTIAL = ("wx_radps", "wy_radps", "wz_radps", "ax_mps2", "ay_mps2", "az_mps2")
BEAM = ("range_m", "bearing_rad")
WHEELS = ("left_rad", "right_rad")
CORNERS = ("u1_px", "v1_px", "u2_px", "v2_px", "u3_px", "v3_px", "u4_px", "v4_px", "size_m")
GPS = ("x_m", "y_m", "antenna_x_m", "antenna_y_m")

NAMES = ("t_s", "robot", "sensor", "id", "class", "of")
CONTROL = (
    "v_mps", "vx_mps", "vy_mps", "vz_mps", "w_radps", "wx_radps", "wy_radps", "wz_radps",
    "ax_mps2", "ay_mps2", "az_mps2", "steering_rad",
    "dv_mps", "dvx_mps", "dvy_mps", "dvz_mps", "dw_radps", "dwx_radps", "dwy_radps", "dwz_radps",
    "dx_m", "dy_m", "dz_m", "rx_rad", "ry_rad", "rz_rad", "dtheta_rad", "left_rad", "right_rad",
    "front_left_radps", "front_right_radps", "rear_left_radps", "rear_right_radps",
)  # fmt: skip
OBSERVATION = (
    "range_m", "bearing_rad", "azimuth_rad", "elevation_rad", "signature",
    "distance_m", "normal_rad", "right_m", "left_m",
    "x_m", "y_m", "z_m", "qx", "qy", "qz", "qw", "x2_m", "y2_m", "z2_m",
    "u_px", "v_px", "rho_per_m", "ul_px", "vl_px", "ur_px", "vr_px",
    "u1_px", "v1_px", "u2_px", "v2_px", "u3_px", "v3_px", "u4_px", "v4_px", "size_m",
)  # fmt: skip
READING = (  # of a robot itself by its own sensors, and of senders
    "heading_rad", "theta_rad", "rssi_dbm", "difference_m", "roll_rad", "pitch_rad",
    "speed_mps", "range_rate_mps",
)  # fmt: skip
CANONICAL = (*CONTROL, *OBSERVATION, *READING)
"""The order in which known columns make a control or an observation, whatever their order in the file."""
NOT_NEGATIVE = {"range_m": "range", "size_m": "size"}
UNITS = {
    "s": "seconds", "m": "metres", "rad": "radians", "px": "pixels", "mps": "m/s", "radps": "rad/s", "mps2": "m/s^2",
}  # fmt: skip
"""The units of columns, by the end of their names."""
OTHER_UNITS = {
    "ms", "us", "ns", "sec", "secs", "seconds", "min", "h", "mm", "cm", "dm", "km", "in", "ft", "meter", "meters",
    "metre", "metres", "deg", "degree", "degrees", "rads", "radian", "radians", "mrad", "kmh", "kph", "mph", "dps",
    "degps", "degs", "rpm", "pixel", "pixels", "pix",
}  # fmt: skip
FACTORS = {
    "mm": ("m", 1e-3), "cm": ("m", 1e-2), "km": ("m", 1e3), "deg": ("rad", math.pi / 180), "mrad": ("rad", 1e-3),
    "mmps": ("mps", 1e-3), "cmps": ("mps", 1e-2), "kmh": ("mps", 1 / 3.6), "degps": ("radps", math.pi / 180),
    "dps": ("radps", math.pi / 180), "g": ("mps2", 9.80665), "mg": ("mps2", 9.80665e-3),
}  # fmt: skip
"""Units of columns that are taken, too: each the unit that it becomes, and by what it is multiplied."""
TIMES = {"t_s": 1_000_000_000, "t_ms": 1_000_000, "t_us": 1000, "t_ns": 1}
"""The columns of times, and how many nanoseconds are one of each."""
RANK = {name: rank for rank, name in enumerate(CANONICAL)}
BASES = {unit: unit for unit in UNITS} | {unit: base for unit, (base, _) in FACTORS.items()}
BASES |= {name.removeprefix("t_"): "s" for name in TIMES}
"""The unit that each unit that is taken becomes."""
WORDS = {
    "time": "t", "timestamp": "t", "stamp": "t", "velocity": "v", "speed": "v", "omega": "w", "yaw_rate": "w",
    "yaw": "theta", "heading": "theta", "distance": "range", "dist": "range", "angle": "bearing",
}  # fmt: skip
"""Words of the field for quantities, and the stem of the column of each."""
DIRECTIONS = ("bearing_rad", "azimuth_rad", "elevation_rad", "normal_rad")
"""The columns of directions, which are within a turn."""
GLOBE = {"lat_deg": "x_m", "lon_deg": "y_m", "height_m": "z_m"}
"""Columns of positions on the globe, and those of the tangent plane whose place in a row they take."""


def in_order(names: Iterable[str]) -> list[str]:
    """Return columns in the order in which they make a control or an observation, unknown ones last."""
    return sorted(names, key=lambda name: RANK.get(name, len(RANK)))


def in_own_unit(name: str) -> tuple[str, float]:
    """Return a column in kalmark's unit, and by what numbers in the unit of its name are multiplied."""
    stem, _, unit = name.rpartition("_")
    return (f"{stem}_{FACTORS[unit][0]}", FACTORS[unit][1]) if unit in FACTORS else (name, 1.0)


def split_unit(name: str) -> tuple[str, str]:
    """Return the stem and the unit of a column's name, "" without one: of w_deg_s, as of w_degps, w and degps."""
    *stem, last = re.findall("[a-z0-9]+", name.lower()) or [""]
    units = [(f"{stem[-1]}p{last}", 1), (stem[-1] + last, 1), (last, 0)] if stem else []
    for unit, more in units:
        if unit in BASES or unit in OTHER_UNITS:
            return "_".join(stem[: len(stem) - more]), unit
    return "_".join([*stem, last]), ""


def in_unit_of(name: str, column: str) -> str:
    """Return a column in the unit of a name of the same quantity, or "": t_ms of time_ms and t_s, t_s of time.

    A name with a unit must begin alike or be one of `WORDS`, one without a unit must be one of `WORDS`.
    """
    (stem, unit), (known, base) = split_unit(name), split_unit(column)
    stem = WORDS.get(stem, stem)
    if not unit:
        return column if stem == known else ""
    alike = bool(stem and known) and (stem.startswith(known) or known.startswith(stem))
    return f"{known}_{unit}" if alike and base and BASES.get(unit) == BASES.get(base) else ""
