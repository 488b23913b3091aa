"""The picture of a filter now: what is drawn, where, and how large."""

from __future__ import annotations

import base64
import io
from dataclasses import replace
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.image import imread
from matplotlib.text import Annotation
from PIL import Image

import kalmark as km
from kalmark.logs.log import Log, Trajectory
from kalmark.report import Report
from kalmark.results.filter_description import KEPT, correlations_kept
from kalmark.results.history import WHOLE
from kalmark.results.labels import name_points
from kalmark.results.plot import draw_map, save_map
from kalmark.results.plot_scan import draw_sensor
from kalmark.results.record import record
from kalmark.results.run import Run
from kalmark.results.run_page import series
from kalmark.results.scene import BODIES, BODY_SIZE, OUTCOME_COLOURS, Scene
from results_space import slam_for as slam_in_space
from results_space import spiral, with_camera
from results_world import circle, slam_for

POSTS = {1: (4.0, 1.0), 2: (2.0, 3.0), 3: (-1.0, 2.0)}


@pytest.fixture(autouse=True)
def _close() -> Any:
    yield
    plt.close("all")


def plane(mount: Any = (0.2, 0.0, 0.0), **options: Any) -> km.Slam:
    lidar = km.Mount(km.sensors.RangeBearing(sigma_range_m=0.1, sigma_bearing_rad=0.05), at=mount)
    rover = km.Robot("rover", km.motion.Unicycle(), sensors={"lidar": lidar}, cov=np.diag([0.01, 0.02, 0.001]))
    return km.Slam(rover, estimator=km.estimators.Ekf(), **options)


def scan(slam: km.Slam, t_s: float, off: float = 0.0) -> Report:
    """Process a scan of the posts from where the robot believes to be; `off` is added to the range of the first."""
    x, y, heading = slam.mean("rover")
    at = np.array([x + 0.2 * np.cos(heading), y + 0.2 * np.sin(heading), heading])
    seen = km.geometry.observe(at, np.array([*POSTS.values()]))[0]
    seen[0, 0] += off
    return slam.process(km.Scan(t_s=t_s, robot="rover", sensor="lidar", y=seen, ids=[*POSTS]))


def line(axes: Axes, label: str) -> Any:
    (found,) = [line for line in axes.lines if line.get_label() == label]
    return found


def texts(axes: Axes) -> list[str]:
    return [text.get_text() for text in axes.texts]


def test_an_ellipse_has_the_axes_and_the_place_of_its_covariance() -> None:
    slam = plane()
    scan(slam, 0.1)
    axes = km.draw(slam, sigmas=2.0)
    rings = line(axes, "estimated landmarks, 2σ in the world").get_xydata()
    rings = np.split(rings, np.flatnonzero(np.isnan(rings[:, 0])))[:-1]
    assert len(rings) == 3
    for ring, name in zip(rings, POSTS, strict=True):
        d = ring[np.isfinite(ring[:, 0])] - slam.mean(name)
        radii = np.linalg.norm(d, axis=1)
        sigmas = np.sqrt(np.linalg.eigvalsh(slam.covariance(name)))
        assert radii.min() == pytest.approx(2.0 * sigmas[0], rel=0.02)
        assert radii.max() == pytest.approx(2.0 * sigmas[1], rel=0.02)
        assert np.allclose(np.einsum("ni,ij,nj->n", d, np.linalg.inv(slam.covariance(name)), d), 4.0)


def test_robot_and_true_robot_are_at_their_present_places() -> None:
    slam = plane()
    slam.process(km.Control(t_s=0.0, robot="rover", u=(1.0, 0.5)))
    scan(slam, 1.0)
    axes = km.draw(slam, truth={"rover": [0.7, 0.1, 0.4], 1: (4.1, 1.2)}, path=[[0.0, 0.0, 0.0]])
    assert np.allclose(line(axes, "robot").get_xydata(), [slam.mean("rover")[:2]])
    assert np.allclose(line(axes, "true robot").get_xydata(), [[0.7, 0.1]])
    assert np.allclose(line(axes, "true landmarks").get_xydata(), [[4.1, 1.2]])
    assert np.allclose(line(axes, "estimated path").get_xydata(), [[0.0, 0.0], slam.mean("rover")[:2]])
    heading = line(axes, "robot")._marker.get_user_transform().transform([1.0, 0.0])
    assert np.arctan2(heading[1], heading[0]) == pytest.approx(slam.mean("rover")[2])


