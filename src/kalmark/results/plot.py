"""``map.png``: paths, landmarks with their 3-sigma contours, the truth behind them; in space a view and a plan."""

from __future__ import annotations

import textwrap
import warnings
from dataclasses import dataclass
from functools import partial
from os import PathLike
from pathlib import Path as FilePath
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.markers import MarkerStyle
from matplotlib.path import Path
from matplotlib.transforms import Affine2D

from kalmark.arrays import Array
from kalmark.files import replace_file
from kalmark.results.evaluate import headline, summary_of
from kalmark.results.landmark_table import LINES, TAG
from kalmark.results.recording import Recording
from kalmark.results.scene import FIX_COLOUR, INK, TRUTH_COLOUR, Scene, break_path, contours, join_polylines, squares
from kalmark.results.verdict_text import alarm

VIEWS = {"normal": (28.0, -55.0), "top": (90.0, -90.0), "side": (0.0, -90.0), "front": (0.0, 0.0)}
LANDMARK_COLOUR = "#d2691e"
EUCLIDEAN_COLOUR, OTHER_COLOUR, LINE_COLOUR = "#1f5fa8", "#c8412f", "#8c1c13"
GROUPS = {  # of landmarks that are drawn alike, by the dimensions of the scene
    2: (
        *((LANDMARK_COLOUR, "estimated landmarks, 3σ {}"),) * 2,
        (LINE_COLOUR, "walls, 3σ of their ends {}"),
    ),
    3: (
        (EUCLIDEAN_COLOUR, "Euclidean landmarks, 3σ {}"),
        (OTHER_COLOUR, "landmarks that are not Euclidean, 3σ {}"),
        (LINE_COLOUR, "lines, 3σ of their ends {}"),
    ),
}
LONG = 3000  # a path of more steps than this is drawn thinner
CROWD = 100  # with more landmarks than this, everything about them is drawn thinner
FEW = 40  # landmarks of space that are labelled
GROUND, SHADOW, TICK, SOFT = "#d7dbe1", "#c3c8d0", "#7a818c", "#555b66"
NAMED: dict[str, Any] = {"color": "#1e4d2b", "fontsize": 7, "ha": "center", "va": "bottom", "zorder": 9}
POSE_COLOUR = "#d62f2f"
ALARM_COLOUR = "#b3261e"
KNOWN_COLOUR = "#2f7d4f"
INCHES = {2: 8.3, 3: 13.6}  # what the panels are wide together
LINE_INCHES, CHARACTERS = 0.17, 13  # the height of a line of text, and how many fit an inch


class Stroke(NamedTuple):
    """Polylines or marks: points (N, d), NaN between lines, their style, and the label and style in the legend."""

    points: Array
    style: dict[str, Any]
    label: str = ""
    sample: dict[str, Any] | None = None


def save_figure(figure: Figure, path: str | PathLike[str], dpi: float = 130, rim: bool = True) -> None:
    """Write a figure as a PNG, completely or not, with a narrow rim around the drawing, or as it is.

    matplotlib draws twice to find that box, which only a figure with a layout of its own needs.
    """
    figure.set_dpi(dpi)
    FigureCanvasAgg(figure)
    laid_out = figure.get_layout_engine() is not None
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph .* missing")  # of a name in a script that the font does not have
        box = None if not rim else "tight" if laid_out else figure.get_tightbbox().padded(0.15)
        style: dict[str, Any] = {"bbox_inches": box, "pad_inches": 0.15, "pil_kwargs": {"compress_level": 3}}
        replace_file(FilePath(path), partial(figure.savefig, dpi=dpi, format="png", **style))


def save_map(run: Recording, path: str | PathLike[str], world: bool = False) -> None:
    """Draw the map of a run and write it as a PNG, with the ellipses of its shape or those in the world."""
    save_figure(draw_map(run, world=world), path)


