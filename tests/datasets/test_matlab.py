"""Arrays of MATLAB files as scipy reads them; of damaged files one error, where scipy ends the process."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io

from kalmark.datasets.array_files import arrays, variables
from kalmark.datasets.matlab import HEADER
from kalmark.errors import LogError


@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize(
    "kind", ["f8", "f4", "i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8"],
)  # fmt: skip
def test_arrays_are_those_that_scipy_reads(kind: str, compressed: bool, tmp_path: Path) -> None:
    random = np.random.default_rng(0)
    told = {name: random.integers(0, 100, shape).astype(kind) for name, shape in (
        ("a", (3, 2)), ("column", (4, 1)), ("one", (1, 1)), ("cube", (2, 3, 4)), ("none", (0, 0)))}  # fmt: skip
    scipy.io.savemat(
        tmp_path / "a.mat", told | {"text": "abc", "cells": np.array([1, "b"], dtype=object)}, do_compression=compressed
    )
    assert variables(tmp_path / "a.mat") == {*told, "text", "cells"}
    found = arrays(tmp_path / "a.mat", tuple(told))
    for name, value in scipy.io.loadmat(tmp_path / "a.mat").items():
        if name in told:
            np.testing.assert_array_equal(found[name], value)
    for name in ("text", "cells"):
        with pytest.raises(LogError, match=f"{name} is no array of real numbers"):
            arrays(tmp_path / "a.mat", (name,))


@pytest.mark.parametrize(
    "file",
    ["lost_in_the_woods/dataset2.mat", "victoria_park/aa3_dr.mat", "victoria_park/aa3_gpsx.mat",
     "plaza1/Plaza1_.mat", "victoria_park/slsjf/data_sensor_clean_clean.mat", "starry_night/vincentive_dataset3.mat"],
)  # fmt: skip
def test_real_files_are_what_scipy_reads(file: str, data: Any) -> None:
    path = data(file)
    known = {name: value for name, value in scipy.io.loadmat(path).items() if not name.startswith("__")}
    assert variables(path) == {*known}
    real = tuple(name for name, value in known.items() if value.dtype.kind in "fiu" and np.isfinite(value).all())
    found = arrays(path, real)
    assert real
    for name in real:
        np.testing.assert_array_equal(found[name], known[name])


def damaged(path: Path, old: bytes, new: bytes) -> Path:
    """Write a file of one array with some bytes changed."""
    scipy.io.savemat(path, {"b": np.arange(6.0).reshape(3, 2)})
    path.write_bytes(path.read_bytes().replace(old, new, 1))
    return path


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        (struct.pack("<ii", 3, 2), struct.pack("<ii", 2**24, 2), "b has 6 numbers, expected those of the shape"),
        (struct.pack("<ii", 3, 2), struct.pack("<ii", -3, -2), "b has 6 numbers, expected those of the shape"),
        (struct.pack("<II", 9, 48), struct.pack("<II", 99, 48), "b has numbers of the unknown type 99"),
        (struct.pack("<II", 9, 48), struct.pack("<II", 9, 2**31), "ends too early: "),
        (struct.pack("<II", 9, 48), struct.pack("<II", 9, 40), "b has 5 numbers"),
        (b"IM", b"XX", "no header of a MATLAB file"),
    ],
)
def test_a_damaged_file_gets_one_line(old: bytes, new: bytes, said: str, tmp_path: Path) -> None:
    path = damaged(tmp_path / "a.mat", old, new)
    with pytest.raises(LogError, match=f"not a complete MATLAB file .{said}") as error:
        arrays(path, ("b",))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("compressed", [False, True])
def test_cut_and_changed_files_are_refused_or_read(compressed: bool, tmp_path: Path) -> None:
    scipy.io.savemat(tmp_path / "a.mat", {"b": np.arange(600.0).reshape(3, 200)}, do_compression=compressed)
    content, random = (tmp_path / "a.mat").read_bytes(), np.random.default_rng(1)
    for end in range(0, len(content) - 1, 37):
        (tmp_path / "cut.mat").write_bytes(content[:end])
        with pytest.raises(LogError):
            arrays(tmp_path / "cut.mat", ("b",))
    for _ in range(400):
        odd = bytearray(content)
        for at in random.integers(HEADER, min(len(odd), HEADER + 80), 3):
            odd[at] = int(random.integers(256))
        (tmp_path / "odd.mat").write_bytes(odd)
        variables(tmp_path / "odd.mat")
        try:
            arrays(tmp_path / "odd.mat", ("b",))
        except LogError as error:
            assert "\n" not in str(error)
