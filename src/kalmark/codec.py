"""A codec of records by their type hints: JSON, and beside it one array of the numbers of all arrays.

A dataclass or a named tuple is saved as its fields.  An object of another class is saved as the attributes that the
class's body annotates, or names as `SAVED`, and is filled in place.  `restored`, if there is that, computes the rest.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from enum import Enum
from functools import cache
from types import NoneType, UnionType
from typing import Any, ClassVar, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np

from kalmark.arrays import Array
from kalmark.errors import MapError
from kalmark.events import Id

NOT_FINITE = ("inf", "-inf", "nan")  # JSON has no numbers for them


class Writer:
    """Writes values by their hints, `special` ones by functions of their own; `at` is the place in the record."""

    def __init__(self, special: Mapping[Any, Callable[[Any], Any]]) -> None:
        self.special, self.at = special, list[Any]()
        self._arrays: list[Array] = [np.zeros(0)]
        self._size = 0

    def put(self, array: Any) -> list[int]:
        """Take the numbers of an array; return where they begin, and the shape."""
        at, self._size = self._size, self._size + np.size(array)
        self._arrays.append(np.asarray(array, dtype=np.float64).ravel())
        return [at, *np.shape(array)]

    def numbers(self) -> Array:
        """Return the numbers (N,) of all arrays so far."""
        return np.concatenate(self._arrays)


class Reader:
    """Reads what a `Writer` wrote beside its numbers (N,)."""

    def __init__(self, numbers: Array, special: Mapping[Any, Callable[[Any], Any]]) -> None:
        self.numbers, self.special, self.at = numbers, special, list[Any]()

    def take(self, says: Any, dtype: Any) -> Any:
        """Return an array by where its numbers begin and its shape.  Raises MapError."""
        begin, *shape = says
        if any(type(size) is not int or size < 0 for size in says) or begin + math.prod(shape) > len(self.numbers):
            raise MapError(
                f"{place_in_record(self)} is {says!r}, expected a place in {len(self.numbers)} numbers and a shape"
            )
        return self.numbers[begin : begin + math.prod(shape)].reshape(shape).astype(dtype)


def place_in_record(of: Reader | Writer) -> str:
    """Return in words where in a record it is."""
    return ".".join(map(str, of.at))


class Kind:
    """Writer and reader of the values of one hint: here those that JSON has as they are.

    Both raise MapError for a value of another type.
    """

    def write(self, writer: Writer, value: Any) -> Any:
        """Return a value as JSON has it."""
        return value

    def read(self, reader: Reader, says: Any, now: Any) -> Any:
        """Return a value; `now` is what there is, which is filled where it has a state."""
        return says


@cache
def kind_of(hint: Any) -> Kind:
    """Return how values of a hint are written and read."""
    origin, args = get_origin(hint), get_args(hint)
    if hint in SIMPLE:
        return SIMPLE[hint]
    if origin in (Union, UnionType):
        (of,) = (Id,) if {*args} == {int, str, NoneType} else (each for each in args if each is not NoneType)
        return _Optional(kind_of(of))
    if origin is np.ndarray:
        return _Numbers(get_args(args[1])[0])
    if origin is dict:
        return Kind() if args == (str, Any) else _Mapping(kind_of(args[0]), kind_of(args[1]))
    if origin in (list, set, frozenset) or args[1:] == (...,):
        return _Sequence(origin, kind_of(args[0]))
    if origin is tuple:
        return _Tuple(tuple, tuple(map(kind_of, args)))
    if origin is Literal:
        return _Scalar((str,), f"one of {', '.join(args)}", args)
    if issubclass(hint, Enum):
        return _Member(hint)
    if issubclass(hint, tuple):
        return _Tuple(hint._make, tuple(map(kind_of, get_type_hints(hint).values())))
    return _Object(hint)


@dataclasses.dataclass(frozen=True)
class _Scalar(Kind):
    types: tuple[type, ...]
    expected: str
    words: tuple[str, ...] = ()

    def write(self, writer: Writer, value: Any) -> Any:
        value = self._checked(writer, value.item() if isinstance(value, np.generic) else value)
        return str(value) if isinstance(value, float) and not math.isfinite(value) else value

    def read(self, reader: Reader, says: Any, now: Any) -> Any:
        return float(says) if float in self.types and says in NOT_FINITE else self._checked(reader, says)

    def _checked(self, of: Reader | Writer, value: Any) -> Any:
        if type(value) not in self.types or (self.words and value not in self.words):
            raise MapError(f"{place_in_record(of)} is {value!r}, expected {self.expected}")
        return value


class _Random(Kind):
    """A generator of random numbers, by its state."""

    def write(self, writer: Writer, value: Any) -> Any:
        return value.bit_generator.state

    def read(self, reader: Reader, says: Any, now: Any) -> Any:
        now.bit_generator.state = says
        return now


SIMPLE: dict[Any, Kind] = {
    bool: _Scalar((bool,), "true or false"),
    int: _Scalar((int,), "an integer"),
    float: _Scalar((float, int), "a number"),
    str: _Scalar((str,), "a text"),
    Id: _Scalar((int, str), "an id that is an integer or a text"),
    np.random.Generator: _Random(),
}


@dataclasses.dataclass(frozen=True)
class _Optional(Kind):
    of: Kind

    def write(self, writer: Writer, value: Any) -> Any:
        return None if value is None else self.of.write(writer, value)

    def read(self, reader: Reader, says: Any, now: Any) -> Any:
        return None if says is None else self.of.read(reader, says, now)


@dataclasses.dataclass(frozen=True)
class _Numbers(Kind):
    dtype: Any

    def write(self, writer: Writer, value: Any) -> Any:
        return writer.put(value)

    def read(self, reader: Reader, says: Any, now: Any) -> Any:
        return reader.take(says, self.dtype)


@dataclasses.dataclass(frozen=True)
class _Member(Kind):
    of: type[Enum]

    def write(self, writer: Writer, value: Any) -> Any:
        return value.value

    def read(self, reader: Reader, says: Any, now: Any) -> Any:
        return self.of(says)


@dataclasses.dataclass(frozen=True)
class _Sequence(Kind):
    make: Callable[[Any], Any]
    of: Kind

    def write(self, writer: Writer, value: Any) -> Any:
        each = value if isinstance(value, list | tuple) else sorted(value, key=str)
        return [self.of.write(writer, item) for item in each]

    def read(self, reader: Reader, says: Any, now: Any) -> Any:
        return self.make([self.of.read(reader, item, None) for item in says])


@dataclasses.dataclass(frozen=True)
class _Tuple(Kind):
    make: Callable[[Any], Any]
    of: tuple[Kind, ...]

    def write(self, writer: Writer, value: Any) -> Any:
        return [kind.write(writer, item) for kind, item in zip(self.of, value, strict=True)]

    def read(self, reader: Reader, says: Any, now: Any) -> Any:
        return self.make([kind.read(reader, item, None) for kind, item in zip(self.of, says, strict=True)])


@dataclasses.dataclass(frozen=True)
class _Mapping(Kind):
    """Pairs; where there are objects with a state, their keys are the same."""

    key: Kind
    of: Kind

    def write(self, writer: Writer, value: Any) -> Any:
        pairs = []
        for key, item in value.items():
            writer.at.append(key)
            pairs.append([self.key.write(writer, key), self.of.write(writer, item)])
            writer.at.pop()
        return pairs

    def read(self, reader: Reader, says: Any, now: Any) -> Any:
        found = {}
        for pair in says:
            reader.at.append(pair[0])
            key = self.key.read(reader, pair[0], None)
            found[key] = self.of.read(reader, pair[1], (now or {}).get(key))
            reader.at.pop()
        if len(found) != len(says):
            raise MapError(f"{place_in_record(reader)} has {len(says) - len(found)} of its keys twice")
        return found


@dataclasses.dataclass(frozen=True)
class _Object(Kind):
    """A record by its fields, or another object by its parts."""

    of: type

    def write(self, writer: Writer, value: Any) -> Any:
        if self.of in writer.special:
            return writer.special[self.of](value)
        says = {}
        for name, kind in _parts(value.__class__).items():
            writer.at.append(name)
            says[name] = kind.write(writer, getattr(value, name))
            writer.at.pop()
        return says

    def read(self, reader: Reader, says: Any, now: Any) -> Any:
        if self.of in reader.special:
            return reader.special[self.of](says)
        is_record = dataclasses.is_dataclass(self.of) and not hasattr(self.of, "SAVED")
        if not is_record and now is None:
            now = object.__new__(self.of)
        found = {}
        for name, kind in _parts(self.of if is_record else now.__class__).items():
            reader.at.append(name)
            found[name] = kind.read(reader, says[name], getattr(now, name, None))
            reader.at.pop()
        if is_record:
            now = self.of(**found)
        else:
            for name, value in found.items():
                setattr(now, name, value)
        if hasattr(now, "restored"):
            now.restored()
        return now


@cache
def _parts(of: Any) -> dict[str, Kind]:
    """Return what is saved of a class, by name."""
    hints = get_type_hints(of)
    fields = [field.name for field in dataclasses.fields(of) if field.init] if dataclasses.is_dataclass(of) else hints
    names = getattr(of, "SAVED", fields)
    return {name: kind_of(hints[name]) for name in names if get_origin(hints[name]) is not ClassVar}
