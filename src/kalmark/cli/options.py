"""Arguments and options that several verbs share."""

from __future__ import annotations

import sys
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
    """Say so if the inner loops are yet to be compiled, and keep BLAS to one thread.

    The matrices of a scan are small: with more threads, they only wait for each other.
    """
    announce_compilation()
    import scipy.linalg  # noqa: F401 - loads its BLAS, so that the limit takes hold of it
    from threadpoolctl import threadpool_limits

    with threadpool_limits(1):
        yield


def announce_compilation() -> None:
    """Say on stderr that the first run of this version will take longer."""
    from kalmark.compiled import cache_folder

    if not Path(cache_folder()).exists():
        sys.stderr.write("kalmark: compiling its inner loops, this once; it takes about half a minute\n")


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
