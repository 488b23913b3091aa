"""`draw`: the picture of a filter now, for a program's own loop and for animations."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from kalmark.arrays import Array
from kalmark.errors import KalmarkError, MapError
from kalmark.events import Fix, Id, Scan, short_text
from kalmark.geometry.pose_frames import ORIGIN
from kalmark.logs.log import LandmarkPlaces, Log, begins_at, poses_of_size
from kalmark.picture_options import Picture
from kalmark.report import Report
from kalmark.results.filter_description import cameras, mount_now, observed_points
from kalmark.results.history import RobotStart
from kalmark.results.landmark_table import MapLandmarks, shapes
from kalmark.results.measures import Rigid
from kalmark.results.scene import Ray, Scene, Way, drawn_box, places_of, places_of_classes
from kalmark.results.truth import as_rigid, frame_offset, landmarks_of_size, move_landmarks

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from kalmark.slam.slam import Slam

DRAWN = "kalmark"  # the gid of what `draw` has drawn on axes


def draw(
    slam: Slam,
    ax: Axes | None = None,
    truth: Any = None,
    report: Report | Iterable[Report] = (),
    path: Any = None,
    **options: Any,
) -> Axes:
    """Draw robots and landmarks with the 3-sigma ellipses of their covariances, as they are now, and return the axes.

    On axes that it drew on before, this replaces what it drew then; without `ax` it makes a figure.  `truth` are true
    robots, now or up to now, and landmarks by their names, each an array (3,), (7,), (N, 3) or (N, 7) or a position, in
    the frame of the map; of one robot its array alone; or a log, of which the poses up to the time of the filter are
    drawn.  `report`, or several, are those of the last scans, whose observations are drawn in the colours of their
    outcomes, from the sensor to where they seem to come from, and dotted from there to the landmark.  `path` are the
    poses (N, 3|7) of a robot so far, by its name or of one robot alone.  Robots in space are seen in perspective, or as
    `view` has it.  The other `options` are those of the section `picture` of a configuration.  `axes.legend()` adds a
    legend.  Raises KalmarkError for a truth or a path of another shape.

    >>> rover = km.Robot("rover", km.motion.Unicycle(), sensors={"lidar": km.Mount(km.sensors.RangeBearing())})
    >>> slam = km.Slam(rover)
    >>> report = slam.process(km.Scan(t_s=0.0, robot="rover", sensor="lidar", y=[[4.2, 0.3]], ids=[7]))
    >>> axes = km.draw(slam, truth=[0.1, 0.0, 0.0], report=report, labels=True)
    >>> [text.get_text() for text in axes.texts]
    ['7']
    """
    from matplotlib.pyplot import subplots

    from kalmark.results.plot import Projection, draw_plan, draw_space  # matplotlib is slow to import

    picture = Picture(**{"ellipses": "world"} | options)
    scene = scene_of_filter(slam, truth, [report] if isinstance(report, Report) else report, path, picture)
    if ax is None:
        figure, ax = subplots(layout="constrained")
        if picture.width_px is not None:
            width = picture.width_px / figure.get_dpi()
            figure.set_size_inches((width, 0.75 * width))
    for artist in [*ax.get_children()]:
        if artist.get_gid() == DRAWN:
            artist.remove()
    others = {*ax.get_children()}
    if scene.d == 2:
        draw_plan(ax, scene)
    else:
        draw_space(ax, scene, Projection.of(scene))
    for artist in ax.get_children():
        if artist not in others:
            artist.set_gid(DRAWN)
    return ax


def scene_of_filter(slam: Slam, truth: Any, reports: Iterable[Report], path: Any, picture: Picture) -> Scene:
    """Return the scene of a filter now; the arguments are those of `draw`."""
    picture.check_colours(slam.robots)
    world, names, whole = picture.ellipses != "shape", tuple(slam.robots), MapLandmarks.of(slam)
    d, exact = whole.d, whole.split()[1]
    size = 3 if d == 2 else 7
    robots = np.array([slam.covariance(name)[:d, :d] for name in names])
    if not world:
        whole, robots = whole.shape(slam, names)
    mapped = whole.split()[0]
    drawn, known = shapes(*mapped.places(), mapped.kinds, d), exact.positions()[0][:, :d]
    before, nothing = _poses_by_robot(path, names, size, "path"), np.empty((0, size))
    true, landmarks = truth_until_now(slam, truth, size)
    ways = {
        name: _way(np.vstack([before.get(name, nothing), slam.mean(name)[:size]]), P[None], true.get(name, nothing))
        for name, P in zip(names, robots, strict=True)
    }
    shown = [part[:, :d] for way in ways.values() for part in (way.path, way.truth)] + [*places_of(landmarks, d), known]
    ends = np.array([way.path[-1, :d] for way in ways.values()])
    rays = tuple(ray for report in reports for ray in rays_of(slam, report)) if picture.sensors else ()
    shown += [np.array([ray.seen_at for ray in rays]).reshape(-1, d)]
    low, high = drawn_box(nothing[:, :d], ends, robots, drawn, shown, picture)
    return Scene(
        d=d,
        ways=ways,
        true_landmarks=landmarks,
        ids=tuple(mapped.ids),
        shapes=drawn,
        cameras=cameras(slam),
        low=low,
        high=high,
        repeats=np.empty((0, d)),
        unseen=np.array([mapped.means[mapped.ids.index(i)][:d] for i in mapped.unseen]).reshape(-1, d),
        known=known,
        known_ids=tuple(exact.ids),
        world=world,
        aligned=False,
        rays=rays,
        picture=picture,
        end="robot",
        classes=places_of_classes(mapped, {str(i): mean[:d] for i, mean in zip(mapped.ids, mapped.means, strict=True)}),
    )


def _way(path: Array, P: Array, truth: Array) -> Way:
    """Return a way without gaps, dead reckoning and fixes."""
    gaps, nothing = np.zeros(max(len(path), len(truth)), dtype=np.int64), np.empty((0, P.shape[1]))
    return Way(path, P, gaps, gaps > 0, nothing, truth, nothing, nothing)


def rays_of(slam: Slam, report: Report) -> list[Ray]:
    """Return the observations of the last scan of a filter, with the places of its robot and landmarks now."""
    scan = report.event
    if not isinstance(scan, Scan) or not len(report.y):
        return []
    pose, d = slam.mean(scan.robot), slam.place(scan.robot)[0].size
    at = mount_now(slam, scan.robot, scan.sensor)
    sensor = as_rigid(pose[: len(at)])(at[:d])
    seen_at = observed_points(slam, scan.robot, scan.sensor, pose[: 3 if d == 2 else 7], report.y)
    return [Ray(o.outcome, sensor, seen_at[o.index], _place(slam, o.landmark, d)) for o in report.observations]


def _place(slam: Slam, name: Id | None, d: int) -> Array:
    """Return the place (d,) of a landmark or a robot, NaN of one that is not in the map or has no position."""
    try:
        return slam.place(name)[0][:d]  # type: ignore[arg-type]
    except MapError:
        return np.full(d, np.nan)


def _poses_by_robot(given: Any, names: tuple[str, ...], size: int, what: str) -> dict[str, Array]:
    """Return poses (N, size), N > 0, by robot.  Raises KalmarkError."""
    named = given if isinstance(given, Mapping) else {} if given is None else {names[0]: given}
    try:
        rows = {name: np.asarray(poses, dtype=np.float64) for name, poses in named.items() if np.size(poses)}
        if not {*rows} <= {*names} or (rows and len(names) > 1 and named is not given):
            raise ValueError
        return {name: np.atleast_2d(poses)[:, np.arange(size)] for name, poses in rows.items()}
    except (TypeError, ValueError, IndexError):
        wanted = f"poses (N, {size}), of several robots by their names"
        raise KalmarkError(f"draw: {what} is {short_text(given)}, expected {wanted}") from None


def truth_until_now(slam: Slam, truth: Any, size: int) -> tuple[dict[str, Array], LandmarkPlaces]:
    """Return the true poses (N, size) of robots up to now and the true landmarks, in the frame of the map."""
    if isinstance(truth, Log):
        return _logged_truth(slam, truth, size)
    if not isinstance(truth, Mapping):
        return _poses_by_robot(truth, tuple(slam.robots), size, "truth"), {}
    landmarks = {i: np.asarray(l, dtype=np.float64) for i, l in truth.items() if i not in slam.robots}
    robots = {i: poses for i, poses in truth.items() if i in slam.robots}
    return _poses_by_robot(robots, tuple(slam.robots), size, "truth"), landmarks


def truth_to_map(slam: Slam, log: Log, size: int) -> Rigid:
    """Return the transform from the frame of a log's truth to that of the map, poses having `size` numbers."""
    starts = []
    for name, robot in slam.robots.items():
        t_ns, dof = begins_at(log.events, name, robot.motion.held), robot.motion.space.dof
        if t_ns is not None:
            P = np.zeros((dof, dof)) if robot.cov is None else np.asarray(robot.cov)
            starts.append(RobotStart(name, np.asarray(robot.start), P, t_ns))
    anchored = len(slam.tracks.known) or any(type(event) is Fix for event in log.events)
    return as_rigid(ORIGIN[size] if anchored else frame_offset(log.truth, starts, size))


def _logged_truth(slam: Slam, log: Log, size: int) -> tuple[dict[str, Array], LandmarkPlaces]:
    to_map = truth_to_map(slam, log, size)
    until, out = slam.t_ns or 0, {}
    for name in log.truth.keys() & slam.robots.keys():
        true = log.truth[name]
        rows = np.vstack([true.poses[true.t_ns < until], true.at(np.array([until]))])
        out[name] = to_map.poses(poses_of_size(rows, size))
    return out, move_landmarks(to_map, landmarks_of_size(log.landmarks, size))
