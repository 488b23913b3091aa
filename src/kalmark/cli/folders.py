"""Commands on run folders: `kalmark evaluate`, `report`, `view`, `compare` and `explain`."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from kalmark.cli.shared import RunFolder, Trust, limit_blas_threads, print_summary, print_table, say, writable
from kalmark.errors import PluginError

if TYPE_CHECKING:
    from kalmark.results.run import Run

PictureOptions = Annotated[
    list[str] | None, typer.Option("--set", metavar="picture.KEY=VALUE", help="Draw with another option of `picture`.")
]


def evaluate(
    run: RunFolder,
    trust: Trust = False,
    truth: Annotated[
        Path | None,
        typer.Option(metavar="LOG", help="Judge by the truth of this log, or by a file of poses: TUM, KITTI."),
    ] = None,
    batch: Annotated[
        bool, typer.Option("--batch", help="Compare with the batch solution, and keep that in the run.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print all figures as JSON.")] = False,
) -> None:
    """Print the figures of a run."""
    from kalmark.files import write
    from kalmark.logs import open_log
    from kalmark.results.run import Run

    with limit_blas_threads():
        loaded = Run.load(run, trust)
        if truth is not None:
            log = open_log(truth)
            robots = loaded.history.robots
            if not log.events and len(robots) == 1:  # a file of poses does not name its robot
                log = replace(log, truth=dict.fromkeys(robots, *log.truth.values()))
            loaded = loaded.with_truth(log)
        summary = loaded.evaluate(batch=batch)
        if batch and truth is None:
            write(run / "summary.json", json.dumps(summary, indent=2, allow_nan=False) + "\n")
    if as_json:
        say(json.dumps(summary, indent=2))
    else:
        print_summary(str(run), summary)


def drawn_by(run: Run, options: Sequence[str] | None) -> Run:
    """Return a run with options of its pictures replaced.  Raises ConfigError."""
    from kalmark.config import Config, build_picture, config_dict
    from kalmark.config.reading import validate
    from kalmark.config.tree import tree_of
    from kalmark.errors import ConfigError

    if not options:
        return run
    tree = tree_of({"picture": run.config.get("picture") or {}}, options)
    if other := sorted(tree.values.keys() - {"picture"}):
        raise ConfigError(f"--set {other[0]} changes no picture of a run, expected picture.KEY=VALUE")
    config = validate(tree, Config)
    build_picture(config, run.history.robots)
    return replace(run, config=run.config | {"picture": config_dict(config)["picture"]})


def report(
    run: RunFolder,
    trust: Trust = False,
    video: Annotated[
        bool, typer.Option("--video", help="Also write video.mp4 (video.gif where ffmpeg is not installed).")
    ] = False,
    fps: Annotated[float, typer.Option(help="Frames a second of the video.")] = 10.0,
    world: Annotated[
        bool,
        typer.Option("--world", help="Draw the ellipses in the world, with the start's uncertainty, not of the shape."),
    ] = False,
    options: PictureOptions = None,
) -> None:
    """Write map.png, report.html and a figure of each camera's last scan again."""
    from kalmark.results.run import Run

    loaded = drawn_by(Run.load(run, trust), options)
    for path in loaded.report(run, world):
        say(str(path))
    if video:
        from kalmark.results.video import write_video

        say(str(write_video(loaded, run / "video.mp4", fps, world=world)))


def view(
    run: RunFolder,
    trust: Trust = False,
    page: Annotated[bool, typer.Option("--page", help="Show its page in a browser, not the viewer.")] = False,
    save: Annotated[
        Path | None, typer.Option(metavar="FILE.rrd", help="Write what the viewer would show to a file of rerun.")
    ] = None,
    open_: Annotated[bool, typer.Option("--open/--no-open", help="Open the page in a browser.")] = True,
    options: PictureOptions = None,
) -> None:
    """Replay a run in rerun, or without it on its page: a slider through time, the map, errors and associations."""
    import webbrowser

    from kalmark.plugins import load
    from kalmark.results.run import Run

    if save is not None or (open_ and not page):
        loaded = drawn_by(Run.load(run, trust), options)
        try:
            load("viewers", "rerun").replay(loaded, save)
        except PluginError as error:
            if save is not None:
                raise
            say(f"{error}; this is the page", err=True)
        else:
            say("rerun shows it" if save is None else str(save))
            return
    file = run / "report.html"
    if options or not file.is_file() or not (run / "summary.json").is_file():
        drawn_by(Run.load(run, trust), options).report(run)
    shown = open_ and webbrowser.open(file.resolve().as_uri())
    say(f"{file}{'' if shown or not open_ else ': no browser was found, open it yourself'}")


def compare(
    runs: Annotated[list[Path], typer.Argument(metavar="RUN...", help="Two folders or more that `kalmark run` wrote.")],
    out: Annotated[Path, typer.Option(metavar="PNG", help="The picture to write.")] = Path("out/compare.png"),
    as_json: Annotated[bool, typer.Option("--json", help="Print all figures as JSON.")] = False,
) -> None:
    """Put runs side by side: their figures, what differs in their configurations, and a picture of their maps."""
    from kalmark.results.compare import compare as compared
    from kalmark.results.compare import draw_comparison
    from kalmark.results.plot import save_figure
    from kalmark.results.run import Run

    writable(out.parent)
    told = compared({str(run): Run.load(run) for run in runs})
    if as_json:
        say(json.dumps(told.figures, indent=2))
    else:
        for title, rows in told.tables():
            print_table(title, ("", *told.names), rows, align="<" + ">" * len(told.names))
    out.parent.mkdir(parents=True, exist_ok=True)
    save_figure(draw_comparison(told), out)
    say(str(out), err=as_json)


def explain(
    run: RunFolder,
    scan: Annotated[
        float, typer.Option(metavar="T", help="The log's time in s, as in associations.csv; else since the first scan.")
    ],
    robot: Annotated[str | None, typer.Option(help="Of this robot. (default: the nearest scan of any)")] = None,
    trust: Trust = False,
) -> None:
    """Print and draw the association of one scan: candidates of each observation, d2, gates, outcome and reason."""
    from kalmark.results.explain import explain as explanation_of
    from kalmark.results.plot import save_figure
    from kalmark.results.plot_scan import draw_scan
    from kalmark.results.recording import file_name
    from kalmark.results.run import Run

    loaded = Run.load(run, trust)
    told = explanation_of(loaded, scan, robot)
    for line in told.lines():
        say(line)
    path = run / f"scan_{file_name(told.robot)}_{told.in_log}.png"
    save_figure(draw_scan(loaded, told), path)
    say(str(path))