def draw_map(
    run: Recording, step: int | None = None, view: str | tuple[float, float] = "normal", world: bool = False
) -> Figure:
    """Return the figure of a run's map after a step, by default the last: axes in metres, in the frame of the map.

    Ellipses are those of the shape, without what the start leaves open (`kalmark.results.gauge`), or in the `world`.
    In space `view` is where the left half looks from: "normal", "top", "side", "front" or (elevation, azimuth) in
    degrees.
    """
    scene = Scene.of(run, step, world)
    spans = [(scene.high - scene.low)[:2]]
    if scene.d == 3:
        projection = Projection.of(scene, view)
        spans.insert(0, np.ptp(projection(box_corners(scene.low, scene.high)), axis=0))
    aspects = [float(np.clip(span[0] / span[1], 0.5, 4.0)) for span in spans]
    tall = float(np.clip(INCHES[scene.d] / sum(aspects), 3.0, 8.5))
    width = max(sum(aspects) * tall + 0.2 + 0.65 * len(spans), 6.0)
    title, figures = headline(run)
    lines, handles = _lines(figures, int(CHARACTERS * width)), legend(scene)
    told = [*dict.fromkeys((*summary_of(run)["warnings"], *alarm(summary_of(run).get("verdict"))))]
    alarms = [part for line in told for part in textwrap.wrap(line, int(CHARACTERS * width))]
    columns = max(1, int(width / 1.9))
    below, above = 0.6 + 0.25 * -(-len(handles) // columns), 0.55 + LINE_INCHES * (len(lines) + len(alarms))
    figure = Figure(figsize=(width, tall + below + above), facecolor="white")
    height = figure.get_figheight()
    left = 0.1 if scene.d == 3 else 0.75
    if scene.d == 3:
        at = left / width, (below - 0.3) / height, aspects[0] * tall / width, (tall + 0.3) / height
        draw_space(figure.add_axes(at), scene, projection)
    wide = aspects[-1] * tall
    at = (width - 0.15 - wide if scene.d == 3 else left) / width, below / height, wide / width, tall / height
    draw_plan(figure.add_axes(at, anchor="NW"), scene)
    figure.text(left / width, 1 - 0.3 / height, title, fontsize=13, fontweight="bold", color=INK)
    text: dict[str, Any] = {"va": "top", "fontsize": 9, "color": SOFT, "linespacing": 1.35}
    figure.text(left / width, 1 - 0.4 / height, "\n".join(lines), **text)
    below_lines = 1 - (0.4 + LINE_INCHES * len(lines)) / height
    figure.text(left / width, below_lines, "\n".join(alarms), **text | {"color": ALARM_COLOUR})
    figure.legend(handles=handles, loc="lower center", ncols=columns, frameon=False, fontsize=9)
    return figure


def _lines(figures: list[str], width: int) -> list[str]:
    """Return the key figures joined to lines of at most `width` characters, none of them broken."""
    lines: list[str] = []
    for figure in figures:
        if lines and len(lines[-1]) + len(figure) + 3 <= width:
            lines[-1] += f" · {figure}"
        else:
            lines.append(figure)
    return lines


def draw_plan(axes: Axes, scene: Scene) -> None:
    """Draw a scene as seen from above: x to the right, y up."""
    axes.set_xlabel("x (m)", color=INK)
    axes.set_ylabel("y (m)", color=INK)
    axes.grid(True, color="#e6e8ec", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.tick_params(colors=SOFT, labelsize=9)
    for side in axes.spines.values():
        side.set_color("#c4c8cf")
    for stroke in strokes(scene):
        axes.plot(stroke.points[:, 0], stroke.points[:, 1], **stroke.style)
    for name, point in _labels(scene):
        axes.text(point[0], point[1] + 0.01 * scene.size, name, **NAMED)
    axes.set_xlim(scene.low[0], scene.high[0])
    axes.set_ylim(scene.low[1], scene.high[1])
    axes.set_aspect("equal", adjustable="box")


def strokes(scene: Scene) -> list[Stroke]:
    """Return all that is drawn of a scene, in the order of the legend."""
    several, crowded = len(scene.paths) > 1, len(scene.ids) > CROWD
    gaps = " (dotted: no scans, or lost)" if any(way.any() for way in scene.dotted.values()) else ""
    out = []
    for robot, path in scene.paths.items():
        style = {"color": scene.colour(robot), "linewidth": 0.8 if len(path) > LONG else 1.2, "alpha": 0.9, "zorder": 6}
        label = robot if several else f"estimated path{gaps}"
        out.append(Stroke(scene.line(robot), style, label, {"color": scene.colour(robot)}))
        out.append(Stroke(scene.bridges(robot), style | {"linestyle": ":"}))
    truth = {"color": TRUTH_COLOUR, "linewidth": 2.3, "alpha": 0.6, "zorder": 2}
    label = f"true path{'s' if several else ''}{scene.how}"
    out += [
        Stroke(break_path(scene.truth[robot], scene.stretches[robot]), truth, label, truth) for robot in scene.truth
    ]
    small, cross = _marks(".", TRUTH_COLOUR, 1.8, 1), _marks("x", FIX_COLOUR, 3.5, 3) | {"markeredgewidth": 0.7}
    aligned = "position fixes (aligned, not used)"
    out += [Stroke(fixes, small, aligned, small | {"markersize": 6}) for fixes in scene.fixes.values()]
    out += [Stroke(fixes, cross, "fixes used", cross | {"markersize": 5}) for fixes in scene.used.values()]
    out += (
        _true_strokes(scene, truth, crowded)
        + _known_strokes(scene)
        + _landmark_strokes(scene, crowded)
        + _robot_strokes(scene)
    )
    if len(scene.unseen):
        cross = _marks("x", ALARM_COLOUR, 3 if crowded else 6, 7) | {"markeredgewidth": 0.8}
        out.append(Stroke(scene.unseen, cross, "landmarks not seen again", cross | {"markersize": 6}))
    if len(scene.repeats):
        twice = {"color": ALARM_COLOUR, "linewidth": 0.9, "alpha": 0.8, "zorder": 5}
        out.append(Stroke(scene.repeats, twice, "landmarks mapped twice", twice))
    for robot, path in scene.dead.items():
        dead = {"color": scene.colour(robot), "linewidth": 0.7, "alpha": 0.5, "linestyle": (0, (5, 3)), "zorder": 3}
        if np.isfinite(path).any():
            out.append(Stroke(break_path(path, scene.stretches[robot]), dead, "dead reckoning", dead))
    return out


def _true_strokes(scene: Scene, style: dict[str, Any], crowded: bool) -> list[Stroke]:
    points, lines = list(scene.true_points().values()), scene.true_lines()
    out = []
    if points:
        colour, zorder = (INK, 6) if scene.d == 2 else (TRUTH_COLOUR, 2)
        plus = _marks("+", colour, 4 if crowded else 8, zorder) | {"markeredgewidth": 0.6 if crowded else 1.0}
        out.append(Stroke(np.array(points), plus, f"true landmarks{scene.how}", _marks("+", colour, 7, 1)))
    if lines:
        out.append(
            Stroke(
                join_polylines(lines, scene.d), style, f"true {'walls' if scene.d == 2 else 'lines'}{scene.how}", style
            )
        )
    tags = np.array([l for l in scene.true_landmarks.values() if len(l) == TAG]).reshape(-1, TAG)
    return [*out, Stroke(join_polylines(squares(tags, scene.size)), style)] if len(tags) else out


def _known_strokes(scene: Scene) -> list[Stroke]:
    """Return the landmarks that were known exactly beforehand."""
    if not len(scene.known):
        return []
    mark = _marks("^", KNOWN_COLOUR, 2.5 if len(scene.known) > CROWD else 6, 5) | {"markerfacecolor": "none"}
    return [Stroke(scene.known, mark, "landmarks known exactly", mark | {"markersize": 6})]


def _landmark_strokes(scene: Scene, crowded: bool) -> list[Stroke]:
    shapes, out = scene.shapes, []
    for k, (colour, label) in enumerate(GROUPS[scene.d]):
        mine = shapes.group == k
        if not mine.any():
            continue
        rings = np.concatenate(contours(shapes.means[mine], shapes.covariances[mine]))
        width, alpha = (0.9, 1.0) if scene.d == 2 else (0.7, 0.55)
        thin = {"linewidth": 0.5 * width, "alpha": 0.75 * alpha} if crowded else {"linewidth": width, "alpha": alpha}
        sample = {"color": colour, "marker": "."}
        out.append(
            Stroke(
                join_polylines(rings, scene.d),
                {"color": colour, "zorder": 4, **thin},
                label.format(scene.of_what),
                sample,
            )
        )
        out.append(Stroke(shapes.means[mine], _marks(".", colour, 2 if crowded else 4, 5)))
    if len(shapes.lines):
        out.append(Stroke(join_polylines(shapes.lines, scene.d), {"color": LINE_COLOUR, "linewidth": 1.8, "zorder": 5}))
    if scene.d == 3:
        tags = join_polylines(squares(shapes.tags, scene.size))
        out.append(Stroke(tags, {"color": EUCLIDEAN_COLOUR, "linewidth": 1.4, "zorder": 5}))
    return out


def _robot_strokes(scene: Scene) -> list[Stroke]:
    """Return starts, ends with their contours, and in space the robots' bodies along the way."""
    starts, ends, rings, d = [], [], [], scene.d
    disc = {"markerfacecolor": "white"}
    for robot, path in scene.paths.items():
        if not len(path):
            continue
        colour = scene.colour(robot)
        rim = _marks("o", colour, 7 if d == 2 else 6, 7)
        starts.append(Stroke(path[:1, :d], rim | disc, "start", _marks("o", INK, 6, 1) | disc))
        marker, size = (_arrow(float(path[-1, 2])), 15) if d == 2 else ("o", 6)
        mark = _marks(_arrow(0.0) if d == 2 else "o", INK, 11 if d == 2 else 6, 1)
        ends.append(Stroke(path[-1:, :d], _marks(marker, colour, size, 8) | {"markeredgecolor": "white"}, "end", mark))
        ring = join_polylines(contours(path[-1:, :d], scene.pose_covariances[robot][-1:])[0], d)
        style = {"color": colour if d == 2 else POSE_COLOUR, "linewidth": 0.9, "zorder": 7}
        rings.append(Stroke(ring, style, f"end, 3σ {scene.of_what}", style | {"color": INK if d == 2 else POSE_COLOUR}))
        if d == 3:
            thin = {"color": colour, "linewidth": 0.8, "alpha": 0.8, "zorder": 6}
            rings.append(Stroke(join_polylines(scene.frames(robot)), thin))
    return starts + ends + rings


def _marks(marker: Any, colour: str, size: float, zorder: float) -> dict[str, Any]:
    return {"linestyle": "", "marker": marker, "color": colour, "markersize": size, "zorder": zorder}


def _arrow(heading: float) -> MarkerStyle:
    """Return a dart that points along a heading, about the robot's place."""
    dart = Path([(0.62, 0.0), (-0.38, 0.36), (-0.16, 0.0), (-0.38, -0.36), (0.62, 0.0)], closed=True)
    return MarkerStyle(dart, transform=Affine2D().rotate(heading))


def legend(scene: Scene) -> list[Line2D]:
    """Return the entries of a scene's legend."""
    samples = {stroke.label: stroke.sample for stroke in reversed(strokes(scene)) if stroke.label}
    return [Line2D([], [], label=label, **(sample or {})) for label, sample in reversed(samples.items())]


def _labels(scene: Scene) -> list[tuple[str, Array]]:
    """Return the names of the landmarks of space, if they are few, and their places."""
    if scene.d == 2 or len(scene.ids) > FEW:
        return []
    places = scene.shapes.means[: len(scene.ids)]
    inside = ((places >= scene.low) & (places <= scene.high)).all(axis=1)
    return [(str(scene.ids[k]), places[k]) for k in np.flatnonzero(inside).tolist()]


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


def box_corners(low: Array, high: Array) -> Array:
    """Return the corners (8, 3) of a box."""
    return np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])


