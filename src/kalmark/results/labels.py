"""Names beside points of a picture, placed at each drawing where they meet neither another name nor another point."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.text import Annotation
from numpy.typing import ArrayLike

from kalmark.arrays import Array

__all__ = ["name_points"]

GAP = 3.0  # points of paper between a point and its name
SIDES = np.array([[0, 1], [0, -1], [1, 0], [-1, 0], [1, 1], [-1, 1], [1, -1], [-1, -1]], dtype=np.float64)
DIGITS = 3  # of a pixel's area: what covers less is free, so that rounding does not choose between free places
FARTHER = (1.0, 2.0)  # times that distance of a name; farther only where the near places are taken


def name_points(axes: Axes, points: ArrayLike, names: Iterable[object], gap: float = GAP, **style: Any) -> None:
    """Write names beside points (N, 2) of axes, or (N, 3) of axes in space, `gap` points of paper away.

    `style` is that of a text of matplotlib.
    All names of the axes are placed at each drawing, so they do not meet in another size, limits or view either.

    >>> from matplotlib.figure import Figure
    >>> from kalmark.results.labels import name_points
    >>> axes = Figure().add_subplot()
    >>> name_points(axes, [[0.5, 0.5], [0.5, 0.51]], ["a", "b"])
    >>> [text.get_text() for text in axes.texts]
    ['a', 'b']
    """
    for point, name in zip(np.asarray(points, dtype=np.float64), names, strict=True):
        if np.isfinite(point).all():
            axes.add_artist(_Label(str(name), point, gap, **style))


class _Label(Annotation):
    """A name; the first one of its axes places all of them."""

    def __init__(self, name: str, point: Array, gap: float, **style: Any) -> None:
        middle: dict[str, Any] = {"ha": "center", "va": "center", "annotation_clip": False}
        super().__init__(name, tuple(point[:2]), (0, 0), textcoords="offset points", **middle | style)
        self.point, self.gap = point, gap

    def draw(self, renderer: Any) -> None:
        texts = self.axes.texts if self.axes else ()
        labels = [text for text in texts if isinstance(text, _Label)]
        if self is labels[0]:
            _place(labels, renderer)
        super().draw(renderer)


def _place(labels: list[_Label], renderer: Any) -> None:
    """Give each name the place that covers least of the other points, of the names before it and of the outside."""
    axes: Any = labels[0].axes
    pixels = renderer.points_to_pixels(1.0)
    for each in labels:
        each.set_position((0, 0))
        if axes.name == "3d":
            x, y, _, w = axes.get_proj() @ [*each.point, 1.0]
            each.xy = float(x / w), float(y / w)
    at = axes.transData.transform([each.xy for each in labels])
    half = np.array([np.divide(each.get_window_extent(renderer).size, 2) for each in labels])
    frame, mark = np.array(axes.bbox.extents)[None], 0.5 * GAP * pixels
    taken = np.hstack([at - mark, at + mark])  # rectangles: left, bottom, right, top
    for k, each in enumerate(labels):
        offsets = np.vstack([times * SIDES * (half[k] + each.gap * pixels) for times in FARTHER])
        boxes = np.hstack([at[k] + offsets - half[k], at[k] + offsets + half[k]])
        inside = _common(boxes, frame)[:, 0]
        covered = _common(boxes, np.delete(taken, k, axis=0)).sum(axis=1) + (4 * half[k].prod() - inside)
        best = int(covered.round(DIGITS).argmin())
        each.set_position(tuple(offsets[best] / pixels))
        taken = np.vstack([taken, boxes[best]])


def _common(a: Array, b: Array) -> Array:
    """Return the areas (K, N) that rectangles (K, 4) and (N, 4) have in common."""
    sides = np.minimum(a[:, None, 2:], b[None, :, 2:]) - np.maximum(a[:, None, :2], b[None, :, :2])
    areas: Array = np.maximum(sides, 0.0).prod(axis=2)
    return areas
