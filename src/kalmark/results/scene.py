"""The content of the pictures of a run: at one step in the frame of the map, and scan by scan in the images of cameras.

A `Scene` has paths, landmarks, truth, fixes and cameras, for robots in the plane (d = 2) and in space (d = 3) alike;
`kalmark.results.plot` draws it for ``map.png``, `kalmark.results.run_page` writes it into the page.

The columns of a camera's measurements determine their kind: `u_px, v_px` is a point; `u1_px, v1_px, u2_px, v2_px` are
the ends of a segment, four of them the corners of a tag; `ul_px, vl_px, ur_px, vr_px` is a point in a left and a right
image.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from kalmark.arrays import Array, Flags
from kalmark.events import Id
from kalmark.geometry.gaussian import contours, is_finite
from kalmark.geometry.rotations import matrix
from kalmark.logs.log import LandmarkPlaces
from kalmark.picture_options import USUAL, Picture
from kalmark.report import Report
from kalmark.results.control_gaps import while_lost
from kalmark.results.evaluate import FIX_GAP_S, aligned_fixes
from kalmark.results.history import Camera, History, Ints, MapSnapshot, Measuring
from kalmark.results.landmark_table import EUCLIDEAN, EUCLIDEANS, MapLandmarks, Shapes, shapes
from kalmark.results.measures import Rigid, rigid, sigmas
from kalmark.results.recording import Recording
from kalmark.results.truth import as_rigid, move_landmarks

Style = dict[str, Any]  # keywords of matplotlib
COLUMN = re.compile(r"([uv])([lr]?)(\d*)_px")
EXPECTED = {  # names of colours, usual ones, meanings: by whether a landmark is Euclidean, then whether it was used
    (True, True): ("landmarks_used", "#0aa5b5", "Euclidean, used"),
    (True, False): ("landmarks_predicted", "#1f3fd0", "Euclidean, predicted only"),
    (False, True): ("others_used", "#d81b1b", "not Euclidean, used"),
    (False, False): ("others_predicted", "#c218c2", "not Euclidean, predicted only"),
}
IN_VIEW = "in view, not measured"
SIDES = {"": "", "l": "left", "r": "right"}
COLOURS = ("#1f5fa8", "#c8553d", "#2f8f5b", "#8456a8", "#b8892b", "#2a9aa5", "#b0457a", "#6b6f2a")
SPACE_COLOURS = ("#2f8f5b", "#8456a8", "#b8892b", "#2a9aa5", "#6b6f2a", "#b0457a")  # landmarks are blue or red
TRUTH_COLOUR, FIX_COLOUR, INK = "#8b929c", "#7a3fa0", "#2b2f36"
GAP_STEPS = 10.0
POINTS = 2000  # of a curve
CLEAR = 0.3  # a point whose sigma is a larger part of its distance does not widen the picture
REACH, REACH_M = 0.15, 0.5  # a contour widens the picture by at most this part of it, or so much
PAD, PAD_M = 0.04, 0.2  # around it, a part of its longest side, or so much
OUTCOME_COLOURS = {
    "associated": "#4a8f7b", "new": "#d2a23c", "rejected": "#c8553d", "ignored": "#8b929c",
    "deferred": "#5b67a8", "tentative": "#9a62ab",
}  # fmt: skip
NARROW = 0.15  # the least width of a plan, as a part of its length
FRAMES = 6  # cameras are drawn at so many poses of a path
NOSE = np.array([[0.36, 0.16], [0.62, 0.0], [0.36, -0.16]])  # of a robot, which shows its heading
TURN = np.linspace(0.42, 2.0 * np.pi - 0.42, 24)
BODIES = {  # outlines (P, 2) of robots, which look along x
    "dart": np.array([[0.62, 0.0], [-0.38, 0.36], [-0.16, 0.0], [-0.38, -0.36], [0.62, 0.0]]),
    "box": np.vstack([NOSE, [[0.36, -0.32], [-0.4, -0.32], [-0.4, 0.32], [0.36, 0.32]], NOSE[:1]]),
    "disc": np.vstack([NOSE, 0.394 * np.column_stack([np.cos(TURN), -np.sin(TURN)]), NOSE[:1]]),
}
MAST = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.4]])  # of a robot in space, upwards
BODY_SIZE = 0.035  # as a part of a scene's
SQUARE = np.array([[-0.5, -0.5, 0], [0.5, -0.5, 0], [0.5, 0.5, 0], [-0.5, 0.5, 0], [-0.5, -0.5, 0]])


class Ray(NamedTuple):
    """An observation of a scan: its outcome, and positions (d,) of the sensor, the observed point and the landmark.

    `seen_at` is NaN of a sensor that does not measure all coordinates, `landmark` of an observation without one.
    """

    outcome: str
    sensor: Array
    seen_at: Array
    landmark: Array


class Way(NamedTuple):
    """A robot's way up to a step: poses (N, 3|7) and the covariances (N, d, d) of their positions.

    `stretches` (S,) are the gaps in time up to each of all its steps, `dotted` (S,) flags those to which the way is
    unknown.  `dead` (N, d) are positions by dead reckoning, `truth` (N or 0, 3|7; NaN: unknown) true poses, `fixes`
    (F, 2) those to score with and `used` (F, d) those that the filter used.
    """

    path: Array
    covariances: Array
    stretches: Ints
    dotted: Flags
    dead: Array
    truth: Array
    fixes: Array
    used: Array


def places_of_classes(landmarks: MapLandmarks, at: Mapping[str, Array]) -> dict[str, Array]:
    """Return where the landmarks of each class are (N, d), by the places (d,) of all that are to be drawn."""
    out: dict[str, list[Array]] = {}
    for name, (of, _) in sorted(landmarks.classes.items(), key=lambda each: each[1]):
        if str(name) in at:
            out.setdefault(of, []).append(at[str(name)])
    return {of: np.array(places) for of, places in out.items()}


@dataclass(frozen=True, eq=False)
class Scene:
    """A run up to one of its steps, or a filter now, in the plane (d = 2) or in space (d = 3).

    `ways` are those of the robots.  `ids` and `shapes` are the landmarks of the map, `true_landmarks` true places,
    `known` (N, d) are the landmarks known exactly and `known_ids` their names.
    `unseen` (N, d) are those that were not seen again where they should be, `classes` the places (N, d) of each class.
    `repeats` (3 P, d) lines between landmarks that were mapped twice, NaN between them.  `low` and `high` (d,) are the
    corners of the box to draw, the same for all steps.  Covariances are those of the shape (`kalmark.results.gauge`) or
    those in the `world`.  The truth is `aligned` by a rigid motion of the path where the frames differ, and
    for the shape.  `rays` are the observations of the last scan, `picture` the options, and `end` is the text of the
    robots' last pose in a legend.
    """

    d: int
    ways: dict[str, Way]
    true_landmarks: LandmarkPlaces
    ids: tuple[Id, ...]
    shapes: Shapes
    cameras: tuple[Camera, ...]
    low: Array
    high: Array
    repeats: Array
    unseen: Array
    known: Array
    known_ids: tuple[Id, ...]
    world: bool
    aligned: bool
    rays: tuple[Ray, ...] = ()
    picture: Picture = USUAL
    end: str = "end"
    classes: Mapping[str, Array] = field(default_factory=dict)

    @classmethod
    def of(cls, run: Recording, step: int | None = None, world: bool = False) -> Scene:
        """Return the scene of a run after a step, by default the last; the box is that of the whole run."""
        history, d, picture = run.history, run.history.d, picture_of(run)
        world = world or picture.ellipses == "world"
        known = np.isfinite(run.truth.poses).all(axis=1)
        aligned = bool(known.any()) and not (run.truth.frame == "truth" and (world or run.truth.anchored))
        to_map = run.truth.to_map()
        if aligned:
            some = np.flatnonzero(known)[spread_indices(int(known.sum()))]
            to_map = rigid(_corners(run.truth.poses[some]), _corners(history.poses[some]))
        landmarks = {
            i: l if d == 3 or len(l) == 2 * d else l[:2] for i, l in move_landmarks(to_map, run.truth.landmarks).items()
        }
        last, exact = run.landmarks.split()
        end = history.map_at(len(history.t_ns))
        as_kept = not world and end.ids == tuple(last.ids)
        whole = map_shapes(end, d, world) if as_kept else shapes(*last.places(), last.kinds, d)
        now, ids = whole, tuple(last.ids)
        if step is not None:
            kept = history.map_at(step)
            now, ids = map_shapes(kept, d, world), kept.ids
        P = history.pose_covariances[:, :d, :d] if world else history.robot_shape(np.arange(len(history.t_ns)))
        final = [np.flatnonzero(history.robot == robot)[-1:] for robot in history.robots]
        ends = np.concatenate([np.zeros(0, dtype=np.int64), *final])
        known_at = exact.positions()[0][:, :d]
        fixes = [used_fixes(run, robot) for robot in history.robots]
        more = [to_map.poses(run.truth.poses)[:, :d], *fixes, *places_of(landmarks, d), known_at]
        low, high = drawn_box(history.poses[:, :d], history.poses[ends, :d], P[ends], whole, more, picture)
        at = {str(name): now.means[k] for k, name in enumerate(ids)}
        twice = [np.array([at[row.landmark], at[row.other]]) for row in history.repeats if {*row[1:3]} <= at.keys()]
        unseen = np.array([at[str(i)][:d] for i in last.ids if i in last.unseen and str(i) in at]).reshape(-1, d)
        return cls(
            d, {robot: way_of(run, robot, P, to_map, step) for robot in history.robots}, landmarks, ids, now,
            history.cameras, low, high, join_polylines([line[:, :d] for line in twice], d), unseen, known_at,
            tuple(exact.ids), world, aligned, picture=picture, classes=places_of_classes(last, at),
        )  # fmt: skip

    @property
    def of_what(self) -> str:
        """The text of the ellipses in a legend."""
        return "in the world" if self.world else "of the shape"

    def how_large(self, of: str = "") -> str:
        """Return the text of the ellipses in a legend, "" without any."""
        return "" if self.picture.ellipses == "off" else f", {self.picture.sigmas:g}σ{of} {self.of_what}"

    def rings(self, means: Array, covariances: Array) -> Array:
        """Return the contours of Gaussians as one polyline (N, d), NaN between them, and alone if none are drawn."""
        if self.picture.ellipses == "off":
            return np.full((1, self.d), np.nan)
        return join_polylines(np.concatenate(contours(means, covariances, self.picture.sigmas)), self.d)

    @property
    def how(self) -> str:
        """The alignment of the truth, for a legend."""
        return ", aligned" if self.aligned else ""

    @property
    def size(self) -> float:
        """The longest side of the box."""
        return float((self.high - self.low).max())

    @property
    def ground(self) -> float:
        """The height of the ground: 0, or the lowest there is."""
        return 0.0 if self.low[2] <= 0.0 <= self.high[2] else float(self.low[2])

    def colour(self, robot: str) -> str:
        """Return the robot's colour."""
        colours = SPACE_COLOURS if self.d == 3 else COLOURS
        return self.picture.colour(robot, colours[list(self.ways).index(robot) % len(colours)])

    def line(self, robot: str) -> Array:
        """Return a robot's path (N, d), NaN where its way is unknown."""
        return break_path(self.ways[robot].path[:, : self.d], np.cumsum(self.ways[robot].dotted))

    def bridges(self, robot: str) -> Array:
        """Return the rest of a robot's path (N, d): across gaps of time and while it is lost, NaN between them."""
        path = self.ways[robot].path[:, : self.d]
        ends = np.diff(self.ways[robot].dotted[: len(path)].astype(int), prepend=0, append=0)
        spans = zip(np.flatnonzero(ends > 0).tolist(), np.flatnonzero(ends < 0).tolist(), strict=True)
        return join_polylines([path[max(first - 1, 0) : last] for first, last in spans], self.d)

    def inside(self, lines: Array) -> Array:
        """Return polylines (..., d) with NaN where they leave the box."""
        out = (lines < self.low) | (lines > self.high)
        return np.where(out.any(axis=-1, keepdims=True), np.nan, lines)

    def frames(self, robot: str) -> list[Array]:
        """Return the shapes of a robot in space along its path."""
        path, body = self.ways[robot].path, self.body(robot)
        at = np.unique(np.linspace(0, max(len(path) - 1, 0), FRAMES).round().astype(int))
        return [_placed(pose, line) for pose in path[at[: len(path)]] for line in body]

    def body(self, robot: str) -> list[Array]:
        """Return a robot as polylines (P, 3) in its own frame: its outline, in space with a mast, and its cameras."""
        size, outline = BODY_SIZE * self.size, np.pad(BODIES[self.picture.robot], ((0, 0), (0, 1)))
        lines = [size * outline, size * MAST][: self.d - 1]
        for camera in self.cameras if self.picture.sensors else ():
            if camera.robot == robot:
                a, b, c, d = 0.03 * self.size * camera.corners
                top = np.zeros(3)  # one polyline passes all edges
                lines.append(_placed(camera.mount, np.array([a, b, top, a, d, top, c, d, c, b])))
        return lines

    @property
    def true_ends(self) -> dict[str, Array]:
        """The true poses (3|7,) of robots at the step, where they are known."""
        return {robot: w.truth[-1] for robot, w in self.ways.items() if np.isfinite(w.truth[-1:]).all(axis=1).any()}

    def true_lines(self) -> list[Array]:
        """Return the true lines (2, d)."""
        return [l.reshape(2, self.d) for l in self.true_landmarks.values() if len(l) == 2 * self.d]

    def true_points(self) -> LandmarkPlaces:
        """Return the true positions (d,) of landmarks, without lines."""
        return {i: l[: self.d] for i, l in self.true_landmarks.items() if len(l) != 2 * self.d}


