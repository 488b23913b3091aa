"""A run as a video: the map as it grew and what cameras saw, MP4 where ffmpeg is installed, else an animated GIF."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.animation import FFMpegWriter
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from kalmark.errors import RunError
from kalmark.files import replace_file
from kalmark.logs.progress import track
from kalmark.results.camera_log import images_of_cameras
from kalmark.results.evaluate import headline
from kalmark.results.plot import VIEWS, Projection, draw_plan, draw_space
from kalmark.results.plot_scan import draw_image
from kalmark.results.recording import Recording
from kalmark.results.scene import INK, Scene, images, picture_of, steps_of

INCHES, DPI = (12.8, 7.2), 80
MOST_IMAGES = 3  # beside the map


def write_video(
    run: Recording,
    path: str | Path,
    fps: float = 10.0,
    frames: int = 200,
    orbit_deg: float | None = None,
    progress: bool = True,
    world: bool = False,
) -> Path:
    """Write a run as a video of at most so many frames and return its path.

    The suffix of `path` becomes ``.gif`` if it is ``.mp4`` and ffmpeg is not installed.  In space the view turns by
    `orbit_deg` in all, by default once around if the view of the run's pictures is "orbit".  Ellipses are those of the
    shape, or in the `world`.  Raises RunError for a run without scans and for other suffixes.
    """
    path = Path(path)
    if path.suffix not in (".mp4", ".gif"):
        raise RunError(f"{path}: the suffix is {path.suffix!r}, expected .mp4 or .gif")
    if not (math.isfinite(fps) and fps > 0):
        raise RunError(f"fps is {fps}, expected a number above 0")
    if len(run.history.t_ns) == 0:
        raise RunError(f"{path}: no scan was processed, expected a run with something to show")
    if path.suffix == ".mp4" and not FFMpegWriter.isAvailable():
        path = path.with_suffix(".gif")
    count = len(run.history.t_ns)
    steps = np.unique(np.linspace(0, count - 1, max(1, min(frames, count))).round().astype(int)).tolist()
    if orbit_deg is None:
        orbit_deg = 360.0 if picture_of(run).view == "orbit" else 0.0
    drawn = partial(_frames, run, steps, orbit_deg, progress, world)
    replace_file(path, partial(_mp4 if path.suffix == ".mp4" else _gif, drawn(), fps))
    return path


def _mp4(drawn: Iterator[Figure], fps: float, path: Path) -> None:
    writer: Any = FFMpegWriter(fps=fps)  # type: ignore[arg-type]
    first = next(drawn)
    with writer.saving(first, str(path), first.get_dpi()):
        writer.grab_frame()
        for _ in drawn:  # the same figure, drawn again
            writer.grab_frame()


def _gif(drawn: Iterator[Figure], fps: float, path: Path) -> None:
    pictures = (_picture(figure) for figure in drawn)
    first = next(pictures)
    first.save(path, format="GIF", save_all=True, append_images=pictures, duration=max(20, round(1e3 / fps)), loop=0)


def _picture(figure: Figure) -> Image.Image:
    canvas: Any = figure.canvas
    canvas.draw()
    return Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3].copy()).quantize(64)


def _frames(run: Recording, steps: list[int], orbit_deg: float, progress: bool, world: bool) -> Iterator[Figure]:
    """Yield one figure again and again, drawn again after each of the steps."""
    figure = Figure(figsize=INCHES, dpi=DPI, facecolor="white")
    FigureCanvasAgg(figure)
    t_s, title, pictures = run.history.t_s, headline(run)[0], images_of_cameras(run)
    for k, step in enumerate(track(steps, "video", len(steps), show=progress)):
        figure.clear()
        _draw(figure, run, Scene.of(run, step, world), step, orbit_deg * k / max(len(steps) - 1, 1), pictures)
        figure.text(0.02, 0.955, title, fontsize=12, fontweight="bold", color=INK)
        figure.text(0.98, 0.955, f"{t_s[step]:.1f} s", fontsize=12, ha="right", color=INK)
        yield figure


def _draw(figure: Figure, run: Recording, scene: Scene, step: int, turned: float, pictures: Any) -> None:
    if scene.d == 2:
        draw_plan(figure.add_axes((0.07, 0.09, 0.9, 0.84)), scene)
        return
    elevation, azimuth = VIEWS["normal"]
    view = (elevation, azimuth + turned) if scene.picture.view in ("normal", "orbit") else None
    projection = Projection.of(scene, view)
    seen = _last_images(run, step, pictures)
    left = 0.5 if any(picture is not None for *_, picture in seen) else 0.6  # the images are larger than their marks
    draw_space(figure.add_axes((0.0, 0.02, left, 0.92)), scene, projection)
    if not seen:
        draw_plan(figure.add_axes((0.65, 0.12, 0.33, 0.76)), scene)
    height = 0.9 / max(len(seen), 1)
    for k, (title, image, size, picture) in enumerate(seen):
        axes = figure.add_axes((left + 0.04, 0.94 - (k + 1) * height + 0.06, 0.95 - left, height - 0.1))
        draw_image(axes, image, size, scene.picture, picture)
        axes.set_title(title, fontsize=9, color="#555b66")


def _last_images(run: Recording, step: int, pictures: Any) -> list[tuple[str, Any, tuple[float, float], Any]]:
    """Return titles, what each camera saw last up to a step, the size of its image, and the image if there is one."""
    out: list[tuple[str, Any, tuple[float, float], Any]] = []
    for camera in run.history.cameras:
        steps = steps_of(run.history, camera)
        if not (steps <= step).any():
            continue
        at = int(steps[steps <= step][-1])
        for image in images(run.history, camera, at):
            picture = pictures and pictures.at(camera, at, image.side)
            out.append((f"{camera.robot} · {camera.sensor} {image.side}", image, camera.size, picture))
    return out[:MOST_IMAGES]
