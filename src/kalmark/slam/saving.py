"""A Slam on disk: one zip of arrays, a JSON description and their checksums, never pickle: loading runs nothing of it.

The settings are what a Slam is constructed with, the state is what events have made of it.  Registered models are saved
by name and parameters, in the keys of a configuration; others are to be given again.
"""

from __future__ import annotations

import hashlib
import io
import json
import math
import zipfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from kalmark.arrays import Array
from kalmark.codec import NOT_FINITE, Reader, Writer, kind_of, place_in_record
from kalmark.declare import class_of_file, classes
from kalmark.errors import KalmarkError, MapError
from kalmark.events import Id
from kalmark.files import refuse_bomb, replace_file
from kalmark.filter.map import Map
from kalmark.filter.maps import restore_map as restored_map
from kalmark.geometry.spaces import Rn, Space
from kalmark.management.hypotheses import POLAR
from kalmark.models.protocols import Landmark
from kalmark.slam.description import Description, arguments_of, describe, describe_model, model_described
from kalmark.slam.estimate import Estimate
from kalmark.slam.held_control import bias_block, bias_name
from kalmark.slam.pose_hypothesis import motion_of_hypothesis
from kalmark.slam.reader import StateReader
from kalmark.slam.robot import Robot, mount_name
from kalmark.slam.state import State
from kalmark.tracks.channel import Channel
from kalmark.tracks.track import ChannelKey, Status

VERSION = 24
DESCRIPTION, NUMBERS, SUMS = "slam.json", "numbers", "sha256"
LARGE = 1 << 20  # bytes of an array that is stored as it is: the digits of a large covariance do not compress


# ---------------------------------------------------------------------- saving
def save(path: Path, slam: Estimate) -> None:
    """Write settings and state; the file appears whole or not at all.  A model's own memory is not written.

    Raises MapError if the file cannot be written, or an id is neither an integer nor a text.
    """
    members = members_of(slam.state, {"kalmark": VERSION, "settings": _each(describe(slam), _to_text)})
    sums = "".join(f"{hashlib.sha256(data).hexdigest()}  {name}\n" for name, data in members.items()).encode()

    def pack(file: Path) -> None:
        with zipfile.ZipFile(file, "w") as archive:
            for name, data in (members | {SUMS: sums}).items():  # without the clock: equal maps are equal files
                small = len(data) < LARGE or name == f"{NUMBERS}.npy"
                archive.writestr(zipfile.ZipInfo(name), data, zipfile.ZIP_DEFLATED if small else zipfile.ZIP_STORED)

    try:
        replace_file(path, pack)
    except OSError as error:
        raise MapError(f"{path}: {error.strerror}, expected a file that can be written") from error


def members_of(state: State, head: Description) -> dict[str, bytes]:
    """Return what events have made of a Slam, as the files of an archive; `head` stands before it."""
    arrays: dict[str, Array] = {}

    def map_said(map_: Map) -> Description:
        said, prefix = map_.state(), f"{len(arrays)}." if arrays else ""  # it finishes a full update
        arrays.update({f"{prefix}{name}": array for name, array in map_.arrays()})
        return said | {"arrays": prefix}

    for given in state.given.values():
        given.sum_motions()
    writer = Writer({Map: map_said, Landmark: lambda of: _each(describe_model(of), _to_text)})
    said = head | {"columns": _columns(state.robots), "state": kind_of(State).write(writer, state)}
    arrays[NUMBERS] = writer.numbers()
    members = {DESCRIPTION: json.dumps(said, default=_plain, allow_nan=False).encode()}
    return members | {f"{name}.npy": _npy(array) for name, array in arrays.items()}


