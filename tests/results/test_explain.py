"""A run folder is enough to say why an observation became what it did."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

import kalmark as km
from garden import GARDEN, look, slam_of
from kalmark.cli import main
from kalmark.errors import RunError
from kalmark.geometry.frames import compose
from kalmark.report import Candidate
from kalmark.results.explain import explain
from kalmark.results.figure_texts import figure
from kalmark.results.plot_scan import draw_scan
from kalmark.results.run import Run
from kalmark.results.run_page import change_rows, report_html, series
from kalmark.results.scene import Scene
from kalmark.results.warnings import window_warnings


def lost_run(tmp_path: Path) -> Run:
    """Map the garden, lose the way, map it again, until the two become one."""
    rng, events = np.random.default_rng(0), []
    for t in range(20):
        if t == 6:
            events.append(km.Control(t, "cart", (2.5, -2.5, 0.03), np.diag([3.0, 3.0, 0.05]) ** 2))
        y = km.geometry.observe(np.zeros(3), GARDEN)[0] + rng.normal(size=(6, 2)) * [0.05, 0.01]
        events.append(km.Scan(100 + t, "cart", "lidar", y) if t != 6 else km.Scan(100 + t, "cart", "lidar", ()))
    events[6] = km.Control(106, "cart", events[6].u, events[6].cov)  # type: ignore[union-attr]
    run = km.record(slam_of(), events, progress=False)
    run.save(tmp_path / "run")
    return Run.load(tmp_path / "run")


def test_it_names_the_landmarks_compared_with_their_distances_gates_and_the_decision(tmp_path: Path) -> None:
    run = lost_run(tmp_path)
    told = explain(run, 5.0)
    assert (told.robot, told.sensor, told.t_s, told.in_log) == ("cart", "lidar", 5.0, "105")
    assert told.gates == pytest.approx((9.21, 23.03), abs=0.01)
    assert [f.outcome for f in told.fates] == ["associated"] * 6
    for fate, point in zip(told.fates, GARDEN, strict=True):
        assert fate.compared[0].landmark == fate.landmark
        assert np.linalg.norm(fate.seen_at - point) < 0.4
        assert np.linalg.norm(fate.compared[0].place - point) < 0.2
    held = explain(run, 7.0)
    assert {f.outcome for f in held.fates} == {"deferred"}
    text = "\n".join(held.lines())
    assert "cart · lidar · t = 7.000 s (107 s in the log)" in text
    assert "or a new landmark: the odds are" in text
    assert "compared with u" in text


def test_the_time_may_be_that_of_the_log(tmp_path: Path) -> None:
    run = lost_run(tmp_path)
    assert explain(run, float(explain(run, 7.0).in_log)).step == explain(run, 7.0).step
    assert explain(run, 107.0).step == explain(run, 7.0).step
    with pytest.raises(RunError, match=r"scan is 50 s, expected 100.000000000 to 119.000000000 s of the log, or 0 to"):
        explain(run, 50.0)
    with pytest.raises(RunError, match="robot is 'ship', expected one of cart"):
        explain(run, 5.0, "ship")


def test_a_time_that_the_log_has_is_the_logs_and_the_answer_says_which_it_took(tmp_path: Path) -> None:
    robot = km.Robot("r", km.motion.Odometry2D(), sensors={"s": km.Mount(km.sensors.RangeBearing())})
    events = [km.Scan(t, "r", "s", [[3.0, 0.1]], [7]) for t in range(10, 40)]
    km.record(km.Slam([robot]), events, progress=False).save(tmp_path / "run")
    run = Run.load(tmp_path / "run")
    told, since = explain(run, 20.0), explain(run, 5.0)
    assert (told.t_s, since.t_s) == (10.0, 5.0)
    assert next(told.lines()).endswith("t = 10.000 s (20 s in the log); 20 s in the log was asked for")
    assert next(since.lines()).endswith("t = 5.000 s (15 s in the log); 5 s since the first scan was asked for")
    assert explain(run, 39.8).in_log == "39"


@pytest.mark.usefixtures("never_found")
def test_merged_and_removed_landmarks_are_listed_in_a_file_of_their_own(tmp_path: Path) -> None:
    run = lost_run(tmp_path)
    with (tmp_path / "run" / "changes.csv").open() as file:
        rows = list(csv.DictReader(file))
    merged = [row for row in rows if row["change"] == "merged"]
    assert merged
    assert all(row["reason"].startswith(f"merged into '{row['into']}'") for row in merged)
    step = run.history.changes[0].step
    told = explain(run, (run.history.t_ns[step] - run.history.t_ns[0]) * 1e-9)
    assert any(change.what in ("merged", "removed") for change in told.changes)
    with (tmp_path / "run" / "associations.csv").open() as file:
        assert len(list(csv.DictReader(file))) == len(run.history.step)


def test_an_average_over_landmarks_has_a_row_for_each_with_its_weight(tmp_path: Path) -> None:
    mount = km.Mount(km.sensors.Position2D(0.1))
    robot = km.Robot("r", km.motion.Odometry2D(), cov=np.diag([0.05, 0.4, 0.02]) ** 2, sensors={"s": mount})
    slam = km.Slam([robot], km.association.Averaged())
    for name, point in zip("ab", [[4.0, 0.0], [4.0, 1.0]], strict=True):
        slam.add_landmark(name, point, 0.05**2 * np.eye(2))
    run = km.record(slam, [km.Scan(1, "r", "s", [[4.0, 0.45]]), km.Scan(2, "r", "s", [[9.0, 9.0]])], progress=False)
    run.save(tmp_path)
    assert Run.load(tmp_path).evaluate()["associated"] == 1
    with (tmp_path / "associations.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["index"] for row in rows] == ["0", "0", "0"]
    assert {row["landmark"] for row in rows[:2]} == {"a", "b"}
    weights = [float(row["weight"]) for row in rows]
    assert weights[0] > weights[1] > 0.2 and sum(weights[:2]) < 1 and weights[2] == 1


def test_a_run_with_ids_says_what_it_can(tmp_path: Path) -> None:
    robot = km.Robot("r", km.motion.Odometry2D(), sensors={"s": km.Mount(km.sensors.RangeBearing())})
    run = km.record(km.Slam([robot]), [km.Scan(1, "r", "s", [[3.0, 0.1]], [7])] * 2, progress=False)
    run.save(tmp_path / "run")
    told = explain(Run.load(tmp_path / "run"), 0.0)
    assert [*told.lines()][2] == "   0 (id 7): new 7"
    assert told.gates is None


def test_what_has_an_id_is_drawn_with_its_landmark_and_d2_as_what_has_none(tmp_path: Path) -> None:
    at, rng = (0.5, -0.2, 0.3), np.random.default_rng(3)
    mount = km.Mount(km.sensors.RangeBearing(0.05, 0.01), at=at)
    robot = km.Robot("r", km.motion.Odometry2D(), start=(2.0, 1.0, 0.5), sensors={"s": mount})
    seen_from = compose(np.array([2.0, 1.0, 0.5]), np.array(at))[0]
    y = km.geometry.observe(seen_from, GARDEN)[0]
    noise = rng.normal(size=(6, 2)) * [0.05, 0.01]
    events = [km.Scan(1, "r", "s", y, [*range(6)]), km.Scan(2, "r", "s", y + noise, [*range(6)])]
    km.record(km.Slam([robot]), events, progress=False).save(tmp_path / "run")
    run = Run.load(tmp_path / "run")
    new, told = explain(run, 1.0), explain(run, 2.0)
    assert [fate.compared for fate in new.fates] == [()] * 6
    np.testing.assert_allclose([fate.seen_at for fate in new.fates], GARDEN, atol=1e-9)
    for k, fate in enumerate(told.fates):
        (landmark,) = fate.compared
        assert (landmark.landmark, landmark.d2) == (str(k), fate.d2)
        np.testing.assert_allclose(landmark.place, GARDEN[k], atol=0.05)
        np.testing.assert_allclose(fate.seen_at, pointed_at(seen_from, (y + noise)[k]), atol=0.05)
    axes = draw_scan(run, told).axes[0]
    assert {f"{k}: {figure(fate.d2, 2)}" for k, fate in enumerate(told.fates)} <= {t.get_text() for t in axes.texts}
    assert not any("compared with" in line for line in told.lines()), "the line of the observation says it"
    far = replace(told.fates[0], landmark="", compared=(Candidate(0, "far", 4110.0, np.array([500.0, 0.0])),))
    lone = draw_scan(run, replace(told, fates=(far, *told.fates[1:]))).axes[0]
    assert "far" not in {t.get_text() for t in lone.texts}
    assert lone.get_xlim()[1] < 100.0
    (tmp_path / "run" / "map.kmk").unlink()
    assert not np.isfinite([fate.seen_at for fate in explain(Run.load(tmp_path / "run"), 2.0).fates]).any()


def test_a_drawn_scan_has_no_far_landmarks_and_no_text_over_another(tmp_path: Path) -> None:
    held = explain(lost_run(tmp_path), 7.0)
    places = [np.array(p) for p in ([4.0, 1.0], [4.3, 1.2], [4.4, 0.8], [4.6, 1.1])]
    near = tuple(
        Candidate(0, f"u{k}", d2, p) for k, (d2, p) in enumerate(zip([1.23, 4.56, 7.89, 120.0], places, strict=True))
    )
    fates = tuple(
        replace(held.fates[0], index=k, landmark="", seen_at=np.array([3.0, y]), compared=compared)
        for k, (y, compared) in enumerate([(1.0, near), (1.1, near), (0.5, near[3:])])
    )
    told = replace(held, fates=fates)
    run = Run.load(tmp_path / "run")
    figure = draw_scan(run, told)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    texts = figure.axes[0].texts
    said = [text.get_text() for text in texts]
    assert sorted(said) == sorted(["0", "1", "2", "u0", "u1", "u2", *2 * ["1.23", "4.56", "7.89"]])
    boxes = [text.get_window_extent() for text in texts]
    pairs = [(a, b) for i, a in enumerate(said) for j, b in enumerate(said[:i]) if boxes[i].overlaps(boxes[j])]
    assert pairs == []
    assert sum("u3 (d2 120)" in line for line in told.lines()) == 3
    assert [fate.near for fate in fates] == [[*near[:3]], [*near[:3]], []]


def pointed_at(T: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return where a range and a bearing from T point."""
    a = T[2] + y[1]
    return np.array([T[0] + y[0] * np.cos(a), T[1] + y[0] * np.sin(a)])