def map_shapes(kept: MapSnapshot, d: int, world: bool) -> Shapes:
    """Return the shapes of a kept map, with the covariances of its shape or in the world."""
    return shapes(kept.means, kept.covariances if world else kept.shape, kept.kinds, d)


def squares(tags: Array, size: float) -> list[Array]:
    """Return tags (T, 7) as squares (5, 3) that can be seen in a scene of this size."""
    return [_placed(tag, 0.03 * size * SQUARE) for tag in tags]


def join_polylines(lines: Sequence[Array] | Array, d: int = 3) -> Array:
    """Return polylines (P, d) as one (N, d) that is broken by NaN between them."""
    parts = [part for line in lines for part in (line, np.full((1, d), np.nan))]
    return np.concatenate(parts) if parts else np.empty((0, d))


def stretches_of(t_ns: Ints) -> Ints:
    """Return the number of gaps before each of a robot's steps (N,): 3 s, and ten times the median, without a scan."""
    steps = np.diff(t_ns) * 1e-9
    if not len(steps):
        return np.zeros(len(t_ns), dtype=np.int64)
    return np.append(0, np.cumsum(steps > max(FIX_GAP_S, GAP_STEPS * float(np.median(steps)))))


def break_path(points: Array, stretches: Ints) -> Array:
    """Return a path (N, d) with a row of NaN before each new stretch, so that no line is drawn across the gap."""
    return np.insert(points, gaps_in(stretches[: len(points)]), np.nan, axis=0)


