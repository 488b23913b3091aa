"""Draw docs/images/scans.png: KALMARK_DATA=... python docs/images/scans.py."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")

import matplotlib.pyplot as plt
import numpy as np

import kalmark as km

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "tests"))
from laser_worlds import LaserWorld  # noqa: E402

ANGLES = np.radians(np.arange(361) / 2 - 90)
ROOM = np.array(
    [[-2.0, -4, 7, -4], [7, -4, 7, 1], [7, 1, 9, 1], [9, 1, 9, 5], [9, 5, -2, 5], [1, -3, 2, -1.5], [2, -1.5, 3, -3]]
)
POSTS = np.array([[4.0, 1.0, 0.05, 9], [5.5, -1.2, 0.05, 9], [2.0, 3.5, 0.05, 9], [3.0, -0.3, 0.2, 1]])


def main() -> None:
    """Write the picture: trees of Victoria Park, and three ways to look at a simulated room."""
    log = km.open_log(Path(os.environ["KALMARK_DATA"]) / "victoria_park", detections="laser")
    park = [event for event in log if isinstance(event, km.Scan)][2500].y
    r, light = LaserWorld(POSTS, ROOM).scan(ANGLES, 0.03, np.random.default_rng(1))
    trunks = km.detect.Trunks(range_min_m=1.5, range_max_m=75.0, sigma_position_m=0.1, beams=1)
    room = {"range_max_m": 50.0, "sigma_range_m": 0.03}
    found = {
        "Victoria Park: Trunks": (*park.T, None, trunks, 75.0),
        "a room: Walls": (r, ANGLES, light, km.detect.Walls(**room), 50.0),
        "the same: Corners": (r, ANGLES, light, km.detect.Corners(**room), 50.0),
        "the same: Reflectors and Trunks": (
            r,
            ANGLES,
            light,
            km.detect.Reflectors(intensity_min=5, radius_m=0.05, **room),
            50.0,
        ),
    }
    figure, axes = plt.subplots(2, 2, figsize=(11, 11), layout="constrained")
    for ax, (title, (ranges, angles, intensities, detector, far)) in zip(axes.flat, found.items(), strict=True):
        km.detect.draw_scan(ranges, angles, detector.detect(ranges, angles, intensities), far, ax)
        ax.set_title(title)
    trunk = km.detect.Trunks(radius_min_m=0.1, **room).detect(r, ANGLES)
    km.detect.draw_scan(r, ANGLES, trunk, 50.0, axes[1, 1])
    figure.savefig(Path(__file__).with_suffix(".png"), dpi=70)


if __name__ == "__main__":
    main()
