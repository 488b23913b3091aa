"""What the page of a run in space shows: the map as it grew, the robots' bodies, and what their cameras saw."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from kalmark.results.history import Array, Camera, MapSnapshot
from kalmark.results.images import Image, Sighting, colour_of, images, steps_of
from kalmark.results.shapes import LINE, shapes
from kalmark.results.space import Scene, joined, squares
from kalmark.results.thinned import gaussians, rounded, thin, xy

if TYPE_CHECKING:
    from kalmark.results.run import Run

LANDMARKS = 40_000  # in all the maps of a page together
GROUPS = 3  # Euclidean, others, lines


def space_series(run: Run, t: Array) -> dict[str, Any]:
    """Return maps, truth, bodies and cameras of a run in space; `t` (S,) are the times of its steps in seconds."""
    scene = Scene.of(run)
    true = scene.true_landmarks
    points = {i: l[:3] for i, l in true.items() if len(l) != LINE}
    maps = _fewer(run.history.maps)
    return {
        "space": {"low": rounded(scene.low, 3), "high": rounded(scene.high, 3)},
        "maps": [_map(m, float(t[m.step]), scene.size) for m in maps],
        "trueLandmarks": {"id": [str(i) for i in points], **xy(np.array(list(points.values())).reshape(-1, 3))},
        "trueLines": xy(joined([l.reshape(2, 3) for l in true.values() if len(l) == LINE])),
        "fixes": {},
        "usedFixes": {robot: xy(fixes[thin(len(fixes))]) for robot, fixes in scene.used.items()},
        "bodies": {robot: xy(joined(scene.body(robot))) for robot in scene.paths},
        "cameras": [_camera(run, camera, maps, t) for camera in run.history.cameras],
    }


def _fewer(maps: tuple[MapSnapshot, ...]) -> list[MapSnapshot]:
    """Return maps evenly spread, the last among them, of so many landmarks that the page stays of a size to open."""
    total = sum(len(m.ids) for m in maps)
    stride = max(1, -(-total // LANDMARKS))
    return [m for k, m in enumerate(reversed(maps)) if k % stride == 0][::-1]


def _map(m: MapSnapshot, t_s: float, size: float) -> dict[str, Any]:
    """Return a map: all points, in each the endpoints of lines last, with the group that each is drawn in."""
    drawn = shapes(m.means, m.covariances, m.kinds)
    points = drawn.points
    return {
        "t": round(t_s, 3),
        "id": [str(m.ids[row]) for row in points.row],
        "group": drawn.group.tolist(),
        "count": len(m.ids),
        "lines": xy(joined(list(drawn.lines))),
        "tags": xy(joined(squares(drawn.tags, size))),
        **gaussians(points.means, points.covariances),
    }


def _camera(run: Run, camera: Camera, maps: list[MapSnapshot], t: Array) -> dict[str, Any]:
    """Return what a camera saw last at each of the maps: `frames` are indices of its `scans`, None before the first."""
    steps = steps_of(run.history, camera)
    last = np.searchsorted(steps, [m.step for m in maps], side="right") - 1
    used = np.unique(last[last >= 0])
    return {
        "name": f"{camera.robot} · {camera.sensor}",
        "size": [float(side) for side in camera.size],
        "scans": [_scan(run, camera, int(steps[k]), t) for k in used],
        "frames": [int(np.searchsorted(used, k)) if k >= 0 else None for k in last],
    }


def _scan(run: Run, camera: Camera, step: int, t: Array) -> dict[str, Any]:
    return {"t": round(float(t[step]), 3), "images": [_image(image) for image in images(run.history, camera, step)]}


def _image(image: Image) -> dict[str, Any]:
    return {"side": image.side, "seen": [_seen(sighting) for sighting in image.sightings]}


def _seen(s: Sighting) -> dict[str, Any]:
    colour, meaning = colour_of(s)
    out: dict[str, Any] = {"name": s.name, "outcome": s.outcome, "y": [rounded(p, 2) for p in s.measured]}
    if np.isfinite(s.expected).all():
        out |= {"e": [rounded(p, 2) for p in s.expected], "colour": colour, "meaning": meaning}
    if np.isfinite(s.Z).all():
        out["Z"] = rounded(np.array([s.Z[0, 0], s.Z[0, 1], s.Z[1, 1]]), 3)
    return out
