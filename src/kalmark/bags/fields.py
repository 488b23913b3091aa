"""Fields of messages of any type: those that a configuration names, and those that a definition shows by their names.

A path leads from a message to a number, such as `pose.position.x`; `[]` goes through an array, so `tags[].id` is a
number of each element, and `ids[]` with `ranges[]` are two arrays of one length.  A path without `[]` holds for all
observations of a message.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from kalmark.arrays import Array
from kalmark.bags.messages import MESSAGES, Measured, Message, Seen, first_id
from kalmark.bags.topics import Scans, Topic
from kalmark.errors import LogError
from kalmark.events import short_text, unit_quaternion
from kalmark.logs.log import Names
from kalmark.logs.table import Refused
from kalmark.logs.table_columns import GLOBE, INERTIAL, POSE3, POSITION, TWIST3, in_order, in_own_unit

ID = "id"
OWN = (*POSE3, "theta_rad", *GLOBE, "v_mps", "steering_rad", "w_radps", *TWIST3, *INERTIAL)
"""Columns of what a robot itself does, or where it is."""
RANGE, BEARING, ELEVATION = ("range", "distance", "dist"), ("bearing", "azimuth", "angle"), ("elevation",)
OTHERS = {"frame", "robot", "sensor", "class", "vehicle", "agent", "seq", "sequence", "message", "msg"}
"""Ids that are not those of landmarks."""
NO_PLACE = {
    "velocity", "twist", "linear", "angular", "acceleration", "size", "scale", "orientation", "rotation", "normal",
    "color", "covariance", "dimensions",
}  # fmt: skip
"""Vectors that are no positions."""
SKIPPED = ("std_msgs/msg/Header", "builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration")
DEEPEST = 4


@dataclass(frozen=True)
class Fields:
    """Paths by column, each with the factor to the column's unit."""

    paths: dict[str, tuple[str, float]]

    @classmethod
    def of(cls, where: str, given: Any, scan: bool) -> Fields:
        """Return the paths that a configuration gives of a topic.  Raises LogError."""
        if not isinstance(given, Mapping) or not given or not all(isinstance(p, str) and p for p in given.values()):
            raise LogError(
                f"{where}: fields is {short_text(given)}, expected a mapping of columns to fields of the message"
            )
        paths = {}
        for name, path in given.items():
            column, factor = (name, 1.0) if name in GLOBE else in_own_unit(str(name))
            if not scan and column not in OWN:
                raise LogError(
                    f"{where}: fields has {short_text(name)}, expected some of {', '.join(dict.fromkeys(OWN))}"
                )
            paths[column] = (path, factor)
        return cls({name: paths[name] for name in in_order(paths)})

    def message(self, scan: bool) -> Message:
        """Return the contents of a message by these fields."""
        if scan:
            return Message("fields", seen=self.seen)
        has, offers = {*self.paths}, dict[str, Any]()
        if {*POSITION[:2]} <= has:
            offers["pose"] = self.pose
        if {"lat_deg", "lon_deg"} <= has:
            offers["globe"] = lambda m: Measured(self.numbers(m, tuple(GLOBE), math.nan))
        if has & {"v_mps", *TWIST3}:
            plane = "v_mps" in has
            names = ("v_mps", "vy_mps", "vz_mps", "wx_radps", "wy_radps", "w_radps") if plane else TWIST3
            offers["twist"] = lambda m: Measured(self.numbers(m, names))
        if {"v_mps", "steering_rad"} <= has:
            offers["drive"] = partial(self.numbers, columns=("v_mps", "steering_rad"))
        if "w_radps" in has or has & {*INERTIAL[:3]}:
            turns = (*INERTIAL[:2], "w_radps" if "w_radps" in has else INERTIAL[2])
            offers["rates"] = lambda m: Measured(self.numbers(m, turns))
            offers["attitude"] = lambda m: None
        if has & {*INERTIAL[3:]}:
            offers["force"] = lambda m: Measured(self.numbers(m, INERTIAL[3:]))
        return Message("fields", **offers)

    def table(self, m: Any) -> dict[str, list[Any]]:
        """Return the values by column, as many of each.  Raises Refused."""
        read = {name: value(m, path) for name, (path, _) in self.paths.items()}
        sizes = {name: len(each) for name, each in read.items() if isinstance(each, list)}
        if len({*sizes.values()}) > 1:
            told = ", ".join(f"{size} of {name}" for name, size in sizes.items())
            raise Refused(f"{told}, expected as many of each")
        count = next(iter(sizes.values()), 1)
        return {name: each if isinstance(each, list) else [each] * count for name, each in read.items()}

    def seen(self, m: Any, scan: Scans) -> Seen:
        """Return the observations of a sensor; a value that is not finite was not measured.  Raises Refused."""
        columns = tuple(name for name in self.paths if name != ID)
        seen, table = Seen(columns), self.table(m)
        factors = [self.paths[name][1] for name in columns]
        for k, row in enumerate(zip(*(table[name] for name in columns), strict=True)):
            y = [factor * number_of_field(name, v) for name, v, factor in zip(columns, row, factors, strict=True)]
            if not all(map(math.isfinite, y)):
                seen.left_out["observations that are not finite"] += 1
                continue
            seen.add(y, first_id(scan, table[ID][k]) if ID in table else scan.landmark)
        return seen

    def numbers(self, m: Any, columns: Names, absent: float = 0.0) -> Array:
        """Return one number of each column, `absent` where no field is named.  Raises Refused."""
        table = self.table(m)
        if any(len(each) != 1 for each in table.values()):
            raise Refused(f"{len(next(iter(table.values())))} values of each field, expected one")
        return np.array([number_of_field(c, table[c][0]) * self.paths[c][1] if c in table else absent for c in columns])

    def pose(self, m: Any) -> Measured:
        """Return a pose, its rotation NaN if no field is of one.  Raises Refused."""
        p, turn = self.numbers(m, POSITION), np.full(4, np.nan)
        if {*POSE3[3:]} <= self.paths.keys():
            turn = unit_quaternion(self.numbers(m, POSE3[3:]), Refused)
        elif "theta_rad" in self.paths:
            half = self.numbers(m, ("theta_rad",))[0] / 2
            turn = np.array([0.0, 0.0, math.sin(half), math.cos(half)])
        return Measured(np.append(p, turn))


