"""The errors kalmark raises on bad input: one line each: what, where and what was expected."""

from __future__ import annotations

__all__ = [
    "ConfigError", "DataError", "DivergedError", "EventError", "ImageError", "KalmarkError", "LogError", "MapError",
    "ModelError", "PluginError", "RunError",
]  # fmt: skip

LONGEST = 1000  # characters of a message


def printable(text: str) -> str:
    """Return a text with line breaks and control characters as escapes, which no terminal obeys."""
    return text if text.isprintable() else "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)


def one_line(text: str) -> str:
    """Return a text that is `printable`; the middle of a long one is left out."""
    plain = printable(text)
    return plain if len(plain) <= LONGEST else f"{plain[: 2 * LONGEST // 3]} ... {plain[-LONGEST // 4 :]}"


class KalmarkError(Exception):
    """Any input kalmark refuses.  The command line prints it as one line and exits with status 2."""

    def __str__(self) -> str:
        return one_line(super().__str__())


class EventError(KalmarkError):
    """A control, scan or fix that cannot be used; the map is exactly what it was before."""


class ImageError(EventError):
    """A frame whose image cannot be read.  A run goes on without it."""


class ModelError(KalmarkError):
    """A motion, sensor or landmark model that is wrong in itself or does not fit the others.

    `key` is the parameter that is wrong, if it is one, and `wanted` its expected value.
    """

    key = ""
    wanted = ""


class MapError(KalmarkError):
    """A block that is not in the map, or a map that cannot be read."""


class PluginError(KalmarkError):
    """A plug-in is not installed or cannot be loaded."""


class LogError(KalmarkError):
    """A log that cannot be read.  The message starts with ``file:line:`` where there is one."""


class ConfigError(KalmarkError):
    """A configuration that cannot be read.  The message starts with ``file:line:column:``."""


class DataError(KalmarkError):
    """A dataset that is unknown, cannot be fetched or fails its checksum."""


class RunError(KalmarkError):
    """A run folder that is missing something or cannot be read."""


class DivergedError(KalmarkError):
    """The filter is lost for good: the covariance of a robot is none.  All other errors leave the map as it was."""
