"""What both pictures of a run show, all in the frame of the map: paths, landmarks, truth, position fixes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from kalmark.events import Id
from kalmark.results.align import Rigid, rigid, rigid_robust
from kalmark.results.evaluate import FIX_GAP_S, antenna_path
from kalmark.results.history import Array, Ints
from kalmark.results.truth import moved
from kalmark.results.warnings import POSE_NEES
from kalmark.results.words import count, figure

if TYPE_CHECKING:
    from kalmark.results.run import Run

COLOURS = ("#1f5fa8", "#c8553d", "#2f8f5b", "#8456a8", "#b8892b", "#2a9aa5", "#b0457a", "#6b6f2a")
SPACE_COLOURS = ("#2f8f5b", "#8456a8", "#b8892b", "#2a9aa5", "#6b6f2a", "#b0457a")
TRUTH_COLOUR = "#8b929c"
LANDMARK_COLOUR = "#d2691e"
FIX_COLOUR = "#7a3fa0"
INK = "#2b2f36"
GAP_STEPS = 10.0


@dataclass(frozen=True, eq=False)
class Picture:
    """By robot: estimated poses (N, 3), true positions (N, 2; NaN: unknown), fixes (N, 2) to score with
    and those `used` by the filter.  True landmarks (2,).  In space poses are (N, 7), positions (N, 3), landmarks
    places.  `stretches` (N,) count the gaps in time up to each of a robot's steps: no line is drawn across them.
    """

    paths: dict[str, Array]
    truth: dict[str, Array]
    fixes: dict[str, Array]
    landmarks: dict[Id, Array]
    used: dict[str, Array]
    stretches: dict[str, Ints]

    @classmethod
    def of(cls, run: Run) -> Picture:
        """Return what to draw of a run."""
        history = run.history
        d = 3 if history.in_space else 2
        to_map = _truth_to_map(run, d)
        paths, truth, fixes = {}, {}, {}
        for robot in history.robots:
            mine = history.robot == robot
            paths[robot] = history.poses[mine]
            poses = run.truth.poses[mine]
            if np.isfinite(poses).any():
                truth[robot] = to_map(poses[:, :d])
            elif robot in run.truth.fixes:
                fixes[robot] = _fixes_in_map(run, robot)
        landmarks = {i: l if d == 3 else l[:2] for i, l in moved(to_map, run.truth.landmarks).items()}
        stretches = {robot: stretches_of(history.t_ns[history.robot == robot]) for robot in paths}
        return cls(paths, truth, fixes, landmarks, _used_fixes(run), stretches)

    def colour(self, robot: str) -> str:
        """Return the robot's colour; in space, where landmarks are blue or red, the first robot is green."""
        in_space = any(path.shape[1] == 7 for path in self.paths.values())
        colours = SPACE_COLOURS if in_space else COLOURS
        return colours[list(self.paths).index(robot) % len(colours)]


def stretches_of(t_ns: Ints) -> Ints:
    """Return how many gaps are before each of a robot's steps (N,): 3 s, and ten times the median, without a scan."""
    steps = np.diff(t_ns) * 1e-9
    if not len(steps):
        return np.zeros(len(t_ns), dtype=np.int64)
    return np.append(0, np.cumsum(steps > max(FIX_GAP_S, GAP_STEPS * float(np.median(steps)))))


def broken(points: Array, stretches: Ints) -> Array:
    """Return a path (N, d) with a row of NaN before each new stretch, so that no line is drawn across the gap."""
    at = np.flatnonzero(np.diff(stretches[: len(points)])) + 1
    return np.insert(points, at, np.nan, axis=0)


