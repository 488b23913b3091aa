"""`kalmark live`: events as lines of JSON in, estimates out."""

from __future__ import annotations

import socket
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from kalmark.cli.shared import Overrides, computing, slam_of, writable
from kalmark.errors import DivergedError, KalmarkError

if TYPE_CHECKING:
    from kalmark.results.live import Live

HERE = "127.0.0.1"


def live(
    config: Annotated[
        str, typer.Argument(metavar="CONFIG", help="A YAML file, a shipped name, or a saved map, .kmk, to go on with.")
    ],
    listen: Annotated[
        int | None, typer.Option(metavar="PORT", min=0, max=65535, help="Answer on this port of this machine instead.")
    ] = None,
    out: Annotated[Path | None, typer.Option(metavar="MAP", help="Save the map here at the end, .kmk.")] = None,
    overrides: Overrides = None,
) -> None:
    """Take events as lines of JSON on standard input or a socket; answer each with the estimate after it."""
    from kalmark.results.live import Live, converse
    from kalmark.slam.slam import Slam

    if out is not None:
        writable(out.parent)
    with computing():
        if Path(config).suffix == ".kmk":
            if overrides:
                raise KalmarkError("--set changes a configuration, and a saved map has its own")
            slam = Slam.load(config)
        else:
            slam = slam_of(config, overrides or ())
        slam.warm_up()
        told = Live(slam)
        try:
            if listen is None:
                incoming, outgoing = (typer.get_text_stream(n, "utf-8", "replace") for n in ("stdin", "stdout"))
                converse(told, incoming, outgoing)
            else:
                serve(told, listen)
        finally:
            if out is not None and not told.lost:
                slam.save(out)
    if told.lost:
        raise DivergedError(told.lost)


def serve(told: Live, port: int) -> None:
    """Answer one program after the other on a port of this machine, until the filter is lost."""
    from kalmark.results.live import converse

    try:
        server = socket.create_server((HERE, port))
    except OSError as error:
        raise KalmarkError(f"--listen {port}: {error.strerror}, expected a free port") from None
    with server:
        typer.echo(f"listening on {HERE}:{server.getsockname()[1]}", err=True)
        while not told.lost:
            connection, _ = server.accept()
            try:
                with (
                    connection,
                    connection.makefile("r", encoding="utf-8", errors="replace", newline="\n") as incoming,
                    connection.makefile("w", encoding="utf-8", newline="\n") as outgoing,
                ):
                    converse(told, incoming, outgoing)
            except OSError:  # the program is gone; the map stays for the next one
                continue
