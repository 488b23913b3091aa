"""The text of a cause, with its figure, and the line of a configuration that takes it out."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from kalmark.batch.motion_chain import TURNING
from kalmark.config.tree import EACH, Configuration, value_at
from kalmark.diagnosis.causes import TIMES, Finding
from kalmark.diagnosis.error_columns import ALL, ALSO, DRIFT
from kalmark.diagnosis.jumps import LISTED, OddControl, step_size
from kalmark.geometry.named_poses import POSES, describe_pose, pose_of
from kalmark.geometry.rotations import exp, multiply
from kalmark.results.figure_texts import figure
from kalmark.slam.gaps import MARGIN

Words = tuple[str, str]  # evidence, cure
OR = "; or: "  # between the cures of causes of which each explains as much
MOST_SIGMAS = 1e4
RANGE = "range_m"  # the column whose scale and offset a sensor may have
DISPARITY, INVERSE = "ur_px", "rho_per_m"  # columns that have the scale of distances through a baseline, and inversely
CALIBRATIONS = {  # the keys that put an error of a column of the controls into the map, by its kind
    ("v_mps", "offset"): "sigma_v_bias_mps",
    ("w_radps", "offset"): "sigma_w_bias_radps",
    ("steering_rad", "offset"): "sigma_steering_bias_rad",
    ("v_mps", "scale"): "sigma_v_scale",
    ("w_radps", "scale"): "sigma_w_scale",
    ("steering_rad", "scale"): "sigma_steering_scale",
    ("w_radps", "per_way"): "sigma_turn_rad_per_m",
    ("dx_m", "scale"): "sigma_scale",
    ("dtheta_rad", "scale"): "sigma_turn_scale",
    ("dtheta_rad", "offset"): "sigma_turn_bias_radps",
    ("dtheta_rad", "per_way"): "sigma_turn_rad_per_m",
}


# the keys of noises that are not called as their columns
SIGMAS = {f"d{name}": f"sigma_{name}" for name in ("x_m", "y_m", "z_m", "theta_rad")}
SIGMAS |= dict.fromkeys(("rx_rad", "ry_rad", "rz_rad"), "sigma_rotation_rad")
SIGMAS |= dict.fromkeys(("left_rad", "right_rad"), "sigma_way_m_per_sqrt_m")
MOVED = {
    "kidnapped": "{robot} is moved by about {jump} at t={t_s} s, and its controls do not show it",
    "odometry_jump": "{robot} moves by {jump} more than by its controls at t={t_s} s: it is bumped, its wheels slip, or"
    " its odometry jumps",
}
LIMITS = {
    "v_mps": "max_speed_mps",
    "dx_m": "max_speed_mps",
    "w_radps": "max_turn_radps",
    "dtheta_rad": "max_turn_radps",
}


def finding_text(finding: Finding, config: Configuration) -> Words:
    """Return a sentence about a finding, and the line that would cure it, "" if no key does.

    `config` is the configuration of the run: a new noise is given as a number where it states the old one.
    """
    text = _TELL.get(finding.name) or (_noise if finding.unit == TIMES else _offset)
    evidence, cure = finding.told or text(finding, config)
    if finding.alike:
        others = ", ".join(f"{other.name} of {_sensor(other)} {_value(other)}" for other in finding.alike)
        evidence += f"; the log does not distinguish this from {others}"
        cures = (cure, *(finding_text(other, config)[1] for other in finding.alike))
        cure = OR.join(dict.fromkeys(line for line in cures if line))
    return evidence, cure


def _value(finding: Finding) -> str:
    return _size(finding.value, finding.unit, "+")


def _sure(finding: Finding) -> str:
    """Return of how many sigmas a finding is, behind its value; nothing if it was not found by them."""
    return f" ({figure(min(abs(finding.value) / finding.sigma, MOST_SIGMAS), 2)} sigma)" if finding.sigma > 0 else ""


def _sensor(finding: Finding) -> str:
    return f"{ALL} of {finding.of[0]}" if finding.of[1] == ALL else ".".join(finding.of[:2])


def _in_log(finding: Finding, config: Configuration) -> Iterator[tuple[str, ...]]:
    """Yield the columns of a finding as they are in the log, where a detector measures ranges, by robot and sensor."""
    robot, sensor, *columns = finding.of
    sections = _current(config, robot, "sensors") or {}
    of = [section for name, section in sections.items() if sensor in (ALL, name)]
    raw = any(isinstance(section, Mapping) and section.get("detector") for section in of)
    where = (robot,) if sensor == ALL else (robot, sensor)
    yield from ((*where, column) for column in ([RANGE] if raw else columns))


def _size(value: float, unit: str, sign: str = "") -> str:
    """Return a quantity with its unit: angles in degrees, and what has no unit in per cent, with this sign."""
    if unit.startswith("rad"):
        return f"{figure(math.degrees(value))} {unit.replace('rad', 'deg')}"
    return f"{figure(value)} {unit}" if unit else f"{value:{sign}.2%}"


def _current(config: Configuration, robot: str, *path: str) -> Any:
    """Return a value of a robot's section, None where the configuration does not state it."""
    stated = (value_at(config, ("robots", name, *path)) for name in (robot, EACH))
    return next((value for value in stated if value is not None), None)


