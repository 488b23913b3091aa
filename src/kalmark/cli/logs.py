"""The command that makes logs, `kalmark simulate`, and those of first files, `kalmark config` and `worlds`."""

from __future__ import annotations

import re
import shlex
from itertools import takewhile
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from kalmark.cli.shared import Overrides, print_table, say, writable

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
    from kalmark.files import write
    from kalmark.logs import write_native

    writable(out)
    loaded = sim.load_world(world, overrides or ())
    log = sim.simulate(loaded, seed)
    write_native(log, out)
    write(out / "config.yaml", fitting_config(loaded, seed))
    say(f"{out}: {len(log)} events of {', '.join(log.robots)}; map them with")
    say(f"kalmark run {shlex.quote(str(out / 'config.yaml'))}")


def fitting_config(world: World, seed: int) -> str:
    """Return the text of a configuration of the filter that fits a world, for a log in its own folder."""
    from kalmark.config import config_dict
    from kalmark.results.recording import config_yaml

    config = world.config()
    log = config.log.model_copy(update={"path": ".", "format": "native"})
    values = config_dict(config.model_copy(update={"log": log, "seed": seed}))
    chosen = config.estimator.model_dump(exclude_defaults=True)  # so that --set estimator.type=ekf is enough
    return config_yaml(values | {"estimator": {"type": config.estimator.type, **chosen}})


def config(
    name: Annotated[
        str | None, typer.Argument(metavar="NAME", help="A shipped configuration, like native. (default: list them)")
    ] = None,
) -> None:
    """Print a shipped configuration, to start your own: kalmark config native > mine.yaml."""
    from kalmark.config import resolve_config, shipped_configs

    if name is None:
        _list(shipped_configs())
    else:
        say(resolve_config(name).read_text(encoding="utf-8").rstrip("\n"))


def worlds(
    name: Annotated[
        str | None, typer.Argument(metavar="NAME", help="A shipped world, like cloister. (default: list them)")
    ] = None,
) -> None:
    """Print a shipped world, to start your own: kalmark worlds cloister > mine.yaml."""
    from kalmark.config.reading import resolve_name
    from kalmark.simulate import shipped_worlds

    if name is None:
        _list(shipped_worlds())
    else:
        say(resolve_name(name, shipped_worlds(), "world").read_text(encoding="utf-8").rstrip("\n"))


def _list(shipped: dict[str, Path]) -> None:
    """Print the names of files and their first comments."""
    print_table("", ("name", "what"), [(name, _headline(path)) for name, path in shipped.items()], align="<<")


def _headline(path: Path) -> str:
    """Return the first sentence of a file's first comment."""
    lines = takewhile(lambda line: line.startswith("#"), path.read_text(encoding="utf-8").splitlines())
    text = " ".join(line.lstrip("# ").rstrip() for line in lines if not line.startswith("#   "))
    return re.split(r"(?<=[a-z0-9)])\.(?:\s|$)", text, maxsplit=1)[0]
