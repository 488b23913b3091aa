"""A short attack on every reader, the configuration, the saved map and `process`: mutated inputs on fixed seeds.

The long one is `make fuzz`, guided by coverage.  An input that it finds is added to `FOUND`.
"""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("rosbags", reason="rosbags is not installed: no bag can be written")

import fuzz

TARGETS = fuzz.targets()
FOUND: list[tuple[str, bytes]] = [
    ("g2o", b"\0PARAMS_SE3OFFSET 0\0 1\nEDGE"),
    ("config", b"log: {path: ~log, to_s: 0 }\n"),
    ("plaza", b"122E22222223 .1 2\n"),
    ("native", b'\0t_s,robot,vove=r,"""*1,0\n1,rover,1,0.1\n2,ro"\n2,ro""\n'),
    ("freiburg", b"ODOMETRY 0 1 0\nSENSOR " + 390 * b"\0"),
]


@pytest.mark.parametrize("name", TARGETS)
def test_the_seeds_of_a_target_are_taken(name: str, tmp_path: Path) -> None:
    for seed in TARGETS[name].seeds:
        assert fuzz.attacked(TARGETS[name], seed, tmp_path)


@pytest.mark.parametrize("name", TARGETS)
def test_inputs_that_are_nearly_right_are_taken_or_refused_with_one_line(name: str) -> None:
    broken = [(outcome, data) for data, outcome in fuzz.by_chance(TARGETS[name], 40) if isinstance(outcome, Exception)]
    assert not broken


@pytest.mark.parametrize(("name", "data"), FOUND)
def test_inputs_that_once_broke_something_are_taken_or_refused_with_one_line(
    name: str, data: bytes, tmp_path: Path
) -> None:
    fuzz.attacked(TARGETS[name], data, tmp_path)


def test_what_is_broken_is_told() -> None:
    def odd(data: bytes, folder: Path) -> None:
        raise ZeroDivisionError(data[:3])

    ((_, outcome),) = fuzz.by_chance(fuzz.Target((b"seed",), odd), 1)
    assert isinstance(outcome, ZeroDivisionError)
    with pytest.raises(fuzz.Broken, match="message"):
        fuzz.plain(fuzz.KalmarkError(""))


def test_a_message_is_one_line_whatever_the_input_has_in_it() -> None:
    assert str(fuzz.KalmarkError("column 'a\nb\x1b[2J' in Zürich")) == "column 'a\\nb\\x1b[2J' in Zürich"
    long = str(fuzz.KalmarkError(f"file:1: {'x' * 5000}, expected a number"))
    assert len(long) < 1000 and long.startswith("file:1: xxx") and long.endswith("xxx, expected a number")
