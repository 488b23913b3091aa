"""`kalmark convert`: a log or a run in another format."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from kalmark.cli.shared import writable
from kalmark.errors import KalmarkError

if TYPE_CHECKING:
    from kalmark.logs.log import Log
    from kalmark.results.run import Run

MCAP = ".mcap"


def convert(
    source: Annotated[
        Path, typer.Argument(metavar="IN", help="A log that kalmark reads, a configuration that names one, or a run.")
    ],
    out: Annotated[Path, typer.Argument(metavar="OUT", help="The folder of the native log to write, or FILE.mcap.")],
    log_format: Annotated[str | None, typer.Option("--format", help="Format of IN, if not recognised.")] = None,
) -> None:
    """Write a log as a native one, a folder of CSV files, or as MCAP, of a run with its results."""
    from kalmark.logs import write_native

    if out.suffix == MCAP:
        if out.exists():
            raise KalmarkError(f"{out}: this file exists already, expected a new one")
        writable(out.parent)
    else:
        writable(out)
    log, run = _read(source, log_format)
    if out.suffix == MCAP:
        from kalmark.results.mcap import export

        counts = export(out, log, run)
        typer.echo(f"{out}: {sum(counts.values())} messages on {', '.join(sorted(counts))}")
    elif log is not None:
        write_native(log, out)
    if log is not None:
        typer.echo(f"{out}: {len(log)} events of {', '.join(log.robots)}, read as {log.format}")


def _read(source: Path, log_format: str | None) -> tuple[Log | None, Run | None]:
    """Return the log, and the run if `source` is the folder of one."""
    from kalmark.logs import open_log

    if (source / "summary.json").is_file() and (source / "config.yaml").is_file():
        from kalmark.config import open_run
        from kalmark.results.run import Run

        return open_run(source / "config.yaml")[1], Run.load(source)
    if source.suffix in (".yaml", ".yml"):
        from kalmark.config import open_run

        return open_run(source)[1], None
    return open_log(source, log_format), None
