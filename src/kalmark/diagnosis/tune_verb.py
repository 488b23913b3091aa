"""`kalmark tune`: noise and calibration by the first part of a log, judged by the rest; a new configuration."""

from __future__ import annotations

from collections.abc import Sequence
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from kalmark.cli.shared import (
    ConfigName,
    OtherLog,
    Overrides,
    cell_text,
    limit_blas_threads,
    print_table,
    say,
    writable,
)
from kalmark.errors import KalmarkError

if TYPE_CHECKING:
    from kalmark.diagnosis.tune import Tuning


class Aim(StrEnum):
    """Purpose of the tuned noise, where errors are correlated."""

    INNOVATIONS = "innovations"
    MAP = "map"


def tune(
    config: ConfigName,
    log: OtherLog = None,
    out: Annotated[Path | None, typer.Option(help="The file to write. (default: out/CONFIG_tuned.yaml)")] = None,
    share: Annotated[float, typer.Option(help="Part of the log to tune by; the rest judges.")] = 0.5,
    aim: Annotated[
        Aim,
        typer.Option(
            help="Figure to fit where errors are correlated: the innovations or the map get their stated covariance."
        ),
    ] = Aim.INNOVATIONS,
    keep: Annotated[
        list[str] | None, typer.Option(metavar="KEY.PATH", help="Do not touch; may be given again.")
    ] = None,
    page: Annotated[
        Path | None, typer.Option(help="Instead, write a page on which two sliders choose the noise, as an HTML file.")
    ] = None,
    seconds: Annotated[
        float | None, typer.Option(help="Of the log, for the page. (default: its first 400 scans)")
    ] = None,
    overrides: Overrides = None,
) -> None:
    """Estimate noise and calibration by the first part of a log, and write a configuration that has them."""
    if page is not None:
        write_page(page, config, log, overrides or (), seconds)
        return
    from kalmark.diagnosis.tune import tune as tuned
    from kalmark.diagnosis.tune_picture import draw_tuning
    from kalmark.diagnosis.tuned_file import new_config
    from kalmark.files import write
    from kalmark.results.plot import save_figure

    out = out or Path("out") / f"{Path(config).stem}_tuned.yaml"
    if out.suffix not in (".yaml", ".yml"):
        raise KalmarkError(f"--out {out}: expected a path that ends with .yaml")
    writable(out.parent)
    with limit_blas_threads():
        tuning = tuned(config, log, overrides or (), share=share, aim=aim.value, keep=keep or (), progress=True)
    text, picture = new_config(config, tuning, overrides or (), log), out.with_suffix(".png")
    out.parent.mkdir(parents=True, exist_ok=True)
    write(out, text)
    save_figure(draw_tuning(tuning, Path(config).stem), picture)
    print_tuning(tuning)
    say(f"{out}: the new configuration; {picture}: the NIS before and after")


def write_page(
    page: Path, config: str, log: Path | None, overrides: Sequence[str], seconds: float | None
) -> None:  # fmt: skip
    """Write the page of sliders of a configuration and the beginning of its log."""
    from kalmark.config import open_run
    from kalmark.diagnosis.sliders import sliders
    from kalmark.diagnosis.tune import written_robots

    if page.suffix != ".html":
        raise KalmarkError(f"--page {page}: expected a path that ends with .html")
    writable(page.parent)
    with limit_blas_threads():
        made, opened = open_run(config, log, overrides)
        written = written_robots(config, overrides)
        found = sliders(made, opened, seconds=seconds, written=written, progress=True)
    page.parent.mkdir(parents=True, exist_ok=True)
    found.save(page)
    say(f"{page}: open it in a browser; it needs no network")


def print_tuning(tuning: Tuning) -> None:
    """Print what became of each key, and how both parts of the log fit before and after."""
    from kalmark.diagnosis.tuned_file import cells, correlation_lines

    columns = ("key", "before", "after", "known to", "second part", "")
    print_table("", columns, [cells(change) for change in tuning.changes], align="<>>>><")
    rows = []
    for label, k in (("the part it was tuned by", 0), ("the part that judges", 1)):
        one, two = tuning.before[k], tuning.after[k]
        shares = (cell_text(x.left_out, "%") for x in (one, two))
        gain = f"{two.likelihood - one.likelihood:+.0f}"
        rows.append((label, cell_text(one.nis), cell_text(two.nis), gain, *shares))
    head = ("", "NIS per dof before", "after", "log-likelihood", "left out (%) before", "after")
    print_table("", head, rows, align="<>>>>>")
    for line in correlation_lines(tuning):
        say(line)
