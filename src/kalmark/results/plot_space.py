"""``map.png`` of a run in space: a view from above the side and one from the top, in perspective and in plan."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from kalmark.results.history import Array
from kalmark.results.picture import FIX_COLOUR, INK, TRUTH_COLOUR, headline
from kalmark.results.shapes import LINE, LINES, TAG
from kalmark.results.space import EUCLIDEAN_COLOUR, LINE_COLOUR, OTHER_COLOUR, Scene, ellipsoids, joined, squares

if TYPE_CHECKING:
    from kalmark.results.run import Run

VIEWS = {"normal": (28.0, -55.0), "top": (90.0, -90.0), "side": (0.0, -90.0), "front": (0.0, 0.0)}
GROUPS = (
    (EUCLIDEAN_COLOUR, r"Euclidean landmarks, $3\sigma$"),
    (OTHER_COLOUR, r"other landmarks, $3\sigma$"),
    (LINE_COLOUR, r"lines, $3\sigma$ of their ends"),
)
CROWD = 100  # with more landmarks than this, everything about them is drawn thinner
FEW = 40  # landmarks that are labelled
GROUND, SHADOW, TICK, LABEL = "#d7dbe1", "#c3c8d0", "#7a818c", "#1e4d2b"
POSE_COLOUR = "#d62f2f"


def draw_map(run: Run, step: int | None = None, view: str | tuple[float, float] = "normal") -> Figure:
    """Return the figure of a run in space after a step, by default the last, axes in metres in the map's frame.

    `view` is where the left half looks from: "normal", "top", "side", "front" or (elevation, azimuth) in degrees.
    """
    scene = Scene.of(run, step)
    projection = Projection.of(scene, view)
    shapes = [np.ptp(projection(corners(scene.low, scene.high)), axis=0), (scene.high - scene.low)[:2]]
    left, right = (float(np.clip(span[0] / span[1], 0.5, 4.0)) for span in shapes)
    tall = float(np.clip(13.6 / (left + right), 4.0, 8.5))
    figure = Figure(figsize=(15.0, tall + 1.9), facecolor="white")
    height, share = figure.get_figheight(), left / (left + right)
    title, figures = headline(run)
    figure.text(0.02, 1 - 0.45 / height, title, fontsize=14, fontweight="bold", color=INK)
    figure.text(0.02, 1 - 0.75 / height, " · ".join(figures), fontsize=10, color="#555b66")
    at, part = 0.95 / height, tall / height
    draw_space(figure.add_axes((0.01, at - 0.3 / height, 0.9 * share, part + 0.3 / height)), scene, projection)
    draw_top(figure.add_axes((0.065 + 0.9 * share, at, 0.9 * (1 - share) + 0.02, part)), scene)
    figure.legend(handles=legend(scene), loc="lower center", ncols=9, columnspacing=1.4, frameon=False, fontsize=10)
    return figure


@dataclass(frozen=True, eq=False)
class Projection:
    """A view of space on paper: `axes` (3, 3) are right, up and towards the eye, which is `distance` from `middle`."""

    axes: Array
    middle: Array
    distance: float

    @classmethod
    def of(cls, scene: Scene, view: str | tuple[float, float] = "normal") -> Projection:
        """Return the view from (elevation, azimuth), degrees: without perspective from the top and the sides."""
        elevation, azimuth = np.radians(VIEWS[view] if isinstance(view, str) else view)
        eye = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
        right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
        far = np.inf if isinstance(view, str) and view != "normal" else 2.5 * np.linalg.norm(scene.high - scene.low)
        return cls(np.array([right, np.cross(eye, right), eye]), (scene.low + scene.high) / 2, float(far))

    def __call__(self, points: Array) -> Array:
        """Return points (..., 3) on paper (..., 2)."""
        q = (points - self.middle) @ self.axes.T
        return q[..., :2] / (1.0 - q[..., 2:] / self.distance)


def corners(low: Array, high: Array) -> Array:
    """Return the corners (8, 3) of a box."""
    return np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])


def draw_space(axes: Axes, scene: Scene, projection: Projection) -> None:
    """Draw a scene in perspective above a grid on the ground, with the shadows of paths and of few landmarks."""
    axes.set_axis_off()
    axes.set_aspect("equal", adjustable="box")
    _ground(axes, scene, projection)
    floor = ground(scene)
    shadows = [np.column_stack([line[:, :2], np.full(len(line), floor)]) for line in scene.lines.values()]
    if len(scene.ids) <= CROWD:
        standing = scene.shapes.points.means[scene.shapes.group != LINES]
        shadows += [np.array([point, [*point[:2], floor]]) for point in standing]
    _line(axes, projection(scene.inside(joined(shadows))), color=SHADOW, linewidth=0.7, zorder=1)
    for line, style in _strokes(scene):
        _line(axes, projection(scene.inside(line)), **style)
    if len(scene.ids) <= FEW:
        for name, point in _labels(scene, np.array([0.0, 0.0, 0.012 * scene.size])):
            x, y = projection(point)
            axes.text(x, y, name, color=LABEL, fontsize=7, ha="center", va="bottom", zorder=9)
    edges = projection(corners(scene.low, scene.high))
    low, high = edges.min(axis=0), edges.max(axis=0)
    pad = 0.04 * (high - low).max()
    axes.set_xlim(low[0] - pad, high[0] + pad)
    axes.set_ylim(low[1] - pad, high[1] + pad)


def _line(axes: Axes, points: Array, **style: Any) -> None:
    axes.plot(points[:, 0], points[:, 1], clip_on=False, **style)


def draw_top(axes: Axes, scene: Scene) -> None:
    """Draw a scene as seen from above: x to the right, y up."""
    axes.set_xlim(scene.low[0], scene.high[0])
    axes.set_ylim(scene.low[1], scene.high[1])
    axes.set_aspect("equal", adjustable="box")
    axes.set_xlabel("x (m)", color=INK)
    axes.set_ylabel("y (m)", color=INK)
    axes.grid(True, color="#e6e8ec", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.tick_params(colors="#555b66", labelsize=9)
    for side in axes.spines.values():
        side.set_color("#c4c8cf")
    for line, style in _strokes(scene):
        axes.plot(line[:, 0], line[:, 1], **style)
    if len(scene.ids) <= FEW:
        for name, point in _labels(scene, np.array([0.0, 0.01 * scene.size, 0.0])):
            axes.text(point[0], point[1], name, color=LABEL, fontsize=7, ha="center", va="bottom", zorder=9)


def _strokes(scene: Scene) -> list[tuple[Array, dict[str, Any]]]:
    """Return every polyline and set of marks (N, 3) with the style it is drawn in."""
    crowded = len(scene.ids) > CROWD
    out: list[tuple[Array, dict[str, Any]]] = []
    for fixes in scene.used.values():
        out.append((_high(fixes), _marks("x", FIX_COLOUR, 3.5, 3)))
    for path in scene.truth.values():
        out.append((path, {"color": TRUTH_COLOUR, "linewidth": 2.4, "alpha": 0.6, "zorder": 2}))
    true = list(scene.true_landmarks.values())
    points = np.array([l[:3] for l in true if len(l) != LINE]).reshape(-1, 3)
    out.append((points, _marks("+", TRUTH_COLOUR, 4 if crowded else 7, 2)))
    tags = squares(np.array([l for l in true if len(l) == TAG]).reshape(-1, TAG), scene.size)
    lines = joined([*(l.reshape(2, 3) for l in true if len(l) == LINE), *tags])
    out.append((lines, {"color": TRUTH_COLOUR, "linewidth": 2.0, "alpha": 0.6, "zorder": 2}))
    out += _landmark_strokes(scene, crowded)
    for robot, path in scene.paths.items():
        out += _robot_strokes(scene, robot, path)
    return out


def _landmark_strokes(scene: Scene, crowded: bool) -> list[tuple[Array, dict[str, Any]]]:
    points, out = scene.shapes.points, []
    out.append((joined(list(scene.shapes.lines)), {"color": LINE_COLOUR, "linewidth": 1.8, "zorder": 5}))
    out.append((joined(scene.squares()), {"color": EUCLIDEAN_COLOUR, "linewidth": 1.4, "zorder": 5}))
    for group, (colour, _) in enumerate(GROUPS):
        mine = scene.shapes.group == group
        circles = ellipsoids(points.means[mine], points.covariances[mine]).reshape(-1, 25, 3)
        thin = {"linewidth": 0.35 if crowded else 0.7, "alpha": 0.4 if crowded else 0.55, "zorder": 4}
        out.append((joined(list(circles)), {"color": colour, **thin}))
        out.append((points.means[mine], _marks(".", colour, 2 if crowded else 4, 5)))
    return out


def _robot_strokes(scene: Scene, robot: str, path: Array) -> list[tuple[Array, dict[str, Any]]]:
    if len(path) == 0:
        return []
    colour = scene.colours[robot]
    contour = ellipsoids(path[-1:, :3], scene.pose_covariances[robot][-1:, :3, :3])[0]
    frames = scene.frames(robot)
    return [
        (scene.lines[robot], {"color": colour, "linewidth": 1.3, "zorder": 6}),
        (joined(frames), {"color": colour, "linewidth": 0.8, "alpha": 0.8, "zorder": 6}),
        (joined(list(contour)), {"color": POSE_COLOUR, "linewidth": 0.8, "zorder": 7}),
        (path[:1, :3], {**_marks("o", colour, 6, 7), "markerfacecolor": "white"}),
        (path[-1:, :3], {**_marks("o", colour, 6, 8), "markeredgecolor": "white"}),
    ]


def _marks(marker: str, colour: str, size: float, zorder: float) -> dict[str, Any]:
    return {"linestyle": "", "marker": marker, "color": colour, "markersize": size, "zorder": zorder}


def _high(points: Array) -> Array:
    """Return points (N, 2 or 3) in space."""
    return points if points.shape[1] == 3 else np.column_stack([points, np.zeros(len(points))])


def _labels(scene: Scene, above: Array) -> list[tuple[str, Array]]:
    points = scene.shapes.points
    placed = [(str(scene.ids[row]), mean + above) for row, mean in zip(points.row, points.means, strict=True)]
    return [(name, p) for name, p in placed[: len(scene.ids)] if ((p >= scene.low) & (p <= scene.high)).all()]


def spacing(size: float) -> float:
    """Return the distance of the lines of a grid: 2 m, or 1, 2 or 5 times a power of ten that gives some ten lines."""
    if 8.0 <= size <= 40.0:
        return 2.0
    power = 10.0 ** np.floor(np.log10(size / 10.0))
    return float(power * next(m for m in (1, 2, 5, 10) if size / (m * power) <= 14))


def ground(scene: Scene) -> float:
    """Return the height of the ground: 0, or the lowest there is."""
    return 0.0 if scene.low[2] <= 0.0 <= scene.high[2] else float(scene.low[2])


def _ground(axes: Axes, scene: Scene, projection: Projection) -> None:
    """Draw the grid on the ground with ticks at the edges that face the eye, and a scale of heights at a corner."""
    low, high, eye, z = scene.low, scene.high, projection.axes[2], ground(scene)
    step = spacing(float((high - low)[:2].max()))
    xs, ys = (np.arange(np.ceil(low[i] / step), np.floor(high[i] / step) + 1) * step for i in (0, 1))
    lines = [np.array([[x, low[1], z], [x, high[1], z]]) for x in xs]
    lines += [np.array([[low[0], y, z], [high[0], y, z]]) for y in ys]
    _line(axes, projection(joined(lines)), color=GROUND, linewidth=0.7, zorder=0)
    near = np.where(eye[:2] > 0, high[:2], low[:2])
    away = 0.035 * scene.size * np.where(eye[:2] > 0, 1.0, -1.0)
    skip = max(1, -(-max(len(xs), len(ys)) // 8))
    ticks = [(f"{x + 0.0:g}", [x, near[1] + away[1], z]) for x in xs[::skip]]
    ticks += [(f"{y + 0.0:g}", [near[0] + away[0], y, z]) for y in ys[::skip]]
    middle = (low + high) / 2
    ticks.append(("x (m)", [middle[0], near[1] + 2.6 * away[1], z]))
    ticks.append(("y (m)", [near[0] + 2.6 * away[0], middle[1], z]))
    ticks += _heights(axes, scene, projection)
    for text, point in ticks:
        u, v = projection(np.array(point))
        axes.text(u, v, text, color=TICK, fontsize=8, ha="center", va="center", zorder=1)


def _heights(axes: Axes, scene: Scene, projection: Projection) -> list[tuple[str, Any]]:
    """Draw the scale of heights at the corner that is leftmost on paper and return its ticks."""
    low, high = scene.low, scene.high
    if abs(projection.axes[2, 2]) > 0.99:
        return []
    edges = corners(low, high)
    x, y, _ = edges[np.argmin(projection(edges)[:, 0])]
    step = spacing(float(3.0 * max(high[2] - low[2], 0.2 * scene.size)))
    _line(axes, projection(np.array([[x, y, low[2]], [x, y, high[2]]])), color="#b4bac4", linewidth=0.8, zorder=0)
    beside = -0.03 * scene.size * projection.axes[0]
    zs = np.arange(np.ceil(low[2] / step), np.floor(high[2] / step) + 1) * step
    ticks = [(f"{z + 0.0:g}", np.array([x, y, z]) + beside) for z in zs]
    return [*ticks, ("z (m)", np.array([x, y, high[2] + 0.03 * scene.size]))]


def legend(scene: Scene) -> list[Line2D]:
    """Return the entries of a scene's legend."""
    several = len(scene.paths) > 1
    out = [Line2D([], [], color=scene.colours[r], label=r if several else "estimated path") for r in scene.paths]
    sizes = {len(l) for l in scene.true_landmarks.values()}
    if scene.truth:
        label = "true path, true lines" if LINE in sizes else "true path"
        out.append(Line2D([], [], color=TRUTH_COLOUR, linewidth=2.4, alpha=0.6, label=label))
    if scene.used:
        out.append(Line2D([], [], **_marks("x", FIX_COLOUR, 5, 1), label="fixes used"))
    if sizes - {LINE}:
        out.append(Line2D([], [], **_marks("+", TRUTH_COLOUR, 7, 1), label="true landmarks"))
    if LINE in sizes and not scene.truth:
        out.append(Line2D([], [], color=TRUTH_COLOUR, linewidth=2.0, alpha=0.6, label="true lines"))
    for group, (colour, label) in enumerate(GROUPS):
        if (scene.shapes.group == group).any():
            out.append(Line2D([], [], color=colour, marker=".", label=label))
    if any(len(path) for path in scene.paths.values()):
        out.append(Line2D([], [], **{**_marks("o", INK, 6, 1), "markerfacecolor": "white"}, label="start"))
        out.append(Line2D([], [], **_marks("o", INK, 6, 1), label="end"))
        out.append(Line2D([], [], color=POSE_COLOUR, linewidth=0.8, label=r"$3\sigma$ of the end"))
    return out
