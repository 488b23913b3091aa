"""A recording of rerun: robots, map, scans, images, covariance and figures of a run, along its time.

Everything of the map is in three dimensions under ``map``, that of a plane at z = 0.  Nothing leaves the machine: a
file is written, or the viewer is started on a port of 127.0.0.1 alone, without its usage statistics.
"""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from kalmark.arrays import Array
from kalmark.errors import PluginError
from kalmark.geometry.gaussian import contours, is_finite
from kalmark.geometry.rotations import from_matrix
from kalmark.logs.log import poses_of_size
from kalmark.picture_options import Picture
from kalmark.results.measures import anees_interval, correlations_of, sigmas
from kalmark.results.plot import BEHIND, GROUPS, Projection
from kalmark.results.scene import (
    EXPECTED,
    INK,
    OUTCOME_COLOURS,
    TRUTH_COLOUR,
    Image,
    Scene,
    colour_of,
    sides_of,
    squares,
)

INSTALL = "rerun is not installed, expected it for this view: pip install 'kalmark[view]'"
LOOPBACK = "127.0.0.1"
PATIENCE_S = 3.0  # after which a viewer has opened its window, or has ended
SHAPE = 0.625  # height of a window as a part of its width
SPIN = 0.2  # of the eye in an orbit
QUALITY = 75  # of an image, compressed as JPEG
BOUND = "#9a9a9a"  # of what a figure of consistency is compared with
PIECE = 0.005  # of the size of the map: the least length of a piece of a path
MARK, LINE, BEAM = -2.5, -1.2, -0.5  # radii; negative ones are points of the screen
AXES = {"x": "#ff7f7f", "y": "#8fd18f", "z": "#8fb4ff"}  # of the world, and of rotations about them


