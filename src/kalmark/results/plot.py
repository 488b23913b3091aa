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
from matplotlib.colors import is_color_like
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.markers import MarkerStyle
from matplotlib.path import Path
from matplotlib.transforms import Affine2D

from kalmark.arrays import Array
from kalmark.errors import KalmarkError
from kalmark.files import replace_file
from kalmark.geometry.rotations import matrix
from kalmark.results.evaluate import headline, summary_of
from kalmark.results.labels import name_points
from kalmark.results.landmark_table import LINES, TAG
from kalmark.results.recording import Recording
from kalmark.results.scene import (
    BODIES,
    FIX_COLOUR,
    INK,
    OUTCOME_COLOURS,
    TRUTH_COLOUR,
    Scene,
    Style,
    break_path,
    join_polylines,
    picture_of,
    squares,
)
from kalmark.results.verdict_text import alarm

NORMAL = (28.0, -55.0)
VIEWS = {"normal": NORMAL, "orbit": NORMAL, "top": (90.0, -90.0), "side": (0.0, -90.0), "front": (0.0, 0.0)}
BEHIND = (20.0, 180.0, 0.25)  # of a robot: elevation and azimuth of the eye, deg, and how far it is, of the box
LANDMARK_COLOUR = "#d2691e"
EUCLIDEAN_COLOUR, OTHER_COLOUR, LINE_COLOUR = "#1f5fa8", "#c8412f", "#8c1c13"
GROUPS = {  # of landmarks that are drawn alike, by the dimensions of the scene: their colour, its name, their label
    2: (
        *((LANDMARK_COLOUR, "landmarks", "estimated landmarks{}"),) * 2,
        (LINE_COLOUR, "lines", "walls{}"),
    ),
    3: (
        (EUCLIDEAN_COLOUR, "landmarks", "Euclidean landmarks{}"),
        (OTHER_COLOUR, "others", "landmarks that are not Euclidean{}"),
        (LINE_COLOUR, "lines", "lines{}"),
    ),
}
LONG = 3000  # a path of more steps than this is drawn thinner
CROWD = 100  # with more landmarks than this, everything about them is drawn thinner
WINDOW = 0.7  # half of the picture from behind a robot, by the distance of the eye
NEAREST = 0.1  # what is nearer to the eye than this part of the distance of the middle is not drawn
FEW = 40  # landmarks of space that are labelled
GROUND, SHADOW, TICK, SOFT = "#d7dbe1", "#c3c8d0", "#7a818c", "#555b66"
NAMED: Style = {"color": "#1e4d2b", "fontsize": 7, "zorder": 9}
POSE_COLOUR = "#d62f2f"
ALARM_COLOUR = "#b3261e"
KNOWN_COLOUR = "#2f7d4f"
INCHES = {2: 8.3, 3: 13.6}  # what the panels are wide together
LINE_INCHES, CHARACTERS = 0.17, 13  # the height of a line of text, and how many fit an inch


class Stroke(NamedTuple):
    """Polylines or marks: points (N, d), NaN between lines, their style, and the label and style in the legend."""

    points: Array
    style: Style
    label: str = ""
    sample: Style | None = None


def save_figure(figure: Figure, path: str | PathLike[str], dpi: float = 130, rim: bool = True) -> None:
    """Write a figure completely or not, with a narrow rim around the drawing, or as it is.

    The ending of the name is that of a PNG, SVG or PDF, or of another format of matplotlib.  It draws twice to find
    that box, which only a figure with a layout of its own needs.  Raises KalmarkError for another ending.
    """
    path = FilePath(path)
    ending = path.suffix.lower().lstrip(".")
    if ending not in (known := FigureCanvasAgg.get_supported_filetypes()):
        raise KalmarkError(
            f"{path}: the ending is {path.suffix!r}, expected a format of matplotlib: {', '.join(known)}"
        )
    figure.set_dpi(dpi)
    FigureCanvasAgg(figure)
    laid_out = figure.get_layout_engine() is not None
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph .* missing")  # of a name in a script that the font does not have
        box = None if not rim else "tight" if laid_out else figure.get_tightbbox().padded(0.15)
        style: Style = {"bbox_inches": box, "pad_inches": 0.15}
        style |= {"pil_kwargs": {"compress_level": 3}} if ending == "png" else {}
        replace_file(path, partial(figure.savefig, dpi=dpi, format=ending, **style))


def save_map(run: Recording, path: str | PathLike[str], world: bool = False) -> None:
    """Draw the map of a run and write it, with the ellipses of its shape or those in the world."""
    figure, width_px = draw_map(run, world=world), picture_of(run).width_px
    save_figure(figure, path, 130.0 if width_px is None else width_px / figure.get_figwidth(), rim=width_px is None)


