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
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from kalmark.arrays import Array
from kalmark.declare import class_of, class_of_file, classes
from kalmark.errors import KalmarkError, MapError
from kalmark.events import Id
from kalmark.files import refuse_bomb, replace_file
from kalmark.filter.maps import restored as restored_map
from kalmark.geometry.spaces import SE2, SE3, Rn, Space
from kalmark.management.hypotheses import POLAR
from kalmark.models.protocols import Landmark
from kalmark.slam.alternative import Alternative, alone
from kalmark.slam.description import Description, describe, model
from kalmark.slam.estimate import Estimate
from kalmark.slam.gaussian_sum import GaussianSum
from kalmark.slam.held_control import Mean, Moving, bias_block, bias_name
from kalmark.slam.held_readings import Given
from kalmark.slam.reader import Reader
from kalmark.slam.replacing import LeftOut
from kalmark.slam.robot import Robot, mount_name
from kalmark.slam.state import State
from kalmark.tracks.channel import Channel
from kalmark.tracks.clones import Clone, Clones, Measurement
from kalmark.tracks.looks import Looks
from kalmark.tracks.track import ChannelKey, Pending, Status, Track, Tracks

VERSION = 16
DESCRIPTION, SUMS = "slam.json", "sha256"
LARGE = 1 << 20  # bytes of an array that is stored as it is: the digits of a large covariance do not compress
OF_TRACKS = (
    "recent",
    "last_scan",
    "changes",
    "searched",
    "unnamed",
    "experience",
    "looked",
    "detection",
)  # beside the tracks
NOT_FINITE = ("inf", "-inf", "nan")  # JSON has no word for them


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
                small = len(data) < LARGE
                archive.writestr(zipfile.ZipInfo(name), data, zipfile.ZIP_DEFLATED if small else zipfile.ZIP_STORED)

    try:
        replace_file(path, pack)
    except OSError as error:
        raise MapError(f"{path}: {error.strerror}, expected a file that can be written") from error


def members_of(state: State, head: Description) -> dict[str, bytes]:
    """Return what events have made of a Slam, as the files of an archive; `head` stands before it."""
    said = json.dumps(head | {"state": _state(state)}, default=_plain, allow_nan=False)
    return {DESCRIPTION: said.encode()} | {f"{name}.npy": _npy(array) for name, array in _arrays(state)}


def fill(state: State, members: dict[str, bytes]) -> None:
    """Fill a state as it is after construction with what `members_of` returned."""
    _Saved(json.loads(members[DESCRIPTION])["state"], members, state.settings.landmarks).fill(state)


def _state(state: State) -> Description:
    tracks = state.tracks
    all_ = [*tracks.confirmed.values(), *tracks.tentative.values(), *tracks.pending.values()]
    blocks = {name: slot for name, slot in tracks.slots.items() if name not in tracks.confirmed}
    return {
        "t_ns": state.t_ns,
        "columns": _columns(state.robots),
        "taken": sorted(map(list, state.taken)),
        "placed": state.placed,
        "map": state.map.state(),
        "blocks": [[_id(name), slot] for name, slot in blocks.items()],
        "tracks": [_record(track) | {"id": _id(track.id)} for track in all_],
        "candidates": [[*key, [_record(c) for c in candidates]] for key, candidates in tracks.candidates.items()],
        "known": [
            {"model": of.model, "names": [*map(_id, of.names)], "counts": of.counts.tolist()}
            for of in tracks.known.of_kind.values()
        ],
        "reserved": sorted(map(_id, tracks.reserved)),
        **{name: getattr(tracks, name) for name in OF_TRACKS},
        "looks": [[*key, *looks.saved()] for key, looks in tracks.looks.items()],
        "given": [[*key, given.saved()] for key, given in state.given.items()],
        "alternatives": [
            [name, other.since_ns, other.misses, other.map.state()] for name, other in state.alternatives.items()
        ],
        "sums": [_sum(name, of) for name, of in state.sums.items()],
        "clones": [[number, _record(clone)] for number, clone in state.clones.clones.items()],
        "latest": state.clones.latest,
        "numbered": state.clones.numbered,
        "moving": {name: _moving(m) for name, m in state.moving.items()},
        "readers": [
            [*key, reader.t_ns, None if reader.standing is None else reader.standing.state(), *reader.saved()]
            for key, reader in state.readers.items()
        ],
        "front_ends": [[*key, front_end.state()] for key, front_end in state.front_ends.items()],
        "surveys": {
            "trial": [[_id(name), count] for name, count in state.surveys.trial.items()],
            "misfits": [
                [_id(name), out, sorted(map(_id, fit), key=str)] for name, (out, fit) in state.surveys.misfits.items()
            ],
            "strangers": [
                [robot, sorted(map(_id, names), key=str)] for robot, names in state.surveys.strangers.items()
            ],
        },
    }