def _set(robot: str, path: str, value: float) -> str:
    return f"--set robots.{robot}.{path}={figure(value)}"


def log_correction_line(config: Configuration, option: str, path: tuple[str, ...], by: float) -> str:
    """Return the line that adds to the times of a sensor (`shift_s`), or multiplies a column (`factors`), of a log."""
    now = value_at(config, ("log", option, *path))
    neutral = 0.0 if option == "shift_s" else 1.0
    old = now if isinstance(now, float | int) else neutral
    return f"--set log.{option}.{'.'.join(path)}={figure(old + by if option == 'shift_s' else old * by, 6)}"


def _range_scale(finding: Finding, config: Configuration) -> Words:
    robot, sensor, column = finding.of[:3]
    evidence, by = _lengths(finding, ""), 1.0 + finding.value
    if column == RANGE and sensor != ALL:
        scale = _current(config, robot, "sensors", sensor, "scale") or 1.0
        return evidence, _set(robot, f"sensors.{sensor}.scale", scale * by)
    if column == DISPARITY:
        baseline_m = _current(config, robot, "sensors", sensor, "baseline_m")
        return evidence, _set(robot, f"sensors.{sensor}.baseline_m", baseline_m / by) if baseline_m else ""
    factor = by if column == INVERSE else 1.0 / by
    return evidence, " ".join(log_correction_line(config, "factors", of, factor) for of in _in_log(finding, config))


def _range_offset(finding: Finding, config: Configuration) -> Words:
    robot, sensor, column = finding.of[:3]
    bias = _current(config, robot, "sensors", sensor, "bias_m") or 0.0
    known = column == RANGE and sensor != ALL
    return _lengths(finding, "m"), _set(robot, f"sensors.{sensor}.bias_m", bias + finding.value) if known else ""


def _height(finding: Finding, config: Configuration) -> Words:
    robot, sensor = finding.of[:2]
    section, height_m = _current(config, robot, "sensors", sensor) or {}, math.sqrt(finding.value)
    evidence = f"ranges of {_sensor(finding)} are of things {figure(height_m)} m above or below it{_sure(finding)}"
    if section.get("type") != "range":  # which has no height
        return evidence, "log the distances along the ground"
    return evidence, _set(
        robot, f"sensors.{sensor}.mount.z_m", -math.hypot(section.get("mount", {}).get("z_m", 0.0), height_m)
    )


def _lengths(finding: Finding, unit: str) -> str:
    lengths, long = "ranges" if finding.of[2].startswith("range") else "distances", finding.value > 0
    off = f"{_size(abs(finding.value), unit)} too {'long' if long else 'short'}{_sure(finding)}"
    return f"{lengths} of {_sensor(finding)} are {off}"


def _bearing_offset(finding: Finding, config: Configuration) -> Words:
    robot, cures = finding.of[0], []
    sensors = (_current(config, robot, "sensors") or {}) if finding.of[1] == ALL else finding.of[1:2]
    for sensor in () if "azimuth_rad" in finding.of else sensors:
        theta = _current(config, robot, "sensors", sensor, "mount", "theta_rad") or 0.0
        cures.append(_set(robot, f"sensors.{sensor}.mount.theta_rad", theta - finding.value))
    return f"bearings of {_sensor(finding)} are off by {_value(finding)}{_sure(finding)}", " ".join(cures)


