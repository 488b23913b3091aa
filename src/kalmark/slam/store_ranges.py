"""What is known of landmarks that are not in the map yet, in a file: the ranges kept, or the hypotheses left."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from kalmark.errors import MapError
from kalmark.events import Id
from kalmark.geometry.spaces import POINT2, Space
from kalmark.management.hypotheses import POLAR, Ring
from kalmark.management.initialization import Unlocated
from kalmark.management.trilateration import Kept, Ranges


def ranges_described(unlocated: Mapping[Id, Unlocated]) -> list[list[Any]]:
    """Return a row for each landmark."""
    rows: list[list[Any]] = []
    for name, known in unlocated.items():
        if isinstance(known, Ranges):
            kept = [list(each) for each in known.kept]
            rows.append([name, "ranges", known.robot, known.sensor, known.spacing, kept])
        else:
            hypotheses = [known.slots, known.log_weights.tolist()]
            rows.append([name, "hypotheses", known.robot, known.sensor, known.seen, hypotheses])
    return rows


def ranges_restored(rows: list[list[Any]]) -> dict[Id, Unlocated]:
    """Return what `ranges_described` was given; raise MapError for what it cannot have written."""
    unlocated: dict[Id, Unlocated] = {}
    for name, what, robot, sensor, first, rest in rows:
        if what == "ranges":
            kept = [Kept(slot, float(y), float(variance), *varies) for slot, y, variance, *varies in rest]
            unlocated[name] = Ranges(robot, sensor, float(first), kept)
        else:
            slots, log_weights = rest
            unlocated[name] = Ring(robot, sensor, list(slots), np.array(log_weights, dtype=np.float64), int(first))
        numbers = [each.variance for each in kept] if what == "ranges" else log_weights
        if not numbers or not np.isfinite(np.array(numbers, dtype=np.float64)).all():
            raise MapError(f"what is known of {name!r} is {rest!r}, expected finite numbers")
        if what != "ranges" and len(log_weights) != len(slots):
            raise MapError(f"what is known of {name!r} has {len(log_weights)} weights, expected {len(slots)}")
    return unlocated


def ranges_owners(unlocated: Mapping[Id, Unlocated]) -> Iterator[tuple[str, Any, Space]]:
    """Return what each block is, its slot and its space; a place that ranges of several landmarks share is one."""
    places = dict.fromkeys(each.slot for known in unlocated.values() for each in getattr(known, "kept", ()))
    yield from ((f"place {slot!r} of a range", slot, POINT2) for slot in places)
    for name, known in unlocated.items():
        if isinstance(known, Ring):
            yield from ((f"a hypothesis of {name!r}", slot, POLAR) for slot in known.slots)