def _columns(robots: dict[str, Robot]) -> dict[str, list[str]]:
    return {name: list(robot.motion.columns) for name, robot in robots.items()}


def _moving(m: Moving) -> list[Any]:
    gaps = None if m.held.gaps is None else m.held.gaps.state()
    number = 0 if m.held.mean is None else m.held.mean.number
    return [m.error, m.held.t_ns, m.held.fresh, gaps, [[part.tolist() for part in one] for one in m.left_out], number]


def _record(value: Any) -> Description:
    """Return a record as its fields."""
    return {field.name: getattr(value, field.name) for field in fields(value)}


def _plain(value: Any) -> Any:
    """Return what JSON has no word for: arrays as lists, records as their fields, models as they are described."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, set | frozenset):
        return sorted(value, key=str)
    if isinstance(value, Status):
        return value.value
    if isinstance(value, Measurement | Pending):
        return _record(value)
    if isinstance(value, Landmark):
        return _each(model(value), _to_text)
    raise MapError(f"{value!r} cannot be saved, expected a number or a text")


def _id(name: Any) -> Any:
    name = name.item() if isinstance(name, np.generic) else name
    if not isinstance(name, int | str):
        raise MapError(f"landmark {name!r} cannot be saved, expected an id that is an integer or a text")
    return name


def _sum(name: str, of: GaussianSum) -> list[Any]:
    maps = [each.map.state() for each in of.all()]
    return [name, of.prior_log, str(of.lead), of.linear, of.log_weights.tolist(), of.prior.since_ns, maps]


def _arrays_of_sums(state: State) -> Iterator[tuple[str, Array]]:
    for i, of in enumerate(state.sums.values()):
        for j, each in enumerate(of.all()):
            for name, array in each.map.arrays():
                yield f"sum{i}.{j}.{name}", array


def _arrays(state: State) -> Iterator[tuple[str, Array]]:
    yield from state.map.arrays()
    for i, of in enumerate(state.tracks.known.of_kind.values()):
        yield f"known{i}", of.values
    for i, front_end in enumerate(state.front_ends.values()):
        for name, array in front_end.arrays().items():
            yield f"{name}{i}", array
    for i, other in enumerate(state.alternatives.values()):
        for name, array in other.map.arrays():
            yield f"alternative{i}.{name}", array
    yield from _arrays_of_sums(state)
    for i, moving in enumerate(state.moving.values()):
        if moving.held.u is not None and moving.held.N is not None:
            yield f"u{i}", moving.held.u
            yield f"N{i}", moving.held.N
        if moving.held.usual is not None:
            yield f"usual{i}", moving.held.usual
        if moving.held.mean is not None:
            yield f"rate{i}", moving.held.mean.rate


def _npy(array: Array) -> bytes:
    file, kind = io.BytesIO(), "|u1" if array.dtype == np.uint8 else "<f8"
    np.lib.format.write_array(file, np.ascontiguousarray(array, dtype=kind), (1, 0), allow_pickle=False)
    return file.getvalue()


# ---------------------------------------------------------------------- loading
@contextmanager
def errors(path: Path) -> Iterator[None]:
    """Turn whatever a damaged file leads to into a MapError that names the file."""
    try:
        yield
    except KalmarkError as error:
        raise MapError(f"{path}: {error}") from error
    except OSError as error:
        said = error.strerror or error
        raise MapError(f"{path}: {said}, expected a map written by save()") from error
    except Exception as error:  # a damaged file fails in any way: in zlib, json, numpy or a model
        said = " ".join(str(error).split())[:160]
        raise MapError(f"{path}: {type(error).__name__}: {said}, expected a map written by save()") from error


@dataclass(frozen=True)
class _Saved:
    """What a Slam takes over once it is constructed as it was; `_landmarks` are the user's own, given again."""

    _state: Description
    _members: dict[str, bytes]
    _landmarks: Landmark | None = None

    def fill(self, state: State) -> None:
        """Fill a state as it is after construction.  Raises MapError if the parts do not fit together."""
        s, given = self._state, [channel.landmark for channel in state.channels.values()]
        if self._landmarks is not None:
            given.append(self._landmarks)
        map_ = restored_map(s["map"], partial(_array, self._members))
        robots, tracks, clones = state.robots, Tracks(state.robots), Clones()
        world = next(iter(robots.values())).motion.space.world
        _check_columns(robots, s["columns"])
        state.t_ns, state.map, state.tracks, state.clones = _time(s["t_ns"]), map_, tracks, clones
        state.placed = _count(s["placed"], "placed")
        state.taken = {(str(kind), str(robot), str(sensor)) for kind, robot, sensor in s.get("taken", ())}
        for name, slot in s["blocks"]:
            tracks.enter_block(name, slot, robot=name in robots)
        for record in s["tracks"]:
            landmark = _landmark(record["model"], given, world, f"landmark {record['id']!r}")
            _enter(tracks, _track(record, landmark), len(map_.spaces))
        for robot, sensor, candidates in s["candidates"]:
            tracks.candidates[robot, sensor] = [_pending(c) for c in candidates]
        self._enter_known(tracks, given, world)
        tracks.reserve(s["reserved"])
        for name in OF_TRACKS:
            setattr(tracks, name, s[name])
        tracks.experience = float(s["experience"])
        tracks.detection = float(s["detection"][0]), float(s["detection"][1])
        tracks.looks = {(str(r), str(sensor)): Looks.restored(*saved) for r, sensor, *saved in s["looks"]}
        for name in ("changes", "searched", "unnamed", "looked"):
            setattr(tracks, name, _count(s[name], name))
        for number, c in s["clones"]:
            users = {(str(robot), str(sensor)) for robot, sensor in c["users"]}
            clones.clones[_count(number, "number of a clone")] = Clone(c["slot"], c["robot"], c["t_ns"], users)
        clones.latest = {robot: _count(number, "number of a clone") for robot, number in s["latest"].items()}
        clones.numbered = _count(s["numbered"], "number of clones")
        self._fill_moving(state)
        for i, (name, since_ns, misses, of) in enumerate(s["alternatives"]):
            other = self._other(state, name, of, since_ns, f"alternative{i}")
            state.alternatives[name] = replace(other, misses=_count(misses, "misses"))
        state.given = {(str(r), str(sensor)): Given.restored(*saved) for r, sensor, saved in s.get("given", ())}
        self._fill_sums(state)
        judged = s.get("surveys", {"trial": (), "misfits": (), "strangers": ()})
        state.surveys.trial = {name: _count(number, f"sightings of {name!r}") for name, number in judged["trial"]}
        state.surveys.misfits = {name: (int(out), frozenset(fit)) for name, out, fit in judged["misfits"]}
        state.surveys.strangers = {str(robot): set(names) for robot, names in judged["strangers"]}
        for robot, sensor, t_ns, window, *saved in s["readers"]:
            reader = state.readers[robot, sensor]
            reader.t_ns = _time(t_ns)
            if reader.standing is not None:
                reader.standing.restore(window)
            reader.restore(*saved)
        self._fill_front_ends(state)
        carried: dict[ChannelKey, Channel | Reader] = {**state.channels, **state.readers}
        for key, channel in carried.items():
            channel.mount = tracks.slots.get(mount_name(*key), -1)
        _check_owners(state)
        _check_measurements(state)

    def _fill_front_ends(self, state: State) -> None:
        """Fill in how landmarks looked."""
        for i, (robot, sensor, seen) in enumerate(self._state.get("front_ends", ())):

            def read(name: str, shape: tuple[int, ...], i: int = i) -> Array:
                return _array(self._members, f"{name}{i}", shape)

            state.front_ends[robot, sensor].restore(seen, read)

    def _other(self, state: State, name: str, of: Description, since_ns: int, at: str) -> Alternative:
        """Return another filter of a robot, whose arrays' names begin with `at`."""
        own = restored_map(of, lambda key, *shape: _array(self._members, f"{at}.{key}", *shape))
        return Alternative(own, alone(state.moving[name]), int(since_ns))

    def _fill_sums(self, state: State) -> None:
        for i, (name, prior_log, lead, linear, log_weights, since_ns, maps) in enumerate(self._state.get("sums", ())):
            each = [self._other(state, name, of, since_ns, f"sum{i}.{j}") for j, of in enumerate(maps)]
            logs = np.array(log_weights, dtype=np.float64).reshape(len(maps) - 1)
            state.sums[name] = GaussianSum(each[0], each[1:], logs, float(prior_log), float(lead), int(linear))

    def _fill_moving(self, state: State) -> None:
        """Fill in how the robots move."""
        for i, (name, m) in enumerate(state.moving.items()):
            error, t_ns, fresh, watched, left_out, number = self._state["moving"][name]
            d = 2 if m.motion.space.axes == 1 else 3
            m.left_out = [
                LeftOut(_numbers(y).reshape(d), _numbers(R).reshape(d, d), _numbers(p).reshape(d))
                for y, R, p in left_out
            ]
            k, m.slot, m.error = len(m.motion.columns), state.tracks.slots[name], error
            m.bias = state.tracks.slots.get(bias_name(name))
            m.held.t_ns, m.held.fresh = _time(t_ns), bool(fresh)
            if f"u{i}.npy" in self._members:
                m.held.u, m.held.N = _array(self._members, f"u{i}", (k,)), _array(self._members, f"N{i}", (k, k))
            if f"usual{i}.npy" in self._members:
                m.held.usual = _array(self._members, f"usual{i}", (k,))
            if f"rate{i}.npy" in self._members:
                m.held.mean = Mean(_array(self._members, f"rate{i}", (k,)), max(int(number), 1))
            if m.held.gaps is not None:
                m.held.gaps.restore(_watching(watched, k))

    def _enter_known(self, tracks: Tracks, own: Sequence[Landmark], world: str) -> None:
        """Enter the landmarks known exactly.  Raises MapError where one is there twice."""
        for i, of in enumerate(self._state["known"]):
            kind = _landmark(of["model"], own, world, f"landmark {next(iter(of['names']), '')!r}")
            values = _array(self._members, f"known{i}", (len(of["names"]), kind.space.size))
            for name, value, count in zip(of["names"], values, of["counts"], strict=True):
                if name in tracks.slots or name in tracks.known:
                    raise MapError(f"landmark {name!r} is there twice, expected each name once")
                tracks.known.add(name, kind, value)
                tracks.known.recount(name, _count(count, f"observations of {name!r}"))


