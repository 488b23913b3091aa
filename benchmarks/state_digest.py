"""A digest of all that events have made of a Slam, to the last bit; what it may make anew at any time is left out."""

from __future__ import annotations

import hashlib
from enum import Enum
from typing import Any

import numpy as np

import kalmark as km

# caches, memory made ready, and what does not change
MADE_ANEW = {"_rows", "_numbers", "_wanted", "_sort_at", "_next", "prefault", "_workspace", "workspace", "_search",
             "_before", "motion", "model", "capacity", "map",
             "addresses"}  # fmt: skip


def add(found: Any, value: Any) -> None:
    """Add a value to a hash, piece by piece."""
    if isinstance(value, np.ndarray):
        found.update(f"{value.shape}{value.dtype.str}".encode())
        found.update(np.ascontiguousarray(value))
    elif isinstance(value, dict):
        for key, item in value.items():
            found.update(repr(key).encode())
            add(found, item)
    elif isinstance(value, set | frozenset):
        found.update(repr(sorted(value, key=repr)).encode())
    elif isinstance(value, list | tuple):
        found.update(str(len(value)).encode())
        for item in value:
            add(found, item)
    elif type(value).__module__.startswith("kalmark.") and not isinstance(value, Enum) and hasattr(value, "__dict__"):
        for key, item in vars(value).items():
            if key not in MADE_ANEW:
                found.update(key.encode())
                add(found, item)
    else:
        found.update(repr(value).encode())


def digest(slam: km.Slam) -> str:
    """Return the digest of the map, the tracks, the clones, the controls held and the time."""
    return _digest(slam, slam.map)


def digest_of_saved(slam: km.Slam) -> str:
    """Return the digest of what `save` writes: a full update that is under way is finished first.

    Not of memory that holds anything: above the diagonal of a covariance.
    """
    return _digest(slam, (slam.map.state(), list(slam.map.arrays())))


def _digest(slam: km.Slam, map_: Any) -> str:
    found = hashlib.sha256()
    add(found, (slam.t_ns, map_, slam.tracks, slam.clones, slam.state.moving))
    return found.hexdigest()
