"""Where a configuration's log is, and whether its format takes what the configuration says of it."""

from __future__ import annotations

from pathlib import Path

from kalmark.config.reading import did_you_mean, shipped_configs
from kalmark.config.schema import Config
from kalmark.errors import LogError
from kalmark.logs import FORMATS, find_data
from kalmark.logs.formats import recognise


def find_log(config: Config, log_path: str | Path | None = None) -> Path:
    """Return where the log is: beside the configuration, in ``KALMARK_DATA``, or in the download cache.

    A path given from outside (`log_path`, an override) is looked for in the working directory instead of beside the
    configuration.  Raises ConfigError or LogError, naming all places.
    """
    if log_path is not None:
        return find_data(log_path).resolve()
    if config.log.path is None:
        raise config.error(("log", "path"), "got nothing, expected the path of a log: here, or with --log PATH")
    own = config.file is not None and config.file not in shipped_configs().values()
    beside = config.file.resolve().parent if config.file and own and not config.overridden("log", "path") else None
    try:
        return find_data(config.log.path, beside).resolve()
    except LogError as error:
        raise config.error(("log", "path"), str(error)) from None


def check_format(config: Config, path: Path) -> None:
    """Refuse a format that does not exist and options that the log's format does not have."""
    name = config.log.format
    if name is not None and name not in FORMATS:
        message = f"got {name!r}, expected one of {', '.join(FORMATS)}{did_you_mean(name, [*FORMATS])}"
        raise config.error(("log", "format"), message)
    entry, _ = recognise(path, name)
    for key, value in config.log.options().items():
        if key not in entry.options:
            known = f"one of {', '.join(entry.options)}" if entry.options else "none"
            message = f"got {value!r}, which logs of format {entry.name} do not take, expected {known} of their options"
            raise config.error(("log", key), message)
