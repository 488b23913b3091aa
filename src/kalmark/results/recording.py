"""`Recording`: what was recorded of one log through one filter, how it is read from a run folder, and its plain files.

Those are TUM trajectories, ``associations.csv``, ``changes.csv`` and ``config.yaml``.
"""

from __future__ import annotations

import hashlib
import io
import json
import math
import shutil
import zipfile
import zlib
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from ruamel.yaml import YAML

from kalmark.declare import load_plugin
from kalmark.errors import LogError, RunError
from kalmark.events import fixed_seconds, list_names, short_text
from kalmark.files import csv_text, hold_lock, read_arrays, replace_file, write
from kalmark.logs.poses import tum_text
from kalmark.logs.source import LeftOut, read_mapping, records_of
from kalmark.results.figure_texts import Figures
from kalmark.results.history import History, ints
from kalmark.results.landmark_table import MapLandmarks
from kalmark.results.truth import Truth
from kalmark.slam.description import plain_value

if TYPE_CHECKING:
    from kalmark.logs.log import Log, Names, Section
    from kalmark.slam.slam import Slam

ASSOCIATIONS = ("t_s", "robot", "sensor", "index", "id", "outcome", "landmark", "d2", "reason")
CHANGES = ("t_s", "robot", "landmark", "change", "into", "reason")
FAST, PAYS = 1, 0.75  # the level of compression of ``history.npz``, and what it must leave at most to be used
LONGEST_NAME = 100  # bytes of a robot or a sensor in the name of a file, which has 255 at most
NEEDED = ("summary.json", "config.yaml", "history.npz", "landmarks.csv")


def tum(history: History, robot: str) -> str:
    """Return a robot's path after each of its steps as TUM lines: t x y z qx qy qz qw."""
    mine = history.robot == robot
    return tum_text(history.t_ns[mine], history.poses[mine])


def associations_csv(history: History) -> str:
    """Return one row an observation: when, who, with what, and what became of it.

    Of an observation that was averaged over landmarks, one row each with its weight, which is then a column more.
    """
    steps, landmarks = history.step.tolist(), history.landmark.tolist()
    times, robots = [fixed_seconds(t_ns) for t_ns in history.t_ns.tolist()], history.robot.tolist()
    seen = (column.tolist() for column in (history.sensor, history.index, history.id, history.outcome))
    d2 = ["" if math.isnan(value) else value for value in history.d2.tolist()]  # the writer writes floats by repr
    columns: list[Sequence[Any]] = [[times[s] for s in steps], [robots[s] for s in steps], *seen, landmarks, d2]
    columns.append(history.reason.tolist())
    if not len(history.share_row):
        return csv_text(ASSOCIATIONS, zip(*columns, strict=True))
    shares = defaultdict(list)
    soft = (history.share_row, history.share_landmark, history.share_weight)
    for row, *share in zip(*(column.tolist() for column in soft), strict=True):
        shares[row].append(share)
    rows = []
    for k, (*head, landmark, number, reason) in enumerate(zip(*columns, strict=True)):
        for name, weight in shares.get(k, [(landmark, 1.0)]):
            rows.append([*head, name, number if name == landmark else "", reason, weight])
    return csv_text((*ASSOCIATIONS, "weight"), rows)


def changes_csv(history: History) -> str:
    """Return one row for each landmark that was removed or merged with another: after which scan, and why."""
    return csv_text(
        CHANGES, ([fixed_seconds(history.t_ns[c.step]), history.robot[c.step], *c[1:]] for c in history.changes)
    )


def _savez(path: Path, arrays: Mapping[str, Any]) -> None:
    """Write arrays as `numpy.savez_compressed` does, but leave those as they are that compression hardly makes smaller.

    Measured and estimated numbers are such: to compress them takes most of the time and gains a tenth.
    """
    with zipfile.ZipFile(path, "w") as file:
        for name, array in arrays.items():
            out, sample = io.BytesIO(), array.ravel()[:2000].tobytes()
            np.lib.format.write_array(out, array, allow_pickle=False)
            pays = len(zlib.compress(sample, FAST)) < PAYS * len(sample)
            how = zipfile.ZIP_DEFLATED if pays else zipfile.ZIP_STORED
            file.writestr(zipfile.ZipInfo(f"{name}.npy"), out.getbuffer(), how, FAST)  # without the clock


