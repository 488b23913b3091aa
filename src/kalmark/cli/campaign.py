"""`kalmark campaign`: many runs of a world, estimators side by side."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from kalmark.cli.options import Overrides, announce_compilation_elsewhere, writable
from kalmark.cli.tables import number, print_table

if TYPE_CHECKING:
    from kalmark.campaign import Campaign

NEES = ("joint", "pose", "state", "heading", "landmarks", "mount")
FIGURES = (
    ("diverged", "diverged"),
    *((f"{name}_anees", name) for name in NEES),
    ("pose_inside", "pose in its band, %"),
    ("position_rmse_m", "position RMSE, m"),
    ("heading_rmse_deg", "heading RMSE, deg"),
    ("landmark_rmse_m", "landmark RMSE, m"),
    ("mount_m", "mount at the end, m"),
    ("mount_deg", "mount at the end, deg"),
    ("mount_sure", "mounts within 3 sigma at the end"),
)


class Backend(StrEnum):
    """Who runs the processes."""

    LOKY = "loky"
    DASK = "dask"
    RAY = "ray"


def campaign(
    world: Annotated[str, typer.Argument(metavar="WORLD", help="A YAML file or a shipped name.")],
    runs: Annotated[int, typer.Option(min=1, help="How many runs of each estimator.")],
    estimator: Annotated[
        list[str] | None,
        typer.Option(help="invariant, ekf, fej, invariant:iterations=1; may be given again. (default: the world's)"),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the campaign.")] = 0,
    jobs: Annotated[int | None, typer.Option(min=1, help="Processes. (default: one a core)")] = None,
    backend: Annotated[Backend, typer.Option(help="Who runs the processes.")] = Backend.LOKY,
    skip: Annotated[int, typer.Option(min=0, help="Steps at the beginning that no average of NEES counts.")] = 0,
    out: Annotated[Path | None, typer.Option(help="The folder to write. (default: out/campaign-WORLD)")] = None,
    overrides: Overrides = None,
) -> None:
    """Run a world many times: ANEES and its band, RMSE, divergences, estimators side by side."""
    announce_compilation_elsewhere()
    from kalmark.campaign import run_campaign
    from kalmark.simulate import load_world

    out = writable(out or Path("out") / f"campaign-{Path(world).stem}")
    loaded = load_world(world, overrides or ())
    result = run_campaign(loaded, runs, estimator, seed=seed, jobs=jobs, backend=backend.value, skip=skip)
    result.save(out)
    print_campaign(result)
    typer.echo(f"{out}: summary.json, anees.csv and anees.png")


def print_campaign(campaign: Campaign) -> None:
    """Print one row a figure, one column an estimator."""
    estimators: dict[str, dict[str, Any]] = campaign.summary()["estimators"]
    rows = [
        (
            campaign.label(label) if label in NEES else label,
            *(number(figures.get(key), "%" if key.endswith("_inside") else "") for figures in estimators.values()),
        )
        for key, label in FIGURES
        if any(figures.get(key) is not None for figures in estimators.values())
    ]
    title = f"{campaign.world}: {campaign.runs} runs, seed {campaign.seed}; ANEES (in brackets: of a consistent filter)"
    print_table(title, ("", *estimators), rows, align="<" + ">" * len(estimators))
