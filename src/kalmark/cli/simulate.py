"""`kalmark simulate`: a world in, a native log with truth out."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from kalmark.cli.options import Overrides, writable

if TYPE_CHECKING:
    from kalmark.logs.log import Log


def simulate_log(world_path: str | Path, seed: int, overrides: Sequence[str] = ()) -> Log:
    """Return one log of a world."""
    from kalmark import simulate as sim

    return sim.simulate(sim.load_world(world_path, overrides), seed)


def simulate(
    world: Annotated[str, typer.Argument(metavar="WORLD", help="A YAML file or a shipped name.")],
    out: Annotated[Path, typer.Option(metavar="LOG", help="The folder of the log to write.")],
    seed: Annotated[int, typer.Option(min=0, help="Seed of the noise.")] = 1,
    overrides: Overrides = None,
) -> None:
    """Simulate a world and write a native log with its truth."""
    from kalmark.logs import write_native

    writable(out)
    log = simulate_log(world, seed, overrides or ())
    write_native(log, out)
    typer.echo(f"{out}: {len(log)} events of {', '.join(log.robots)}")
