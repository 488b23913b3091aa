"""The pictures of a run in space: the map, what cameras saw, the page."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import kalmark as km
from browser import said_by_page
from kalmark.errors import RunError
from kalmark.geometry.gaussian import contours
from kalmark.results.history import Camera
from kalmark.results.landmark_table import EUCLIDEANS, LINES, OTHERS, shapes
from kalmark.results.plot import Projection, box_corners, draw_map, grid_spacing, save_map
from kalmark.results.plot_scan import draw_sensor
from kalmark.results.record import record
from kalmark.results.run import Run
from kalmark.results.run_page import report_html
from kalmark.results.scene import Scene, clip_line, images
from results_space import FORWARD, SIGMA, START, slam_for, spiral, with_camera

WRONG = 13


@pytest.fixture(scope="module")
def run() -> Run:
    slam, log = with_camera(spiral(landmarks=60, seed=3), wrong=WRONG)
    return record(slam, log, progress=False)


def page_data(page: str) -> dict[str, Any]:
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', page, flags=re.DOTALL)
    assert found is not None
    return json.loads(found[1])


def test_the_great_circles_of_an_ellipsoid_lie_on_it() -> None:
    rng = np.random.default_rng(1)
    factors = rng.normal(size=(5, 3, 3))
    covariances, means = factors @ factors.transpose(0, 2, 1), rng.normal(size=(5, 3))
    circles = contours(means, covariances)
    for three, mean, P in zip(circles, means, covariances, strict=True):
        d = three.reshape(-1, 3) - mean
        np.testing.assert_allclose(np.einsum("ni,ij,nj->n", d, np.linalg.inv(P), d), 9.0)
    covariances[2] = np.inf
    assert np.isnan(contours(means, covariances)[2]).all()


def test_landmarks_are_sorted_by_what_is_drawn_of_them() -> None:
    nan = np.nan
    means = np.array(
        [[1, 2, 3, *[nan] * 4], [1, 2, 3, 4, 5, 6, nan], [1, 2, 3, 0, 0, 0, 1.0], [np.inf] * 3 + [nan] * 4]
    )
    covariances = np.full((4, 6, 6), np.nan)
    covariances[:, :3, :3], covariances[1], covariances[2] = np.eye(3), 2 * np.eye(6), np.eye(6)
    drawn = shapes(means, covariances, ["point3", "pluecker_line", "tag", "inverse_depth"])
    assert drawn.group.tolist() == [EUCLIDEANS, LINES, EUCLIDEANS, OTHERS, LINES]
    assert drawn.row.tolist() == [0, 1, 2, 3, 1]
    assert drawn.means[4].tolist() == [4, 5, 6]
    assert drawn.covariances[4].tolist() == (2 * np.eye(3)).tolist()
    assert (len(drawn.lines), len(drawn.tags)) == (1, 1)


def test_the_map_of_a_run_in_space_has_a_view_and_a_plan(run: Run, tmp_path: Path) -> None:
    save_map(run, tmp_path / "map.png")
    assert (tmp_path / "map.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    space, plan = draw_map(run).axes
    assert space.get_aspect() == plan.get_aspect() == 1.0
    assert (plan.get_xlabel(), plan.get_ylabel()) == ("x (m)", "y (m)")
    labels = [text.get_text() for text in draw_map(run).legends[0].get_texts()]
    ends = ["start", "end", "end, 3σ of the shape"]
    assert labels == [
        "estimated path",
        "true path, aligned",
        "true landmarks, aligned",
        "true end, aligned",
        "Euclidean landmarks, 3σ of the shape",
        *ends,
        "dead reckoning",
    ]


@pytest.mark.parametrize("view", ["normal", "top", "side", "front", (60.0, 10.0)])
def test_a_view_puts_what_is_higher_up_and_what_is_right_to_the_right(run: Run, view: Any) -> None:
    scene = Scene.of(run)
    project = Projection.of(scene, view)
    np.testing.assert_allclose(project.axes @ project.axes.T, np.eye(3), atol=1e-12)
    middle = (scene.low + scene.high) / 2
    up, right = (project(middle + d) - project(middle) for d in (np.eye(3)[2], project.axes[0]))
    if view in ("top", "side", "front"):  # without perspective, axes in metres
        assert np.allclose(project(middle), middle[{"top": [0, 1], "side": [0, 2], "front": [1, 2]}[view]])
    else:
        assert np.allclose(project(middle), 0.0)
    assert view == "top" or up[1] > 0.1
    assert right[0] == pytest.approx(1.0)
    assert np.isfinite(project(box_corners(scene.low, scene.high))).all()


def test_a_point_at_great_depth_does_not_shrink_the_picture(run: Run) -> None:
    far = replace(
        run.landmarks,
        kinds=["inverse_depth", *run.landmarks.kinds[1:]],
        means=[np.array([9e3, 0, 0]), *run.landmarks.means[1:]],
        covariances=[1e8 * np.eye(3), *run.landmarks.covariances[1:]],
    )
    a, b = Scene.of(run, world=True), Scene.of(replace(run, landmarks=far), world=True)
    assert b.size < 1.2 * a.size
    assert (b.shapes.group == OTHERS).sum() == 1
    assert np.isnan(b.inside(b.shapes.means[:1])).all()


def test_the_grid_is_of_two_metres_or_of_round_numbers() -> None:
    assert [grid_spacing(size) for size in (0.5, 3.0, 8.0, 16.0, 40.0, 100.0, 1500.0)] == [0.05, 0.5, 2, 2, 2, 10, 200]


def test_a_line_is_trimmed_to_the_image_even_where_its_ends_lie_outside() -> None:
    size = (640.0, 480.0)
    np.testing.assert_allclose(clip_line(np.array([-100.0, 240]), np.array([0.0, 240]), size), [[0, 240], [640, 240]])
    np.testing.assert_allclose(clip_line(np.array([10.0, 600]), np.array([10.0, 500]), size), [[10, 480], [10, 0]])
    assert clip_line(np.array([-1.0, 0]), np.array([-1.0, 9]), size) is None
    assert clip_line(np.array([-10.0, 0]), np.array([0.0, -10]), size) is None


def test_the_image_shows_what_was_used_and_what_was_rejected(run: Run) -> None:
    (camera,) = run.history.cameras
    assert (camera.sensor, camera.size) == ("eye", (640.0, 480.0))
    np.testing.assert_allclose(camera.mount, FORWARD)
    steps = np.unique(run.history.step[(run.history.outcome == "rejected") & (run.history.sensor == "eye")])
    assert len(steps), "the wrong landmark comes into sight"
    (image,) = images(run.history, camera, int(steps[0]))
    by_name = {s.name: s for s in image.observations}
    assert by_name[str(WRONG)].outcome == "rejected"
    assert np.linalg.norm(by_name[str(WRONG)].measured - by_name[str(WRONG)].expected) > 50
    used = [s for s in image.observations if s.outcome == "associated"]
    assert all(np.isfinite(s.Z).all() and np.linalg.norm(s.measured - s.expected) < 12 for s in used)
    figure = draw_sensor(run, "rover", "eye", step=int(steps[0]))
    (axes,) = figure.axes
    assert axes.get_ylim() == (480.0, 0.0)
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert labels == ["measured", "Euclidean, used, 3σ", "Euclidean, predicted only, 3σ", "rejected"]
    names = {text.get_text(): text.xy for text in axes.texts}
    assert names[str(WRONG)][1] == pytest.approx(by_name[str(WRONG)].expected[0, 1])


def test_a_scan_is_chosen_by_its_time_since_the_first(run: Run) -> None:
    title = draw_sensor(run, "rover", "eye", t_s=2.95).get_suptitle()
    assert title.startswith("rover · eye · t = 2.900 s · ")
    with pytest.raises(RunError, match="saw nothing until then"):
        draw_sensor(run, "rover", "eye", t_s=-0.01)
    with pytest.raises(RunError, match=r"expected one of: rover\.eye"):
        draw_sensor(run, "rover", "ear")


@pytest.mark.parametrize(
    ("columns", "sides", "points"),
    [
        (("u1_px", "v1_px", "u2_px", "v2_px"), [""], 2),
        (("ul_px", "vl_px", "ur_px", "vr_px"), ["left", "right"], 1),
        (("ul_px", "vl_px", "ur_px"), ["left", "right"], 1),
        (("u1_px", "v1_px", "u2_px", "v2_px", "u3_px", "v3_px", "u4_px", "v4_px", "size_m"), [""], 4),
    ],
    ids=["segments", "stereo", "stereo of three numbers", "tags"],
)
def test_any_camera_s_measurements_are_points_of_its_images(run: Run, columns: Any, sides: Any, points: int) -> None:
    m, count = len(columns), len(run.history.step)
    rng = np.random.default_rng(2)
    y = rng.uniform(50, 400, (count, m))
    camera = Camera("rover", "eye", FORWARD, (640.0, 480.0), columns, run.history.cameras[0].corners)
    Z = np.tile(4.0 * np.eye(m), (count, 1, 1))
    history = replace(run.history, y=y, e=y + 3.0, z=np.full((count, m), -3.0), Z=Z, cameras=(camera,))
    history = replace(history, unmeasured_step=np.full_like(history.unmeasured_step, -1))
    seen = images(history, camera, int(history.step[-1]))
    assert [image.side for image in seen] == sides
    assert all(s.measured.shape == s.expected.shape == (points, 2) for image in seen for s in image.observations)
    assert np.isfinite(seen[0].observations[0].Z).all() == (points == 1)
    assert len(draw_sensor(replace(run, history=history), "rover", "eye").axes) == len(sides)


def test_the_page_has_the_map_and_the_images_of_every_position_of_the_slider(run: Run) -> None:
    data = page_data(report_html(run))
    (camera,) = data["cameras"]
    assert len(camera["frames"]) == len(data["maps"]) <= 61 + len(run.landmarks)
    assert camera["frames"][-1] == len(camera["scans"]) - 1
    seen = camera["scans"][-1]["images"][0]["seen"]
    assert {"name", "outcome", "y", "e", "Z", "colour"} <= set(seen[0])
    (robot,) = data["robots"]
    assert len(robot["q"]) == 4
    assert len(robot["q"][0]) == len(robot["z"]) == len(robot["t"])
    assert len(robot["error"]) == data["dof"] == 6
    assert set(data["maps"][-1]) >= {"x", "y", "z", "pxx", "pyz", "pzz", "group", "lines", "tags"}
    assert len(data["bodies"]["rover"]["x"]) == 20, "outline, mast and pyramid, nothing behind each"


TURNED = """<script>
const eye = () => document.getElementById("map")._fullLayout.scene._scene.getCamera().eye;
const mouse = (target, type, x, y, buttons) => target.dispatchEvent(
  new MouseEvent(type, {clientX: x, clientY: y, buttons, bubbles: true, cancelable: true, view: window}));
