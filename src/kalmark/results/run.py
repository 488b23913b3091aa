"""A run: what was recorded and under which configuration.  Evaluated, saved as a folder, and read back."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from kalmark.errors import RunError
from kalmark.logs.source import LeftOut, records_of
from kalmark.results.evaluate import evaluate
from kalmark.results.files import associations_csv, changes_csv, config_yaml, read_yaml, tum
from kalmark.results.history import History
from kalmark.results.images import cameras_that_saw
from kalmark.results.landmarks import MapLandmarks
from kalmark.results.truth import Truth

if TYPE_CHECKING:
    from kalmark.slam.slam import Slam

FORMAT = 1


@dataclass(frozen=True)
class LogReference:
    """Which log a run was made from."""

    name: str = ""
    format: str = ""
    path: str | None = None
    robots: tuple[str, ...] = ()

    @classmethod
    def of(cls, log: Any, robots: tuple[str, ...] = ()) -> LogReference:
        """Return the reference to a log; a plain list of events has no name."""
        path = getattr(log, "path", None)
        return cls(
            getattr(log, "name", ""),
            getattr(log, "format", ""),
            None if path is None else str(path),
            tuple(getattr(log, "robots", robots)),
        )

    def as_dict(self) -> dict[str, Any]:
        """Return the reference as it stands in ``summary.json``."""
        return {"name": self.name, "format": self.format, "path": self.path, "robots": list(self.robots)}


@dataclass(frozen=True, eq=False)
class Run:
    """One log through one filter: the history, the final map, the truth to judge them by, the configuration.

    `summary` is what `evaluate` last returned.  `slam`, the filter after the last event, and `source`, the log itself,
    are None in a run that was loaded; `final_slam` reads the filter from ``map.kmk``.  `reference` holds what others
    made of the same log, figures by their name, which the summary repeats.
    """

    history: History
    config: dict[str, Any]
    landmarks: MapLandmarks
    truth: Truth
    log: LogReference = LogReference()
    coordinates: str = "world"
    controls: int = 0
    fixes: int = 0
    fixes_rejected: int = 0
    wall_s: float = 0.0
    skipped: list[str] = field(default_factory=list)
    stopped: str = ""
    slam: Slam | None = None
    source: Any = None
    folder: Path | None = None
    summary: dict[str, Any] = field(default_factory=dict)
    reference: dict[str, Any] = field(default_factory=dict)

    @property
    def estimator(self) -> str:
        """The estimator's name in configuration files."""
        value = self.config.get("estimator")
        return str(value.get("type", "")) if isinstance(value, dict) else str(value or "")

    def evaluate(self, batch: bool = False) -> dict[str, Any]:
        """Return the figures of ``summary.json``; with `batch` also the comparison with the batch solution."""
        summary = evaluate(self)
        if batch:
            from kalmark.results.batch import compare  # heavy, and seldom wanted

            summary["batch"] = compare(self, self.source)
        elif "batch" in self.summary:
            summary["batch"] = self.summary["batch"]
        self.summary.clear()
        self.summary.update(summary)
        return summary

    def with_truth(self, log: Any) -> Run:
        """Return the run judged by another log's truth."""
        return replace(self, truth=Truth.of(log, self.history, self.truth.anchored), summary={})

    def final_slam(self) -> Slam:
        """Return the filter after the last event, read from ``map.kmk`` if the run was loaded."""
        if self.slam is not None:
            return self.slam
        if self.folder is None or not (self.folder / "map.kmk").is_file():
            raise RunError(f"{self.folder or 'run'}: no map.kmk, expected the saved map of the run")
        from kalmark.slam.slam import Slam

        return Slam.load(self.folder / "map.kmk")

    def save(self, folder: str | Path) -> Path:
        """Write the run folder of the contract; files of an earlier run in it are replaced, all others stay.

        ``summary.json`` goes first and comes last: a folder that has one is complete.
        """
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "summary.json").unlink(missing_ok=True)
        summary = self.summary or self.evaluate()
        for robot in self.history.robots:
            write(folder / f"trajectory_{file_name(robot)}.tum", tum(self.history, robot))
        write(folder / "config.yaml", config_yaml(self.config))
        write(folder / "landmarks.csv", self.landmarks.to_csv())
        write(folder / "associations.csv", associations_csv(self.history))
        (folder / "changes.csv").unlink(missing_ok=True)
        if self.history.decisions.changes:
            write(folder / "changes.csv", changes_csv(self.history))
        replace_file(folder / "history.npz", self._write_arrays)
        self._save_map(folder)
        self.report(folder)
        write(folder / "summary.json", json.dumps(summary, indent=2, allow_nan=False) + "\n")
        return folder

    def report(self, folder: str | Path) -> list[Path]:
        """Write ``map.png``, ``report.html`` and each camera's last scan into a folder; return their paths."""
        from kalmark.results.plot import save_map, save_sensor  # matplotlib is slow to import
        from kalmark.results.report import report_html

        folder = Path(folder)
        replace_file(folder / "map.png", lambda path: save_map(self, path))
        written = [folder / "map.png", folder / "report.html"]
        for robot, sensor in cameras_that_saw(self.history):
            written.append(folder / f"sensor_{file_name(robot)}_{file_name(sensor)}.png")
            replace_file(written[-1], partial(save_sensor, self, robot, sensor))
        write(folder / "report.html", report_html(self))
        return written

    @classmethod
    def load(cls, folder: str | Path) -> Run:
        """Read a run folder.  Raises RunError naming the file that is missing or cannot be read."""
        folder = Path(folder)
        for name in ("summary.json", "config.yaml", "history.npz", "landmarks.csv"):
            if not (folder / name).is_file():
                raise RunError(f"{folder / name}: no such file, expected the folder of a complete run")
        try:
            summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
            with np.load(folder / "history.npz", allow_pickle=False) as arrays:
                named = {key: arrays[key] for key in arrays.files}
            history, truth = History.from_arrays(named), Truth.from_arrays(named)
            log = summary["log"]
            return cls(
                history=history,
                config=read_yaml(folder / "config.yaml"),
                landmarks=MapLandmarks.read(folder / "landmarks.csv"),
                truth=truth,
                log=LogReference(log["name"], log["format"], log["path"], tuple(log["robots"])),
                coordinates=summary["coordinates"],
                controls=summary["controls"],
                fixes=summary["fixes"],
                fixes_rejected=summary["fixes_rejected"],
                wall_s=summary["wall_s"],
                skipped=_skipped(named),
                stopped=summary.get("stopped", ""),
                folder=folder,
                summary=summary,
                reference={name: summary[name] for name in named.get("reference", np.empty(0)).tolist()},
            )
        except (KeyError, ValueError, OSError) as error:
            raise RunError(f"{folder}: not a run that this version reads: {error}") from None

    def _write_arrays(self, path: Path) -> None:
        skipped = np.array(self.skipped, dtype=np.str_)
        with path.open("wb") as file:
            arrays: dict[str, Any] = {**self.history.arrays(), **self.truth.arrays(), "skipped": skipped}
            arrays["skipped_records"] = np.array([records_of(line) for line in self.skipped], dtype=np.int64)
            arrays["reference"] = np.array(list(self.reference), dtype=np.str_)
            np.savez_compressed(file, **arrays)

    def _save_map(self, folder: Path) -> None:
        if self.slam is not None:
            replace_file(folder / "map.kmk", self.slam.save)
        elif self.folder is not None and self.folder.resolve() != folder.resolve():
            source = self.folder / "map.kmk"
            if source.is_file():
                replace_file(folder / "map.kmk", lambda path: path.write_bytes(source.read_bytes()))


def _skipped(named: dict[str, Any]) -> list[str]:
    lines = named["skipped"].tolist()
    records = named["skipped_records"].tolist() if "skipped_records" in named else [1] * len(lines)
    return [line if n == 1 else LeftOut(line, n) for line, n in zip(lines, records, strict=True)]


def load_run(folder: str | Path) -> Run:
    """Read a run folder.  Raises RunError naming the file that is missing or cannot be read."""
    return Run.load(folder)


def file_name(robot: str) -> str:
    """Return a robot's name as part of a file's name."""
    return "".join(c if c.isalnum() or c in "-_." else "_" for c in robot)


def write(path: Path, text: str) -> None:
    """Write a text file so that it is there completely or not at all."""
    replace_file(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))


def replace_file(path: Path, writer: Callable[[Path], Any]) -> None:
    """Let `writer` write a temporary file beside `path`, then put it in its place."""
    temporary = path.with_name(f".{path.stem}.{os.getpid()}{path.suffix}")
    try:
        writer(temporary)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
