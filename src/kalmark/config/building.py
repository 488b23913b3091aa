"""From a configuration to the robots and the filter that it describes, and whether the log is what they take."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from kalmark.config.opening import known_map_path, open_run, with_log_description
from kalmark.config.reading import did_you_mean, load_config, one_near
from kalmark.config.schema import TRUTH, Config, SpaceStartConfig
from kalmark.config.sections import model_of, plain_section
from kalmark.config.tree import EACH, KeyPath, quote_value
from kalmark.config.true_start import true_start
from kalmark.declare import built_in, registered_name
from kalmark.detect.laser_scan import RAW, Laser
from kalmark.errors import LogError, MapError, ModelError
from kalmark.events import Raw
from kalmark.geometry.named_poses import world_of
from kalmark.logs.formats import known_formats
from kalmark.logs.known_map import KnownLandmark, read_known
from kalmark.logs.log import Log
from kalmark.logs.table_columns import POSITION
from kalmark.models.inertial import Inertial, start_at_rest
from kalmark.models.landmark_views import Raised
from kalmark.models.landmarks import PointHeight2D
from kalmark.models.protocols import Motion as MotionModel
from kalmark.models.protocols import state_columns
from kalmark.picture_options import USUAL, Picture
from kalmark.plugins import load_all
from kalmark.slam.description import EXACT, arguments_of, describe_place, place_described, robot_described
from kalmark.slam.robot import Mount, Robot
from kalmark.slam.slam import Slam

BY_SIGMAS = "state a start without at_rest, as uncertain as it is: sigma_rotation_deg, sigma_v_mps, sigma_bias_..."


def build_slam(config: Config, log: Log | None = None, **given: Any) -> Slam:
    """Return the filter that a configuration describes, for the robots of a log and with its description of them.

    Without a log the robots are those that the configuration names; `each` alone is one robot called "robot".  `given`
    arguments of `Slam` take the place of configured ones.

    >>> from kalmark.config import build_slam
    >>> from kalmark.simulate import load_world, simulate
    >>> world = load_world("cloister", ["steps=100"])
    >>> log = simulate(world)
    >>> build_slam(world.config(), log)
    <Slam of 'robot' before its first event: 0 landmarks, Invariant, ByIdentity>
    """
    config = config if log is None else with_log_description(config, log)
    made, m = partial(_made, config), config.map
    robots = given.pop("robots", None) or [build_robot(config, name, log) for name in _names(config, log)]
    slam: Slam = made(("robots",), Slam, **made((), arguments_of, plain_section(config), robots=robots, **given))
    world = robots[0].motion.space.world
    for name, mean, cov, columns in _known(config, log):
        high = PointHeight2D() if columns == POSITION and world == "plane" else None
        made(("map", "known"), slam.add_landmark, name, mean, cov, high)
    for k, known in enumerate(m.landmarks):
        at = ("map", "landmarks", str(k))
        made(at, slam.add_landmark, known.id, known.mean, known.cov, model_of(known.landmark, world))
    if m.cov is not None:
        made(("map", "cov"), slam.state.set_covariance, m.cov)
    return slam


def _known(config: Config, log: Log | None) -> list[KnownLandmark]:
    """Return the landmarks known beforehand, of a file or of the log's truth."""
    given, exact = config.map.known, config.map.exact
    if given is None:
        return []
    if given == TRUTH:
        if log is None or not log.landmarks:
            raise config.error(("map", "known"), "got truth, expected a log that has true landmarks")
        return [KnownLandmark(name, place) for name, place in log.landmarks.items()]
    path = _made(config, ("map", "known"), known_map_path, config)
    readers = {ending: read for entry in known_formats().values() for ending, read in entry.known_maps.items()}
    if path.suffix in readers:
        return _made(config, ("map", "known"), readers[path.suffix], path, exact)
    return _made(config, ("map", "known"), read_known, path, exact, None if log is None else log.origin)


def slam_from_config(path_or_name: str | Path) -> Slam:
    """Return the filter of a configuration file or shipped name; the log it names gives robots, starts and the rest.

    >>> slam_from_config("native")
    <Slam of 'robot' before its first event: 0 landmarks, Invariant, ByIdentity>
    """
    config = load_config(path_or_name)
    return build_slam(config) if config.log.path is None else build_slam(*open_run(path_or_name))


