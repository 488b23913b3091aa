"""`kalmark demo`: Sola's cloister, simulated and solved."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from kalmark.cli.options import computing, writable
from kalmark.cli.run import finish

if TYPE_CHECKING:
    from kalmark.results.run import Run


def run_world(world_path: str | Path, seed: int, *, progress: bool = True) -> Run:
    """Return the run of the filter that fits a world over one log simulated in it."""
    from kalmark.config import build_slam, config_dict
    from kalmark.results.record import record
    from kalmark.simulate import load_world, simulate

    world = load_world(world_path)
    config = world.config().model_copy(update={"seed": seed})
    log = simulate(world, seed)
    return record(build_slam(config, log), log, progress=progress, config=config_dict(config))


def demo(
    out: Annotated[Path, typer.Option(help="The run folder to write.")] = Path("out/demo"),
    seed: Annotated[int, typer.Option(min=0, help="Seed of the simulation.")] = 1,
) -> None:
    """Simulate Sola's cloister, map it, and write a run folder with the picture."""
    writable(out)
    with computing():
        result = run_world("cloister", seed)
        result.save(out)
    finish(result, out, f"Sola's cloister, seed {seed}")