def _time_offset(finding: Finding, config: Configuration) -> Words:
    early, by = "later" if finding.value > 0 else "earlier", f"{figure(abs(finding.value))} s"
    if finding.unit == DRIFT:
        gains = "loses" if finding.value > 0 else "gains"
        return f"the clock of {_sensor(finding)} {gains} {by} each second{_sure(finding)}", ""
    evidence = f"scans of {_sensor(finding)} were made {by} {early} than their stamps{_sure(finding)}"
    where = finding.of[:1] if finding.of[1] == ALL else finding.of[:2]
    return evidence, log_correction_line(config, "shift_s", where, finding.value)


def _mount_position(finding: Finding, config: Configuration) -> Words:
    robot, sensor, column = finding.of
    now = _current(config, robot, "sensors", sensor, "mount", column) or 0.0
    evidence = f"{column} of the mount of {_sensor(finding)} is {figure(now + finding.value)}, not {figure(now)}"
    return f"{evidence}{_sure(finding)}", _set(robot, f"sensors.{sensor}.mount.{column}", now + finding.value)


def _odometry(finding: Finding, config: Configuration) -> Words:
    robot, column, kind = finding.of
    small = "small" if finding.value > 0 else "large"
    each = " for each metre driven" if kind == "per_way" else ""
    size = _size(abs(finding.value), finding.unit.removesuffix("/m") if each else finding.unit)
    verb = "are" if ALSO in column or column == TURNING else "is"
    evidence = f"{column} of {robot} {verb} {size} too {small}{each}{_sure(finding)}"
    return evidence, _calibrated(finding, config) or f"correct {column} by {_value(finding)}{each}"


def _calibrated(finding: Finding, config: Configuration) -> str:
    """Return the lines that take an error of controls out of a configuration or log, "" if no key does."""
    robot, column, kind = finding.of
    key = CALIBRATIONS.get((column, kind))
    if key:
        return _set(robot, f"motion.{key}", abs(finding.value))
    if column == TURNING:
        now = {key: _current(config, robot, "motion", key) for key in ("track_m", "wheelbase_m")}
        return " ".join(_set(robot, f"motion.{key}", m * (1.0 - finding.value)) for key, m in now.items() if m)
    by, wheels = 1.0 / (1.0 - finding.value), column.split(ALSO) if kind == "scale" else ()
    return " ".join(log_correction_line(config, "factors", (robot, wheel), by) for wheel in wheels)


def _noise(finding: Finding, config: Configuration) -> Words:
    robot, *of = finding.of
    if finding.name == "start":
        if finding.at is not None:
            return f"{robot} starts {_jump(finding)} from its stated start", ""
        return f"the start is {figure(finding.value, 2)} times as uncertain as stated", ""
    if finding.name == "control_sigma":
        what, path = f"the noise of {robot}'s {of[0] or 'motion'}", ["motion", _sigma_of(of[0])]
    else:
        what, path = f"the noise of {robot}.{of[0]} {of[1]}", ["sensors", of[0], _sigma_of(of[1])]
    now = _current(config, robot, *path)
    low, high = (max(finding.value + k * 2 * finding.sigma, 0.0) for k in (-1, 1))
    evidence = f"{what} is {figure(finding.value)} times as large as stated ({figure(low)} to {figure(high)})"
    evidence += ", which does no harm" if finding.value < 1.0 else ""
    cure = _set(robot, ".".join(path), now * finding.value) if isinstance(now, float) and now > 0 else ""
    return evidence, cure


def _sigma_of(column: str) -> str:
    """Return the key of the noise of a column."""
    return SIGMAS.get(column) or ("sigma_px" if column.endswith("_px") else f"sigma_{column}")


def _offset(finding: Finding, config: Configuration) -> Words:
    return f"{finding.name} of {'.'.join(finding.of)} is {_value(finding)}{_sure(finding)}", ""


def _correlated(finding: Finding, config: Configuration) -> Words:
    factor = math.sqrt(max((1.0 + finding.value) / (1.0 - finding.value), 1.0))
    evidence = (
        f"errors of {_sensor(finding)} {finding.of[2]} are correlated between observations (correlation"
        f" {figure(finding.value, 2)}): they carry the information of white noise of {figure(factor, 2)} times the"
        " sigma"
    )
    return evidence, ""


