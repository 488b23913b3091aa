"""`Sweep`: the campaigns of all cells side by side, as figures, a table of runs, a picture and a page."""

from __future__ import annotations

import base64
import html
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import stdtrit

from kalmark.arrays import Array
from kalmark.campaign.campaign import FIGURES, Campaign, kinds, largest_last_value, rms
from kalmark.campaign.campaign import FILES as RESULTS
from kalmark.campaign.scoring import Scores
from kalmark.campaign.sweep_cells import Cell, value_as_yaml
from kalmark.events import is_number
from kalmark.files import replace_file, replace_folder, write
from kalmark.results.figure_texts import Figures
from kalmark.results.history import grouped
from kalmark.results.measures import finite_mean, ratio
from kalmark.results.run_page import figure_text, html_table, read_page, tagged
from kalmark.results.scene import COLOURS

_PANELS = (
    ("pose_nees", "pose NEES"),
    ("position_rmse_m", "position RMSE (m)"),
    ("heading_rmse_deg", "heading RMSE (deg)"),
    ("landmark_rmse_m", "landmark RMSE,\naligned (m)"),
)


def run_figures(score: Scores, names: list[str], skip: int) -> Figures:
    """Return the figures of one run; `..._nees` are averages over robots and steps after the first `skip`."""
    series = score.series
    row: Figures = {"diverged": score.diverged, "stopped": score.stopped}
    for name in names:
        over = series["joint_dof"] if name == "joint" else 1.0
        row[f"{name}_nees"] = finite_mean((series[name] / over)[:, skip:])
    row["position_rmse_m"] = rms(series["position_m"])
    row["heading_rmse_deg"] = float(np.degrees(rms(series["heading_rad"])))
    row |= {"landmark_rmse_m": score.landmark_rmse_m, "landmark_rmse_raw_m": score.landmark_rmse_raw_m}
    row |= {"landmarks": score.landmarks, "nis_per_dof": ratio(score.nis, score.nis_dof)}
    if "mount" in names:
        row["mount_m"] = largest_last_value(series["mount_m"])
        row["mount_deg"] = float(np.degrees(largest_last_value(series["mount_rad"])))
    return row


def figure_over_runs(key: str, values: Array) -> tuple[float, float]:
    """Return the figure of the runs' figures (N,), and half its 95 % interval: a mean, of RMSE the root mean square."""
    values = values[np.isfinite(values)]
    power = values**2 if "rmse" in key else values
    if not len(values):
        return float("nan"), float("nan")
    middle = float(power.mean())
    n = len(values)
    half = float(stdtrit(n - 1, 0.975) * power.std(ddof=1)) / n**0.5 if n > 1 else 0.0  # Student's t
    if "rmse" not in key:
        return middle, half
    return middle**0.5, half / (2.0 * middle**0.5) if middle > 0 else 0.0


