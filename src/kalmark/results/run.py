"""A run: what was recorded and under which configuration.  Evaluated, saved as a folder, and read back."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

from kalmark.files import replace_folder, write
from kalmark.results.evaluate import evaluate
from kalmark.results.figure_texts import Figures
from kalmark.results.recording import Recording, file_name
from kalmark.results.scene import picture_of, steps_of

__all__ = ["Run"]

FILES = (
    *("summary.json", "config.yaml", "landmarks.csv", "associations.csv", "changes.csv", "history.npz", "map.kmk"),
    *("report.html", "trajectory_*.tum"),
    *(f"{name}.{ending}" for name in ("map", "sensor_*") for ending in ("png", "svg", "pdf")),
)
"""Patterns of the files of a run folder."""


@dataclass(frozen=True, eq=False, repr=False)
class Run(Recording):
    """A recording with what is made of it: its figures, its pictures and its folder.

    >>> rover = km.Robot("rover", km.motion.Unicycle())
    >>> drive = [km.Control(t_s=0.1 * k, robot="rover", u=(0.5, 0.02)) for k in range(4)]
    >>> run = km.record(km.Slam(rover), drive, progress=False)
    >>> run.history.mean.shape
    (4, 3)
    >>> saved = run.save("out/drive")
    >>> km.Run.load("out/drive")
    <Run '' of 'rover': 4 steps, 0 observations, 0 landmarks>
    """

    def evaluate(self, batch: bool = False) -> Figures:
        """Return the figures of ``summary.json``; with `batch` also the comparison with the batch solution."""
        summary = evaluate(self)
        if batch:
            from kalmark.results.batch import batch_entry  # heavy, and seldom needed

            summary["batch"] = batch_entry(self, self.source)
        for key in ("batch", "verdict"):
            if key in self.summary and key not in summary:
                summary[key] = self.summary[key]
        self.summary.clear()
        self.summary.update(summary)
        return summary

    def save(self, folder: str | Path, *, report: bool = True) -> Path:
        """Write the run folder of the contract; files of an earlier run in it are replaced, all others stay.

        The folder has all files of the earlier run or all of this one, whatever happens meanwhile: `replace_folder`.
        Without `report` it has no pictures and no page yet: `finish` writes them.
        """
        folder = Path(folder)

        def fill(made: Path) -> None:
            self.save_files(made)
            self.finish(made, report=report)

        replace_folder(folder, fill, FILES, "summary.json")
        return folder

    def finish(self, folder: Path, *, report: bool = True) -> None:
        """Write the figures and, with `report`, the pictures and the page into a run folder: all that has a verdict."""
        summary = self.summary or self.evaluate()
        if report:
            self.report(folder)
        write(folder / "summary.json", json.dumps(summary, indent=2, allow_nan=False) + "\n")

    def report(self, folder: str | Path, world: bool = False) -> list[Path]:
        """Write ``map.png``, ``report.html`` and each sensor's last scan into a folder; return their paths.

        Maps have the ellipses of the shape or those in the `world`.  The section `picture` of the configuration may
        name another format, in which the pictures are written, too.
        """
        from kalmark.results.plot import save_figure, save_map  # matplotlib is slow to import
        from kalmark.results.plot_measured import sensors_with_picture
        from kalmark.results.plot_scan import draw_sensor
        from kalmark.results.run_page import report_html

        folder, picture = Path(folder), picture_of(self)
        endings = dict.fromkeys(("png", picture.format))
        written = [*(folder / f"map.{ending}" for ending in endings), folder / "report.html"]
        for path in written[:-1]:
            save_map(self, path, world)
        for seen in sensors_with_picture(self.history):
            if not len(steps_of(self.history, seen)):
                continue
            figure = draw_sensor(self, seen.robot, seen.sensor)
            name = "_".join(map(file_name, (seen.robot, seen.sensor)))
            dpi = 110 if picture.sensor_width_px is None else picture.sensor_width_px / figure.get_figwidth()
            for ending in endings:
                written.append(folder / f"sensor_{name}.{ending}")
                save_figure(figure, written[-1], dpi, rim=False)
        write(folder / "report.html", report_html(self, world))
        return written