class Stream:
    """A recording of rerun, sent to a viewer that it starts, or to a file.  Raises PluginError without rerun."""

    def __init__(self, name: str, scene: Scene, path: Path | None = None) -> None:
        try:
            import rerun
        except ImportError:
            raise PluginError(INSTALL) from None
        self.rr: Any = rerun
        # a connection would send each row alone, ten times the bytes of a file, which has those of 0.2 s together
        together = rerun.ChunkBatcherConfig.DEFAULT()
        self.recording = rerun.RecordingStream("kalmark", recording_id=name or None, batcher_config=together)
        self.path, self.d, self.size, self.last = path, scene.d, scene.size, dict[str, Array]()
        self.picture, self.colours = scene.picture, {robot: scene.colour(robot) for robot in scene.ways}
        if path is None:
            self.recording.connect_grpc(start_viewer(scene.picture.width_px))
        else:
            path.parent.mkdir(parents=True, exist_ok=True)
            self.recording.save(str(path))
        self._describe(scene)

    def put(self, entity: str, *things: Any, static: bool = False) -> None:
        """Log archetypes of rerun to an entity, now."""
        self.recording.log(entity, *things, static=static)

    def set_time(self, t_s: float, step: int) -> None:
        """Set the time, s since the first scan, and the number of the step, of all that follows."""
        self.recording.set_time("time", duration=t_s)
        self.recording.set_time("step", sequence=step)

    def _describe(self, scene: Scene) -> None:
        """Log what does not change: the bodies of robots, true landmarks, names of curves and the arrangement."""
        rr, true = self.rr, rgb(scene.picture.colour("truth", TRUTH_COLOUR))
        self.put("map", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        for robot in scene.ways:
            colour, lines = scene.colour(robot), scene.body(robot)
            body = rr.LineStrips3D(lines, colors=rgb(colour), radii=LINE)
            self.put(f"map/robots/{robot}/body", body, static=True)
            if len(scene.ways) > 1:
                name = rr.Points3D([[0.0, 0.0, 0.0]], colors=rgb(colour), labels=[robot], show_labels=True, radii=LINE)
                self.put(f"map/robots/{robot}/name", name, static=True)
            if scene.picture.truth:
                self.put(f"map/true_robots/{robot}/body", rr.LineStrips3D(lines, colors=true, radii=LINE), static=True)
            place, turn = [*AXES][: self.d], ["z"] if self.d == 2 else [*AXES]
            self._curves(f"sigma/{robot}/position", {name: AXES[name] for name in place})
            self._curves(f"sigma/{robot}/rotation", {f"about {name}": AXES[name] for name in turn})
            self._curves(f"consistency/NEES/{robot}", {robot: colour, "from": BOUND, "to": BOUND})
        self._curves("consistency/NIS", {"NIS": AXES["y"], "expected": BOUND})
        places = [l[:2] if self.d == 2 else l[:3] for l in scene.true_points().values()]
        if scene.picture.truth and places:
            points = rr.Points3D(xyz(np.array(places)), colors=true, radii=MARK)
            self.put("map/true_landmarks", points, static=True)
        if scene.picture.truth and scene.true_lines():
            self.put("map/true_lines", rr.LineStrips3D([*map(xyz, scene.true_lines())], colors=true), static=True)
        self.recording.send_blueprint(self._arranged(scene))

    def _curves(self, entity: str, colours: dict[str, str]) -> None:
        """Log names and colours of the curves of an entity."""
        lines = self.rr.SeriesLines(names=[*colours], colors=[rgb(colour) for colour in colours.values()])
        self.put(entity, lines, static=True)

    def _arranged(self, scene: Scene) -> Any:
        import rerun.blueprint as rrb

        rr = self.rr
        forever = rrb.VisibleTimeRanges(
            [
                rrb.VisibleTimeRange(
                    timeline, start=rrb.TimeRangeBoundary.infinite(), end=rrb.TimeRangeBoundary.cursor_relative()
                )
                for timeline in ("time", "step")
            ]
        )
        paths = [f"map/paths/{robot}" for robot in scene.ways] + [f"map/true_paths/{robot}" for robot in scene.ways]
        view, first = scene.picture.view, next(iter(scene.ways))
        behind, (position, target, up) = view == "self" and self.d == 3, eye_of(scene)
        if behind:
            offset, axes = eye_behind(scene.size)
            place = rr.Transform3D(translation=offset, mat3x3=axes)
            plane = rr.Pinhole(fov_y=1.0, aspect_ratio=1.5, image_plane_distance=0.01 * scene.size, color=[0, 0, 0, 0])
            self.put(f"map/robots/{first}/behind", place, plane, static=True)
        look = rrb.EyeControls3D(
            position=position,
            look_target=target,
            eye_up=up,
            spin_speed=SPIN if view == "orbit" else None,
            tracking_entity=f"map/robots/{first}/behind" if behind else None,
        )
        three = rrb.Spatial3DView(origin="map", name="map", overrides=dict.fromkeys(paths, forever), eye_controls=look)

        def curves(origin: str, name: str, named: bool) -> Any:
            shown = rrb.PlotLegend(rrb.Corner2D.LeftTop, visible=named)
            return rrb.TimeSeriesView(origin=origin, name=name, plot_legend=shown)

        turn = f"{'sigma of the heading' if self.d == 2 else 'sigmas of the rotation'} (rad)"
        sigmas = [
            rrb.Vertical(
                curves(f"sigma/{robot}/position", "sigmas of the position (m)", True),
                curves(f"sigma/{robot}/rotation", turn, False),
                name=robot,
            )
            for robot in scene.ways
        ]
        figures = [
            curves("consistency/NEES", "NEES of the pose and its 95 % band", False),
            curves("consistency/NIS", "NIS per degree of freedom, 1 expected", False),
            rrb.Tabs(*sigmas) if len(sigmas) > 1 else sigmas[0],
        ]
        correlations = rrb.Spatial2DView(origin="covariance", name="correlations of P")
        views = [
            rrb.Spatial2DView(
                origin="/".join(filter(None, ["images", c.robot, c.sensor, side])),
                name=f"{c.sensor} {side}".strip(),
                visual_bounds=rrb.VisualBounds2D(x_range=(0.0, c.size[0]), y_range=(0.0, c.size[1])),
            )
            for c in scene.cameras
            for side in sides_of(c)
        ]
        if views:
            left = rrb.Vertical(three, rrb.Horizontal(*views, correlations), row_shares=[2, 1])
        else:
            left, figures = three, [*figures, correlations]
        beside = rrb.Vertical(*figures, row_shares=[1, 1, 2, 2][: len(figures)])
        return rrb.Blueprint(rrb.Horizontal(left, beside, column_shares=[2, 1]), collapse_panels=True)

    def robot(self, name: str, pose: Array, P: Array, true: Array, nees: float) -> None:
        """Log a robot at a pose (3|7,) of covariance P (3, 3) or (6, 6), its true pose and NEES, NaN if not known."""
        rr, colour = self.rr, self.colours[name]
        self._move(f"map/robots/{name}", f"map/paths/{name}", pose, colour)
        if self.picture.ellipses != "off":
            ellipsoid = self._ellipsoids(pose[None, : self.d], P[None, : self.d, : self.d], rgb(colour))
            self.put(f"map/robot_ellipses/{name}", ellipsoid)
        sigma = sigmas(P)
        self.put(f"sigma/{name}/position", rr.Scalars(sigma[: self.d]))
        self.put(f"sigma/{name}/rotation", rr.Scalars(sigma[self.d :]))
        if np.isfinite(true).all() and self.picture.truth:
            colour = self.picture.colour("truth", TRUTH_COLOUR)
            self._move(f"map/true_robots/{name}", f"map/true_paths/{name}", true, colour)
        if np.isfinite(nees):
            self.put(f"consistency/NEES/{name}", rr.Scalars([nees, *anees_interval(len(P))]))

    def _move(self, entity: str, path: str, pose: Array, colour: str) -> None:
        whole = poses_of_size(pose[None], 7)[0]
        self.put(entity, self.rr.Transform3D(translation=whole[:3], quaternion=whole[3:7]))
        before = self.last.setdefault(entity, whole)
        if np.linalg.norm(whole[:3] - before[:3]) > PIECE * self.size:
            self.put(path, self.rr.LineStrips3D([[before[:3], whole[:3]]], colors=rgb(colour), radii=LINE))
            self.last[entity] = whole

    def landmarks(self, scene: Scene) -> None:
        """Log the landmarks of a map: points, ellipsoids, lines and tags, by their groups."""
        rr, shapes = self.rr, scene.shapes
        plane = self.d == 2
        colours = [scene.picture.colour(name, usual) for usual, name, _ in GROUPS[self.d]]
        known = is_finite(shapes.means, shapes.covariances)
        mine = np.array([rgb(colours[group]) for group in shapes.group[known].tolist()]).reshape(-1, 3)
        names = [str(scene.ids[row]) for row in shapes.row[known].tolist()]
        points = rr.Points3D(
            xyz(shapes.means[known]),
            colors=mine,
            labels=names,
            show_labels=scene.picture.labels,
            radii=MARK,
        )
        self.put("map/landmarks", points)
        if scene.picture.ellipses != "off":
            self.put("map/landmark_ellipses", self._ellipsoids(shapes.means[known], shapes.covariances[known], mine))
        self.put("map/lines", rr.LineStrips3D([*map(xyz, shapes.lines)], colors=rgb(colours[2])))
        if not plane:
            self.put("map/tags", rr.LineStrips3D(squares(shapes.tags, scene.size), colors=rgb(colours[0])))

    def _ellipsoids(self, means: Array, covariances: Array, colours: Any) -> Any:
        values, axes = np.linalg.eigh(covariances)
        axes[np.linalg.det(axes) < 0, :, 0] *= -1.0
        whole = np.tile(np.eye(3), (len(means), 1, 1))
        whole[:, : self.d, : self.d] = axes
        half = np.zeros((len(means), 3))
        half[:, : self.d] = self.picture.sigmas * np.sqrt(np.maximum(values, 0.0))
        return self.rr.Ellipsoids3D(
            centers=xyz(means),
            half_sizes=half,
            quaternions=[from_matrix(np.ascontiguousarray(R)) for R in whole],
            colors=colours,
            line_radii=BEAM,
            fill_mode=self.rr.components.FillMode.MajorWireframe,
        )

    def scan(self, scene: Scene) -> None:
        """Log the observations of a scan in the colours of their outcomes, with lines to the landmarks."""
        rr = self.rr
        if not scene.picture.sensors:
            return
        seen = [ray for ray in scene.rays if np.isfinite(ray.seen_at).all()]
        ends = [(ray, ray.seen_at if np.isfinite(ray.seen_at).all() else ray.landmark) for ray in scene.rays]
        beams = [(ray, end) for ray, end in ends if np.isfinite(end).all()]
        colours = [rgb(OUTCOME_COLOURS.get(ray.outcome, INK)) for ray, _ in beams]
        self.put(
            "map/scan/beams",
            rr.LineStrips3D([xyz(np.array([r.sensor, e])) for r, e in beams], colors=colours, radii=BEAM),
        )
        colours = [rgb(OUTCOME_COLOURS.get(ray.outcome, INK)) for ray in seen]
        places = xyz(np.array([ray.seen_at for ray in seen]).reshape(-1, self.d))
        outcomes = [ray.outcome for ray in seen]
        self.put(
            "map/scan/observations",
            rr.Points3D(places, colors=colours, labels=outcomes, show_labels=False, radii=MARK),
        )
        pairs = [(ray, colour) for ray, colour in zip(seen, colours, strict=True) if np.isfinite(ray.landmark).all()]
        strips = [xyz(np.array([ray.seen_at, ray.landmark])) for ray, _ in pairs]
        self.put("map/scan/innovations", rr.LineStrips3D(strips, colors=[colour for _, colour in pairs], radii=BEAM))

    def image(self, entity: str, image: Image, size: tuple[float, float], picture: Any) -> None:
        """Log an image of a scan: the pixels (H, W) if there are some, measured points and expectations."""
        rr = self.rr
        entity = f"{entity}/{image.side}" if image.side else entity
        if picture is not None:
            self.put(f"{entity}/pixels", rr.Image(picture).compress(jpeg_quality=QUALITY))
        else:
            self.put(f"{entity}/border", rr.Boxes2D(mins=[[0, 0]], sizes=[size], colors=rgb(TRUTH_COLOUR)))
        measured = [(point, s.outcome) for s in image.observations for point in s.measured]
        colours = [rgb(OUTCOME_COLOURS.get(outcome, INK)) for _, outcome in measured]
        self.put(f"{entity}/measured", rr.Points2D([point for point, _ in measured], colors=colours, radii=2.5))
        expected = [s for s in image.observations if len(s.expected) and np.isfinite(s.expected).all()]
        strips = [
            contours(s.expected, s.Z[None], self.picture.sigmas)[0, 0]
            if len(s.expected) == 1 and np.isfinite(s.Z).all()
            else np.vstack([s.expected, s.expected[:1]])
            for s in expected
        ]
        lines = rr.LineStrips2D(
            strips, colors=[rgb(colour_of(s, self.picture)[0]) for s in expected], labels=[s.name for s in expected],
            show_labels=self.picture.labels,
        )  # fmt: skip
        self.put(f"{entity}/expected", lines)

    def correlations(self, P: Array) -> None:
        """Log a covariance (n, n) as an image of its correlations: blue -1, white 0, red 1."""
        from matplotlib import colormaps

        pixels = colormaps["RdBu_r"](0.5 + 0.5 * correlations_of(P))[..., :3]
        self.put("covariance", self.rr.Image((255 * pixels).astype(np.uint8)))

    def nis(self, value: float, dof: int) -> None:
        """Log the NIS of the observations of a scan, divided by its degrees of freedom."""
        if dof:
            self.put("consistency/NIS", self.rr.Scalars([value / dof, 1.0]))


def xyz(points: Array) -> Array:
    """Return points (N, 2 or 3) in three dimensions (N, 3), those of the plane at z = 0."""
    return points if points.shape[1] == 3 else np.pad(points, ((0, 0), (0, 1)))


def rgb(colour: str) -> list[int]:
    """Return a colour of matplotlib as three numbers from 0 to 255."""
    from matplotlib.colors import to_rgb

    return [round(255 * part) for part in to_rgb(colour)]


def light_colours(scene: Scene) -> Picture:
    """Return the picture's options with usual colours that are mixed with white: the viewer is dark."""
    usual = {name: colour for colour, name, _ in GROUPS[scene.d]}
    usual |= {name: colour for name, colour, _ in EXPECTED.values()} | {
        robot: scene.colour(robot) for robot in scene.ways
    }
    light = {name: "#" + bytes(round(0.6 * part + 102) for part in rgb(colour)).hex() for name, colour in usual.items()}
    return replace(scene.picture, colours=light | dict(scene.picture.colours or {}))


def eye_of(scene: Scene) -> tuple[Array, Array, Array]:
    """Return the position of the eye, the point that it looks at, and the direction upwards, by the picture's view."""
    low, high = (xyz(corner[None])[0] for corner in (scene.low, scene.high))
    view = scene.picture.view if scene.d == 3 and scene.picture.view != "self" else "top" if scene.d == 2 else "normal"
    _, up, ahead = Projection.of(scene, view).axes
    middle = (low + high) / 2
    return middle + 0.9 * float(np.linalg.norm(high - low)) * ahead, middle, up


def eye_behind(size: float) -> tuple[Array, Array]:
    """Return the place (3,) of the eye behind a robot in its frame, and its axes (3, 3): right, down, ahead."""
    elevation, _, share = BEHIND
    e = np.radians(elevation)
    ahead, right = np.array([np.cos(e), 0.0, -np.sin(e)]), np.array([0.0, -1.0, 0.0])
    return -share * size * ahead, np.column_stack([right, np.cross(ahead, right), ahead])


def start_viewer(width_px: float | None = None) -> str:
    """Start the viewer on a free port of 127.0.0.1, without its statistics, and return its address.

    Its window has its usual width or another one.  Raises PluginError if there is none.
    """
    folders = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])
    executable = shutil.which("rerun", path=folders)
    if executable is None:
        raise PluginError(INSTALL)
    with socket.socket() as free:
        free.bind((LOOPBACK, 0))
        port = free.getsockname()[1]
    command = [executable, "--bind", LOOPBACK, "--port", str(port), "--expect-data-soon", "--hide-welcome-screen"]
    command += [] if width_px is None else ["--window-size", f"{width_px:.0f}x{SHAPE * width_px:.0f}"]
    quiet = os.environ | {"CI": "true", "RUST_LOG": "error"}  # rerun sends no statistics of what runs in a CI
    with tempfile.TemporaryFile("w+") as errors:
        viewer = subprocess.Popen(command, env=quiet, stderr=errors, start_new_session=True)
        try:
            viewer.wait(PATIENCE_S)
        except subprocess.TimeoutExpired:
            return f"rerun+http://{LOOPBACK}:{port}/proxy"
        errors.seek(0)
        said = errors.read().strip().splitlines() or ["it ended"]
    raise PluginError(f"rerun cannot open a window here: {said[-1]}; --save FILE.rrd, --view-to FILE.rrd write a file")
