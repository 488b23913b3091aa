"""The figures of a run: errors against truth, consistency, scoring against position fixes.  See docs/evaluation.md."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from kalmark.arrays import Array
from kalmark.events import Id
from kalmark.logs.log import poses_of_size
from kalmark.logs.source import records_of
from kalmark.report import OUTCOMES
from kalmark.results.association_errors import association_figures, best_known, by_position, no_ids
from kalmark.results.control_gaps import gap_figures, gap_notes
from kalmark.results.figure_texts import Figures, count, figure
from kalmark.results.history import History, Ints
from kalmark.results.landmark_errors import landmark_error
from kalmark.results.landmark_table import MapLandmarks
from kalmark.results.measures import (
    Rigid,
    aligned_rmse,
    associated_nis,
    finite_mean,
    has_diverged,
    identity_alignment,
    nees,
    nees_limit,
    path_m,
    pose_error,
    ratio,
    rigid_robust,
    rmse,
    similarity,
)
from kalmark.results.recording import Recording
from kalmark.results.repeated_landmarks import repeat_figures, repeat_notes
from kalmark.results.self_calibration import bias_figures, mount_figures
from kalmark.results.truth import Truth
from kalmark.results.warnings import advice, fix_nis_per_dof, warnings, window_figures
from kalmark.results.wrong_starts import restarts

FIX_GAP_S = 3.0  # no path is interpolated across a longer gap between scans
FIX_NEAR_M = 10.0
PIXEL = 2  # numbers that a camera without depth measures of a point


def evaluate(run: Recording) -> Figures:
    """Return the figures of ``summary.json``; a figure that needs what is not there is absent or None."""
    history = run.history
    robots = {name: robot_figures(run, name) for name in history.robots}
    step_us = history.step_us[1:][np.isfinite(history.step_us[1:])]
    controls, fixes = sum(c.number for c in history.controls.values()), history.fixes
    summary: Figures = {
        "log": run.log.as_dict(),
        "estimator": run.estimator,
        "coordinates": run.coordinates,
        "frame": run.truth.frame if run.truth else None,
        "events": controls + history.scans + len(fixes),
        "controls": controls,
        "scans": history.scans,
        "fixes": len(fixes),
        "fixes_rejected": sum(not fix.used for fix in fixes),
        "observations": len(history.step),
        **{name: int(np.sum(history.outcome == name)) for name in OUTCOMES},
        "landmarks": len(run.landmarks),
        "skipped": sum(map(records_of, run.skipped)),
        "wall_s": run.wall_s,
        "step_us_median": _quantile(step_us, 0.5),
        "step_us_p99": _quantile(step_us, 0.99),
        "nis_per_dof": nis_per_dof(history),
        "pose_dof": 6 if history.in_space else 3,
        "diverged": bool(run.stopped) or any(figures.get("diverged", False) for figures in robots.values()),
    }
    summary |= window_figures(history)
    if fixes:
        summary["fix_nis_per_dof"] = fix_nis_per_dof(fixes)
    if run.stopped:
        summary["stopped"] = run.stopped
    summary["robots"] = robots
    landmarks = known_landmarks(run)
    if no_ids(run) and landmarks.ids != run.landmarks.ids:
        found = sum(a != b for a, b in zip(landmarks.ids, run.landmarks.ids, strict=True))
        summary["landmarks_matched"] = f"{found} of {len(landmarks)} by position, of {len(run.truth.landmarks)} true"
    summary |= association_figures(history, run.landmarks.ids)
    summary |= landmark_figures(landmarks, run.truth, last_observed_from(history, run.landmarks.ids))
    if not np.isnan(history.left_px).all():
        summary["corner_rms_px"] = float(np.sqrt(np.nanmean(history.left_px**2)))
    if history.mounts:
        summary["mounts"] = {mount.name: mount_figures(mount) for mount in history.mounts}
    if history.biases:
        summary["biases"] = {bias.robot: bias_figures(bias, run.motion(bias.robot)) for bias in history.biases}
    summary["gaps"], summary["repeats"] = gap_figures(run), repeat_figures(run)
    summary |= run.reference
    if run.truth.fixes and not np.isfinite(run.truth.poses).any():
        summary |= fix_figures(np.concatenate([fix_distances(run, name) for name in run.truth.fixes]))
    summary = none_for_nan(summary)
    summary["warnings"] = warnings(run, summary)
    summary["advice"] = advice(run, summary)
    summary["notes"] = [*run.notes, *gap_notes(summary["gaps"]), *repeat_notes(history), *scale_notes(run, robots)]
    return summary


def scale_notes(run: Recording, robots: Figures) -> Iterator[str]:
    """Yield a line for each robot whose scale is not observable, or not by a sensor."""
    for name, figures in robots.items():
        if figures.get("scale") is not None and scale_is_free(run, name):
            yield f"the scale of {name}'s path is not observable: compared after a similarity, and without pose NEES"
    for name in robots:
        coasts = run.motion(name).get("type") == "constant_velocity_3d"
        if coasts and sees_no_scale(run, name) and not scale_is_free(run, name):
            yield f"{name} sees no scale, and its velocity drifts: sigmas of places may be several times too small"


def summary_of(run: Recording) -> Figures:
    """Return the figures of a run as evaluated last, or now if they never were."""
    return run.summary or evaluate(run)


def headline(run: Recording) -> tuple[str, list[str]]:
    """Return the title of a run and its key figures, a few words each."""
    summary = summary_of(run)
    name = run.log.name or "run"
    title = f"{name} · {run.estimator}" if run.estimator else name
    parts = [] if run.history.localizes and not summary["landmarks"] else [count(summary["landmarks"], "landmark")]
    parts += [count(summary["scans"], "scan")]
    if not summary["scans"]:
        parts = [count(summary["fixes"], "fix", "fixes"), count(summary["controls"], "control")]
    errors = [figures for figures in summary["robots"].values() if figures.get("ate_m") is not None]

    def mean_of(key: str) -> float:
        return finite_mean([f[key] for f in errors if f.get(key) is not None])

    if errors:
        parts.append(f"position {figure(mean_of('ate_raw_m'))} m ({figure(mean_of('ate_m'))} m aligned)")
        turn = "orientation" if run.history.in_space else "heading"
        parts.append(f"{turn} {figure(mean_of('heading_rmse_deg'), 2)}°")
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
        usual = f"consistent: {summary['pose_dof']}, this run up to {figure(mean_of('pose_nees_most'), 2)}"
        parts.append(f"pose NEES {figure(mean_of('pose_nees'))} ({usual})")
    if summary["nis_per_dof"] is not None:
        parts.append(f"NIS/dof {summary['nis_per_dof']:.2f}")
    if summary["diverged"]:
        parts.append("DIVERGED")
    return title, parts


def robot_figures(run: Recording, name: str) -> Figures:
    """Return the figures of one robot: against its truth if there is one, else against position fixes."""
    mine = run.history.robot == name
    mean, P = run.history.poses[mine], run.history.pose_covariances[mine]
    truth = run.truth.poses_in_map()[mine]
    figures: Figures = {"scans": int(mine.sum()) if run.history.scans else 0}
    known = np.isfinite(truth).all(axis=1)
    if known.any():
        figures |= pose_figures(mean[known], P[known], truth[known], run.coordinates)
        restart = restarts(run.history).get(name)
        if restart is not None:  # before it the path was in another frame
            later = known & (run.history.t_ns[mine] > restart.t_ns)
            figures["diverged"] = pose_figures(mean[later], P[later], truth[later], run.coordinates)["diverged"]
        if any(isinstance(s, dict) and s.get("detector") for s in run.sections(name).values()) and mean.shape[1] == 7:
            figures |= scale_figures(mean[known, :3], truth[known, :3])
            if scale_is_free(run, name):
                figures |= free_scale_figures(mean[known], P[known], truth[known])
    elif name in run.truth.fixes:
        figures |= fix_figures(fix_distances(run, name))
    return figures


def pose_figures(mean: Array, P: Array, truth: Array, coordinates: str = "world") -> Figures:
    """Return errors and NEES of a path (N, 3) with covariances (N, 3, 3) against true poses (N, 3) in one frame.

    In space poses are (N, 7) and covariances (N, 6, 6).
    """
    d = 3 if mean.shape[1] == 7 else 2
    world = pose_error(mean, truth, "world")
    own = pose_error(mean, truth, coordinates)
    return {
        "ate_m": aligned_rmse(mean[:, :d], truth[:, :d]),
        "ate_raw_m": rmse(world[:, :d]),
        "heading_rmse_deg": float(np.degrees(rmse(world[:, d:]))),
        "pose_nees": finite_mean(nees(own, P)),
        "pose_nees_most": nees_limit(own, P),
        "pose_nees_world": finite_mean(nees(world, P)),
        "path_m": path_m(truth[:, :d]),
        "diverged": has_diverged(own, world, P, truth),
    }


def scale_is_free(run: Recording, name: str) -> bool:
    """Return whether neither sensors nor controls determine the scale of a robot's path."""
    return sees_no_scale(run, name) and run.history.controls.get(name) is None