def fill_state(state: State, members: dict[str, bytes], landmarks: Landmark | None = None) -> None:
    """Fill a state as it is after construction with what `members_of` returned.

    `landmarks` is a type of the user's own, beside those of its sensors.  Raises MapError if the parts do not fit
    together.
    """
    own = [channel.landmark for channel in state.channels.values()]
    own += [each for each in (state.settings.landmarks, landmarks) if each is not None]
    world, said = next(iter(state.robots.values())).motion.space.world, json.loads(members[DESCRIPTION])

    def map_of(says: Description) -> Map:
        return restored_map(says, lambda name, shape: _array(members, f"{says['arrays']}{name}", shape))

    def model_of(says: Description) -> Landmark:
        return _landmark(says, own, world, place_in_record(reader))

    if said["columns"] != _columns(state.robots):
        raise MapError(f"columns of the motions are {_columns(state.robots)}, expected {said['columns']}")
    reader = Reader(_array(members, NUMBERS), {Map: map_of, Landmark: model_of})
    kind_of(State).read(reader, said["state"], state)
    tracks, slots = state.tracks, len(state.map.spaces)
    for track in tracks.confirmed.values():
        if not -1 <= track.slot < slots:
            raise MapError(f"slot of {track.id!r} is {track.slot}, expected one of {slots}")
    tracks.number()
    for name, other in [*state.pose_hypotheses.items(), *((name, of.prior) for name, of in state.sums.items())]:
        other.moving = motion_of_hypothesis(state.moving[name])
    carried: dict[ChannelKey, Channel | StateReader] = {**state.channels, **state.readers}
    for key, channel in carried.items():
        channel.mount = tracks.slots.get(mount_name(*key), -1)
    _check_owners(state)
    _check_measurements(state)


def _columns(robots: dict[str, Robot]) -> dict[str, list[str]]:
    return {name: list(robot.motion.columns) for name, robot in robots.items()}


def _plain(value: Any) -> Any:
    """Return arrays, which JSON has no word for, as lists."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    raise MapError(f"{value!r} cannot be saved, expected a number or a text")


def _npy(array: Array) -> bytes:
    file = io.BytesIO()
    np.lib.format.write_array(file, np.ascontiguousarray(array, dtype="<f8"), (1, 0), allow_pickle=False)
    return file.getvalue()


# ---------------------------------------------------------------------- loading
@contextmanager
def errors(path: Path) -> Iterator[None]:
    """Turn whatever a damaged file leads to into a MapError that names the file."""
    try:
        yield
    except KalmarkError as error:
        raise MapError(": ".join([str(path), *filter(None, [".".join(error.path)]), str(error)])) from error
    except OSError as error:
        said = error.strerror or error
        raise MapError(f"{path}: {said}, expected a map written by save()") from error
    except Exception as error:  # a damaged file fails in any way: in zlib, json, numpy or a model
        said = " ".join(str(error).split())[:160]
        raise MapError(f"{path}: {type(error).__name__}: {said}, expected a map written by save()") from error


def load(path: Path, built: Callable[..., Any], robots: Iterable[Robot] | None, **models: Any) -> Any:
    """Return the Slam of a file written by `save`, `built` of its arguments; a user's own models are given again.

    Raises MapError if the file is damaged, lacks a model, or was saved with other robots or landmarks.
    """
    with errors(path):
        description, members = _read(path)
        said, state = _each(description["settings"], _to_number), description["state"]
        own = models["landmarks"]
        of_tracks = [
            of["model"]
            for said_of in (*(state["tracks"][status.value] for status in Status), state["tracks"]["known"]["of_kind"])
            for _, of in said_of
        ]
        if own is not None and not is_type(own, said["landmarks"]):
            if not any(is_type(own, each) for each in of_tracks):
                names = sorted({_name(each) for each in (said["landmarks"], *of_tracks) if each is not None})
                raise MapError(f"landmarks is {type(own).__name__}, expected {' or '.join(names) or 'None'}")
            del models["landmarks"]
        given = {name: each for name, each in models.items() if each is not None}
        if robots is not None:
            given["robots"] = _same_robots([*robots], said["robots"])
        _refuse_own({name: each for name, each in said.items() if name not in given})
        slam = built(**arguments_of(said, **given))
        fill_state(slam.state, members, own)
        return slam


def _read(path: Path) -> tuple[Description, dict[str, bytes]]:
    """Return the description and the arrays' files, their checksums compared."""
    with zipfile.ZipFile(path) as archive:
        refuse_bomb(archive, path, MapError)
        state = json.loads(archive.read(DESCRIPTION))
        if state.get("kalmark") != VERSION:
            raise MapError(f"version is {state.get('kalmark')!r}, expected {VERSION}")
        sums = {name: sum_ for sum_, name in map(str.split, archive.read(SUMS).decode().splitlines())}
        members = {name: archive.read(name) for name in {DESCRIPTION, *sums}}
    for name, data in members.items():
        if hashlib.sha256(data).hexdigest() != sums.get(name):
            raise MapError(f"{name} is damaged: its checksum is not {sums.get(name)}")
    return state, members


