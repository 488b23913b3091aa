"""The last frame as a picture: where landmarks were searched, where they were found, and the new ones."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from kalmark.report import Report
from kalmark.vision import opencv as cv2
from kalmark.vision.front_end import FrontEnd
from kalmark.vision.joint_expectation import PIXEL
from kalmark.vision.segments import LineFrontEnd
from kalmark.vision.selection import GATE, Selection

FOUND, MISSED, MATCH, NEW, REJECTED = (0, 200, 255), (60, 60, 255), (60, 220, 60), (255, 120, 0), (255, 0, 255)
COLOURS = {"new": NEW, "associated": MATCH}
FINE = 16  # parts of a pixel in which OpenCV draws


def overlay(front_end: FrontEnd | LineFrontEnd, report: Report, scale: int = 1) -> Any:
    """Return the last frame (H, W, 3), blue, green and red, `scale` times as large, with what was searched and found.

    Search ellipses of three sigmas in yellow where the landmark was found, in red where it was not; matches are green
    dots, those that the filter rejected magenta; new landmarks are blue circles.  Matches that agreed with the base of
    the one-point RANSAC were not searched in an ellipse.  Lines are drawn in the same colours, as expected and as
    measured.

    >>> found = km.landmarks.Homogeneous(prior_rho_per_m=0.5, sigma_rho_per_m=0.25)
    >>> eye = km.Mount(km.sensors.PinHole(), landmark=found, detector=km.vision.ActiveSearch())
    >>> slam = km.Slam(km.Robot("hand", km.motion.ConstantVelocity3D(), sensors={"eye": eye}))
    >>> image = np.random.default_rng(0).integers(0, 255, (24, 32), np.uint8).repeat(20, axis=0).repeat(20, axis=1)
    >>> report = slam.process(km.Frame(0.0, "hand", "eye", image))
    >>> km.vision.overlay(slam.state.sources["hand", "eye"], report, scale=2).shape
    (960, 1280, 3)
    """
    size = (front_end.image.shape[1] * scale, front_end.image.shape[0] * scale)
    picture = cv2.cvtColor(cv2.resize(front_end.image, size), cv2.COLOR_GRAY2BGR)

    def place(y: Any) -> tuple[int, int]:
        u, v = np.rint(((np.asarray(y) + 0.5) * scale - 0.5) * FINE).astype(int).tolist()
        return u, v

    if isinstance(front_end, LineFrontEnd):
        expected, found = front_end.expected, front_end.matches
        ends = zip(expected.e, found.of, strict=True) if expected is not None and found is not None else ()
        drawn = [(e, FOUND if number >= 0 else MISSED) for e, number in ends]
        drawn += [(report.y[o.index], COLOURS.get(o.outcome, REJECTED)) for o in report.observations]
        for segment, colour in drawn:
            cv2.line(picture, place(segment[:2]), place(segment[2:]), colour, scale, cv2.LINE_AA, 4)
        return picture
    _ellipses(picture, front_end.selection, place, scale)
    for o in report.observations:
        radius, filled = (4 * scale * FINE, 1) if o.outcome == "new" else (2 * scale * FINE, -1)
        colour = COLOURS.get(o.outcome, REJECTED)
        cv2.circle(picture, place(report.y[o.index, :PIXEL]), radius, colour, filled, cv2.LINE_AA, 4)
    return picture


def _ellipses(picture: Any, found: Selection | None, place: Callable[[Any], tuple[int, int]], scale: int
) -> None:  # fmt: skip
    """Draw where landmarks were searched."""
    for k in np.flatnonzero(np.isfinite(found.regions).all(axis=(1, 2))).tolist() if found is not None else ():
        assert found is not None
        spread, axes = np.linalg.eigh(found.regions[k])
        half = np.rint(np.sqrt(GATE * np.maximum(spread, 0.0)) * scale * FINE).astype(int).tolist()
        angle = math.degrees(math.atan2(axes[1, 0], axes[0, 0]))
        colour = FOUND if found.matched[k] else MISSED
        cv2.ellipse(picture, place(found.centres[k]), half, angle, 0, 360, colour, 1, cv2.LINE_AA, 4)