def sees_no_scale(run: Recording, name: str) -> bool:
    """Return whether a robot has cameras of two numbers, nothing else, and no place is known."""
    h = run.history
    cameras = {camera.sensor for camera in h.cameras if camera.robot == name and len(camera.columns) == PIXEL}
    return (
        bool(cameras) and set(run.sections(name)) <= cameras and len(h.robots) == 1
        and not h.fixes and not h.priors
    )  # fmt: skip


def free_scale_figures(mean: Array, P: Array, truth: Array) -> Figures:
    """Return the figures of a path (N, 7) that compare it with the truth in units of its sigmas (N, 6, 6).

    The covariance is of a world whose scale begins with a guess, so there is no NEES; it has diverged if it does after
    the similarity.
    """
    fit, scale = similarity(mean[:, :3], truth[:, :3])
    error = fit(scale * mean[:, :3]) - truth[:, :3]
    turn = scale * fit.rotation
    sigmas = turn @ P[:, :3, :3] @ turn.T
    lost = has_diverged(error, error, sigmas, truth)
    return {"pose_nees": None, "pose_nees_most": None, "pose_nees_world": None, "diverged": lost}


def scale_figures(path: Array, truth: Array) -> dict[str, float]:
    """Return the error of a path (N, 3) whose scale is free, and its scale: the true length over the estimated one.

    `scale_drift` compares the scales of both halves.
    """
    if len(path) < 4:
        return {}
    fit, scale = similarity(path, truth)
    halves = np.array_split(np.arange(len(path)), 2)
    first, second = (similarity(path[half], truth[half])[1] for half in halves)
    drift = abs(second / first - 1.0) if first > 0.0 else float("nan")
    return {"ate_similarity_m": rmse(fit(scale * path) - truth), "scale": scale, "scale_drift": drift}


