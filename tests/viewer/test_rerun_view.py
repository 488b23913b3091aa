"""A view in rerun: entities of a file, live and of a folder; one line where rerun, or a screen for it, is missing."""

from __future__ import annotations

import builtins
import sys
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import kalmark as km
from kalmark.errors import PluginError
from kalmark.picture_options import Picture
from kalmark.results.record import record
from kalmark.results.run import Run
from kalmark.viewer.rerun_stream import eye_behind
from kalmark.viewer.rerun_view import follow, replay
from results_space import spiral, with_camera
from results_world import circle, slam_for

Rows = dict[str, dict[str, list[Any]]]


def rows_of(path: Path) -> Rows:
    """Return the values of each component of each entity of a file, one a time at which it was logged."""
    chunk = pytest.importorskip("rerun.chunk")
    found: Rows = defaultdict(lambda: defaultdict(list))
    for each in chunk.RrdReader(str(path)).stream():
        batch = each.to_record_batch()
        for name, column in zip(batch.schema.names, batch.columns, strict=True):
            found[each.entity_path][name] += column.to_pylist()
    return found


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> tuple[Run, Path, Path]:
    pytest.importorskip("rerun")
    folder, log = tmp_path_factory.mktemp("view"), circle(steps=30)
    slam = slam_for(log)
    observer = follow(slam, log, Picture(sigmas=2.0), folder / "live.rrd")
    run = record(slam, log, progress=False, observers=[observer])
    del observer
    replay(run, folder / "again.rrd")
    return run, folder / "live.rrd", folder / "again.rrd"


@pytest.mark.parametrize("which", [1, 2])
def test_the_file_has_robots_map_scan_and_figures_of_each_step(files: tuple[Run, Path, Path], which: int) -> None:
    run, rows = files[0], rows_of(files[which])
    history, (robot,) = run.history, run.history.robots
    places = np.array(rows[f"/map/robots/{robot}"]["Transform3D:translation"]).reshape(-1, 3)
    np.testing.assert_allclose(places[:, :2], history.poses[:, :2], atol=1e-5)
    true = np.array(rows[f"/map/true_robots/{robot}"]["Transform3D:translation"]).reshape(-1, 3)
    np.testing.assert_allclose(true[:, :2], run.truth.poses_in_map()[:, :2], atol=1e-5)
    sigmas = np.hstack([rows[f"/sigma/{robot}/{part}"]["Scalars:scalars"] for part in ("position", "rotation")])
    np.testing.assert_allclose(
        sigmas**2, np.diagonal(history.pose_covariances, axis1=1, axis2=2), rtol=1e-6, atol=1e-15
    )
    assert rows["/map/landmarks"]["Points3D:labels"][-1] == [str(i) for i in run.landmarks.ids]
    np.testing.assert_allclose(
        np.array(rows["/map/landmarks"]["Points3D:positions"][-1])[:, :2], run.landmarks.positions()[0], atol=1e-5
    )
    half = np.array(rows["/map/landmark_ellipses"]["Ellipsoids3D:half_sizes"][-1])
    values = np.linalg.eigvalsh(run.landmarks.positions()[1])
    np.testing.assert_allclose(half[:, :2], (2.0 if which == 1 else 3.0) * np.sqrt(values), rtol=1e-4)
    outcomes = rows["/map/scan/observations"]["Points3D:labels"]
    counts = [[*history.outcome[history.step == step]] for step in range(len(history.t_ns))]
    assert [label or [] for label in outcomes] == counts
    nees = np.array(rows[f"/consistency/NEES/{robot}"]["Scalars:scalars"])
    assert np.isfinite(nees).all() and nees.shape[1] == 3
    assert len(rows["/consistency/NIS"]["Scalars:scalars"]) > 20
    assert "/covariance" in rows
    steps = rows[f"/map/robots/{robot}"]["step"]
    assert steps == [*range(len(history.t_ns))]


def test_the_folder_of_a_run_shows_again_what_was_shown_live(files: tuple[Run, Path, Path]) -> None:
    live, again = rows_of(files[1]), rows_of(files[2])
    for entity, column in (("/consistency/NEES/rover", "Scalars:scalars"), ("/consistency/NIS", "Scalars:scalars")):
        np.testing.assert_allclose(live[entity][column], again[entity][column], rtol=1e-9)
    for entity in ("/map/scan/observations", "/map/landmarks"):
        a, b = (rows[entity]["Points3D:positions"][-1] for rows in (live, again))
        np.testing.assert_allclose(a, b, atol=1e-5)