def build_picture(config: Config, robots: Iterable[str]) -> Picture:
    """Return the options of pictures that a configuration has, of these robots.

    Raises ModelError if they do not fit together or to the robots.

    >>> picture = build_picture(load_config("native", ["picture.view=top"]), ["rover"])
    >>> picture.view, picture.sigmas
    ('top', 3.0)
    """
    given: Picture | None = model_of(config.picture)
    picture = given or USUAL
    picture.check_colours(robots)
    return picture


def config_dict(config: Config) -> dict[str, Any]:
    """Return what is in force as plain values, to be saved as ``config.yaml`` and loaded again.

    It has what was asked for: presets, files, `each`.  `kalmark.slam.description.describe` has the filter made of it.

    >>> from kalmark.config import config_dict, load_config
    >>> config_dict(load_config("native"))["estimator"]["type"]
    'invariant'
    """
    return dict(plain_section(config))


def build_robot(config: Config, name: str, log: Log | None = None) -> Robot:
    """Return one robot with its sensors, started at the pose of the configuration, or else the log's truth."""
    key = name if name in config.robots else EACH
    if key not in config.robots:
        near = did_you_mean(name, [*config.robots])
        raise config.error(("robots",), f"got {', '.join(config.robots)}, expected {name!r} of the log, or each{near}")
    robot, path = config.robots[key], ("robots", key)
    if EACH in robot.sensors:
        raise config.error((*path, "sensors", EACH), "got each without a log, expected the sensors by their names")
    moves = _made(config, (*path, "motion"), model_of, robot.motion)
    if log is not None:
        refuse_controls(config, key, name, moves.columns, log)
    own = _start(config, (*path, "start"), robot.start, name, log, moves)
    found = _made(config, path, robot_described, name, plain_section(robot), **own)
    for s, mount in found.sensors.items():
        _refuse_odd_mount(config, (*path, "sensors", s), robot.sensors[s], mount)
    if log is not None:
        refuse_scans(config, key, name, found.sensors, log)
        if any(isinstance(event, Raw) and event.robot == name for event in log.events):
            for check in load_all("checks")[0].values():
                check(config, key, name, log)
    return found


def _names(config: Config, log: Log | None) -> list[str]:
    named = [name for name in config.robots if name != EACH]
    if log is None:
        return named or ["robot"]
    there = (*log.robots, *config.log.without_events)
    for name in named if config.log.robots is None else ():
        if name not in there:
            what = "got a robot that the log does not have"
            raise config.error(("robots", name), f"{what}, {one_near(log.robots, name)}")
    return [*dict.fromkeys(name for name in (*named, *there) if name in there)]


def _start(
    config: Config, path: KeyPath, section: Any, name: str, log: Log | None, moves: MotionModel
) -> dict[str, Any]:
    """Return the start of a robot and its covariance: as configured, else by the truth, else the origin."""
    if section is None:
        start, cov = (None, None) if log is None else true_start(log, name, moves)
        return {"start": start, "cov": cov}
    behind = state_columns(moves)
    at, cov = place_described(vars(section), moves.space.dof, behind)
    _refuse_contradiction(config, path, section, at, cov, behind)
    at_rest = isinstance(section, SpaceStartConfig) and section.at_rest
    return _made(config, path, _start_at_rest, moves, name, log, at, cov) if at_rest else {"start": at, "cov": cov}


def _refuse_contradiction(
    config: Config, path: KeyPath, section: Any, at: Any, cov: Any, behind: KeyPath = ()
) -> None:  # fmt: skip
    """Refuse a mount or a start, at a pose with a covariance, whose exact keys contradict the readable ones."""
    said = vars(section)
    exact = [key for key in EXACT if said.get(key) is not None]
    told = describe_place(at, world_of(said), cov, behind) if exact else {}
    for key in (section.model_fields_set & told.keys()) - {*EXACT}:
        if not np.allclose(said[key], told[key], rtol=1e-6, atol=1e-9):
            raise config.error(
                (*path, key),
                f"got {quote_value(said[key])}, expected {quote_value(told[key])} by its {' and '.join(exact)}, "
                "or none of these beside it",
            )


