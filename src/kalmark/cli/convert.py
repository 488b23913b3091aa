"""`kalmark convert`: a log or a run in another format."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from kalmark.cli.shared import Trust, say, writable
from kalmark.errors import KalmarkError
from kalmark.plugins import entry_points_of, load

if TYPE_CHECKING:
    from kalmark.logs.log import Log
    from kalmark.results.run import Run

POSES = (".tum", ".kitti")


def convert(
    source: Annotated[
        Path, typer.Argument(metavar="IN", help="A log that kalmark reads, a configuration that names one, or a run.")
    ],
    out: Annotated[
        Path,
        typer.Argument(
            metavar="OUT",
            help="The folder of the native log to write; or a file: .mcap; of a run .g2o; .tum or .kitti of a path.",
        ),
    ],
    log_format: Annotated[str | None, typer.Option("--format", help="Format of IN, if not recognised.")] = None,
    robot: Annotated[str | None, typer.Option(help="Of this robot's path: .tum, .kitti.")] = None,
    trust: Trust = False,
    parquet: Annotated[bool, typer.Option("--parquet", help="Write a folder of Parquet files instead of CSV.")] = False,
) -> None:
    """Write a log as a native one, a folder of CSV files; with its results as MCAP or g2o; a path as TUM or KITTI."""
    from kalmark.logs import write_native

    writes = out.suffix[1:] in entry_points_of("writers")
    if writes or out.suffix in POSES:
        if out.exists():
            raise KalmarkError(f"{out}: this file exists already, expected a new one")
        writable(out.parent)
    else:
        writable(out)
    log, run = _read(source, log_format, trust)
    if out.suffix in POSES:
        _write_path(out, log, run, robot)
        return
    if writes:
        counts = load("writers", out.suffix[1:])(out, log, run)
        say(f"{out}: {sum(counts.values())} records of {', '.join(sorted(counts))}")
    elif log is not None:
        write_native(log, out, parquet=parquet)
    if log is not None:
        say(f"{out}: {len(log)} events of {', '.join(log.robots)}, read as {log.format}")


def _write_path(out: Path, log: Log | None, run: Run | None, robot: str | None) -> None:
    """Write the path of a robot: of a run the estimated one, of a log the true one.  Raises KalmarkError."""
    import numpy as np

    from kalmark.logs.log import Trajectory
    from kalmark.logs.poses import write_path

    paths: dict[str, Trajectory] = {} if log is None or run is not None else dict(log.truth)
    if run is not None:
        history = run.history
        for name in history.robots:
            t_ns, first = np.unique(history.t_ns[history.robot == name], return_index=True)
            if len(t_ns):
                paths[name] = Trajectory(t_ns, history.poses[history.robot == name][first])
    names = [robot] if robot is not None else [*paths]
    if len(names) != 1 or names[0] not in paths:
        there = ", ".join(paths) or "none: only a run has an estimated path, and this log has no truth"
        raise KalmarkError(f"{out}: paths of {there}; expected one, or --robot with one of them")
    files = write_path(out, paths[names[0]].t_ns, paths[names[0]].poses)
    say(f"{', '.join(map(str, files))}: {len(paths[names[0]])} poses of {names[0]}")


def _read(source: Path, log_format: str | None, trust: bool) -> tuple[Log | None, Run | None]:
    """Return the log with its increments as recorded, and the run if `source` is the folder of one."""
    from kalmark.logs import open_log

    overrides = ("log.increments=recorded",)
    if (source / "summary.json").is_file() and (source / "config.yaml").is_file():
        from kalmark.config import open_run
        from kalmark.results.run import Run

        run = Run.load(source, trust)
        run.run_plugins()
        return open_run(source / "config.yaml", overrides=overrides)[1], run
    if source.suffix in (".yaml", ".yml"):
        from kalmark.config import open_run

        return open_run(source, overrides=overrides, progress=True)[1], None
    return open_log(source, log_format, progress=True), None
