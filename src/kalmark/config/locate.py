"""Where a configuration's log is."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

from kalmark.config.reading import shipped_configs
from kalmark.config.schema import Config
from kalmark.errors import LogError
from kalmark.logs.download import cache_folder


def find_log(config: Config, log_path: str | Path | None = None) -> Path:
    """Return where the log is: beside the configuration, in ``KALMARK_DATA``, or in the download cache.

    A path given from outside (`log_path`, or an override) is looked for in the working directory instead of beside
    the configuration.  Raises ConfigError or LogError, naming all places.
    """
    name = log_path if log_path is not None else config.log.path
    if name is None:
        raise config.error(("log", "path"), "got nothing, expected the path of a log: here, or with --log PATH")
    tried = [folder / Path(name).expanduser() for folder in _folders(config, log_path is not None)]
    for path in tried:
        if path.exists():
            return path.resolve()
    looked = ", ".join(str(path) for path in dict.fromkeys(tried))
    hint = "" if os.environ.get("KALMARK_DATA") else " (KALMARK_DATA is not set)"
    if log_path is not None:
        raise LogError(f"{log_path}: no such log, expected one of {looked}{hint}")
    raise config.error(("log", "path"), f"got {name!r}, expected a log at one of {looked}{hint}")


def _folders(config: Config, from_outside: bool) -> Iterator[Path]:
    if from_outside or config.file is None or config.overridden("log", "path"):
        yield Path.cwd()
    elif config.file not in shipped_configs().values():
        yield config.file.resolve().parent
    if os.environ.get("KALMARK_DATA"):
        yield Path(os.environ["KALMARK_DATA"])
    yield cache_folder()
