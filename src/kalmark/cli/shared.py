"""Arguments and options of several commands, and tables of figures on standard output."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from kalmark.errors import KalmarkError, printable
from kalmark.results.figure_texts import (
    BATCH,
    DIFFERENCE_COLUMNS,
    DIFFERENCE_TITLE,
    ROBOT,
    TOTALS,
    Summary,
    column_header,
    difference_rows,
    figure,
    rows_with_labels,
)

if TYPE_CHECKING:
    from kalmark.slam.slam import Slam

ConfigName = Annotated[str, typer.Argument(metavar="CONFIG", help="A YAML file or a shipped name.")]
OtherLog = Annotated[Path | None, typer.Option(help="The log to use instead of the configuration's.")]
Overrides = Annotated[
    list[str] | None, typer.Option("--set", metavar="KEY.PATH=VALUE", help="Override one key; may be given again.")
]
Trust = Annotated[bool, typer.Option("--trust", help="Run the plug-ins that the config.yaml of RUN names.")]
RunFolder = Annotated[Path, typer.Argument(metavar="RUN", help="The folder that `kalmark run` wrote.")]
NO_NAMES = ("", "", "")  # of columns
_SHOWN_IF_ANY = {"new", "ignored", "deferred", "tentative", "rejected", "fixes", "fixes_rejected"}


@contextmanager
def limit_blas_threads() -> Iterator[None]:
    """Keep BLAS to one thread.

    The matrices of a scan are small: with more threads, they only wait for each other.
    """
    from threadpoolctl import threadpool_limits

    import kalmark.filter.kernels  # noqa: F401 - loads the BLAS, so that the limit takes hold of it

    with threadpool_limits(1):
        yield


def slam_of(config: str, overrides: Sequence[str]) -> Slam:
    """Return the filter of a configuration, with the robots and sensors of the log that it names, if it names one."""
    from kalmark import config as cfg

    made = cfg.load_config(config, overrides)
    return cfg.build_slam(made) if made.log.path is None else cfg.build_slam(*cfg.open_run(config, None, overrides))


def announce_compilation_elsewhere() -> None:
    """Print on stderr that other processes will compile the inner loops, if the cache of compiled code is empty."""
    from kalmark.compiled import SOURCES, cache_folder, say_compiling

    if not all(Path(cache_folder(part)).exists() for part in SOURCES):
        say_compiling()


def writable(folder: Path) -> Path:
    """Return a folder that can be made or written to, without making it: found out before the work, not after."""
    import os

    existing = folder
    while not existing.exists() and existing != existing.parent:
        existing = existing.parent
    if not existing.is_dir():
        raise KalmarkError(f"--out {folder}: {existing} is a file, expected a folder")
    if not os.access(existing, os.W_OK | os.X_OK):
        raise KalmarkError(f"--out {folder}: {existing} cannot be written to")
    return folder


def say(text: str, err: bool = False) -> None:
    """Print lines: all text for a terminal goes through here or `print_table`, so that no name in it is obeyed."""
    typer.echo("\n".join(map(printable, text.split("\n"))), err=err)


def print_summary(title: str, summary: Summary) -> None:
    """Print the key figures of a run's summary, its warnings and advice; other programs on the same log in brackets."""
    from kalmark.results.self_calibration import ESTIMATE_COLUMNS, MOUNT_COLUMNS, estimate_rows, mount_rows
    from kalmark.results.verdict_text import verdict_lines

    totals = [
        (label, cell_text(summary[key], unit), unit)
        for key, label, unit in TOTALS
        if summary.get(key) is not None and (summary[key] or key not in _SHOWN_IF_ANY)
    ]
    print_table(title, NO_NAMES, totals, align="<><")
    _print_robots(summary)
    figures = {key: value for key, value in summary.get("batch", {}).items() if key != "pose_differences"}
    compared = [(label, cell_text(value), unit) for _, label, value, unit in rows_with_labels(figures, BATCH)]
    for name, columns, rows, align in (
        ("mounts that calibrate themselves", MOUNT_COLUMNS, mount_rows(summary), "<<>>>"),
        ("calibrations, estimated", ESTIMATE_COLUMNS, estimate_rows(summary), "<<>>"),
        ("against the batch solution", NO_NAMES, compared, "<><"),
        (DIFFERENCE_TITLE.lower(), DIFFERENCE_COLUMNS, difference_rows(summary), "<>>>"),
    ):
        if rows:
            print_table(name, columns, rows, align=align)
    for kind, key in (("warning", "warnings"), ("note", "notes"), ("advice", "advice")):
        for line in summary.get(key, ()):
            say(f"{kind}: {line}")
    verdict = summary.get("verdict")
    for n, line in enumerate(verdict_lines(verdict) if verdict else ()):
        say(f"{'  ' if n else 'verdict: '}{line}")


def _print_robots(summary: Summary) -> None:
    """Print a row of figures for each robot, and for each other program on the same log."""
    robots: Summary = summary.get("robots", {})
    shown = [row for row in ROBOT if any(figures.get(row[0]) is not None for figures in robots.values())]
    if shown:
        columns = ("robot", *(column_header(label, unit) for _, label, unit in shown))
        others = ((f"({k})", v) for k, v in summary.items() if isinstance(v, Mapping) and "ate_raw_m" in v)
        table = [
            (name, *(cell_text(f.get(key), unit) for key, _, unit in shown)) for name, f in (*robots.items(), *others)
        ]
        print_table("", columns, table, align="<" + ">" * len(shown))
        if any(key == "pose_nees" for key, _, _ in shown):
            most = [figure(f["pose_nees_most"], 2) for f in robots.values() if f.get("pose_nees_most") is not None]
            this = f", up to {', '.join(most)} in this one" if most else ""
            say(f"consistent pose NEES: {summary.get('pose_dof', 3)} averaged over many runs{this}\n")


def print_table(title: str, columns: Sequence[str], rows: Iterable[Sequence[str]], *, align: str) -> None:
    """Print rows of text; `align` has one of < and > for each column.  A header appears if any column has a name.

    A narrow terminal folds all columns but the first, which holds names.
    """
    from rich import box
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table(box=box.SIMPLE, show_header=any(columns))
    for n, (column, side) in enumerate(zip(columns, align, strict=True)):
        table.add_column(
            Text(printable(column)), justify="right" if side == ">" else "left", overflow="fold", no_wrap=n == 0
        )
    for row in rows:
        table.add_row(*(Text(printable(cell)) for cell in row))
    console = Console()
    if not console.is_terminal:
        console.width = 140  # into a file or a pipe: whole lines
    if title:
        console.print(Text(printable(title), style="bold"))
    console.print(table)


def cell_text(value: Any, unit: str = "") -> str:
    """Return a figure as a table shows it."""
    if value is None:
        return "-"
    if isinstance(value, bool | str) or (isinstance(value, int) and unit != "%"):
        return str(value)
    if unit == "%":
        return f"{100 * value:.1f}"
    return f"{value:.3f}" if abs(value) < 100 else f"{value:.0f}"