def _start_at_rest(motion: Inertial, name: str, log: Log | None, start: Any, cov: Any) -> dict[str, Any]:
    """Return the start of a robot whose log begins at rest, its covariance, and until when it does.

    Raises ModelError.
    """
    readings = [] if log is None else log.controls_of(name)
    if not readings:
        raise ModelError(
            f"{name} has no readings of its inertial unit yet, expected a log that begins at rest. Events one by one "
            f"have none: {BY_SIGMAS}; km.motion.start_at_rest estimates them"
        )
    t_ns = np.array([event.t_ns for event in readings])
    seconds, u = (t_ns - t_ns[0]) * 1e-9, np.array([event.u for event in readings])
    try:
        found = start_at_rest(motion, seconds, u, np.array(start, dtype=np.float64), np.asarray(cov, dtype=np.float64))
    except ModelError as error:
        raise ModelError(f"{error}. Begin where it stands, by log.from_s; or {BY_SIGMAS}") from None
    until_ns = int(t_ns[0]) + round(found.until_s * 1e9)
    return {"start": found.start, "cov": found.cov, "rests_until_ns": until_ns}


def _refuse_odd_mount(config: Config, path: KeyPath, section: Any, mount: Mount) -> None:
    """Refuse a height of a sensor that has none, and exact keys of a mount that contradict the readable ones."""
    place, path = section.mount, (*path, "mount")
    if world_of(vars(place)) == "plane" and place.z_m and not isinstance(mount.sensor, Raised):
        what = f"got {place.z_m:g}, expected none: a {section.type} measures in the plane"
        raise config.error((*path, "z_m"), what)
    _refuse_contradiction(config, path, place, mount.at, mount.cov)


def _made(config: Config, path: KeyPath, make: Callable[..., Any], *args: Any, **keys: Any) -> Any:
    """Return what `make` makes of these; errors name the place of the section at `path`."""
    try:
        return make(*args, **keys)
    except (ModelError, LogError, MapError) as error:
        raise config.error((*path, *error.path), str(error)) from None


def refuse_controls(config: Config, key: str, name: str, columns: KeyPath, log: Log) -> None:
    """Refuse controls that the motion of a robot does not take."""
    if name in log.control_columns:
        of = f"its motion {config.robots[key].motion.type}"
        log.refuse_columns(name, "", columns, of, did_you_mean, partial(_type_hint, "motion", f"{key}.motion", columns))


def refuse_scans(config: Config, key: str, name: str, mounts: Mapping[str, Mount], log: Log) -> None:
    """Refuse observations that a sensor does not take and, unless bad input is skipped, sensors not configured."""
    for (robot, sensor), given in log.sensor_columns.items():
        if robot != name or sensor not in mounts or not isinstance(mounts[sensor].detector, Laser | None):
            continue
        if mounts[sensor].detector is not None:
            log.refuse_columns(name, sensor, RAW[: max(len(given), 2)], "its beams", did_you_mean)
            continue
        of, columns = f"its type {config.robots[key].sensors[sensor].type}", tuple(mounts[sensor].sensor.columns)
        hint = partial(_type_hint, "sensor", f"{key}.sensors.{sensor}", columns)
        log.refuse_columns(name, sensor, columns, of, did_you_mean, hint)
    used = [sensor for robot, sensor in log.sensors() if robot == name]
    other = next((sensor for sensor in used if sensor not in mounts), None)
    if other is None or config.log.on_error == "skip":
        return
    file, line = log.places.get((name, other), (log.path, 0))
    where, idle = f"{file}{f':{line}' if line else ''}", [sensor for sensor in mounts if sensor not in used]
    if idle and not did_you_mean(other, [sensor for sensor in mounts if sensor in used]):  # it has another name
        meant = next((each for each in idle if did_you_mean(other, [each])), idle[0])
        what = f"the log has no scans by it, expected {other!r} as in {where}"
        raise config.error(
            ("robots", key, "sensors", meant), f"{what}; if that is another sensor, add robots.{key}.sensors.{other}"
        )
    known = f"one of {', '.join(mounts)}" if mounts else "none, as none is configured"
    what = f"{name} has scans of the sensor {other!r}, expected {known}"
    raise LogError(f"{where}: {what}; if it is another one, add robots.{key}.sensors.{other}")


def _type_hint(role: str, key: str, columns: KeyPath, given: KeyPath) -> str:
    """Return a hint at a type of kalmark's own models that takes the columns given, or at a height in the plane."""
    if given == (*columns, "z_m"):
        return "; leave z_m out, on the globe height_m: the robot is in the plane"
    fitting = next((registered_name(model) for model in built_in(role) if model.columns == given), None)
    return f"; try --set robots.{key}.type={fitting}" if fitting else ""
