"""`kalmark report`: the pictures and the page of a run, made again."""

from __future__ import annotations

from typing import Annotated

import typer

from kalmark.cli.options import RunFolder


def report(
    run: RunFolder,
    video: Annotated[
        bool, typer.Option("--video", help="Also write video.mp4 (video.gif where ffmpeg is not installed).")
    ] = False,
    fps: Annotated[float, typer.Option(help="Frames a second of the video.")] = 10.0,
) -> None:
    """Write map.png, report.html and a figure of each camera's last scan again."""
    from kalmark.results.run import Run

    loaded = Run.load(run)
    for path in loaded.report(run):
        typer.echo(str(path))
    if video:
        from kalmark.results.video import write_video

        typer.echo(str(write_video(loaded, run / "video.mp4", fps)))