setTimeout(() => {
  const seen = [eye()], canvas = document.querySelector("#map canvas"), at = canvas.getBoundingClientRect();
  const x = at.left + 300, y = at.top + 300, slider = document.getElementById("time");
  let k = 0;
  mouse(canvas, "mousedown", x, y, 1);
  const drag = setInterval(() => {
    if (++k <= 20) { mouse(canvas, "mousemove", x + 8 * k, y + 3 * k, 1); return; }
    clearInterval(drag);
    mouse(window, "mouseup", x + 160, y + 60, 0);
    setTimeout(() => {
      seen.push(eye());
      slider.value = 3;
      slider.dispatchEvent(new Event("input"));
      setTimeout(() => {
        seen.push(eye());
        const image = document.getElementById("image-0-0").layout.title.text;
        document.title = JSON.stringify({seen, image, now: document.getElementById("now").textContent});
      }, 1000);
    }, 1000);
  }, 30);
}, 4000);
</script></body>"""


def test_the_page_turns_under_the_mouse_and_stays_turned_when_time_moves_on(run: Run, tmp_path: Path) -> None:
    page, drawing = (
        report_html(run).replace("</body>", TURNED),
        ("--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
    )
    said = said_by_page(page, tmp_path, *drawing, "--window-size=1300,1500", "--virtual-time-budget=15000")
    if said is None:
        pytest.skip("this chromium draws nothing in three dimensions")
    before, turned, after = (np.array([eye[axis] for axis in "xyz"]) for eye in said["seen"])
    assert np.linalg.norm(turned - before) > 0.3
    np.testing.assert_allclose(after, turned, atol=1e-6)
    data = page_data(report_html(run))
    times = np.unique(data["robots"][0]["t"]).tolist()  # two sensors, so two scans at a time
    assert said["now"].startswith(f"step 4 of {len(times)} · {times[3]:.2f} s")
    assert said["image"].startswith("rover · eye")


def test_the_folder_of_a_run_in_space_comes_back_whole(run: Run, tmp_path: Path) -> None:
    run.save(tmp_path / "one")
    assert (tmp_path / "one" / "sensor_rover_eye.png").is_file()
    loaded = Run.load(tmp_path / "one")
    assert loaded.evaluate() == run.evaluate()
    loaded.save(tmp_path / "two")
    for name in ("summary.json", "trajectory_rover.tum", "landmarks.csv", "associations.csv", "sensor_rover_eye.png"):
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "two" / name).read_bytes(), name
    assert page_data(report_html(loaded)) == page_data(report_html(run))


@pytest.mark.parametrize("landmarks", [0, 300])
def test_every_kind_of_run_in_space_has_its_pictures(landmarks: int, tmp_path: Path) -> None:
    log = replace(spiral(robots=("a", "b"), steps=5, landmarks=landmarks), truth={})
    run = record(slam_for(spiral(robots=("a", "b"), steps=5)), log, progress=False)
    save_map(run, tmp_path / "map.png")
    assert page_data(report_html(run))["cameras"] == []


def test_a_run_in_space_without_scans_has_its_pictures(tmp_path: Path) -> None:
    events = [km.Control(t_s=0.0, robot="rover", u=np.zeros(6))]
    run = record(slam_for(spiral(steps=2)), events, progress=False)
    run.save(tmp_path)
    assert Run.load(tmp_path).history.in_space
    assert page_data((tmp_path / "report.html").read_text())["maps"][0]["count"] == 0


def test_a_robot_that_coasts_needs_no_controls() -> None:
    log = spiral(steps=5)
    run = record(slam_for(log), [event for event in log if not isinstance(event, km.Control)], progress=False)
    taken = [line for line in run.evaluate()["warnings"] if "taken to stand still" in line]
    assert len(taken) == 1
    moving = np.column_stack([run.history.mean, np.zeros((len(run.history.mean), 6))])
    coasting = replace(run, history=replace(run.history, mean=moving), summary={})
    assert not [line for line in coasting.evaluate()["warnings"] if "taken to stand still" in line]


def test_true_tags_and_lines_are_drawn_as_such(run: Run) -> None:
    true = {1: np.array([0, 0, 1.0, 0, 0, 0, 1]), 2: np.array([0, 0, 0, 1.0, 1, 1])}
    other = replace(run, truth=replace(run.truth, landmarks=true))
    assert [len(l) for l in Scene.of(other).true_landmarks.values()] == [7, 6]
    draw_map(other)
    data = page_data(report_html(other))
    assert data["trueLandmarks"]["id"] == ["1"]
    assert data["trueLines"]["x"][:2] == pytest.approx([0.0, 1.0], abs=2e-3)  # aligned with the map


def test_points_that_a_camera_starts_are_placed_by_their_depth() -> None:
    """A camera alone: inverse-depth points, mount in the map."""
    _, log = with_camera(spiral(steps=25, landmarks=40, seed=3))
    eye = km.Mount(km.sensors.PinHole(), FORWARD, cov=1e-6 * np.eye(6))
    rover = km.Robot("rover", km.motion.Odometry3D(*SIGMA), START, {"eye": eye})
    slam = km.Slam([rover], landmarks=km.landmarks.InverseDepth3D(prior_rho_per_m=0.2, sigma_rho_per_m=0.2))
    events = [event for event in log if getattr(event, "sensor", "eye") == "eye"]
    run = record(slam, replace(log, events=events), progress=False)
    summary = run.evaluate()
    assert summary["mounts"]["rover.eye"]["sigma_rotation_deg"] < 0.06
    assert summary["robots"]["rover"]["ate_raw_m"] < 0.1
    assert summary["landmark_rmse_raw_m"] < 1.0
    assert {len(mean) for mean in run.landmarks.means} == {3}
    drawn = Scene.of(run).shapes
    assert (drawn.group == OTHERS).any(), "some points are not yet Euclidean"
    labels = [text.get_text() for text in draw_sensor(run, "rover", "eye").legends[0].get_texts()]
    assert "not Euclidean, used, 3σ" in labels
