"""Arguments and options that several verbs share."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Annotated, Any

import typer

from kalmark.errors import KalmarkError

Overrides = Annotated[
    list[str] | None, typer.Option("--set", metavar="KEY.PATH=VALUE", help="Override one key; may be given again.")
]
COMPILING = "kalmark: compiling its inner loops, this once for this kind of run; in space it can take minutes\n"
RunFolder = Annotated[Path, typer.Argument(metavar="RUN", help="The folder that `kalmark run` wrote.")]


@contextmanager
def computing() -> Iterator[None]:
    """Say so when inner loops are compiled, and keep BLAS to one thread.

    The matrices of a scan are small: with more threads, they only wait for each other.
    """
    announce_compilation()
    import scipy.linalg  # noqa: F401 - loads its BLAS, so that the limit takes hold of it
    from threadpoolctl import threadpool_limits

    with threadpool_limits(1):
        yield


@cache
def announce_compilation() -> None:
    """From now on say on stderr, once, that an inner loop is being compiled; one loaded from the cache is not."""
    from numba.core import event

    class Announcer(event.Listener):  # type: ignore[misc, unused-ignore]
        def on_start(self, event: Any) -> None:
            if event.data["dispatcher"].py_func.__module__.startswith("kalmark."):
                say_compiling()

        def on_end(self, event: Any) -> None:
            pass

    event.register("numba:compile", Announcer())


def announce_compilation_elsewhere() -> None:
    """Say on stderr that other processes will compile the inner loops, as far as can be known: nothing is there yet."""
    from kalmark.compiled import cache_folder

    if not Path(cache_folder()).exists():
        say_compiling()


@cache
def say_compiling() -> None:
    """Say on stderr that this takes longer than it will the next time; once in a process."""
    sys.stderr.write(COMPILING)


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
