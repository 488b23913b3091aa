"""`kalmark evaluate`: the figures of a run."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from kalmark.cli.options import RunFolder, computing
from kalmark.cli.tables import print_summary


def evaluate_run(folder: Path, truth: Path | None = None, *, batch: bool = False) -> dict[str, Any]:
    """Return the figures of a run, judged by its own truth or by that of another log.

    The comparison with the batch solution is kept in the run's ``summary.json`` (if judged by its own truth).
    """
    from kalmark.results.files import write
    from kalmark.results.run import Run

    run = Run.load(folder)
    if truth is not None:
        from kalmark.logs import open_log

        run = run.with_truth(open_log(truth))
    summary = run.evaluate(batch=batch)
    if batch and truth is None:
        write(folder / "summary.json", json.dumps(summary, indent=2, allow_nan=False) + "\n")
    return summary


def evaluate(
    run: RunFolder,
    truth: Annotated[Path | None, typer.Option(metavar="LOG", help="Judge by the truth of this log.")] = None,
    batch: Annotated[
        bool, typer.Option("--batch", help="Compare with the batch solution, and keep that in the run.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print all figures as JSON.")] = False,
) -> None:
    """Print the figures of a run."""
    with computing():
        summary = evaluate_run(run, truth, batch=batch)
    if as_json:
        typer.echo(json.dumps(summary, indent=2))
    else:
        print_summary(str(run), summary)
