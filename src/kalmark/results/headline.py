"""The title of a run and its key figures, as its pictures and its page have them."""

from __future__ import annotations

from typing import Any

from kalmark.results.evaluate import summary_of
from kalmark.results.recording import Recording
from kalmark.results.warnings import POSE_NEES
from kalmark.results.words import count, figure


def headline(run: Recording) -> tuple[str, list[str]]:
    """Return the title of a run and its key figures, a few words each."""
    summary = summary_of(run)
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