def test_a_sensor_that_does_not_tell_distances_explains_itself_without_places(tmp_path: Path) -> None:
    robot = km.Robot("r", km.motion.Odometry2D(), sensors={"s": km.Mount(km.sensors.Bearing())})
    km.record(km.Slam([robot]), [km.Scan(1, "r", "s", [[0.1]], [7])] * 2, progress=False).save(tmp_path / "run")
    assert not np.isfinite(explain(Run.load(tmp_path / "run"), 0.0).fates[0].seen_at).any()
    assert main(["explain", str(tmp_path / "run"), "--scan", "0"]) == 0


def test_a_wrong_map_is_noticed_from_the_time_on_when_it_is_wrong() -> None:
    rng = np.random.default_rng(5)
    robot = km.Robot("r", km.motion.Odometry2D(0.02, 0.02, 0.01), sensors={"s": km.Mount(km.sensors.RangeBearing())})
    for wrong in (False, True):
        events = []
        for t in range(40, 340):
            events.append(km.Control(t, "r", rng.normal(size=3) * [0.02, 0.02, 0.01]))
            y = km.geometry.observe(np.zeros(3), GARDEN)[0] + rng.normal(size=(6, 2)) * [0.1, 0.02]
            ids = [0, 1, 2, 3, 4, 5] if not wrong or t < 240 else [1, 0, 2, 3, 4, 5]  # two are taken for each other
            events.append(km.Scan(t, "r", "s", y, ids))
        run = km.record(km.Slam([robot], km.association.ByIdentity(gate="off")), events, progress=False)
        verdict = km.diagnose(run)
        assert verdict.map == ("doubtful" if wrong else "ok")
    assert verdict.causes[0].since_s == pytest.approx(240, abs=5)
    assert any(line.startswith("NIS per degree of freedom rises to ") for line in window_warnings(run))
    assert 180 <= run.summary["nis_window_max_s"][0] <= 215


