"""`Campaign`: what N runs of each estimator gave, as figures, a table a step, and a picture.

Bar-Shalom, Li, Kirubarajan 2001, section 5.4.2: the average of N independent NEES values of n degrees of freedom is
chi-square of N n degrees, over N.  Per step, never over time: the steps of one run are not independent.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from kalmark.arrays import Array
from kalmark.campaign.scoring import NEES, Scores
from kalmark.files import replace_folder, write
from kalmark.geometry.gaussian import quantile
from kalmark.results.evaluate import none_for_nan
from kalmark.results.figure_texts import Figures
from kalmark.results.measures import finite_mean, ratio
from kalmark.results.scene import COLOURS, group_steps

POINTS = 400  # of a curve, at most
COARSE, FINE = (1.0, 2.0, 5.0), (1.0, 1.2, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0)  # ticks in a decade
FIGURES = (
    ("diverged", "diverged"),
    *((f"{name}_anees", name) for name in ("joint", "pose", "state", "heading", "landmarks", "mount")),
    ("pose_anees_sigma", "pose, standard error"),
    ("pose_inside", "pose in its band, %"),
    ("position_rmse_m", "position RMSE, m"),
    ("heading_rmse_deg", "heading RMSE, deg"),
    ("landmark_rmse_m", "landmark RMSE, aligned, m"),
    ("landmark_rmse_raw_m", "landmark RMSE, raw, m"),
    ("mount_m", "mount at the end, m"),
    ("mount_deg", "mount at the end, deg"),
    ("mount_sure", "mounts within 3 sigma at the end"),
)
FILES = (
    *("summary.json", "world.yaml", "config.yaml", "anees.csv", "anees.png", "sweep.png"),
    *("runs.parquet", "report.html", "cells"),
)
"""Names that the results of a campaign have in its folder."""
_WORDS = {"joint": "joint state, a dimension", "state": "pose and velocity"}
_WITH_WORLD = ("pose", "landmarks", "joint")


class Anees:
    """The average NEES over runs at each (robot, step), its 95 % band, and whether it lies inside.

    Of the joint state it is per dimension.  For landmarks the band is that of one landmark: the landmarks of a map
    share their errors, so their mean scatters almost as one of them does, and less where they do not.  `average` and
    `inside` leave out the first `skip` steps.
    """

    def __init__(self, name: str, scores: Sequence[Scores], skip: int = 0) -> None:
        kind = name.removesuffix("_world")
        values, size = (np.array([s.series[key] for s in scores]) for key in (name, f"{kind}_dof"))
        finite = np.isfinite(values) & np.isfinite(size)
        self.skip = skip
        self.runs = finite.sum(axis=0)
        dof = np.where(finite, size, 0.0).sum(axis=0)
        over = dof if kind == "joint" else self.runs
        known = over > 0
        divisor, dof = np.where(known, over, 1.0), np.where(known, dof, 1.0)
        self.mean = np.where(known, np.where(finite, values, 0.0).sum(axis=0) / divisor, np.nan)
        self.low = np.where(known, quantile(0.025, dof) / divisor, np.nan)
        self.high = np.where(known, quantile(0.975, dof) / divisor, np.nan)
        self.ideal = 1.0 if kind == "joint" else finite_mean(size[finite])

    @property
    def average(self) -> float:
        """The average over robots and steps."""
        return finite_mean(self.mean[:, self.skip :])

    @property
    def inside(self) -> float:
        """The share of steps inside the band."""
        inside = np.where(np.isfinite(self.mean), (self.low <= self.mean) & (self.mean <= self.high), np.nan)
        return finite_mean(inside[:, self.skip :])


def rms(values: Any) -> float:
    """Return the root mean square of the values (N,) that are finite."""
    return finite_mean(np.asarray(values) ** 2) ** 0.5


def figures(scores: Sequence[Scores], skip: int = 0) -> Figures:
    """Return the figures of one estimator over all runs, diverged ones included.

    `..._anees` is the average over steps, `..._inside` the share of steps inside the 95 % band, both after the first
    `skip` steps; joint ANEES is per dimension.  `pose_anees_sigma` is the standard error of the pose's, as the means of
    the runs scatter: the steps of one are correlated.  `..._median` of pose NEES over all runs and steps is not moved
    by a run that diverges.  Figures that the runs do not have (of velocities, uncertain mounts) are left out.
    """
    result: Figures = {"runs": len(scores), "diverged": sum(s.diverged for s in scores)}
    stopped = sorted({s.stopped for s in scores if s.stopped})
    if stopped:
        result["stopped"] = stopped
    for name in kinds(scores):
        for suffix in ("", "_world") if f"{name}_world" in scores[0].series else ("",):
            anees = Anees(name + suffix, scores, skip)
            result[f"{name}_anees{suffix}"] = anees.average
            result[f"{name}_inside{suffix}"] = anees.inside
    pose = np.array([s.series["pose"] for s in scores])
    each = np.array([finite_mean(nees[:, skip:]) for nees in pose])
    each = each[np.isfinite(each)]
    result["pose_anees_sigma"] = float(np.std(each, ddof=1)) / len(each) ** 0.5 if len(each) > 1 else float("nan")
    pose = pose[np.isfinite(pose)]
    result["pose_nees_median"] = float(np.median(pose)) if len(pose) else float("nan")
    result["position_rmse_m"] = rms([s.series["position_m"] for s in scores])
    result["heading_rmse_deg"] = float(np.degrees(rms([s.series["heading_rad"] for s in scores])))
    result["landmark_rmse_m"] = rms([s.landmark_rmse_m for s in scores])
    result["landmark_rmse_raw_m"] = rms([s.landmark_rmse_raw_m for s in scores])
    result["landmarks"] = finite_mean([s.landmarks for s in scores])
    result["nis_per_dof"] = ratio(sum(s.nis for s in scores), sum(s.nis_dof for s in scores))
    return result | mount_uncertainties(scores)


def kinds(scores: Sequence[Scores]) -> list[str]:
    """Return the quantities with a NEES in these runs; pose, heading, landmarks and joint state always."""
    always = ("pose", "heading", "landmarks", "joint")
    return [n for n in NEES if n in always or any(np.isfinite(s.series[n]).any() for s in scores)]


def mount_uncertainties(scores: Sequence[Scores]) -> dict[str, float]:
    """Return the final uncertainties of mounts: the largest of each run.

    `mount_m`, `mount_deg`: RMS over runs; `mount_sure`: runs whose NEES is below its 99.73 % quantile, 3 sigma.
    """
    if not any(np.isfinite(s.series["mount_m"]).any() for s in scores):
        return {}
    names = ("mount", "mount_dof", "mount_m", "mount_rad")
    last = {name: np.array([largest_last_value(s.series[name]) for s in scores]) for name in names}
    below = last["mount"] <= quantile(0.9973, last["mount_dof"])
    degrees = float(np.degrees(rms(last["mount_rad"])))
    return {"mount_m": rms(last["mount_m"]), "mount_deg": degrees, "mount_sure": int(below.sum())}


def largest_last_value(values: Array) -> float:
    """Return the largest, over robots, of the last finite values."""
    rows = [row[np.isfinite(row)] for row in values]
    return max((float(row[-1]) for row in rows if len(row)), default=float("nan"))


def draw(path: Path, title: str, t_s: Array, panels: Sequence[tuple[str, float, dict[str, Anees]]]) -> None:
    """Write the picture to a PNG file.  NEES in the estimator's coordinates, robots averaged, logarithmic.

    A panel is a quantity: its label, its ANEES for a consistent filter, and the ANEES of each estimator.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 2.5 * len(panels)), layout="constrained")
    axes = figure.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0]
    for axis, panel in zip(axes, panels, strict=True):
        _draw_panel(axis, t_s, *panel)
    axes[-1].set_xlabel("time (s)")
    each = -(-len(t_s) // POINTS)
    figure.suptitle(title + (f"; curves: means over {each} steps" if each > 1 else ""))
    figure.savefig(path, dpi=110)


def curves(t_s: Array, value: Array, *others: Array) -> Array:
    """Return curves (K, M), the first over time (N,), that can be read: means over steps that have a value (N,).

    NaN stands where a gap in time is, so that no line is drawn across it.
    """
    steps = np.flatnonzero(np.isfinite(value))
    groups, gaps = group_steps(steps, (t_s[steps] * 1e9).astype(np.int64), -(-len(t_s) // POINTS))
    size = np.bincount(groups)
    return np.insert([np.bincount(groups, row[steps]) / size for row in (t_s, value, *others)], gaps, np.nan, axis=1)


def _draw_panel(axis: Any, t_s: Array, label: str, ideal: float, estimators: dict[str, Anees]) -> None:
    from matplotlib.ticker import LogLocator, NullFormatter

    for i, (estimator, anees) in enumerate(estimators.items()):
        rows = (np.ma.masked_invalid(a).mean(axis=0).filled(np.nan) for a in (anees.mean, anees.low, anees.high))
        t, value, low, high = curves(t_s, *rows)
        said = f"{estimator} ({anees.average:.3g}; {100 * anees.inside:.0f} % inside)"
        if i == 0:
            axis.fill_between(t, low, high, color="0.85", linewidth=0, label="95 % band")
        axis.plot(t, value, color=COLOURS[i % len(COLOURS)], linewidth=0.9, label=said)
    axis.axhline(ideal, color="0.4", linewidth=0.6)
    axis.set_yscale("log")
    bottom, top = axis.get_ylim()
    axis.yaxis.set_major_locator(LogLocator(subs=COARSE if top > 5.0 * bottom else FINE))
    axis.yaxis.set_major_formatter("{x:g}")
    axis.yaxis.set_minor_formatter(NullFormatter())
    axis.set_ylabel(label)
    axis.grid(visible=True, which="both", linewidth=0.3)
    axis.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=4, fontsize="small", frameon=False, borderpad=0.1)


@dataclass(frozen=True, eq=False)
class Campaign:
    """N runs of a world, each estimator on the same logs: `scores[estimator][run]`, `t_s` the time of each step.

    `kind` is "world", or "config" of a log's replay; `description` is it as it was in force, in YAML.  Averages of NEES
    leave out the first `skip` steps.  `path` is the way by which the runs were computed: `running.path_of`.

    >>> from kalmark.simulate import load_world
    >>> world = load_world("cloister", ["steps=10"])
    >>> campaign = run_campaign(world, 2, ["ekf", "invariant"], jobs=1, progress=False)
    >>> campaign.label("pose"), campaign.summary()["estimators"]["ekf"]["diverged"]
    ('pose (3)', 0)
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
    path: str = "ordinary path"

    def ideal(self, name: str) -> float:
        """Return the ANEES of a consistent filter: its degrees of freedom, 1 for the joint state."""
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

    def summary(self) -> Figures:
        """Return the figures of ``summary.json``: a section for each estimator."""
        head = {self.kind: self.world, "seed": self.seed, "runs": self.runs, "steps": len(self.t_s)}
        head |= {"map_every": self.map_every, "skip": self.skip, "path": self.path}
        dof, band = ({name: of(name) for name in self._names()} for of in (self.ideal, self.band))
        estimators = {name: figures(scores, self.skip) for name, scores in self.scores.items()}
        return none_for_nan({**head, "dof": dof, "band": band, "estimators": estimators})

    def save(self, folder: str | Path) -> Path:
        """Write ``summary.json``, ``anees.csv`` (a row an estimator, robot and step), ``anees.png``, description."""
        replace_folder(Path(folder), self.write, FILES, "summary.json")
        return Path(folder)

    def write(self, folder: Path) -> None:
        """Write the files of `save` into a new folder."""
        write(folder / "summary.json", json.dumps(self.summary(), indent=2) + "\n")
        write(folder / f"{self.kind}.yaml", self.description)
        self._write_steps(folder / "anees.csv")
        title = f"{self.world}: average NEES of {self.runs} runs, seed {self.seed}"
        t_s = np.array(self.t_s) - (self.t_s[0] if self.kind == "config" else 0.0)  # logs have clocks
        panels = [
            (self.label(n), self.ideal(n), {of: Anees(n, scores, self.skip) for of, scores in self.scores.items()})
            for n in self._names()
            if any(np.isfinite(score.series[n]).any() for scores in self.scores.values() for score in scores)
        ]  # of a map without landmarks none has a NEES
        draw(folder / "anees.png", title, t_s, panels)

    def _names(self) -> list[str]:
        return kinds([score for scores in self.scores.values() for score in scores])

    def _write_steps(self, path: Path) -> None:
        names = [n + w for n in self._names() for w in (("", "_world") if n in _WITH_WORLD else ("",))]
        bands = [f"{name}_{what}" for name in names for what in ("anees", "low", "high")]
        with path.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file, lineterminator="\n")
            head = ("estimator", "robot", "step", "t_s", "runs", *bands, "position_rmse_m", "heading_rmse_rad")
            writer.writerow(head)
            for estimator, scores in self.scores.items():
                anees = [Anees(name, scores) for name in names]
                columns = [column for a in anees for column in (a.mean, a.low, a.high)]
                errors = [[s.series[name] for s in scores] for name in ("position_m", "heading_rad")]
                columns += [np.sqrt((np.ma.masked_invalid(e) ** 2).mean(axis=0).filled(np.nan)) for e in errors]
                for i, robot in enumerate(self.robots):
                    for k, t_s in enumerate(self.t_s):
                        row = [f"{v:.9g}" if np.isfinite(v := column[i, k]) else "" for column in columns]
                        writer.writerow([estimator, robot, k + 1, f"{t_s:.9f}", anees[0].runs[i, k], *row])
