"""The viewer `rerun`: `replay` shows the folder of a run, `follow` a filter while it runs."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from kalmark.arrays import Array
from kalmark.errors import RunError
from kalmark.events import Control, Event, Fix, Frame, kind_of
from kalmark.logs.log import Log, poses_of_size
from kalmark.logs.progress import track
from kalmark.picture_options import Picture
from kalmark.report import Report
from kalmark.results.camera_log import images_of_cameras
from kalmark.results.filter_description import mount_now, observed_points
from kalmark.results.filter_picture import scene_of_filter, truth_to_map
from kalmark.results.history import WHOLE
from kalmark.results.measures import associated_nis, nees, nis, pose_error
from kalmark.results.recording import Recording
from kalmark.results.scene import Ray, Scene, images, images_of_report, map_shapes, picture_of, steps_of
from kalmark.results.truth import as_rigid
from kalmark.viewer.rerun_stream import Stream, light_colours

if TYPE_CHECKING:
    from kalmark.slam.slam import Slam

MOST = 100  # landmarks whose correlations are shown
LEAST_S = 0.1  # between two pictures of a map, of a view that follows


def _world(picture: Picture) -> Picture:
    """Return the picture with the ellipses that the filter itself has, or none."""
    return picture if picture.ellipses == "off" else replace(picture, ellipses="world")


def follow(slam: Slam, log: Log, picture: Picture, save: Path | None = None) -> Callable[[Event, Report], None]:
    """Show a filter, a new one, while it processes a log: return what is called with each event and its report.

    With `save` it is written to a file of rerun, which has every scan; a window has at most ten maps a second.
    Raises PluginError without rerun.
    """
    picture = _world(picture)
    scene = scene_of_filter(slam, log, (), None, picture)
    picture = light_colours(scene)
    scene = replace(scene, picture=picture)
    size = 3 if scene.d == 2 else 7
    stream, to_map = Stream(log.name, scene, save), truth_to_map(slam, log, size)
    scans = bool(log.sensors())
    steps, begin_ns, last_s = 0, 0, -np.inf

    def truth(name: str, t_ns: int) -> Array:
        true = log.truth.get(name)
        unknown = np.full(size, np.nan)
        return unknown if true is None else to_map.poses(poses_of_size(true.at(np.array([t_ns])), size))[0]

    def observe(event: Event, report: Report) -> None:
        nonlocal steps, begin_ns, last_s
        if scans and isinstance(event, Control | Fix):
            return
        begin_ns = begin_ns if steps else event.t_ns
        stream.set_time((event.t_ns - begin_ns) * 1e-9, steps)
        steps += 1
        pose, q = slam.mean(event.robot)[:size], 3 if size == 3 else 6
        P, true = slam.covariance(event.robot)[:q, :q], truth(event.robot, event.t_ns)
        error = pose_error(pose, true, slam.estimator.coordinates)
        stream.robot(event.robot, pose, P, true, float(nees(error, P)) if np.isfinite(error).all() else np.nan)
        used = [o.index for o in report.observations if o.outcome == "associated"]
        value, dof = nis(report.z[used], report.Z[used]) if used else (np.zeros(0), np.zeros(0, dtype=np.int64))
        stream.nis(float(value[dof > 0].sum()), int(dof.sum()))
        now_s = time.monotonic()
        if save is None and now_s - last_s < LEAST_S:
            return
        now = scene_of_filter(slam, None, [report], None, picture)
        stream.landmarks(now)
        stream.scan(now)
        stream.correlations(slam.covariance(*slam.robots, *now.ids[:MOST]))
        models = [None if o.landmark is None else slam.landmark_model(o.landmark) for o in report.observations]
        kinds = ["" if model is None else model.kind for model in models]
        for camera in now.cameras:
            if kind_of(event)[1:] == (camera.robot, camera.sensor):
                for image in images_of_report(camera, report, kinds):
                    frame = event if isinstance(event, Frame) else None
                    grey = None if frame is None else frame.right_grey() if image.side == "right" else frame.grey()
                    stream.image(f"images/{camera.robot}/{camera.sensor}", image, camera.size, grey)
        last_s = now_s

    return observe


def replay(run: Recording, save: Path | None = None) -> None:
    """Show a run again, or write it to a file of rerun: all its steps, and the maps that it has kept.

    The covariance of the whole map is that at the end; in a run whose plug-ins are not trusted there is none, and no
    place of observations by sensors of ids.  Raises PluginError without rerun.
    """
    history, scene = run.history, Scene.of(run, world=True)
    scene = replace(scene, picture=_world(picture_of(run)), true_landmarks=run.truth.landmarks_in_map())
    scene = replace(scene, picture=light_colours(scene))
    stream, pictures = Stream(run.log.name, scene, save), images_of_cameras(run)
    try:
        slam = run.final_slam()
    except RunError:
        slam = None
    truth, maps = run.truth.poses_in_map(), {kept.step: kept for kept in history.maps}
    error = pose_error(history.poses, truth, run.coordinates)
    consistency = np.where(np.isfinite(error).all(axis=1), nees(np.nan_to_num(error), history.pose_covariances), np.nan)
    value, dof, at = associated_nis(history)
    totals = [np.bincount(at, x, len(history.t_ns)) for x in (value, dof)]
    of_cameras = [(camera, {*steps_of(history, camera).tolist()}) for camera in history.cameras]
    places: dict[str, Array] = {}
    for step in track(range(len(history.t_ns)), "view", len(history.t_ns), show=True):
        stream.set_time(float(history.t_s[step]), step)
        name = str(history.robot[step])
        stream.robot(name, history.poses[step], history.pose_covariances[step], truth[step], float(consistency[step]))
        stream.nis(float(totals[0][step]), int(totals[1][step]))
        if step in maps:
            kept = maps[step]
            places = dict(zip(map(str, kept.ids), kept.means[:, : scene.d], strict=True))
            stream.landmarks(replace(scene, ids=kept.ids, shapes=map_shapes(kept, scene.d, True)))
            if kept.correlations.size:
                stream.correlations(kept.correlations / WHOLE)
        stream.scan(replace(scene, rays=tuple(_rays(run, slam, step, places))))
        for camera in (camera for camera, seen in of_cameras if step in seen):
            for image in images(history, camera, step):
                entity = f"images/{camera.robot}/{camera.sensor}"
                stream.image(entity, image, camera.size, pictures and pictures.at(camera, step, image.side))
    if slam is not None and len(history.t_ns):
        mapped = slam.landmarks(exactly_known=False).ids
        stream.correlations(slam.covariance(*slam.robots, *mapped[:MOST]))
    stream.recording.flush()


def _rays(run: Recording, slam: Slam | None, step: int, places: dict[str, Array]) -> list[Ray]:
    """Return the observations of a step, with landmarks where the last map that was kept has them."""
    history, d = run.history, run.history.d
    rows = np.flatnonzero(history.step == step)
    if not len(rows):
        return []
    pose, robot, sensor = history.poses[step], str(history.robot[step]), str(history.sensor[rows[0]])
    at, seen_at = pose[:d], history.seen_at[rows]
    if slam is not None and sensor in slam.robots[robot].sensors:
        mount = mount_now(slam, robot, sensor)
        at = as_rigid(pose[: len(mount)])(mount[:d])
        seen_at = observed_points(slam, robot, sensor, pose, history.y[rows])
    unknown = np.full(d, np.nan)
    outcomes, landmarks = history.outcome[rows].tolist(), history.landmark[rows].tolist()
    return [Ray(o, at, p, places.get(l, unknown)) for o, p, l in zip(outcomes, seen_at, landmarks, strict=True)]