def number_of_field(column: str, v: Any) -> float:
    """Return a field's number.  Raises Refused if it is none."""
    if isinstance(v, bool | int | float | np.number | np.bool_):
        return float(v)
    raise Refused(f"the field of {column} is {short_text(getattr(v, '__msgtype__', v))}, expected a number")


def value(m: Any, path: str) -> Any:
    """Return the value at a path of a message: a list if the path goes through an array."""
    here, many = [m], False
    for name, array in re.findall(r"([^.\[]+)(\[\])?", path if hasattr(m, "msg") else path.removeprefix("msg.")):
        here = [getattr(each, name) for each in here]
        if array:
            here, many = [each for several in here for each in several], True
    return here if many else here[0]


def offers(kind: str, definitions: Mapping[str, Any], where: str = "", topic: Topic | None = None) -> Message | None:
    """Return the contents of messages of a type: by the fields that a topic names, by its type, or by its definition.

    None if nothing is known.  Raises LogError.
    """
    scan = topic is None or isinstance(topic, Scans)
    if topic is not None and topic.fields is not None:
        return Fields.of(where, topic.fields, scan).message(scan)
    if kind in MESSAGES:
        return MESSAGES[kind]
    found = landmark_fields(kind, definitions)
    return Fields.of(where, found, scan).message(scan) if found and scan else None


# ------------------------------------------------------------------ definitions
def leaves(kind: str, definitions: Mapping[str, Any], before: str = "", depth: int = 0) -> Iterator[tuple[str, str]]:
    """Yield path and basic type of all numbers and texts of a type of messages, with one array on the way at most."""
    if depth > DEEPEST or kind in SKIPPED:
        return
    for name, (node, detail) in definitions.get(kind, ((), ()))[1]:
        array = node.name in ("ARRAY", "SEQUENCE")
        path = f"{before}{name}"
        if array and ("[]" in before or node.name == "ARRAY"):
            continue
        (inner, of), path = (detail[0], f"{path}[]") if array else ((node, detail), path)
        if inner.name == "BASE":
            yield path, of[0]
        else:
            yield from leaves(of, definitions, f"{path}.", depth + 1)


def landmark_fields(kind: str, definitions: Mapping[str, Any]) -> dict[str, str]:
    """Return the fields of landmarks in a type of messages: an id with a position, or with a range, a bearing or both.

    Recognised by the names of the fields: elements of an array, arrays of one length, or the message itself; {} if
    there are none.
    """
    groups: dict[str, dict[str, str]] = {}
    for path, base in leaves(kind, definitions):
        groups.setdefault(path.partition("[].")[0] if "[]." in path else "[]" if "[]" in path else "", {})[path] = base
    for _, group in sorted(groups.items(), key=lambda item: item[0] in ("", "[]")):
        numbers = [path for path, base in group.items() if base not in ("string", "bool")]
        ids = [
            path
            for path, base in group.items()
            if "float" not in base and words_of_name(path)[-1:] == [ID] and not OTHERS & {*words_of_name(path)}
        ]
        found = _place(numbers) or _polar(numbers)
        if ids and found:
            return {ID: min(ids, key=lambda path: words_of_name(path)[-1:] != words_of_name(path))} | found
    return {}


def words_of_name(path: str) -> list[str]:
    """Return the words of the last name of a path, in the singular."""
    name = path.removesuffix("[]").rpartition(".")[2]
    return [word.rstrip("s") for word in re.sub("([a-z0-9])([A-Z])", r"\1_\2", name).lower().split("_") if word]


def _place(paths: list[str]) -> dict[str, str]:
    """Return the fields of the first position among numbers, {} if there is none."""
    places: dict[str, dict[str, str]] = {}
    for path in paths:
        above, _, _ = path.removesuffix("[]").rpartition(".")
        axis, *more = words_of_name(path) or [""]
        if axis in ("x", "y", "z", "w") and not more:
            places.setdefault(above, {})[f"{axis}_m"] = path
    for above, found in places.items():
        if (
            {*POSITION[:2]} <= found.keys()
            and "w_m" not in found
            and not NO_PLACE & {*re.split(r"[._\[\]]+", above.lower())}
        ):
            return found
    return {}


def _polar(paths: list[str]) -> dict[str, str]:
    """Return the fields of the range and the angles among numbers, {} if there are none."""
    found: dict[str, str] = {}
    for path in paths:
        quantity, *units = words_of_name(path) or [""]
        for column, names in (("range_m", RANGE), ("bearing_rad", BEARING), ("elevation_rad", ELEVATION)):
            if quantity in names and {*units} <= {"m", "rad"}:
                found.setdefault(column, path)
    if "elevation_rad" in found and "bearing_rad" in found:
        found["azimuth_rad"] = found.pop("bearing_rad")
        return {name: found[name] for name in ("range_m", "azimuth_rad", "elevation_rad") if name in found}
    return {name: path for name, path in found.items() if name != "elevation_rad"}
