"""`kalmark config`: the text of a shipped configuration, to start one's own from."""

from __future__ import annotations

from typing import Annotated

import typer


def config(
    name: Annotated[str, typer.Argument(metavar="NAME", help="A shipped configuration, like native.")],
) -> None:
    """Print a shipped configuration, to start your own: kalmark config native > mine.yaml."""
    from kalmark.config import resolve_config

    typer.echo(resolve_config(name).read_text(encoding="utf-8"), nl=False)
