"""The two pictures of a run: they show what is there, for every kind of log."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from html import escape
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytest
from matplotlib.image import imread

from browser import said_by_page
from kalmark.association import ByIdentity
from kalmark.cli.shared import print_summary
from kalmark.events import Control, Event, Fix, Scan
from kalmark.geometry import ellipse
from kalmark.geometry.gaussian import contours
from kalmark.logs.log import Log, PositionTrack
from kalmark.results.evaluate import headline
from kalmark.results.figure_texts import BATCH, ROBOT, TOTALS, column_header, count, figure
from kalmark.results.plot import LANDMARK_COLOUR, draw_map, save_map
from kalmark.results.record import record
from kalmark.results.run import Run
from kalmark.results.run_page import POINTS, common_reasons, figure_text, report_html, series
from kalmark.results.scene import Scene, group_steps, stretches_of
from results_world import circle, slam_for


def recorded(log: Log, **options: Any) -> Run:
    return record(slam_for(log, **options), log, progress=False)


@pytest.fixture(scope="module")
def run() -> Run:
    return recorded(circle(steps=60))


def page_data(page: str) -> dict[str, Any]:
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', page, flags=re.DOTALL)
    assert found is not None
    return json.loads(found[1])


def test_many_ellipses_at_once_are_the_ellipses_of_the_guide() -> None:
    rng = np.random.default_rng(1)
    factors = rng.normal(size=(5, 2, 2))
    covariances, means = factors @ factors.transpose(0, 2, 1), rng.normal(size=(5, 2))
    for contour, mean, P in zip(contours(means, covariances)[:, 0], means, covariances, strict=True):
        d = contour - mean
        assert np.allclose(np.einsum("ni,ij,nj->n", d, np.linalg.inv(P), d), 9.0)
        guide = ellipse(mean, P, sigmas=3, points=40)
        assert np.allclose(np.ptp(contour, axis=0), np.ptp(guide, axis=0), rtol=0.02)


def test_the_map_is_a_png_with_labelled_axes_in_metres(run: Run, tmp_path: Path) -> None:
    save_map(run, tmp_path / "map.png")
    assert (tmp_path / "map.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    figure = draw_map(run)
    (axes,) = figure.axes
    assert axes.get_xlabel() == "x (m)"
    assert axes.get_ylabel() == "y (m)"
    assert axes.get_aspect() == 1.0
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert labels[:3] == ["estimated path", "true path, aligned", "true landmarks, aligned"]
    (rings,) = [line for line in axes.lines if line.get_color() == LANDMARK_COLOUR and line.get_linestyle() == "-"]
    assert np.isnan(rings.get_xdata()).sum() == len(run.landmarks)


@pytest.mark.parametrize(
    "log",
    [
        circle(robots=("a", "b", "c"), steps=10),
        circle(steps=10, truth=False),
        circle(steps=10, truth=False, gps=True),
        circle(steps=10, landmarks=0),
        circle(steps=10, landmarks=600),
    ],
    ids=["several robots", "no truth", "position fixes", "no landmarks", "600 landmarks"],
)
def test_every_kind_of_run_has_its_pictures(log: Log, tmp_path: Path) -> None:
    run = recorded(log)
    save_map(run, tmp_path / "map.png")
    data = page_data(report_html(run))
    assert [robot["name"] for robot in data["robots"]] == list(log.robots)
    assert all(("error" in robot) == bool(log.truth) for robot in data["robots"])
    assert len(data["maps"][-1]["id"]) == len(run.landmarks)
    assert set(data["fixes"]) == set(log.gps)


def test_a_run_without_scans_has_its_pictures() -> None:
    log = circle(steps=2)
    run = record(slam_for(log), [Control(t_ns=0, robot="rover", u=(1.0, 0.0))], progress=False)
    draw_map(run)
    assert [kept["count"] for kept in page_data(report_html(run))["maps"]] == [0]


def test_truth_is_shown_in_the_frame_of_the_map() -> None:
    log = circle(steps=60)
    elsewhere = recorded(log, start=(7.0, -3.0, 1.2))
    scene = Scene.of(elsewhere)
    gap = (scene.ways["rover"].truth - scene.ways["rover"].path)[:, :2]
    assert np.linalg.norm(gap, axis=1).max() < 0.2
    means, _ = elsewhere.landmarks.positions()
    true = np.array([scene.true_landmarks[i] for i in elsewhere.landmarks.ids])
    assert np.linalg.norm(true - means, axis=1).max() < 0.5


def test_position_fixes_are_shown_where_the_robot_was_and_not_its_antenna() -> None:
    log = circle(steps=300, truth=False, gps=True)
    poses = circle(steps=300).truth["rover"].poses[::3]
    lever = np.column_stack([np.cos(poses[:, 2]), np.sin(poses[:, 2])]) * 2.0
    track = log.gps["rover"]
    log.gps["rover"] = PositionTrack(track.t_ns, track.xy + lever, np.array([2.0, 0.0]))
    run = recorded(log)
    fixes = Scene.of(run).ways["rover"].fixes
    assert np.abs(np.linalg.norm(fixes - [0.0, 5.0], axis=1) - 5.0).max() < 0.5
    assert run.evaluate()["fix_median_m"] < 0.2


def test_the_report_is_one_file_that_asks_nothing_of_the_network(run: Run) -> None:
    page = report_html(run)
    markup = re.sub(r"<script>.*?</script>", "", page, flags=re.DOTALL)
    assert "http" not in markup
    assert not re.search(r"<(link|img|iframe)\b|\bsrc=", markup)
    assert len(page) < 8e6


STEPPED = """<script>
addEventListener("load", () => setTimeout(() => {
  const shown = [], key = name => document.dispatchEvent(new KeyboardEvent("keydown", {key: name}));
  const robot = () => el("map").data.find(trace => trace.name === "estimated path").x.filter(x => x !== null).length;
  const note = () => shown.push([el("now").textContent, robot()]);
  const bar = document.querySelector(".slider").getBoundingClientRect();
  note();
  const left = () => key("ArrowLeft"), right = () => key("ArrowRight");
  for (const step of [left, () => el("back").click(), () => el("next").click(), right]) { step(); note(); }
  document.title = JSON.stringify({shown, inSight: bar.top > 0 && bar.bottom <= innerHeight});
}, 1000));
</script></body>"""


def test_the_page_goes_step_by_step_with_its_slider_in_sight(run: Run, tmp_path: Path) -> None:
    page = report_html(run).replace("</body>", STEPPED)
    said = said_by_page(page, tmp_path, "--window-size=1280,800", "--virtual-time-budget=8000")
    assert said["inSight"]
    count, times = len(run.history.t_ns), run.history.t_s
    for (text, points), step in zip(said["shown"], (count, count - 1, count - 2, count - 1, count), strict=True):
        assert text.startswith(f"step {step} of {count} · {times[step - 1]:.2f} s")
        assert points == step


def test_the_page_names_figures_in_the_words_of_the_command_line(run: Run, capsys: pytest.CaptureFixture[str]) -> None:
    summary = run.evaluate() | {"toolbox": {"ate_raw_m": 0.25}, "batch": {"sigma_ratio": 0.9, "rms_px": 0.5}, "own": 7}
    table = report_html(replace(run, summary=summary)).partition("<h2>Figures</h2>")[2].partition("</section>")[0]
    print_summary("", summary)
    printed = capsys.readouterr().out
    assert "landmark sigma, the filter's over the batch's" in printed
    shown = [
        label.strip()
        for keys, of in ((TOTALS, summary), (BATCH, summary["batch"]))
        for key, label, _ in keys
        if key in of
    ]
    assert len(shown) > 12
    for label in shown:
        assert escape(label) in table
    of_one_camera = {"ate_similarity_m", "scale", "scale_drift"}
    for key, label, unit in ROBOT:
        if key in of_one_camera:
            continue
        assert key in summary["robots"]["rover"]
        assert f"<th>{column_header(label, unit)}</th>" in table and column_header(label, unit) in printed
    assert "<td>toolbox: position RMSE</td><td>0.25</td><td>m</td>" in table
    words = re.findall(r"<tr title=\"[^\"]*\"><td[^>]*>([^<]*)</td>", table)
    assert [label for label in words if "_" in label or label == "own"] == ["own"], "only what is unknown has its key"


def test_a_share_is_shown_in_per_cent() -> None:
    assert (figure_text(0.125, "%"), figure_text(0.125), figure_text([0.5, 0.25], "s")) == (
        "12.5",
        "0.125",
        "0.5, 0.25",
    )


def test_text_from_a_log_cannot_break_out_of_the_page() -> None:
    log = circle(steps=5)
    evil = "</script><b>&"
    events = [
        Scan(t_ns=e.t_ns, robot="rover", sensor="lidar", y=e.y[:1], ids=[evil]) for e in log if isinstance(e, Scan)
    ]
    page = report_html(record(slam_for(log), events, progress=False))
    assert evil not in page
    assert page_data(page)["maps"][-1]["id"] == [evil]


def test_long_logs_are_thinned_but_keep_their_end() -> None:
    run = recorded(circle(steps=2 * POINTS + 10, landmarks=3))
    data = series(run, Scene.of(run))
    (robot,) = data["robots"]
    assert POINTS / 2 < len(robot["t"]) <= POINTS + 1
    assert len(robot["error"]) == len(robot["sigma"]) == 3
    assert robot["t"][-1] == pytest.approx((run.history.t_ns[-1] - run.history.t_ns[0]) * 1e-9)
    assert len(data["maps"]) <= 61 + 3  # and one for each landmark
    assert data["maps"][-1]["t"] == pytest.approx(robot["t"][-1], abs=1e-3)
    assert sum(sum(column) for column in data["outcomes"]["counts"].values()) == len(run.history.step)


def test_the_nis_curve_averages_to_the_figure_of_the_summary(run: Run) -> None:
    nis = series(run, Scene.of(run))["nis"]
    assert nis["window"] == 1
    assert np.mean(nis["value"]) == pytest.approx(run.evaluate()["nis_per_dof"], rel=0.2)
    assert all(low < 1 < high for low, high in zip(nis["low"], nis["high"], strict=True))


def test_reasons_that_differ_in_a_number_are_merged_when_there_are_many(run: Run) -> None:
    count = len(run.history.outcome)
    run = recorded(circle(steps=60))
    run.history.outcome[:] = "rejected"
    object.__setattr__(run.history, "reason", np.array([f"d2 {k}.5 too large" for k in range(count)]))
    assert common_reasons(run) == [("rejected", "d2 … too large", count)]


def test_the_headline_names_the_key_figures(run: Run) -> None:
    title, figures = headline(run)
    assert title == "circle · invariant"
    assert figures[:2] == [f"{len(run.landmarks)} landmarks", "60 scans"]
    assert any(figure.startswith("position ") for figure in figures)
    assert figure_text(None) != figure_text(0.0) == "0"
    assert figure_text(1234567.0) == "1.235e+06"


def test_the_map_shows_whole_ellipses_but_a_huge_one_does_not_blow_it_up(run: Run) -> None:
    means, covariances = run.landmarks.positions()
    rings = contours(means, covariances).reshape(-1, 2)
    (axes,) = draw_map(run, world=True).axes
    (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
    assert left < rings[:, 0].min() < rings[:, 0].max() < right
    assert bottom < rings[:, 1].min() < rings[:, 1].max() < top
    huge = replace(run.landmarks, covariances=[1e6 * np.eye(2), *run.landmarks.covariances[1:]])
    (axes,) = draw_map(replace(run, landmarks=huge), world=True).axes
    assert axes.get_xlim()[1] - axes.get_xlim()[0] < 2 * (right - left)


def test_no_line_is_drawn_across_a_gap_in_time() -> None:
    log = circle(steps=120)
    events = [e for e in log if not (isinstance(e, Scan) and 4.05 < e.t_s < 9.0)]
    run = record(slam_for(log), replace(log, events=events), progress=False)
    before = int((run.history.t_ns <= 4.05e9).sum())
    (axes,) = draw_map(run).axes
    lines = [line.get_xydata() for line in axes.lines if len(line.get_xydata()) == len(run.history.t_ns) + 1]
    assert len(lines) == 3, "the estimated path, the true one and that by dead reckoning"
    for points in lines:
        assert np.flatnonzero(np.isnan(points).any(axis=1)).tolist() == [before]
    (robot,) = page_data(report_html(run))["robots"]
    assert robot["gaps"] == [before]
    assert len(robot["truth"]["x"]) == len(robot["t"]), "the page breaks its curves at the gaps"
    nis = page_data(report_html(run))["nis"]
    (gap,) = nis["gaps"]
    assert nis["t"][gap - 1] < 4.05
    assert nis["t"][gap] >= 8.8, "since the first scan"
    groups, gaps = group_steps(np.array([0, 1, 3, 4, 5, 9]), 10**9 * np.array([0, 1, 2, 30, 31, 32]), 4)
    assert (groups.tolist(), gaps.tolist()) == ([0, 0, 0, 1, 1, 2], [1])
    assert stretches_of(10**9 * np.array([0, 5, 10, 15, 70])).tolist() == [0, 0, 0, 0, 1]


def test_the_title_keeps_its_distance_from_the_edge_of_the_picture(run: Run, tmp_path: Path) -> None:
    save_map(run, tmp_path / "map.png")
    ink = (imread(tmp_path / "map.png")[..., :3] < 0.9).any(axis=2)
    assert not ink[:15].any()
    assert not ink[-15:].any()


def test_fixes_that_the_filter_used_are_drawn_where_they_were_measured() -> None:
    log = circle(steps=10)
    fix = Fix(t_ns=log.events[-1].t_ns, robot="rover", y=(1.0, 0.1), cov=np.eye(2))
    run = record(slam_for(log), [*log.events, fix], progress=False)
    assert Scene.of(run).ways["rover"].used.tolist() == [[1.0, 0.1]]
    assert page_data(report_html(run))["usedFixes"] == {"rover": {"x": [1.0], "y": [0.1]}}
    assert "fixes used" in [text.get_text() for text in draw_map(run).legends[0].get_texts()]


def test_how_far_fixes_are_from_the_estimate_is_a_curve_of_the_page_with_a_gap_where_there_were_none() -> None:
    log, true = circle(steps=200), circle(steps=200).truth["rover"]
    at = [k for k in range(5, 200, 5) if not 60 < k < 140]
    t_ns, xy = true.t_ns[at].tolist(), true.poses[at, :2]
    xy[3, 1] += 50.0
    fixes = [Fix(t_ns=t, robot="rover", y=y, cov=0.01 * np.eye(2)) for t, y in zip(t_ns, xy, strict=True)]
    slam = slam_for(log)
    slam.state.settings = replace(slam.state.settings, association=ByIdentity(gate=0.9973))
    run = record(slam, sorted([*log.events, *fixes], key=lambda e: e.t_ns), progress=False)
    data = page_data(report_html(run))
    (rover,) = data["innovations"]
    assert (rover["name"], rover["colour"]) == ("rover", data["robots"][0]["colour"])
    assert rover["gaps"] == [at.index(140)]
    assert np.array(rover["t"]) == pytest.approx(np.array(at) * 0.1 - 0.1)
    assert rover["z"][1][3] == pytest.approx(50.0, abs=1.0)
    assert (np.abs(np.delete(rover["z"], 3, axis=1)) < 3 * np.delete(rover["sigma"], 3, axis=1)).mean() > 0.9
    assert np.min(rover["sigma"]) >= 0.1
    assert rover["rejected"]["t"] == [rover["t"][3]]
    assert [column[0] for column in rover["rejected"]["z"]] == [column[3] for column in rover["z"]]
    assert page_data(report_html(recorded(log)))["innovations"] == []


def test_figures_in_words_are_without_powers_of_ten_and_in_the_right_number() -> None:
    assert [figure(110.4, 2), figure(1234.5), figure(0.01234), figure(float("nan"))] == ["110", "1230", "0.0123", "nan"]
    assert [count(1, "scan"), count(0, "scan"), count(2, "fix", "fixes")] == ["1 scan", "0 scans", "2 fixes"]
    title, parts = headline(recorded(circle(steps=1)))
    assert title == "circle · invariant"
    assert "1 scan" in parts


def test_steps_in_which_something_is_compiled_have_no_time(monkeypatch: pytest.MonkeyPatch) -> None:
    log = circle(steps=8)
    slam, scans = slam_for(log), 0
    process = slam.process

    def compiling(event: Event) -> Any:
        nonlocal scans
        scans += isinstance(event, Scan)
        if isinstance(event, Control) and scans == 4:
            numba.njit(lambda a: a + 1)(1.0)
        return process(event)

    recorded(log)
    monkeypatch.setattr(slam, "process", compiling)
    run = record(slam, log, progress=False)
    assert np.flatnonzero(np.isnan(run.history.step_us)).tolist() == [4]
    assert run.evaluate()["step_us_p99"] > 0


def test_the_first_step_does_not_count_for_the_time_a_step_takes(run: Run) -> None:
    slow = replace(run.history, step_us=np.array([1e9, *[5.0] * (len(run.history.t_ns) - 1)]))
    summary = replace(run, history=slow, summary={}).evaluate()
    assert (summary["step_us_median"], summary["step_us_p99"]) == (5.0, 5.0)
