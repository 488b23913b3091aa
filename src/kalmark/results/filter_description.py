"""The description of a filter in a recording: its configuration, cameras, mounts, corners and noise."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np

from kalmark.arrays import Array
from kalmark.config.schema import STATES, sigma_of
from kalmark.declare import own_name, parameters, plugin_of, registered_name
from kalmark.errors import MapError
from kalmark.events import Scan
from kalmark.geometry.frames3d import compose
from kalmark.geometry.rotations import to_euler
from kalmark.logs import FORMATS
from kalmark.logs.log import Log
from kalmark.models.landmark_views import Raised
from kalmark.models.protocols import calibrating, parameter_names, state_columns
from kalmark.models.sensors import TagCorners
from kalmark.models.tags import project_corners, tag_seen_from
from kalmark.results.history import Biased, Camera, Measuring, Mounted
from kalmark.slam.held_control import bias_name

if TYPE_CHECKING:
    from kalmark.report import Report
    from kalmark.slam.slam import Slam

PARTS = ("landmark", "association", "detector", "initialization")  # of a mounted sensor, if it has its own
HALF_VIEW = 0.8  # tangent of half the angle that is drawn of a camera that has no focal length
USED = ("associated", "new")


def plain(value: Any) -> Any:
    """Return a value made of dicts, lists, texts, numbers and None only, ready for YAML or JSON."""
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [plain(item) for item in value]
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist())
    return value if value is None or isinstance(value, bool | int | float | str) else str(value)


def model(value: Any) -> dict[str, Any]:
    """Return the type and the parameters of a model, as a mapping."""
    kind = type(value)
    given = {own.name: vars(value)[own.name] for own in parameters(kind)}
    name = registered_name(kind) or own_name(kind)  # file.py:Class for a user's own that has none
    return {"type": name} | {key: plain(item) for key, item in given.items() if item is not None}


def describe(slam: Any, log: Any = None) -> dict[str, Any]:
    """Return the configuration of a Slam: log, robots, sensors, landmarks, association, estimator, map."""
    out: dict[str, Any] = {}
    settings = slam.state.settings
    models = [settings.landmarks, slam.association, slam.estimator, *(robot.motion for robot in slam.robots.values())]
    for mount in (mount for robot in slam.robots.values() for mount in robot.sensors.values()):
        models += [mount.sensor, *(vars(mount)[part] for part in PARTS)]
    own: list[Any] = [type(each) for each in models]
    if isinstance(log, Log) and log.path is not None:
        out["log"] = {"path": str(log.path), "format": log.format, "robots": list(log.robots)}
        own += [FORMATS[log.format].read] if log.format in FORMATS else []
    plugins = sorted({str(file) for each in own if (file := plugin_of(each)) is not None})
    if plugins:
        out["plugins"] = plugins
    out["robots"] = {name: _robot(robot) for name, robot in slam.robots.items()}
    if settings.landmarks is not None:
        out["landmarks"] = model(settings.landmarks)
    out["association"] = model(slam.association)
    out["upkeep"] = _keys(settings.upkeep)
    out["estimator"] = model(slam.estimator)
    reparametrize = "off" if settings.reparametrize is None else float(settings.reparametrize)
    out["longest_pause_s"] = settings.longest_pause_s
    out["map"] = {"type": settings.map, "numbers": settings.numbers, "reparametrize": reparametrize}
    return out


def _keys(value: Any) -> dict[str, Any]:
    return {key: value for key, value in model(value).items() if key != "type"}


def _robot(robot: Any) -> dict[str, Any]:
    pose, behind = 3 if robot.motion.space.world == "plane" else 7, state_columns(robot.motion)
    start = describe_pose(robot.start[:pose])
    start |= dict(zip(behind, plain(robot.start)[pose:], strict=False))
    if robot.cov is not None:
        start |= _sigmas(robot.cov, behind)
    sensors = {name: _sensor(mount) for name, mount in robot.sensors.items()}
    return {"motion": model(robot.motion), "start": start, "sensors": sensors}


def _sensor(mount: Any) -> dict[str, Any]:
    out, at = model(mount.sensor), describe_pose(mount.at)
    if isinstance(mount.sensor, Raised):
        at["z_m"] = out.pop("height_m")
    if any(at.values()):
        out["mount"] = at
    for part in PARTS:
        if vars(mount)[part] is not None:
            out[part] = model(vars(mount)[part])
    if mount.attention != type(mount.attention)():
        out["attention"] = _keys(mount.attention)
    if mount.robust is not None:
        out["robust"] = mount.robust
    if mount.upkeep is not None:
        out["upkeep"] = _keys(mount.upkeep)
    if mount.cov is not None:
        out["mount"] = at | _sigmas(mount.cov)
    return out


def describe_pose(pose: Any) -> dict[str, float]:
    """Return a pose as configuration files have it: (x, y, theta), in space (x, y, z, roll, pitch, yaw)."""
    pose = [float(value) for value in pose]
    if len(pose) == 3:
        return dict(zip(("x_m", "y_m", "theta_rad"), pose, strict=True))
    angles = np.degrees(to_euler(np.array(pose[3:7]))[0]).tolist()
    return dict(zip(("x_m", "y_m", "z_m", "roll_deg", "pitch_deg", "yaw_deg"), (*pose[:3], *angles), strict=True))


def _sigmas(cov: Any, behind: tuple[str, ...] = ()) -> dict[str, float]:
    """Return the sigmas of a covariance as configuration files have them, one for all axes.

    `behind` are the names of what a state has behind its pose.
    """
    sigma = np.sqrt(np.diagonal(np.asarray(cov, dtype=np.float64))).tolist()
    known = {*STATES["plane"], *STATES["space"]}
    more = {
        sigma_of(name)[0]: sigma[i]
        for i, name in reversed([*enumerate(behind, len(sigma) - len(behind))])
        if name in known
    }
    if len(sigma) - len(behind) == 3:
        return {"sigma_xy_m": sigma[0], "sigma_theta_rad": sigma[2]} | more
    return {"sigma_position_m": sigma[0], "sigma_rotation_deg": math.degrees(sigma[3])} | more


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


def cameras(slam: Slam) -> tuple[Camera, ...]:
    """Return the sensors of a filter that measure pixels of an image of known size; mounts in the map as estimated."""
    found = []
    for robot in slam.robots.values():
        for name, mount in robot.sensors.items():
            sensor, columns = mount.sensor, tuple(mount.sensor.columns)
            if columns[0].endswith("_px") and isinstance(sensor, Imaging):
                at = mount_now(slam, robot.name, name, mount.at)
                size = (float(sensor.width_px), float(sensor.height_px))
                found.append(Camera(robot.name, name, at, size, columns, _corners(sensor)))
    return tuple(found)


def sensors(slam: Slam) -> tuple[Measuring, ...]:
    """Return the sensors of a filter that are no cameras."""
    seen = {(camera.robot, camera.sensor) for camera in cameras(slam)}
    return tuple(
        Measuring(robot.name, name, tuple(mount.sensor.columns))
        for robot in slam.robots.values()
        for name, mount in robot.sensors.items()
        if (robot.name, name) not in seen
    )


def mounts(slam: Slam) -> tuple[Mounted, ...]:
    """Return the mounts of the sensors that calibrate themselves, as estimated and as given."""
    named = {f"{robot.name}.{key}": mount for robot in slam.robots.values() for key, mount in robot.sensors.items()}
    return tuple(
        Mounted(name, mean, slam.covariance(name), block[2], parameter_names(mount.sensor)[: len(mean) - len(mount.at)])
        for name, mount in named.items()
        if (block := mount.block(name)) is not None and _in_map(slam, name) and len(mean := slam.mean(name))
    )


def biases(slam: Slam) -> tuple[Biased, ...]:
    """Return the biases of the robots' controls that are in the map, as estimated."""
    return tuple(
        Biased(robot.name, model.calibration, slam.mean(name), slam.covariance(name))
        for robot in slam.robots.values()
        if (model := calibrating(robot.motion)) is not None and _in_map(slam, name := bias_name(robot.name))
    )


