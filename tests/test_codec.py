"""The codec: values of all hints come back as they were, and files that do not fit are refused with the place."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from enum import Enum
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np
import numpy.typing as npt
import pytest

from kalmark.arrays import Array, Flags, Index
from kalmark.codec import Reader, Writer, kind_of
from kalmark.errors import MapError
from kalmark.events import Id


class Colour(Enum):
    RED = "red"


class Place(NamedTuple):
    p: Array
    name: str


@dataclass(frozen=True)
class Record:
    id: Id
    known: Id | None
    count: int
    size_m: float | None
    is_new: bool
    word: Literal["a", "b"]
    colour: Colour
    place: Place
    by_key: dict[tuple[str, int], list[Place]]
    names: set[Id]
    pair: tuple[int, str]
    times: tuple[int, ...]
    free: dict[str, Any]
    rows: Index
    flags: Flags
    patch: npt.NDArray[np.uint8]


class Counter:
    """Has a state: what its body annotates, and what follows from that."""

    LIMIT: ClassVar[int] = 3
    seen: list[int]
    random: np.random.Generator

    def __init__(self) -> None:
        self.seen, self.random, self.sum = [], np.random.default_rng(1), 0

    def restored(self) -> None:
        self.sum = sum(self.seen)


@dataclass
class Held:
    """Has a state beside what it is made of."""

    model: object
    counters: dict[str, Counter] = field(default_factory=dict)
    SAVED: ClassVar = ("counters",)


RECORD = Record(
    7, "oak", 2, float("inf"), True, "b", Colour.RED, Place(np.zeros((0, 3)), "x"),
    {("r", 1): [Place(np.array([0.1, np.nan]), "y")]}, {"1", 1}, (1, "one"), (3, 4), {"deep": [1, {"a": 2.5}]},
    np.array([[2**40, -1]]), np.array([True, False]), np.arange(6, dtype=np.uint8).reshape(2, 3),
)  # fmt: skip


def there_and_back(value: Any, hint: Any, now: Any = None, spoil: Any = None) -> Any:
    writer = Writer({})
    says = json.loads(json.dumps(kind_of(hint).write(writer, value), allow_nan=False))
    if spoil is not None:
        spoil(says)
    return kind_of(hint).read(Reader(writer.numbers(), {}), says, now)


def test_a_record_comes_back_as_it_was() -> None:
    back = there_and_back(RECORD, Record)
    for name, value in vars(RECORD).items():
        same = getattr(back, name)
        if isinstance(value, np.ndarray):
            np.testing.assert_array_equal(same, value)
            assert same.dtype == value.dtype
        elif name == "place":
            assert same.p.shape == (0, 3) and same.name == "x"
        elif name == "by_key":
            ((key, (one,)),) = same.items()
            assert key == ("r", 1) and one.name == "y"
            np.testing.assert_array_equal(one.p, [0.1, np.nan])
        else:
            assert same == value and type(same) is type(value), name


def test_an_object_with_a_state_is_filled_in_place() -> None:
    held, new = Held("model", {"a": Counter()}), Held("another", {"a": Counter()})
    held.counters["a"].seen = [1, 2]
    held.counters["a"].random.random(5)
    counter = new.counters["a"]
    assert there_and_back(held, Held, new) is new
    assert new.model == "another" and new.counters["a"] is counter
    assert counter.seen == [1, 2] and counter.sum == 3
    assert counter.random.random() == held.counters["a"].random.random()


def test_numbers_of_numpy_are_written_as_pythons() -> None:
    assert there_and_back(np.int64(3), Id) == 3 and there_and_back(np.str_("a"), Id) == "a"
    assert there_and_back({np.int64(3): np.float64(0.5)}, dict[Id, float]) == {3: 0.5}


@pytest.mark.parametrize("value", [True, 1.0, None, (1, 2)])
def test_what_is_no_id_is_not_written(value: Any) -> None:
    with pytest.raises(MapError, match="expected an id that is an integer or a text"):
        there_and_back({value: 1}, dict[Id, int])


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda d: d.update(count="2"), "count is '2', expected an integer"),
        (lambda d: d.update(count=True), "count is True, expected an integer"),
        (lambda d: d.update(is_new=1), "is_new is 1, expected true or false"),
        (lambda d: d.update(size_m="big"), "size_m is 'big', expected a number"),
        (lambda d: d.update(word="c"), "word is 'c', expected one of a, b"),
        (lambda d: d["rows"].__setitem__(1, 10**9), r"rows is \[.*, expected a place in .* numbers and a shape"),
        (lambda d: d["rows"].__setitem__(0, -1), "rows is"),
        (lambda d: d["by_key"].append(d["by_key"][0]), "by_key has 1 of its keys twice"),
        (lambda d: d["by_key"][0][1][0].__setitem__(1, 5), r"by_key\.\['r', 1\] is 5, expected a text"),
    ],
)
def test_a_value_of_another_type_is_refused_with_its_place(spoil: Any, message: str) -> None:
    with pytest.raises(MapError, match=message):
        there_and_back(RECORD, Record, spoil=spoil)
