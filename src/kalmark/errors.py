"""The errors kalmark raises on bad input: one line each, saying what, where and what was expected."""

from __future__ import annotations


class KalmarkError(Exception):
    """Any input kalmark refuses.  The command line prints it as one line and exits with status 2."""


class EventError(KalmarkError):
    """A control, scan or fix that cannot be used; the map is exactly what it was before."""


class ImageError(EventError):
    """A frame whose image cannot be read.  A run goes on without it."""


class ModelError(KalmarkError):
    """A motion, sensor or landmark model that is wrong in itself or does not fit the others.

    `key` is the parameter that is wrong, if it is one, and `wanted` what it is to be.
    """

    key = ""
    wanted = ""


class MapError(KalmarkError):
    """A block that is not in the map, or a map that cannot be read."""


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
