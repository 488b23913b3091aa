"""The description of a filter in a recording: its configuration, cameras, mounts, corners and noise."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import FunctionType
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np

from kalmark.arrays import Array
from kalmark.config.tree import EACH
from kalmark.declare import declared_options, is_own, own_name, parameters, place_of_object, plugin_of, registered_name
from kalmark.events import Id, Scan
from kalmark.geometry.frames3d import compose
from kalmark.logs import known_formats
from kalmark.logs.log import Log, SensorKey
from kalmark.models.protocols import FullSensor, SegmentVisible, finds_depth, self_calibrating
from kalmark.models.sensors import TagCorners
from kalmark.models.tags import project_corners, tag_seen_from
from kalmark.results.history import NONE, WHOLE, Biased, CalibratedMount, Camera, Measuring
from kalmark.results.landmark_table import LINE
from kalmark.results.measures import correlations_of
from kalmark.results.truth import as_rigid
from kalmark.slam.description import describe, describe_beginning
from kalmark.slam.held_control import bias_name

if TYPE_CHECKING:
    from kalmark.report import Report
    from kalmark.slam.robot import Mount, Robot
    from kalmark.slam.slam import Slam

HALF_VIEW = 0.8  # tangent of half the angle that is drawn of a camera that has no focal length
USED = ("associated", "new")
KEPT = 40  # landmarks of a map whose correlations are kept


def configuration(slam: Slam, log: Log) -> dict[str, Any]:
    """Return the configuration that makes the run of a log by a Slam again: its plugins, the log, the filter.

    Before the first event of the Slam it has what was added to its map.
    """
    files, of_log = {file for _, file, _ in _own(slam)}, dict[str, Any]()
    if log.path is not None:
        of_log = {"path": str(log.path.resolve()), "format": log.format, "robots": list(log.robots)} | log.options
        files |= {plugin_of(entry.read)} if (entry := known_formats().get(log.format)) else set()
    if silent := [name for name in slam.robots if name not in log.robots]:
        of_log["without_events"] = silent
    plugins = sorted(map(str, files - {None}))
    said = ({"plugins": plugins} if plugins else {}) | ({"log": of_log} if of_log else {})
    return said | (describe(slam) if slam.t_ns is not None else describe_beginning(slam))


def not_described(slam: Slam, log: Log) -> Iterator[str]:
    """Yield a line for each thing that a run of a log by a Slam has and its configuration has not."""
    if log.path is None:
        yield "config.yaml has no log, because this one has no file: `kalmark run` of it requires --log"
    if slam.t_ns is not None:
        yield "config.yaml lacks the events that the filter had before this log: `kalmark run` makes another map"
    for kind, file, lost in _own(slam):
        if file is None and not (is_own(kind) and registered_name(kind)):
            what = "a registered class, or an object, of a file"
            yield f"config.yaml cannot have {own_name(kind)}: `kalmark run` requires {what}"
        elif lost:
            what = "an attribute of that name"
            yield f"config.yaml cannot have {lost[0]} of {own_name(kind)}: `kalmark run` requires {what}"
    if EACH in {*slam.robots}.union(*mounts_of(slam.robots)):
        yield f"config.yaml cannot have a robot or a sensor called {EACH}, which stands for all of them there"


def _own(slam: Slam) -> list[tuple[Any, Path | None, tuple[str, ...]]]:
    """Return the classes, or functions, of the models of a Slam, with the users' files that have them or the models.

    The texts are the parameters that a model does not store under their names.
    """
    mounts = mounts_of(slam.robots).values()
    parts = (slam.state.settings, *slam.robots.values(), *mounts)
    models = [vars(part)[own.name] for part in parts for own in declared_options(type(part))]
    models += [mount.sensor for mount in mounts]
    models += [slam.landmark_model(name) for name in (*slam.tracks.confirmed, *slam.tracks.known)]
    models = [each for each in models if not isinstance(each, bool | int | float | str | np.generic | None)]
    return [*dict.fromkeys(map(_home, models))]


def _home(model: Any) -> tuple[Any, Path | None, tuple[str, ...]]:
    kind: Any = model if isinstance(model, FunctionType) else type(model)
    lost = tuple(own.name for own in parameters(type(model)) if own.name not in vars(model))
    if registered_name(kind):
        return kind, plugin_of(kind), lost
    if place := place_of_object(model):
        return kind, place[0], ()
    place = place_of_object(kind)
    return kind, place and place[0], lost


@runtime_checkable
class Imaging(Protocol):
    """A sensor whose pixels are of an image of known size."""

    width_px: float
    height_px: float


@runtime_checkable
class Focal(Protocol):
    """A camera with focal lengths and a principal point, in pixels."""

    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float


def mounts_of(robots: Mapping[str, Robot]) -> dict[SensorKey, Mount]:
    """Return the mounts of robots' sensors, by robot and sensor."""
    return {(robot.name, name): m for robot in robots.values() for name, m in robot.sensors.items()}


def cameras(slam: Slam) -> tuple[Camera, ...]:
    """Return the sensors of a filter that measure pixels of an image of known size; mounts in the map as estimated."""
    found = []
    for (robot, name), mount in mounts_of(slam.robots).items():
        sensor, columns = mount.sensor, tuple(mount.sensor.columns)
        if columns[0].endswith("_px") and isinstance(sensor, Imaging):
            size = (float(sensor.width_px), float(sensor.height_px))
            found.append(Camera(robot, name, mount_now(slam, robot, name), size, columns, _corners(sensor, *size)))
    return tuple(found)