def known_landmarks(run: Recording) -> MapLandmarks:
    """Return the map at the end with the log's names, where the filter did not get them; without any, by position."""
    names = best_known(run.history, run.landmarks.ids, run.landmarks.observations)
    if no_ids(run):
        names = by_position(run.landmarks, run.truth.landmarks_in_map())
    return replace(run.landmarks, ids=[names.get(i, i) for i in run.landmarks.ids])


def landmark_figures(landmarks: MapLandmarks, truth: Truth, eyes: Array) -> Figures:
    """Return the errors of landmarks over the ids that map and truth share, those known exactly left out.

    Those of points and the centres of tags are raw and after their own rigid alignment; those of lines, if there are
    any true ones, are raw.  `eyes` (K, 2|3) are where the landmarks were last observed from, NaN if nowhere:
    `kalmark.results.landmark_errors` has which landmarks count.
    """
    true = {str(i): l for i, l in truth.landmarks_in_map().items()}
    if not true:
        return {}
    d = landmarks.d
    points, lines = [np.empty((2, 0, d))], [np.empty((2, 0, d))]
    table = zip(landmarks.ids, landmarks.kinds, landmarks.means, landmarks.covariances, eyes, strict=True)
    for name, kind, place, P, eye in table:
        if str(name) not in true or name in landmarks.exact:
            continue
        error = landmark_error(kind, place, P, true[str(name)], eye)
        if error is not None:
            (points if len(error.place) == 1 else lines).append(np.array([error.place, error.truth]))
    estimate, position = np.concatenate(points, axis=1)
    figures: Figures = {
        "landmark_rmse_m": aligned_rmse(estimate, position) if len(estimate) >= d else float("nan"),
        "landmark_rmse_raw_m": rmse(estimate - position),
        "landmarks_compared": len(estimate),
    }
    if any(len(l) == 2 * d for l in true.values()):
        nearest, ends = np.concatenate(lines, axis=1)
        figures |= {"line_rmse_raw_m": rmse(nearest - ends), "lines_compared": len(lines) - 1}
    return figures