def draw_map(
    run: Recording, step: int | None = None, view: str | tuple[float, float] | None = None, world: bool = False
) -> Figure:
    """Return the figure of a run's map after a step, by default the last: axes in metres, in the frame of the map.

    Ellipses are those of the shape, without what the start leaves open (`kalmark.results.gauge`), or in the `world`.
    In space `view` is where the left half looks from (`kalmark.picture_options.Picture`); by default, as all else, by
    the section `picture` of the run's configuration.
    """
    scene = Scene.of(run, step, world)
    spans, flat = [(scene.high - scene.low)[:2]], False
    if scene.d == 3:
        projection = Projection.of(scene, view)
        flat = projection.distance == np.inf
        spans.insert(0, np.subtract(*reversed(projection.frame(scene.low, scene.high))))
    aspects = [float(np.clip(span[0] / span[1], 0.5, 4.0)) for span in spans]
    tall = float(np.clip(INCHES[scene.d] / sum(aspects), 3.0, 8.5))
    width = max(sum(aspects) * tall + 0.2 + 0.65 * (len(spans) + flat), 6.0)
    title, figures = headline(run)
    lines, handles = _lines(figures, int(CHARACTERS * width)), legend(scene)
    told = [*dict.fromkeys((*summary_of(run)["warnings"], *alarm(summary_of(run).get("verdict"))))]
    alarms = [part for line in told for part in textwrap.wrap(line, int(CHARACTERS * width))]
    columns = max(1, int(width / 1.9))
    below, above = 0.6 + 0.25 * -(-len(handles) // columns), 0.55 + LINE_INCHES * (len(lines) + len(alarms))
    figure = Figure(figsize=(width, tall + below + above), facecolor="white")
    height = figure.get_figheight()
    left = 0.1 if scene.d == 3 and not flat else 0.75
    if scene.d == 3:
        drop = 0.0 if flat else 0.3  # perspective needs no room for labels below
        at = left / width, (below - drop) / height, aspects[0] * tall / width, (tall + drop) / height
        draw_space(figure.add_axes(at), scene, projection)
    wide = aspects[-1] * tall
    at = (width - 0.15 - wide if scene.d == 3 else left) / width, below / height, wide / width, tall / height
    draw_plan(figure.add_axes(at, anchor="NW"), scene)
    figure.text(left / width, 1 - 0.3 / height, title, fontsize=13, fontweight="bold", color=INK)
    text: Style = {"va": "top", "fontsize": 9, "color": SOFT, "linespacing": 1.35}
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


def style_axes(axes: Axes, x_label: str, y_label: str) -> None:
    """Label axes in metres, and draw their grid."""
    axes.set_xlabel(x_label, color=INK)
    axes.set_ylabel(y_label, color=INK)
    axes.grid(True, color="#e6e8ec", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.tick_params(colors=SOFT, labelsize=9)
    for side in axes.spines.values():
        side.set_color("#c4c8cf")


def draw_plan(axes: Axes, scene: Scene) -> None:
    """Draw a scene as seen from above: x to the right, y up."""
    style_axes(axes, "x (m)", "y (m)")
    for stroke in strokes(scene):
        axes.plot(stroke.points[:, 0], stroke.points[:, 1], label=stroke.label or None, **stroke.style)
    names, places = _labels(scene)
    name_points(axes, places, names, **NAMED)
    axes.set_xlim(scene.low[0], scene.high[0])
    axes.set_ylim(scene.low[1], scene.high[1])
    axes.set_aspect("equal", adjustable="box")


def strokes(scene: Scene) -> list[Stroke]:
    """Return all that is drawn of a scene, in the order of the legend."""
    several, crowded = len(scene.ways) > 1, len(scene.ids) > CROWD
    gaps = " (dotted: no scans, or lost)" if any(way.dotted.any() for way in scene.ways.values()) else ""
    paths = []
    for robot, way in scene.ways.items():
        thick = 0.8 if len(way.path) > LONG else 1.2
        style = {"color": scene.colour(robot), "linewidth": thick, "alpha": 0.9, "zorder": 6}
        label = robot if several else f"estimated path{gaps}"
        paths.append(Stroke(scene.line(robot), style, label, {"color": scene.colour(robot)}))
        paths.append(Stroke(scene.bridges(robot), style | {"linestyle": ":"}))
    triangle = _marks("^", KNOWN_COLOUR, 2.5 if len(scene.known) > CROWD else 6, 5) | {"markerfacecolor": "none"}
    cross = _marks("x", ALARM_COLOUR, 3 if crowded else 6, 7) | {"markeredgewidth": 0.8}
    twice = {"color": ALARM_COLOUR, "linewidth": 0.9, "alpha": 0.8, "zorder": 5}
    others = [
        *(_true_paths(scene) if scene.picture.truth else []),
        *_fix_strokes(scene),
        *(_true_strokes(scene, crowded) if scene.picture.truth else []),
        Stroke(scene.known, triangle, "landmarks known exactly", triangle | {"markersize": 6}),
        *_landmark_strokes(scene, crowded),
        *_robot_strokes(scene),
        *(_ray_strokes(scene) if scene.picture.sensors else []),
        *_class_strokes(scene, crowded),
        Stroke(scene.unseen, cross, "landmarks not seen again", cross | {"markersize": 6}),
        Stroke(scene.repeats, twice, "landmarks mapped twice", twice),
    ]
    for robot, way in scene.ways.items():
        dead = {"color": scene.colour(robot), "linewidth": 0.7, "alpha": 0.5, "linestyle": (0, (5, 3)), "zorder": 3}
        if np.isfinite(way.dead).any():
            others.append(Stroke(break_path(way.dead, way.stretches), dead, "dead reckoning", dead))
    return paths + [stroke for stroke in others if len(stroke.points)]


def _fix_strokes(scene: Scene) -> list[Stroke]:
    small, cross = _marks(".", TRUTH_COLOUR, 1.8, 1), _marks("x", FIX_COLOUR, 3.5, 3) | {"markeredgewidth": 0.7}
    told = "position fixes (aligned, not used)"
    fixes = [Stroke(way.fixes, small, told, small | {"markersize": 6}) for way in scene.ways.values()]
    return fixes + [Stroke(way.used, cross, "fixes used", cross | {"markersize": 5}) for way in scene.ways.values()]


def _true_style(scene: Scene) -> Style:
    return {"color": scene.picture.colour("truth", TRUTH_COLOUR), "linewidth": 2.3, "alpha": 0.6, "zorder": 2}


def _true_paths(scene: Scene) -> list[Stroke]:
    style, label = _true_style(scene), f"true path{'s' if len(scene.ways) > 1 else ''}{scene.how}"
    ways = [(way.truth[:, : scene.d], way.stretches) for way in scene.ways.values() if len(way.truth) > 1]
    return [Stroke(break_path(*way), style, label, style) for way in ways]


def _true_strokes(scene: Scene, crowded: bool) -> list[Stroke]:
    style, points = _true_style(scene), np.array([*scene.true_points().values()]).reshape(-1, scene.d)
    colour, zorder = (scene.picture.colour("truth", INK), 6) if scene.d == 2 else (style["color"], 2)
    plus = _marks("+", colour, 4 if crowded else 8, zorder) | {"markeredgewidth": 0.6 if crowded else 1.0}
    lines, what = join_polylines(scene.true_lines(), scene.d), "walls" if scene.d == 2 else "lines"
    tags = np.array([l for l in scene.true_landmarks.values() if len(l) == TAG]).reshape(-1, TAG)
    return [
        Stroke(points, plus, f"true landmarks{scene.how}", _marks("+", colour, 7, 1)),
        Stroke(lines, style, f"true {what}{scene.how}", style),
        *(
            _robot_mark(scene, pose, style["color"], f"true {scene.end}{scene.how}", 5.5)
            for pose in scene.true_ends.values()
        ),
        Stroke(join_polylines(squares(tags, scene.size)), style),
    ]


def _landmark_strokes(scene: Scene, crowded: bool) -> list[Stroke]:
    shapes, picture, out = scene.shapes, scene.picture, []
    colours = {name: picture.colour(name, usual) for usual, name, _ in GROUPS[scene.d]}
    for k, (_, name, label) in enumerate(GROUPS[scene.d]):
        mine, colour = shapes.group == k, colours[name]
        if not mine.any():
            continue
        rings = scene.rings(shapes.means[mine], shapes.covariances[mine])
        width, alpha = (0.9, 1.0) if scene.d == 2 else (0.7, 0.55)
        thin = {"linewidth": 0.5 * width, "alpha": 0.75 * alpha} if crowded else {"linewidth": width, "alpha": alpha}
        said = label.format(scene.how_large(" of their ends" if name == "lines" else ""))
        out.append(Stroke(rings, {"color": colour, "zorder": 4, **thin}, said, {"color": colour, "marker": "."}))
        out.append(Stroke(shapes.means[mine], _marks(".", colour, 2 if crowded else 4, 5)))
    lines, tags = join_polylines(shapes.lines, scene.d), join_polylines(squares(shapes.tags, scene.size))
    return [
        *out,
        Stroke(lines, {"color": colours["lines"], "linewidth": 1.8, "zorder": 5}),
        Stroke(tags, {"color": colours["landmarks"], "linewidth": 1.4, "zorder": 5}),
    ]


def _class_strokes(scene: Scene, crowded: bool) -> list[Stroke]:
    """Return the landmarks of each class, in the colour that its name is, if it is one."""
    out = []
    for k, (name, places) in enumerate(scene.classes.items()):
        dot = _marks("o", name if is_color_like(name) else f"C{k}", 3 if crowded else 5, 6)
        out.append(Stroke(places, dot, name, dot | {"markersize": 5}))
    return out


def _robot_strokes(scene: Scene) -> list[Stroke]:
    """Return starts, ends with their contours, and in space the robots' bodies along the way."""
    starts, ends, rings, d = [], [], [], scene.d
    disc = {"markerfacecolor": "white"}
    for robot, way in scene.ways.items():
        path = way.path
        if not len(path):
            continue
        colour = scene.colour(robot)
        rim = _marks("o", colour, 7 if d == 2 else 6, 7)
        if len(path) > 1 or scene.end == "end":
            starts.append(Stroke(path[:1, :d], rim | disc, "start", _marks("o", INK, 6, 1) | disc))
        ends.append(_robot_mark(scene, path[-1], colour, scene.end, 8))
        ring = scene.rings(path[-1:, :d], way.covariances[-1:])
        style = {"color": colour if d == 2 else POSE_COLOUR, "linewidth": 0.9, "zorder": 7}
        said = f"{scene.end}{scene.how_large()}" if scene.how_large() else ""
        rings.append(Stroke(ring, style, said, style | {"color": INK if d == 2 else POSE_COLOUR}))
        if d == 3:
            thin = {"color": colour, "linewidth": 0.8, "alpha": 0.8, "zorder": 6}
            rings.append(Stroke(join_polylines(scene.frames(robot)), thin))
    return starts + ends + rings


def _robot_mark(scene: Scene, pose: Array, colour: str, label: str, zorder: float) -> Stroke:
    """Return a robot at a pose (3|7,): its outline, in space a disc."""
    marker, size = (_outline(scene, float(pose[2])), 15) if scene.d == 2 else ("o", 6)
    sample = _marks(_outline(scene, 0.0) if scene.d == 2 else "o", INK, 11 if scene.d == 2 else 6, 1)
    sample |= {"color": colour} if label.startswith("true") else {}
    style = _marks(marker, colour, size, zorder) | {"markeredgecolor": "white"}
    return Stroke(pose[None, : scene.d], style, label, sample)


def _ray_strokes(scene: Scene) -> list[Stroke]:
    """Return the last scan, by outcome: lines from the sensor to what it saw, and dotted ones from there to landmarks.

    A sensor that does not measure all coordinates has lines to the landmarks.
    """
    out = []
    for outcome in dict.fromkeys(ray.outcome for ray in scene.rays):
        mine, colour = [ray for ray in scene.rays if ray.outcome == outcome], OUTCOME_COLOURS.get(outcome, INK)
        beams = [np.array([ray.sensor, ray.seen_at]) for ray in mine if np.isfinite(ray.seen_at).all()]
        short = [np.array([ray.sensor, ray.landmark]) for ray in mine if not np.isfinite(ray.seen_at).all()]
        marks = _marks("x", colour, 6, 7) | {"markeredgewidth": 1.4}
        thin = {"color": colour, "linewidth": 0.8, "alpha": 0.7, "zorder": 3}
        out.append(Stroke(join_polylines(beams + short, scene.d), thin, f"observation: {outcome}", thin))
        out.append(Stroke(np.array([ray[1] for ray in beams]).reshape(-1, scene.d), marks))
        innovations = [np.array([ray.seen_at, ray.landmark]) for ray in mine]
        out.append(Stroke(join_polylines(innovations, scene.d), thin | {"linestyle": ":", "linewidth": 1.4}))
    return out


def _marks(marker: Any, colour: str, size: float, zorder: float) -> Style:
    return {"linestyle": "", "marker": marker, "color": colour, "markersize": size, "zorder": zorder}


def _outline(scene: Scene, heading: float) -> MarkerStyle:
    """Return the outline of a robot that looks along a heading, about its place."""
    return MarkerStyle(Path(BODIES[scene.picture.robot], closed=True), transform=Affine2D().rotate(heading))


def legend(scene: Scene) -> list[Line2D]:
    """Return the entries of a scene's legend."""
    samples = {stroke.label: stroke.sample for stroke in reversed(strokes(scene)) if stroke.label}
    return [Line2D([], [], label=label, **(sample or {})) for label, sample in reversed(samples.items())]


def _labels(scene: Scene) -> tuple[list[str], Array]:
    """Return the names of the landmarks and their places; by default those of space, if they are few."""
    usual = scene.d == 3 and len(scene.ids) <= FEW
    places = scene.shapes.means[: len(scene.ids)]
    inside = ((places >= scene.low) & (places <= scene.high)).all(axis=1)
    named = np.flatnonzero(inside & (usual if scene.picture.labels is None else scene.picture.labels))
    return [str(scene.ids[k]) for k in named.tolist()], places[named]


@dataclass(frozen=True, eq=False)
class Projection:
    """A view of space on paper: `axes` (3, 3) are right, up and towards the eye, which is `distance` from `middle`."""

    axes: Array
    middle: Array
    distance: float

    @classmethod
    def of(cls, scene: Scene, view: str | tuple[float, float] | None = None) -> Projection:
        """Return the view from (elevation, azimuth), degrees: without perspective from the top and the sides.

        "self" is that from behind the first robot, which looks along its x axis.  By default that of the picture.
        """
        view = scene.picture.view if view is None else view
        middle, far = (scene.low + scene.high) / 2, 2.5 * float(np.linalg.norm(scene.high - scene.low))
        if view == "self":
            pose = next(way.path[-1] for way in scene.ways.values())
            ahead = matrix(np.ascontiguousarray(pose[3:7]))[:, 0]
            elevation, turned, share = BEHIND
            degrees = elevation, turned + float(np.degrees(np.arctan2(ahead[1], ahead[0])))
            middle, far = pose[:3], share * scene.size
        else:
            degrees = VIEWS[view] if isinstance(view, str) else view
            middle, far = (np.zeros(3), np.inf) if view in ("top", "side", "front") else (middle, far)
        elevation, azimuth = np.radians(degrees)
        eye = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
        right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
        return cls(np.array([right, np.cross(eye, right), eye]), middle, far)

    def __call__(self, points: Array) -> Array:
        """Return points (..., 3) on paper (..., 2)."""
        q = (points - self.middle) @ self.axes.T
        depth = 1.0 - q[..., 2:] / self.distance
        return q[..., :2] / np.where(depth > NEAREST, depth, np.nan)

    def frame(self, low: Array, high: Array) -> tuple[Array, Array]:
        """Return the corners (2,) on paper of the picture of a box; from inside of the box those of a window."""
        edges = self(box_corners(low, high))
        if np.isnan(edges).any():
            return np.full(2, -WINDOW * self.distance), np.full(2, WINDOW * self.distance)
        return edges.min(axis=0), edges.max(axis=0)


def box_corners(low: Array, high: Array) -> Array:
    """Return the corners (8, 3) of a box."""
    return np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])