def config_yaml(config: Section) -> str:
    """Return the text of ``config.yaml``: everything that was in force, headed by version and seed."""
    out = io.StringIO()
    head = {"version": version("kalmark"), "seed": config.get("seed")}
    yaml = YAML()
    yaml.default_flow_style = False
    yaml.representer.add_representer(type(None), lambda to, _: to.represent_scalar("tag:yaml.org,2002:null", "null"))
    yaml.dump(plain_value(head | {key: value for key, value in config.items() if key not in head}), out)
    return out.getvalue()


def file_name(robot: str) -> str:
    """Return a robot's name as part of a file's name, another one for each robot.

    A name that is not one of files, or is long, gets a part of its SHA-256.
    """
    name = "".join(c if c.isalnum() or c in "-_." else "_" for c in robot)
    if name == robot and len(name.encode()) <= LONGEST_NAME:
        return name
    return f"{name[: LONGEST_NAME // 4]}_{hashlib.sha256(robot.encode()).hexdigest()[:8]}"


@dataclass(frozen=True)
class LogReference:
    """Log of a run; a plain list of events has no name."""

    name: str = ""
    format: str = ""
    path: str | None = None
    robots: Names = ()

    def as_dict(self) -> Figures:
        """Return the reference as it stands in ``summary.json``."""
        return vars(self) | {"robots": list(self.robots)}


