"""`kalmark campaign`: many runs of a world or of a log's replay, estimators side by side."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from kalmark.cli.shared import (
    OtherLog,
    Overrides,
    announce_compilation_elsewhere,
    cell_text,
    limit_blas_threads,
    print_table,
    say,
    writable,
)
from kalmark.results.figure_texts import Figures

if TYPE_CHECKING:
    from kalmark.campaign import Campaign, Sweep

NEES = ("joint", "pose", "state", "heading", "landmarks", "mount")
SHOWN = ("diverged", "joint_anees", "pose_anees", "position_rmse_m", "heading_rmse_deg", "landmark_rmse_m")  # of sweeps


class Backend(StrEnum):
    """Program that runs the processes."""

    LOKY = "loky"
    DASK = "dask"
    RAY = "ray"


def campaign(
    world: Annotated[str, typer.Argument(metavar="WORLD_OR_CONFIG", help="A YAML file or a shipped name.")],
    runs: Annotated[int, typer.Option(min=1, help="Number of runs of each estimator.")],
    estimator: Annotated[
        list[str] | None,
        typer.Option(
            help="ekf, textbook, invariant:iterations=1, own_file:Class; may be given again. (default: the file's)"
        ),
    ] = None,
    log: OtherLog = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the campaign.")] = 0,
    jobs: Annotated[int | None, typer.Option(min=1, help="Processes. (default: one a core)")] = None,
    backend: Annotated[Backend, typer.Option(help="Who runs the processes.")] = Backend.LOKY,
    address: Annotated[
        str | None, typer.Option(help="Of the dask or ray cluster. (default: its own, else this machine)")
    ] = None,
    sweep: Annotated[
        list[str] | None,
        typer.Option(metavar="KEY.PATH=A,B", help="Run with each of the values; of several keys, all combinations."),
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume/--no-resume", help="Keep the finished runs of this campaign, or run all again.")
    ] = True,
    skip: Annotated[int, typer.Option(min=0, help="Steps at the beginning that no average of NEES counts.")] = 0,
    out: Annotated[Path | None, typer.Option(help="The folder to write. (default: out/campaign-NAME)")] = None,
    overrides: Overrides = None,
) -> None:
    """Run a world many times, or a log with all noise drawn again: ANEES and its band, RMSE, divergences.

    A log's route, map and observations are those that its configured filter finds; all else is simulated by its models.
    """
    announce_compilation_elsewhere()
    from kalmark.campaign import open_cells, run_sweep
    from kalmark.campaign.running import check_backend

    out = writable(out or Path("out") / f"campaign-{Path(world).stem}")
    check_backend(backend.value, address)
    with limit_blas_threads():
        cells = open_cells(world, sweep or (), overrides or (), log, estimators=estimator)
    result = run_sweep(
        cells, runs, estimator, seed, jobs, backend.value, skip=skip, address=address, folder=out, resume=resume
    )
    result.save(out)
    if sweep:
        print_sweep(result)
    else:
        print_campaign(result.campaigns[0])
    for path in dict.fromkeys(campaign.path for campaign in result.campaigns):
        say(f"computed by the {path}")
    say(f"{out}: report.html, summary.json, runs.parquet and, of each step, anees.csv and anees.png")


def print_sweep(sweep: Sweep) -> None:
    """Print one row a cell and estimator, one column a figure."""
    head, rows = sweep.table(SHOWN)
    first = sweep.campaigns[0]
    title = f"{first.world}: {first.runs} runs a cell, seed {first.seed}; ANEES (in brackets: of a consistent filter)"
    texts = [[cell if isinstance(cell, str) else cell_text(cell) for cell in row] for row in rows]
    print_table(title, head, texts, align="<" * (len(sweep.keys) + 1) + ">" * (len(head) - len(sweep.keys) - 1))


def print_campaign(campaign: Campaign) -> None:
    """Print one row a figure, one column an estimator."""
    from kalmark.campaign.campaign import FIGURES

    estimators: dict[str, Figures] = campaign.summary()["estimators"]
    rows = []
    for key, label in FIGURES:
        if any(figures.get(key) is not None for figures in estimators.values()):
            name = key.removesuffix("_anees")
            band = campaign.band(name) if name in NEES else None
            words = (campaign.label(name) if name in NEES else label, "{:.2f} to {:.2f}".format(*band) if band else "")
            unit = "%" if key.endswith("_inside") else ""
            rows.append((*words, *(cell_text(figures.get(key), unit) for figures in estimators.values())))
    title = f"{campaign.world}: {campaign.runs} runs, seed {campaign.seed}; ANEES (in brackets: of a consistent filter)"
    print_table(title, ("", "95 % band, one step", *estimators), rows, align="<>" + ">" * len(estimators))