def test_an_observation_has_the_colour_of_its_outcome_and_lies_where_it_was_measured() -> None:
    slam = plane()
    first = scan(slam, 0.1)
    axes = km.draw(slam, report=first)
    assert to_hex(line(axes, "observation: new").get_color()) == OUTCOME_COLOURS["new"]
    before, report = slam.mean(1).copy(), scan(slam, 0.2, off=1.5)
    assert [o.outcome for o in report.observations] == ["rejected", "associated", "associated"]
    axes = km.draw(slam, axes, report=report)
    beam = line(axes, "observation: rejected").get_xydata()
    assert to_hex(line(axes, "observation: rejected").get_color()) == OUTCOME_COLOURS["rejected"]
    x, y, heading = slam.mean("rover")
    sensor = np.array([x + 0.2 * np.cos(heading), y + 0.2 * np.sin(heading)])
    assert np.allclose(beam[0], sensor)
    along = (before - sensor) / np.linalg.norm(before - sensor)
    assert np.allclose(beam[1], before + 1.5 * along, atol=1e-6)
    assert "observation: new" not in [each.get_label() for each in axes.lines]


def test_a_bearing_is_a_line_to_its_landmark() -> None:
    eye = km.Robot("rover", km.motion.Unicycle(), sensors={"eye": km.Mount(km.sensors.Bearing(), at=(0.1, 0.0, 0.0))})
    slam = km.Slam(eye)
    slam.add_landmark(1, POSTS[1], np.diag([0.1, 0.1]))
    report = slam.process(km.Scan(t_s=0.0, robot="rover", sensor="eye", y=[[np.arctan2(1.0, 3.9)]], ids=[1]))
    beam = line(km.draw(slam, report=report), "observation: associated").get_xydata()
    assert np.allclose(beam[:2], [[0.1, 0.0], slam.mean(1)])


def test_a_second_picture_replaces_the_first_and_nothing_else() -> None:
    slam = plane()
    scan(slam, 0.1)
    _, axes = plt.subplots()
    axes.plot([0, 1], [0, 1], label="mine")
    km.draw(slam, axes, labels=True)
    count = len(axes.get_children())
    assert texts(axes) == ["1", "2", "3"]
    for k in range(3):
        scan(slam, 0.2 + k)
        assert km.draw(slam, axes, labels=True) is axes
    assert len(axes.get_children()) == count
    assert line(axes, "mine").get_xydata().tolist() == [[0, 0], [1, 1]]


def test_options_change_what_is_drawn() -> None:
    slam = plane()
    report = scan(slam, 0.1)
    options: dict[str, Any] = {"ellipses": "off", "sensors": False, "colours": {"landmarks": "#123456"}}
    axes = km.draw(slam, None, {"rover": np.zeros(3), **POSTS}, report, limits_m=[-2, 5, -1, 4], **options)
    labels = [each.get_label() for each in axes.lines if not each.get_label().startswith("_")]
    assert labels == ["estimated path", "true landmarks", "true robot", "estimated landmarks", "robot"]
    assert line(axes, "estimated landmarks").get_color() == "#123456"
    assert (*axes.get_xlim(), *axes.get_ylim()) == (-2, 5, -1, 4)
    world, shape = (km.draw(slam, ellipses=each) for each in ("world", "shape"))
    rings = line(world, "estimated landmarks, 3σ in the world"), line(shape, "estimated landmarks, 3σ of the shape")
    spans = [np.nanmax(ring.get_xdata()) - np.nanmin(ring.get_xdata()) for ring in rings]
    assert spans[1] < spans[0]  # without the start's uncertainty


