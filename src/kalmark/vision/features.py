"""Starts of new landmarks in an image: the best corner of each cell in which there is none.  Shi and Tomasi 1994."""

from __future__ import annotations

from typing import Any

import numpy as np

from kalmark.arrays import Array
from kalmark.vision import opencv as cv2

BLOCK = 5  # px: surroundings of a corner, small so that it is in the middle of its patch
FORGIVEN = 15  # frames until a cell in which no corner was found is looked at again


class Cells:
    """Cells of an image, `across` of its longer side, shifted at each use; those without a feature are recorded."""

    failed: dict[tuple[int, int], int]

    def __init__(self, across: int, half: int, contrast: float) -> None:
        self.across, self.half, self.contrast, self.failed = across, half, contrast, {}

    def corners(
        self, image: Any, taken: Array, count: int, margin: int, frame: int, random: np.random.Generator
    ) -> Array:  # fmt: skip
        """Return at most `count` corners (n, 2) in cells, chosen at random, in which none of `taken` (K, 2) is."""
        height, width = image.shape
        size = max(width, height) / self.across
        shift = random.uniform(0.0, size, 2) if count else np.zeros(2)
        columns, rows = int(width // size) + 2, int(height // size) + 2
        occupied = {tuple(cell) for cell in ((taken + shift) // size).astype(np.int64).tolist()}
        found: list[tuple[float, float]] = []
        for cell in random.permutation(columns * rows).tolist():
            j, i = divmod(cell, columns)
            if len(found) >= count:
                break
            left, top = max(round(i * size - shift[0]), margin), max(round(j * size - shift[1]), margin)
            right = min(round((i + 1) * size - shift[0]), width - margin)
            bottom = min(round((j + 1) * size - shift[1]), height - margin)
            place = int((left + right) // size), int((top + bottom) // size)  # twice as fine, does not shift
            if (i, j) in occupied or min(right - left, bottom - top) < size / 2:
                continue
            if frame - self.failed.get(place, -FORGIVEN) < FORGIVEN:
                continue
            corner = self._best(image, left, top, right, bottom)
            if corner is None:
                self.failed[place] = frame
                continue
            near = np.abs(taken - corner).max(axis=1).min(initial=np.inf) if len(taken) else np.inf
            if near > 2 * self.half:
                found.append(corner)
        return np.array(found, dtype=np.float64).reshape(-1, 2)

    def _best(self, image: Any, left: int, top: int, right: int, bottom: int) -> tuple[float, float] | None:
        """Return the pixel of a part of the image whose surroundings differ most from any near it."""
        h = self.half
        part = image[top - h : bottom + h, left - h : right + h]
        response = responses(part)[h:-h, h:-h]
        j, i = divmod(int(response.argmax()), response.shape[1])
        if not response[j, i] >= self.contrast**2:
            return None
        return float(left + i), float(top + j)


def responses(image: Any) -> Any:
    """Return for each pixel of an image (H, W) the mean square of the gradient around it, where that is least.

    Of all directions, over a square of `BLOCK` pixels: in (grey values a pixel)^2.
    """
    return cv2.cornerMinEigenVal(image, BLOCK, ksize=3) * (255.0**2 / 4.0)  # OpenCV's is 4 / 255^2 times that