def test_a_window_is_sent_the_rows_of_a_fifth_of_a_second_together(tmp_path: Path, monkeypatch: Any) -> None:
    rerun, made = pytest.importorskip("rerun"), list[Any]()
    new = rerun.RecordingStream

    def recorded(*names: Any, batcher_config: Any, **options: Any) -> Any:
        made.append(batcher_config)
        return new(*names, batcher_config=batcher_config, **options)

    monkeypatch.setattr(rerun, "RecordingStream", recorded)
    log = circle(steps=3)
    follow(slam_for(log), log, Picture(), tmp_path / "live.rrd")
    assert made[0].flush_tick.total_seconds() == 0.2


def test_options_of_pictures_change_what_is_shown(tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    log = circle(steps=4)
    some: dict[str, Any] = {"ellipses": "off", "truth": False, "colours": {"landmarks": "red"}}
    for name, options in {"all": dict[str, Any](), "some": some}.items():
        slam = slam_for(log)
        record(slam, log, progress=False, observers=[follow(slam, log, Picture(**options), tmp_path / f"{name}.rrd")])
    whole, less = (rows_of(tmp_path / f"{name}.rrd") for name in ("all", "some"))
    left_out = {"/map/landmark_ellipses", "/map/robot_ellipses/rover", "/map/true_robots/rover", "/map/true_landmarks"}
    assert left_out <= whole.keys()
    assert not left_out & less.keys()
    assert {*less["/map/landmarks"]["Points3D:colors"][-1]} == {0xFF0000FF}


def test_a_view_from_behind_the_robot_moves_with_it_and_scans_can_be_left_out(tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    slam, log = with_camera(spiral(steps=3))
    picture = Picture(view="self", sensors=False)
    record(slam, log, progress=False, observers=[follow(slam, log, picture, tmp_path / "self.rrd")])
    rows = rows_of(tmp_path / "self.rrd")
    assert not [entity for entity in rows if entity.startswith("/map/scan")]
    offset, axes = eye_behind(4.0)
    assert offset[0] < 0 < offset[2] and np.linalg.norm(offset) == pytest.approx(1.0)
    np.testing.assert_allclose(axes[:, 2], -offset, err_msg="it looks at the robot")
    np.testing.assert_allclose(np.linalg.det(axes), 1.0)


def test_cameras_of_space_have_their_images_and_expectations(tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    slam, log = with_camera(spiral(steps=6, landmarks=30, seed=3))
    observer = follow(slam, log, Picture(), tmp_path / "live.rrd")
    run = record(slam, log, progress=False, observers=[observer])
    del observer
    replay(run, tmp_path / "again.rrd")
    (camera,) = run.history.cameras
    for name in ("live", "again"):
        rows = rows_of(tmp_path / f"{name}.rrd")
        entity = f"/images/{camera.robot}/{camera.sensor}"
        measured = np.array(rows[f"{entity}/measured"]["Points2D:positions"][-1])
        last = run.history.y[run.history.sensor == camera.sensor]
        np.testing.assert_allclose(measured[-1], last[-1, :2], atol=1e-3)
        assert rows[f"{entity}/expected"]["LineStrips2D:strips"][-1]
        assert rows["/map/robots/rover/body"]


def test_without_rerun_a_view_is_refused_in_one_line_with_its_cure(monkeypatch: pytest.MonkeyPatch) -> None:
    found: Callable[..., Any] = builtins.__import__

    def without(name: str, *more: Any, **options: Any) -> Any:
        if name.partition(".")[0] == "rerun":
            raise ImportError(f"No module named {name!r}")
        return found(name, *more, **options)

    monkeypatch.delitem(sys.modules, "rerun", raising=False)
    monkeypatch.setattr(builtins, "__import__", without)
    log = circle(steps=2)
    with pytest.raises(PluginError, match=r"pip install 'kalmark\[view\]'$"):
        follow(slam_for(log), log, Picture(), None)


def test_observers_get_each_event_and_its_report() -> None:
    log, seen = circle(steps=3), []
    record(slam_for(log), log, progress=False, observers=[lambda event, report: seen.append((event, report.event))])
    assert [event for event, _ in seen] == [*log.events]
    assert all(event == other for event, other in seen)
    assert km.record is record