def test_a_log_gives_the_truth_up_to_the_present_time_in_the_frame_of_the_map() -> None:
    slam = plane()
    t_ns = np.array([0, 1, 2]) * 10**9
    drive = [km.Control(t_s=float(k), robot="rover", u=(1.0, 0.0)) for k in range(3)]
    # the true start is at (5, 5), heading along y; the filter starts at the origin, which is the map's
    poses = np.array([[5.0, 5.0, np.pi / 2], [5.0, 6.0, np.pi / 2], [5.0, 7.0, np.pi / 2]])
    log = Log("", ("rover",), drive, truth={"rover": Trajectory(t_ns, poses)}, landmarks={9: np.array([4.0, 9.0])})
    for event in drive[:2]:
        slam.process(event)
    axes = km.draw(slam, truth=log)
    assert np.allclose(line(axes, "true robot").get_xydata(), [[1.0, 0.0]])
    assert np.allclose(line(axes, "true path").get_xydata(), [[0.0, 0.0], [1.0, 0.0]])
    assert np.allclose(line(axes, "true landmarks").get_xydata(), [[4.0, 1.0]])


@pytest.mark.parametrize(("view", "columns"), [("top", [0, 1]), ("side", [0, 2]), ("front", [1, 2])])
def test_robots_in_space_are_projected(view: str, columns: list[int]) -> None:
    at = (0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
    eye = km.Mount(km.sensors.Position3D())
    slam = km.Slam(km.Robot("drone", km.motion.Odometry3D(), start=at, sensors={"eye": eye}, cov=0.01 * np.eye(6)))
    y = [[2.0, 1.0, 0.5], [3.0, -2.0, 1.5]]
    report = slam.process(km.Scan(t_s=0.0, robot="drone", sensor="eye", y=y, ids=[1, 2]))
    axes = km.draw(slam, report=report, truth=[0.1, 0.2, 1.1, 0, 0, 0, 1], view=view)
    assert (axes.get_xlabel(), axes.get_ylabel()) == tuple(f"{'xyz'[k]} (m)" for k in columns)
    assert np.allclose(line(axes, "robot").get_xydata(), [np.array(at[:3])[columns]])
    assert np.allclose(line(axes, "true robot").get_xydata(), [np.array([0.1, 0.2, 1.1])[columns]])
    beams = line(axes, "observation: new").get_xydata()
    assert np.allclose(beams[[1, 4]], np.add(y, [0, 0, 1.0])[:, columns])
    assert texts(axes) == ["1", "2"]


def test_the_view_from_behind_the_robot_has_ahead_what_it_looks_at() -> None:
    turned = (0.0, 0.0, 1.0, 0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5))  # its x points along y
    eye = km.Mount(km.sensors.Position3D())
    slam = km.Slam(km.Robot("drone", km.motion.Odometry3D(), start=turned, sensors={"eye": eye}))
    for name, place in {"ahead": (0.0, 6.0, 1.0), "left": (-2.0, 4.0, 1.0), "behind": (0.0, -9.0, 1.0)}.items():
        slam.add_landmark(name, place, 0.01 * np.eye(3))
    axes = km.draw(slam, view="self", ellipses="off", labels=True)
    at = {text.get_text(): text.xy for text in axes.texts if isinstance(text, Annotation)}
    assert abs(at["ahead"][0]) < 1e-9
    assert at["ahead"][1] > 0
    assert at["left"][0] < 0
    assert "behind" not in at


def test_a_path_or_a_truth_of_another_shape_is_refused_in_one_line() -> None:
    slam = plane()
    for key in ("truth", "path"):
        with pytest.raises(km.KalmarkError, match=rf"draw: {key} is .*, expected poses \(N, 3\)"):
            km.draw(slam, **{key: [1.0, 2.0]})
    with pytest.raises(km.KalmarkError, match=r"limits_m is .*, expected 4 or 6 numbers"):
        km.draw(slam, limits_m=[1, 0, 0, 1])
    with pytest.raises(km.KalmarkError, match=r"expected colours of landmarks, .*, rover, not of landmrks"):
        km.draw(slam, colours={"landmrks": "red"})
    with pytest.raises(km.KalmarkError, match="view is 'below', expected"):
        km.draw(slam, view="below")


