"""Read the numeric arrays of a MATLAB file of the versions 5 to 7.

Source: MathWorks, MAT-File Format, "Level 5 MAT-File Format".  A file is a header of 128 bytes and elements, each with
a tag of type and size; an array is an element of elements: flags, dimensions, name, numbers; it may be compressed as a
whole.  scipy reads these files, too; of damaged ones it reads beyond what is there, which ends the process.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from kalmark.arrays import Array
from kalmark.logs.log import Names

HEADER, TAG, EIGHT = 128, 8, 8
ORDERS = {b"IM": "<", b"MI": ">"}
TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
ARRAY, COMPRESSED = 14, 15
NUMERIC = range(6, 16)  # classes: double, single, integers; others are cells, structures, texts, ...
COMPLEX = 0x0800
MOST_BYTES = 1 << 30  # of one array
NAME_BYTES = 4096  # in which its name is


class Element(NamedTuple):
    """An element: its type, its content, and where the next one begins."""

    type: int
    content: bytes
    end: int


def element(data: bytes, at: int, order: str) -> Element:
    """Return the element at a place.  Raises ValueError if it is cut."""
    if at + TAG > len(data):
        raise ValueError("ends too early")
    kind, size = (int(v) for v in np.frombuffer(data, order + "u4", 2, at))
    begin = at + TAG
    if kind >> 16:  # a small one has its content in its tag
        kind, size, begin = kind & 0xFFFF, kind >> 16, at + 4
        if size > 4:
            raise ValueError(f"an element of {size} bytes in 4")
        return Element(kind, data[begin : begin + size], at + TAG)
    if begin + size > len(data):
        raise ValueError(f"ends too early: {begin + size - len(data)} bytes are missing")
    end = begin + size + (-size % EIGHT if kind != COMPRESSED else 0)
    return Element(kind, data[begin : begin + size], end)


def elements(path: Path, most: int) -> Iterator[tuple[str, bytes]]:
    """Yield byte order and content of the arrays of a file, at most so many bytes.  Raises ValueError, OSError."""
    data = path.read_bytes()
    order = ORDERS.get(data[HEADER - 2 : HEADER])
    if len(data) < HEADER or order is None:
        raise ValueError("no header of a MATLAB file of the versions 5 to 7")
    at = HEADER
    while at < len(data):
        found = element(data, at, order)
        at = found.end
        if found.type == COMPRESSED:
            try:
                plain = zlib.decompressobj().decompress(found.content, most)
            except zlib.error as error:
                raise ValueError(str(error)) from None
            if len(plain) < TAG:
                raise ValueError("ends too early")
            kind, size = (int(v) for v in np.frombuffer(plain, order + "u4", 2))
            found = Element(kind, plain[TAG : TAG + size], at)
        if found.type == ARRAY:
            yield order, found.content[:most]


class Head(NamedTuple):
    """Header of an array, and the place of its numbers."""

    name: str
    shape: tuple[int, ...]
    numeric: bool
    at: int


def head(content: bytes, order: str) -> Head:
    """Return the head of an array.  Raises ValueError."""
    flags = element(content, 0, order)
    dimensions = element(content, flags.end, order)
    name = element(content, dimensions.end, order)
    if len(flags.content) < 4 or len(dimensions.content) % 4:
        raise ValueError("an array without flags and dimensions")
    told = int(np.frombuffer(flags.content, order + "u4", 1)[0])
    shape = tuple(int(v) for v in np.frombuffer(dimensions.content, order + "i4"))
    return Head(name.content.decode("latin-1"), shape, (told & 0xFF) in NUMERIC and not told & COMPLEX, name.end)


def names(path: Path) -> set[str]:
    """Return the names of the arrays in a file.  Raises ValueError, OSError."""
    return {head(content, order).name for order, content in elements(path, NAME_BYTES)}


def load_arrays(path: Path, wanted: Names) -> dict[str, Array]:
    """Return those of the wanted arrays that there are, as float64.  Raises ValueError, OSError."""
    out = {}
    for order, content in elements(path, MOST_BYTES):
        told = head(content, order)
        if told.name not in wanted:
            continue
        if not told.numeric:
            raise ValueError(f"{told.name} is no array of real numbers")
        values = element(content, told.at, order)
        if values.type not in TYPES:
            raise ValueError(f"{told.name} has numbers of the unknown type {values.type}")
        kind = np.dtype(order + TYPES[values.type])
        count = len(values.content) // kind.itemsize
        if min(told.shape, default=0) < 0 or count != int(np.prod([*map(float, told.shape)])) or len(told.shape) < 2:
            raise ValueError(f"{told.name} has {count} numbers, expected those of the shape {told.shape}")
        flat = np.frombuffer(values.content, kind, count).astype(np.float64)
        out[told.name] = flat.reshape(told.shape, order="F")
    return out
