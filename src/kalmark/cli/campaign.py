"""`kalmark campaign`: many runs of a world or of a log's replay, estimators side by side."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from kalmark.cli.shared import Overrides, announce_compilation_elsewhere, computing, number, print_table, writable

if TYPE_CHECKING:
    from kalmark.campaign import Campaign

NEES = ("joint", "pose", "state", "heading", "landmarks", "mount")
FIGURES = (
    ("diverged", "diverged"),
    *((f"{name}_anees", name) for name in NEES),
    ("pose_inside", "pose in its band, %"),
    ("position_rmse_m", "position RMSE, m"),
    ("heading_rmse_deg", "heading RMSE, deg"),
    ("landmark_rmse_m", "landmark RMSE, aligned, m"),
    ("landmark_rmse_raw_m", "landmark RMSE, raw, m"),
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
    world: Annotated[str, typer.Argument(metavar="WORLD_OR_CONFIG", help="A YAML file or a shipped name.")],
    runs: Annotated[int, typer.Option(min=1, help="How many runs of each estimator.")],
    estimator: Annotated[
        list[str] | None,
        typer.Option(help="invariant, ekf, fej, invariant:iterations=1; may be given again. (default: the file's)"),
    ] = None,
    log: Annotated[Path | None, typer.Option(help="The log to use instead of the configuration's.")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the campaign.")] = 0,
    jobs: Annotated[int | None, typer.Option(min=1, help="Processes. (default: one a core)")] = None,
    backend: Annotated[Backend, typer.Option(help="Who runs the processes.")] = Backend.LOKY,
    skip: Annotated[int, typer.Option(min=0, help="Steps at the beginning that no average of NEES counts.")] = 0,
    out: Annotated[Path | None, typer.Option(help="The folder to write. (default: out/campaign-NAME)")] = None,
    overrides: Overrides = None,
) -> None:
    """Run a world many times, or a log with all noise drawn anew: ANEES and its band, RMSE, divergences.

    A log's route, map and sightings are those that its configured filter finds; all else is simulated by its models.
    """
    announce_compilation_elsewhere()
    from kalmark.campaign import open_scene, run_campaign
    from kalmark.campaign.running import refuse_unknown

    out = writable(out or Path("out") / f"campaign-{Path(world).stem}")
    refuse_unknown(estimator)
    with computing():
        scene = open_scene(world, overrides or (), log)
    result = run_campaign(scene, runs, estimator, seed=seed, jobs=jobs, backend=backend.value, skip=skip)
    result.save(out)
    print_campaign(result)
    typer.echo(f"{out}: summary.json, anees.csv and anees.png")


def print_campaign(campaign: Campaign) -> None:
    """Print one row a figure, one column an estimator."""
    estimators: dict[str, dict[str, Any]] = campaign.summary()["estimators"]
    rows = []
    for key, label in FIGURES:
        if any(figures.get(key) is not None for figures in estimators.values()):
            name = key.removesuffix("_anees")
            band = campaign.band(name) if name in NEES else None
            words = (campaign.label(name) if name in NEES else label, "{:.2f} to {:.2f}".format(*band) if band else "")
            unit = "%" if key.endswith("_inside") else ""
            rows.append((*words, *(number(figures.get(key), unit) for figures in estimators.values())))
    title = f"{campaign.world}: {campaign.runs} runs, seed {campaign.seed}; ANEES (in brackets: of a consistent filter)"
    print_table(title, ("", "95 % band, one step", *estimators), rows, align="<>" + ">" * len(estimators))
