"""A progress bar that appears on standard error only when something takes longer than two seconds."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from typing import Any, TypeVar

from kalmark.errors import printable

T = TypeVar("T")


def track(
    items: Iterable[T],
    what: str,
    total: int | None = None,
    *,
    show: bool = True,
    delay_s: float = 2.0,
    at: Callable[[], int] | None = None,
    note: Callable[[], str] | None = None,
) -> Iterator[T]:
    """Yield the items; after `delay_s` seconds show a bar named `what` on standard error, if `show`.

    `at` is the done part of `total`, if that is not the number of items; `note` is the text behind the bar.
    """
    if not show:
        yield from items
        return
    start = shown = time.perf_counter()
    done, bar = -1, None
    try:
        for done, item in enumerate(items):
            now = time.perf_counter()
            if now - start > delay_s and (bar is None or now - shown > 0.1):
                bar, shown = bar or _bar(what, total), now
                behind = "" if note is None else note()
                bar.update(bar.task_ids[0], completed=done if at is None else at(), note=behind, refresh=True)
            yield item
        if bar is not None:
            bar.update(bar.task_ids[0], completed=done + 1, refresh=True)
    finally:
        if bar is not None:
            bar.stop()


def _bar(what: str, total: int | None) -> Any:
    """Return a rich progress bar that is shown on standard error; most runs are over before one is needed."""
    from rich import progress as rich
    from rich.console import Console

    parts = (rich.TextColumn("{task.description}", markup=False), rich.BarColumn(), rich.MofNCompleteColumn())
    times = (rich.TimeElapsedColumn(), rich.TimeRemainingColumn())
    behind = rich.TextColumn("{task.fields[note]}")
    bar = rich.Progress(*parts, *times, behind, console=Console(stderr=True), auto_refresh=False)
    bar.add_task(printable(what), total=total, note="")
    bar.start()
    return bar
