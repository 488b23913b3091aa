"""Mistakes in a log or its configuration: units, signs, columns, mounts, times.

Each mistake has the log and the configuration without it, so that the filter can be asked whether they fit.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from copy import deepcopy
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from kalmark.arrays import Array
from kalmark.config.tree import put, robot_section, value_at
from kalmark.diagnosis.cause_texts import RANGE, log_correction_line
from kalmark.diagnosis.error_columns import ALL, LATE
from kalmark.events import Control, Event, Scan
from kalmark.results.figure_texts import figure
from kalmark.results.run import Run
from kalmark.slam.robot import Robot

TURNS_DEG = (180, 90, -90)
OFFSETS_M = (-4.0, -2.0, -1.0, -0.5, 0.5, 1.0, 2.0, 4.0)  # of ranges
HEIGHTS_M = (1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 6.0, 10.0)  # of beacons above a robot of the plane, or below it
DEGREE = math.pi / 180
LENGTHS = {"millimetres": 1e-3, "centimetres": 1e-2, "decimetres": 0.1, "feet": 0.3048, "kilometres": 1e3}
SPEEDS = {"kilometres per hour": 1 / 3.6, "miles per hour": 0.44704}
TIMES = {"milliseconds": 1e-3, "microseconds": 1e-6}
TURNS = ("w_radps", "dtheta_rad", "steering_rad")  # of controls of the plane, to the left
WHEELS = ("left_rad", "right_rad")
OPTICAL = {"roll_deg": -90.0, "yaw_deg": -90.0}  # from the axes of a robot to those of a camera

Change = Callable[[Event], Event]
OfOne = Callable[[Mapping[str, Any], Robot], Iterator["Mistake"]]  # the mistakes of a robot
Where = tuple[str, str]  # robot and sensor


class Mistake(NamedTuple):
    """Mistake that may have been made: its name, description, cure, and the configuration and log without it.

    `gain` is half of the chi-square that it explains, the logarithm of a likelihood ratio as of any other cause, and
    `since_s` since when it counts, in s of the log.  `shrunk` has the sensors
    of which a measurement is smaller without it, and the logarithm of by how much: its noise then explains more.
    One that is a large size of an error of `causes`, which a score test finds while it is small, has that error's `of`,
    `value` and `unit` (`causes.Finding`).
    """

    name: str
    evidence: str
    cure: str
    config: Mapping[str, Any]
    change: Change | None = None
    gain: float = 0.0
    since_s: float = 0.0
    shrunk: Mapping[Where, float] = {}
    of: tuple[str, ...] = ()
    value: float = 0.0
    unit: str = ""


def mistakes(config: Mapping[str, Any], run: Run) -> Iterator[Mistake]:
    """Yield the mistakes that a log with the sensors and controls of a run may have.  Those in the sensors first.

    Each is one of a single sensor, or of all that measure such columns.
    """
    robots = run.final_slam().robots
    columns = {(r.name, s): tuple(m.sensor.columns) for r in robots.values() for s, m in r.sensors.items()}
    plain = {of: names for of, names in columns.items() if robots[of[0]].sensors[of[1]].detector is None}
    for sensors in _groups(plain):
        yield from _of_columns(config, sensors)
    yield from _of_robots(config, [*robots.values()], _of_mounts)
    for robot in robots.values():
        yield from _of_ranges(config, robot)
    yield from _of_robots(config, [*robots.values()], _of_controls)
    if any(column.endswith("ps") for robot in robots.values() for column in robot.motion.columns):
        for unit, factor in TIMES.items():
            cure = log_correction_line(config, "factors", ("t_s",), factor)
            yield Mistake("units", f"times fit only if they are {unit}", cure, config, _at(factor))


def _of_robots(config: Mapping[str, Any], robots: list[Robot], of_one: OfOne) -> Iterator[Mistake]:
    """Yield the mistakes of each robot, and those that all make alike, if they have the same sensors and controls."""
    for robot in robots:
        yield from of_one(config, robot)
    first, *others = robots
    kinds = {(*r.motion.columns, *((name, *m.sensor.columns) for name, m in r.sensors.items())) for r in robots}
    for k, one in enumerate(of_one(config, first) if others and len(kinds) == 1 else ()):
        alike = one
        for robot in others:
            alike = _both(alike, [*of_one(alike.config, robot)][k])
        yield alike


def _both(first: Mistake, second: Mistake) -> Mistake:
    """Return two mistakes as one; the configuration of the second is without both."""
    evidence, cure = f"{first.evidence}; {second.evidence}", f"{first.cure} {second.cure}"
    one, other = first.change, second.change
    change = (lambda e: other(one(e))) if one and other else None
    return second._replace(evidence=evidence, cure=cure, change=change)


def _groups(columns: Mapping[Where, tuple[str, ...]]) -> Iterator[dict[Where, tuple[str, ...]]]:
    """Yield all sensors of a kind together, and each of them alone."""
    by_kind: dict[tuple[str, ...], dict[Where, tuple[str, ...]]] = {}
    for of, names in columns.items():
        by_kind.setdefault(names, {})[of] = names
    for together in by_kind.values():
        yield together
        if len(together) > 1:
            yield from ({of: names} for of, names in together.items())


def _of_columns(config: Mapping[str, Any], sensors: dict[Where, tuple[str, ...]]) -> Iterator[Mistake]:
    """Yield the mistakes in what sensors of one kind measure."""
    names = next(iter(sensors.values()))
    of = ", ".join(".".join(where) for where in sensors)
    turned = [name for name in names if name.startswith(("bearing", "azimuth"))]
    angles = turned + [name for name in names if name.startswith(("elevation", "normal"))]
    lengths = [name for name in names if name in ("range_m", "x_m", "y_m", "z_m", "distance_m", "right_m", "left_m")]

    def made(name: str, evidence: str, which: list[str], factor: float) -> Mistake:
        cures = (
            log_correction_line(config, "factors", (*where, column), factor) for where in sensors for column in which
        )
        by = np.array([factor if column in which else 1.0 for column in names])
        shrunk = dict.fromkeys(sensors, -math.log(float(np.abs(by).prod())))
        return Mistake(
            name, evidence, " ".join(cures), config, change_measurements({*sensors}, lambda y: y * by), shrunk=shrunk
        )

    if turned or names[:2] == ("x_m", "y_m"):
        evidence = f"directions of {of} fit only with their sign changed: clockwise, or upside down"
        yield made("bearing_sign", evidence, turned or ["y_m"], -1.0)
    if angles:
        yield made("units", f"angles of {of} fit only if they are degrees", angles, DEGREE)
    if names in (("range_m", "bearing_rad"), ("x_m", "y_m")):
        one, other = names
        evidence, cure = f"{one} and {other} of {of} are swapped", f"swap the columns {one} and {other}"
        yield Mistake("swapped_columns", evidence, cure, config, change_measurements({*sensors}, lambda y: y[:, ::-1]))
    for unit, factor in LENGTHS.items() if lengths else ():
        yield made("units", f"distances of {of} fit only if they are {unit}", lengths, factor)


def _of_mounts(config: Mapping[str, Any], robot: Robot) -> Iterator[Mistake]:
    """Yield other directions in which the sensors of a robot may look; those with one mount look there together."""
    space, at = robot.motion.space.axes > 1, ("robots", robot_section(config, robot.name), "sensors")
    places: dict[bytes, list[str]] = {}
    for sensor, mount in robot.sensors.items():
        names = tuple(mount.sensor.columns)
        camera = any(name.endswith("_px") for name in names)
        looks = mount.detector is not None or names[:2] == ("x_m", "y_m")
        if camera:
            now = value_at(config, (*at, sensor, "mount")) or {}
            if space and not any(now.get(name) for name in ("roll_deg", "pitch_deg", "yaw_deg")):
                key = f"robots.{robot.name}.sensors.{sensor}.mount"
                evidence = f"{robot.name}.{sensor} fits only with its optical axis forward: its mount lacks that turn"
                cure = " ".join(f"--set {key}.{name}={value:g}" for name, value in OPTICAL.items())
                turned = with_value(config, (*at, sensor, "mount"), {**now, **OPTICAL})
                yield Mistake("mount", evidence, cure, turned)
        elif looks or any(name.startswith(("bearing", "azimuth", "normal")) for name in names):
            places.setdefault(np.array(mount.at).tobytes(), []).append(sensor)
    for together in places.values():
        for sensors in [together, *([sensor] for sensor in together if len(together) > 1)]:
            yield from (_turned(config, robot.name, sensors, turn, space) for turn in TURNS_DEG)


def _of_ranges(config: Mapping[str, Any], robot: Robot) -> Iterator[Mistake]:
    """Yield that ranges alone are off by a constant, or, in the plane, of things at another height."""
    for sensor in (name for name, mount in robot.sensors.items() if tuple(mount.sensor.columns) == (RANGE,)):
        path, of = ("robots", robot_section(config, robot.name), "sensors", sensor), f"{robot.name}.{sensor}"
        key = f"robots.{robot.name}.sensors.{sensor}"
        bias_m = float(value_at(config, (*path, "bias_m")) or 0.0)
        for offset_m in OFFSETS_M:
            evidence = f"ranges of {of} are {abs(offset_m):g} m too {'long' if offset_m > 0 else 'short'}"
            cure = f"--set {key}.bias_m={bias_m + offset_m:g}"
            changed = with_value(config, (*path, "bias_m"), bias_m + offset_m)
            yield Mistake(
                "range_offset", evidence, cure, changed, of=(robot.name, sensor, RANGE), value=offset_m, unit="m"
            )
        for height_m in HEIGHTS_M if robot.motion.space.axes == 1 else ():
            evidence = f"ranges of {of} fit only if they are of things {height_m:g} m above or below it"
            cure = f"--set {key}.mount.z_m={-height_m:g}"
            yield Mistake("height", evidence, cure, with_value(config, (*path, "mount", "z_m"), -height_m))


def _turned(config: Mapping[str, Any], robot: str, sensors: list[str], turn: int, space: bool) -> Mistake:
    """Return the mistake of sensors that are turned by so many degrees from their mounts."""
    name, cures = "yaw_deg" if space else "theta_rad", []
    of = f"the sensor {robot}.{sensors[0]} looks" if len(sensors) == 1 else f"{' and '.join(sensors)} of {robot} look"
    for sensor in sensors:
        path = ("robots", robot_section(config, robot), "sensors", sensor, "mount", name)
        old = float(value_at(config, path) or 0.0)
        angle = math.remainder(old + turn, 360.0) if space else math.remainder(old + turn * DEGREE, 2 * math.pi)
        config = with_value(config, path, angle)
        cures.append(f"--set robots.{robot}.sensors.{sensor}.mount.{name}={angle:.4f}")
    said = f"{of} {turn} deg away from the direction of {'its mount' if len(sensors) == 1 else 'their mounts'}"
    return Mistake("mount", said, " ".join(cures), config)


def _of_controls(config: Mapping[str, Any], robot: Robot) -> Iterator[Mistake]:
    """Yield the mistakes in the controls of a robot."""
    names, of = tuple(robot.motion.columns), robot.name

    def made(name: str, evidence: str, which: list[str], factor: float) -> Mistake:
        cure = " ".join(log_correction_line(config, "factors", (of, column), factor) for column in which)
        by = np.array([factor if column in which else 1.0 for column in names])
        return Mistake(name, evidence, cure, config, _controlled(of, lambda u: u * by))

    if any(name in TURNS for name in names):
        evidence = f"turns of {of} fit only with their sign changed: its controls count them clockwise"
        yield made("control_sign", evidence, [name for name in names if name in TURNS], -1.0)
    if names == WHEELS:
        evidence, cure = f"the wheels of {of} fit only with left and right exchanged", f"swap {' and '.join(WHEELS)}"
        yield Mistake("swapped_columns", evidence, cure, config, _controlled(of, lambda u: u[::-1]))
    angles = [name for name in names if name.endswith(("_rad", "_radps"))]
    if angles:
        yield made("units", f"angles of the controls of {of} fit only if they are degrees", angles, DEGREE)
    lengths = [name for name in names if name.endswith(("_m", "_mps"))]
    for unit, factor in LENGTHS.items() if lengths else ():
        yield made("units", f"ways of the controls of {of} fit only if they are {unit}", lengths, factor)
    speeds = [name for name in names if name.endswith("_mps")]
    for unit, factor in SPEEDS.items() if speeds else ():
        yield made("units", f"speeds of the controls of {of} fit only if they are {unit}", speeds, factor)


def late_scans(config: Mapping[str, Any], robot: str, by_s: float) -> Mistake:
    """Return the mistake of scans of a robot that were made so much later than their stamps."""
    evidence = f"scans of {robot} were made {figure(abs(by_s))} s {'later' if by_s > 0 else 'earlier'} than stamped"
    cure = log_correction_line(config, "shift_s", (robot,), by_s)
    by_ns = round(by_s * 1e9)
    return Mistake(
        LATE, evidence, cure, config,
        lambda e: replace(e, t_ns=e.t_ns + by_ns) if isinstance(e, Scan) and e.robot == robot else e,
        of=(robot, ALL), value=by_s, unit="s",
    )  # fmt: skip


# ------------------------------------------------------------------ configurations and events without them
def with_value(config: Mapping[str, Any], path: tuple[str, ...], value: Any) -> dict[str, Any]:
    """Return a configuration with another value at a path."""
    changed = deepcopy(dict(config))
    section = put(changed, path, value)
    if path[-1].startswith("sigma_"):
        section.pop("cov", None)  # of a mount or a start: its sigmas as they were
    return changed


def change_measurements(sensors: set[Where], change: Callable[[Array], Array]) -> Change:
    """Return the function that changes the measurements y (K, m) of some sensors."""

    def changed(e: Event) -> Event:
        if isinstance(e, Scan) and len(e.y) and (e.robot, e.sensor) in sensors:
            return replace(e, y=change(e.y))
        return e

    return changed


def _controlled(robot: str, change: Callable[[Array], Array]) -> Change:
    return lambda e: replace(e, u=change(e.u)) if isinstance(e, Control) and e.robot == robot else e


def _at(factor: float) -> Change:
    return lambda e: replace(e, t_ns=round(e.t_ns * factor))