def sensors(slam: Slam) -> tuple[Measuring, ...]:
    """Return the sensors of a filter that are no cameras."""
    seen = {(camera.robot, camera.sensor) for camera in cameras(slam)}
    return tuple(
        Measuring(*key, tuple(mount.sensor.columns)) for key, mount in mounts_of(slam.robots).items() if key not in seen
    )


def calibrated_mounts(slam: Slam) -> tuple[CalibratedMount, ...]:
    """Return the mounts of the sensors that calibrate themselves, as estimated and as given."""
    named = {".".join(key): mount for key, mount in mounts_of(slam.robots).items()}
    return tuple(
        CalibratedMount(name, mean, slam.covariance(name), block[2], mount.parameter_names[: len(mean) - len(mount.at)])
        for name, mount in named.items()
        if (block := mount.block(name)) is not None and name in slam.tracks.slots and len(mean := slam.mean(name))
    )


def biases(slam: Slam) -> tuple[Biased, ...]:
    """Return the biases of the robots' controls that are in the map, as estimated."""
    return tuple(
        Biased(robot.name, model.calibration, slam.mean(name), slam.covariance(name))
        for robot in slam.robots.values()
        if (model := self_calibrating(robot.motion)) is not None
        and (name := bias_name(robot.name)) in slam.tracks.slots
    )


def mount_now(slam: Slam, robot: str, sensor: str) -> Array:
    """Return the mount of a sensor: as given, or as estimated so far if its mount is in the map."""
    name, at = f"{robot}.{sensor}", slam.robots[robot].sensors[sensor].at
    return np.array(slam.mean(name)[: len(at)] if name in slam.tracks.slots else at, dtype=np.float64)


def observed_points(slam: Slam, robot: str, sensor: str, pose: Array, y: Array) -> Array:
    """Return the points (K, 2 or 3) that measurements y (K, m) are of, from a robot's pose, in the frame of the map.

    NaN where y is, and of sensors that do not measure all coordinates of a point.
    """
    d = 3 if len(pose) == 7 else 2
    out = np.full((len(y), d), np.nan)
    model = slam.robots[robot].sensors[sensor].sensor
    known = np.flatnonzero(np.isfinite(y[:, : len(model.columns)]).all(axis=1))
    if not len(known) or not isinstance(model, FullSensor) or not finds_depth(model):
        return out
    v = model.invert(np.ascontiguousarray(y[known, : len(model.columns)]))[0]
    if v.shape[1] == LINE or isinstance(model, SegmentVisible):  # a line is nowhere in particular
        return out
    at = mount_now(slam, robot, sensor)
    out[known] = as_rigid(pose[: len(at)])(as_rigid(at)(v[:, :d]))
    return out


def _corners(sensor: Any, width: float, height: float) -> Array:
    """Return the rays (4, 3), z = 1, to the corners of the image of a camera without distortion."""
    u, v = np.array([0.0, width, width, 0.0]), np.array([0.0, 0.0, height, height])
    if not isinstance(sensor, Focal):
        across, down = u / width - 0.5, v / height - 0.5
        return np.column_stack([2 * HALF_VIEW * across, 2 * HALF_VIEW * down * height / width, np.ones(4)])
    return np.column_stack([(u - sensor.cx_px) / sensor.fx_px, (v - sensor.cy_px) / sensor.fy_px, np.ones(4)])


def stated_noise(slam: Slam, report: Report) -> Array:
    """Return the sigmas (K, p) of the noise that a scan's observations were given, (K, 0) where they are not of z."""
    count, width = report.z.shape
    event = report.event
    if not count or not isinstance(event, Scan):
        return np.empty((count, 0))
    sensor = slam.robots[event.robot].sensors[event.sensor].sensor
    R = sensor.noise(event.y) if event.cov is None else np.broadcast_to(event.cov, (count, *event.cov.shape[-2:]))
    if R.shape != (count, width, width):
        return np.empty((count, 0))
    return np.sqrt(np.einsum("kii->ki", R))


def residual_px(slam: Slam, scan: Scan, report: Report) -> Array:
    """Return the residual of each observation (K,) after a scan: the RMS of a tag's corners, NaN of all else.

    `slam` is the filter just after the scan; an observation that it did not use has NaN, too.
    """
    left, sensor = np.full(len(report.observations), np.nan), slam.robots[scan.robot].sensors[scan.sensor].sensor
    used = [o for o in report.observations if o.outcome in USED]
    if not used or not isinstance(sensor, TagCorners):
        return left
    at = mount_now(slam, scan.robot, scan.sensor)
    tags = np.array([slam.mean(o.landmark)[:7] for o in used])  # type: ignore[arg-type]
    v = tag_seen_from(compose(slam.mean(scan.robot)[:7], at)[0], tags)[0]
    rows = [o.index for o in used]
    y, par = scan.y[rows], np.array(sensor.parameters)
    e = project_corners(sensor.code, v, np.ascontiguousarray(y[:, 8]), par)[0]
    rms = np.sqrt(0.25 * np.sum((y[:, :8] - e) ** 2, axis=1))
    left[rows] = np.nan_to_num(rms, nan=np.inf)  # behind the camera
    return left


def correlations_kept(slam: Slam, ids: Sequence[Id]) -> Any:
    """Return the correlations (n, n) of robots and landmarks as parts of `WHOLE`, `NONE` of a large map."""
    if len(ids) > KEPT:
        return NONE
    return np.round(WHOLE * correlations_of(slam.covariance(*slam.robots, *ids))).astype(np.int8)