def test_looking_is_the_same_with_and_without_a_record() -> None:
    one, two = slam_of(), slam_of()
    for t in range(4):
        report = look(one, t, GARDEN)
        look(two, t, GARDEN)
        assert len(report.seen_at) == len(GARDEN)
    np.testing.assert_array_equal(one.mean("cart"), two.mean("cart"))


@pytest.mark.usefixtures("never_found")
def test_the_page_draws_the_ambiguous_scans_and_lists_what_was_merged(tmp_path: Path) -> None:
    run = lost_run(tmp_path)
    shown = series(run, Scene.of(run))["association"]
    assert shown["changes"]["merged"]
    scan = next(s for s in shown["scans"] if s["t"] == 7.0)
    assert [seen["outcome"] for seen in scan["seen"]] == ["deferred"] * 6
    told = explain(run, 7.0).fates[0]
    assert scan["seen"][0]["near"][0]["name"] == told.compared[0].landmark
    assert scan["seen"][0]["near"][0]["x"] == pytest.approx(told.compared[0].place[0], abs=1e-4)
    rows = [*change_rows(run)]
    assert all(reason.startswith("merged into") or what == "removed" for _, _, what, reason in rows)
    page = report_html(run)
    assert "Landmarks merged and removed" in page
    assert "Ambiguous scans" in page
    assert "whose d2 is at the cross" in page and "`${seen.k}: ${chosen.d2}`" in page


def test_a_scan_can_be_drawn_from_the_folder_alone(tmp_path: Path) -> None:
    run = lost_run(tmp_path)
    assert main(["explain", str(run.folder), "--scan", "9"]) == 0
    picture = tmp_path / "run" / "scan_cart_109.png"
    assert picture.read_bytes()[:4] == b"\x89PNG"
    assert main(["explain", str(run.folder), "--scan", "77"]) == 2
