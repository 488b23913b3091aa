"""`kalmark diagnose`: whether the map of a run can be trusted, to what accuracy, and if not, why."""

from __future__ import annotations

import json
from typing import Annotated

import typer

from kalmark.cli.shared import RunFolder, Trust, limit_blas_threads, print_table, say


def diagnose(
    run: RunFolder,
    trust: Trust = False,
    observations: Annotated[
        int, typer.Option(min=100, help="About how many observations to take; more is slower.")
    ] = 20_000,
    as_json: Annotated[bool, typer.Option("--json", help="Print the verdict as JSON.")] = False,
    apply: Annotated[
        bool, typer.Option("--apply", help="Run the log again with the cure of the first cause; compare both runs.")
    ] = False,
) -> None:
    """Judge without truth whether the map of a run is right; if not, name causes and cures."""
    from kalmark.diagnosis.breakdown import breakdown, nees_parts
    from kalmark.diagnosis.cured_run import apply_cure
    from kalmark.diagnosis.picture import draw_diagnosis
    from kalmark.diagnosis.verdict import diagnose as diagnosed
    from kalmark.results.compare import compare, draw_comparison
    from kalmark.results.plot import save_figure
    from kalmark.results.run import Run
    from kalmark.results.verdict_text import verdict_lines

    with limit_blas_threads():
        loaded = Run.load(run, trust)
        verdict = diagnosed(loaded, observations, progress=True)
        loaded.finish(run)
        picture = run / "diagnosis.png"
        save_figure(draw_diagnosis(loaded, verdict), picture)
        cured = apply_cure(loaded, run, verdict, observations) if apply else None
        if cured is not None:
            both = compare({str(run): loaded, str(cured.folder): cured.run})
            save_figure(draw_comparison(both), cured.folder / "cured.png")
    if as_json:
        told = verdict.as_dict() if cured is None else verdict.as_dict() | {"cured": cured.as_dict()}
        say(json.dumps(told, indent=2))
        return
    for line in verdict_lines(verdict.as_dict(), shown=None):
        say(line)
    say(f"(by the {verdict.checked})")
    rows = [row.cells() for row in breakdown(loaded)]
    print_table("innovations", ("of", "", "observations", "NIS per dof", "mean (sigma)", ""), rows, align="<<>>><")
    parts = list(nees_parts(loaded))
    if parts:
        columns = ("robot", "part", "NEES per dof", "outside its band from t (s)")
        print_table("against the truth", columns, parts, align="<<>>")
    say(str(picture))
    if cured is not None:
        for line in cured.lines():
            say(line)
        for title, table in both.tables():
            print_table(title, ("", *both.names), table, align="<>>")
        say(str(cured.folder / "cured.png"))
    elif apply:
        say("no cause has a cure that options of kalmark run can express")