@dataclass(frozen=True, eq=False)
class Sweep:
    """The cells of a campaign and what each gave; run i of every cell has the same seed.  One cell without a sweep.

    >>> sweep = run_sweep(open_cells("cloister", ["steps=5,10"], progress=False), 1, ["ekf"], jobs=1, progress=False)
    >>> sweep.keys, [row["steps"] for row in sweep.runs()]
    (('steps',), [5, 10])
    """

    cells: tuple[Cell, ...]
    campaigns: tuple[Campaign, ...]

    @property
    def keys(self) -> tuple[str, ...]:
        """The keys that were swept."""
        return tuple(self.cells[0].settings)

    def summary(self) -> Figures:
        """Return the figures of ``summary.json``: without a sweep those of the campaign, else a section a cell."""
        summaries = [campaign.summary() for campaign in self.campaigns]
        if not self.keys:
            return summaries[0]
        head = {key: summaries[0][key] for key in (self.campaigns[0].kind, "seed", "runs", "map_every", "skip")}
        grid = {
            key: list({value_as_yaml(v): v for v in (c.settings[key] for c in self.cells)}.values())
            for key in self.keys
        }
        own = ("steps", "path", "dof", "band", "estimators")
        pairs = zip(self.cells, summaries, strict=True)
        cells = [{"settings": cell.settings, **{key: summary[key] for key in own}} for cell, summary in pairs]
        return {**head, "sweep": grid, "cells": cells}

    def runs(self) -> list[Figures]:
        """Return one row a cell, estimator and run: settings, figures; run i has the same number in all cells."""
        return [
            {**cell.settings, "estimator": name, "run": number, **run_figures(score, kinds(scores), campaign.skip)}
            for cell, campaign in zip(self.cells, self.campaigns, strict=True)
            for name, scores in campaign.scores.items()
            for number, score in enumerate(scores)
        ]

    def table(self, keys: Sequence[str] = ()) -> tuple[list[str], list[list[Any]]]:
        """Return the head, and a row a cell and estimator: its settings, and the figures `keys` that any of them has.

        By default all figures.
        """
        rows: list[tuple[list[Any], Figures]] = []
        for cell, campaign in zip(self.cells, self.campaigns, strict=True):
            for name, figures in campaign.summary()["estimators"].items():
                rows.append(([*map(value_as_yaml, cell.settings.values()), name], figures))
        found = [(key, label) for key, label in FIGURES if any(f.get(key) is not None for _, f in rows)]
        found = [(key, label) for key, label in found if not keys or key in keys]
        words = [self.campaigns[0].label(label) if key.endswith("_anees") else label for key, label in found]
        last = [key.rpartition(".")[2] for key in self.keys]
        head = [*(last if len({*last}) == len(last) else self.keys), "estimator", *words]
        return head, [[*first, *(_percent(key, f.get(key)) for key, _ in found)] for first, f in rows]

    def save(self, folder: str | Path) -> Path:
        """Write ``report.html``, ``summary.json`` and ``runs.parquet``; of a campaign all that `Campaign.save` writes.

        With a sweep, each cell has that in a folder of its own, ``cells/NUMBER``, and ``sweep.png`` compares them.
        """
        replace_folder(Path(folder), self._write, RESULTS, "summary.json")
        return Path(folder)

    def _write(self, folder: Path) -> None:
        for i, campaign in enumerate(self.campaigns):
            of_cell = folder / f"cells/{i + 1:03d}" if self.keys else folder
            of_cell.mkdir(parents=True, exist_ok=True)
            campaign.write(of_cell)
        picture = folder / ("sweep.png" if self.keys else "anees.png")
        if self.keys:
            write(folder / "summary.json", json.dumps(self.summary(), indent=2) + "\n")
            self.draw(picture)
        self.write_runs(folder / "runs.parquet")
        write(folder / "report.html", self.page(picture))

    def write_runs(self, path: Path) -> None:
        """Write the rows of `runs` to a Parquet file; a swept key whose values are of several kinds as text."""
        from pyarrow import Table
        from pyarrow.parquet import write_table

        rows = self.runs()
        for key in self.keys:
            kinds_of = {float if is_number(row[key]) else type(row[key]) for row in rows}
            as_type = float if kinds_of == {float} else value_as_yaml if kinds_of != {bool} else bool
            rows = [row | {key: as_type(row[key])} for row in rows]
        names = list({name: None for row in rows for name in row})
        table = Table.from_pydict({name: [row.get(name) for row in rows] for name in names})
        replace_file(path, lambda temporary: write_table(table, temporary))

    def draw(self, path: Path) -> None:
        """Write the picture of a sweep to a PNG file: figures over one key, a curve for each of the other settings.

        The key is the last one of numbers, else the last one.  Bars are 95 % intervals over the runs.
        """
        from matplotlib.figure import Figure

        rows, first = self.runs(), self.campaigns[0]
        numeric = [k for k in self.keys if all(is_number(c.settings[k]) for c in self.cells)]
        along = (numeric or self.keys)[-1]
        values = [*dict.fromkeys(value_as_yaml(cell.settings[along]) for cell in self.cells)]
        at = {text: float(text) if numeric else float(i) for i, text in enumerate(values)}
        curves = grouped(rows, lambda row: self._label(row, along))
        panels = [(key, label) for key, label in _PANELS if any(np.isfinite(row[key]) for row in rows)]
        figure = Figure(figsize=(9, 2.3 * len(panels) + 0.8), layout="constrained")
        axes = figure.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0]
        for axis, (key, label) in zip(axes, panels, strict=True):
            for i, (name, mine) in enumerate(curves.items()):
                points = grouped(mine, lambda row: at[value_as_yaml(row[along])])
                told = [(x, *figure_over_runs(key, np.array([row[key] for row in points[x]]))) for x in sorted(points)]
                axis.errorbar(*np.transpose(told), marker="o", markersize=4, capsize=3, linewidth=1.1,
                              color=COLOURS[i % len(COLOURS)], label=name or None)  # fmt: skip
            if key == "pose_nees":
                axis.axhline(first.ideal("pose"), color="0.4", linewidth=0.8, label="consistent")
            axis.set_ylabel(label)
            axis.grid(visible=True, linewidth=0.3)
        axes[0].legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=4, fontsize="small", frameon=False)
        axes[-1].set_xlabel(along)
        axes[-1].set_xticks([*at.values()], values)
        figure.suptitle(f"{first.world}: {first.runs} runs a cell, seed {first.seed}; bars: 95 % intervals")
        replace_file(path, lambda temporary: figure.savefig(temporary, dpi=110))

    def page(self, picture: Path) -> str:
        """Return the page: the figures of every cell, the picture, the description.  It needs no other file."""
        first, (head, rows) = self.campaigns[0], self.table()
        title = f"{first.world}: campaign of {first.runs} runs" + (f" in {len(self.cells)} cells" if self.keys else "")
        lost = sum(score.diverged for c in self.campaigns for scores in c.scores.values() for score in scores)
        told = [f"seed {first.seed}", f"{len(first.t_s)} steps", f"{lost} diverged"]
        told += [f"first {first.skip} steps left out"] if first.skip else []
        return read_page("campaign.html").format(
            title=html.escape(title),
            style=read_page("report.css"),
            figures=tagged("span", told),
            table=html_table([[figure_text(cell) for cell in row] for row in rows], head),
            picture=base64.b64encode(picture.read_bytes()).decode("ascii"),
            config=html.escape(first.description),
            of=" of the first cell" if self.keys else "",
        )  # fmt: skip

    def _label(self, row: Figures, along: str) -> str:
        """Return what the curve of a run is called: its settings but that `along` the axis, its estimator."""
        words = []
        for key in self.keys:
            if key != along:
                of = "" if key.endswith("estimator.type") else f"{key.rpartition('.')[2]} "
                words.append(of + value_as_yaml(row[key]))
        swept = any(key.endswith("estimator.type") for key in self.keys)
        return ", ".join(words if swept else [*words, row["estimator"]])


def _percent(key: str, value: Any) -> Any:
    return 100.0 * value if key.endswith("_inside") and value is not None else value
