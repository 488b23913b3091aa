"""Figures and counts as people write them, and the words for the figures of a run, one source for all who show them.

The words are rows of key in ``summary.json``, label and unit; a label that begins with two blanks is a part of the one
above it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

Words = tuple[tuple[str, str, str], ...]

TOTALS: Words = (
    ("observations", "observations", ""),
    ("associated", "  associated", ""),
    ("new", "  new landmarks", ""),
    ("rejected", "  rejected by the gate", ""),
    ("ignored", "  ignored", ""),
    ("deferred", "  deferred", ""),
    ("tentative", "  tentative", ""),
    ("landmarks", "landmarks in the map", ""),
    ("judged", "fused, where the log hides an id", ""),
    ("wrong", "  with another's landmark", ""),
    ("duplicates", "  landmarks beyond one for each id", ""),
    ("nis_per_dof", "NIS per degree of freedom (1)", ""),
    ("fixes", "fixes given to the filter", ""),
    ("fixes_rejected", "  rejected by the gate", ""),
    ("fix_nis_per_dof", "  NIS per degree of freedom (1)", ""),
    ("landmarks_matched", "landmarks matched to true ones", ""),
    ("landmark_rmse_m", "landmark RMSE, aligned", "m"),
    ("landmark_rmse_raw_m", "landmark RMSE, raw", "m"),
    ("corner_rms_px", "reprojection of corners, RMS", "px"),
    ("fix_median_m", "distance to position fixes, median", "m"),
    ("fix_rms_10m", "distance to position fixes, RMS within 10 m", "m"),
    ("fix_within_10m", "position fixes within 10 m", "%"),
    ("step_us_median", "time a step, median", "us"),
    ("step_us_p99", "time a step, 99 %", "us"),
)
MORE: Words = (  # what the page has besides
    ("landmarks_compared", "landmarks compared with true ones", ""),
    ("line_rmse_raw_m", "line RMSE, raw", "m"),
    ("lines_compared", "lines compared with true ones", ""),
    ("fixes_compared", "position fixes compared with the path", ""),
    ("nameless", "observations without an id in the log", ""),
    ("nameless_fused", "  fused all the same", ""),
    ("nis_window_max", "NIS per degree of freedom, worst window", ""),
    ("nis_window_max_s", "  from, to", "s"),
    ("nis_window_median", "  median window", ""),
    ("left_out_window_max", "observations that fit nothing, worst window", "%"),
    ("left_out_window_max_s", "  from, to", "s"),
    ("left_out_window_median", "  median window", "%"),
    ("innovation_autocorrelation", "correlation of successive innovations (0)", ""),
    ("events", "events", ""),
    ("controls", "  controls", ""),
    ("scans", "  scans", ""),
    ("skipped", "records left out", ""),
    ("wall_s", "time of the whole replay", "s"),
    ("estimator", "estimator", ""),
    ("coordinates", "coordinates of its errors", ""),
    ("frame", "frame of the map", ""),
    ("pose_dof", "numbers of a pose", ""),
    ("diverged", "diverged", ""),
    ("stopped", "stopped", ""),
    ("log.name", "log", ""),
    ("log.format", "  format", ""),
    ("log.path", "  path", ""),
    ("log.robots", "  robots", ""),
)
ROBOT: Words = (
    ("ate_raw_m", "position RMSE", "m"),
    ("ate_m", "aligned", "m"),
    ("heading_rmse_deg", "heading RMSE", "deg"),
    ("pose_nees", "pose NEES", ""),
)
BATCH: Words = (
    ("rms_px", "distance of corners, batch, RMS", "px"),
    ("median_px", "distance of corners, batch, median", "px"),
    ("filter_rms_px", "distance of corners, filter, RMS", "px"),
    ("filter_median_px", "distance of corners, filter, median", "px"),
    ("sigma_ratio", "landmark sigma, the filter's over the batch's", ""),
    ("map_difference_m", "distance of landmarks, RMS", "m"),
    ("map_difference_sigma", "distance of landmarks, largest", "sigmas"),
    ("map_difference_deg", "angle between tags, RMS", "deg"),
    ("path_ratio", "position RMSE, the filter's over the batch's", ""),
    ("path_difference_m", "distance of the paths, RMS", "m"),
    ("landmarks", "landmarks", ""),
    ("tags", "tags", ""),
    ("sightings", "sightings of tags", ""),
    ("iterations", "iterations", ""),
    ("chi2_per_dof", "chi2 per degree of freedom (1)", ""),
)


def in_words(figures: Mapping[str, Any], words: Words) -> Iterator[tuple[str, str, Any, str]]:
    """Yield key, label, value and unit of each figure in the order of the words; last, by its key, what has none."""
    known = {key: (label, unit) for key, label, unit in words}
    for key in [*(key for key in known if key in figures), *(key for key in figures if key not in known)]:
        label, unit = known.get(key, (key, ""))
        yield key, label, figures[key], unit


def header(label: str, unit: str) -> str:
    """Return the words at the top of a column of figures: position RMSE (m)."""
    return f"{label.strip()} ({unit})" if unit else label.strip()


def figure(value: float, digits: int = 3) -> str:
    """Return a value to so many significant digits, without a power of ten where it is large: 110, not 1.1e+02."""
    text = f"{value:.{digits}g}"
    return f"{float(text):.0f}" if math.isfinite(value) and 10**digits <= abs(value) < 1e9 else text


def count(number: int, one: str, many: str = "") -> str:
    """Return a number with its noun: 1 scan, 2 scans."""
    return f"{number} {one if number == 1 else many or one + 's'}"
