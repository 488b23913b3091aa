"""A progress bar that appears on standard error only when something takes longer than two seconds."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from typing import TypeVar

T = TypeVar("T")


def track(
    items: Iterable[T], what: str, total: int | None = None, *, show: bool = True, delay_s: float = 2.0
) -> Iterator[T]:
    """Yield the items; after `delay_s` seconds show a bar named `what` on standard error, if `show`."""
    if not show:
        yield from items
        return
    bar = None
    start = shown = time.perf_counter()
    done = 0
    try:
        for done, item in enumerate(items):
            now = time.perf_counter()
            if bar is None and now - start > delay_s:
                bar = _Bar(what, total)
            if bar is not None and now - shown > 0.1:
                bar.advance_to(done)
                shown = now
            yield item
        if bar is not None:
            bar.advance_to(done + 1)
    finally:
        if bar is not None:
            bar.close()


class _Bar:
    """One rich progress bar on standard error."""

    def __init__(self, what: str, total: int | None) -> None:
        from rich.console import Console  # most runs are over before a bar is needed
        from rich.progress import (
            BarColumn,
            MofNCompleteColumn,
            Progress,
            TextColumn,
            TimeElapsedColumn,
            TimeRemainingColumn,
        )

        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
            console=Console(stderr=True),
            auto_refresh=False,
        )
        self._task = self._progress.add_task(what, total=total)
        self._progress.start()

    def advance_to(self, done: int) -> None:
        self._progress.update(self._task, completed=done, refresh=True)

    def close(self) -> None:
        self._progress.stop()
