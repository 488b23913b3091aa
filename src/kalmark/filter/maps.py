"""The choice of a map: dense, compressed, or dense as long as it is small."""

from __future__ import annotations

from collections.abc import Iterable

from kalmark.errors import ModelError
from kalmark.filter.compressed import restoring as compressed
from kalmark.filter.compressed.compressed_map import CompressedMap
from kalmark.filter.compressed.restoring import NUMBERS
from kalmark.filter.compressed.storage import Triangle
from kalmark.filter.layout import Read, State
from kalmark.filter.map import Map, StochasticMap
from kalmark.geometry.spaces import RHO, Space

DENSE = 80  # landmarks up to which the dense map is faster
MAPS = ("auto", "dense", "postponed")


def new_map(type_: str, numbers: str) -> Map:
    """Return an empty map of a type; `numbers` are those in which a compressed one keeps inactive blocks.

    Raises ModelError for a type or numbers that there are not.
    """
    for what, value, known in (("map", type_, MAPS), ("numbers", numbers, NUMBERS)):
        if value not in known:
            raise ModelError(f"{what} is {value!r}, expected one of {', '.join(known)}")
    return CompressedMap(Triangle(NUMBERS[numbers])) if type_ == "postponed" else StochasticMap()


def compress_if_large(map_: Map, landmarks: Iterable[Space], numbers: str) -> Map:
    """Return a dense map as a compressed one where it pays: from DENSE landmarks on, inverse distances not counted."""
    if not isinstance(map_, StochasticMap) or sum(RHO not in space.kinds for space in landmarks) <= DENSE:
        return map_
    return CompressedMap.from_dense(map_, Triangle(NUMBERS[numbers]))


def restore_map(state: State, read: Read) -> Map:
    """Build the map of a file from what `state` and `arrays` of a map have written."""
    return compressed.restore_compressed(state, read) if "postponed" in state else StochasticMap.restored(state, read)
