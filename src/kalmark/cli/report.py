"""`kalmark report`: the picture and the page of a run, made again."""

from __future__ import annotations

import typer

from kalmark.cli.options import RunFolder


def report(run: RunFolder) -> None:
    """Write map.png and report.html of a run again."""
    from kalmark.results.run import Run

    Run.load(run).report(run)
    typer.echo(f"{run / 'map.png'}\n{run / 'report.html'}")