def draw_space(axes: Axes, scene: Scene, projection: Projection) -> None:
    """Draw a scene in perspective above a grid on the ground, with the shadows of paths and of few landmarks."""
    axes.set_axis_off()
    axes.set_aspect("equal", adjustable="box")
    floor = scene.ground
    shadows = [np.column_stack([line[:, :2], np.full(len(line), floor)]) for line in map(scene.line, scene.paths)]
    if len(scene.ids) <= CROWD:
        standing = scene.shapes.means[scene.shapes.group != LINES]
        shadows += [np.array([point, [*point[:2], floor]]) for point in standing]
    drawn = [Stroke(scene.inside(join_polylines(shadows)), {"color": SHADOW, "linewidth": 0.7, "zorder": 1})]
    drawn += [Stroke(scene.inside(stroke.points), stroke.style) for stroke in strokes(scene)]
    for points, style, *_ in _ground(axes, scene, projection) + drawn:
        axes.plot(*projection(points).T, clip_on=False, **style)
    for name, point in _labels(scene):
        u, v = projection(point + np.array([0.0, 0.0, 0.012 * scene.size]))
        axes.text(u, v, name, **NAMED)
    edges = projection(box_corners(scene.low, scene.high))
    low, high = edges.min(axis=0), edges.max(axis=0)
    pad = 0.04 * (high - low).max()
    axes.set_xlim(low[0] - pad, high[0] + pad)
    axes.set_ylim(low[1] - pad, high[1] + pad)


