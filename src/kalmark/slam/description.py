"""The description of a Slam in data, by the keys of a configuration: a run's `config.yaml` and a saved map have it.

It follows from the declarations: the fields of `Robot`, `Mount` and `Settings` and the parameters of models.  A pose or
a covariance that the readable keys (angles in degrees, one sigma a coordinate) do not give to the last bit has an exact
key beside them: `quaternion`, `state` or `cov`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from types import FunctionType
from typing import Any

import numpy as np

import kalmark.detect
import kalmark.management.initialization
import kalmark.models.landmarks
import kalmark.models.motion
import kalmark.models.sensors  # noqa: F401 - all of these register their models
from kalmark.arrays import Array
from kalmark.declare import (
    class_of,
    classes,
    declared_options,
    has_one_model,
    own_name,
    parameters,
    place_of_object,
    registered_name,
)
from kalmark.errors import KalmarkError, ModelError
from kalmark.events import Id, short_text
from kalmark.geometry.named_poses import describe_pose, pose_of, world_of
from kalmark.models.landmark_views import Raised
from kalmark.models.protocols import state_columns
from kalmark.slam.estimate import Estimate
from kalmark.slam.robot import Mount, Robot
from kalmark.slam.state import Settings

Description = dict[str, Any]

STATES = {
    "plane": {
        "vx_mps": "constant_velocity, constant_turn_rate: velocity forward.",
        "vy_mps": "constant_velocity: velocity to the left.",
        "w_radps": "constant_velocity, constant_turn_rate: turn rate.",
        "slip": "slipping_unicycle: velocity to the left, as a share of the speed.",
    },
    "space": {
        **dict.fromkeys(("vx_mps", "vy_mps", "vz_mps"), "constant_velocity_3d, inertial: velocity in the world."),
        **{f"w{axis}_radps": f"constant_velocity_3d: rate about the robot's own {axis}." for axis in "xyz"},
        **{f"bias_w{axis}_radps": f"inertial: bias of the rate about {axis}." for axis in "xyz"},
        **{f"bias_a{axis}_mps2": f"inertial: bias of the specific force along {axis}." for axis in "xyz"},
        **{f"gravity_{axis}_mps2": "inertial_gravity: gravity in the map's frame." for axis in "xyz"},
    },
}
"""Components of a state after its pose, as keys of a start, with their documentation."""
SIGMAS = {
    "plane": (("sigma_xy_m", 0), ("sigma_xy_m", 1), ("sigma_theta_rad", 0)),
    "space": (*(("sigma_position_m", k) for k in range(3)), *(("sigma_rotation_deg", k) for k in range(3))),
}
"""The keys of the sigmas of a pose and their axes."""
EXACT = ("quaternion", "state", "cov")
NONE = (None, {"type": "immediate"})  # parts of a mount that are not there
_AXIS = re.compile(r"(?:_|(?<=[vwa]))[xyz](?=_)")  # of a key: vx_mps, gravity_x_mps2


def describe(slam: Estimate) -> Description:
    """Return a Slam as a configuration has it: robots, landmarks, association, upkeep, estimator, map."""
    out = _own_options(slam.state.settings)
    linear = out.pop("reparametrize")
    kept = {"type": out.pop("map"), "numbers": out.pop("numbers"), "reparametrize": "off" if linear is None else linear}
    return {"robots": {name: _robot(robot) for name, robot in slam.robots.items()}, **out, "map": kept}


def describe_beginning(slam: Estimate) -> Description:
    """Return `describe` of a Slam before its first event, with what was added to its map: the `landmarks` of `map`.

    They are as `Slam.add_landmark` takes them, those known exactly last.  `cov` of `map` is the covariance of all that
    is in it, if they are correlated: `Slam.fuse`.
    """
    out, tracks, found, end = describe(slam), slam.tracks, list[Description](), 0
    P = slam.covariance(*tracks.slots)
    alone = np.zeros_like(P)
    for name, slot in tracks.slots.items():
        begin, end = end, end + len(slam.map.rows(slot))
        own = alone[begin:end, begin:end] = P[begin:end, begin:end]
        if name in tracks.confirmed:
            found.append(_landmark(slam, name) | {"cov": own.tolist()})
        elif (robot := slam.robots.get(str(name))) is not None:
            cov = own if own.any() else robot.cov
            at = slam.mean(name), robot.motion.space.world, cov, state_columns(robot.motion)
            out["robots"][name]["start"] = describe_place(*at)
    found += [_landmark(slam, name) for name in tracks.known]
    said = {"landmarks": found} if found else {}
    out["map"] |= said if np.array_equal(P, alone) else said | {"cov": P.tolist()}
    return out


def _landmark(slam: Estimate, name: Id) -> Description:
    return {"id": name, "landmark": describe_model(slam.landmark_model(name)), "mean": slam.mean(name).tolist()}


def plain_value(value: Any) -> Any:
    """Return a value made of dicts, lists, texts, numbers and None only, ready for YAML or JSON."""
    if isinstance(value, dict):
        return {str(key): plain_value(item) for key, item in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [plain_value(item) for item in value]
    if isinstance(value, np.ndarray | np.generic):
        return plain_value(value.tolist())
    return value if value is None or isinstance(value, bool | int | float | str) else str(value)


def describe_model(value: Any) -> Description:
    """Return the type and the parameters of a model.

    That of a user's without a name is file.py:NAME, of an object in his file or of a class there.
    """
    kind: Any = value if isinstance(value, FunctionType) else type(value)
    if registered_name(kind) is None and (place := place_of_object(value)):
        return {"type": f"{place[0].name}:{place[1]}"}
    name = registered_name(kind) or own_name(kind)
    given = {own.name: plain_value(vars(value)[own.name]) for own in parameters(type(value)) if own.name in vars(value)}
    return given if has_one_model(name) else {"type": name} | given


# ---------------------------------------------------------------------- and back
@contextmanager
def part(*path: str) -> Iterator[None]:
    """Add the keys that lead to a part of a description to the errors of that part."""
    try:
        yield
    except KalmarkError as error:
        error.path = (*path, *error.path)
        raise


def arguments_of(said: Description, **given: Any) -> Description:
    """Return the arguments of the Slam that `describe` describes, some of them `given` instead.

    Raises ModelError with the `path` of the part that cannot be made.
    """
    robots = given.get("robots") or [robot_described(name, each) for name, each in said["robots"].items()]
    storage = said["map"]
    kept = said | {"map": storage["type"], "numbers": storage["numbers"], "reparametrize": storage["reparametrize"]}
    own = {key: value for key, value in kept.items() if key not in given and value != "off"}
    parts = {"reparametrize": None} | _options(Settings, own, robots[0].motion.space.world)
    return parts | given | {"robots": robots}


def robot_described(name: str, said: Description, **own: Any) -> Robot:
    """Return a robot that is described; `own` are arguments in the place of those described.  Raises ModelError."""
    own = _options(Robot, said) | own
    space, behind = own["motion"].space, state_columns(own["motion"])
    if "start" not in own:
        own["start"], own["cov"] = place_described(said["start"], space.dof, behind)
    sensors = {}
    for key, each in said["sensors"].items():
        with part("sensors", key):
            model = model_described("sensor", each, space.world)
            at, cov = place_described(each["mount"], space.pose.dof)
            sensors[key] = Mount(model, at=at, cov=cov, **_options(Mount, each, space.world))
    return Robot(name, sensors=sensors, **own)


def _options(of: type, said: Description, world: str = "") -> Description:
    """Return the options of a class that are described, models made."""
    out = {each.name: said[each.name] for each in declared_options(of) if said.get(each.name) not in NONE}
    for each in declared_options(of):
        if each.role and each.name in out:
            with part(each.name):
                out[each.name] = model_described(each.role, out[each.name], world)
    return out


def model_described(role: str, said: Mapping[str, Any], world: str = "") -> Any:
    """Return the model that `describe_model` describes, of the plane or of space where its type leaves that open.

    The height of a sensor of the plane is that of its `mount`.  Raises ModelError for an unknown type, and if
    the model refuses its parameters.
    """
    name = said.get("type", role)
    try:
        kind = class_of(role, name, world)
    except KeyError:
        got = f"got {short_text(name)}, expected one of {', '.join(classes(role, world))}"
        raise ModelError(f"type: {got}") from None
    if world == "plane" and "mount" in said:
        said = {"height_m": said["mount"].get("z_m", 0.0), **said}
    own = [each for each in parameters(kind) if each.name in said]
    given = {each.name: said[each.name] for each in own if each.optional or said[each.name] is not None}
    try:
        return kind(**{key: tuple(value) if isinstance(value, list) else value for key, value in given.items()})
    except (AttributeError, TypeError) as error:
        raise ModelError(f"{name} cannot be made of the keys of its section: {error}") from None


def place_described(
    said: Mapping[str, Any], dof: int, behind: tuple[str, ...] = ()
) -> tuple[list[float], Array | None]:
    """Return the pose, with a whole state, of a mount or a start, and its covariance (dof, dof), None if it has none.

    `behind` are the names of what the state has behind its pose.
    """
    names = state_names(behind, world_of(said))
    state = said["state"] if said.get("state") is not None else [said[name] for name in names]
    return [*pose_of(said), *state], covariance_of(said, dof, behind)


# ---------------------------------------------------------------------- parts
def _described(value: Any) -> Any:
    return (
        plain_value(value) if isinstance(value, bool | int | float | str | np.generic | None) else describe_model(value)
    )


def _own_options(owner: Any) -> Description:
    return {each.name: _described(vars(owner)[each.name]) for each in declared_options(type(owner))}


def _robot(robot: Robot) -> Description:
    world = robot.motion.space.world
    start = describe_place(robot.start, world, robot.cov, state_columns(robot.motion))
    sensors = {name: _mount(mount, world) for name, mount in robot.sensors.items()}
    return {**_own_options(robot), "start": start, "sensors": sensors}


def _mount(mount: Mount, world: str) -> Description:
    out, place = describe_model(mount.sensor), describe_place(mount.at, world, mount.cov)
    if isinstance(mount.sensor, Raised):
        place["z_m"] = out.pop("height_m")
    own = _own_options(mount)
    own["initialization"] = own["initialization"] or {"type": "immediate"}
    return out | {"mount": place} | own


# ---------------------------------------------------------------------- mounts and starts
def describe_place(at: Any, world: str, cov: Any = None, behind: tuple[str, ...] = ()) -> Description:
    """Return a mount or a start `at` a pose, or with a whole state, and its covariance, by the keys of its section.

    `behind` are the names of what the state has behind its pose.
    """
    at, pose, names = np.asarray(at, dtype=np.float64), 3 if world == "plane" else 7, state_names(behind, world)
    said: Description = describe_pose(at[:pose]) | dict(zip(names, at[pose:].tolist(), strict=False))
    P = np.zeros((0, 0)) if cov is None else np.asarray(cov, dtype=np.float64)
    keys, sigmas = [*SIGMAS[world], *map(sigma_of, names)], np.zeros(len(at))
    sigmas[: len(P)] = np.sqrt(np.maximum(np.diagonal(P), 0.0))
    by_key: dict[str, list[float]] = {}
    for (key, axis), sigma in zip(keys, sigmas.tolist(), strict=False):
        by_key.setdefault(key, [0.0] * 3)[axis] = math.degrees(sigma) if key.endswith("_deg") else sigma
    said |= {key: each if world == "space" and len({*each}) > 1 else each[0] for key, each in by_key.items()}
    exact = {"state": at[pose:].tolist()} if at[pose:].any() and not names else {}
    if not np.array_equal(pose_of(said), at[:pose]):
        exact["quaternion"] = at[3:7].tolist()
    found = covariance_of(said, len(P), behind)
    if cov is not None and (found is None or not np.array_equal(found, P)):
        exact["cov"] = P.tolist()
    return said | exact


def covariance_of(said: Mapping[str, Any], dof: int, behind: tuple[str, ...] = ()) -> Array | None:
    """Return the covariance (dof, dof) of a mount or a start, None if it is known exactly.

    `behind` are the names of what the state has behind its pose.
    """
    if said.get("cov") is not None:
        return np.array(said["cov"], dtype=np.float64)
    world, sigmas = world_of(said), np.zeros(dof)
    for k, (key, axis) in enumerate([*SIGMAS[world], *map(sigma_of, state_names(behind, world))][:dof]):
        sigma = np.broadcast_to(np.asarray(said[key], dtype=np.float64), 3)[axis]
        sigmas[k] = np.radians(sigma) if key.endswith("_deg") else sigma
    return np.diag(np.square(sigmas)) if sigmas.any() else None


def sigma_of(name: str) -> tuple[str, int]:
    """Return the key of a start with the sigma of what a state has behind its pose, and its axis, 0 of no axis."""
    found = _AXIS.search(name)
    return f"sigma_{_AXIS.sub('', name, count=1)}", "xyz".index(found[0][-1]) if found else 0


def state_names(behind: tuple[str, ...], world: str) -> tuple[str, ...]:
    """Return the names of a state behind its pose, if a start has keys for all of them."""
    return behind if {*behind} <= {*STATES[world]} else ()
