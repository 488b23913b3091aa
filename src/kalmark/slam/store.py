"""A Slam on disk: one zip of arrays, a JSON description and their checksums, never pickle: loading runs nothing of it.
`store_map` has the part that is the map.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import zipfile
from collections.abc import Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from kalmark.association.protocol import Association
from kalmark.errors import KalmarkError, MapError
from kalmark.events import Id
from kalmark.filter.estimators import Estimator
from kalmark.geometry.spaces import SE2, SE3, Rn, Space
from kalmark.management.doubts import Doubt
from kalmark.management.tentative import Tentative
from kalmark.management.upkeep import CAREFUL
from kalmark.models.protocols import Landmark
from kalmark.slam.describe import State, described, landmark_type, restored, robot_described, robots_restored, same
from kalmark.slam.prediction import bias_block, bias_name
from kalmark.slam.slam import Slam
from kalmark.slam.store_map import map_arrays, map_described, map_restored
from kalmark.slam.store_ranges import ranges_described, ranges_owners, ranges_restored
from kalmark.slam.store_waiting import check_kept, kept_described, kept_restored, waiting_described, waiting_restored
from kalmark.tracks.robot import Robot, mount_name

Array = npt.NDArray[np.float64]

VERSION = 6
READABLE = (5, 6)  # 5: before there were tentative landmarks
DESCRIPTION, SUMS = "slam.json", "sha256"


# ---------------------------------------------------------------------- saving
def save(slam: Slam, path: Path) -> None:
    """Write the state; the file appears whole or not at all.  What a model of the user's remembers is not written."""
    members = {DESCRIPTION: json.dumps(_state(slam), default=_item, allow_nan=False).encode()}
    members |= {f"{name}.npy": _npy(array) for name, array in _arrays(slam)}
    sums = "".join(f"{hashlib.sha256(data).hexdigest()}  {name}\n" for name, data in members.items()).encode()
    temporary = path.with_name(path.name + ".part")
    try:
        try:
            with zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED) as archive:
                for name, data in (members | {SUMS: sums}).items():
                    archive.writestr(name, data)
            os.replace(temporary, path)
        finally:
            temporary.unlink(missing_ok=True)
    except OSError as error:
        raise MapError(f"{path}: {error.strerror}, expected a file that can be written") from error


def _state(slam: Slam) -> State:
    type_ = getattr(slam, "landmark_type", None)
    return {
        "kalmark": VERSION,
        "robots": [robot_described(r) for r in slam.robots.values()],
        "association": described(slam.association),
        "estimator": described(slam.estimator),
        "landmarks": None if type_ is None else described(type_),
        "upkeep": described(slam.upkeep),
        "t_ns": slam.t_ns,
        "slots": [[_id(name), slot] for name, slot in slam.members.slots.items()],
        "kinds": [[_id(name), described(kind)] for name, kind in slam.members.kinds.items()],
        "reparametrize": slam.reparametrize,
        "existence": [[_id(name), *told] for name, told in slam.members.existence.items()],
        "lately": [_id(name) for name in slam.members.lately],
        "looked": [[_id(name), *told] for name, told in slam.members.looked.items()],
        "changes": slam.members.changes,
        "together": [[_id(name), [_id(other) for other in others]] for name, others in slam.members.together.items()],
        "searched": [[_id(name), counts] for name, counts in slam.members.searched.items()],
        "ends": [[_id(name), t.tolist()] for name, t in slam.members.ends.items()],
        "doubts": [[_id(i), d.poses.tolist(), d.evidence, d.t_ns] for i, d in slam.members.doubts.open.items()],
        "unlocated": ranges_described(slam.members.unlocated),
        "here": slam.members.here,
        "tentative": [
            [name, t.slot, described(t.kind), t.hits, t.chances, t.unseen, kept_described(t)]
            for name, t in slam.members.tentative.items()
        ],
        "waiting": waiting_described(slam),
        "seen": [[_id(name), count] for name, count in slam.members.seen.items()],
        "errors": slam._errors,
        "drives": [[drive.t_ns, drive.fresh] for drive in slam._drives.values()],
        "unnamed": slam.members.unnamed,
        "theirs": sorted(map(_id, slam.members.theirs)),
        "experience": slam.members.experience,
        "map": slam.map_type,
        "numbers": slam.numbers,
        "postponed": None,
    } | map_described(slam.map)


def _id(name: Any) -> Any:
    name = name.item() if isinstance(name, np.generic) else name
    if not isinstance(name, int | str):
        raise MapError(f"landmark {name!r} cannot be saved, expected an id that is an integer or a text")
    return name


def _item(value: Any) -> Any:
    """Return a NumPy number that JSON does not know."""
    if isinstance(value, np.generic):
        return value.item()
    raise MapError(f"{value!r} cannot be saved, expected a number or a text")


