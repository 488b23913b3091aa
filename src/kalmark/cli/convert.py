"""`kalmark convert`: any log that kalmark reads, as a native one."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from kalmark.cli.options import writable


def convert(
    source: Annotated[Path, typer.Argument(metavar="IN", help="A log in any format kalmark reads.")],
    out: Annotated[Path, typer.Argument(metavar="OUT", help="The folder of the native log to write.")],
    log_format: Annotated[str | None, typer.Option("--format", help="Format of IN, if not recognised.")] = None,
) -> None:
    """Write a log as a native one: a folder of CSV files."""
    from kalmark.logs import open_log, write_native

    writable(out)
    log = open_log(source, log_format)
    write_native(log, out)
    typer.echo(f"{out}: {len(log)} events of {', '.join(log.robots)}, read as {log.format}")