@dataclass(frozen=True, eq=False)
class Recording:
    """One log through one filter: the history, the final map, the truth to judge them by, the configuration.

    `summary` is what `Run.evaluate` last returned.  `slam`, the filter after the last event, and `source`, the log
    itself, are None in a run that was loaded; `final_slam` reads the filter from ``map.kmk``.  `reference` holds what
    others made of the same log, figures by their name, which the summary repeats.  `notes` are
    those about the configuration, which the summary has, too.  Plug-ins of the
    configuration are run only if the run is `trusted`.
    """

    history: History
    config: Section
    landmarks: MapLandmarks
    truth: Truth
    log: LogReference = LogReference()
    coordinates: str = "world"
    wall_s: float = 0.0
    skipped: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    stopped: str = ""
    slam: Slam | None = None
    source: Log | None = None
    folder: Path | None = None
    summary: Figures = field(default_factory=dict)
    reference: Figures = field(default_factory=dict)
    trusted: bool = True

    def __repr__(self) -> str:
        steps, lost = len(self.history.t_ns), f", stopped: {self.stopped}" if self.stopped else ""
        of = f"{steps} steps, {len(self.history.outcome)} observations, {len(self.landmarks)} landmarks"
        return f"<{type(self).__name__} {self.log.name!r} of {list_names(self.history.robots)}: {of}{lost}>"

    @property
    def estimator(self) -> str:
        """The estimator's name in configuration files."""
        value = self.config.get("estimator")
        return str(value.get("type", "")) if isinstance(value, dict) else str(value or "")

    def section(self, robot: str, sensor: str) -> Section:
        """Return the configuration of a robot's sensor, {} if it has none."""
        return self.sections(robot).get(sensor) or {}

    def motion(self, robot: str) -> Section:
        """Return the configuration of a robot's motion, {} if it has none."""
        robots = self.config.get("robots") or {}
        return (robots.get(robot) or robots.get("each") or {}).get("motion") or {}

    def sections(self, robot: str) -> Section:
        """Return the configuration of a robot's sensors by name."""
        robots = self.config.get("robots") or {}
        found: Section = {}
        for name in ("each", robot):
            found |= (robots.get(name) or {}).get("sensors") or {}
        return found

    def with_truth(self, log: Log) -> Self:
        """Return the run judged by another log's truth."""
        return replace(self, truth=Truth.of(log, self.history, self.truth.anchored), summary={})

    def final_slam(self) -> Slam:
        """Return the filter after the last event, read from ``map.kmk`` if the run was loaded.

        This runs the `plugins` of the run's configuration.  Raises RunError if the run is not trusted.
        """
        if self.slam is not None:
            return self.slam
        if self.folder is None or not (self.folder / "map.kmk").is_file():
            raise RunError(f"{self.folder or 'run'}: no map.kmk, expected the saved map of the run")
        from kalmark.slam.slam import Slam

        self.run_plugins()
        return Slam.load(self.folder / "map.kmk")

    def run_plugins(self) -> None:
        """Run the `plugins` of the run's configuration: what they register is known from then on.

        Raises RunError if there are some, and the run is not trusted: whoever wrote the folder wrote their names.
        """
        if self.config.get("plugins") and not self.trusted:
            raise RunError(
                f"{self.folder}/config.yaml names plug-ins, {short_text(self.config['plugins'])}, "
                "whose code would be run: expected --trust, or Run.load(folder, trust=True), if you trust them"
            )
        for plugin in self.config.get("plugins") or ():
            load_plugin(Path(plugin))

    @classmethod
    def load(cls, folder: str | Path, trust: bool = False) -> Self:
        """Read a run folder; `trust`: what follows may run the plug-ins that its configuration names.

        Raises RunError naming the file that is missing or cannot be read.
        """
        folder = Path(folder)
        for name in NEEDED:
            if not (folder / name).is_file():
                raise RunError(f"{folder / name}: no such file, expected the folder of a complete run")
        try:
            with hold_lock(folder, shared=True):  # no other program replaces it meanwhile
                summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
                named = read_arrays(folder / "history.npz", RunError)
                log = summary["log"]
                return cls(
                    history=History.from_arrays(named),
                    config=read_mapping(folder / "config.yaml"),
                    landmarks=MapLandmarks.read(folder / "landmarks.csv"),
                    truth=Truth.from_arrays(named),
                    log=LogReference(**log | {"robots": tuple(log["robots"])}),
                    coordinates=summary["coordinates"],
                    wall_s=summary["wall_s"],
                    skipped=[
                        line if n == 1 else LeftOut(line, n)
                        for line, n in zip(named["skipped"].tolist(), named["skipped_records"].tolist(), strict=True)
                    ],
                    notes=named["notes"].tolist() if "notes" in named else [],
                    stopped=summary.get("stopped", ""),
                    folder=folder,
                    trusted=trust,
                    summary=summary,
                    reference={name: summary[name] for name in named["reference"].tolist()},
                )
        except (KeyError, ValueError, OSError, LogError) as error:
            raise RunError(f"{folder}: not a run that this version reads: {error}") from None

    def save_files(self, folder: Path) -> None:
        """Write all files of the run into a new folder but its figures, its pictures and its page."""
        for robot in self.history.robots:
            write(folder / f"trajectory_{file_name(robot)}.tum", tum(self.history, robot))
        write(folder / "config.yaml", config_yaml(self.config))
        write(folder / "landmarks.csv", self.landmarks.to_csv())
        write(folder / "associations.csv", associations_csv(self.history))
        if self.history.changes:
            write(folder / "changes.csv", changes_csv(self.history))
        replace_file(folder / "history.npz", self._save_arrays)
        saved = None if self.folder is None else self.folder / "map.kmk"
        if self.slam is not None:
            replace_file(folder / "map.kmk", self.slam.save)
        elif saved is not None and saved.is_file():
            replace_file(folder / "map.kmk", partial(shutil.copyfile, saved))

    def _save_arrays(self, path: Path) -> None:
        arrays: dict[str, Any] = {**self.history.arrays(), **self.truth.arrays()}
        arrays["skipped"] = np.array(self.skipped, dtype=np.str_)
        arrays["notes"] = np.array(self.notes, dtype=np.str_)
        arrays["skipped_records"] = ints([records_of(line) for line in self.skipped])
        arrays["reference"] = np.array(list(self.reference), dtype=np.str_)
        _savez(path, arrays)