def load(path: Path, built: Callable[..., Any], robots: Iterable[Robot] | None, **models: Any) -> Any:
    """Return the Slam of a file written by `save`, `built` by its description; a user's own models are given again.

    Raises MapError if the file is damaged, lacks a model, or was saved with other robots or landmarks.
    """
    with errors(path):
        description, members = _read(path)
        said, state = _each(description["settings"], _to_number), description["state"]
        own = models["landmarks"]
        of_tracks = [track["model"] for track in (*state["tracks"], *state["known"])]
        if own is not None and not is_type(own, said["landmarks"]):
            if not any(is_type(own, each) for each in of_tracks):
                names = sorted({_name(each) for each in (said["landmarks"], *of_tracks) if each is not None})
                raise MapError(f"landmarks is {type(own).__name__}, expected {' or '.join(names) or 'None'}")
            del models["landmarks"]
        given = {name: each for name, each in models.items() if each is not None}
        if robots is not None:
            given["robots"] = _same_robots([*robots], said["robots"])
        _refuse_own({name: each for name, each in said.items() if name not in given})
        slam = built(said, **given)
        _Saved(state, members, own).fill(slam.state)
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


def _array(members: dict[str, bytes], name: str, shape: tuple[int, ...]) -> Array:
    """Return an array as float64, its header compared with what is expected before anything is made of it."""
    file = io.BytesIO(members[f"{name}.npy"])
    version = np.lib.format.read_magic(file)
    got, fortran, dtype = np.lib.format.read_array_header_1_0(file)
    if (version, got, fortran) != ((1, 0), shape, False) or dtype not in (np.dtype("<f8"), np.dtype("|u1")):
        raise MapError(f"{name} is an array {got} of {dtype}, expected {shape} of float64 or uint8")
    return np.frombuffer(file.read(), dtype).reshape(shape).astype(np.float64)


