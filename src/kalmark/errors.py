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
    """Any input kalmark refuses.  The command line prints it as one line and exits with status 2.

    >>> try:
    ...     km.Slam(km.Robot("rover", km.motion.Unicycle())).mean("nobody")
    ... except km.KalmarkError as error:
    ...     print(error)
    'nobody' is not in the map, expected 'rover' or one of its 0 landmarks

    `path` has the keys that lead to what is wrong in a description of a Slam.
    """

    path: tuple[str, ...] = ()

    def __str__(self) -> str:
        return one_line(super().__str__())


class EventError(KalmarkError):
    """A control, scan or fix that cannot be used; the map is exactly what it was before.

    >>> slam = km.Slam(km.Robot("rover", km.motion.Unicycle()))
    >>> try:
    ...     slam.process(km.Control(t_s=0.0, robot="rover", u=(1.0,)))
    ... except EventError as error:
    ...     print(error)
    control at t=0 s: u has shape (1,), expected (v_mps, w_radps)
    """


class ImageError(EventError):
    """A frame whose image cannot be read.  A run goes on without it.

    >>> issubclass(ImageError, EventError)
    True
    """


class ModelError(KalmarkError):
    """A motion, sensor or landmark model that is wrong in itself or does not fit the others.

    `key` is the parameter that is wrong, if it is one, and `wanted` its expected value.

    >>> try:
    ...     km.sensors.RangeBearing(sigma_range_m=-1.0)
    ... except ModelError as error:
    ...     print(f"{error.key}: {error.wanted}")
    sigma_range_m: a number of at least 0
    """

    key = ""
    wanted = ""


class MapError(KalmarkError):
    """A block that is not in the map, or a map that cannot be read.

    >>> slam = km.Slam(km.Robot("rover", km.motion.Unicycle()))
    >>> try:
    ...     slam.remove("rover")
    ... except MapError as error:
    ...     print(error)
    'rover' is a robot, expected a landmark
    """


class PluginError(KalmarkError):
    """A plug-in is not installed or cannot be loaded.

    >>> from kalmark.plugins import load
    >>> try:
    ...     load("formats", "nothing")
    ... except PluginError as error:
    ...     print(error)
    no installed package has 'nothing' among its kalmark.formats, expected one
    """


class LogError(KalmarkError):
    """A log that cannot be read.  The message starts with ``file:line:`` where there is one.

    >>> try:
    ...     km.log_from(controls={"t_s": [0.0], "robot": ["rover"], "v_mps": ["fast"]})
    ... except LogError as error:
    ...     print(error)
    controls row 1: v_mps is 'fast', expected a finite number
    """


class ConfigError(KalmarkError):
    """A configuration that cannot be read.  The message starts with ``file:line:column:``.

    >>> from kalmark.config import load_config
    >>> try:
    ...     load_config("native", ["estimator.type=efk"])
    ... except ConfigError as error:
    ...     print(str(error).partition(", ")[0])
    --set estimator.type=efk: estimator.type: got 'efk'
    """


class DataError(KalmarkError):
    """A dataset that is unknown, cannot be fetched or fails its checksum.

    >>> from kalmark.logs import fetch
    >>> try:
    ...     fetch("nothing")
    ... except DataError as error:
    ...     print(str(error)[:29])
    dataset 'nothing' is unknown,
    """


class RunError(KalmarkError):
    """A run folder that is missing something or cannot be read.

    >>> try:
    ...     km.Run.load("nowhere")
    ... except RunError as error:
    ...     print(error)
    nowhere/summary.json: no such file, expected the folder of a complete run
    """


class DivergedError(KalmarkError):
    """The filter is lost for good: the covariance of a robot is none.  All other errors leave the map as it was.

    >>> issubclass(DivergedError, km.KalmarkError), issubclass(DivergedError, EventError)
    (True, False)
    """
