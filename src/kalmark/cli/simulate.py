"""`kalmark simulate`: a world in; a native log with truth, and the configuration that fits it, out."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from kalmark.cli.options import Overrides, writable

if TYPE_CHECKING:
    from kalmark.simulate import World


def simulate(
    world: Annotated[str, typer.Argument(metavar="WORLD", help="A YAML file or a shipped name.")],
    out: Annotated[Path, typer.Option(metavar="LOG", help="The folder of the log to write.")],
    seed: Annotated[int, typer.Option(min=0, help="Seed of the noise.")] = 1,
    overrides: Overrides = None,
) -> None:
    """Simulate a world and write a native log with its truth, and the configuration of the filter that fits it."""
    from kalmark import simulate as sim
    from kalmark.logs import write_native

    writable(out)
    loaded = sim.load_world(world, overrides or ())
    log = sim.simulate(loaded, seed)
    write_native(log, out)
    (out / "config.yaml").write_text(fitting_config(loaded, seed), encoding="utf-8")
    typer.echo(f"{out}: {len(log)} events of {', '.join(log.robots)}; map them with")
    typer.echo(f"kalmark run {shlex.quote(str(out / 'config.yaml'))}")


def fitting_config(world: World, seed: int) -> str:
    """Return the text of a configuration of the filter that fits a world, for a log in its own folder."""
    from kalmark.config import config_dict
    from kalmark.results.files import config_yaml

    config = world.config()
    log = config.log.model_copy(update={"path": ".", "format": "native"})
    values = config_dict(config.model_copy(update={"log": log, "seed": seed}))
    chosen = config.estimator.model_dump(exclude_defaults=True)  # so that --set estimator.type=ekf is enough
    return config_yaml(values | {"estimator": {"type": config.estimator.type, **chosen}})