def _in_map(slam: Slam, name: str) -> bool:
    try:
        slam.mean(name)
    except MapError:
        return False
    return True


def mount_now(slam: Slam, robot: str, sensor: str, at: Any) -> Array:
    """Return where a sensor sits on its robot: as given, or as estimated so far if its mount is in the map."""
    name = f"{robot}.{sensor}"
    return np.array(slam.mean(name)[: len(at)] if _in_map(slam, name) else at, dtype=np.float64)


def _corners(sensor: Imaging) -> Array:
    """Return the rays (4, 3), z = 1, to the corners of the image of a camera without distortion."""
    width, height = float(sensor.width_px), float(sensor.height_px)
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


def left_px(slam: Slam, scan: Scan, report: Report) -> Array:
    """Return what a scan's correction leaves of each observation (K,): the RMS of a tag's corners, NaN of all else.

    `slam` is the filter just after the scan; an observation that it did not use has NaN, too.
    """
    left, mount = np.full(len(report.observations), np.nan), slam.robots[scan.robot].sensors[scan.sensor]
    used = [o for o in report.observations if o.outcome in USED]
    if not used or not isinstance(mount.sensor, TagCorners):
        return left
    at = mount_now(slam, scan.robot, scan.sensor, mount.at)
    tags = np.array([slam.mean(o.landmark)[:7] for o in used])  # type: ignore[arg-type]
    v = tag_seen_from(compose(slam.mean(scan.robot)[:7], at)[0], tags)[0]
    rows = [o.index for o in used]
    y, par = scan.y[rows], np.array(mount.sensor.parameters)
    e = project_corners(mount.sensor.code, v, np.ascontiguousarray(y[:, 8]), par)[0]
    rms = np.sqrt(0.25 * np.sum((y[:, :8] - e) ** 2, axis=1))
    left[rows] = np.nan_to_num(rms, nan=np.inf)  # behind the camera
    return left
