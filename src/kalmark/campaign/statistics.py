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

from kalmark.campaign.scoring import Scores

Array = npt.NDArray[np.float64]

DOF = {"pose": 3, "heading": 1, "landmarks": 2}


class Anees:
    """The average NEES over runs at each (robot, step), its 95 % band, and whether it lies inside.

    Of the joint state it is per dimension.  For landmarks the band is that of one landmark: the landmarks of a map
    share their errors, so their mean scatters almost as one of them does, and less where they do not.
    """

    def __init__(self, name: str, scores: Sequence[Scores], probability: float = 0.95) -> None:
        values = np.array([s.series[name] for s in scores])
        kind = name.removesuffix("_world")
        size = (
            np.array([s.series["joint_dof"] for s in scores]) if kind == "joint" else np.full(values.shape, DOF[kind])
        )
        finite = np.isfinite(values) & np.isfinite(size)
        self.runs = finite.sum(axis=0)
        dof = np.where(finite, size, 0.0).sum(axis=0)
        over = dof if kind == "joint" else self.runs
        known = over > 0
        divisor, dof = np.where(known, over, 1.0), np.where(known, dof, 1.0)
        tail = (1.0 - probability) / 2.0
        self.mean = np.where(known, np.where(finite, values, 0.0).sum(axis=0) / divisor, np.nan)
        self.low = np.where(known, chi2.ppf(tail, dof) / divisor, np.nan)
        self.high = np.where(known, chi2.ppf(1.0 - tail, dof) / divisor, np.nan)

    @property
    def average(self) -> float:
        """The average over robots and steps."""
        return mean(self.mean)

    @property
    def inside(self) -> float:
        """The share of steps inside the band."""
        return mean(np.where(np.isfinite(self.mean), (self.low <= self.mean) & (self.mean <= self.high), np.nan))


def mean(values: Array) -> float:
    """Return the mean of what is not NaN, NaN if nothing is."""
    values = values[np.isfinite(values)]
    return float(values.mean()) if len(values) else float("nan")


def rms(values: Array) -> float:
    """Return the root of the mean square of what is not NaN."""
    return mean(values**2) ** 0.5


def figures(scores: Sequence[Scores]) -> dict[str, Any]:
    """Return the figures of one estimator over all runs, diverged ones included.

    `..._anees` is the average over steps, `..._inside` the share of steps inside the 95 % band; joint ANEES is per
    dimension.  `..._median` of pose NEES over all runs and steps is not moved by a run that diverges.
    """
    result: dict[str, Any] = {"runs": len(scores), "diverged": sum(s.diverged for s in scores)}
    stopped = sorted({s.stopped for s in scores if s.stopped})
    if stopped:
        result["stopped"] = stopped
    for name in ("pose", "heading", "landmarks", "joint"):
        for suffix in ("", "_world") if name != "heading" else ("",):
            anees = Anees(name + suffix, scores)
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
    return result