def _enter(tracks: Tracks, track: Track, slots: int) -> None:
    if track.slot >= slots:
        raise MapError(f"slot of {track.id!r} is {track.slot}, expected one of {slots}")
    if track.status is Status.CONFIRMED:
        tracks.enter(track)
    else:
        of = tracks.tentative if track.status is Status.TENTATIVE else tracks.pending
        of[track.id] = track


def _track(record: Description, landmark: Landmark) -> Track:
    name, pending = record["id"], record["pending"]
    changed = {
        "model": landmark,
        "status": Status(record["status"]),
        "observations": _count(record["observations"], f"observations of {name!r}"),
        "covisible": set(record["covisible"]),
        "compared": tuple(record["compared"]),
        "extent": None if record["extent"] is None else np.array(record["extent"], dtype=np.float64).reshape(2),
        "size_m": _optional(record["size_m"], f"size_m of {name!r}", "a number", float),
        "first": None if record["first"] is None else tuple(record["first"]),
        "pending": None if pending is None else _pending(pending),
        "measurements": [_measurement(m) for m in record["measurements"]],
    }
    track = Track(**(record | changed))
    for what in ("searched", "found", "hits", "chances", "seen"):
        _count(getattr(track, what), f"{what} of {name!r}")
    return track


def _pending(record: Description) -> Pending:
    arrays = {key: None if record[key] is None else _numbers(record[key]) for key in ("mean", "cov", "poses")}
    if arrays["poses"] is not None and arrays["poses"].shape != (2, 7):
        raise MapError(f"what is pending of {record['name']!r} has poses {record['poses']!r}, expected two")
    changed = {
        "channel": tuple(record["channel"]),
        "measurements": tuple(_measurement(m) for m in record["measurements"]),
        "hypotheses": tuple(record["hypotheses"]),
        "log_weights": tuple(_numbers(record["log_weights"]).tolist()),
    }
    pending = Pending(**(record | arrays | changed))
    if len(pending.log_weights) != len(pending.hypotheses):
        raise MapError(f"what is pending of {pending.name!r} has {len(pending.log_weights)} weights of its hypotheses")
    return pending