def _arrays(slam: Slam) -> Iterator[tuple[str, Array]]:
    yield from map_arrays(slam.map)
    for i, drive in enumerate(slam._drives.values()):
        if drive.u is not None and drive.N is not None:
            yield f"u{i}", drive.u
            yield f"N{i}", drive.N


def _npy(array: Array) -> bytes:
    file = io.BytesIO()
    np.lib.format.write_array(file, np.ascontiguousarray(array, dtype="<f8"), (1, 0), allow_pickle=False)
    return file.getvalue()


# ---------------------------------------------------------------------- loading
def load(
    path: Path,
    robots: Iterable[Robot] | None = None,
    association: Association | None = None,
    estimator: Estimator | None = None,
    landmarks: Landmark | None = None,
) -> Slam:
    """Read a state written by `save`; models of the user's own are given again.

    Raises MapError if the file is damaged, lacks a model, or was saved with other robots or landmarks.
    """
    given = None if robots is None else list(robots)
    try:
        state, members = _read(path)
        slam = Slam(
            robots_restored(state["robots"], given),
            association or restored("association", state["association"], "association", "association"),
            estimator or restored("estimator", state["estimator"], "estimator", "estimator"),
            landmark_type(state, landmarks),
            map=state["map"],
            numbers=state["numbers"],
            reparametrize=_threshold(state["reparametrize"]),
            upkeep=restored("upkeep", state["upkeep"], "upkeep", "upkeep") if "upkeep" in state else CAREFUL,
        )
        _fill(slam, state, members, landmarks)
    except KalmarkError as error:
        raise MapError(f"{path}: {error}") from error
    except OSError as error:
        raise MapError(f"{path}: {error.strerror or error}, expected a map written by save()") from error
    except Exception as error:  # a damaged file fails in any way: in zlib, json, numpy or a model
        said = " ".join(str(error).split())
        raise MapError(f"{path}: {type(error).__name__}: {said}, expected a map written by save()") from error
    return slam


def _read(path: Path) -> tuple[State, dict[str, bytes]]:
    """Return the description and the arrays' files, their checksums compared."""
    with zipfile.ZipFile(path) as archive:
        state = json.loads(archive.read(DESCRIPTION))
        if state.get("kalmark") not in READABLE:
            raise MapError(f"version is {state.get('kalmark')!r}, expected {' or '.join(map(str, READABLE))}")
        sums = {name: sum_ for sum_, name in map(str.split, archive.read(SUMS).decode().splitlines())}
        members = {name: archive.read(name) for name in {DESCRIPTION, *sums}}
    for name, data in members.items():
        if hashlib.sha256(data).hexdigest() != sums.get(name):
            raise MapError(f"{name} is damaged: its checksum is not {sums.get(name)}")
    return state, members


def _array(members: dict[str, bytes], name: str, shape: tuple[int, ...]) -> Array:
    """Return an array, its header compared with what is expected before anything is made of it."""
    file = io.BytesIO(members[f"{name}.npy"])
    version = np.lib.format.read_magic(file)
    got, fortran, dtype = np.lib.format.read_array_header_1_0(file)
    if (version, got, fortran, dtype) != ((1, 0), shape, False, np.dtype("<f8")):
        raise MapError(f"{name} is an array {got} of {dtype}, expected {shape} of float64")
    return np.frombuffer(file.read(), "<f8").reshape(shape).astype(np.float64)


def _fill(slam: Slam, state: State, members: dict[str, bytes], given: Landmark | None) -> None:
    slam.map = map_restored(state, partial(_array, members))
    own = [view.landmark for view in slam._views.values()] + ([] if given is None else [given])
    slam.members.enter(dict(map(tuple, state["slots"])), {i: _kind(i, d, own) for i, d in state["kinds"]})
    slam._errors = dict(state["errors"])
    for (robot, sensor), view in slam._views.items():
        view.mount = slam.members.slots.get(mount_name(robot, sensor), -1)
    slam.members.seen = {i: _count(count, f"observations of {i!r}") for i, count in state["seen"]}
    slam.members.searched = {i: [_count(n, f"searches of {i!r}") for n in counts] for i, counts in state["searched"]}
    slam.members.ends = {i: np.array(t, dtype=np.float64).reshape(2) for i, t in state["ends"]}
    slam.members.doubts.open = {i: _doubt(i, *rest) for i, *rest in state["doubts"]}
    slam.members.existence = {i: (float(odds), int(missed)) for i, odds, missed in state.get("existence", ())}
    slam.members.lately = list(state.get("lately", ()))
    slam.members.looked = {name: (seen, changes) for name, seen, changes in state.get("looked", ())}
    slam.members.changes = _count(state.get("changes", 0), "changes")
    slam.members.together = {i: set(others) for i, others in state.get("together", ())}
    slam.members.unlocated = ranges_restored(state.get("unlocated", []))
    slam.members.here = None if state.get("here") is None else tuple(state["here"])
    slam.members.tentative = {i: _tentative(i, own, *rest) for i, *rest in state.get("tentative", ())}
    waiting_restored(slam, state.get("waiting", []))
    check_kept(slam)
    slam.members.unnamed = _count(state["unnamed"], "unnamed")
    if "theirs" in state:
        slam.members.reserve(state["theirs"])
    else:  # written before it was kept: what was made up has a number up to `unnamed`
        ours = {f"u{i}" for i in range(1, slam.members.unnamed + 1)}
        slam.members.reserve(name for name in slam.members.kinds if name not in ours)
    slam.members.experience = [float(count) for count in state.get("experience", (0.0, 0.0))]
    slam.t_ns = _time(state["t_ns"])
    _check_owners(slam)
    for i, (drive, (t_ns, fresh)) in enumerate(zip(slam._drives.values(), state["drives"], strict=True)):
        drive.t_ns, drive.fresh, k = _time(t_ns), bool(fresh), len(drive.motion.columns)
        if f"u{i}.npy" in members:
            drive.u, drive.N = _array(members, f"u{i}", (k,)), _array(members, f"N{i}", (k, k))


