"""`kalmark run`: one log through one filter.  `kalmark demo`: Sola's cloister, simulated and solved."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from kalmark.cli.shared import (
    ConfigName,
    OtherLog,
    Overrides,
    limit_blas_threads,
    print_summary,
    say,
    slam_of,
    writable,
)
from kalmark.errors import KalmarkError, PluginError, RunError
from kalmark.plugins import load

if TYPE_CHECKING:
    from kalmark.events import Event
    from kalmark.report import Report
    from kalmark.results.run import Run

SHOWN = 5
VERDICT_OBSERVATIONS = 5_000  # that the verdict at the end of a run takes


class OnError(StrEnum):
    """Treatment of bad input."""

    RAISE = "raise"
    SKIP = "skip"


def run_log(
    config_path: str | Path,
    log_path: str | Path | None = None,
    *,
    overrides: Sequence[str] = (),
    on_error: str | None = None,
    progress: bool = True,
    own: Path | None = None,
    follow: Callable[..., Callable[[Event, Report], object]] | None = None,
) -> Run:
    """Return the run of a configuration over the log that it names, or over another one read in the same way.

    `follow`, given the filter, the log and the options of pictures, returns what observes each event and its report.
    Raises RunError, before anything is computed, if the run folder `own` has the result of another log.
    """
    from kalmark import config as cfg
    from kalmark.results.record import record

    override = [] if on_error is None else [f"log.on_error={on_error}"]
    config, log = cfg.open_run(config_path, log_path, [*overrides, *override], progress=True)
    if own is not None:
        refuse_other_log(own, str(log.path))
    slam = cfg.build_slam(config, log)
    picture = cfg.build_picture(config, slam.robots)
    observers = () if follow is None else (follow(slam, log, picture),)
    whole = cfg.config_dict(config)
    return record(slam, log, progress=progress, on_error=config.log.on_error, config=whole, observers=observers)


def refuse_other_log(folder: Path, path: str) -> None:
    """Refuse to replace the result of another log than that at `path`.  Raises RunError."""
    try:
        other = str(json.loads((folder / "summary.json").read_text(encoding="utf-8"))["log"]["path"])
    except (OSError, ValueError, KeyError, TypeError):
        return  # no result
    if other != path:
        raise RunError(
            f"{folder} has the result of {other}, expected that of {path}: --out DIR names another folder, "
            f"--out {folder} replaces it"
        )


def run(
    config: ConfigName,
    log: OtherLog = None,
    out: Annotated[Path | None, typer.Option(help="The run folder. (default: out/CONFIG, not of another log)")] = None,
    overrides: Overrides = None,
    on_error: Annotated[
        OnError | None, typer.Option(help="Refuse bad input, or leave it out and list it. (default: raise)")
    ] = None,
    batch: Annotated[
        bool | None,
        typer.Option(help="Compare with the batch solution. (default: if tags' corners were seen)"),
    ] = None,
    view: Annotated[bool, typer.Option("--view", help="Show the filter while it runs.")] = False,
    view_to: Annotated[
        Path | None, typer.Option(metavar="FILE.rrd", help="Write what --view shows to a file of rerun.")
    ] = None,
) -> None:
    """Run one log through one filter and write a run folder."""
    from kalmark.config.tree import name_of, name_on

    usual = Path("out") / Path(config).stem
    own, out = usual if out is None else None, writable(out or usual)
    with limit_blas_threads():
        left_out = on_error.value if on_error else None
        follow = partial(load("viewers", "rerun").follow, save=view_to) if view or view_to is not None else None
        result = run_log(config, log, overrides=overrides or (), on_error=left_out, own=own, follow=follow)
        summary = result.evaluate()
        if batch or (batch is None and summary.get("corner_rms_px") is not None):
            try:
                summary = result.evaluate(batch=True)
            except KalmarkError as error:
                if batch:
                    raise
                say(f"warning: no batch solution: {error}", err=True)
        save(result, out)
    finish(result, out, name_on(name_of(Path(config), "config"), result.log.name))
    if summary.get("stopped"):
        raise typer.Exit(2)


def warm_up(
    config: ConfigName,
    overrides: Overrides = None,
) -> None:
    """Compile beforehand all that runs of a configuration need."""
    with limit_blas_threads():
        slam_of(config, overrides or ()).warm_up()
    say("compiled: no event of such a run waits for it")


def save(result: Run, out: Path) -> None:
    """Write the run folder, then a short verdict with the pictures: its interruption loses nothing of the run."""
    result.save(out, report=False)
    try:
        judge(result)
    except KeyboardInterrupt:
        say(f"warning: no verdict, as it was interrupted: kalmark diagnose {out} makes it", err=True)
    result.finish(out)


def judge(result: Run) -> None:
    """Put a short verdict into the summary of a run, if the plug-in for it is there."""
    try:
        diagnose = load("names", "diagnose")
    except PluginError as error:
        say(f"warning: no verdict: {error}", err=True)
    else:
        diagnose(result, VERDICT_OBSERVATIONS, brief=True, progress=True)


def finish(result: Run, out: Path, title: str) -> None:
    """Print a run's figures and warnings, what was left out, and where the run folder is."""
    from kalmark.results.figure_texts import count

    print_summary(title, result.summary)
    if result.skipped:
        say(f"{count(result.summary['skipped'], 'record')} left out:")
        for line in result.skipped[:SHOWN]:
            say(f"  {line}")
        if len(result.skipped) > SHOWN:
            say("  ...")
    say(f"{out}: map.png, report.html and the rest of the run")


def demo(
    out: Annotated[Path, typer.Option(help="The run folder to write.")] = Path("out/demo"),
    seed: Annotated[int, typer.Option(min=0, help="Seed of the simulation.")] = 1,
) -> None:
    """Simulate Sola's cloister, map it, and write a run folder with the picture."""
    from kalmark.config import build_slam, config_dict
    from kalmark.results.record import record
    from kalmark.simulate import load_world, simulate

    writable(out)
    with limit_blas_threads():
        world = load_world("cloister")
        log, config = simulate(world, seed), world.config().model_copy(update={"seed": seed})
        result = record(build_slam(config, log), log, config=config_dict(config))
        save(result, out)
    finish(result, out, f"Sola's cloister, seed {seed}")