def _measurement(record: Description) -> Measurement:
    m = Measurement(**(record | {"y": _numbers(record["y"]), "R": _numbers(record["R"])}))
    if m.y.ndim != 1 or m.R.ndim != 2 or m.R.shape[0] != m.R.shape[1]:
        raise MapError(f"a measurement of {m.robot!r}, {m.sensor!r} has the noise {m.R.tolist()}")
    return m


def _watching(record: Description, k: int) -> Description:
    """Return what was known of the controls of a robot, which have k numbers."""

    def control(value: Any) -> Array:
        u = _numbers(value)
        if u.shape != (k,):
            raise MapError(f"a control is {value!r}, expected {k} numbers")
        return u

    times = {key: _time(record[key]) for key in ("last_ns", "since_ns", "until_ns", "usual_ns", "bound_ns")}
    return times | {
        "left_out_ns": _time(record.get("left_out_ns")),
        "intervals": tuple(_count(dt, "interval of controls") for dt in record["intervals"]),
        "pending": tuple((_count(dt, "interval of controls"), control(u)) for dt, u in record["pending"]),
        "largest": control(record["largest"]),
        "adrift": bool(record["adrift"]),
    }


def _numbers(value: Any) -> Array:
    found = np.array(value, dtype=np.float64)
    if not np.isfinite(found).all():
        raise MapError(f"{value!r} is no array of finite numbers")
    return found


def _check_columns(robots: dict[str, Robot], saved: dict[str, list[str]]) -> None:
    """Refuse motions that take other controls than those saved."""
    columns = _columns(robots)
    if columns != saved:
        raise MapError(f"columns of the motions are {columns}, expected {saved}")


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
        pose = SE2 if robots[clone.robot].motion.space.axes == 1 else SE3
        owners.append((f"clone {number}", clone.slot, pose))
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
        raise MapError("clones or pending measurements are of sensors that there are not")


def _count(value: Any, what: str) -> int:
    if type(value) is not int or value < 0:
        raise MapError(f"{what} is {value!r}, expected an integer of at least 0")
    return value


def _optional(value: Any, what: str, expected: str, *kinds: type) -> Any:
    if value is not None and type(value) not in kinds:
        raise MapError(f"{what} is {value!r}, expected {expected} or none")
    return value


def _time(value: Any) -> int | None:
    return _optional(value, "t_ns", "an integer", int)


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
    found = next((each for each in like if _each(model(each), _to_text) == said), None)
    if said["type"] in classes("landmark") and found is None:
        given = {key: value for key, value in _each(said, _to_number).items() if key != "type"}
        made: Landmark = class_of("landmark", said["type"], world)(**given)
        return made
    if not like:
        raise MapError(f"{what} is {_name(said)}, a model of your own: give the landmarks to load() again")
    return found or like[0]


def is_type(landmark: Landmark, description: Description | None) -> bool:
    """Return whether a landmark type is the one that was saved."""
    return description is not None and model(landmark)["type"] == description["type"]


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
            ("motion is", model(robot.motion)["type"], saved[robot.name]["motion"]["type"]),
            ("sensors are", sorted(robot.sensors), sorted(saved[robot.name]["sensors"])),
        ):
            if mine != expected:
                raise MapError(f"robot {robot.name!r}: {what} {mine}, expected {expected}")
    return sorted(given, key=lambda robot: names.index(robot.name))


def _name(description: Description) -> str:
    return str(description["type"]).rpartition(":")[2]