def _kind(name: Id, description: State, own: list[Landmark]) -> Landmark:
    """Return the type of a landmark: the user's own, if it is that, or one of kalmark's."""
    for landmark in own:
        if same(landmark, description):
            return landmark
    return restored("landmark", description, f"landmark {name!r}", "landmarks")


def _check_owners(slam: Slam) -> None:
    """Refuse a map whose blocks are not each one robot, one landmark or one control's error, of their shapes."""
    spaces: dict[Id, Space] = {name: robot.motion.space for name, robot in slam.robots.items()}
    spaces |= {name: kind.space for name, kind in slam.members.kinds.items()}
    for robot, sensor in slam._views:
        own = slam.robots[robot].sensors[sensor].block(sensor)
        if own is not None:
            spaces[mount_name(robot, sensor)] = own[0]
    for moving in slam.robots.values():
        bias = bias_block(moving.motion)
        if bias is not None:
            spaces[bias_name(moving.name)] = bias[0]
    if (
        slam.robots.keys() & slam.members.kinds.keys()
        or spaces.keys() != slam.members.slots.keys()
        or not spaces.keys() >= slam.members.seen.keys()
    ):
        raise MapError("the slots' names are not those of the robots and landmarks")
    owners = [(f"{name!r}", slot, spaces[name]) for name, slot in slam.members.slots.items()]
    owners += ranges_owners(slam.members.unlocated)
    owners += [(f"tentative {name!r}", t.slot, t.kind.space) for name, t in slam.members.tentative.items()]
    for view in slam._views.values():
        pose = SE2 if len(view.at) == 3 else SE3
        owners += [(f"kept pose {n}", slot, pose) for n, slot in view.waiting.poses.items()]
    for name, slot in slam._errors.items():
        owners.append((f"the error of {name!r}", slot, Rn(len(slam.robots[name].motion.columns))))
    used = [i for i, space in enumerate(slam.map.spaces) if space is not None]
    if sorted(_count(slot, f"slot of {what}") for what, slot, _ in owners) != used:
        raise MapError(f"the slots of the map are not used once each: {len(owners)} names, {len(used)} blocks")
    for what, slot, space in owners:
        block = slam.map.spaces[slot]
        if block is None or block.kinds != space.kinds:
            raise MapError(f"{what} is a {space.name} of {space.size} numbers, its block in the map is {block}")


def _doubt(name: Id, poses: Any, evidence: Any, t_ns: Any) -> Doubt:
    found = np.array(poses, dtype=np.float64)
    if found.shape != (2, 7) or not np.isfinite(found).all() or not isinstance(evidence, float):
        raise MapError(f"the doubt about {name!r} is {poses!r} by {evidence!r}, expected two poses and a number")
    return Doubt(found, evidence, _count(t_ns, f"the time of the doubt about {name!r}"))


def _tentative(name: Id, own: list[Landmark], slot: Any, kind: State, *rest: Any) -> Tentative:
    counts, kept = rest[:3], rest[3] if len(rest) > 3 else {}
    hits, chances, unseen = (_count(n, f"sightings of the tentative {name!r}") for n in counts)
    slot = _count(slot, f"slot of the tentative {name!r}")
    return Tentative(slot, _kind(name, kind, own), hits, chances, unseen, **kept_restored(kept))


def _count(value: Any, what: str) -> int:
    if type(value) is not int or value < 0:
        raise MapError(f"{what} is {value!r}, expected an integer of at least 0")
    return value


def _threshold(value: Any) -> float | None:
    if value is not None and not isinstance(value, float | int):
        raise MapError(f"reparametrize is {value!r}, expected a number or none")
    return value


def _time(value: Any) -> int | None:
    if value is not None and type(value) is not int:
        raise MapError(f"t_ns is {value!r}, expected an integer or none")
    return value