def gaps_in(stretches: Ints) -> Ints:
    """Return before which of the points with these numbers of gaps there is one."""
    return np.flatnonzero(np.diff(stretches)) + 1


def spread_indices(count: int) -> Ints:
    """Return at most about 2,000 evenly spread indices, the last one among them."""
    stride = max(1, -(-count // POINTS))
    indices = np.arange(0, count, stride)
    return np.append(indices, count - 1) if count and indices[-1] != count - 1 else indices


def thin(rows: Any) -> Any:
    """Return at most about 2,000 evenly spread rows (N, ...), the last one among them."""
    return rows[spread_indices(len(rows))]


def group_steps(steps: Ints, t_ns: Ints, each: int) -> tuple[Ints, Ints]:
    """Return the group (N,) of each of these steps, and before which groups a gap in time is.

    A group is drawn as one: what is of so many consecutive steps, and on one side of a gap.
    """
    stretches = stretches_of(t_ns)
    new = (np.diff(steps // each, prepend=-1) != 0) | (np.diff(stretches, prepend=0) != 0)
    return np.cumsum(new) - 1, gaps_in(stretches[new])


def way_of(run: Recording, robot: str, P: Array, to_map: Rigid, step: int | None = None) -> Way:
    """Return a robot's way up to a step, by default the last; P (S, d, d) are the covariances of all steps."""
    history, d = run.history, run.history.d
    rows = np.flatnonzero(history.robot == robot)
    until_ns = np.inf if step is None else int(history.t_ns[step])
    now = rows if step is None else rows[rows <= step]
    stretches, lost = stretches_of(history.t_ns[rows]), while_lost(history)[rows]
    dotted = lost | np.append(False, lost)[:-1] | (np.diff(stretches, prepend=0) > 0)
    truth, fixes = run.truth.poses[rows], np.empty((0, 2))
    scored = bool(np.isfinite(truth).any())
    if not scored and d == 2 and robot in run.truth.fixes:  # the antenna's offset is taken off
        to_fixes, _, offset, xy, t_ns = aligned_fixes(run, robot)
        fixes = (to_fixes.inverse()(xy) - offset)[t_ns <= until_ns] if len(xy) > 1 else fixes
    return Way(
        path=history.poses[now],
        covariances=P[now],
        stretches=stretches,
        dotted=dotted,
        dead=history.dead_reckoned[now, :d],
        truth=to_map.poses(truth[: len(now) if scored else 0]),
        fixes=fixes,
        used=used_fixes(run, robot, until_ns),
    )


def used_fixes(run: Recording, robot: str, until_ns: float = np.inf) -> Array:
    """Return the fixes (N, d) of a robot that the filter used until then; they are in the frame of the map."""
    used = [fix.y for fix in run.history.fixes if fix.used and fix.robot == robot and fix.t_ns <= until_ns]
    return np.array([np.pad(y, (0, run.history.d - len(y))) for y in used]).reshape(-1, run.history.d)


def _corners(poses: Array) -> Array:
    """Return the positions (4 N, 3) of poses (N, 7), or (3 N, 2) of (N, 3), and the ends of axes of 0.1 m there."""
    d = 2 if poses.shape[1] == 3 else 3
    ends = np.vstack([np.zeros(d), 0.1 * np.eye(d)])
    return np.concatenate([as_rigid(pose)(ends) for pose in poses])


def _placed(pose: Array, points: Array) -> Array:
    return points @ matrix(np.ascontiguousarray(pose[3:7])).T + pose[:3]


def places_of(landmarks: Mapping[Id, Array], d: int) -> list[Array]:
    """Return the points (N, d) of true landmarks, of lines both ends."""
    return [l.reshape(-1, d) if len(l) == 2 * d else l[None, :d] for l in landmarks.values()]


def picture_of(run: Recording) -> Picture:
    """Return the options of drawings in the configuration of a run."""
    given = run.config.get("picture") or {}
    return Picture(**{key: value for key, value in given.items() if value is not None})


def drawn_box(
    path: Array, ends: Array, P: Array, drawn: Shapes, more: list[Array], picture: Picture
) -> tuple[Array, Array]:
    """Return the corners (d,) of what is to be seen: a path, contours at its ends, landmarks whose place is clear.

    The ends (R, d) have the covariances P (R, d, d).  Contours reach out of it where they are huge.  Limits of the
    picture replace what they name.
    """
    d = path.shape[1]
    means, covariances = drawn.means, drawn.covariances
    known = is_finite(means, covariances)
    sigma = sigmas(np.where(known[:, None, None], covariances, 0.0))
    middle = path.mean(axis=0) if len(path) else np.zeros(d)
    distance = np.linalg.norm(np.where(known[:, None], means, np.inf) - middle, axis=1)
    clear = known & ((drawn.group == EUCLIDEANS) | (sigma.max(axis=1, initial=0.0) < CLEAR * distance))
    points = np.concatenate([path, means[clear], *more])
    points = points[np.isfinite(points).all(axis=1)]
    low, high = -np.ones(d), np.ones(d)
    if len(points):
        limit = max(REACH * float(np.ptp(points, axis=0).max()), REACH_M)
        centres = np.concatenate([means[clear], ends])
        reach = np.fmin(3 * np.concatenate([sigma[clear], sigmas(P)]), limit)
        points = np.concatenate([points, centres - reach, centres + reach])
        low, high = points.min(axis=0), points.max(axis=0)
        middle, half = (low + high) / 2, (high - low) / 2
        half += max(2 * PAD * float(half.max()), PAD_M)
        half[:2] = np.maximum(half[:2], NARROW * half.max())
        low, high = middle - half, middle + half
    given = np.reshape(picture.limits_m or (), (-1, 2))[:d]
    low[: len(given)], high[: len(given)] = given.T
    return low, high


class ImageObservation(NamedTuple):
    """One observation in one image: its name, what became of it, what was measured and what was expected.

    `measured` and `expected` (V, 2) are pixels, one row a point; without an expectation the latter is NaN.  `Z` (2, 2)
    is the covariance of the innovation of a single point, NaN of what has several.  A landmark in view that was not
    measured has the outcome `IN_VIEW` and `measured` (0, 2).
    """

    name: str
    outcome: str
    euclidean: bool
    measured: Array
    expected: Array
    Z: Array


class Image(NamedTuple):
    """One image of a scan: "left", "right" or "" for the only one, and all that was seen in it."""

    side: str
    observations: list[ImageObservation]


def images(history: History, camera: Camera, step: int) -> list[Image]:
    """Return the images of the scan that a camera made at a step."""
    seen: list[Any] = []
    for row in np.flatnonzero(history.step == step):
        name, outcome = str(history.landmark[row]) or str(history.id[row]), str(history.outcome[row])
        named = name, outcome, str(history.kind[row]) in EUCLIDEAN
        seen.append((named, history.e[row], history.Z[row], history.y[row], history.z[row]))
    for row in np.flatnonzero((history.unmeasured_step == step) & (history.unmeasured_sensor == camera.sensor)):
        named = str(history.unmeasured_landmark[row]), IN_VIEW, str(history.unmeasured_kind[row]) in EUCLIDEAN
        seen.append((named, history.unmeasured_e[row], history.unmeasured_Z[row]))
    return _images(camera, seen)


def sides_of(camera: Camera) -> list[str]:
    """Return the names of a camera's images: "left" and "right" of a pair, "" of a single one."""
    return [SIDES[side] for side in _points(camera)]


def images_of_report(camera: Camera, report: Report, kinds: Sequence[str]) -> list[Image]:
    """Return the images of a scan that a camera made; `kinds` are those of the landmarks of its observations."""
    seen = []
    for o, kind in zip(report.observations, kinds, strict=True):
        name, k = next((str(each) for each in (o.landmark, o.id) if each is not None), ""), o.index
        seen.append(((name, o.outcome, kind in EUCLIDEAN), report.e[k], report.Z[k], report.y[k], report.z[k]))
    return _images(camera, seen)


def _images(camera: Camera, seen: Iterable[tuple[Any, ...]]) -> list[Image]:
    """Return the images of a camera in which each was seen: names of it, e and Z, and y and z if it was measured.

    The names are its own, its outcome, and whether it is Euclidean.
    """
    points = _points(camera)
    found = [Image(SIDES[side], []) for side in points]
    for (name, outcome, euclidean), e, Z, *measured in seen:
        whole = len({np.isfinite(numbers).sum() for numbers in measured}) < 2
        for image, at in zip(found, points.values(), strict=True):
            Z_at = Z[np.ix_(at[0], at[0])] if whole and len(at) == 1 else np.full((2, 2), np.nan)
            y_at = measured[0][at] if measured else np.empty((0, 2))
            image.observations.append(ImageObservation(name, outcome, euclidean, y_at, e[at], Z_at))
    return found


def colour_of(observation: ImageObservation, picture: Picture) -> tuple[str, str]:
    """Return the colour of an expectation and what it means."""
    name, usual, meaning = EXPECTED[observation.euclidean, observation.outcome == "associated"]
    return picture.colour(name, usual), meaning


def steps_of(history: History, camera: Camera | Measuring) -> Ints:
    """Return the steps at which a sensor observed something."""
    return np.unique(history.step[history.made_by(camera.robot, camera.sensor)])


def _points(camera: Camera) -> dict[str, Ints]:
    """Return the columns (V, 2) of u and v of the points in each image."""
    found: dict[str, dict[str, dict[str, int]]] = {}
    for k, name in enumerate(camera.columns):
        match = COLUMN.fullmatch(name)
        if match is not None:
            axis, side, number = match.groups()
            found.setdefault(side, {}).setdefault(number, {})[axis] = k
    # a stereo pair without the right image's v has it from the left one: the pair is rectified
    left = found.get("l", {}).get("", {})
    return {
        side: np.array([[at["u"], at.get("v", left.get("v", 0))] for at in points.values()], dtype=np.int64)
        for side, points in found.items()
    }


def clip_line(a: Array, b: Array, size: tuple[float, float]) -> Array | None:
    """Return the part (2, 2) of the straight line through two pixels that lies in an image, None if there is none."""
    d = b - a
    if not (np.isfinite(d).all() and d.any()):
        return None
    first, last = -np.inf, np.inf
    for k in (0, 1):
        if d[k] == 0:
            if not 0 <= a[k] <= size[k]:
                return None
            continue
        near, far = sorted((-a[k] / d[k], (size[k] - a[k]) / d[k]))
        first, last = max(first, near), min(last, far)
    return np.array([a + first * d, a + last * d]) if first < last else None
