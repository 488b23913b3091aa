"""`Kept`: the finished runs of a campaign in its folder, so that one that was stopped goes on where it was.

``campaign.json`` describes the runs; ``runs/CELL/NUMBER.npz`` holds the scores of one run.  A file appears
complete or not at all, so a campaign may be killed at any time.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np

from kalmark.campaign.replay import Replay, ReplayedScan
from kalmark.campaign.scoring import SERIES, Scores
from kalmark.config.schema import Config
from kalmark.errors import KalmarkError
from kalmark.files import replace_file, write
from kalmark.simulate.worlds import World

NUMBERS = ("landmark_rmse_m", "landmark_rmse_raw_m", "landmarks", "nis", "nis_dof", "diverged")


@cache
def code_digest() -> str:
    """Return a digest of kalmark's sources: other code gives other numbers."""
    digest, package = hashlib.sha256(), Path(__file__).parents[1]
    for source in sorted(package.rglob("*.py")):
        digest.update(source.read_bytes())
    return digest.hexdigest()[:16]


def cell_digest(scene: World | Replay, configs: Mapping[str, Config]) -> str:
    """Return a digest of what a run is of: scene, filters, own models, and the observations of a log."""
    digest = hashlib.sha256(scene.to_yaml().encode())
    for name, config in configs.items():
        digest.update(f"{name} {config.model_dump_json()}".encode())
    for plugin in scene.config().plugins:
        digest.update(Path(plugin).read_bytes())
    if isinstance(scene, Replay):
        for look in scene.recorded.events:
            if isinstance(look, ReplayedScan):
                digest.update(f"{look.event.t_ns} {look.event.y.tolist()}".encode())
    return digest.hexdigest()[:16]


class Kept:
    """Finished runs in a folder.

    `cells` are the digests of the cells by their labels; cells may be added later.  Raises KalmarkError if the folder
    holds runs of another campaign, unless these are not to be resumed: then they are removed.
    """

    def __init__(self, folder: Path, head: dict[str, int | str], cells: dict[str, str], resume: bool = True) -> None:
        self.folder = folder / "runs"
        file = folder / "campaign.json"
        if not resume:
            shutil.rmtree(self.folder, ignore_errors=True)
        head = head | {"code": code_digest()}
        old = json.loads(file.read_text(encoding="utf-8")) if resume and file.is_file() else {**head, "cells": {}}
        other = [key for key in head if old.get(key) != head[key]]
        other += [label or "description" for label in cells if old["cells"].get(label, cells[label]) != cells[label]]
        if other:
            raise KalmarkError(
                f"{folder}: got runs of another campaign ({', '.join(other)} differs), expected another --out, "
                "or --no-resume to begin again"
            )
        folder.mkdir(parents=True, exist_ok=True)
        write(file, json.dumps(head | {"cells": old["cells"] | cells}, indent=2) + "\n")

    def path(self, cell: str, number: int) -> Path:
        """Return the file of one run."""
        return self.folder / cell / f"{number:06d}.npz"

    def read(self, cell: str, number: int) -> dict[str, Scores] | None:
        """Return the scores of a finished run by estimator, None if there is no such run."""
        try:
            with np.load(self.path(cell, number), allow_pickle=False) as file:
                series, numbers, names, stopped = (file[key] for key in ("series", "numbers", "estimators", "stopped"))
        except (FileNotFoundError, BadZipFile, EOFError, ValueError):  # after a power cut a file may be damaged
            return None
        result = {}
        for name, arrays, values, reason in zip(
            names.tolist(), series, numbers.tolist(), stopped.tolist(), strict=True
        ):
            aligned, raw, landmarks, nis, dof, diverged = values
            all_of = dict(zip(SERIES, arrays, strict=True))
            result[name] = Scores(all_of, aligned, raw, int(landmarks), nis, int(dof), bool(diverged), reason)
        return result

    def write(self, cell: str, number: int, result: Mapping[str, Scores]) -> None:
        """Keep the scores of a finished run."""
        scores = result.values()
        arrays: dict[str, Any] = {
            "series": np.array([[s.series[name] for name in SERIES] for s in scores]),
            "numbers": np.array([[float(getattr(s, name)) for name in NUMBERS] for s in scores]),
            "estimators": np.array([*result]),
            "stopped": np.array([s.stopped for s in scores]),
        }
        self.path(cell, number).parent.mkdir(parents=True, exist_ok=True)
        replace_file(self.path(cell, number), lambda temporary: np.savez_compressed(temporary, **arrays))