def last_observed_from(history: History, ids: Sequence[Id]) -> Array:
    """Return where the robot was that observed each landmark (K,) last, (K, 2|3), NaN of those never observed."""
    rows = np.flatnonzero(history.fused)[::-1]
    names, latest = np.unique(history.landmark[rows], return_index=True)
    eyes = dict(zip(names.tolist(), history.poses[history.step[rows[latest]], : history.d], strict=True))
    return np.array([eyes.get(str(name), np.full(history.d, np.nan)) for name in ids]).reshape(-1, history.d)


def path_at(history: History, robot: str, t_ns: Ints, max_gap_s: float = FIX_GAP_S) -> Array:
    """Return planar poses (N, 3) of a robot's path interpolated at times, NaN outside it and across long gaps."""
    mine = history.robot == robot
    t, mean = history.t_ns[mine], poses_of_size(history.poses[mine], 3)
    out = np.full((len(t_ns), 3), np.nan)
    if len(t) < 2:
        return out
    after = np.clip(np.searchsorted(t, t_ns, side="left"), 1, len(t) - 1)
    gap = t[after] - t[after - 1]
    inside = (t_ns >= t[0]) & (t_ns <= t[-1]) & (gap <= max_gap_s * 1e9)
    share = ((t_ns - t[after - 1]) / np.maximum(gap, 1))[:, None]
    poses = np.column_stack([mean[:, :2], np.unwrap(mean[:, 2])])
    blend = (1.0 - share) * poses[after - 1] + share * poses[after]
    out[inside] = blend[inside]
    return out


def aligned_fixes(run: Recording, robot: str) -> tuple[Rigid, Array, Array, Array, Ints]:
    """Return the robust alignment (`rigid_robust`) of the path to a robot's fixes, with what it aligns, all (N, 2).

    That is: where the antenna was by the estimated path at the time of each fix, its offset from the robot, both in the
    frame of the map, and the fix; last its time (N,), ns.
    """
    fixes = run.truth.fixes[robot]
    poses = path_at(run.history, robot, fixes.t_ns)
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    x, y = fixes.antenna
    offset = np.column_stack([c * x - s * y, s * x + c * y])
    antenna = poses[:, :2] + offset
    known = np.isfinite(antenna).all(axis=1) & np.isfinite(fixes.xy).all(axis=1)
    antenna, offset, xy = antenna[known], offset[known], fixes.xy[known]
    return rigid_robust(antenna, xy) if len(xy) > 1 else identity_alignment(), antenna, offset, xy, fixes.t_ns[known]


def fix_distances(run: Recording, robot: str) -> Array:
    """Return the distances of the fixes from the path that is aligned to them robustly."""
    to_fixes, antenna, _, xy, _ = aligned_fixes(run, robot)
    return np.linalg.norm(to_fixes(antenna) - xy, axis=1)


def fix_figures(distance: Array) -> Figures:
    """Return the median, the RMS of those within 10 m and their share of all, for distances (N,) in metres."""
    near = distance[distance <= FIX_NEAR_M]
    return {
        "fix_median_m": _quantile(distance, 0.5),
        "fix_rms_10m": rmse(near[:, None]),
        "fix_within_10m": finite_mean(distance <= FIX_NEAR_M),
        "fixes_compared": len(distance),
    }


def nis_per_dof(history: History) -> float:
    """Return the sum of the normalised innovations squared of the associated observations over their dimensions."""
    value, dof, _ = associated_nis(history)
    return ratio(value.sum(), dof.sum())


def none_for_nan(value: Any) -> Any:
    """Return a summary with None in place of every NaN or infinity, which JSON does not have."""
    if isinstance(value, dict):
        return {key: none_for_nan(item) for key, item in value.items()}
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value


def _quantile(values: Array, q: float) -> float:
    return float(np.quantile(values, q)) if len(values) else float("nan")
