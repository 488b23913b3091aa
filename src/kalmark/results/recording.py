"""`Recording`: what was recorded of one log through one filter, and how that is read from a run folder."""

from __future__ import annotations

import json
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from kalmark.errors import RunError
from kalmark.logs.source import LeftOut, records_of
from kalmark.results.files import read_yaml, replace_file
from kalmark.results.history import History
from kalmark.results.landmarks import MapLandmarks
from kalmark.results.truth import Truth

if TYPE_CHECKING:
    from kalmark.logs.log import Log
    from kalmark.slam.slam import Slam

NEEDED = ("summary.json", "config.yaml", "history.npz", "landmarks.csv")


@dataclass(frozen=True)
class LogReference:
    """Which log a run was made from; a plain list of events has no name."""

    name: str = ""
    format: str = ""
    path: str | None = None
    robots: tuple[str, ...] = ()

    def as_dict(self) -> dict[str, Any]:
        """Return the reference as it stands in ``summary.json``."""
        return vars(self) | {"robots": list(self.robots)}


@dataclass(frozen=True, eq=False)
class Recording:
    """One log through one filter: the history, the final map, the truth to judge them by, the configuration.

    `summary` is what `Run.evaluate` last returned.  `slam`, the filter after the last event, and `source`, the log
    itself, are None in a run that was loaded; `final_slam` reads the filter from ``map.kmk``.  `reference` holds what
    others made of the same log, figures by their name, which the summary repeats.
    """

    history: History
    config: dict[str, Any]
    landmarks: MapLandmarks
    truth: Truth
    log: LogReference = LogReference()
    coordinates: str = "world"
    wall_s: float = 0.0
    skipped: list[str] = field(default_factory=list)
    stopped: str = ""
    slam: Slam | None = None
    source: Log | None = None
    folder: Path | None = None
    summary: dict[str, Any] = field(default_factory=dict)
    reference: dict[str, Any] = field(default_factory=dict)

    @property
    def estimator(self) -> str:
        """The estimator's name in configuration files."""
        value = self.config.get("estimator")
        return str(value.get("type", "")) if isinstance(value, dict) else str(value or "")

    def section(self, robot: str, sensor: str) -> dict[str, Any]:
        """Return the configuration of a robot's sensor, {} if it has none."""
        robots = self.config.get("robots") or {}
        sections = (((robots.get(name) or {}).get("sensors") or {}).get(sensor) for name in (robot, "each"))
        return next(filter(None, sections), {})

    def with_truth(self, log: Log) -> Self:
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

    @classmethod
    def load(cls, folder: str | Path) -> Self:
        """Read a run folder.  Raises RunError naming the file that is missing or cannot be read."""
        folder = Path(folder)
        for name in NEEDED:
            if not (folder / name).is_file():
                raise RunError(f"{folder / name}: no such file, expected the folder of a complete run")
        try:
            summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
            with np.load(folder / "history.npz", allow_pickle=False) as arrays:
                named = {key: arrays[key] for key in arrays.files}
            log = summary["log"]
            return cls(
                history=History.from_arrays(named),
                config=read_yaml(folder / "config.yaml"),
                landmarks=MapLandmarks.read(folder / "landmarks.csv"),
                truth=Truth.from_arrays(named),
                log=LogReference(log["name"], log["format"], log["path"], tuple(log["robots"])),
                coordinates=summary["coordinates"],
                wall_s=summary["wall_s"],
                skipped=[
                    line if n == 1 else LeftOut(line, n)
                    for line, n in zip(named["skipped"].tolist(), named["skipped_records"].tolist(), strict=True)
                ],
                stopped=summary.get("stopped", ""),
                folder=folder,
                summary=summary,
                reference={name: summary[name] for name in named["reference"].tolist()},
            )
        except (KeyError, ValueError, OSError) as error:
            raise RunError(f"{folder}: not a run that this version reads: {error}") from None

    def save_arrays(self, path: Path) -> None:
        """Write ``history.npz``."""
        arrays: dict[str, Any] = {**self.history.arrays(), **self.truth.arrays()}
        arrays["skipped"] = np.array(self.skipped, dtype=np.str_)
        arrays["skipped_records"] = np.array([records_of(line) for line in self.skipped], dtype=np.int64)
        arrays["reference"] = np.array(list(self.reference), dtype=np.str_)
        with path.open("wb") as file:
            np.savez_compressed(file, **arrays)

    def save_map(self, folder: Path) -> None:
        """Write ``map.kmk`` into a folder: the filter, or what the run was loaded with."""
        if self.slam is not None:
            replace_file(folder / "map.kmk", self.slam.save)
        elif self.folder is not None and self.folder.resolve() != folder.resolve():
            source = self.folder / "map.kmk"
            if source.is_file():
                replace_file(folder / "map.kmk", lambda path: path.write_bytes(source.read_bytes()))
