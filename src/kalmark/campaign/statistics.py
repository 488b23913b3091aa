"""From the scores of N runs to ANEES, their chi-square bands and RMSE.

Bar-Shalom, Li, Kirubarajan 2001, section 5.4.2: the average of N independent NEES values of n degrees of freedom is
chi-square of N n degrees, over N.  Per step, never over time: the steps of one run are not independent.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.stats import chi2

from kalmark.campaign.scoring import NEES, Scores

Array = npt.NDArray[np.float64]


class Anees:
    """The average NEES over runs at each (robot, step), its 95 % band, and whether it lies inside.

    Of the joint state it is per dimension.  For landmarks the band is that of one landmark: the landmarks of a map
    share their errors, so their mean scatters almost as one of them does, and less where they do not.  `average` and
    `inside` leave out the first `skip` steps.
    """

    def __init__(self, name: str, scores: Sequence[Scores], skip: int = 0, probability: float = 0.95) -> None:
        kind = name.removesuffix("_world")
        values, size = (np.array([s.series[key] for s in scores]) for key in (name, f"{kind}_dof"))
        finite = np.isfinite(values) & np.isfinite(size)
        self.skip = skip
        self.runs = finite.sum(axis=0)
        dof = np.where(finite, size, 0.0).sum(axis=0)
        over = dof if kind == "joint" else self.runs
        known = over > 0
        divisor, dof = np.where(known, over, 1.0), np.where(known, dof, 1.0)
        tail = (1.0 - probability) / 2.0
        self.mean = np.where(known, np.where(finite, values, 0.0).sum(axis=0) / divisor, np.nan)
        self.low = np.where(known, chi2.ppf(tail, dof) / divisor, np.nan)
        self.high = np.where(known, chi2.ppf(1.0 - tail, dof) / divisor, np.nan)
        self.ideal = 1.0 if kind == "joint" else mean(size[finite])

    @property
    def average(self) -> float:
        """The average over robots and steps."""
        return mean(self.mean[:, self.skip :])

    @property
    def inside(self) -> float:
        """The share of steps inside the band."""
        inside = np.where(np.isfinite(self.mean), (self.low <= self.mean) & (self.mean <= self.high), np.nan)
        return mean(inside[:, self.skip :])


def mean(values: Array) -> float:
    """Return the mean of the values (N,) that are finite, NaN if none is."""
    values = values[np.isfinite(values)]
    return float(values.mean()) if len(values) else float("nan")


def rms(values: Array) -> float:
    """Return the root mean square of the values (N,) that are finite."""
    return mean(values**2) ** 0.5


def figures(scores: Sequence[Scores], skip: int = 0) -> dict[str, Any]:
    """Return the figures of one estimator over all runs, diverged ones included.

    `..._anees` is the average over steps, `..._inside` the share of steps inside the 95 % band, both after the first
    `skip` steps; joint ANEES is per dimension.  `..._median` of pose NEES over all runs and steps is not moved by a run
    that diverges.  What the runs do not have (velocities, uncertain mounts) is left out.
    """
    result: dict[str, Any] = {"runs": len(scores), "diverged": sum(s.diverged for s in scores)}
    stopped = sorted({s.stopped for s in scores if s.stopped})
    if stopped:
        result["stopped"] = stopped
    for name in kinds(scores):
        for suffix in ("", "_world") if f"{name}_world" in scores[0].series else ("",):
            anees = Anees(name + suffix, scores, skip)
            result[f"{name}_anees{suffix}"] = anees.average
            result[f"{name}_inside{suffix}"] = anees.inside
    pose = np.array([s.series["pose"] for s in scores])
    result["pose_nees_median"] = float(np.median(pose[np.isfinite(pose)])) if np.isfinite(pose).any() else float("nan")
    result["position_rmse_m"] = rms(np.array([s.series["position_m"] for s in scores]))
    result["heading_rmse_deg"] = float(np.degrees(rms(np.array([s.series["heading_rad"] for s in scores]))))
    result["landmark_rmse_m"] = rms(np.array([s.landmark_rmse_m for s in scores]))
    result["landmark_rmse_raw_m"] = rms(np.array([s.landmark_rmse_raw_m for s in scores]))
    result["landmarks"] = mean(np.array([float(s.landmarks) for s in scores]))
    dof = sum(s.nis_dof for s in scores)
    result["nis_per_dof"] = sum(s.nis for s in scores) / dof if dof else float("nan")
    return result | mounts(scores)


def kinds(scores: Sequence[Scores]) -> list[str]:
    """Return what has a NEES in these runs; pose, heading, landmarks and joint state always."""
    always = ("pose", "heading", "landmarks", "joint")
    return [n for n in NEES if n in always or any(np.isfinite(s.series[n]).any() for s in scores)]


def mounts(scores: Sequence[Scores]) -> dict[str, float]:
    """Return how uncertain mounts came out at the end of the runs: the worst of each run.

    `mount_m`, `mount_deg`: RMS over runs; `mount_sure`: runs whose NEES is below its 99.73 % quantile, 3 sigma.
    """
    if not any(np.isfinite(s.series["mount_m"]).any() for s in scores):
        return {}
    names = ("mount", "mount_dof", "mount_m", "mount_rad")
    last = {name: np.array([_last(s.series[name]) for s in scores]) for name in names}
    below = last["mount"] <= chi2.ppf(0.9973, last["mount_dof"])
    return {
        "mount_m": rms(last["mount_m"]),
        "mount_deg": float(np.degrees(rms(last["mount_rad"]))),
        "mount_sure": int(below.sum()),
    }


def _last(values: Array) -> float:
    """Return the largest, over robots, of the last finite values."""
    rows = [row[np.isfinite(row)] for row in values]
    return max((float(row[-1]) for row in rows if len(row)), default=float("nan"))
