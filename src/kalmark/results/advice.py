"""Is a sensor's noise stated far too large?  What its innovations are over the whole run, against that noise alone.

An innovation has the noise of its measurement in it, and the uncertainty of pose and map on top: E[z z'] = H P H' + R
is at least R, whatever P the filter believes in.  Squares of z that add up to far less than R therefore say that R is
too large, and by how much at least.  They do not say it of errors that last from one sighting to the next: the map
takes those in, and a larger white noise is a fair price for them.  So nothing is said where the truth shows the filter
to be too sure of itself already.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from kalmark.declare import registered_name
from kalmark.events import Scan
from kalmark.models import sensors
from kalmark.results.columns import Array
from kalmark.results.consistency import nis
from kalmark.results.history import History
from kalmark.results.recording import Recording
from kalmark.results.warnings import POSE_NEES
from kalmark.results.words import figure

if TYPE_CHECKING:
    from kalmark.report import Report
    from kalmark.slam.slam import Slam

LOW = 0.5  # squares over those of the stated noise: it is 1.4 times too large
TINY_NIS = 0.1
TINY = 1e-6  # of those squares, where a log has no noise
NUMBER, SCANS = 100, 30  # of observations, of scans: with a right noise one in 30,000 sensors is below LOW
COLUMNS = {registered_name(cls): tuple(cls.columns) for cls in sensors.BUILT_IN}


def stated_noise(slam: Slam, report: Report) -> Array:
    """Return the sigmas (K, p) of the noise that a scan's observations were given, (K, 0) where they are not of z."""
    count, width = report.z.shape
    event = report.event
    if not count or not isinstance(event, Scan):
        return np.empty((count, 0))
    sensor = slam.robots[event.robot].sensors[event.sensor].sensor
    R = sensor.noise(event.y) if event.cov is None else np.broadcast_to(event.cov, (count, *event.cov.shape[-2:]))
    if R.shape != (count, width, width):
        return np.empty((count, 0))
    return np.sqrt(np.einsum("kii->ki", R))


def advice(run: Recording, summary: Mapping[str, Any]) -> list[str]:
    """Return a line for each sensor whose noise is stated far too large; one if the NIS is tiny for another reason."""
    lines, nis_ = list(_sensors(run, summary)), summary["nis_per_dof"]
    if not lines and nis_ is not None and nis_ < TINY_NIS and summary["associated"] >= NUMBER // 2:
        lines = [f"NIS per degree of freedom {figure(nis_, 2)} where 1 is consistent: the noise is set too large"]
    return lines


def _sensors(run: Recording, summary: Mapping[str, Any]) -> Iterator[str]:
    history = run.history
    nees = [figures["pose_nees"] for figures in summary["robots"].values() if figures.get("pose_nees") is not None]
    if summary["diverged"] or (nees and float(np.mean(nees)) > POSE_NEES[summary["pose_dof"]]):
        return
    for sensor in dict.fromkeys(history.sensor.tolist()):
        mine = (history.outcome == "associated") & (history.sensor == sensor) & np.isfinite(history.noise).any(axis=1)
        if mine.sum() >= NUMBER and len(set(history.step[mine].tolist())) >= SCANS:
            yield from _of(history, sensor, mine, _columns(run, sensor))


def _of(history: History, sensor: str, mine: Any, columns: tuple[str, ...]) -> Iterator[str]:
    size = int(np.isfinite(history.noise[mine]).sum(axis=1).max())  # the padding after its numbers is that of others
    z, sigma = history.z[mine], history.noise[mine]
    squares = np.nanmean((z[:, :size] / sigma[:, :size]) ** 2, axis=0)
    low = np.flatnonzero(squares < LOW)
    if not len(low):
        return
    value, dof = nis(z, history.Z[mine])
    factors = 1.0 / np.sqrt(np.maximum(squares, TINY))
    if len(columns) == size:
        told = "sigma is", ", ".join(f"{figure(factors[k], 2)} times ({columns[k]})" for k in low)
    elif len(low) == size:
        told = "sigmas are", f"{figure(float(1.0 / np.sqrt(np.mean(np.maximum(squares, TINY)))), 2)} times"
    else:
        return
    share = figure(float(np.nansum(value) / dof.sum()), 2)
    yield (
        f"sensor {sensor}: NIS {share} where 1 is expected: its {told[0]} stated about {told[1]} too large, "
        "unless its errors last from one sighting to the next"
    )


def _columns(run: Recording, sensor: str) -> tuple[str, ...]:
    """Return what a sensor of kalmark's own measures, () of others."""
    sections = [((robot or {}).get("sensors") or {}).get(sensor) for robot in (run.config.get("robots") or {}).values()]
    return next((COLUMNS.get(str(section.get("type")), ()) for section in sections if section), ())
