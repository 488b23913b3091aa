"""`kalmark data`: list the published logs, and download them."""

from __future__ import annotations

from typing import Annotated

import typer

from kalmark.cli.shared import print_table, say

data = typer.Typer(help="List and fetch datasets.", no_args_is_help=True)


@data.command("list")
def list_() -> None:
    """List the datasets that can be fetched, and those of which a copy of your own is read."""
    from kalmark.datasets.download import OWN_COPIES, list_data

    rows = [(d.name, f"{d.bytes / 1e6:.1f} MB", d.what, d.licence) for d in list_data()]
    print_table("", ("name", "size", "what", "licence"), rows, align="<><<")
    say("\nNot fetched; put a copy of your own where it is found:\n")
    print_table("", ("name", "what", "put"), [(d.name, d.what, d.put) for d in OWN_COPIES], align="<<<")


@data.command()
def fetch(name: Annotated[str, typer.Argument(help="A dataset, or a group like mrclam.")]) -> None:
    """Download a dataset into the cache, every file checked by its hash; what KALMARK_DATA has is used from there."""
    from rich.console import Console
    from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn, TimeRemainingColumn

    from kalmark.datasets.download import fetch as fetch_data

    columns = TextColumn("{task.description}", markup=False), BarColumn(), DownloadColumn(), TimeRemainingColumn()
    bar = Progress(*columns, console=Console(stderr=True), transient=True)
    task = bar.add_task(name, total=None)

    def show(file: str, done: int, total: int) -> None:
        bar.start()
        bar.update(task, description=file, completed=done, total=total)

    try:
        say(str(fetch_data(name, show)))
    finally:
        if bar.live.is_started:
            bar.stop()
