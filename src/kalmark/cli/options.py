"""Arguments and options that several verbs share."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from kalmark.errors import KalmarkError

Overrides = Annotated[
    list[str] | None, typer.Option("--set", metavar="KEY.PATH=VALUE", help="Override one key; may be given again.")
]
RunFolder = Annotated[Path, typer.Argument(metavar="RUN", help="The folder that `kalmark run` wrote.")]


@contextmanager
def computing() -> Iterator[None]:
    """Keep BLAS to one thread.

    The matrices of a scan are small: with more threads, they only wait for each other.
    """
    from threadpoolctl import threadpool_limits

    import kalmark.filter.kernels  # noqa: F401 - loads the BLAS, so that the limit takes hold of it

    with threadpool_limits(1):
        yield


def announce_compilation_elsewhere() -> None:
    """Say on stderr that other processes will compile the inner loops, as far as can be known: nothing is there yet."""
    from kalmark.compiled import SOURCES, cache_folder, say_compiling

    if not all(Path(cache_folder(part)).exists() for part in SOURCES):
        say_compiling()


def writable(folder: Path) -> Path:
    """Return a folder that can be made or written to, without making it: found out before the work, not after."""
    import os

    existing = folder
    while not existing.exists() and existing != existing.parent:
        existing = existing.parent
    if not existing.is_dir():
        raise KalmarkError(f"--out {folder}: {existing} is a file, expected a folder")
    if not os.access(existing, os.W_OK | os.X_OK):
        raise KalmarkError(f"--out {folder}: {existing} cannot be written to")
    return folder
