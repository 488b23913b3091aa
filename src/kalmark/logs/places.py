"""The folders in which logs are looked for.

`KALMARK_DATA` names a folder that has datasets, `KALMARK_ORACLE` one of recordings, `KALMARK_CACHE` the cache of
downloads (default: the platform's).
"""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

import platformdirs

from kalmark.errors import LogError
from kalmark.plugins import load_all


def cache_folder() -> Path:
    """Return the download cache.

    >>> (cache_folder() / "lost_in_the_woods").name
    'lost_in_the_woods'
    """
    return Path(os.environ.get("KALMARK_CACHE") or platformdirs.user_cache_path("kalmark") / "data")


def find_data(path: Path | str, base: Path | str | None = None) -> Path:
    """Return the path of a log; raise LogError if it does not exist.

    A relative path is searched in `base` (default: the working folder), then in `KALMARK_DATA`, `KALMARK_ORACLE` and
    the download cache.  It may begin with the name of these folders themselves, as oracle/NAME.json.gz does for a
    `KALMARK_ORACLE` that ends in /oracle.

    >>> log = km.log_from(controls={"t_s": [0.0], "robot": ["rover"], "v_mps": [0.5], "w_radps": [0.0]})
    >>> folder = write_native(log, "my_log")
    >>> find_data("my_log").name
    'my_log'
    """
    path = Path(path)
    with suppress(RuntimeError):  # ~ and the name of nobody: a file may be named so
        path = path.expanduser()
    named = [Path(os.environ[name]) for name in ("KALMARK_DATA", "KALMARK_ORACLE") if os.environ.get(name)]
    places = [folder / path for folder in (Path(base or ""), *named, cache_folder())]  # an absolute path stays as it is
    places += [folder.parent / path for folder in named if path.parts[:1] == (folder.name,)]
    for place in places:
        if place.exists():
            return place
    looked = " or ".join(dict.fromkeys(str(place.absolute()) for place in places))
    hints = [f"; {hint}" for how_to_get in load_all("data")[0].values() if (hint := how_to_get(path))]
    if not os.environ.get("KALMARK_DATA"):
        hints.append("; KALMARK_DATA can name a folder that has it")
    raise LogError(f"log {str(path)!r} not found, expected it at {looked}{''.join(hints)}")
