"""Verbs that have their place and are not there yet: not in the help, but they say so when they are called."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated

import typer

from kalmark.errors import KalmarkError

COMING = {
    "view": "Replay a run interactively.",
    "diagnose": "Say whether the filter is consistent on a log, and if not why.",
    "tune": "Fit the noise of a configuration.",
    "live": "Take events as JSON lines, give estimates.",
}


def coming(name: str, what: str) -> Callable[..., None]:
    """Return the command that says it is not available yet."""

    def command(arguments: Annotated[list[str] | None, typer.Argument(hidden=True)] = None) -> None:
        raise KalmarkError(f"{name} is not available yet ({what[0].lower()}{what[1:].rstrip('.')})")

    return command
