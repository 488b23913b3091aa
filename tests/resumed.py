"""A run that is saved and loaded on the way, beside one that is not."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

import kalmark as km


def ends_alike(slams: Sequence[km.Slam], events: Sequence[Any], same: Sequence[Any], at: int, path: Path) -> None:
    """Assert that a robot is where it is when the second of two gets the `same` events, and is resumed after `at`."""
    one, other = slams
    for k, (event, again) in enumerate(zip(events, same, strict=True)):
        one.process(event)
        other.process(again)
        if k == at:
            other.save(path)
            other = km.Slam.load(path)
    (name,) = one.robots
    np.testing.assert_array_equal(one.mean(name), other.mean(name))
    np.testing.assert_array_equal(one.covariance(name), other.covariance(name))