@pytest.fixture(scope="module")
def run() -> Run:
    log = circle(steps=12, landmarks=5)
    return record(slam_for(log), log, progress=False)


def drawn(run: Run, **options: Any) -> Run:
    return replace(run, config=run.config | {"picture": options})


def test_the_section_of_a_configuration_changes_the_map_of_a_run(run: Run, tmp_path: Path) -> None:
    options = {"ellipses": "off", "truth": False, "labels": True, "limits_m": [-20, 20, -10, 30], "width_px": 500}
    other = drawn(run, **options, colours={"rover": "tab:red"})
    (axes,) = draw_map(other).axes
    labels = {text.get_text() for text in draw_map(other).legends[0].get_texts()}
    assert labels == {"estimated path", "estimated landmarks", "start", "end", "dead reckoning"}
    assert (*axes.get_xlim(), *axes.get_ylim()) == (-20, 20, -10, 30)
    assert texts(axes) == [str(i) for i in run.landmarks.ids]
    assert to_hex(axes.lines[0].get_color()) == to_hex("tab:red")
    save_map(other, tmp_path / "map.png")
    assert imread(tmp_path / "map.png").shape[1] == 500


def test_the_section_changes_the_page(run: Run) -> None:
    usual = series(run, Scene.of(run))["picture"]
    assert usual == {
        "eye": None, "flat": False, "orbit": False, "sigmas": 3.0, "labels": False, "truth": True, "colours": {},
        "behind": None, "sensorWidth": None,
    }  # fmt: skip
    other = drawn(run, sigmas=1.0, labels=True, truth=False, colours={"landmarks": "red"}, limits_m=[0, 1, 2, 3])
    data = series(other, Scene.of(other))
    changed = {"sigmas": 1.0, "labels": True, "truth": False, "colours": {"landmarks": "#ff0000"}}
    assert data["picture"] == usual | changed
    assert data["box"] == {"low": [0, 2], "high": [1, 3]}


def test_a_view_of_space_turns_map_and_page() -> None:
    log = spiral(steps=6)
    side = drawn(record(slam_in_space(log), log, progress=False), view="side")
    space, plan = draw_map(side).axes
    assert (space.get_xlabel(), space.get_ylabel(), plan.get_xlabel()) == ("x (m)", "z (m)", "x (m)")
    page = series(side, Scene.of(side))["picture"]
    assert page["flat"] and page["eye"] == [0.0, -1.0, 0.0]
    orbit = drawn(side, view="orbit")
    assert series(orbit, Scene.of(orbit))["picture"]["orbit"]


def test_the_true_robot_is_at_its_place_of_the_step_on_map_and_page(run: Run) -> None:
    (robot,) = series(run, Scene.of(run, world=True))["robots"]
    true = run.truth.poses_in_map()
    assert robot["truth"]["x"] == pytest.approx(true[:, 0], abs=1e-4)
    assert robot["truth"]["theta"] == pytest.approx(true[:, 2], abs=1e-4)
    for step in (5, None):
        (axes,) = draw_map(run, step, world=True).axes
        mark = line(axes, "true end")
        assert np.allclose(mark.get_xydata(), true[None, -1 if step is None else step, :2])
        ahead = mark._marker.get_user_transform().transform([1.0, 0.0])
        assert np.arctan2(ahead[1], ahead[0]) == pytest.approx(true[-1 if step is None else step, 2])
    assert "true end" not in {each.get_label() for each in draw_map(drawn(run, truth=False), world=True).axes[0].lines}


@pytest.mark.parametrize("shape", ["dart", "box", "disc"])
def test_the_shape_of_a_robot_is_that_of_the_picture_everywhere(run: Run, shape: str) -> None:
    other = drawn(run, robot=shape)
    (axes,) = draw_map(other).axes
    assert np.array_equal(line(axes, "end")._marker.get_path().vertices, BODIES[shape])
    scene = Scene.of(other)
    body = series(other, scene)["bodies"]["rover"]
    outline = np.column_stack([body["x"], body["y"]])[:-1].astype(float)
    assert np.allclose(outline, BODY_SIZE * scene.size * BODIES[shape], atol=1e-4)
    assert outline[outline[:, 0].argmax(), 1] == 0.0, "its nose is ahead"