def _array(members: dict[str, bytes], name: str, shape: tuple[int, ...] | None = None) -> Array:
    """Return an array of float64, its header compared with what is expected before anything is made of it."""
    file = io.BytesIO(members[f"{name}.npy"])
    version = np.lib.format.read_magic(file)
    got, fortran, dtype = np.lib.format.read_array_header_1_0(file)
    if (version, got, fortran, dtype) != ((1, 0), shape or got, False, np.dtype("<f8")):
        raise MapError(f"{name} is an array {got} of {dtype}, expected {shape} of float64")
    return np.frombuffer(file.read(), dtype).reshape(got).astype(np.float64)


def _check_owners(state: State) -> None:
    """Refuse a map whose blocks are not each one robot, one landmark or one other known thing, of their shapes."""
    owners = _owners(state)
    used = [i for i, space in enumerate(state.map.spaces) if space is not None]
    if sorted(_count(slot, f"slot of {what}") for what, slot, _ in owners) != used:
        raise MapError(f"the slots of the map are not used once each: {len(owners)} names, {len(used)} blocks")
    for what, slot, space in owners:
        block = state.map.spaces[slot]
        if block is None or block.kinds != space.kinds:
            raise MapError(f"{what} is a {space.name} of {space.size} numbers, its block in the map is {block}")


def _owners(state: State) -> list[tuple[str, int, Space]]:
    """Return what each block is, its slot and its space.  Raises MapError for names without a block."""
    robots, tracks = state.robots, state.tracks
    spaces: dict[Id, Space] = {name: robot.motion.space for name, robot in robots.items()}
    mounts = {mount_name(name, key): mount.block(key) for name, r in robots.items() for key, mount in r.sensors.items()}
    spaces |= {name: block[0] for name, block in mounts.items() if block is not None}
    biased = {name: block for name, r in robots.items() if (block := bias_block(r.motion)) is not None}
    spaces |= {bias_name(name): block[0] for name, block in biased.items()}
    spaces |= {name: track.model.space for name, track in tracks.confirmed.items()}
    if robots.keys() & tracks.confirmed.keys() or spaces.keys() != tracks.slots.keys():
        raise MapError("the slots' names are not those of the robots and landmarks")
    owners = [(f"{name!r}", slot, spaces[name]) for name, slot in tracks.slots.items()]
    owners += [(f"tentative {name!r}", t.slot, t.model.space) for name, t in tracks.tentative.items()]
    owners += [(f"a hypothesis of {p.name!r}", slot, POLAR) for p in tracks.waiting() for slot in p.hypotheses]
    for number, clone in state.clones.clones.items():
        owners.append((f"clone {number}", clone.slot, robots[clone.robot].motion.space.pose))
    errors = [(name, m) for name, m in state.moving.items() if m.error is not None]
    owners += [(f"the error of {name!r}", m.error, Rn(len(m.motion.columns))) for name, m in errors]  # type: ignore[misc]
    return owners


