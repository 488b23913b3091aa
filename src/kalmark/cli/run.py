"""`kalmark run`: one log through one filter."""

from __future__ import annotations

from collections.abc import Sequence
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from kalmark.cli.options import Overrides, computing, writable
from kalmark.cli.tables import print_summary

if TYPE_CHECKING:
    from kalmark.results.run import Run

SHOWN = 5


class OnError(StrEnum):
    """What to do with bad input."""

    RAISE = "raise"
    SKIP = "skip"


def run_log(
    config_path: str | Path,
    log_path: str | Path | None = None,
    *,
    overrides: Sequence[str] = (),
    on_error: str | None = None,
    progress: bool = True,
) -> Run:
    """Return the run of a configuration over the log that it names, or over another one read in the same way."""
    from kalmark import config as cfg
    from kalmark.results.record import record

    override = [] if on_error is None else [f"log.on_error={on_error}"]
    config, log = cfg.open_run(config_path, log_path, [*overrides, *override])
    slam = cfg.build_slam(config, log)
    return record(slam, log, progress=progress, on_error=config.log.on_error, config=cfg.config_dict(config))


def run(
    config: Annotated[str, typer.Argument(metavar="CONFIG", help="A YAML file or a shipped name.")],
    log: Annotated[Path | None, typer.Option(help="The log to use instead of the configuration's.")] = None,
    out: Annotated[Path | None, typer.Option(help="The run folder to write. (default: out/CONFIG)")] = None,
    overrides: Overrides = None,
    on_error: Annotated[
        OnError | None, typer.Option(help="Refuse bad input, or leave it out and list it. (default: raise)")
    ] = None,
    batch: Annotated[
        bool | None,
        typer.Option(help="Compare with the batch solution. (default: if tags' corners were seen)"),
    ] = None,
) -> None:
    """Run one log through one filter and write a run folder."""
    from kalmark.config.tree import name_of, name_on

    out = writable(out or Path("out") / Path(config).stem)
    with computing():
        result = run_log(config, log, overrides=overrides or (), on_error=on_error.value if on_error else None)
        summary = result.evaluate()
        if batch or (batch is None and summary.get("corner_rms_px") is not None):
            summary = against_batch(result, summary, needed=bool(batch))
        result.save(out)
    finish(result, out, name_on(name_of(Path(config), "config"), result.log.name))
    if summary.get("stopped"):
        raise typer.Exit(2)


def against_batch(result: Run, summary: dict[str, Any], needed: bool) -> dict[str, Any]:
    """Return the summary with the batch solution in it, or say why there is none unless that is needed."""
    from kalmark.errors import KalmarkError

    try:
        return result.evaluate(batch=True)
    except KalmarkError as error:
        if needed:
            raise
        typer.echo(f"warning: no batch solution: {error}", err=True)
        return summary


def finish(result: Run, out: Path, title: str) -> None:
    """Print a run's figures and warnings, what was left out, and where the run folder is."""
    from kalmark.results.words import count

    print_summary(title, result.summary)
    if result.skipped:
        typer.echo(f"{count(result.summary['skipped'], 'record')} left out:")
        for line in result.skipped[:SHOWN]:
            typer.echo(f"  {line}")
        if len(result.skipped) > SHOWN:
            typer.echo("  ...")
    typer.echo(f"{out}: map.png, report.html and the rest of the run")
