"""Statuses of a map or a path: by its own log."""

from __future__ import annotations

from typing import NamedTuple

OK, UNCHECKED, DOUBTFUL, WRONG = "ok", "unchecked", "doubtful", "wrong"
STATUSES = (OK, UNCHECKED, DOUBTFUL, WRONG)  # from the best on


class Sign(NamedTuple):
    """A line that should not be overlooked, and the best status that a map or path can have with it."""

    line: str
    status: str = OK


def worst_status(*statuses: str) -> str:
    """Return the worst of some statuses, ok without any."""
    return max(statuses, key=STATUSES.index, default=OK)
