"""Simulated scans of round, straight and shining things, with what is really there."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

FAR_M = 81.91  # the reading of a beam without return
ANGLES = np.radians(np.arange(361) / 2 - 90)
SIGMA_M = 0.03


@dataclass
class LaserWorld:
    """Circles (x, y, radius, intensity) and walls (x1, y1, x2, y2), seen by a laser at the origin."""

    circles: np.ndarray = field(default_factory=lambda: np.zeros((0, 4)))
    walls: np.ndarray = field(default_factory=lambda: np.zeros((0, 4)))

    def scan(self, angles: np.ndarray, sigma_m: float, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Return ranges and intensities of the beams at these angles."""
        u = np.stack([np.cos(angles), np.sin(angles)], axis=1)
        r, light = np.full(len(angles), FAR_M), np.zeros(len(angles))
        for x, y, radius, intensity in self.circles:
            along, across = u @ [x, y], u[:, 0] * y - u[:, 1] * x
            hit = (np.abs(across) < radius) & (along > 0)
            depth = along - np.sqrt(np.maximum(radius**2 - across**2, 0.0))
            nearer = hit & (depth < r)
            r[nearer], light[nearer] = depth[nearer], intensity
        for x1, y1, x2, y2 in self.walls:
            dx, dy = x2 - x1, y2 - y1
            with np.errstate(divide="ignore", invalid="ignore"):
                cross = u[:, 0] * dy - u[:, 1] * dx
                t, s = (x1 * dy - y1 * dx) / cross, (x1 * u[:, 1] - y1 * u[:, 0]) / cross
            hit = (t > 0) & (s >= 0) & (s <= 1) & (t < r)
            r[hit], light[hit] = t[hit], 0.0
        back = r < FAR_M
        r[back] += sigma_m * random.standard_normal(back.sum())
        return r, light


def spread(random: np.random.Generator, count: int, near_m: float, far_m: float, fov_rad: float) -> np.ndarray:
    """Return points (count, 2) of which none hides another: each in a sector of its own, off its borders."""
    bearings = (np.arange(count) + random.uniform(0.3, 0.7, count)) / count * fov_rad - fov_rad / 2
    d = random.uniform(near_m, far_m, count)
    return np.stack([d * np.cos(bearings), d * np.sin(bearings)], axis=1)
