"""A Slam on disk: one zip of arrays and a JSON description, never pickle, so that loading a file runs nothing of it.

Models that are kalmark's own are written by name and parameters.  A user's model is written by its name alone: `load`
then wants the robots again.
"""

from __future__ import annotations

import json
import math
import os
import zipfile
from collections.abc import Iterable
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from kalmark.errors import MapError
from kalmark.filter import estimators
from kalmark.filter.map import StochasticMap
from kalmark.geometry.spaces import Space
from kalmark.models import landmarks, motion, sensors
from kalmark.slam import association
from kalmark.slam.robot import Mount, Robot
from kalmark.slam.slam import Slam

VERSION = 1
MODULES = {
    "motion": motion,
    "sensor": sensors,
    "landmark": landmarks,
    "estimator": estimators,
    "association": association,
}


def _described(model: Any) -> dict[str, Any]:
    """Return a model as its name and those parameters that differ from the defaults."""
    own = is_dataclass(model) and any(type(model) is getattr(m, type(model).__name__, None) for m in MODULES.values())
    if not own:
        return {"python": type(model).__qualname__}
    values = {f.name: getattr(model, f.name) for f in fields(model)}
    kept = {k: v for k, v in values.items() if not (isinstance(v, float) and not math.isfinite(v))}
    return {"type": type(model).__name__, **kept}


def _restored(kind: str, description: dict[str, Any]) -> Any:
    description = dict(description)
    if "python" in description:
        raise MapError(f"{kind} is {description['python']}, a model of your own: give the robots to load() again")
    name = description.pop("type")
    model = getattr(MODULES[kind], name, None)
    if not is_dataclass(model):
        raise MapError(f"{kind} is {name!r}, expected one of kalmark's")
    return model(**description)  # type: ignore[operator]


def _robot_described(robot: Robot) -> dict[str, Any]:
    mounts = {
        name: {
            "sensor": _described(mount.sensor),
            "at": list(mount.at),
            "landmark": None if mount.landmark is None else _described(mount.landmark),
        }
        for name, mount in robot.sensors.items()
    }
    cov = None if robot.cov is None else np.asarray(robot.cov).tolist()
    start = {"start": list(robot.start), "cov": cov}
    return {"name": robot.name, "motion": _described(robot.motion), **start, "sensors": mounts}


def _robot_restored(d: dict[str, Any]) -> Robot:
    mounts = {
        name: Mount(
            _restored("sensor", m["sensor"]),
            m["at"],
            None if m["landmark"] is None else _restored("landmark", m["landmark"]),
        )
        for name, m in d["sensors"].items()
    }
    return Robot(d["name"], _restored("motion", d["motion"]), d["start"], mounts, d["cov"])


def save(slam: Slam, path: Path) -> None:
    """Write the state; the file appears whole or not at all."""
    m, drives = slam.map, slam._drives
    lower = np.tril_indices(m.n)
    arrays: dict[str, Any] = {
        "x": m.x[: m.x_n], "x_first": m.x_first[: m.x_n], "P": m.P[: m.n, : m.n][lower], "blocks": m.blocks,
        "atoms": m.atoms,
    }  # fmt: skip
    for i, drive in enumerate(drives.values()):
        if drive.u is not None and drive.N is not None:
            arrays[f"u{i}"], arrays[f"N{i}"] = drive.u, drive.N
    state = {
        "kalmark": VERSION,
        "robots": [_robot_described(r) for r in slam.robots.values()],
        "association": _described(slam.association),
        "estimator": _described(slam.estimator),
        "t_ns": slam.t_ns,
        "n": m.n,
        "capacity": len(m.x),
        "spaces": [None if s is None else [s.name, list(s.kinds)] for s in m.spaces],
        "free": [[list(kinds), slots] for kinds, slots in m._free.items()],
        "slots": [[name, slot] for name, slot in slam._slots.items()],
        "kinds": [[name, _described(kind)] for name, kind in slam._kinds.items()],
        "seen": [[name, count] for name, count in slam._seen.items()],
        "errors": slam._errors,
        "drives": [[drive.t_ns, drive.fresh] for drive in drives.values()],
        "unnamed": slam._unnamed,
    }
    temporary = path.with_name(path.name + ".part")
    with zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("slam.json", json.dumps(state))
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w") as file:
                np.lib.format.write_array(file, np.ascontiguousarray(array), allow_pickle=False)
    os.replace(temporary, path)


def load(path: Path, robots: Iterable[Robot] | None = None) -> Slam:
    """Read a state written by `save`."""
    try:
        with zipfile.ZipFile(path) as archive:
            state = json.loads(archive.read("slam.json"))
            arrays = {}
            for name in archive.namelist():
                if name.endswith(".npy"):
                    with archive.open(name) as file:
                        arrays[name[:-4]] = np.lib.format.read_array(file, allow_pickle=False)
    except (OSError, zipfile.BadZipFile, KeyError, ValueError) as error:
        raise MapError(f"{path}: {error}, expected a map written by save()") from None
    if state.get("kalmark") != VERSION:
        raise MapError(f"{path}: version {state.get('kalmark')!r}, expected {VERSION}")
    given = None if robots is None else list(robots)
    slam = Slam(
        [_robot_restored(r) for r in state["robots"]] if given is None else given,
        _restored("association", state["association"]),
        _restored("estimator", state["estimator"]),
    )
    names = [r["name"] for r in state["robots"]]
    if list(slam.robots) != names:
        raise MapError(f"{path}: robots are {list(slam.robots)}, expected {names}")
    _fill(slam, state, arrays)
    return slam


def _fill(slam: Slam, state: dict[str, Any], arrays: dict[str, Any]) -> None:
    slam.map = m = StochasticMap(state["capacity"])
    m.n, m.x_n = state["n"], len(arrays["x"])
    m.x[: m.x_n], m.x_first[: m.x_n] = arrays["x"], arrays["x_first"]
    m.P[: m.n, : m.n][np.tril_indices(m.n)] = arrays["P"]
    m.blocks, m.atoms = arrays["blocks"].copy(), arrays["atoms"].copy()
    m.spaces = [None if s is None else Space(s[0], tuple(s[1])) for s in state["spaces"]]
    m._free = {tuple(kinds): slots for kinds, slots in state["free"]}
    slam.t_ns, slam._unnamed, slam._errors = state["t_ns"], state["unnamed"], state["errors"]
    slam._slots = dict(map(tuple, state["slots"]))
    slam._seen = dict(map(tuple, state["seen"]))
    mine = {type(v.landmark).__qualname__: v.landmark for v in slam._views.values()}
    slam._kinds = {i: mine.get(d.get("python", "")) or _restored("landmark", d) for i, d in state["kinds"]}
    for i, (drive, (t_ns, fresh)) in enumerate(zip(slam._drives.values(), state["drives"], strict=True)):
        drive.t_ns, drive.fresh = t_ns, fresh
        drive.u, drive.N = arrays.get(f"u{i}"), arrays.get(f"N{i}")
