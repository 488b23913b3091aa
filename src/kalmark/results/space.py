"""What the pictures of a run in space show at one step: places to draw, contours, frames of cameras, the box around."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from kalmark.events import Id
from kalmark.geometry.rotations import matrix
from kalmark.results.history import Array, Camera
from kalmark.results.picture import Picture, broken
from kalmark.results.shapes import EUCLIDEANS, LINE, Shapes, shapes

if TYPE_CHECKING:
    from kalmark.results.run import Run

EUCLIDEAN_COLOUR, OTHER_COLOUR, LINE_COLOUR = "#1f5fa8", "#c8412f", "#8c1c13"
CLEAR = 0.3  # a point whose sigma is a larger part of its distance does not widen the picture
FRAMES = 6  # cameras are drawn at so many poses of a path
BODY = np.array([[1.0, 0, 0], [-0.6, 0.5, 0], [-0.6, -0.5, 0], [1.0, 0, 0], [-0.6, 0, 0.45], [-0.3, 0, 0]])  # a dart
SQUARE = np.array([[-0.5, -0.5, 0], [0.5, -0.5, 0], [0.5, 0.5, 0], [-0.5, 0.5, 0], [-0.5, -0.5, 0]])


@dataclass(frozen=True, eq=False)
class Scene:
    """A run up to one of its steps: paths by robot, and the map as it was then, sorted by what is to be drawn.

    `paths` are poses (N, 7), `lines` and `truth` positions (N, 3), NaN in gaps of time; `ids` are those of the
    landmarks.
    """

    paths: dict[str, Array]
    lines: dict[str, Array]
    truth: dict[str, Array]
    colours: dict[str, str]
    pose_covariances: dict[str, Array]
    true_landmarks: dict[Id, Array]
    used: dict[str, Array]
    ids: tuple[Id, ...]
    shapes: Shapes
    cameras: tuple[Camera, ...]
    low: Array
    high: Array

    @classmethod
    def of(cls, run: Run, step: int | None = None) -> Scene:
        """Return what to draw of a run in space after a step, by default the last; the box is that of the whole run."""
        history, picture = run.history, Picture.of(run)
        if step is None:
            step, (means, covariances) = len(history.t_ns) - 1, run.landmarks.places()
            ids, kinds = tuple(run.landmarks.ids), tuple(run.landmarks.kinds)
        else:
            _, _, ids, means, covariances, kinds = history.map_at(step)
        until = {name: int((history.robot[: step + 1] == name).sum()) for name in picture.paths}
        low, high = _box(run, picture)
        return cls(
            {name: path[: until[name]] for name, path in picture.paths.items()},
            {name: broken(p[: until[name], :3], picture.stretches[name]) for name, p in picture.paths.items()},
            {name: broken(path, picture.stretches[name]) for name, path in picture.truth.items()},
            {name: picture.colour(name) for name in picture.paths},
            {name: history.pose_covariances[history.robot == name][: until[name]] for name in picture.paths},
            picture.landmarks,
            picture.used,
            ids,
            shapes(means, covariances, kinds or [""] * len(ids)),
            history.cameras,
            low,
            high,
        )

    @property
    def size(self) -> float:
        """The longest side of the box."""
        return float((self.high - self.low).max())

    def inside(self, lines: Array) -> Array:
        """Return polylines (..., 3) with NaN where they leave the box."""
        out = (lines < self.low) | (lines > self.high)
        return np.where(out.any(axis=-1, keepdims=True), np.nan, lines)

    def frames(self, robot: str) -> list[Array]:
        """Return what is drawn of a robot along its path: the pyramids of its cameras, or a dart if it has none."""
        path, body = self.paths[robot], self.body(robot)
        if len(path) == 0:
            return []
        at = np.unique(np.linspace(0, len(path) - 1, FRAMES).round().astype(int))
        return [_placed(pose, line) for pose in path[at] for line in body]

    def body(self, robot: str) -> list[Array]:
        """Return what is drawn of a robot as polylines (P, 3) in its own frame."""
        size = 0.03 * self.size
        mine = [_pyramid(camera, size) for camera in self.cameras if camera.robot == robot]
        return mine or [0.6 * size * BODY]

    def squares(self) -> list[Array]:
        """Return the tags as squares (5, 3)."""
        return squares(self.shapes.tags, self.size)


def squares(tags: Array, size: float) -> list[Array]:
    """Return tags (T, 7) as squares (5, 3) that can be seen in a scene of this size."""
    return [_placed(tag, 0.03 * size * SQUARE) for tag in tags]


def ellipsoids(means: Array, covariances: Array, sigmas: float = 3.0, points: int = 24) -> Array:
    """Return the three great circles (K, 3, points + 1, 3) of many 3-D Gaussians in their principal planes."""
    known = np.logical_and(np.isfinite(covariances).all(axis=(1, 2)), np.isfinite(means).all(axis=1))
    values, axes = np.linalg.eigh(np.where(known[:, None, None], covariances, 0.0))
    half = axes * np.sqrt(np.maximum(values, 0.0))[:, None, :]
    alpha = np.linspace(0.0, 2.0 * np.pi, points + 1)
    zero = np.zeros_like(alpha)
    circles = np.stack([[np.cos(alpha), np.sin(alpha), zero], [zero, np.cos(alpha), np.sin(alpha)],
                        [np.cos(alpha), zero, np.sin(alpha)]])  # fmt: skip
    out = means[:, None, None, :] + sigmas * np.einsum("kij,cjp->kcpi", half, circles)
    return np.where(known[:, None, None, None], out, np.nan)


def joined(lines: Array | list[Array]) -> Array:
    """Return polylines (P, 3) as one (N, 3) that is broken by NaN between them."""
    parts = [part for line in lines for part in (line, np.full((1, 3), np.nan))]
    return np.concatenate(parts) if parts else np.empty((0, 3))


def _placed(pose: Array, points: Array) -> Array:
    return points @ matrix(np.ascontiguousarray(pose[3:7])).T + pose[:3]


def _pyramid(camera: Camera, depth: float) -> Array:
    """Return a camera's pyramid, `depth` long, as one polyline in its robot's frame that passes all its edges."""
    a, b, c, d = depth * camera.corners
    top = np.zeros(3)
    return _placed(camera.mount, np.array([a, b, top, a, d, top, c, d, c, b]))


def _box(run: Run, picture: Picture) -> tuple[Array, Array]:
    """Return the corners of what is to be seen: paths, their ends' contours, truth, landmarks whose place is clear."""
    means, covariances = run.landmarks.places()
    path = np.concatenate([p[:, :3] for p in picture.paths.values()] or [np.empty((0, 3))])
    drawn, _, _, group = shapes(means, covariances, run.landmarks.kinds)
    middle = path.mean(axis=0) if len(path) else np.zeros(3)
    known = np.logical_and(np.isfinite(drawn.covariances).all(axis=(1, 2)), np.isfinite(drawn.means).all(axis=1))
    sigma = np.sqrt(np.einsum("kii->ki", drawn.covariances).max(axis=1, initial=0.0))
    distance = np.linalg.norm(np.where(known[:, None], drawn.means, np.inf) - middle, axis=1)
    clear = np.logical_and(known, np.logical_or(group == EUCLIDEANS, sigma < CLEAR * distance))
    true = [l.reshape(2, 3) if len(l) == LINE else l[None, :3] for l in picture.landmarks.values()]
    limit = 0.1 * (float(np.ptp(path, axis=0).max()) if len(path) else 10.0)
    reach, ends = np.minimum(3 * sigma[clear], limit)[:, None], _ends(run, picture, limit)
    seen = [path, drawn.means[clear] - reach, drawn.means[clear] + reach, ends, *picture.truth.values(), *true]
    points = np.concatenate([part[np.isfinite(part).all(axis=1)] for part in seen])
    if len(points) == 0:
        return -np.ones(3), np.ones(3)
    low, high = points.min(axis=0), points.max(axis=0)
    pad = max(0.04 * float((high - low).max()), 0.2)
    return low - pad, high + pad


def _ends(run: Run, picture: Picture, limit: float) -> Array:
    """Return the corners (2 R, 3) of the robots' last positions, 3 sigma around them, but not more than `limit`."""
    out = [np.empty((0, 3))]
    for name, path in picture.paths.items():
        if len(path):
            P = run.history.pose_covariances[run.history.robot == name][-1]
            reach = np.fmin(3 * np.sqrt(np.maximum(np.diag(P)[:3], 0.0)), limit)
            out.append(np.array([path[-1, :3] - reach, path[-1, :3] + reach]))
    return np.concatenate(out)
