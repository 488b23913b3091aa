"""`kalmark explain`: one scan's association."""

from __future__ import annotations

from typing import Annotated

import typer

from kalmark.cli.options import RunFolder


def explain(
    run: RunFolder,
    scan: Annotated[
        float, typer.Option(metavar="T", help="The log's time in s, as in associations.csv; else since the first scan.")
    ],
    robot: Annotated[str | None, typer.Option(help="Of this robot. (default: the nearest scan of any)")] = None,
) -> None:
    """Say why one scan's observations became what they did, and draw it: what each was compared with, d2, gates."""
    from kalmark.results.explain import explain as explanation_of
    from kalmark.results.files import file_name, replace_file
    from kalmark.results.plot_scan import save_scan
    from kalmark.results.run import Run

    loaded = Run.load(run)
    told = explanation_of(loaded, scan, robot)
    for line in told.lines():
        typer.echo(line)
    path = run / f"scan_{file_name(told.robot)}_{told.in_log}.png"
    replace_file(path, lambda temporary: save_scan(loaded, told, temporary))
    typer.echo(str(path))