def test_cameras_of_a_robot_in_space_are_drawn_unless_sensors_are_not() -> None:
    slam, log = with_camera(spiral(steps=3))
    run = record(slam, log, progress=False)
    count = {sensors: len(Scene.of(drawn(run, sensors=sensors)).body("rover")) for sensors in (True, False)}
    assert count == {True: 3, False: 2}
    behind = series(drawn(run, view="self"), Scene.of(drawn(run, view="self")))["picture"]["behind"]
    assert behind[:2] == [20.0, 180.0]


def test_pictures_of_sensors_have_width_colours_and_format_of_the_section(tmp_path: Path) -> None:
    slam, log = with_camera(spiral(steps=4))
    options = {"sensor_width_px": 500, "format": "svg", "colours": {"measured": "tab:red", "landmarks_used": "k"}}
    other = drawn(record(slam, log, progress=False), **options)
    names = {path.name for path in other.report(tmp_path)}
    assert {"map.png", "map.svg", "sensor_rover_eye.png", "sensor_rover_eye.svg"} <= names
    assert imread(tmp_path / "sensor_rover_eye.png").shape[1] == 500
    assert "<svg" in (tmp_path / "map.svg").read_text()
    colours = {to_hex(each.get_color()) for each in draw_sensor(other, "rover", "eye").legends[0].get_lines()}
    assert {to_hex("tab:red"), "#000000"} <= colours
    page = series(other, Scene.of(other))
    assert (page["picture"]["sensorWidth"], page["picture"]["colours"]["measured"]) == (500, to_hex("tab:red"))
    expected = {s["colour"] for s in page["cameras"][0]["scans"][-1]["images"][0]["seen"] if "colour" in s}
    assert "#000000" in expected
    with pytest.raises(km.KalmarkError, match=r"map.bmp: the ending is '.bmp', expected a format of matplotlib"):
        save_map(other, tmp_path / "map.bmp")


def test_a_map_that_is_kept_has_the_correlations_of_its_numbers_unless_it_is_large(tmp_path: Path) -> None:
    log = circle(steps=12, landmarks=5)
    slam = slam_for(log)
    run = record(slam, log, progress=False)
    last = run.history.maps[-1]
    P = slam.covariance(*slam.robots, *last.ids)
    sigma = np.sqrt(np.diagonal(P))
    assert np.abs(last.correlations / WHOLE - P / np.outer(sigma, sigma)).max() <= 0.5 / WHOLE
    again = Run.load(run.save(tmp_path / "run")).history.maps
    assert all(np.array_equal(a.correlations, b.correlations) for a, b in zip(again, run.history.maps, strict=True))
    picture = Image.open(io.BytesIO(base64.b64decode(series(run, Scene.of(run))["maps"][-1]["P"].partition(",")[2])))
    assert picture.size == P.shape
    red, _, blue = picture.convert("RGB").getpixel((0, 0))  # type: ignore[misc]
    assert red > 2 * blue, "a correlation of 1 is red"
    assert correlations_kept(slam, [*last.ids] * (KEPT + 1)).size == 0


@pytest.mark.parametrize("space", [False, True])
def test_names_of_points_that_are_close_do_not_meet(space: bool) -> None:
    figure = Figure(figsize=(4, 3))
    axes = figure.add_subplot(projection="3d" if space else None)
    points = np.array([[0.5, 0.5], [0.5, 0.56], [0.56, 0.5], [0.9, 0.9], [0.95, 0.9]])
    name_points(axes, np.pad(points, ((0, 0), (0, 1))) if space else points, ["one", "two", "three", "four", "five"])
    for width in (4.0, 8.0):
        figure.set_size_inches(width, 3.0)
        FigureCanvasAgg(figure).draw()
        boxes = [text.get_window_extent() for text in axes.texts]
        assert not any(a.overlaps(b) for k, a in enumerate(boxes) for b in boxes[:k])
        marks = axes.transData.transform([text.xy for text in axes.texts])
        assert not any(box.contains(*mark) for box in boxes for mark in marks)