def _moving(finding: Finding, config: Configuration) -> Words:
    far = f", {figure(finding.moved_m)} m while it was seen" if finding.moved_m is not None else ""
    evidence = f"landmark {finding.of[0]} moves at {_value(finding)}{_sure(finding)}{far}: its place is wrong"
    return evidence, f"leave out {finding.of[0]}"


def _landmark_prior(finding: Finding, config: Configuration) -> Words:
    name = finding.of[0]
    at = ", ".join(figure(float(x)) for x in (np.zeros(0) if finding.at is None else finding.at))
    evidence = (
        f"landmark {name} is {figure(finding.value)} m from its survey{_sure(finding)}:"
        f" its observations place it at ({at}) m"
    )
    return evidence, f"correct {name} in the file of the survey, or leave it out"


def _outliers(finding: Finding, config: Configuration) -> Words:
    return f"{finding.value:.1%} of the observations are far off where their landmark is", ""


def _jump(finding: Finding) -> str:
    """Return the size of a jump with its sigma, as a text."""
    far_m, turn_deg = step_size(np.zeros(3) if finding.at is None else finding.at)
    return f"{figure(far_m)} m and {figure(turn_deg)} deg ({figure(finding.value, 2)} sigma)"


def _others(times: Sequence[str]) -> str:
    """Return the times of the other jumps of a robot."""
    some = ", ".join(times[:LISTED])
    return f"; {len(times)} more at t={some} s{', ...' if len(times) > LISTED else ''}" if times else ""


def _moved(finding: Finding, config: Configuration) -> Words:
    robot, t_s, *others = finding.of
    return MOVED[finding.name].format(robot=robot, jump=_jump(finding), t_s=t_s) + _others(others), ""


def odd_control_text(robot: str, odd: OddControl, times: Sequence[str] = ()) -> Words:
    """Return a sentence about a control that jumps, also at `times`, and the limit of its column that leaves it out."""
    degrees = odd.column.endswith(("_rad", "_radps"))
    value = f"{figure(math.degrees(odd.value) if degrees else odd.value)} {'deg' if degrees else ''}".rstrip()
    evidence = (
        f"{odd.column} of {robot} is {value} at t={odd.t_s:.1f} s, {figure(odd.times, 2)} times as large as is usual,"
        f" and it does not move so: its odometry jumps{_others(times)}"
    )
    key = LIMITS.get(odd.column)
    return (
        evidence,
        f"--set robots.{robot}.{key}={figure(odd.usual * MARGIN)}" if key else f"set max_speed_mps of {robot}",
    )


def _mount(finding: Finding, config: Configuration) -> Words:
    robot, sensor, key = finding.of
    mount, axes = _current(config, robot, "sensors", sensor, "mount") or {}, POSES["space"][3:]
    evidence = f"the sensor {_sensor(finding)} is turned by {_value(finding)}{_sure(finding)}"
    at = f"sensors.{sensor}.mount"
    if key not in axes:
        return evidence, _set(robot, f"{at}.theta_rad", mount.get("theta_rad", 0.0) + finding.value)
    about, pose = axes.index(key), pose_of(mount)
    pose[3:] = multiply(exp(finding.value * np.eye(3)[about]), pose[3:])
    turned = describe_pose(pose)
    cure = "" if "quaternion" in mount else " ".join(_set(robot, f"{at}.{axis}", turned[axis]) for axis in axes)
    return f"{evidence} about the {'xyz'[about]} axis of {robot}", cure


_TELL: dict[str, Callable[[Finding, Configuration], Words]] = {
    "range_scale": _range_scale,
    "range_offset": _range_offset,
    "bearing_offset": _bearing_offset,
    "height": _height,
    "time_offset": _time_offset,
    "mount_position": _mount_position,
    "odometry_scale": _odometry,
    "odometry_turn": _odometry,
    "odometry_offset": _odometry,
    "steering_offset": _odometry,
    "correlated_noise": _correlated,
    "moving_landmark": _moving,
    "landmark_prior": _landmark_prior,
    "outliers": _outliers,
    **dict.fromkeys(MOVED, _moved),
    "start": _noise,
    "mount": _mount,
}
