"""Models and robots as JSON: registered ones by name and parameters, others by name alone, to be given again."""

from __future__ import annotations

import math
from dataclasses import fields
from typing import Any

import numpy as np

from kalmark.declare import by_class_name, registered_name
from kalmark.errors import MapError
from kalmark.models.protocols import Landmark
from kalmark.slam.robot import Mount, Robot

State = dict[str, Any]

NOT_FINITE = ("inf", "-inf", "nan")  # JSON has no word for them


def described(model: Any) -> State:
    """Return a model that has a name in configurations as its class and parameters, another as its class alone."""
    name = type(model).__name__
    if registered_name(type(model)) is None:
        return {"python": name, "kind": model.kind if isinstance(model, Landmark) else ""}
    return {"type": name, **{f.name: _plain(vars(model)[f.name]) for f in fields(model)}}


def _plain(value: Any) -> Any:
    """Return NumPy's numbers as Python's, and those JSON has no word for as text."""
    if isinstance(value, tuple):
        return [_plain(v) for v in value]
    value = value.item() if isinstance(value, np.generic) else value
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value


def restored(kind: str, description: State, what: str, argument: str) -> Any:
    """Make a registered model again; of another, say which argument of `load` has to give it."""
    if "python" in description:
        raise MapError(f"{what} is {_name(description)}, a model of your own: give the {argument} to load() again")
    model = by_class_name(kind, description["type"])
    if model is None:
        raise MapError(f"{what} is {description['type']!r}, expected one of kalmark's, or of a plugin that is loaded")
    parameters = {k: v for k, v in description.items() if k != "type"}
    return model(**{k: float(v) if v in NOT_FINITE else v for k, v in parameters.items()})


def _name(description: State) -> str:
    return str(description.get("type") or description["python"])


def same(landmark: Any, description: State | None) -> bool:
    """Return whether a landmark type is the one that was saved."""
    if description is None:
        return False
    mine = described(landmark)
    return _name(mine) == _name(description) and mine.get("kind") == description.get("kind")


def robot_described(robot: Robot) -> State:
    """Return a robot with its motion, its start and its mounted sensors."""
    mounts = [
        [
            name,
            {
                "sensor": described(mount.sensor),
                "at": list(mount.at),
                "landmark": None if mount.landmark is None else described(mount.landmark),
                "association": None if mount.association is None else described(mount.association),
                "detector": None if mount.detector is None else described(mount.detector),
                "attention": described(mount.attention),
                "upkeep": None if mount.upkeep is None else described(mount.upkeep),
                "initialization": None if mount.initialization is None else described(mount.initialization),
                "cov": None if mount.cov is None else np.asarray(mount.cov).tolist(),
            },
        ]
        for name, mount in robot.sensors.items()
    ]
    cov = None if robot.cov is None else np.asarray(robot.cov).tolist()
    moved = {"motion": described(robot.motion), "columns": list(robot.motion.columns)}
    return {"name": robot.name, **moved, "start": list(robot.start), "cov": cov, "sensors": mounts}


def _robot_restored(d: State) -> Robot:
    who, mounts = f"robot {d['name']!r}", {}
    for name, m in d["sensors"]:
        what = f"{who}: sensor {name!r}"
        if m["detector"] is True:  # written before kalmark had its own
            raise MapError(f"{what} has a detector of your own: give the robots to load() again")
        finds = m["detector"] and restored("detector", m["detector"], f"{what}: detector", "robots")
        landmark = m["landmark"] and restored("landmark", m["landmark"], f"{what}: landmark", "robots")
        paired = m["association"] and restored("association", m["association"], f"{what}: association", "robots")
        budget = restored("attention", m["attention"], f"{what}: attention", "robots")
        cleaned = m.get("upkeep") and restored("upkeep", m["upkeep"], f"{what}: upkeep", "robots")
        late = m.get("initialization") and restored("initialization", m["initialization"], what, "robots")
        sensor = restored("sensor", m["sensor"], what, "robots")
        mounts[name] = Mount(sensor, m["at"], landmark, paired, finds or None, budget, m["cov"], cleaned, late)
    return Robot(d["name"], restored("motion", d["motion"], f"{who}: motion", "robots"), d["start"], mounts, d["cov"])


def robots_restored(saved: list[State], given: list[Robot] | None) -> list[Robot]:
    """Return the robots in the order saved: restored, or those given again if they are the same."""
    if given is None:
        return [_robot_restored(d) for d in saved]
    for robot in given:
        if not isinstance(robot, Robot):
            raise MapError(f"robots holds {robot!r}, expected nothing but robots")
    names = [d["name"] for d in saved]
    got = [robot.name for robot in given]
    if sorted(got) != sorted(names):
        raise MapError(f"robots are {got}, expected {names}")
    given = sorted(given, key=lambda robot: names.index(robot.name))
    for robot, d in zip(given, saved, strict=True):
        for what, mine, expected in (
            ("motion is", type(robot.motion).__name__, _name(d["motion"])),
            ("columns of the motion are", list(robot.motion.columns), d["columns"]),
            ("sensors are", sorted(map(str, robot.sensors)), sorted(str(name) for name, _ in d["sensors"])),
        ):
            if mine != expected:
                raise MapError(f"robot {robot.name!r}: {what} {mine}, expected {expected}")
    return given


def landmark_type(state: State, given: Landmark | None) -> Landmark | None:
    """Return the slam's type of landmark; one given again must be one that was saved."""
    saved = state["landmarks"]
    if given is not None:
        known = [saved, *(d for _, d in state["kinds"])]
        if not any(same(given, d) for d in known):
            names = sorted({_name(d) for d in known if d is not None})
            raise MapError(f"landmarks is {type(given).__name__}, expected {' or '.join(names) or 'None'}")
        if same(given, saved):
            return given
    return None if saved is None else restored("landmark", saved, "landmarks", "landmarks")
