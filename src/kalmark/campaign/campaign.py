"""`Campaign`: what N runs of each estimator gave, as figures, a table a step, and a picture."""

from __future__ import annotations

import csv
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from kalmark.campaign.picture import Panel, draw
from kalmark.campaign.scoring import Scores
from kalmark.campaign.statistics import Anees, figures, kinds
from kalmark.results.evaluate import none_for_nan

_WORDS = {"joint": "joint state, a dimension", "state": "pose and velocity"}
_WITH_WORLD = ("pose", "landmarks", "joint")


@dataclass(frozen=True, eq=False)
class Campaign:
    """N runs of a world, each estimator on the same logs: `scores[estimator][run]`, `t_s` the time of each step.

    `kind` is "world", or "config" of a log's replay; `description` is it as it was in force, in YAML.  Averages of NEES
    leave out the first `skip` steps.
    """

    world: str
    description: str
    seed: int
    runs: int
    map_every: int
    robots: tuple[str, ...]
    t_s: tuple[float, ...]
    scores: dict[str, tuple[Scores, ...]]
    skip: int = 0
    kind: str = "world"

    def ideal(self, name: str) -> float:
        """Return what the ANEES of a consistent filter would be: its degrees of freedom, 1 for the joint state."""
        return Anees(name, [score for scores in self.scores.values() for score in scores]).ideal

    def label(self, name: str) -> str:
        """Return the words for a NEES and, in brackets, what it is for a consistent filter."""
        words = "orientation" if name == "heading" and self.ideal(name) == 3 else _WORDS.get(name, name)
        return f"{words} ({self.ideal(name):.3g})"

    def band(self, name: str) -> list[float] | None:
        """Return the 95 % band [low, high] of an ANEES at one step, the median over steps; None if it has none.

        The average over steps scatters less, by how much the correlation of the steps decides.
        """
        anees = Anees(name, next(iter(self.scores.values())), self.skip)
        low, high = (a[:, self.skip :][np.isfinite(a[:, self.skip :])] for a in (anees.low, anees.high))
        return [float(np.median(low)), float(np.median(high))] if len(low) else None

    def summary(self) -> dict[str, Any]:
        """Return the figures of ``summary.json``: a section for each estimator."""
        estimators = {name: figures(scores, self.skip) for name, scores in self.scores.items()}
        head = {self.kind: self.world, "seed": self.seed, "runs": self.runs, "steps": len(self.t_s)}
        dof = {name: self.ideal(name) for name in self._names()}
        band = {name: self.band(name) for name in self._names()}
        tail = {"map_every": self.map_every, "skip": self.skip, "dof": dof, "band": band, "estimators": estimators}
        return none_for_nan({**head, **tail})

    def save(self, folder: str | Path) -> Path:
        """Write ``summary.json``, ``anees.csv`` (a row an estimator, robot and step), ``anees.png``, description."""
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "summary.json").write_text(json.dumps(self.summary(), indent=2) + "\n", encoding="utf-8")
        (folder / f"{self.kind}.yaml").write_text(self.description, encoding="utf-8")
        self._write_steps(folder / "anees.csv")
        title = f"{self.world}: average NEES of {self.runs} runs, seed {self.seed}"
        t_s = np.array(self.t_s) - (self.t_s[0] if self.kind == "config" else 0.0)  # logs have clocks
        draw(folder / "anees.png", title, t_s, [self._panel(name) for name in self._names()])
        return folder

    def _panel(self, name: str) -> Panel:
        anees = {estimator: Anees(name, scores, self.skip) for estimator, scores in self.scores.items()}
        return Panel(self.label(name), self.ideal(name), anees)

    def _names(self) -> list[str]:
        return kinds([score for scores in self.scores.values() for score in scores])

    def _write_steps(self, path: Path) -> None:
        names = [n + w for n in self._names() for w in (("", "_world") if n in _WITH_WORLD else ("",))]
        bands = [f"{name}_{what}" for name in names for what in ("anees", "low", "high")]
        with path.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(
                ["estimator", "robot", "step", "t_s", "runs", *bands, "position_rmse_m", "heading_rmse_rad"]
            )
            for estimator, scores in self.scores.items():
                anees = [Anees(name, scores) for name in names]
                columns = [column for a in anees for column in (a.mean, a.low, a.high)]
                columns += [_rms(scores, name) for name in ("position_m", "heading_rad")]
                for i, robot in enumerate(self.robots):
                    for k, t_s in enumerate(self.t_s):
                        row = [_text(column[i, k]) for column in columns]
                        writer.writerow([estimator, robot, k + 1, f"{t_s:.9f}", anees[0].runs[i, k], *row])


def _rms(scores: tuple[Scores, ...], name: str) -> Any:
    values = np.array([s.series[name] for s in scores])
    count = np.isfinite(values).sum(axis=0)
    return np.where(count > 0, np.sqrt(np.nansum(values**2, axis=0) / np.maximum(count, 1)), np.nan)


def _text(value: float) -> str:
    return f"{value:.9g}" if np.isfinite(value) else ""