def grid_spacing(size: float) -> float:
    """Return the distance of the lines of a grid: 2 m, or 1, 2 or 5 times a power of ten that gives some ten lines."""
    if 8.0 <= size <= 40.0:
        return 2.0
    power = 10.0 ** np.floor(np.log10(size / 10.0))
    return float(power * next(m for m in (1, 2, 5, 10) if size / (m * power) <= 14))


def _ground(axes: Axes, scene: Scene, projection: Projection) -> list[Stroke]:
    """Return the grid on the ground and a scale of heights at a corner; draw ticks at the edges that face the eye."""
    low, high, eye, z = scene.low, scene.high, projection.axes[2], scene.ground
    step = grid_spacing(float((high - low)[:2].max()))
    xs, ys = (np.arange(np.ceil(low[i] / step), np.floor(high[i] / step) + 1) * step for i in (0, 1))
    lines = [np.array([[x, low[1], z], [x, high[1], z]]) for x in xs]
    lines += [np.array([[low[0], y, z], [high[0], y, z]]) for y in ys]
    near = np.where(eye[:2] > 0, high[:2], low[:2])
    away = 0.035 * scene.size * np.where(eye[:2] > 0, 1.0, -1.0)
    skip = max(1, -(-max(len(xs), len(ys)) // 8))
    ticks = [(f"{x + 0.0:g}", [x, near[1] + away[1], z]) for x in xs[::skip]]
    ticks += [(f"{y + 0.0:g}", [near[0] + away[0], y, z]) for y in ys[::skip]]
    middle = (low + high) / 2
    ticks.append(("x (m)", [middle[0], near[1] + 2.6 * away[1], z]))
    ticks.append(("y (m)", [near[0] + 2.6 * away[0], middle[1], z]))
    heights, more = _heights(scene, projection)
    ticks += more
    for text, point in ticks:
        u, v = projection(np.array(point))
        axes.text(u, v, text, color=TICK, fontsize=8, ha="center", va="center", zorder=1)
    return [Stroke(join_polylines(lines), {"color": GROUND, "linewidth": 0.7, "zorder": 0}), *heights]


def _heights(scene: Scene, projection: Projection) -> tuple[list[Stroke], list[tuple[str, Any]]]:
    """Return the scale of heights at the corner that is leftmost on paper, and its ticks."""
    low, high = scene.low, scene.high
    if abs(projection.axes[2, 2]) > 0.99:
        return [], []
    edges = box_corners(low, high)
    x, y, _ = edges[np.argmin(projection(edges)[:, 0])]
    step = grid_spacing(float(3.0 * max(high[2] - low[2], 0.2 * scene.size)))
    scale = Stroke(np.array([[x, y, low[2]], [x, y, high[2]]]), {"color": "#b4bac4", "linewidth": 0.8, "zorder": 0})
    beside = -0.03 * scene.size * projection.axes[0]
    zs = np.arange(np.ceil(low[2] / step), np.floor(high[2] / step) + 1) * step
    ticks = [(f"{z + 0.0:g}", np.array([x, y, z]) + beside) for z in zs]
    return [scale], [*ticks, ("z (m)", np.array([x, y, high[2] + 0.03 * scene.size]))]