def _check_measurements(state: State) -> None:
    """Refuse measurements that were not made from a clone of the map by a sensor of its robots."""
    robots, tracks, clones = state.robots, state.tracks, state.clones
    measured = [m for t in tracks.tentative.values() for m in t.measurements]
    for m in (*measured, *(m for p in tracks.waiting() for m in p.measurements)):
        if m.clone not in clones.clones or (m.robot, m.sensor) not in clones.clones[m.clone].users:
            raise MapError(f"a measurement of {m.robot!r}, {m.sensor!r} does not fit the clones of the map")
        if m.y.shape != (len(robots[m.robot].sensors[m.sensor].sensor.columns),):
            raise MapError(f"a measurement of {m.robot!r}, {m.sensor!r} is {m.y.tolist()}")
    channels = {(name, sensor) for name, robot in robots.items() for sensor in robot.sensors}
    if not {*clones.users(), *(p.channel for p in tracks.waiting()), *tracks.candidates} <= channels:
        raise MapError("clones or pending measurements name sensors that no robot has")


def _count(value: Any, what: str) -> int:
    if type(value) is not int or value < 0:
        raise MapError(f"{what} is {value!r}, expected an integer of at least 0")
    return value


# ---------------------------------------------------------------------- models and robots
def _each(value: Any, change: Callable[[Any], Any]) -> Any:
    """Return a description with each of its values changed."""
    if isinstance(value, dict):
        return {key: _each(item, change) for key, item in value.items()}
    return [_each(item, change) for item in value] if isinstance(value, list) else change(value)


def _to_text(value: Any) -> Any:
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value


def _to_number(value: Any) -> Any:
    return float(value) if value in NOT_FINITE else value


def _landmark(said: Description, own: Sequence[Landmark], world: str, what: str) -> Landmark:
    """Return the model of a landmark: one of a user's `own`, or the registered one that is described."""
    like = [each for each in own if is_type(each, said)]
    found = next((each for each in like if _each(describe_model(each), _to_text) == said), None)
    if said["type"] in classes("landmark") and found is None:
        made: Landmark = model_described("landmark", _each(said, _to_number), world)
        return made
    if not like:
        raise MapError(f"{what} is {_name(said)}, a model of your own: give the landmarks to load() again")
    return found or like[0]


def is_type(landmark: Landmark, description: Description | None) -> bool:
    """Return whether a landmark type is the one that was saved."""
    return description is not None and describe_model(landmark)["type"] == description["type"]


def _refuse_own(said: Any, path: tuple[str, ...] = ()) -> None:
    """Refuse a description of a model of the user's own that has no name in this program."""
    for key, value in said.items():
        if isinstance(value, dict):
            _refuse_own(value, (*path, key))
        elif key == "type" and ":" in value and class_of_file(value) is None:
            what = f"{'.'.join(path)} is {_name(said)}, a model of your own"
            raise MapError(f"{what}: give the {path[0]} to load() again")


def _same_robots(given: list[Any], saved: Description) -> list[Robot]:
    """Return the robots given again in the order saved.  Raises MapError where they are others."""
    for robot in given:
        if not isinstance(robot, Robot):
            raise MapError(f"robots holds {robot!r}, expected nothing but robots")
    names, got = [*saved], [robot.name for robot in given]
    if sorted(got) != sorted(names):
        raise MapError(f"robots are {got}, expected {names}")
    for robot in given:
        for what, mine, expected in (
            ("motion is", describe_model(robot.motion)["type"], saved[robot.name]["motion"]["type"]),
            ("sensors are", sorted(robot.sensors), sorted(saved[robot.name]["sensors"])),
        ):
            if mine != expected:
                raise MapError(f"robot {robot.name!r}: {what} {mine}, expected {expected}")
    return sorted(given, key=lambda robot: names.index(robot.name))


def _name(description: Description) -> str:
    return str(description["type"]).rpartition(":")[2]
