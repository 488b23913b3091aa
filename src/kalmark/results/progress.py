"""A progress bar that appears on standard error only when something takes longer than two seconds."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from typing import TypeVar

T = TypeVar("T")


def track(
    items: Iterable[T], what: str, total: int | None = None, *, show: bool = True, delay_s: float = 2.0
) -> Iterator[T]:
    """Yield the items; after `delay_s` seconds show a bar named `what` on standard error, if `show`."""
    if not show:
        yield from items
        return
    start = shown = time.perf_counter()
    done, advance_to = 0, None
    with ExitStack() as closing:
        for done, item in enumerate(items):
            now = time.perf_counter()
            if advance_to is None and now - start > delay_s:
                advance_to = closing.enter_context(_bar(what, total))
            if advance_to is not None and now - shown > 0.1:
                advance_to(done)
                shown = now
            yield item
        if advance_to is not None:
            advance_to(done + 1)


@contextmanager
def _bar(what: str, total: int | None) -> Iterator[Callable[[int], None]]:
    """Show one rich progress bar on standard error; yield what moves it."""
    from rich.console import Console  # most runs are over before a bar is needed
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    parts = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
    times = (TimeElapsedColumn(), TimeRemainingColumn())
    with Progress(*parts, *times, console=Console(stderr=True), auto_refresh=False) as progress:
        task = progress.add_task(what, total=total)
        yield lambda done: progress.update(task, completed=done, refresh=True)
