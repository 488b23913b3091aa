"""Events as lines of JSON, one object a line: what a robot's program writes to `kalmark live`."""

from __future__ import annotations

import json
from typing import Any

from kalmark.errors import EventError
from kalmark.events import Control, Event, Fix, Scan, short_text
from kalmark.logs.log import Names
from kalmark.logs.source import reason_of, spelling_hint

LONGEST_LINE = 10_000_000  # characters: more than any scan has
_TIMES = ("t_s", "t_ns", "robot")
KEYS: dict[str, tuple[type[Control | Scan | Fix], Names]] = {
    "control": (Control, (*_TIMES, "u", "cov", "share", "uneven")),
    "scan": (Scan, (*_TIMES, "sensor", "y", "ids", "cov", "classes", "of")),
    "fix": (Fix, (*_TIMES, "y", "cov")),
}
"""By their `type`: the events, and the keys that they have."""


def mapping_of(line: str) -> dict[str, Any]:
    """Return the object that a line is.  Raises EventError."""
    if len(line) > LONGEST_LINE:
        raise EventError(f"a line of more than {LONGEST_LINE} characters, expected less")
    try:
        given = json.loads(line, object_pairs_hook=_once)
    except RecursionError:
        raise EventError(f"{short_text(line)} is nested too deeply, expected an object of JSON") from None
    except ValueError as error:
        reason = reason_of(error, 120)
        raise EventError(f"{short_text(line)} is no JSON ({reason}), expected an object on one line") from None
    if not isinstance(given, dict):
        raise EventError(f"{short_text(line)} is no object, expected one with a type, a time and a robot")
    return given


def event_of_object(given: dict[str, Any]) -> Event:
    """Return the event that an object is.  Raises EventError."""
    kind = given.get("type")
    if not isinstance(kind, str) or kind not in KEYS:
        hint = spelling_hint(kind, KEYS) if isinstance(kind, str) else ""
        raise EventError(f"type is {short_text(kind)}, expected one of {', '.join(KEYS)}{hint}")
    event, keys = KEYS[kind]
    told = {key: value for key, value in given.items() if key != "type"}
    for key in told:
        if key not in keys:
            raise EventError(
                f"unknown key {short_text(key)} of a {kind}, expected {', '.join(keys)}{spelling_hint(key, keys)}"
            )
    return event(**told)


def line_of_event(event: Event) -> str:
    """Return an event as a line; times and numbers come back to the last bit.  Raises EventError for a frame."""
    kind = next((name for name, (cls, _) in KEYS.items() if type(event) is cls), None)
    if kind is None:
        raise EventError(f"a {type(event).__name__.lower()} is not written as a line, expected a {', '.join(KEYS)}")
    told = {
        key: getattr(event, key) for key in KEYS[kind][1] if key != "t_s" and (key, getattr(event, key)) != ("share", 1)
    }
    plain = {key: value.tolist() if hasattr(value, "tolist") else value for key, value in told.items()}
    return json.dumps({"type": kind, **{key: value for key, value in plain.items() if value is not None}})


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        names = [name for name, _ in pairs]
        raise ValueError(f"the key {next(n for n in names if names.count(n) > 1)!r} twice")
    return found
