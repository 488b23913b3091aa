"""Draw a scan and what a detector found in it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from kalmark.arrays import Array
from kalmark.detect.laser_scan import Detections
from kalmark.geometry.frames import inv_scan_many
from kalmark.geometry.gaussian import ellipse

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SIGMAS = 3.0


def draw_scan(ranges: Any, angles: Any, found: Detections, range_max_m: float = np.inf, ax: Axes | None = None) -> Axes:
    """Draw the beams that came back, what was found with its 3-sigma ellipses, and the laser at the origin; x is ahead.

    Circles are drawn as such, corners and reflectors as crosses, walls as lines between their ends.  Returns the axes.

    >>> a = np.linspace(-1.0, 1.0, 201)
    >>> r = 4.0 / np.cos(a)
    >>> axes = km.detect.draw_scan(r, a, km.detect.Walls().detect(r, a))
    >>> axes.get_aspect()
    1.0
    """
    import matplotlib.pyplot as plt

    r, a = np.asarray(ranges, dtype=np.float64), np.asarray(angles, dtype=np.float64)
    hit = np.isfinite(r) & (r < range_max_m)
    if ax is None:
        _, ax = plt.subplots(figsize=(7, 7), layout="constrained")
    used = np.zeros(len(r), dtype=bool)
    for first, last in found.beams:
        used[first : last + 1] = True
    for some, colour in ((hit & ~used, "0.6"), (hit & used, "tab:blue")):
        ax.plot(r[some] * np.cos(a[some]), r[some] * np.sin(a[some]), ".", color=colour, markersize=3)
    ax.plot(0, 0, marker=(3, 0, -90), color="black", markersize=9)
    if "ends_m" in found.attributes and "normal_rad" in found.columns:
        for ends in found.attributes["ends_m"]:
            ax.plot(*ends.T, "-", color="tab:red", linewidth=1.5)
    else:
        _points(ax, found)
    ax.set_aspect("equal", adjustable="datalim")
    ax.set_xlabel("x, ahead (m)")
    ax.set_ylabel("y, left (m)")
    ax.grid(visible=True, alpha=0.3)
    return ax


def _points(ax: Any, found: Detections) -> None:
    p, P_y = inv_scan_many(np.ascontiguousarray(found.y[:, :2]))
    cov = P_y @ found.cov[:, :2, :2] @ P_y.swapaxes(1, 2)
    radius: Array = found.attributes.get("radius_m", np.zeros(len(p)))
    turn = np.linspace(0.0, 2 * np.pi, 60)
    ax.plot(*p.T, "+", color="tab:red", markersize=5)
    for k in range(len(p)):
        if radius[k] > 0:
            x, y = p[k, :, None] + radius[k] * np.array([np.cos(turn), np.sin(turn)])
            ax.plot(x, y, color="tab:red", linewidth=1)
        ax.plot(*ellipse(p[k], cov[k], SIGMAS, 60).T, color="tab:orange", linewidth=1)