def draw_space(axes: Axes, scene: Scene, projection: Projection) -> None:
    """Draw a scene in perspective above a grid on the ground, with the shadows of paths and of few landmarks.

    Without perspective it has axes in metres.
    """
    flat = projection.distance == np.inf
    axes.set_aspect("equal", adjustable="box")
    if flat:
        style_axes(axes, *(f"{'xyz'[int(np.argmax(np.abs(axis)))]} (m)" for axis in projection.axes[:2]))
    else:
        axes.set_axis_off()
        for points, style, *_ in [*_ground(axes, scene, projection), _shadows(scene)]:
            axes.plot(*projection(points).T, clip_on=False, **style)
    for points, style, label, _ in strokes(scene):
        axes.plot(*projection(scene.inside(points)).T, clip_on=False, label=label or None, **style)
    names, places = _labels(scene)
    name_points(axes, projection(places), names, **NAMED)
    low, high = projection.frame(scene.low, scene.high)
    pad = 0.0 if flat else 0.04 * (high - low).max()
    axes.set_xlim(low[0] - pad, high[0] + pad)
    axes.set_ylim(low[1] - pad, high[1] + pad)


def _shadows(scene: Scene) -> Stroke:
    """Return the paths on the ground, and lines from few landmarks down to it."""
    floor = scene.ground
    shadows = [np.column_stack([line[:, :2], np.full(len(line), floor)]) for line in map(scene.line, scene.ways)]
    if len(scene.ids) <= CROWD:
        standing = scene.shapes.means[scene.shapes.group != LINES]
        shadows += [np.array([point, [*point[:2], floor]]) for point in standing]
    return Stroke(scene.inside(join_polylines(shadows)), {"color": SHADOW, "linewidth": 0.7, "zorder": 1})


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