def grouped(steps: Ints, t_ns: Ints, each: int) -> tuple[Ints, Ints]:
    """Return the group (N,) of each of these steps, and before which groups a gap in time is.

    A group is drawn as one: what is of so many consecutive steps, and on one side of a gap.
    """
    stretches = stretches_of(t_ns)
    new = (np.diff(steps // each, prepend=-1) != 0) | (np.diff(stretches, prepend=0) != 0)
    return np.cumsum(new) - 1, np.flatnonzero(np.diff(stretches[new])) + 1


def _used_fixes(run: Run) -> dict[str, Array]:
    """Return the fixes (N, 2) of each robot that the filter used; they are in the frame of the map."""
    used = [fix for fix in run.history.inputs.fixes if fix.used]
    return {name: np.array([fix.y for fix in used if fix.robot == name]) for name in sorted({f.robot for f in used})}


def _truth_to_map(run: Run, d: int) -> Rigid:
    """Return what brings the truth into the map: nothing if they share a frame, else the best rigid alignment."""
    truth = run.truth
    if truth.frame == "truth":
        return truth.to_map()
    known = np.isfinite(truth.poses).all(axis=1)
    return rigid(truth.poses[known][:, :d], run.history.mean[known][:, :d])


def _fixes_in_map(run: Run, robot: str) -> Array:
    """Return where the robot was (N, 2) by each fix: aligned robustly, the antenna's offset taken off."""
    fixes = run.truth.fixes[robot]
    antenna, offset = antenna_path(run.history, robot, fixes)
    known = np.isfinite(antenna).all(axis=1)
    if known.sum() < 2:
        return np.empty((0, 2))
    return rigid_robust(antenna[known], fixes.xy[known]).inverse()(fixes.xy[known]) - offset[known]


def headline(run: Run) -> tuple[str, list[str]]:
    """Return the title of a run and its key figures, a few words each."""
    summary = run.summary or run.evaluate()
    name = run.log.name or "run"
    title = f"{name} · {run.estimator}" if run.estimator else name
    parts = [count(summary["landmarks"], "landmark"), count(summary["scans"], "scan")]
    errors = [figures for figures in summary["robots"].values() if figures.get("ate_m") is not None]
    if errors:
        parts.append(f"position {figure(_mean(errors, 'ate_raw_m'))} m ({figure(_mean(errors, 'ate_m'))} m aligned)")
        parts.append(
            f"{'orientation' if run.history.in_space else 'heading'} {figure(_mean(errors, 'heading_rmse_deg'), 2)}°"
        )
    if summary.get("landmark_rmse_m") is not None:
        raw, aligned = figure(summary["landmark_rmse_raw_m"]), figure(summary["landmark_rmse_m"])
        how = ", matched by position" if "landmarks_matched" in summary else ""
        parts.append(f"landmarks {raw} m ({aligned} m aligned{how})")
    if summary.get("corner_rms_px") is not None:
        batch = f" (batch {figure(summary['batch']['rms_px'])} px)" if "batch" in summary else ""
        parts.append(f"corners {figure(summary['corner_rms_px'])} px{batch}")
    if summary.get("fix_median_m") is not None:
        parts.append(f"fixes: median {summary['fix_median_m']:.2f} m, {summary['fix_within_10m']:.1%} within 10 m")
    if any(figures.get("pose_nees") is not None for figures in errors):
        dof = 6 if run.history.in_space else 3
        usual = f"consistent: {dof}, one run up to {POSE_NEES[dof]:g}"
        parts.append(f"pose NEES {figure(_mean(errors, 'pose_nees'))} ({usual})")
    if summary["nis_per_dof"] is not None:
        parts.append(f"NIS/dof {summary['nis_per_dof']:.2f}")
    if summary["diverged"]:
        parts.append("DIVERGED")
    return title, parts


def _mean(figures: list[dict[str, Any]], key: str) -> float:
    values = [f[key] for f in figures if f.get(key) is not None]
    return sum(values) / len(values) if values else float("nan")


def ellipses(means: Array, covariances: Array, sigmas: float = 3.0, points: int = 40) -> Array:
    """Return the contours (K, points + 1, 2) of many 2-D Gaussians at once, closed.  [S] (85)-(87)."""
    values, axes = np.linalg.eigh(covariances)
    half = axes * np.sqrt(np.maximum(values, 0.0))[:, None, :]
    alpha = np.linspace(0.0, 2.0 * np.pi, points + 1)
    circle = np.stack([np.cos(alpha), np.sin(alpha)])
    return means[:, None, :] + sigmas * np.einsum("kij,jp->kpi", half, circle)
